"""The simulated vehicle on real sockets, with pymavlink as the ground station."""

from __future__ import annotations

import contextlib
import io
import os
import pty
import signal
import socket
import subprocess
import sys
import threading
import tty
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

import logparsers
from logparsers.codec import Codec, Signature
from logparsers.protocol import RemoteLogCommand
from servofd.cli import main
from servofd.simulation.dataflash_writer import dataflash_log
from tests.live.ground import ours, pymavlink_station, received
from tests.live.relay import BadLink, relayed
from tests.live.vehicles import DEADLINE_S, PLANE, flown, flying, free_port, until

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

SERVO = 36
KEY = bytes(range(32))


@pytest.mark.slow
def test_pymavlink_flies_with_it_as_with_a_vehicle() -> None:
    port = free_port()
    flight = flown(duration_s=60.0)
    with (
        pymavlink_station(f"udpin:127.0.0.1:{port}") as ground,
        flying(f"udpout:127.0.0.1:{port}", flight, speed=10.0) as counted,
    ):
        beat = ground.wait_heartbeat(timeout=DEADLINE_S)
        assert (ground.target_system, beat.type, beat.autopilot) == (1, 1, 3)
        assert ground.probably_vehicle_heartbeat(beat)
        for interval_us, result in ((20_000, 2), (25_000, 0)):
            ground.mav.command_long_send(1, 1, 511, 0, SERVO, interval_us, 0, 0, 0, 0, 0)
            assert received(ground, "COMMAND_ACK").result == result
        ground.mav.timesync_send(0, 4242)
        answer = received(ground, "TIMESYNC")
        assert (answer.ts1, answer.tc1 > 0) == (4242, True)
        ground.param_fetch_all()
        until(lambda: received(ground, "PARAM_VALUE") and len(ground.params) == 33, "33 parameters")
        assert ground.params["SERVO2_FUNCTION"] == 19.0
        ground.mav.command_long_send(1, 1, 512, 0, 148, 0, 0, 0, 0, 0, 0)
        assert received(ground, "AUTOPILOT_VERSION").flight_sw_version >> 16 == 0x0407
        ground.waypoint_request_list_send()
        assert received(ground, "MISSION_COUNT").count == 0
        rows = [received(ground, "SERVO_OUTPUT_RAW") for _ in range(200)]
        assert ground.packet_loss() == 0.0
    at = np.searchsorted(np.round(flight.time_s * 1e6), [row.time_usec for row in rows])
    assert [row.servo2_raw for row in rows] == flight.pulse_us[at, 0].tolist()
    assert 1e6 * (len(rows) - 1) / (rows[-1].time_usec - rows[0].time_usec) == pytest.approx(40.0, abs=0.5)
    assert counted[0].received >= 6


@contextlib.contextmanager
def both_ends(kind: str) -> Iterator[tuple[str, str]]:
    """Endpoints of a vehicle and of a ground station that belong together."""
    if kind == "serial":
        vehicle, vehicle_tty = pty.openpty()
        ground, ground_tty = pty.openpty()
        for terminal in (vehicle, vehicle_tty, ground, ground_tty):
            tty.setraw(terminal)
        ends = {vehicle: ground, ground: vehicle}
        stop = threading.Event()

        def cable() -> None:
            import select

            while not stop.is_set():
                for ready in select.select([vehicle, ground], [], [], 0.05)[0]:
                    os.write(ends[ready], os.read(ready, 4096))

        thread = threading.Thread(target=cable)
        thread.start()
        try:
            yield os.ttyname(vehicle_tty), os.ttyname(ground_tty)
        finally:
            stop.set()
            thread.join()
            for terminal in (vehicle, vehicle_tty, ground, ground_tty):
                os.close(terminal)
        return
    port = free_port(socket.SOCK_STREAM if kind.startswith("tcp") else socket.SOCK_DGRAM)
    other = {"udpin": "udpout", "udpout": "udpin", "tcpin": "tcp"}[kind]
    yield f"{kind}:127.0.0.1:{port}", f"{other}:127.0.0.1:{port}"


@pytest.mark.parametrize("kind", ["udpin", "udpout", "tcpin", "serial"])
def test_every_kind_of_link_carries_both_ways(kind: str) -> None:
    with (
        both_ends(kind) as (here, there),
        flying(here, flown(duration_s=60.0), speed=10.0),
        ours(there) as ground,
    ):
        ground.say("HEARTBEAT", type=6)
        ground.wait_for("HEARTBEAT")
        ground.say("COMMAND_LONG", command=511, param1=SERVO, param2=25_000)
        assert ground.wait_for("COMMAND_ACK")[0].fields["result"] == 0
        stamps = [message.fields["time_usec"] for message in ground.wait_for("SERVO_OUTPUT_RAW", 50)]
        assert stamps == sorted(stamps)


