"""A link that becomes late, and stays so, is one sentence: no alarm, no flood, and nothing is lost."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from logparsers.codec import Codec, Received
from servofd.aircraft.schema import Aircraft, load_aircraft
from servofd.live.clock import Latency, VehicleClock
from servofd.live.session import Session
from tests.live.test_troubles import Field, kinds, lively
from tests.live.vehicles import flown, plane_file, vehicle

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from servofd.detection.event import Event


@pytest.fixture(scope="module")
def aircraft(tmp_path_factory: pytest.TempPathFactory) -> Aircraft:
    path: Path = tmp_path_factory.mktemp("plane") / "plane.toml"
    path.write_text(plane_file())
    return load_aircraft(path)


@pytest.fixture(scope="module")
def elevator(tmp_path_factory: pytest.TempPathFactory) -> Aircraft:
    """The surface that jams: a link is late for all of them."""
    path: Path = tmp_path_factory.mktemp("elevator") / "plane.toml"
    path.write_text(plane_file(["elevator"]))
    return load_aircraft(path)


@pytest.fixture(scope="module")
def frames() -> list[tuple[float, bytes]]:
    """What a vehicle whose elevator jams at 14 s sends, and when, in a flight of 24 s."""
    codec, plane = Codec(1, 1), vehicle(lively(duration_s=24.0, stuck_s=14.0), message_hz=40.0)
    return [
        (1.7e9 + 1e-6 * int(plane.time_us[turn]), codec.encode(*message))
        for turn in range(plane.time_us.size)
        for message in plane.turn(turn)
    ]


def heard(frames: list[tuple[float, bytes]], aircraft: Aircraft) -> tuple[list[Event], list[str]]:
    session, events, stepped_s = Session(Codec(0, 191), {0: aircraft}), [], 0.0
    for now_s, frame in frames:
        events += session.take(now_s, frame)
        if now_s - stepped_s >= 0.1:
            stepped_s = now_s
            events += session.step(now_s)
    return events + session.finish(now_s), session.notes


def later(frames: list[tuple[float, bytes]], delay: Callable[[float], float]) -> list[tuple[float, bytes]]:
    first_s = frames[0][0]
    arrivals_s, newest_s = [], 0.0
    for at_s, _ in frames:
        newest_s = max(newest_s, at_s + delay(at_s - first_s))
        arrivals_s.append(newest_s)
    return [(at_s, frame) for at_s, (_, frame) in zip(arrivals_s, frames, strict=True)]


def told(events: list[Event]) -> list[tuple[str, str, str, float]]:
    return [
        (e.surface, e.event, e.kind, e.time_s)
        for e in events
        if e.surface and e.event in ("alarm", "named", "clear", "no_data")
    ]


@pytest.fixture(scope="module")
def straight(frames: list[tuple[float, bytes]], elevator: Aircraft) -> list[tuple[str, str, str, float]]:
    """What is reported of a link that is never late."""
    return told(heard(frames, elevator)[0])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("delay", "sentences"),
    [
        pytest.param(lambda at_s: 1.1 * (at_s > 9.0), ["link 1 s late"], id="1.1 s", marks=pytest.mark.nightly),
        pytest.param(lambda at_s: 4.0 * (at_s > 9.0), ["link 4 s late"], id="4 s", marks=pytest.mark.nightly),
        pytest.param(lambda at_s: 10.0 * (at_s > 9.0), ["link 10 s late"], id="10 s", marks=pytest.mark.nightly),
        pytest.param(lambda at_s: max(0.0, min(15.0 - at_s, 6.0)) * (at_s > 9.0), [], id="a burst after 6 s"),
        pytest.param(lambda at_s: 1.5 * (at_s % 3.0 < 1.0), [], id="hiccups", marks=pytest.mark.nightly),
    ],
)
def test_the_same_is_told_at_the_same_times(
    elevator: Aircraft,
    frames: list[tuple[float, bytes]],
    straight: list[tuple[str, str, str, float]],
    delay: Callable[[float], float],
    sentences: list[str],
) -> None:
    events, notes = heard(later(frames, delay), elevator)
    assert told(events) == straight
    assert [surface for surface, *_ in told(events)][:1] == ["elevator"]
    assert [note for note in notes if note.startswith("link")][: len(sentences) or None] == sentences


@pytest.mark.slow
@pytest.mark.parametrize("gone", ["NAMED_VALUE_FLOAT", "SERVO_OUTPUT_RAW"])
def test_what_stops_is_told_once_for_each_surface(aircraft: Aircraft, gone: str) -> None:
    """Positions or commands alone, for ever; everything together, for 20 s, is a lost link and no silent surface."""
    field = Field.of({0: aircraft})
    plane = vehicle(flown(duration_s=18.0), message_hz=40.0)
    turn = plane.turn
    plane.turn = lambda index: [m for m in turn(index) if m.name != gone or index < 600]  # type: ignore[method-assign]
    field.fly(plane)
    silent = [surface for surface, _ in kinds(field.events, "no_data")]
    assert sorted(silent) == ["aileron", "elevator", "rudder"]
    assert kinds(field.events, "no_data")[0][1] == pytest.approx(14.0, abs=0.5)
    what = "position" if gone == "NAMED_VALUE_FLOAT" else "command"
    assert field.session.waiting() == f"elevator, aileron, rudder: no {what} since 12.0 s"


def test_the_delay_that_a_slow_clock_only_seems_to_have_is_found_out() -> None:
    """A simulator on a busy machine runs slow; the answers to TIMESYNC tell that nothing waits."""
    deaf, asking, said = Latency(), Latency(), []
    for k in range(600):
        made_s = 0.1 * k * 0.9
        arrival_s = 5000.0 + 0.1 * k
        for latency in (deaf, asking):
            latency.take(arrival_s, made_s)
        if k % 50 == 0:
            asking.answered(asking.ask(arrival_s - 0.05), made_s, arrival_s)
        said.append(asking.news(arrival_s))
    assert deaf.late_s > 5.0
    assert asking.late_s < 0.6
    assert set(said) == {""}


def test_messages_without_a_stamp_belong_to_those_around_them() -> None:
    """Of a stream that is ten seconds later than it was."""
    clock = VehicleClock()
    for k in range(100):
        late_s = 0.0 if k < 50 else 10.0
        clock.time_s(Received("ATTITUDE", 1, 1, {"time_boot_ms": 10_000 + 100 * k}), 500.0 + 0.1 * k + late_s)
        beat = clock.time_s(Received("HEARTBEAT", 1, 1, {}), 500.05 + 0.1 * k + late_s)
        assert beat == pytest.approx(10.05 + 0.1 * k)
        pulse = Received("SERVO_OUTPUT_RAW", 1, 1, {"time_usec": 10_030_000 + 100_000 * k})
        assert clock.time_s(pulse, 500.06 + 0.1 * k + late_s) == pytest.approx(10.03 + 0.1 * k)


def test_a_copy_of_the_stream_that_comes_late_is_no_restart() -> None:
    clock = VehicleClock()
    for k in range(200):
        clock.time_s(Received("ATTITUDE", 1, 1, {"time_boot_ms": 10_000 + 100 * k}), 500.0 + 0.1 * k)
        if k > 100 and k % 10 == 0:
            for old in range(k - 60, k - 50):
                clock.time_s(Received("ATTITUDE", 1, 1, {"time_boot_ms": 10_000 + 100 * old}), 500.0 + 0.1 * k)
    assert clock.restarts == 0
