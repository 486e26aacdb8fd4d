"""What a real ArduPilot does on its link, seen over loopback: one test for each behaviour, and the monitor's answer."""

from __future__ import annotations

import socket
import time
from collections import defaultdict
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from logparsers.protocol import RemoteLogCommand
from servofd.simulation.vehicle.troubles import Edit, Freeze, Jump, Late, Pause, Reboot, Silence, Stall, Trouble
from tests.live.ground import Ground, ours
from tests.live.test_end_to_end import monitor
from tests.live.test_troubles import lively
from tests.live.vehicles import flying, free_port, plane_file, until

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from logparsers.codec import Received

SERVO_OUTPUT_RAW, NAMED_VALUE_FLOAT = 36, 251
ACCEPTED, DENIED = 0, 2
SPEED = 10.0
"""Seconds of the flight in one of the clock."""


@contextmanager
def linked(*troubles: Trouble, duration_s: float = 20.0) -> Iterator[tuple[Ground, list[Any], Any]]:
    """A ground station, what was counted once the vehicle has landed, and the flight; nothing is lost on TCP."""
    port, flight = free_port(socket.SOCK_STREAM), lively(duration_s=duration_s)
    with (
        ours(f"tcpin:127.0.0.1:{port}") as ground,
        flying(f"tcp:127.0.0.1:{port}", flight, speed=SPEED, message_hz=25.0, troubles=troubles) as counted,
    ):
        ground.wait_for("HEARTBEAT")
        ground.say("HEARTBEAT")
        yield ground, counted, flight


def listened(*troubles: Trouble, **options: Any) -> tuple[list[tuple[float, Received]], Any]:
    """All that comes of a flight, each with its arrival [s of the flight], and the flight."""
    with linked(*troubles, **options) as (ground, counted, flight):
        heard: list[tuple[float, Received]] = []

        def step() -> bool:
            heard.extend((SPEED * time.monotonic(), message) for message in ground.listen())
            return bool(counted)

        until(step, "the end of the flight")
        heard += [(SPEED * time.monotonic(), message) for message in ground.listen()]
    return heard, flight


def asked(ground: Ground, message: int, interval_us: int) -> dict[str, Any]:
    """Ask for an interval; gives the answer."""
    known = len(ground.received["COMMAND_ACK"])
    ground.say("COMMAND_LONG", command=511, param1=message, param2=interval_us)
    return dict(ground.wait_for("COMMAND_ACK", known + 1)[-1].fields)


def stamps_s(heard: list[tuple[float, Received]], name: str = "SERVO_OUTPUT_RAW") -> np.ndarray[Any, Any]:
    return np.array([1e-6 * m.fields["time_usec"] for _, m in heard if m.name == name])


class Client:
    """A client of the log over MAVLink: it asks, acknowledges, and notes when blocks come [s, the vehicle's clock]."""

    def __init__(self, ground: Ground) -> None:
        self.ground, self.acknowledges, self.now_s = ground, True, 0.0
        self.blocks: list[tuple[float, int, bytes]] = []
        self.restarted = False
        self.start()

    def start(self) -> None:
        self.ground.say("REMOTE_LOG_BLOCK_STATUS", seqno=RemoteLogCommand.START, status=1)

    def listen(self) -> bool:
        """Take what came; whether the vehicle has begun anew."""
        for message in self.ground.listen():
            if message.name == "SERVO_OUTPUT_RAW":
                at_s = 1e-6 * message.fields["time_usec"]
                self.restarted |= at_s < self.now_s - 1.0
                self.now_s = at_s
            if message.name == "REMOTE_LOG_DATA_BLOCK":
                self.blocks.append((self.now_s, message.fields["seqno"], bytes(message.fields["data"])))
                if self.acknowledges:
                    self.ground.say("REMOTE_LOG_BLOCK_STATUS", seqno=message.fields["seqno"], status=1)
        return self.restarted

    def until(self, at_s: float) -> None:
        """Listen until that time of the vehicle's clock."""

        def step() -> bool:
            self.listen()
            return self.now_s >= at_s

        until(step, f"{at_s:g} s of the flight")