@pytest.mark.slow
def test_a_tcp_link_is_dialled_again_after_the_other_end_was_gone() -> None:
    port = free_port(socket.SOCK_STREAM)
    with contextlib.ExitStack() as first:
        server = first.enter_context(ours(f"tcpin:127.0.0.1:{port}"))
        with flying(f"tcp:127.0.0.1:{port}", flown(duration_s=600.0), speed=10.0):
            server.wait_for("HEARTBEAT")
            server.say("HEARTBEAT")
            server.wait_for("NAMED_VALUE_FLOAT", 10)
            first.close()
            with ours(f"tcpin:127.0.0.1:{port}") as again:
                again.wait_for("NAMED_VALUE_FLOAT", 10)


def test_version_1_frames() -> None:
    port = free_port()
    codec = Codec(7, 1, version=1)
    with ours(f"udpin:127.0.0.1:{port}") as ground, flying(f"udpout:127.0.0.1:{port}", codec=codec, system=7):
        first = until(lambda: ground.link.receive(0.1), "a heartbeat")
        assert first[0] == 0xFE
        ground.say("HEARTBEAT", target_system=0)
        rows = ground.wait_for("NAMED_VALUE_FLOAT", 3)
        assert {row.system for row in rows} == {7}


def test_a_signed_link_hears_only_who_has_the_key() -> None:
    port = free_port()
    signed = Codec(1, 1, signature=Signature(KEY, 1.8e9))
    with ours(f"udpin:127.0.0.1:{port}") as ground, flying(f"udpout:127.0.0.1:{port}", codec=signed) as counted:
        ground.wait_for("HEARTBEAT", 2)
        ground.say("COMMAND_LONG", command=511, param1=SERVO, param2=25_000)
        ground.codec = Codec(254, 190, signature=Signature(KEY[::-1], 1.8e9))
        ground.say("COMMAND_LONG", command=511, param1=SERVO, param2=26_000)
        assert ground.codec.decode(until(lambda: ground.link.receive(0.1), "a frame")) == []
        ground.codec = Codec(253, 190, signature=Signature(KEY, 1.8e9))
        ground.say("COMMAND_LONG", command=511, param1=SERVO, param2=27_000)
        (answer,) = ground.wait_for("COMMAND_ACK")
        assert answer.fields["target_system"] == 253
    assert counted[0].received == 1


@pytest.mark.slow
def test_the_log_arrives_whole_through_a_bad_link() -> None:
    """A tenth lost, a tenth twice, a tenth late, a tenth damaged, both ways: blocks are sent until acknowledged."""
    port = free_port()
    flight = flown(duration_s=8.0)
    blocks: dict[int, bytes] = {}
    down, up = BadLink(**_bad(2)), BadLink(**_bad(3))
    with (
        ours(f"udpin:127.0.0.1:{port}") as ground,
        relayed(port, down, up) as relay,
        flying(f"udpout:127.0.0.1:{relay}", flight, speed=4.0) as counted,
    ):

        def step() -> bool:
            if not blocks:
                ground.say("REMOTE_LOG_BLOCK_STATUS", seqno=RemoteLogCommand.START, status=1)
            for message in ground.listen():
                if message.name == "REMOTE_LOG_DATA_BLOCK":
                    number = message.fields["seqno"]
                    blocks[number] = bytes(message.fields["data"])
                    ground.say("REMOTE_LOG_BLOCK_STATUS", seqno=number, status=1)
            return bool(counted)

        until(step, "the end of the flight")
    whole = next(n for n in range(len(blocks) + 1) if n not in blocks)
    assert whole > 0.9 * len(blocks) > 100
    live = logparsers.read(io.BytesIO(b"".join(blocks[n] for n in range(whole))))
    file = logparsers.read(io.BytesIO(dataflash_log(flight, PLANE)))
    pulses = live["RCOU.C2"]
    assert set(zip(pulses.time_s, pulses.values, strict=True)) <= set(
        zip(file["RCOU.C2"].time_s, file["RCOU.C2"].values, strict=True)
    )
    assert down.lost > 50


def _bad(seed: int) -> dict[str, Any]:
    return {"loss": 0.1, "duplicate": 0.1, "reorder": 0.1, "corrupt": 0.1, "seed": seed}


