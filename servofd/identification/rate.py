"""Rate limits from steps (thesis 3.2.2): the slope of the straight part, if the step is large enough to have one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from servofd.estimate.statistics import Estimate
from servofd.identification.output_error import ServoCandidate
from servofd.identification.records import Run

if TYPE_CHECKING:
    from servofd.core.types import FloatArray
    from servofd.identification.shape import LinearServo

_FROM, _TO = 0.2, 0.8
"""Part of the travel that is straight. The largest slope of any 40 ms would be noise: 384 instead of 370 deg/s."""
_STEP_SHARE = 0.2
_SETTLED_SHARE = 0.2
_TRAVELLED = 0.5
_FEWEST_SAMPLES = 4
_LINEAR_SHARE = 0.9
"""A step whose slope comes so near that of the servo without a limit shows no limit."""
_DENSE_S = 5e-4


@dataclass(frozen=True, slots=True)
class StepSlope:
    """One step: from where to where, when, and how fast between 20 and 80 % of the way."""

    run: int
    start_s: float
    end_s: float
    travel_deg: float
    slope_deg_s: float
    deviation_deg_s: float
    """Standard deviation of the slope."""


@dataclass(frozen=True, slots=True)
class RateLimits:
    """Rate limits in both directions; None where no step shows one."""

    up: Estimate | None
    down: Estimate | None
    reason: str
    """Why there is none, or what the limits rest on."""


def step_slopes(runs: Sequence[Run]) -> tuple[StepSlope, ...]:
    """Slope of every step that the position has followed to its end.

    Examples
    --------
    >>> from servofd.identification.records import prepared
    >>> from servofd.aircraft.segment import Segment
    >>> t = np.arange(100) / 100.0
    >>> ramp = np.clip(300.0 * (t - 0.1), 0.0, 60.0)
    >>> run = prepared(Segment("x", t, np.where(t < 0.1, 0.0, 60.0), t, ramp))
    >>> round(step_slopes([run])[0].slope_deg_s, 6)
    300.0
    """
    found = []
    for index, run in enumerate(runs):
        for start_s, end_s in _steps(run):
            inside = (run.measured_s >= start_s) & (run.measured_s < end_s)
            slope = _slope(run.measured_s[inside], run.measured_deg[inside])
            if slope is not None:
                found.append(StepSlope(index, start_s, end_s, *slope))
    return tuple(found)


def rate_limits(runs: Sequence[Run], linear: LinearServo) -> RateLimits:
    """Rate limits in both directions from the steps that are large enough.

    Each step is compared with the same step of the servo without a limit, over the same part of the way: one that
    is hardly slower does not show the limit, and is left out.
    """
    slopes = step_slopes(runs)
    if not slopes:
        return RateLimits(None, None, "no step: a command that jumps and holds until the servo has arrived")
    limited = [slope for slope in slopes if abs(slope.slope_deg_s) < _LINEAR_SHARE * _linear_slope(runs, slope, linear)]
    if not limited:
        largest = max(abs(slope.travel_deg) for slope in slopes)
        return RateLimits(
            None,
            None,
            f"steps of up to {largest:.3g} deg move as fast as the linear servo would: too small to reach the rate "
            "limit, use larger ones",
        )
    up, down = (_average([s for s in limited if np.sign(s.slope_deg_s) == sign]) for sign in (1.0, -1.0))
    return RateLimits(up, down, f"slope over 20 to 80 % of the way of {len(limited)} of {len(slopes)} steps")


def _steps(run: Run) -> list[tuple[float, float]]:
    """Start and end of every time during which a command, new by a jump, holds."""
    threshold_deg = _STEP_SHARE * run.span_deg
    changed = np.flatnonzero(np.diff(run.command_deg) != 0.0) + 1
    ends = np.append(run.command_s[changed[1:]], max(run.command_s[-1], run.measured_s[-1]) + 1e-9)
    jumps_deg = run.command_deg[changed] - run.command_deg[changed - 1]
    return [
        (float(run.command_s[k]), float(end_s))
        for k, end_s, jump_deg in zip(changed, ends, jumps_deg, strict=True)
        if abs(jump_deg) > threshold_deg
    ]


def _slope(time_s: FloatArray, position_deg: FloatArray) -> tuple[float, float, float] | None:
    """Travel, slope and its deviation of one step; None if it did not arrive or has too few samples."""
    if time_s.size < 2 * _FEWEST_SAMPLES:
        return None
    begin, settled = position_deg[0], position_deg[-max(2, int(_SETTLED_SHARE * time_s.size)) :]
    travel = float(np.median(settled) - begin)
    if travel == 0.0 or np.ptp(settled) > (1.0 - _TRAVELLED) * abs(travel):
        return None
    way = (position_deg - begin) / travel
    first = int(np.argmax(way > _FROM))
    last = first + int(np.argmax(way[first:] > _TO))
    if last - first < _FEWEST_SAMPLES:
        return None
    t, y = time_s[first:last] - time_s[first:last].mean(), position_deg[first:last]
    slope = float(t @ y / (t @ t))
    error = y - y.mean() - slope * t
    return travel, slope, float(np.sqrt(error @ error / (t.size - 2) / (t @ t)))


def _linear_slope(runs: Sequence[Run], step: StepSlope, linear: LinearServo) -> float:
    """Slope of the same step without a rate limit [deg/s]."""
    run = runs[step.run]
    at_s = np.arange(step.start_s, step.end_s, _DENSE_S)
    dense = Run(run.servo, run.command_s, run.command_deg, at_s, at_s)
    slope = _slope(at_s, ServoCandidate(linear).simulate(dense))
    return abs(slope[1]) if slope is not None else float("inf")


def _average(slopes: Sequence[StepSlope]) -> Estimate | None:
    if not slopes:
        return None
    rates = np.array([abs(s.slope_deg_s) for s in slopes])
    weights = 1.0 / np.maximum([s.deviation_deg_s for s in slopes], 1e-4 * rates) ** 2
    value = float(weights @ rates / weights.sum())
    # The scatter of the steps counts where it is larger than each slope's own deviation.
    scatter = float(np.std(rates, ddof=1) / np.sqrt(rates.size)) if rates.size > 1 else 0.0
    deviation = max(float(1.0 / np.sqrt(weights.sum())), scatter)
    return Estimate.of(value, deviation)