def test_40_hz_are_granted_and_50_refused() -> None:
    with linked() as (ground, _, _):
        assert asked(ground, SERVO_OUTPUT_RAW, 20_000)["result"] == DENIED
        assert asked(ground, SERVO_OUTPUT_RAW, 25_000)["result"] == ACCEPTED
        known = len(ground.received["SERVO_OUTPUT_RAW"])
        rows = ground.wait_for("SERVO_OUTPUT_RAW", known + 100)[known + 10 :]
    pace_us = np.diff([row.fields["time_usec"] for row in rows])
    assert 1e6 / pace_us.mean() == pytest.approx(40.0, abs=0.5)
    assert set(pace_us) == {20_000, 40_000}


def test_an_acknowledgement_does_not_name_its_message() -> None:
    """Those of two messages that were asked for are the same to the last field."""
    with linked() as (ground, _, _):
        first, second = asked(ground, SERVO_OUTPUT_RAW, 50_000), asked(ground, 74, 50_000)
    assert first == second
    assert first["command"] == 511
    assert not {SERVO_OUTPUT_RAW, 74} & {value for key, value in first.items() if key != "command"}


def test_named_value_float_cannot_be_requested_and_each_try_is_told_to_everybody() -> None:
    with linked() as (ground, _, _):
        for tries in (1, 2):
            assert asked(ground, NAMED_VALUE_FLOAT, 25_000)["result"] == DENIED
            texts = [m.fields["text"] for m in ground.received["STATUSTEXT"]]
            assert texts.count("No ap_message for mavlink id (251)") == tries


@pytest.mark.nightly
def test_a_dataflash_client_is_dropped_after_10_s_without_acknowledgement_until_it_starts_again() -> None:
    """Ten of the clock, however fast the flight goes."""
    with linked(duration_s=200.0) as (ground, _, _):
        client = Client(ground)
        client.until(6.0)
        client.acknowledges, silent_s = False, client.now_s
        client.until(silent_s + 13.0 * SPEED)
        dropped_s = client.blocks[-1][0]
        assert (dropped_s - silent_s) / SPEED == pytest.approx(10.0, abs=0.5)
        client.blocks.clear()
        client.start()
        client.acknowledges = True
        client.until(client.now_s + 3.0)
    assert client.blocks[0][1] == 0


@pytest.mark.slow
def test_blocks_are_counted_from_0_after_a_reboot_and_come_when_asked_for() -> None:
    with linked(Reboot(8.0, away_s=4.0), duration_s=40.0) as (ground, _, _):
        client = Client(ground)
        until(client.listen, "a clock that begins anew")
        before = {number: data for _, number, data in client.blocks}
        client.blocks.clear()
        client.until(client.now_s + 3.0)
        assert client.blocks == []
        client.start()
        client.until(client.now_s + 3.0)
    assert max(before) > 100
    assert client.blocks[0][1] == 0
    again = {number: data for _, number, data in client.blocks}
    assert any(again[number] != before[number] for number in set(again) & set(before))


@pytest.mark.slow
def test_blocks_stall_at_arming_while_everything_else_comes() -> None:
    with linked(Stall(6.0, for_s=5.0), duration_s=30.0) as (ground, counted, _):
        client = Client(ground)
        until(lambda: client.listen() or bool(counted), "the end of the flight")
    at_s = np.array([at_s for at_s, _, _ in client.blocks])
    longest = int(np.argmax(np.diff(at_s)))
    assert np.diff(at_s)[longest] == pytest.approx(5.0, abs=0.8)
    assert at_s[longest] == pytest.approx(6.0, abs=0.8)
    rows = [1e-6 * m.fields["time_usec"] for m in ground.received["SERVO_OUTPUT_RAW"]]
    assert np.diff(rows).max() <= 0.1


@pytest.mark.slow
def test_sequence_numbers_jump_and_no_frame_is_missing() -> None:
    heard, _ = listened(Jump(5.0), Jump(10.0, by=100.0))
    steps = np.diff([m.sequence for _, m in heard]) % 256
    assert sorted(steps[steps != 1].tolist()) == [10, 101]
    assert np.diff(stamps_s(heard)).max() <= 0.041


@pytest.mark.slow
def test_a_delay_changes_and_stays() -> None:
    heard, _ = listened(Late(8.0, by_s=8.0))
    late_s = [(1e-6 * m.fields["time_usec"], at_s) for at_s, m in heard if m.name == "SERVO_OUTPUT_RAW"]
    early_s = min(at_s - made_s for made_s, at_s in late_s if made_s < 7.9)
    assert min(at_s - made_s for made_s, at_s in late_s if made_s > 8.1) - early_s == pytest.approx(8.0, abs=2.0)


