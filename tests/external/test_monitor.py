"""The monitor on a software-in-the-loop flight of ArduPlane in which two servos freeze one after the other."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

import logparsers
import servofd
from logparsers.codec import Codec
from logparsers.replay import replayed
from servofd.aircraft.schema import load_aircraft
from servofd.calibrating.result import calibration_to_toml
from servofd.feedback.draft import draft_to_toml
from servofd.live.session import Session
from tests.external.test_bench_tables import DATA

if TYPE_CHECKING:
    from pathlib import Path

    from servofd.aircraft.schema import Aircraft

LOG = DATA / "logs" / "ardupilot_sitl_feedback.tlog"
HEALTHY_S = ((2.0, 50.0), (58.0, 92.0))


@pytest.fixture(scope="module")
def aircraft(tmp_path_factory: pytest.TempPathFactory) -> Aircraft:
    """Drafted from the log, then calibrated on its healthy part."""
    if not LOG.exists():
        pytest.skip("no flight logs: set SERVOFD_EXTERNAL_DATA to the directory that holds bench/ and logs/")
    folder: Path = tmp_path_factory.mktemp("sitl")
    draft, calibrated = folder / "plane.toml", folder / "calibrated.toml"
    draft.write_text(draft_to_toml(logparsers.read(LOG)))
    calibrated.write_text(calibration_to_toml(servofd.calibrate([LOG], draft, spans=HEALTHY_S)))
    return load_aircraft(calibrated)


@pytest.mark.nightly
def test_both_frozen_servos_are_alarmed_and_named_and_the_others_stay_quiet(aircraft: Aircraft) -> None:
    session, events, stepped_s, now_s = Session(Codec(0, 191), {0: aircraft}), [], 0.0, 0.0
    for now_s, frame in replayed(LOG):
        events += session.take(now_s, frame)
        if now_s - stepped_s >= 0.02:
            stepped_s = now_s
            events += session.step(now_s)
    events += session.finish(now_s)
    found = {m.name: [(fault.kind, fault.alarm_s) for fault in m.faults] for _, m in session.watched}
    (result,) = servofd.audit(LOG, aircraft)
    assert found == {s.surface: [(fault.kind, fault.alarm_s) for fault in s.faults] for s in result.surfaces}
    (aileron,), (elevator,) = found["servo_1"], found["servo_10"]
    assert (aileron[0], elevator[0]) == ("stuck", "stuck")
    assert 93.5 <= aileron[1] <= 94.5  # frozen from 93.5 s on
    assert 133.4 <= elevator[1] <= 136.0  # from 133.4 s on, told by readings at 25 Hz
    assert {name for name, faults in found.items() if faults} == {"servo_1", "servo_10"}
    named = [(event.surface, event.kind) for event in events if event.event == "named" and event.kind != "healthy"]
    assert {("servo_1", "stuck"), ("servo_10", "stuck")} <= set(named)
