"""What ends suddenly, monitor or viewer, takes at most one flush with it."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import time
from typing import TYPE_CHECKING

import pytest

import servofd
from servofd.aircraft.schema import load_aircraft
from servofd.cli import main
from servofd.servo.faults import Stuck
from servofd.simulation.telemetry_writer import telemetry_log
from tests.live.vehicles import DEADLINE_S, PLANE, flown, free_port, plane_file

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

pytestmark = pytest.mark.slow

_SPEED = 4.0


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    flight = flown(duration_s=60.0, command="lively", faults={"elevator": Stuck(8.0)})
    (tmp_path / "flight.tlog").write_bytes(telemetry_log(flight, PLANE))
    (tmp_path / "plane.toml").write_text(plane_file())
    return tmp_path


def monitor(folder: Path, *options: str) -> subprocess.Popen[str]:
    given = ["monitor", "flight.tlog", "-c", "plane.toml", "--plain", "--json-lines", "events.jsonl", *options]
    command = [sys.executable, "-m", "servofd", *given]
    return subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def until(happened: Callable[[], bool], what: str) -> None:
    end = time.monotonic() + 3.0 * DEADLINE_S
    while not happened():
        assert time.monotonic() < end, f"waited in vain for {what}"
        time.sleep(0.02)


def alarms(folder: Path) -> list[dict[str, object]]:
    lines = folder / "events.jsonl"
    events = [json.loads(line) for line in lines.read_text().splitlines()] if lines.exists() else []
    return [event for event in events if event["event"] == "alarm"]


def test_a_killed_monitor_leaves_all_but_the_last_flush(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    running = monitor(folder, "--speed", f"{_SPEED:g}", "--rrd", "own.rrd", "--tlog", "own.tlog")
    until(lambda: bool(alarms(folder)), "the alarm")
    (alarm,) = alarms(folder)
    # What the alarm was raised on is on the disk after the flush that may be under way, and one more.
    for name in ("own.rrd", "own.tlog") * 2:
        before = (folder / name).stat().st_size
        until(lambda file=folder / name, size=before: file.stat().st_size > size, "a flush")  # type: ignore[misc]
    running.kill()
    running.communicate()
    (result,) = servofd.audit(folder / "own.tlog", load_aircraft(folder / "plane.toml"))
    (verdict,) = (s for s in result.surfaces if s.surface == "elevator")
    assert verdict.faults[0].kind == "stuck"
    assert verdict.faults[0].alarm_s == alarm["time_s"]
    whole, kept = ((folder / name).read_bytes() for name in ("flight.tlog", "own.tlog"))
    assert whole.startswith(kept)
    capsys.readouterr()
    assert main(["review", str(folder / "own.rrd"), "--json", "-"]) == 1
    (log,) = json.loads(capsys.readouterr().out)["logs"]
    assert log["surfaces"]["elevator"]["status"] == "fault"
    assert log["duration_s"] > float(str(alarm["time_s"])) - 0.5


@pytest.mark.nightly
def test_a_viewer_that_dies_stops_no_alarm(folder: Path) -> None:
    port = free_port(socket.SOCK_STREAM)
    running = monitor(folder, "--speed", f"{_SPEED:g}", "--serve", "--viewer-port", str(port))

    def connected() -> bool:
        try:
            viewer = socket.create_connection(("127.0.0.1", port), timeout=1.0)
        except OSError:
            return False
        with viewer:
            viewer.sendall(b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n")
        return True  # gone in the middle of the greeting

    until(connected, "the port for viewers")
    _, said = running.communicate(timeout=3.0 * DEADLINE_S)
    assert running.returncode == 1, said
    assert len(alarms(folder)) == 1
