"""Simulated aeroplanes in wind: jams are found by the motion alone, by a model of other healthy aeroplanes."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from tests.external.test_bench_tables import DATA

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from logparsers.records import FlightLog
from motion_wind import flights_of, told
from servofd.aircraft.schema import load_aircraft
from servofd.axes.calibrate import calibrate_motion
from servofd.axes.judge import judge_motion
from servofd.detection.verdict import LogAudit

WIND = DATA / "logs" / "wind"

pytestmark = [
    pytest.mark.nightly,
    pytest.mark.skipif(
        not WIND.is_dir(), reason="no flights in wind: set SERVOFD_EXTERNAL_DATA to the folder that holds logs/wind"
    ),
]


def test_jams_are_found_slow_is_named_and_an_engine_is_no_servo() -> None:
    faults, _, _ = told(flights_of(WIND))
    jams = [one for one in faults if one.fault.kind == "stuck"]
    ailerons = [one for one in jams if one.fault.axis == "roll"]
    assert len(jams) == 4
    assert all(one.delay_s is not None and one.delay_s <= 1.0 for one in ailerons)
    for one in jams:
        assert one.event is not None
        assert one.event.lost_share.low < 0.5 < one.event.lost_share.high
        assert one.holds_offset is not False
    slow = next(one for one in faults if one.fault.kind == "slow" and one.fault.axis == "pitch")
    assert slow.event is not None
    assert slow.event.lag_s is not None
    engine = next(one for one in faults if one.fault.kind == "engine_cut")
    assert engine.event is not None
    assert engine.event.lost_share.value > 0.75


def test_healthy_flights_are_cleared_by_four_others_one_of_which_is_another_aircraft() -> None:
    flights = {one.name: one.motion for one in flights_of(WIND)}
    log, aircraft = FlightLog(Path("a.bin"), "dataflash", {}), load_aircraft("simulated")
    healthy = [name for name in flights if name.startswith("d_ok")]
    engine = flights["d_eng"].until(150.0)
    cleared = {}
    for name in healthy:
        model = calibrate_motion([*(flights[other] for other in healthy if other != name), engine])
        audit = LogAudit(log, aircraft, (), axes=judge_motion(model, flights[name]))
        cleared[name] = not audit.not_judged
        if name != "d_ok3":  # its wing is smaller by a third
            assert [text.partition(":")[0] for text in model.left_out] == ["d_ok3.bin.gz"]
    assert sum(cleared.values()) >= 3
    model = calibrate_motion([flights[name] for name in healthy])
    pitch = next(axis for axis in judge_motion(model, flights["d_f3"]) if axis.axis == "pitch")
    assert pitch.status in ("suspect", "fault")
