"""Each flight alone: a real aeroplane, and ArduPlane in wind."""

from __future__ import annotations

from pathlib import Path

import pytest

import logparsers
from servofd.axes.read import motion_of
from servofd.flight.change import judge_motion_alone
from tests.axes.ulogs import ALLOCATED, read_as_ulog
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


@pytest.mark.parametrize("name", ["d_ok2", "d_ok3", "d_f1", "d_f2"])
def test_as_px4_logs_them_axes_are_modelled_and_single_ailerons_found(name: str, tmp_path: Path) -> None:
    flight = motion_of(logparsers.read(DATA / "logs" / "wind" / f"{name}.bin.gz"))
    roll = judge_motion_alone(motion_of(read_as_ulog(tmp_path, flight, ALLOCATED)))["roll"]
    fault = WITHIN_S.get(f"logs/wind/{name}.bin.gz")
    if fault is None:
        assert roll.status == "ok"
        assert roll.explained_share is not None
        assert roll.explained_share > 0.9
    else:
        assert roll.alarm_s is not None
        assert fault[0] < roll.alarm_s < fault[0] + 6.0
