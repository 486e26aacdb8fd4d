"""The script under real Lua with 32-bit numbers: its residuals and alarms are those of an audit."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from servofd.aircraft.schema import Aircraft
from servofd.aircraft.series import Series
from servofd.detection.residual import ResidualGenerator
from servofd.detection.threshold import constant_threshold, interval_threshold
from servofd.onboard.plan import plan_onboard
from servofd.onboard.script import watch_script
from tests.onboard.autopilot import Flight, Flown, fly

if TYPE_CHECKING:
    from pathlib import Path

    from servofd.core.types import IntArray
    from servofd.detection.residual import Residuals
    from servofd.detection.threshold import Threshold

SERVOS: dict[str, dict[str, object]] = {
    "third_order": {
        "numerator": [122300.0],
        "denominator": [1.0, 94.88, 6660.7936, 122237.64],
        "rate_limit_deg_s": 370.0,
    },
    "double_pole": {"bandwidth_hz": 4.0, "damping": 1.0, "rate_limit_deg_s": 80.0},
    "overdamped": {"bandwidth_hz": 2.4, "damping": 4.1},
}


def aircraft(threshold: str = "interval") -> Aircraft:
    """Three servos of different kinds; positions as ArduPilot measures them."""
    surfaces = {
        name: {
            "servo": name,
            "threshold": threshold,
            "filter_pole_rad_s": 30.0,
            "tolerance": {"noise_deg": 0.1},
            "command": {"channel": f"RCOU.C{k}", "unit": "us", "trim_us": 1520.0, "slope_deg_per_us": 0.09, "sign": -1},
            "measured": {"channel": f"CSRV[{k - 1}].Pos", "unit": "deg", "correction": [1.1, 0.3]},
        }
        for k, name in enumerate(SERVOS, 1)
    }
    servos = {
        name: {"title": name, "delay_s": 0.013 + 0.02 * k, "hold": "zoh", "source": "test", **servo}
        for k, (name, servo) in enumerate(SERVOS.items())
    }
    return Aircraft.model_validate({"surfaces": surfaces, "servos": servos})


def made(plane: Aircraft, count: int, seed: int = 1) -> tuple[IntArray, dict[str, Series], Flight]:
    """A healthy flight across the instant at which 32 bits of microseconds are full."""
    rng = np.random.default_rng(seed)
    time_us = 2**32 - 10_000_000 + np.cumsum(rng.integers(19_400, 20_600, count))
    time_s = time_us.astype(np.float64) / 1e6
    segments, pulses, positions = {}, {}, {}
    for k, (name, surface) in enumerate(plane.surfaces.items()):
        steps = 150.0 * np.sign(np.sin(0.8 * time_s + k)) + 200.0 * np.sin((2.0 + k) * time_s)
        pulses[k + 1] = np.round(1500.0 + steps + 20.0 * rng.normal(size=count)).astype(np.int64)
        asked_deg = surface.command.to_deg(pulses[k + 1].astype(float))
        moved_deg = plane.model(name).simulate(time_s, asked_deg, time_s) + 0.1 * rng.normal(size=count)
        assert surface.measured is not None
        positions[k + 1] = surface.measured.from_deg(moved_deg).astype(np.float32).astype(float)
        segments[name] = Series(name, time_s, asked_deg, time_s, surface.measured.to_deg(positions[k + 1]))
    return time_us, segments, Flight(time_us, pulses, positions)


def audited(plane: Aircraft, name: str, segment: Series) -> tuple[Residuals, Threshold]:
    surface = plane.surfaces[name]
    generator = ResidualGenerator.fitting(plane.model(name), segment, surface.filter_pole_rad_s)
    residuals = generator.run(segment)
    level = interval_threshold(generator, segment, residuals, surface.tolerances)
    return residuals, constant_threshold(level, surface.threshold_deg) if surface.threshold == "constant" else level


def furthest_deg(flown: Flown, output: int, residuals: Residuals) -> float:
    """Largest difference of the residuals, for every sample that an audit judges."""
    wanted = np.where(residuals.settled, residuals.residual_deg, np.nan)[np.isfinite(residuals.measured_deg)]
    rows = flown.of(output)
    assert rows.size == wanted.size
    assert np.array_equal(np.isfinite(rows["residual"]), np.isfinite(wanted))
    return float(np.nanmax(np.abs(rows["residual"] - wanted)))


@pytest.mark.slow
@pytest.mark.parametrize("threshold", ["interval", "constant"])
def test_residuals_and_thresholds_are_those_of_an_audit(tmp_path: Path, threshold: str) -> None:
    plane = aircraft(threshold)
    _, segments, flight = made(plane, 2000)
    flown = fly(watch_script(plan_onboard(plane)), flight, tmp_path)
    assert [text for _, text in flown.texts] == ["servofd watches 3 servos"]
    for output, (name, segment) in enumerate(segments.items(), 1):
        residuals, level = audited(plane, name, segment)
        assert furthest_deg(flown, output, residuals) < 2e-3  # it looks for the instants of a limit in pieces of 4 ms
        assert float(np.max(np.abs(flown.of(output)["level"] - level.level_deg))) < 2e-3


@pytest.mark.parametrize(
    "rows", [pytest.param(30_000, marks=pytest.mark.slow), pytest.param(180_000, marks=pytest.mark.nightly)]
)
def test_ten_minutes_and_an_hour_later_they_still_are(rows: int, tmp_path: Path) -> None:
    plane = aircraft()
    plane = plane.model_copy(update={"surfaces": {"third_order": plane.surfaces["third_order"]}})
    _, segments, flight = made(plane, rows)
    flown = fly(watch_script(plan_onboard(plane)), flight, tmp_path)
    assert not flown.said("THIRD_ORDER")
    assert furthest_deg(flown, 1, audited(plane, "third_order", segments["third_order"])[0]) < 1e-3
