"""Loss, offset and lag of an axis in every window that ends at a sample, and how far they are from what is expected."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from servofd.axes.model import Sums, before

if TYPE_CHECKING:
    from servofd.aircraft.axes import AxisModel
    from servofd.axes.model import Inputs
    from servofd.core.types import BoolArray, FloatArray, IntArray

_ENOUGH = 0.9
"""Share of a window that must be usable."""

_LEARNED_SIGMAS = 2.5
"""A flight is believed to differ from others by no more: one in twenty does by a chance of its own."""
_PERSISTENCE_S = 0.5
"""As long the statistic stays above its threshold before it is an alarm: a gust's edge does not."""
_PRIOR_SAMPLES = 50.0
"""Weight of the calibrated noise beside a window's own, in samples: two seconds of 25 Hz."""


class Sliding(NamedTuple):
    """lambda and beta [us] with their covariance, shape (n,) each: estimates, or what the flight so far lets expect.

    Of estimates one for the window that ends at each sample; NaN where too little of a window is usable.
    """

    loss: FloatArray
    offset: FloatArray
    loss_var: FloatArray
    cross: FloatArray
    offset_var: FloatArray

    def at(self, chosen: IntArray | BoolArray) -> Sliding:
        """Some of the windows."""
        return Sliding(*(each[chosen] for each in self))

    @property
    def known(self) -> BoolArray:
        """Windows with an estimate."""
        return np.isfinite(self.loss)


def nothing_known(flight: FloatArray) -> Sliding:
    """Before anything was seen of a flight: what flights differ by."""
    zero = np.zeros(1)
    return Sliding(zero, zero, flight[:1, 0], flight[:1, 1], flight[1:, 1])


class Solved(NamedTuple):
    """Least squares of a residual e on x1 and x2, shape (n,) each; NaN where the two cannot be told apart.

    Both coefficients, the inverse of the products of x1 and x2, and what they explain of e^2.
    """

    loss: FloatArray
    offset: FloatArray
    loss_loss: FloatArray
    loss_offset: FloatArray
    offset_offset: FloatArray
    explained: FloatArray

    @classmethod
    def of(cls, a: FloatArray, b: FloatArray, c: FloatArray, d1: FloatArray, d2: FloatArray) -> Solved:
        """From x1 x1, x1 x2, x2 x2, x1 e and x2 e."""
        determinant = a * c - b * b
        determinant = np.where(determinant > 1e-9 * a * c, determinant, np.nan)
        loss, offset = (c * d1 - b * d2) / determinant, (a * d2 - b * d1) / determinant
        inverse = (c / determinant, -b / determinant, a / determinant)
        return cls(loss, offset, *inverse, loss * d1 + offset * d2)


def sliding(inputs: Inputs, length: int, noise_var: float, *, enough: float = _ENOUGH) -> Sliding:
    """Least squares in every window of a length."""
    sums = inputs.sums.within(length)
    solved = Solved.of(*sums[:5])
    noise = noise_var * _noise_ratio(inputs, sums, solved.explained)
    noise = np.where(sums.samples >= enough * length, noise, np.nan)
    known = 0.0 * noise
    variances = (noise * solved.loss_loss, noise * solved.loss_offset, noise * solved.offset_offset)
    return Sliding(solved.loss + known, solved.offset + known, *variances)


def _noise_ratio(inputs: Inputs, sums: Sums, explained: FloatArray) -> FloatArray:
    """Variance in each window over the calibrated one."""
    if inputs.variance <= 0.0:
        return np.ones_like(explained)
    left = np.maximum(sums.e_e - np.nan_to_num(explained), 0.0) / inputs.variance
    ratio: FloatArray = (_PRIOR_SAMPLES + left) / (_PRIOR_SAMPLES + sums.samples)
    return ratio


class Lags(NamedTuple):
    """tau [s] in the window that ends at each sample, and its variance [s2]; NaN where there is none; shape (n,)."""

    lag_s: FloatArray
    var_s2: FloatArray


