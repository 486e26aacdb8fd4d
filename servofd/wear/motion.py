"""Simulated against measured motion, for many servos in a row."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from servofd.detection.bank.window import noise_deg
from servofd.detection.residual import ResidualGenerator
from servofd.detection.simulator import Simulator

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from servofd.calibrating.flights import Flight
    from servofd.types import BoolArray, FloatArray
    from servofd.wear.servo import FlownServo

__all__ = ["Motion", "line", "memory", "noise_of"]

_POLE_RAD_S = 30.0
"""Of a filter that only serves to find gaps and starts: gaps beyond 0.17 s, blanking of 0.27 s."""
_FORGOTTEN_S = 1.0
"""After a start the servo was somewhere nobody knows; the slowest ones of the library forget it by then."""
_FORGOTTEN_SHARE = 0.1
"""Of a short test, which begins at rest."""
_REWEIGHTINGS = 8
_MEMORY_S = 1.0
_NEVER = 0.999
"""Share of the speeds among which the largest is looked for: single samples are left out."""


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Flights of one surface, ready to be compared with a simulation."""

    simulators: tuple[Simulator, ...]
    used: tuple[BoolArray, ...]
    """Rows of each flight with a position that a simulation can be held against."""

    @classmethod
    def of(cls, flights: Sequence[Flight], servo: FlownServo) -> Motion:
        """Find the rows; they do not depend on the numbers of the servo."""
        generator = ResidualGenerator(servo.model, _POLE_RAD_S)
        simulators = tuple(Simulator.of(generator, flight.segment) for flight in flights)
        return cls(simulators, tuple(_usable(each) for each in simulators))

    @property
    def measured_deg(self) -> FloatArray:
        """Position in all used rows [deg], shape (n,)."""
        return np.concatenate([each.segment.measured_deg[rows] for each, rows in self._pairs()])

    def with_commands(self, changed: Callable[[FloatArray], FloatArray]) -> Motion:
        """The same flights with commands [deg] that a function has changed."""
        return replace(self, simulators=tuple(r.with_commands(changed(r.segment.command_deg)) for r in self.simulators))

    def simulated_deg(self, servo: FlownServo) -> FloatArray:
        """Deflection of a servo in all used rows [deg], shape (n,)."""
        model = servo.model
        return np.concatenate([each.simulated_deg(model)[rows] for each, rows in self._pairs()])

    def split(self, values: FloatArray) -> list[FloatArray]:
        """What belongs to each flight of an array of shape (n,)."""
        return np.split(values, np.cumsum([np.count_nonzero(rows) for rows in self.used])[:-1])

    def top_speed_deg_s(self, servo: FlownServo) -> float:
        """Largest speed that a servo without its rate limit would have [deg/s], single samples left out."""
        parts = self.split(self.simulated_deg(replace(servo, rate_limit_deg_s=None)))
        speeds = [
            np.abs(np.diff(part) / np.diff(each.segment.measured_s[rows]))
            for part, (each, rows) in zip(parts, self._pairs(), strict=True)
        ]
        every = np.concatenate(speeds)
        return float(np.quantile(every, _NEVER)) if every.size else 0.0

    @property
    def period_s(self) -> float:
        """Median sample time of the first flight [s]."""
        return self.simulators[0].segment.period_s

    def memory(self, error_deg: FloatArray) -> float:
        """Long-run variance of an error over its variance, at least 1."""
        return memory(self.split(error_deg), max(1, round(_MEMORY_S / self.period_s)))

    def _pairs(self) -> Iterable[tuple[Simulator, BoolArray]]:
        """Each flight with its rows."""
        return zip(self.simulators, self.used, strict=True)


def _usable(simulator: Simulator) -> BoolArray:
    from servofd.detection.starts import RESTART_ALL

    time_s, starts = simulator.segment.measured_s, simulator.starts
    begins = np.flatnonzero(starts.restart == RESTART_ALL)
    if begins.size == 0:
        return np.zeros(time_s.size, dtype=bool)
    last = np.searchsorted(begins, np.arange(time_s.size), side="right") - 1
    since_s = time_s - time_s[begins[np.maximum(last, 0)]]
    forgotten_s = min(_FORGOTTEN_S, _FORGOTTEN_SHARE * simulator.segment.duration_s)
    usable: BoolArray = starts.settled & (last >= 0) & (since_s >= forgotten_s)
    return usable


def line(x: FloatArray, y: FloatArray) -> tuple[float, float, float]:
    """Slope and offset of y over x by small absolute deviations, and the median size of what is left.

    Examples
    --------
    >>> x = np.arange(100.0)
    >>> slope, offset, left = line(x, np.where(x < 90, 2.0 * x + 1.0, 0.0))
    >>> round(slope, 1)
    2.0
    """
    weight = np.full(x.size, 1.0)
    slope, offset = 1.0, 0.0
    for _ in range(_REWEIGHTINGS):
        total = weight.sum()
        centre_x, centre_y = float(weight @ x) / total, float(weight @ y) / total
        weighted = weight * (x - centre_x)
        slope = float(weighted @ (y - centre_y)) / max(float(weighted @ (x - centre_x)), 1e-12)
        offset = centre_y - slope * centre_x
        deviation = np.abs(y - slope * x - offset)
        weight = 1.0 / (deviation + 1e-6 + 0.1 * float(deviation.mean()))
    return slope, offset, float(np.median(np.abs(y - slope * x - offset)))


