"""The script under real Lua with 32-bit numbers: its residuals are those of an audit."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from servofd.aircraft.schema import Aircraft
from servofd.aircraft.series import Series
from servofd.detection.residual import ResidualGenerator
from servofd.onboard.plan import plan_onboard
from servofd.onboard.script import watch_script
from tests.onboard.autopilot import Flight, Flown, fly

if TYPE_CHECKING:
    from pathlib import Path

    from servofd.core.types import IntArray

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


def furthest_deg(flown: Flown, plane: Aircraft, name: str, segment: Series) -> float:
    """Largest difference of the residuals from an audit's, for every sample that both judge."""
    model = plane.model(name)
    residuals = ResidualGenerator.fitting(model, segment.period_s, plane.surfaces[name].filter_pole_rad_s).run(segment)
    rows = flown.of(1 + list(plane.surfaces).index(name))
    both = residuals.settled[-rows.size :] & np.isfinite(rows["residual"])
    assert both.mean() > 0.95
    return float(np.max(np.abs(rows["residual"] - residuals.error_deg[-rows.size :])[both]))


@pytest.mark.slow
def test_residuals_are_those_of_an_audit(tmp_path: Path) -> None:
    plane = aircraft()
    _, segments, flight = made(plane, 2000)
    flown = fly(watch_script(plan_onboard(plane)), flight, tmp_path)
    assert [text for _, text in flown.texts] == ["servofd watches 3 servos"]
    for name, segment in segments.items():
        limited = plane.model(name).physics.follow_up_deg_s < np.inf
        assert furthest_deg(flown, plane, name, segment) < (0.4 if limited else 2e-3)  # limits act in pieces of 4 ms


@pytest.mark.slow
def test_what_good_servos_leave_has_the_deviation_that_the_script_expects(tmp_path: Path) -> None:
    """Drawn from the tolerances: over the script's deviation their residuals have a mean square of one or less."""
    plane = aircraft()
    plane = plane.model_copy(update={"surfaces": {"overdamped": plane.surfaces["overdamped"]}})
    plan = plan_onboard(plane)
    limit = plan.surfaces[0].settings[2]["limit"]
    tolerance, rng, shares = plane.surfaces["overdamped"].tolerances, np.random.default_rng(4), []
    _, _, flight = made(aircraft(), 1000)
    time_s = flight.time_us.astype(np.float64) / 1e6
    for _ in range(6):
        gain, late_s, slower = rng.uniform(-1.0, 1.0, 3) * (tolerance.gain, tolerance.delay_s, tolerance.bandwidth)
        asked_deg = plane.surfaces["overdamped"].command.to_deg(flight.pulse_us[3].astype(float))
        physics = plane.model("overdamped").physics._replace(gain=1.0 + gain, bandwidth_scale=1.0 + slower)
        servo = plane.model("overdamped").with_physics(physics._replace(delay_s=physics.delay_s + late_s))
        moved_deg = servo.simulate(time_s, asked_deg, time_s) + tolerance.noise_deg * rng.normal(size=time_s.size)
        positions = {3: plane.surfaces["overdamped"].measured.from_deg(moved_deg)}  # type: ignore[union-attr]
        flown = fly(watch_script(plan), Flight(flight.time_us, {3: flight.pulse_us[3]}, positions), tmp_path)
        assert not flown.said("OVERDAMPED")
        shares.append(np.nanmean((limit * flown.log["residual"] / flown.log["level"]) ** 2))
    assert 0.3 < np.mean(shares) < 1.3


@pytest.mark.parametrize(
    "rows", [pytest.param(30_000, marks=pytest.mark.slow), pytest.param(180_000, marks=pytest.mark.nightly)]
)
def test_ten_minutes_and_an_hour_later_they_still_are(rows: int, tmp_path: Path) -> None:
    plane = aircraft()
    plane = plane.model_copy(update={"surfaces": {"third_order": plane.surfaces["third_order"]}})
    _, segments, flight = made(plane, rows)
    flown = fly(watch_script(plan_onboard(plane)), flight, tmp_path)
    assert not flown.said("THIRD_ORDER")
    assert furthest_deg(flown, plane, "third_order", segments["third_order"]) < 0.4