@pytest.mark.slow
def test_a_burst_comes_after_a_pause_and_nothing_is_lost() -> None:
    heard, _ = listened(Pause(8.0, for_s=6.0))
    arrivals_s = np.array([at_s for at_s, _ in heard])
    assert np.diff(arrivals_s).max() > 5.0
    assert np.diff(stamps_s(heard)).max() <= 0.041


@pytest.mark.slow
def test_a_parameter_is_edited_in_flight_told_and_acted_upon() -> None:
    heard, flight = listened(Edit(8.0, "SERVO2_TRIM", 1560.0))
    (told,) = [m.fields for _, m in heard if m.name == "PARAM_VALUE"]
    assert (told["param_id"].rstrip("\0"), told["param_value"]) == ("SERVO2_TRIM", 1560.0)
    rows = [m.fields for _, m in heard if m.name == "SERVO_OUTPUT_RAW"]
    at = np.searchsorted(np.round(1e6 * flight.time_s), [row["time_usec"] for row in rows])
    moved_us = np.array([row["servo2_raw"] for row in rows]) - flight.pulse_us[at, 0]
    edited = flight.time_s[at] - flight.time_s[0] >= 8.0
    assert set(moved_us[~edited].tolist()) == {0}
    assert set(moved_us[edited].tolist()) == {60}


@pytest.mark.slow
def test_the_servo_bus_freezes_for_all_servos_at_once() -> None:
    heard, flight = listened(Freeze(8.0, for_s=0.6))
    frozen: dict[str, set[float]] = defaultdict(set)
    around: dict[str, set[float]] = defaultdict(set)
    for _, m in heard:
        if m.name == "NAMED_VALUE_FLOAT":
            at_s = 1e-3 * m.fields["time_boot_ms"] - flight.time_s[0]
            (frozen if 8.05 < at_s < 8.55 else around)[m.fields["name"]].add(m.fields["value"])
    assert [len(values) for values in frozen.values()] == [1, 1, 1]
    assert min(len(values) for values in around.values()) > 50


@pytest.mark.nightly
@pytest.mark.parametrize(
    "troubles",
    [
        pytest.param((), id="nothing"),
        pytest.param((Late(20.0, by_s=2.2),), id="1.1 s late"),
        pytest.param((Late(20.0, by_s=8.0),), id="4 s late"),
        pytest.param((Late(20.0, by_s=20.0),), id="10 s late"),
        pytest.param((Pause(20.0, for_s=6.0),), id="a pause, then a burst"),
        pytest.param((Silence(12.0, for_s=10.0),), id="a silence"),
        pytest.param((Jump(10.0), Jump(20.0, by=100.0)), id="numbers that jump"),
        pytest.param((Freeze(18.0), Freeze(22.0)), id="a frozen bus"),
        pytest.param((Edit(18.0, "SERVO2_TRIM", 1560.0),), id="an edited parameter"),
        pytest.param((Reboot(12.0, away_s=4.0),), id="a reboot"),
    ],
)
def test_a_monitor_on_loopback_tells_of_the_jam_alone(tmp_path: Path, troubles: tuple[Trouble, ...]) -> None:
    """The flight goes twice as fast as the clock, so delays of the link are halves of those of the flight."""
    (tmp_path / "plane.toml").write_text(plane_file())
    port, flight = free_port(socket.SOCK_STREAM), lively(duration_s=40.0, stuck_s=30.0)
    with (
        monitor(f"tcpin:127.0.0.1:{port}", "-c", str(tmp_path / "plane.toml")) as watching,
        flying(f"tcp:127.0.0.1:{port}", flight, speed=2.0, message_hz=40.0, troubles=troubles) as counted,
    ):
        until(lambda: watching.read() and counted, "the end of the flight", deadline_s=60.0)
        assert watching.end() == 1, watching.err
    told = [e for e in watching.events() if e["surface"] and e["event"] in ("alarm", "no_data")]
    assert [(e["event"], e["surface"]) for e in told] == [("alarm", "elevator")]
    # A new boot counts from its own zero, which is when the vehicle is back.
    zero_s = sum(trouble.start_s + trouble.away_s for trouble in troubles if isinstance(trouble, Reboot))
    assert told[0]["time_s"] == pytest.approx(30.3 - zero_s, abs=0.6)
    assert watching.named("elevator") == ["stuck"]
    assert watching.err == ""
