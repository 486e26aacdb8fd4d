"""When things are told: a name within two seconds of its alarm or never, none after its clear, clears at once."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from logparsers.codec import Codec
from servofd.aircraft.schema import Aircraft, load_aircraft
from servofd.live.session import Session
from servofd.servo.faults import Bias, DeadBand, Floating, HardOver, LossOfEffectiveness, Oscillation, Slow, Stuck
from tests.live.vehicles import flown, plane_file, vehicle

if TYPE_CHECKING:
    from pathlib import Path

    from servofd.detection.event import Event
    from servofd.detection.stream import Piece
    from servofd.servo.faults import Failure

EPOCH_S = 1.7e9
BEGUN_S, OVER_S = 9.0, 20.0
NAMED_S = 2.0
CLEARED_S = 2.0
FAULTS: tuple[Failure, ...] = (
    Stuck(BEGUN_S, end_s=OVER_S),
    HardOver(BEGUN_S, end_s=OVER_S),
    Bias(BEGUN_S, bias_deg=4.0, end_s=OVER_S),
    Slow(BEGUN_S, end_s=OVER_S),
    Floating(BEGUN_S, end_s=OVER_S),
    Oscillation(BEGUN_S, amplitude_deg=4.0, end_s=OVER_S),
    DeadBand(BEGUN_S, width_deg=8.0, end_s=OVER_S),
    LossOfEffectiveness(BEGUN_S, end_s=OVER_S),
)


@pytest.fixture(scope="module")
def aircraft(tmp_path_factory: pytest.TempPathFactory) -> Aircraft:
    path: Path = tmp_path_factory.mktemp("plane") / "plane.toml"
    path.write_text(plane_file(["elevator"]))
    return load_aircraft(path)


def told(
    aircraft: Aircraft,
    *faults: Failure,
    loud_s: list[float] | None = None,
    read: list[tuple[float, float]] | None = None,
) -> tuple[list[Event], list[tuple[float, str]]]:
    """Events of a flight in which the elevator fails for a while, and the texts that were sent, each with its time.

    `loud_s` gets the times at which the residual was over its threshold [s], `read` what was measured, and when.
    """
    plane = vehicle(flown(command="lively", duration_s=30.0, faults={"elevator": faults}), message_hz=40.0)
    codec, session, texts = Codec(1, 1), Session(Codec(0, 191), {0: aircraft}), []
    events: list[Event] = []

    def listen(surface: str, piece: Piece, _: object) -> None:
        loud = np.abs(piece.residuals.residual_deg) >= piece.threshold.level_deg
        if surface == "elevator" and loud_s is not None:
            loud_s.extend(piece.residuals.time_s[loud].tolist())
        if surface == "elevator" and read is not None:
            read.extend(zip(piece.residuals.time_s.tolist(), piece.residuals.measured_deg.tolist(), strict=True))

    session.listener = listen
    for index in range(plane.time_us.size):
        now_s = 1e-6 * int(plane.time_us[index])

        def alert(_: int, name: str, fields: dict[str, object], at_s: float = now_s) -> None:
            if name == "STATUSTEXT":
                texts.append((at_s, str(fields["text"])))

        session.alert = alert
        for message in plane.turn(index):
            events += session.take(EPOCH_S + now_s, codec.encode(*message))
        if index % 2 == 0:
            events += session.step(EPOCH_S + now_s)
    return events + session.finish(EPOCH_S + now_s), texts


@dataclass(frozen=True)
class Flown:
    """The same flight twice: the fault ends, and it goes on."""

    fault: Failure
    events: list[Event]
    texts: list[tuple[float, str]]
    standing: list[Event]
    loud_s: list[float]


@pytest.fixture(
    scope="module",
    params=[
        pytest.param(fault, id=fault.kind, marks=() if fault.kind == "slow" else pytest.mark.nightly)
        for fault in FAULTS
    ],
)
def twice(request: pytest.FixtureRequest, aircraft: Aircraft) -> Flown:
    loud_s: list[float] = []
    standing, _ = told(aircraft, replace(request.param, end_s=math.inf), loud_s=loud_s)
    return Flown(request.param, *told(aircraft, request.param), standing, loud_s)


def alarms_of(events: list[Event]) -> list[tuple[Event, Event | None, list[Event]]]:
    """Each alarm of the elevator with its clear, if there was one, and the names that came after the alarm."""
    found: list[tuple[Event, Event | None, list[Event]]] = []
    for event in (e for e in events if e.surface == "elevator"):
        if event.event == "alarm":
            found.append((event, None, []))
        elif event.event == "clear":
            found[-1] = (found[-1][0], event, found[-1][2])
        elif event.event == "named":
            assert found[-1][1] is None, "a name after the clear"
            found[-1][2].append(event)
    return found


@pytest.mark.slow
def test_the_name_follows_its_alarm_within_2_s_or_not_at_all(twice: Flown) -> None:
    texts = twice.texts
    ((alarm, _, names),) = alarms_of(twice.events)
    assert [name.kind for name in names] == [twice.fault.kind]
    assert names[0].time_s - alarm.time_s <= NAMED_S
    (first_s, *_), (clear_s, _) = texts[0], texts[-1]
    said = [at_s for at_s, text in texts if not re.match(r"ELEVATOR (ALARM|off by \d|moves as)", text)]
    assert first_s <= said[0] <= first_s + NAMED_S + 0.1
    assert said[-1] <= said[0] + 1.1, "said once more a second later, and not again"
    assert said[-1] < clear_s


@pytest.mark.slow
def test_a_surface_that_was_called_stuck_and_moves_is_called_what_it_is_at_once(aircraft: Aircraft) -> None:
    """In a dead band that is wide beside what is asked of it a servo stands for 6 s."""
    elevator: list[tuple[float, float]] = []
    fault = DeadBand(BEGUN_S, width_deg=8.0, end_s=OVER_S)
    ((_, _, names),) = alarms_of(told(aircraft, fault, read=elevator)[0])
    assert [name.kind for name in names] == ["stuck", "deadband"]
    stuck = names[0].fault
    assert stuck is not None
    stuck_deg = stuck.parameters["position_deg"].value
    moved_s = min(at_s for at_s, deg in elevator if at_s > names[0].time_s and abs(deg - stuck_deg) > 1.5)
    assert names[1].time_s - moved_s <= NAMED_S


@pytest.mark.slow
def test_no_name_comes_after_its_clear_and_clears_follow_recovery_within_2_s(twice: Flown) -> None:
    """Within 2 s of when the fault, had it gone on, would have been over the threshold again."""
    shown_s = min(at_s for at_s in twice.loud_s if at_s >= OVER_S)
    ((_, clear, _),) = alarms_of(twice.events)
    assert clear is not None
    assert OVER_S < clear.time_s <= shown_s + CLEARED_S
    assert twice.texts[-1][0] == pytest.approx(clear.time_s, abs=0.1)
    assert twice.texts[-1][1] == "ELEVATOR moves as commanded again"


@pytest.mark.slow
def test_nothing_is_cleared_while_the_fault_stands(twice: Flown) -> None:
    """For 21 s of a lively command, in which some faulty servos are quiet for seconds."""
    ((_, clear, _),) = alarms_of(twice.standing)
    assert clear is None