def lags(inputs: Inputs, length: int, noise_var: float, *, enough: float = _ENOUGH) -> Lags:
    """Lag beside any loss and offset, by least squares in every window of a length."""
    sums = inputs.sums.within(length)
    a, b, c, d1, d2 = sums[:5]
    of_lag = Solved.of(a, b, c, sums.lag_loss, sums.lag_offset)
    left = sums.lag_lag - of_lag.explained
    left = np.where((sums.samples >= enough * length) & (left > 1e-6 * sums.lag_lag), left, np.nan)
    lag_s = (sums.lag_e - of_lag.loss * d1 - of_lag.offset * d2) / left
    explained = Solved.of(a, b, c, d1, d2).explained + lag_s**2 * left
    return Lags(lag_s, noise_var * _noise_ratio(inputs, sums, explained) / left)


def expected(inputs: Inputs, length: int, noise_var: float, flight: FloatArray, window: FloatArray) -> Sliding:
    """What to expect of the window that ends at each sample, from the flight before that window.

    The past counts as one window's worth of knowledge however long it is, because windows of one flight differ.

    theta0 and P0, by P_flight and P_window (2, 2).
    """
    a, b, c, d1, d2 = (before(total, length) / noise_var for total in inputs.sums[:5])
    w11, w12, w22 = window[0, 0], window[0, 1], window[1, 1]
    # (I + A W)^-1 for A = [[a, b], [b, c]]
    n11, n12 = 1.0 + a * w11 + b * w12, a * w12 + b * w22
    n21, n22 = b * w11 + c * w12, 1.0 + b * w12 + c * w22
    determinant = n11 * n22 - n12 * n21
    i11, i12, i21, i22 = n22 / determinant, -n12 / determinant, -n21 / determinant, n11 / determinant
    prior = np.linalg.inv(flight)
    m11 = prior[0, 0] + i11 * a + i12 * b
    m12 = prior[0, 1] + i11 * b + i12 * c
    m22 = prior[1, 1] + i21 * b + i22 * c
    determinant = m11 * m22 - m12**2
    c11, c12, c22 = m22 / determinant, -m12 / determinant, m11 / determinant
    h1, h2 = i11 * d1 + i12 * d2, i21 * d1 + i22 * d2
    loss, offset = c11 * h1 + c12 * h2, c12 * h1 + c22 * h2
    away = np.sqrt(prior[0, 0] * loss**2 + 2.0 * prior[0, 1] * loss * offset + prior[1, 1] * offset**2)
    held = np.minimum(1.0, _LEARNED_SIGMAS / np.maximum(away, 1e-12))
    return Sliding(loss * held, offset * held, c11, c12, c22)


def distance(found: Sliding, known: Sliding, window: FloatArray, *, loss_matters: bool = True) -> FloatArray:
    """J of each window; 0 where there is none.

    In a healthy aircraft chi-square with two degrees of freedom; with one where the loss does not matter, because
    the command cannot be separated from that of another axis. Shape (n,); `known` is theta0 and P0, `window` P_window.
    """
    offset, offset_var, given, given_var = _away(found, known, window)
    statistic = offset**2 / offset_var
    if loss_matters:
        statistic = statistic + np.maximum(given, 0.0) ** 2 / given_var
    distances: FloatArray = np.nan_to_num(statistic)
    return distances


