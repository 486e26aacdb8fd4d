"""Terms too small to change a verdict, against what they are worth by definition."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from servofd.detection.audit import _odds
from servofd.detection.bank.oscillation import _cycle
from servofd.detection.monitor import SurfaceMonitor
from servofd.detection.probability.upcrossing import false_alarms_per_hour
from servofd.models.faults import Oscillation
from servofd.segment import WARM_UP_STEPS
from tests.detection.test_monitor import surface
from tests.detection.windows import window


@pytest.mark.parametrize(("seed", "frequency_hz", "amplitude_deg"), [(0, 0.5, 2.0), (0, 1.0, 1.0), (1, 1.0, 1.0)])
def test_the_frequency_of_a_limit_cycle_minimizes_misfit_and_prior(
    seed: int, frequency_hz: float, amplitude_deg: float
) -> None:
    """Misfit² + sigma² (coefficient / spread)², as least squares with a row for each prior; with another power of
    sigma the minimum would move by 5e-6 Hz or more."""
    seen = window(seed, Oscillation(2.0, amplitude_deg=amplitude_deg, frequency_hz=frequency_hz))
    target_deg = seen.measured_deg - seen.healthy_deg
    prior = np.diag(seen.noise_deg / np.append(seen.spread, [1e3, 1e3]))

    def cost(tried_hz: float) -> float:
        phase = 2.0 * np.pi * tried_hz * seen.time_s
        rows = np.vstack([np.column_stack([seen.nuisances, np.sin(phase), np.cos(phase)]), prior])
        wanted = np.append(target_deg, np.zeros(len(prior)))
        left = wanted - rows @ np.linalg.lstsq(rows, wanted, rcond=None)[0]
        return float(left @ left)

    near_hz = (frequency_hz - 0.01, frequency_hz + 0.01)
    best_hz = minimize_scalar(cost, bounds=near_hz, method="bounded", options={"xatol": 1e-9}).x
    found = _cycle(seen, commanded=True)
    assert found is not None
    assert found.parameters["frequency_hz"].value == pytest.approx(best_hz, abs=5e-7)


@pytest.mark.parametrize("colour", [-0.5, 0.6, 0.95])
def test_the_odds_of_a_log_are_those_of_its_colour_offset_and_healthy_part(colour: float) -> None:
    rng = np.random.default_rng(3)
    values = np.zeros(20_000)
    for k, shock in enumerate(rng.standard_normal(values.size - 1)):
        values[k + 1] = colour * values[k] + shock
    time_s = np.arange(values.size) / 50.0
    healthy_deg = -0.4 + 0.2 * values
    settled = time_s > 1.0
    residual_deg = np.where(settled & (time_s < 300.0), healthy_deg, 50.0)  # else, what must not count
    residuals: Any = SimpleNamespace(settled=settled, time_s=time_s, residual_deg=residual_deg)
    fault: Any = SimpleNamespace(start_s=300.0)
    counted = healthy_deg[settled & (time_s < 300.0)]
    alike = float(np.corrcoef(counted[:-1], counted[1:])[0, 1])
    expected = false_alarms_per_hour(1.5 - abs(counted.mean()), float(np.std(counted)), alike, 0.02)
    found = _odds(residuals, (fault,), 0.02, 1.5)
    assert found == pytest.approx(expected, rel=5e-3)
    assert alike == pytest.approx(colour, abs=0.02)
    assert found != pytest.approx(false_alarms_per_hour(1.5, float(np.std(counted)), alike, 0.02), rel=0.5)


def test_what_comes_too_slowly_for_long_fills_no_memory_and_delays_nothing() -> None:
    """Five minutes at 5 Hz, then 50 Hz: it is watched once the slow ones are no longer most of what a pace needs."""
    monitor, now_s, told = SurfaceMonitor("x", *surface(servo="hs225bb-eq31")), 0.0, []
    for _ in range(1500):
        now_s += 0.2
        at = np.array([now_s])
        told += monitor.feed((at, np.sin(at)), (at, np.sin(at)))
        assert max(map(len, monitor._waiting)) <= 1.5 * WARM_UP_STEPS
    assert [event.event for event in told] == ["no_data"]
    quick = 0
    while not monitor.is_watched:
        quick += 1
        now_s += 0.02
        at = np.array([now_s])
        monitor.feed((at, np.sin(at)), (at, np.sin(at)))
        assert quick <= 2.5 * WARM_UP_STEPS
