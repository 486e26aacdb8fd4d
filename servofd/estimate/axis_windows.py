"""Lost share and offset of an axis in trailing windows, and how far they are from healthy ones.

A surface that lost the share lambda of its command's effect and stands beta away leaves in the residual of a form

    e = lambda x1 + beta x2,     x1 = -K F(g u),  x2 = K F(g)

theta = (lambda, beta) is estimated by least squares in every window that ends at a sample, with the covariance
Sigma_n of the noise, by cumulative sums. Healthy flights differ from each other by P_flight, and windows of one flight
by P_window. What a flight was like so far tells what to expect of it, theta0 with covariance P0 (Bayes' rule, prior
N(0, P_flight)), and what counts is

    J = (theta - theta0)^T (Sigma_n + P_window + P0)^-1 (theta - theta0)

one-sided in lambda: more effect than expected is no loss. An aircraft that has failed before its flight must not teach
what to expect, so theta0 is held within what flights differ by.

A servo that became slow leaves e = tau x3 with x3 = dx1/dt, to first order in the lag tau, which is judged beside any
loss and offset. Turbulence differs from flight to flight, so that Sigma_n is scaled by what each window itself leaves
unexplained (an inverse gamma prior, worth some seconds, keeps short windows from being too sure).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servofd.core.types import BoolArray, FloatArray, IntArray

_ENOUGH = 0.9
"""Share of a window that must be usable."""

_ROUNDS = 60

_PRIOR_SAMPLES = 50.0
"""Weight of the calibrated noise beside a window's own, in samples: two seconds of 25 Hz."""

_LEARNED_SIGMAS = 2.5
"""A flight is believed to differ from others by no more: one in twenty does by a chance of its own."""


class _Sums(NamedTuple):
    """Cumulative products over what is usable, and its count; shape (n,) each."""

    loss_loss: FloatArray
    loss_offset: FloatArray
    offset_offset: FloatArray
    loss_e: FloatArray
    offset_e: FloatArray
    samples: FloatArray
    e_e: FloatArray
    lag_loss: FloatArray
    lag_offset: FloatArray
    lag_lag: FloatArray
    lag_e: FloatArray

    def within(self, length: int) -> _Sums:
        """Over the window that ends at each sample."""
        return _Sums(*(total - _before(total, length) for total in self))


@dataclass(frozen=True, eq=False)
class Inputs:
    """Residual of a form, and what a loss, an offset and a lag would leave in it; shape (n,) each.

    Without `lag` no lag can be estimated.
    """

    residual: FloatArray
    loss: FloatArray
    offset: FloatArray
    usable: BoolArray
    lag: FloatArray = field(default_factory=lambda: np.zeros(0))
    variance: float = 0.0
    """Of the residual in calibration; 0 takes the calibrated noise for every window as it is."""

    def part(self, first: int, last: int) -> Inputs:
        """From a sample to another, without what came before."""
        cut = slice(first, last)
        return Inputs(
            self.residual[cut], self.loss[cut], self.offset[cut], self.usable[cut], self.lag[cut], self.variance
        )

    @cached_property
    def sums(self) -> _Sums:
        """Cumulative products."""
        lag = self.lag if self.lag.size else np.zeros_like(self.loss)
        e, x1, x2, x3 = (np.where(self.usable, x, 0.0) for x in (self.residual, self.loss, self.offset, lag))
        products = (
            *(x1 * x1, x1 * x2, x2 * x2, x1 * e, x2 * e),
            *(self.usable.astype(np.float64), e * e, x3 * x1, x3 * x2, x3 * x3, x3 * e),
        )
        return _Sums(*(np.cumsum(product) for product in products))


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


