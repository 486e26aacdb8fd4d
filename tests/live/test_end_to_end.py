"""Simulated vehicle, MAVProxy and monitor together; and what a monitor may say on a link."""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

import servofd
from logparsers.codec import Codec, Signature, signing_key
from servofd.aircraft.schema import load_aircraft
from servofd.servo.faults import Stuck
from tests.live.ground import mavproxy, router
from tests.live.relay import BadLink, relayed
from tests.live.vehicles import DEADLINE_S, flown, flying, free_port, plane_file, until

if TYPE_CHECKING:
    from collections.abc import Iterator

SPOKEN = {
    "HEARTBEAT",
    "STATUSTEXT",
    "NAMED_VALUE_FLOAT",
    "COMMAND_LONG",
    "TIMESYNC",
    "REMOTE_LOG_BLOCK_STATUS",
    "PARAM_REQUEST_LIST",
    "PARAM_REQUEST_READ",
}
ASKED = {511, 512}  # MAV_CMD_SET_MESSAGE_INTERVAL, MAV_CMD_REQUEST_MESSAGE


@pytest.fixture
def aircraft_file(tmp_path: Path) -> Path:
    """The plane that the vehicle flies, as its user would describe it."""
    path = tmp_path / "plane.toml"
    path.write_text(plane_file())
    return path


class Monitor:
    """``servofd monitor`` in a process of its own, with its events on standard output."""

    def __init__(self, *arguments: str) -> None:
        command = [sys.executable, "-m", "servofd", "monitor", *arguments, "--json-lines", "-"]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        self.out = self.err = ""

    def read(self) -> Monitor:
        """Take what it printed until now."""
        out, err = self.process.stdout, self.process.stderr
        assert out is not None
        assert err is not None
        for pipe in select.select([out, err], [], [], 0.1)[0]:
            text = os.read(pipe.fileno(), 65_536).decode()
            self.out, self.err = (self.out + text, self.err) if pipe is out else (self.out, self.err + text)
        return self

    def end(self) -> int:
        """Ctrl-C."""
        self.process.send_signal(signal.SIGINT)
        out, err = self.process.communicate(timeout=DEADLINE_S)
        self.out, self.err = self.out + out.decode(), self.err + err.decode()
        return self.process.returncode

    def alarms(self, surface: str) -> list[dict[str, Any]]:
        """Those of a surface until now."""
        return [e for e in self.events() if e["event"] == "alarm" and e["surface"] == surface]

    def named(self, surface: str) -> list[str]:
        """What its faults were called until now."""
        return [e["kind"] for e in self.events() if e["event"] == "named" and e["surface"] == surface]

    def events(self) -> list[dict[str, Any]]:
        lines = self.out.splitlines(keepends=True)
        return [json.loads(line) for line in lines if line.endswith("\n")]


@contextlib.contextmanager
def monitor(*arguments: str) -> Iterator[Monitor]:
    program = Monitor(*arguments)
    try:
        yield program
    finally:
        program.process.kill()
        program.process.communicate()


@pytest.mark.slow
def test_an_alert_reaches_the_console_of_mavproxy(tmp_path: Path, aircraft_file: Path) -> None:
    own_log = tmp_path / "own.tlog"
    flight = flown(command="lively", duration_s=45.0, faults={"elevator": Stuck(30.0)})
    with (
        router(tmp_path) as (console, vehicle, alerts, out),
        monitor(out, "-c", str(aircraft_file), "--alert-to", alerts, "--tlog", str(own_log)) as watching,
    ):
        console.wait_for("Waiting for heartbeat")
        with flying(vehicle, flight, speed=3.0) as counted:
            console.wait_for("AP: ELEVATOR stuck ")
            until(lambda: console.read() and watching.read() and counted, "the end of the flight")
        assert watching.end() == 1, watching.err
    assert watching.alarms("elevator")[0]["time_s"] == pytest.approx(30.5, abs=1.0)
    assert watching.alarms("rudder") + watching.alarms("aileron") == []
    dump = [sys.executable, str(Path(sys.executable).with_name("mavlogdump.py")), "--types=SERVO_OUTPUT_RAW"]
    shown = subprocess.run([*dump, str(own_log)], capture_output=True, text=True, check=True, timeout=DEADLINE_S).stdout
    assert shown.count("SERVO_OUTPUT_RAW {") > 800
    (result,) = servofd.audit(str(own_log), load_aircraft(aircraft_file))
    found = {surface.surface: [fault.kind for fault in surface.faults] for surface in result.surfaces}
    assert found == {"aileron": [], "elevator": ["stuck"], "rudder": []}
    (fault,) = next(surface.faults for surface in result.surfaces if surface.surface == "elevator")
    assert watching.alarms("elevator")[0]["time_s"] == pytest.approx(fault.alarm_s, abs=0.3)