def _away(found: Sliding, known: Sliding, window: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Offset beyond what is expected, its variance, the loss beyond what that offset implies, and its variance."""
    offset = found.offset - known.offset
    offset_var = found.offset_var + window[1, 1] + known.offset_var
    cross = found.cross + window[0, 1] + known.cross
    given = found.loss - known.loss - cross / offset_var * offset
    return offset, offset_var, given, found.loss_var + window[0, 0] + known.loss_var - cross**2 / offset_var


def smallest(found: Sliding, known: Sliding, window: FloatArray, level: float) -> tuple[FloatArray, FloatArray]:
    """Smallest further loss, and smallest offset to either side [us], that lift J of each window to a level.

    Shape (n,) each; inf where there is no estimate.

    Examples
    --------
    >>> quiet = Sliding(*(np.array([x]) for x in (0.0, 0.0, 0.01, 0.0, 25.0)))
    >>> loss, offset_us = smallest(quiet, nothing_known(np.zeros((2, 2))), np.zeros((2, 2)), 4.0)
    >>> round(float(loss[0]), 6), float(offset_us[0])
    (0.2, 10.0)
    """
    offset, offset_var, given, given_var = _away(found, known, window)
    missing = np.maximum(level - offset**2 / offset_var, 0.0)
    loss = np.where(missing == 0.0, 0.0, np.maximum(np.sqrt(missing * given_var) - given, 0.0))
    offset_us = np.sqrt(level * offset_var) + np.abs(offset)
    return np.nan_to_num(loss, nan=np.inf), np.nan_to_num(offset_us, nan=np.inf)


@dataclass(frozen=True)
class Windows:
    """Estimates in the windows of each length that an axis is judged by, beside what to expect of each."""

    axis: AxisModel
    inputs: Inputs
    rate_hz: float
    found: tuple[Sliding, ...]
    expected: tuple[Sliding, ...]

    @classmethod
    def of(cls, axis: AxisModel, inputs: Inputs, rate_hz: float) -> Windows:
        """Of one flight."""
        sizes = [(spread.samples(rate_hz), spread) for spread in axis.spreads]
        found = (sliding(inputs, length, axis.noise_var) for length, _ in sizes)
        known = (
            expected(inputs, length, axis.noise_var, axis.of_flights(spread), spread.covariance)
            for length, spread in sizes
        )
        return cls(axis, inputs, rate_hz, tuple(found), tuple(known))

    def distances(self) -> list[FloatArray]:
        """J in the windows of each length."""
        each = zip(self.found, self.expected, self.axis.spreads, strict=True)
        return [distance(one, known, s.covariance, loss_matters=self.axis.own_command) for one, known, s in each]

    def shares(self) -> FloatArray:
        """J in the windows of each length, as multiples of the calibration's largest; shape (k, n)."""
        return np.array([j / spread.scale for j, spread in zip(self.distances(), self.axis.spreads, strict=True)])

    def smallest(self) -> FloatArray:
        """Smallest loss and offset [us] that the windows of each length would have shown; shape (k, 2, n)."""
        each = zip(self.found, self.expected, self.axis.spreads, strict=True)
        return np.array([smallest(one, known, s.covariance, self.axis.suspect * s.scale) for one, known, s in each])

    def statistic(self) -> FloatArray:
        """Largest J of all windows at each sample, as a multiple of the calibration's largest, after persistence."""
        from scipy import ndimage

        shares = [*self.shares()]
        if self.axis.own_command:
            slow = zip(slowness(self.axis, self.inputs, self.rate_hz), self.axis.spreads, strict=True)
            shares += [j / spread.lag_scale for j, spread in slow if spread.lag_scale is not None]
        length = max(1, round(_PERSISTENCE_S * self.rate_hz))
        origin = (length - 1) // 2
        kept: FloatArray = ndimage.minimum_filter1d(
            np.max(shares, axis=0), length, origin=origin, mode="constant", cval=0.0
        )
        return kept


def slowness(axis: AxisModel, inputs: Inputs, rate_hz: float) -> list[FloatArray]:
    """Square of the lag over its healthy deviation in the windows of each length; earlier than expected is not slow.

    What to expect follows from the flight before each window, as that of a loss does.
    """
    past_s, past_var_s2 = lags(inputs, inputs.usable.size, axis.noise_var, enough=0.0)
    share = axis.of_flight / (1.0 - axis.of_flight)
    found = []
    for spread in axis.spreads:
        length = spread.samples(rate_hz)
        lag_s, var_s2 = lags(inputs, length, axis.noise_var)
        flight = spread.lag_var_s2 * share
        before_var_s2 = np.full_like(var_s2, np.inf)
        before_s = np.zeros_like(lag_s)
        before_s[length:] = np.nan_to_num(past_s[:-length])
        before_var_s2[length:] = np.nan_to_num(past_var_s2[:-length], nan=np.inf) + spread.lag_var_s2
        learned = flight / (flight + before_var_s2)
        late_s = lag_s - learned * before_s
        variance = var_s2 + spread.lag_var_s2 + flight * (1.0 - learned)
        found.append(np.nan_to_num(np.maximum(late_s, 0.0) ** 2 / variance))
    return found
