"""A threshold within the noise: thousands of alarms, of which the largest are named."""

from __future__ import annotations

import re

import numpy as np
import pytest

from servofd.aircraft.schema import plain_aircraft
from servofd.aircraft.series import Series
from servofd.core.tolerance import Tolerance
from servofd.detection.audit import audit_segment
from servofd.detection.judge import _largest
from servofd.detection.threshold import Episode, constant_threshold, find_episodes, interval_threshold
from servofd.detection.verdict import SurfaceAudit
from servofd.servo.faults import Bias, HardOver, Stuck, failing_deflection
from tests.detection.tolerated import MODEL
from tests.detection.windows import GENERATOR, command, flown, judged, residuals_of

TIME_S = np.arange(6000) / 50.0


def audited(level_deg: float, *, stuck: bool = False) -> SurfaceAudit:
    fault = Stuck(60.0, end_s=80.0) if stuck else None
    segment = Series("x", TIME_S, command(2, TIME_S), TIME_S, flown(2, fault, TIME_S))
    surface = plain_aircraft(["x"], "hs225bb-eq31").surfaces["x"].model_copy(update={"threshold_deg": level_deg})
    return audit_segment(
        segment, plain_aircraft(["x"], "hs225bb-eq31").model_copy(update={"surfaces": {"x": surface}}), duration_s=120.0
    )


@pytest.mark.slow
@pytest.mark.parametrize("level_deg", [0.01, 1e-9])
def test_fifty_are_named_and_the_others_counted(level_deg: float) -> None:
    found = audited(level_deg)
    assert 0 < len(found.faults) + len(found.suspicions) <= 50
    (count,) = re.findall(r"(\d+) smaller alarms not named", found.reason)
    assert int(count) > 1000
    assert f"the threshold of {level_deg:.2g} deg lies within the residual's noise of 0.0" in found.reason


@pytest.mark.slow
def test_a_jam_among_them_is_found() -> None:
    found = audited(0.01, stuck=True)
    stuck = [fault for fault in found.faults if fault.kind == "stuck"]
    assert stuck
    assert all(60.0 <= fault.alarm_s <= 80.5 for fault in stuck)


@pytest.mark.slow
def test_a_small_fault_that_goes_on_after_many_large_ones_has_its_name() -> None:
    time_s = np.arange(24_000) / 50.0
    faults = [HardOver(float(t), 20.0, end_s=t + 0.5) for t in range(10, 430, 7)]
    command_deg = 8.0 * np.sin(2.0 * np.pi * 0.5 * time_s)
    moved_deg = failing_deflection(MODEL, (*faults, Bias(450.0, bias_deg=2.5)), time_s, command_deg, time_s)
    measured_deg = moved_deg + 0.1 * np.random.default_rng(1).standard_normal(time_s.size)
    found = judged(time_s, command_deg, measured_deg)
    assert found.unnamed > 0
    assert (found.faults[-1].kind, found.faults[-1].end_s) == ("bias", None)
    assert found.faults[-1].start_s == pytest.approx(450.0, abs=0.5)


def test_a_threshold_above_the_noise_is_not_blamed() -> None:
    found = audited(1.5, stuck=True)
    assert [fault.kind for fault in found.faults] == ["stuck"]
    assert "not named" not in found.reason


def test_the_largest_are_those_furthest_above_their_threshold_and_the_last_in_order_of_time() -> None:
    segment = Series("x", TIME_S, command(2, TIME_S), TIME_S, flown(2, None, TIME_S))
    residuals = residuals_of(TIME_S, segment.command_deg, segment.measured_deg)
    varying = interval_threshold(GENERATOR, segment, residuals, Tolerance(), 6.0)
    threshold = constant_threshold(varying, 0.01)
    episodes = find_episodes(residuals, threshold)
    chosen = _largest(episodes, residuals, threshold)
    assert len(chosen) == 50
    assert list(chosen) == sorted(chosen, key=lambda episode: episode.alarm_s)
    size = np.where(residuals.settled, np.abs(residuals.residual_deg), 0.0)

    def peak(episode: Episode) -> float:
        begin, end = np.searchsorted(TIME_S, (episode.alarm_s, (episode.end_s or np.inf) + 1e-9))
        return float(size[begin:end].max())

    assert chosen[-1] == episodes[-1]
    smallest = min(map(peak, chosen[:-1]))
    assert max(map(peak, set(episodes) - set(chosen))) <= smallest
