"""When things are told: a name within two seconds of its alarm or never, none after its clear, clears at once."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from logparsers.codec import Codec
from servofd.aircraft.schema import Aircraft, load_aircraft
from servofd.live.session import Session
from servofd.servo.faults import Bias, DeadBand, Floating, HardOver, LossOfEffectiveness, Oscillation, Slow, Stuck
from tests.live.vehicles import flown, plane_file, vehicle

if TYPE_CHECKING:
    from pathlib import Path

    from servofd.detection.events import Event
    from servofd.servo.failing import Fault

EPOCH_S = 1.7e9
BEGUN_S, OVER_S = 14.0, 28.0
NAMED_S = 2.0
CLEARED_S = 2.0
FAULTS: tuple[Fault, ...] = (
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
    path.write_text(plane_file())
    return load_aircraft(path)


def told(aircraft: Aircraft, *faults: Fault) -> tuple[list[Event], list[tuple[float, str]]]:
    """Events of a flight in which the elevator fails for a while, and the texts that were sent, each with its time."""
    plane = vehicle(flown(command="lively", duration_s=40.0, faults={"elevator": faults}), message_hz=40.0)
    codec, session, texts = Codec(1, 1), Session(Codec(0, 191), {0: aircraft}), []
    events: list[Event] = []
    for index in range(plane.time_us.size):
        now_s = 1e-6 * int(plane.time_us[index])

        def alert(_: int, name: str, fields: dict[str, object], at_s: float = now_s) -> None:
            if name == "STATUSTEXT":
                texts.append((at_s, str(fields["text"])))

        session.alert = alert
        for message in plane.turn(index):
            events += session.take(EPOCH_S + now_s, codec.encode(*message))
        events += session.step(EPOCH_S + now_s)
    return events + session.finish(EPOCH_S + now_s), texts


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS, ids=[fault.kind for fault in FAULTS])
def test_names_follow_alarms_within_2_s_and_clears_the_recovery(aircraft: Aircraft, fault: Fault) -> None:
    events, texts = told(aircraft, fault)
    alarm_s: float | None = None
    for event in events:
        if event.surface:
            print(event.event, event.surface, event.kind, event.time_s, event.text)
    print(texts)