def memory(errors: Sequence[FloatArray], lags: int) -> float:
    """Long-run variance over variance (Bartlett's window), at least 1: how many neighbours tell as much as one.

    Examples
    --------
    >>> white = np.random.default_rng(0).standard_normal(20_000)
    >>> round(memory([white], 20), 1), round(memory([np.repeat(white, 3)], 50))
    (1.0, 3)
    """
    total = sum(float(e @ e) for e in errors)
    if total == 0.0:
        return 1.0
    products = np.sum([_products(e, lags) for e in errors], axis=0) / total
    return max(1.0, 1.0 + 2.0 * float((1.0 - np.arange(1, lags + 1) / (lags + 1)) @ products))


def _products(error: FloatArray, lags: int) -> FloatArray:
    """Sums of products with itself a number of samples later, shape (lags,), by way of the spectrum."""
    from scipy.fft import irfft, next_fast_len, rfft

    size = next_fast_len(error.size + lags, real=True)
    products: FloatArray = irfft(np.abs(rfft(error, size)) ** 2, size)[1 : lags + 1]
    return products


def noise_of(measured_deg: FloatArray, error_deg: FloatArray) -> float:
    """Standard deviation of the measurement noise [deg], that of rounding included."""
    steps = np.diff(np.unique(measured_deg))
    step_deg = float(np.median(steps)) if steps.size > 1 else 0.0
    return float(max(noise_deg(error_deg), step_deg / np.sqrt(12.0)))


__all__ = ["descended", "deviations", "mean_loss", "ordinary_deg"]

_ORDINARY = 3.0
"""Errors beyond so many typical ones count by their size: a glitch bends nothing."""
_MAD_TO_SIGMA = 1.4826
_TOLERANCE = 1e-6
"""Relative change of numbers and cost at which a descent ends."""


def ordinary_deg(median_deg: float) -> float:
    """Size from which an error is out of the ordinary [deg], from the median size of the errors [deg].

    Examples
    --------
    >>> round(ordinary_deg(0.1), 3)
    0.445
    """
    return _ORDINARY * _MAD_TO_SIGMA * median_deg


def mean_loss(error_deg: FloatArray, scale_deg: float) -> float:
    r"""Mean of :math:`\sqrt{1 + (e / s)^2} - 1`: half the square of small errors, the size of large ones.

    Examples
    --------
    >>> round(mean_loss(np.array([0.0, 3.0]), 1.0), 3)
    1.081
    """
    return float(np.mean(np.sqrt(1.0 + (error_deg / scale_deg) ** 2) - 1.0))


def descended(
    error: Callable[[FloatArray], FloatArray],
    slopes: Callable[[FloatArray], FloatArray],
    begin: FloatArray,
    scale_deg: float,
    *,
    delay_at: int | None,
    evaluations: int,
) -> FloatArray:
    """Numbers at the foot of the slope on which a descent begins.

    Parameters
    ----------
    error : callable
        From numbers of shape (k,) to errors [deg], shape (n,).
    slopes : callable
        From the same to their derivatives, shape (n, k).
    begin : FloatArray
        First numbers, shape (k,).
    scale_deg : float
        Size from which an error is out of the ordinary [deg].
    delay_at : int, optional
        Which of the numbers is a delay: it cannot be negative.
    evaluations : int
        Of the errors, at most.

    Examples
    --------
    >>> x, y = np.arange(10.0), 2.0 * np.arange(10.0) + 1.0
    >>> y[4] = 500.0
    >>> rows = np.column_stack([x, np.ones(10)])
    >>> found = descended(lambda p: rows @ p - y, lambda _: rows, np.zeros(2), 1e-2, delay_at=None, evaluations=50)
    >>> np.round(found, 1).tolist()
    [2.0, 1.0]
    """
    from scipy.optimize import least_squares

    lower = np.full(begin.size, -np.inf)
    if delay_at is not None:
        lower[delay_at] = -1e-9  # a start at zero must lie within
    found: FloatArray = least_squares(
        error,
        begin,
        jac=slopes,
        bounds=(lower, np.inf),
        x_scale="jac",
        loss="soft_l1",
        f_scale=scale_deg,
        max_nfev=evaluations,
        xtol=_TOLERANCE,
        ftol=_TOLERANCE,
    ).x
    return found


def deviations(jacobian: FloatArray, error_deg: FloatArray, memory: float) -> FloatArray:
    """Standard deviations of fitted numbers (inverse of the Fisher information), larger by the memory of the errors.

    Parameters
    ----------
    jacobian : FloatArray
        Derivatives of the errors, shape (n, k).
    error_deg : FloatArray
        Errors [deg], shape (n,).
    memory : float
        How many neighbouring errors tell as much as one.

    Examples
    --------
    The mean of 10 000 errors of 1 deg is known to 0.01 deg:

    >>> error_deg = np.random.default_rng(0).standard_normal(10_000)
    >>> deviations(np.ones((10_000, 1)), error_deg, 1.0).round(3).tolist()
    [0.01]
    """
    sigma_deg = _MAD_TO_SIGMA * float(np.median(np.abs(error_deg)))
    variance = max(sigma_deg**2, float(np.mean(np.clip(error_deg, -_ORDINARY * sigma_deg, _ORDINARY * sigma_deg) ** 2)))
    scale = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-12)
    _, sizes, right = np.linalg.svd(jacobian / scale, full_matrices=False)
    inverse = (right.T / np.maximum(sizes, 1e-9) ** 2) @ right
    deviation: FloatArray = np.sqrt(np.maximum(np.diag(inverse), 0.0) * variance * memory) / scale
    return deviation
