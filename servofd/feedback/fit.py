"""A rough model of a servo from the log it is in: a starting point where nobody has identified it."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from servofd.detection.rehearsal import Rehearsal
from servofd.detection.residual import ResidualGenerator
from servofd.models.effects import Delay, LinearDynamics, RateLimit
from servofd.models.servo_model import ServoModel
from servofd.segment import Segment
from servofd.servos import second_order

if TYPE_CHECKING:
    from collections.abc import Callable

    from servofd.types import BoolArray, FloatArray

__all__ = ["RoughFit", "fit_roughly", "typical_error_deg"]

_MOST_SAMPLES = 4_000
_ORDINARY_SHARE = 0.02
_BANDWIDTHS_HZ = (1.5, 2.3, 3.5, 5.0, 8.0, 12.0, 20.0)
_DAMPINGS = (0.7, 2.0)
_DELAYS_S = (0.0, 0.015, 0.03, 0.05, 0.08, 0.12)
_RATES_DEG_S = (600.0, 400.0, 250.0, 150.0, 100.0, 60.0)
_WORTH_A_LIMIT = 0.95
_MOST_EVALUATIONS = 100
_STARTS = 3
_REWEIGHTINGS = 5
_BANDWIDTH_RANGE_HZ, _DAMPING_RANGE = (0.2, 100.0), (0.2, 10.0)
_FEWEST_ROWS = 50
_SLOWEST_SHARE = 0.1
_POLE_RAD_S = 30.0


@dataclass(frozen=True, slots=True)
class RoughFit:
    """Second-order servo and scale that come closest to the position for most of the time."""

    bandwidth_hz: float = 6.0
    damping: float = 0.8
    delay_s: float = 0.02
    rate_limit_deg_s: float = 1e4
    gain: float = 1.0
    """Deflection per degree of the command as it was converted [deg/deg]."""
    bias_deg: float = 0.0
    error_deg: float = float("inf")
    """Typical simulation error of the moving samples, large ones hardly counted [deg]."""

    @property
    def model(self) -> ServoModel:
        """Healthy model with these numbers."""
        dynamics = LinearDynamics(second_order(2.0 * np.pi * self.bandwidth_hz, self.damping))
        return ServoModel((Delay(self.delay_s), dynamics, RateLimit(self.rate_limit_deg_s)))


_ORDINARY = RoughFit(bandwidth_hz=2.0)
"""A slow servo: when it moves, any other does."""


def fit_roughly(segment: Segment, *, free_scale: bool) -> RoughFit:
    """Fit bandwidth, delay and rate limit, and the scale if it is free, to most of a log.

    The cost is nearly flat for large errors, so that a fault during part of the motion does not bend the model; a
    wide grid, then downhill. It finds a starting point, no more: the order is
    not fitted, and no interval is given.

    Parameters
    ----------
    segment : Segment
        Command, converted with the best guess there is, and position [deg].
    free_scale : bool
        Whether gain and bias between command and position are fitted as well.

    Returns
    -------
    RoughFit
        The best found.

    Examples
    --------
    >>> from servofd.simulation.commands import doublets
    >>> time_s = np.arange(3000) / 100.0
    >>> command_deg = doublets(time_s, np.random.default_rng(0))
    >>> truth = RoughFit(bandwidth_hz=5.0, delay_s=0.03)
    >>> measured_deg = 0.8 * truth.model.simulate(time_s, command_deg, time_s)
    >>> fit = fit_roughly(Segment("x", time_s, command_deg, time_s, measured_deg), free_scale=True)
    >>> abs(fit.bandwidth_hz - 5.0) < 0.3, abs(fit.delay_s - 0.03) < 0.003, round(fit.gain, 1)
    (True, True, 0.8)
    """
    busy = _busiest_part(segment)
    rehearsal = _rehearsal(busy)
    moving = _moving_rows(rehearsal)
    if np.count_nonzero(moving) < _FEWEST_ROWS:
        return RoughFit()

    def judged(fit: RoughFit) -> RoughFit:
        return _judged(fit, rehearsal, moving, free_scale=free_scale)

    coarse = [judged(RoughFit(*shape)) for shape in itertools.product(_BANDWIDTHS_HZ, _DAMPINGS, _DELAYS_S)]
    smooth = min((_refined(start, judged) for start in sorted(coarse, key=_error)[:_STARTS]), key=_error)
    limited = min((judged(replace(smooth, rate_limit_deg_s=rate)) for rate in _RATES_DEG_S), key=_error)
    if limited.error_deg < _WORTH_A_LIMIT * smooth.error_deg:
        return _refined(limited, judged)
    return smooth


def typical_error_deg(fit: RoughFit, segment: Segment) -> float:
    """Median size of the simulation error while the surface should move [deg]; half the motion may be faulty."""
    rehearsal = _rehearsal(_busiest_part(segment))
    error_deg = (rehearsal.starts.measured_deg - rehearsal.simulated_deg(fit.model))[_moving_rows(rehearsal)]
    return float(np.median(np.abs(error_deg))) if error_deg.size else float("inf")


def _refined(start: RoughFit, judged: Callable[[RoughFit], RoughFit]) -> RoughFit:
    """Downhill from a point of the grid, in logarithms of what must stay positive."""
    from scipy.optimize import minimize

    def at(x: FloatArray) -> RoughFit:
        shape = {
            "bandwidth_hz": float(np.clip(np.exp(x[0]), *_BANDWIDTH_RANGE_HZ)),
            "damping": float(np.clip(np.exp(x[1]), *_DAMPING_RANGE)),
            "delay_s": max(float(x[2]), 0.0),
        }
        if start.rate_limit_deg_s < RoughFit().rate_limit_deg_s:
            shape["rate_limit_deg_s"] = float(np.clip(np.exp(x[3]), 10.0, 5000.0))
        return replace(start, **shape)

    begin = np.array([np.log(start.bandwidth_hz), np.log(start.damping), start.delay_s, np.log(start.rate_limit_deg_s)])
    simplex = begin + np.vstack([np.zeros(4), np.diag([0.3, 0.4, 0.01, 0.3])])
    options: Any = {"initial_simplex": simplex, "maxfev": _MOST_EVALUATIONS, "xatol": 1e-3, "fatol": 1e-5}

    def error_deg(x: FloatArray) -> float:
        return judged(at(x)).error_deg

    found: Any = minimize(error_deg, begin, method="Nelder-Mead", options=options)
    return min(start, judged(at(found.x)), key=_error)


def _error(fit: RoughFit) -> float:
    return fit.error_deg


def _busiest_part(segment: Segment) -> Segment:
    """Stretch of the log with most motion of the command, short enough to be simulated a hundred times."""
    size = segment.measured_s.size
    if size <= _MOST_SAMPLES:
        return segment
    asked = np.interp(segment.measured_s, segment.command_s, segment.command_deg)
    travel = np.cumsum(np.abs(np.diff(asked, prepend=asked[0])))
    begin = int(np.argmax(travel[_MOST_SAMPLES:] - travel[:-_MOST_SAMPLES]))
    from_s, to_s = segment.measured_s[begin], segment.measured_s[begin + _MOST_SAMPLES - 1]
    commands = slice(*np.searchsorted(segment.command_s, [from_s, to_s]))
    rows = slice(begin, begin + _MOST_SAMPLES)
    return replace(
        segment,
        command_s=segment.command_s[commands],
        command_deg=segment.command_deg[commands],
        measured_s=segment.measured_s[rows],
        measured_deg=segment.measured_deg[rows],
    )


def _rehearsal(segment: Segment) -> Rehearsal:
    return Rehearsal.of(ResidualGenerator(_ORDINARY.model, _POLE_RAD_S), segment)


def _moving_rows(rehearsal: Rehearsal) -> BoolArray:
    """Rows with a position during which any ordinary servo would be moving."""
    ordinary_deg = rehearsal.simulated_deg(_ORDINARY.model)
    rate_deg_s = np.abs(np.gradient(ordinary_deg, rehearsal.segment.measured_s))
    moving: BoolArray = rehearsal.starts.settled & (rate_deg_s > _SLOWEST_SHARE * np.percentile(rate_deg_s, 99.0))
    return moving


def _judged(fit: RoughFit, rehearsal: Rehearsal, moving: BoolArray, *, free_scale: bool) -> RoughFit:
    """Same fit with its scale, if that is free, and its error."""
    simulated, measured = rehearsal.simulated_deg(fit.model)[moving], rehearsal.starts.measured_deg[moving]
    gain, bias_deg = _line(simulated, measured) if free_scale else (1.0, 0.0)
    error = measured - gain * simulated - bias_deg
    # Cauchy's cost: quadratic for errors of a working servo, nearly flat for those of a jammed one.
    ordinary_deg = max(_ORDINARY_SHARE * float(np.ptp(measured)), 1e-9)
    cost = float(np.expm1(np.mean(np.log1p((error / ordinary_deg) ** 2))))
    error_deg = ordinary_deg * float(np.sqrt(cost)) / max(abs(gain), 1e-6)
    return replace(fit, gain=gain, bias_deg=bias_deg, error_deg=error_deg)


def _line(x: FloatArray, y: FloatArray) -> tuple[float, float]:
    """Straight line with small absolute deviations: reweighted least squares, which outliers do not pull."""
    weight = np.full(x.size, 1.0 / x.size)
    slope, offset = 1.0, 0.0
    for _ in range(_REWEIGHTINGS):
        centre_x, centre_y = float(weight @ x), float(weight @ y)
        weighted = weight * (x - centre_x)
        slope = float(weighted @ (y - centre_y)) / max(float(weighted @ (x - centre_x)), 1e-12)
        offset = centre_y - slope * centre_x
        deviation = np.abs(y - slope * x - offset)
        weight = 1.0 / (deviation + 1e-3 + 0.5 * float(deviation.mean()))
        weight /= weight.sum()
    return slope, offset
