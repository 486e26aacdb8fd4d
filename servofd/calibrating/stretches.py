"""Stretches of some seconds with motion, and by how much the servo of each differs from that of all of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from servofd.detection.bank.explanation import Ridge
from servofd.detection.bank.window import Window
from servofd.detection.residual import ResidualGenerator, commands_at_servo

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servofd.calibrating.flights import Flight
    from servofd.detection.residual import Residuals
    from servofd.models.servo_model import ServoModel
    from servofd.tolerance import Tolerance
    from servofd.types import FloatArray

__all__ = ["NUISANCES", "Flown", "Stretch", "flown", "stretches_of", "telling"]

NUISANCES = ("gain", "delay_s", "bandwidth", "bias_deg")

_WIDE = np.array([0.2, 0.02, 0.3, 10.0])
"""Prior standard deviations of `NUISANCES`: wide, they only keep what a stretch does not excite from running away."""
_SHORTEST_S, _LONGEST_S, _WANTED = 1.0, 20.0, 8
_FORGOTTEN_S, _FORGOTTEN_SHARE = 1.0, 0.1
_FEWEST_SAMPLES = 20
_MOTION_NOISES = 10.0
"""Less motion than ten times the noise tells nothing of gain, delay and bandwidth."""
_TELLING = 0.4
_SIGMA_95 = 1.96


class Flown(NamedTuple):
    """A flight, and what the fitted servo makes of it."""

    flight: Flight
    generator: ResidualGenerator
    residuals: Residuals


@dataclass(frozen=True, slots=True, eq=False)
class Stretch:
    """Some seconds of a flight; arrays of shape (4,), in the order of `NUISANCES`."""

    label: str
    from_s: float
    to_s: float
    deviation: FloatArray
    """Of the servo here from the fitted one."""
    doubt: FloatArray
    """Standard deviation of that."""
    motion_deg: float
    """How far the fitted servo moves, from end to end [deg]."""


def flown(flight: Flight, model: ServoModel, pole_rad_s: float | None) -> Flown:
    """Residual of the fitted servo in a flight."""
    generator = ResidualGenerator.fitting(model, flight.segment, pole_rad_s)
    return Flown(flight, generator, generator.run(flight.segment))


def stretches_of(what: Flown, tolerance: Tolerance, noise_deg: float) -> list[Stretch]:
    """Cut a flight into stretches of 1 to 20 s, and fit each; those in which the surface hardly moves are left out.

    Parameters
    ----------
    what : Flown
        Flight and residuals.
    tolerance : Tolerance
        Passed on to the windows of the bank.
    noise_deg : float
        Standard deviation of the position measurement [deg].

    Returns
    -------
    list of Stretch
        In order of time.
    """
    residuals = what.residuals
    judged_s = residuals.time_s[residuals.settled]
    if judged_s.size < _FEWEST_SAMPLES:
        return []
    forgotten_s = min(_FORGOTTEN_S, _FORGOTTEN_SHARE * what.flight.segment.duration_s)
    first_s, last_s = float(judged_s[0]) + forgotten_s, float(judged_s[-1])
    length_s = float(np.clip((last_s - first_s) / _WANTED, _SHORTEST_S, _LONGEST_S))
    count = max(1, int((last_s - first_s) / length_s))
    edges = np.linspace(first_s, last_s, count + 1)
    commands = commands_at_servo(
        what.flight.segment, what.generator.model.plan.delay_s, what.generator.longest_gap_s(what.flight.segment)
    )
    found = []
    for from_s, to_s in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        begin, end = np.searchsorted(residuals.time_s, (from_s, to_s)).tolist()
        span = slice(begin, end)
        if np.count_nonzero(residuals.settled[span]) < _FEWEST_SAMPLES:
            continue
        window = Window.of(what.generator.model, tolerance, noise_deg, residuals, commands, span)
        if window.motion_deg > _MOTION_NOISES * noise_deg:
            found.append(_fitted(what, window))
    return found


def telling(stretches: Sequence[Stretch]) -> list[Stretch]:
    """Stretches that move about as much as the others; what hardly moves differs for other reasons than the servo."""
    most_deg = max((s.motion_deg for s in stretches), default=0.0)
    return [s for s in stretches if s.motion_deg >= _TELLING * most_deg]


def _fitted(what: Flown, window: Window) -> Stretch:
    ridge = Ridge(window.nuisances, _WIDE, window.noise_deg)
    error_deg = window.error_deg
    fit = ridge.fit(error_deg)
    estimates = [ridge.estimate(fit, error_deg, k) for k in range(len(NUISANCES))]
    return Stretch(
        what.flight.label,
        float(window.time_s[0]),
        float(window.time_s[-1]),
        np.array([e.value for e in estimates]),
        np.array([(e.high - e.low) / (2.0 * _SIGMA_95) for e in estimates]),
        window.motion_deg,
    )
