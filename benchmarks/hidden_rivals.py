"""Can an excitation tell hidden effects from their look-alikes at all? Asked of the generator, before any model is."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import minimize_scalar

from hidden_physics import CONVERTER_DEG, Effects, HiddenRecord, hidden

if TYPE_CHECKING:
    from collections.abc import Callable

    from servofd.core.types import FloatArray

__all__ = ["RIVALS", "Doubt", "leftover_sigmas"]

RIVALS: dict[str, tuple[str, ...]] = {
    "pwm_frame": ("delay", "sensor_lag"),
    "sensor_lag": ("delay", "slow_dynamics"),
    "slow_dynamics": ("sensor_lag", "delay"),
    "rate_limit": ("slow_dynamics", "voltage_rate"),
    "voltage_rate": ("rate_limit", "slow_dynamics"),
    "deadband": ("friction", "backlash"),
    "friction": ("deadband", "backlash"),
    "backlash": ("friction", "deadband"),
    "gain": ("airload", "gravity_load"),
    "airload": ("gain", "gravity_load"),
    "gravity_load": ("gain", "airload"),
    "load_friction": ("slow_dynamics", "friction"),
    "current_limit": ("slow_dynamics", "rate_limit"),
    "clock_offset": ("slow_dynamics",),
}
"""What each effect looks like. A delay and positions stamped too late are one and the same, and not listed."""
_RANGES: dict[str, tuple[str, float, float]] = {
    "delay": ("delay_s", 0.0, 0.1),
    "sensor_lag": ("time_constant_s", 1e-4, 0.15),
    "slow_dynamics": ("bandwidth_scale", 0.3, 2.0),
    "rate_limit": ("rate_limit_deg_s", 10.0, 370.0),
    "voltage_rate": ("deg_s_per_v", 2.0, 60.0),
    "deadband": ("width_deg", 0.0, 6.0),
    "friction": ("friction_deg", 0.0, 4.0),
    "backlash": ("width_deg", 0.0, 6.0),
    "gain": ("gain", 0.4, 1.2),
    "airload": ("deg_per_deg_pa", -4e-4, 4e-3),
    "gravity_load": ("droop_deg", -5.0, 50.0),
}

_GRID = 13

Doubt = tuple[str, float]
"""The best look-alike, and how far it stays away from the truth [standard deviations of the noise, in all]."""


def leftover_sigmas(record: HiddenRecord, seed: int, effects: Effects, excitation: str, noise_deg: float) -> Doubt:
    """Fit every look-alike of each hidden effect to the clean position, and tell how far the best stays away.

    Of several effects, the others stay as they are: a look-alike has one parameter to fit with.

    Parameters
    ----------
    record : HiddenRecord
        Log with the effect, without scatter, jitter or loss.
    seed, effects, excitation, noise_deg
        As it was made.

    Returns
    -------
    tuple of str and float
        Look-alike, and the root of the sum of the squared differences over the noise; infinite if there is none.
    """
    floor_deg = float(np.hypot(noise_deg, CONVERTER_DEG / np.sqrt(12.0)))
    best = ("", np.inf)
    pairs = [(name, rival) for name in effects for rival in RIVALS.get(name, ()) if rival not in effects]
    for name, rival in pairs:
        key, low, high = _RANGES[rival]
        others = {other: values for other, values in effects.items() if other != name}

        def away_deg(value: float, rival: str = rival, key: str = key, others: Effects = others) -> float:
            other = hidden(seed, {**others, rival: {key: value}}, excitation, noise_deg, record.time_s.size / 100.0)
            return _distance(record.clean_deg, other.clean_deg)

        least = _least(away_deg, low, high)
        best = min(best, (rival, least / floor_deg), key=lambda doubt: doubt[1])
    return best


def _least(function: Callable[[float], float], low: float, high: float) -> float:
    """Smallest value between two bounds: where a grid, finer towards the lower one, is lowest, and then near there."""
    grid = low + (high - low) * np.linspace(0.0, 1.0, _GRID) ** 2
    k = int(np.argmin([function(value) for value in grid]))
    near = (grid[max(k - 1, 0)], grid[min(k + 1, _GRID - 1)])
    return float(minimize_scalar(function, bounds=near, method="bounded", options={"maxiter": 25, "xatol": 1e-7}).fun)


def _distance(one: FloatArray, other: FloatArray) -> float:
    return float(np.sqrt(np.sum((one - other) ** 2)))
