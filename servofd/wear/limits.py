"""Limits of one surface, from the aircraft file and the tolerances in it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from servofd.aircraft import Aircraft

_TOLERANCES = 3.0
_DELAYS = 5.0
"""A frame of a 50 Hz autopilot is 20 ms, seven times the usual tolerance of 3 ms."""
_TELLING = 0.5
"""A servo that changed by less than half of what a healthy one may differ by has not changed."""
_TELLING_WIDTH_DEG = 0.1
AXIS_LIMITS = {"effect": 0.75, "offset_us": 60.0}
"""Of an axis: a quarter of its effect is gone, or an eighth of the usual travel goes into its trim."""


def limits_of(aircraft: Aircraft, surface: str) -> dict[str, float]:
    """Limit of each quantity of `servofd.wear.records.QUANTITIES` that has one.

    Examples
    --------
    >>> from servofd.aircraft import plain_aircraft
    >>> limits = limits_of(plain_aircraft(["rudder"]), "rudder")
    >>> limits["dead_band_deg"], round(limits["delay_s"], 4), round(limits["bandwidth_hz"], 2)
    (2.0, 0.019, 3.17)
    """
    entry, servo = aircraft.surfaces[surface], aircraft.servo(surface)
    tolerance, given = entry.tolerances, entry.limits.model_dump(exclude_none=True)
    derived = {
        "bias_deg": entry.threshold_deg,
        "delay_s": servo.transport_delay_s + _DELAYS * tolerance.delay_s,
        "bandwidth_hz": servo.transfer.bandwidth_rad_s / (2.0 * np.pi) * (1.0 - _TOLERANCES * tolerance.bandwidth),
        "noise_deg": _TOLERANCES * tolerance.noise_deg,
        "residual_p95_deg": entry.threshold_deg,
    }
    if servo.rate_limit_deg_s is not None:
        derived["rate_limit_deg_s"] = servo.rate_limit_deg_s * (1.0 - _TOLERANCES * tolerance.rate)
    return {name: float(value) for name, value in (derived | given).items() if value > 0.0 or name == "margin"}


def telling_steps(aircraft: Aircraft, surface: str) -> dict[str, float]:
    """Smallest sudden change that is reported, of each quantity."""
    entry, servo = aircraft.surfaces[surface], aircraft.servo(surface)
    tolerance = entry.tolerances
    rate_deg_s = servo.rate_limit_deg_s or np.inf
    return {
        "dead_band_deg": _TELLING_WIDTH_DEG,
        "bias_deg": _TELLING * tolerance.bias_deg,
        "delay_s": _TELLING * tolerance.delay_s,
        "bandwidth_hz": _TELLING * tolerance.bandwidth * servo.transfer.bandwidth_rad_s / (2.0 * np.pi),
        "rate_limit_deg_s": _TELLING * tolerance.rate * rate_deg_s,
        "noise_deg": _TELLING * tolerance.noise_deg,
    }
