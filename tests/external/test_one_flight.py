"""Each flight alone: a real aeroplane, and ArduPlane in wind."""

from __future__ import annotations

import pytest

import logparsers
from servofd.axes.read import motion_of
from servofd.flight.change import judge_motion_alone
from tests.external.test_bench_tables import DATA

pytestmark = pytest.mark.skipif(
    not (DATA / "alfa").is_dir(), reason="no flights: set SERVOFD_EXTERNAL_DATA to the folder that holds alfa and logs"
)

WITHIN_S = {
    "alfa/2018-09-11-17-27-13_2_both_ailerons_failure.csv": (65.7, "roll", 5.5),
    "alfa/2018-09-11-17-55-30_1_right_aileron_failure.csv": (111.9, "roll", 15.0),
    "alfa/2018-09-11-15-06-34_3_rudder_left_failure.csv": (60.0, "pitch", 15.0),
    "logs/wind/d_f1.bin.gz": (120.1, "roll", 6.0),
    "logs/wind/d_f2.bin.gz": (95.1, "roll", 6.0),
}


@pytest.mark.parametrize("name", WITHIN_S)
def test_a_surface_that_fails_is_seen_against_its_own_past(name: str) -> None:
    onset_s, axis, within_s = WITHIN_S[name]
    found = judge_motion_alone(motion_of(logparsers.read(DATA / name)))[axis]
    assert found.alarm_s is not None
    assert onset_s < found.alarm_s < onset_s + within_s
    assert found.since_s == pytest.approx(onset_s, abs=3.0)


@pytest.mark.parametrize("name", ["d_ok1", "d_ok2", "d_ok3", "d_ok4", "d_eng"])
def test_healthy_surfaces_in_wind_are_no_reason_to_look(name: str) -> None:
    axes = judge_motion_alone(motion_of(logparsers.read(DATA / "logs" / "wind" / f"{name}.bin.gz")))
    assert [axis.axis for axis in axes.values() if axis.status == "look"] == []