def test_the_bad_link_does_what_it_says() -> None:
    codec = Codec(1, 1)
    frames = [codec.encode("NAMED_VALUE_FLOAT", {"time_boot_ms": 10 * n}) for n in range(1000)]
    link = BadLink(loss=0.3, outages_s=((4.0, 6.0),))
    out = [frame for each in frames for frame in link.through(each)]
    stamps = [m.fields["time_boot_ms"] for m in Codec(9, 9).decode(b"".join(out))]
    assert not [at_ms for at_ms in stamps if 4000 <= at_ms < 6000]
    assert 0.65 < len(stamps) / 800 < 0.75
    worse = BadLink(duplicate=0.2, reorder=0.2, corrupt=0.2, seed=1)
    mixed = [frame for each in frames for frame in worse.through(each)]
    assert 1150 < len(mixed) < 1250
    assert 600 < len(set(mixed) & set(frames)) < 850
    order = [frames.index(frame) for frame in mixed if frame in frames]
    assert order != sorted(order)
    same = BadLink(duplicate=0.2, reorder=0.2, corrupt=0.2, seed=1)
    assert mixed == [frame for each in frames for frame in same.through(each)]


@pytest.mark.slow
def test_ctrl_c_ends_the_flight() -> None:
    port = free_port()
    command = [sys.executable, "-m", "servofd", "simulate", "--stream", f"udpout:127.0.0.1:{port}"]
    with (
        ours(f"udpin:127.0.0.1:{port}") as ground,
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process,
    ):
        ground.wait_for("NAMED_VALUE_FLOAT")
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=DEADLINE_S)
    assert (process.returncode, err) == (0, "")
    assert out.splitlines()[0] == f"udpout:127.0.0.1:{port}: system 1, elevator, aileron, rudder, 600 s; Ctrl-C ends it"
    assert out.splitlines()[1].startswith(f"udpout:127.0.0.1:{port}: flew ")


def test_a_flight_ends_by_itself(capsys: pytest.CaptureFixture[str]) -> None:
    port = free_port()
    arguments = ["simulate", "--stream", f"udpout:127.0.0.1:{port}", "--duration", "3", "--speed", "50"]
    assert main([*arguments, "--fault", "rudder:stuck@1", "--clock-s", "4290"]) == 0
    assert "flew 150 turns" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "hint"),
    [
        (["--stream", "udpin:127.0.0.1:{taken}"], "another program listens there"),
        (["--stream", "udpin:192.0.2.1:14550"], "no such address"),
        (["--stream", "tcp:127.0.0.1:{free}"], "no answer from there"),
        (["--stream", "udpout:no.such.host.invalid:14550"], "no host of this name"),
        (["--stream", "/dev/no_such_device"], "No such file or directory"),
        (["--stream", "/bin/true"], "not a MAVLink endpoint"),
        (["--stream", "arduplane.elf"], "not a MAVLink endpoint"),
        (["--stream", "flight.tlog"], "not a MAVLink endpoint"),
        (["--stream", "udpout:127.0.0.1"], "no port"),
        (["--stream", "udpin:{free}", "--system", "0"], "from 1 to 255"),
        (["--stream", "udpin:{free}", "--speed", "0"], "1 is real time"),
        (["--stream", "udpin:{free}", "--feedback", "nmaed"], "did you mean named?"),
        (["--stream", "udpin:{free}", "--signing-key", "no_such_key"], "cannot read it"),
        (["--stream", "udpin:{free}", "--clock-s", "-1"], "give seconds"),
        (["--stream", "udpin:{free}", "--generation", "volz"], "belongs to a .bin"),
        (["--stream", "udpin:{free}", "--fault", "elevator:stuck@601"], "lasts from 0 to 600 s"),
        (["-o", "flight.csv", "--speed", "2"], "belongs to --stream"),
        (["-o", "flight.csv", "--stream", "udpin:{free}"], "not allowed with"),
        ([], "one of the arguments"),
    ],
)
def test_a_wrong_call_is_told_in_one_line(
    arguments: list[str], hint: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        ports = {"taken": taken.getsockname()[1], "free": free_port(socket.SOCK_STREAM)}
        try:
            code = main(["simulate", *(argument.format(**ports) for argument in arguments)])
        except SystemExit as stopped:
            code = int(str(stopped.code))
    err = capsys.readouterr().err
    assert (code, err.count("\n")) == (2, 1)
    assert hint in err


def test_a_serial_device_without_rights_says_who_has_them(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import serial

    def forbidden(*_: object, **__: object) -> None:
        raise serial.SerialException(13, "could not open port /dev/ttyACM0: [Errno 13] Permission denied")

    monkeypatch.setattr(serial, "Serial", forbidden)
    assert main(["simulate", "--stream", "/dev/ttyACM0"]) == 2
    err = capsys.readouterr().err
    assert err.startswith("servofd: /dev/ttyACM0,115200: Permission denied; on Linux, members of the group dialout may")
    assert err.count("\n") == 1