@pytest.mark.slow
def test_of_two_signing_vehicles_behind_a_bad_link_the_right_one_is_told(tmp_path: Path, aircraft_file: Path) -> None:
    """Through MAVProxy, 30 % of all frames of either vehicle lost: whole texts show, and of one vehicle alone."""
    key, signature = tmp_path / "key", Signature(signing_key(b"secret"), time.time())
    key.write_text("secret")
    files = [word for system in (1, 2) for word in ("-c", f"{system}={aircraft_file}")]
    flights = (flown(command="lively", duration_s=45.0, faults={"elevator": Stuck(30.0)}), flown(duration_s=45.0))
    first, second, alerts, out = (free_port() for _ in range(4))
    links = [f"--master=udpin:127.0.0.1:{port}" for port in (first, second, alerts)]
    with (
        mavproxy(tmp_path, *links, f"--out=udpout:127.0.0.1:{out}", "--streamrate=-1", "--target-system=1") as console,
        relayed(first, BadLink(loss=0.3, seed=1)) as one,
        relayed(second, BadLink(loss=0.3, seed=2)) as other,
        monitor(
            *(f"udpin:127.0.0.1:{out}", *files, "--signing-key", str(key)),
            *("--alert-to", f"udpout:127.0.0.1:{alerts}"),
        ) as watching,
        contextlib.ExitStack() as open_,
    ):
        console.wait_for("Waiting for heartbeat")
        for system, port in enumerate((one, other), 1):
            codec, link = Codec(system, 1, signature=signature), f"udpout:127.0.0.1:{port}"
            flight = flights[system - 1]
            open_.enter_context(
                flying(link, flight, codec=codec, wait=False, speed=2.0, message_hz=40.0, system=system)
            )
        until(lambda: console.read() and watching.read().named("elevator"), "a name for the fault")
        console.wait_for("AP: ELEVATOR stuck ")
        assert watching.end() == 1, watching.err
    told = [event for event in watching.events() if event["event"] == "alarm"]
    assert [(event["vehicle"], event["surface"]) for event in told] == [(1, "elevator")]
    assert told[0]["time_s"] == pytest.approx(30.7, abs=0.7)


@pytest.mark.slow
@pytest.mark.parametrize("silent", [False, True])
def test_every_byte_that_a_monitor_sends(aircraft_file: Path, silent: bool) -> None:
    port = free_port(socket.SOCK_STREAM)
    flight = flown(command="lively", duration_s=20.0, faults={"elevator": Stuck(8.0)})
    record = bytearray()
    quiet = ["--no-request", "--no-alert"] if silent else []
    with (
        monitor(f"tcpin:127.0.0.1:{port}", "-c", str(aircraft_file), *quiet) as watching,
        flying(f"tcp:127.0.0.1:{port}", flight, wait=False, record=record, speed=2.0, message_hz=40.0),
    ):
        until(lambda: watching.read().named("elevator"), "a name for the fault")
        watching.end()
    if silent:
        assert bytes(record) == b""
        return
    messages = Codec(250, 1).decode(bytes(record))
    assert {m.name for m in messages} <= SPOKEN
    assert {m.name for m in messages} >= {"HEARTBEAT", "COMMAND_LONG", "STATUSTEXT"}
    assert {m.fields["command"] for m in messages if m.name == "COMMAND_LONG"} <= ASKED
    assert {(m.system, m.component) for m in messages} == {(1, 191)}
    assert all(len(m.fields["text"]) <= 50 for m in messages if m.name == "STATUSTEXT")
    assert sum(len(Codec(1, 191).encode(m.name, m.fields)) for m in messages) == len(record)