def sliding(inputs: Inputs, length: int, noise_var: float, *, enough: float = _ENOUGH) -> Sliding:
    """Least squares in every window of a length.

    Examples
    --------
    A surface that lost 40 % of its effect and stands 12 us away:

    >>> asked = np.sin(np.arange(50.0))
    >>> inputs = Inputs(-0.4 * asked + 12.0, -asked, np.ones(50), np.ones(50, dtype=bool))
    >>> found = sliding(inputs, 50, 1.0)
    >>> round(float(found.loss[-1]), 6), round(float(found.offset[-1]), 6)
    (0.4, 12.0)
    """
    sums = inputs.sums.within(length)
    a, b, c, d1, d2 = sums[:5]
    determinant = a * c - b * b
    determinant = np.where((sums.samples >= enough * length) & (determinant > 1e-9 * a * c), determinant, np.nan)
    loss, offset = (c * d1 - b * d2) / determinant, (a * d2 - b * d1) / determinant
    noise = noise_var * _noise_ratio(inputs, sums, loss * d1 + offset * d2)
    return Sliding(loss, offset, noise * c / determinant, -noise * b / determinant, noise * a / determinant)


def _noise_ratio(inputs: Inputs, sums: _Sums, explained: FloatArray) -> FloatArray:
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
    """Lag beside any loss and offset, by least squares in every window of a length.

    Examples
    --------
    A command that acts 0.04 s late:

    >>> time_s = np.arange(0.0, 10.0, 0.04)
    >>> late = 0.04 * -np.cos(time_s)
    >>> inputs = Inputs(late, -np.sin(time_s), np.ones(250), np.ones(250, dtype=bool), lag=-np.cos(time_s))
    >>> round(float(lags(inputs, 250, 1.0).lag_s[-1]), 4)
    0.04
    """
    sums = inputs.sums.within(length)
    a, b, c, d1, d2 = sums[:5]
    u, v = sums.lag_loss, sums.lag_offset
    determinant = a * c - b * b
    determinant = np.where((sums.samples >= enough * length) & (determinant > 1e-9 * a * c), determinant, np.nan)
    g1, g2 = (c * u - b * v) / determinant, (a * v - b * u) / determinant
    left = sums.lag_lag - g1 * u - g2 * v
    left = np.where(left > 1e-6 * sums.lag_lag, left, np.nan)
    lag_s = (sums.lag_e - g1 * d1 - g2 * d2) / left
    explained = ((c * d1 - b * d2) * d1 + (a * d2 - b * d1) * d2) / determinant + lag_s**2 * left
    return Lags(lag_s, noise_var * _noise_ratio(inputs, sums, explained) / left)


def _before(total: FloatArray, length: int) -> FloatArray:
    earlier = np.zeros_like(total)
    earlier[length:] = total[:-length]
    return earlier


def expected(inputs: Inputs, length: int, noise_var: float, flight: FloatArray, window: FloatArray) -> Sliding:
    """What to expect of the window that ends at each sample, from the flight before that window.

    The past counts as one window's worth of knowledge however long it is, because windows of one flight differ.

    theta0 and P0, by P_flight and P_window (2, 2).
    """
    a, b, c, d1, d2 = (_before(total, length) / noise_var for total in inputs.sums[:5])
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
    the command cannot be told from that of another axis. Shape (n,); `known` is theta0 and P0, `window` P_window.
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


def spread_between(flights: Sequence[Sliding], start: FloatArray) -> FloatArray:
    """Covariance of lambda and beta between healthy flights, or windows, beyond the noise of each.

    Maximum likelihood by expectation and maximization (Dempster, Laird and Rubin 1977), theta around zero; each
    flight has the same weight, however long it is.

    From the windows of each healthy flight, or that flight as one, with a model that has not seen its day.
    """
    between = start
    seen = [found for found in flights if found.loss.size]
    if not seen:
        return np.zeros((2, 2))
    theta = np.hstack([(found.loss, found.offset) for found in seen])
    loss_var, cross, offset_var = np.hstack([(found.loss_var, found.cross, found.offset_var) for found in seen])
    weights = np.concatenate([np.full(found.loss.size, 1.0 / (found.loss.size * len(seen))) for found in seen])
    for _ in range(_ROUNDS):
        first, both, second = loss_var + between[0, 0], cross + between[0, 1], offset_var + between[1, 1]
        adjugate = np.array([[second, -both], [-both, first]])
        gain = np.einsum("ij,jkn->ikn", between, adjugate) / (first * second - both**2)
        mean = np.einsum("ijn,jn->in", gain, theta)
        renewed = between + (mean * weights) @ mean.T - (gain @ weights) @ between
        settled = np.allclose(renewed, between, rtol=1e-3)
        between = (renewed + renewed.T) / 2.0
        if settled:
            break
    return between
