"""The model of an axis: which motion answers a command, what else moves it, and how far a flight is from it.

Each form is linear in its unknowns, so that a lost share and an offset of the command enter linearly as well. With the
command u [us], the airspeed ratio v = V / V0 and a low-pass filter F that is the same for everything::

    forward   F y = K F(g u) + K beta F(g) + sum c_i F z_i        y a rate, an acceleration, a specific force
    inverse   F u = -beta + sum c_i F z_i                         the command that the motion shows

g is the dependence of the surface's effect on dynamic pressure: v for a rate in balance, v^2 for an acceleration.
Forces are proportional to v^2, damping to v (Etkin and Reid, Dynamics of Flight, 3rd ed., sec. 4.9).

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

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servofd.aircraft.axes import AxisModel, Regime
    from servofd.axes.motion import Motion
    from servofd.core.types import BoolArray, FloatArray, IntArray


_DAMPING = 0.8


class Filtered:
    """Channels of a flight, all through one second-order low-pass filter."""

    def __init__(self, motion: Motion, *, corner_hz: float, reference_m_s: float) -> None:
        from scipy import signal  # takes longer to load than a flight to judge

        self.rate_hz = motion.rate_hz
        self.commands_us = motion.commands_us
        corner = 2.0 * np.pi * corner_hz
        bottom = [1.0, 2.0 * _DAMPING * corner, corner**2]
        self._low = signal.bilinear([corner**2], bottom, self.rate_hz)
        self._slope = signal.bilinear([corner**2, 0.0], bottom, self.rate_hz)
        self.v = np.maximum(motion.airspeed_m_s, 1.0) / reference_m_s
        self.p, self.q, self.r = motion.rates_deg_s
        self.ax, self.ay, self.az = motion.accelerations_m_s2
        self.bank = np.sin(np.radians(motion.roll_deg))
        self.throttle = motion.throttle

    def low(self, values: FloatArray) -> FloatArray:
        """F of a channel, beginning at rest on its first value."""
        return _run(self._low, values)

    def slope(self, values: FloatArray) -> FloatArray:
        """F of the derivative of a channel."""
        return _run(self._slope, values)


def _run(coefficients: tuple[FloatArray, FloatArray], values: FloatArray) -> FloatArray:
    from scipy import signal

    top, bottom = coefficients
    out: FloatArray = signal.lfilter(top, bottom, values, zi=signal.lfilter_zi(top, bottom) * values[0])[0]
    return out


@dataclass(frozen=True, slots=True)
class Regression:
    """A form's columns, all filtered.

    Parameters
    ----------
    answer : ndarray, shape (n,)
        The motion of a forward form; zero of an inverse one.
    command : ndarray, shape (n,)
        F(g u) [us].
    offset : ndarray, shape (n,)
        F(g).
    others : ndarray, shape (k, n)
        What else moves the aircraft.
    """

    answer: FloatArray
    command: FloatArray
    offset: FloatArray
    others: FloatArray

    def delayed(self, delay_s: float, rate_hz: float) -> Regression:
        """With a command that acts later."""
        if delay_s <= 0.0:
            return self
        place = np.arange(self.command.size)
        return replace(self, command=np.interp(place - delay_s * rate_hz, place, self.command))


@dataclass(frozen=True, slots=True)
class Form:
    """One way to model one axis."""

    name: str
    axis: str
    command: str
    """Whose command drives it: ``"roll"``, ``"pitch"``, ``"yaw"`` or ``"throttle"``."""
    inverse: bool
    columns: Callable[[Filtered], tuple[FloatArray | None, FloatArray, list[FloatArray]]]
    """Filtered answer (None if inverse), g, and filtered others."""
    unit: str
    """Of what it compares."""

    def regression(self, filtered: Filtered) -> Regression:
        """Columns of one flight."""
        answer, weight, others = self.columns(filtered)
        asked = filtered.throttle if self.command == "throttle" else filtered.commands_us[self.command]
        return Regression(
            np.zeros_like(asked) if answer is None else answer,
            filtered.low(weight * asked),
            filtered.low(weight),
            np.array(others),
        )


def _roll_rate(s: Filtered) -> tuple[FloatArray, FloatArray, list[FloatArray]]:
    others = [s.low(s.r), s.low(s.ay / s.v), s.low(s.bank), s.slope(s.p / s.v)]
    return s.low(s.p), s.v, others


def _roll_acceleration(s: Filtered) -> tuple[FloatArray, FloatArray, list[FloatArray]]:
    others = [s.low(s.v * s.p), s.low(s.v * s.r), s.low(s.ay), s.low(s.bank)]
    return s.slope(s.p), s.v**2, others


def _pitch_inverse(s: Filtered) -> tuple[None, FloatArray, list[FloatArray]]:
    force = s.az / s.v**2
    turn = s.r * s.bank / s.v**2
    others = [
        s.low(force),
        s.low(s.q / s.v),
        s.low(s.throttle / s.v**2),
        s.slope(s.q / s.v**2),
        s.low(turn),
        s.slope(force),
    ]
    return None, np.ones_like(s.v), others


def _pitch_acceleration(s: Filtered) -> tuple[FloatArray, FloatArray, list[FloatArray]]:
    others = [s.low(s.az), s.low(s.v * s.q), s.low(s.throttle), s.low(s.r * s.bank), s.slope(s.az / s.v)]
    return s.slope(s.q), s.v**2, others


def _side_force(s: Filtered) -> tuple[FloatArray, FloatArray, list[FloatArray]]:
    others = [s.low(s.v * s.p), s.low(s.v * s.r), s.low(s.bank), s.low(s.throttle)]
    return s.low(s.ay), s.v**2, others


def _yaw_rate(s: Filtered) -> tuple[FloatArray, FloatArray, list[FloatArray]]:
    others = [s.low(s.bank / s.v), s.low(s.p), s.low(s.ay / s.v), s.low(s.throttle), s.slope(s.r / s.v)]
    return s.low(s.r), s.v, others


def _yaw_acceleration(s: Filtered) -> tuple[FloatArray, FloatArray, list[FloatArray]]:
    others = [s.low(s.v * s.r), s.low(s.v * s.p), s.low(s.ay), s.low(s.bank), s.low(s.throttle)]
    return s.slope(s.r), s.v**2, others


def _thrust(s: Filtered) -> tuple[FloatArray, FloatArray, list[FloatArray]]:
    others = [s.low(s.v), s.low(s.v**2), s.low(s.az**2 / s.v**2)]
    return s.low(s.ax), np.ones_like(s.v), others


FORMS: Mapping[str, Form] = {
    form.name: form
    for form in (
        Form("roll_rate", "roll", "roll", False, _roll_rate, "deg/s"),
        Form("roll_acceleration", "roll", "roll", False, _roll_acceleration, "deg/s2"),
        Form("pitch_inverse", "pitch", "pitch", True, _pitch_inverse, "us"),
        Form("pitch_acceleration", "pitch", "pitch", False, _pitch_acceleration, "deg/s2"),
        Form("side_force", "side", "yaw", False, _side_force, "m/s2"),
        Form("yaw_rate", "side", "yaw", False, _yaw_rate, "deg/s"),
        Form("yaw_acceleration", "side", "yaw", False, _yaw_acceleration, "deg/s2"),
        Form("specific_thrust", "thrust", "throttle", False, _thrust, "m/s2"),
    )
}
"""By name; calibration takes for each axis the one under which a lost axis stands out most."""


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


_PERSISTENCE_S = 0.5
"""As long the statistic stays above its threshold before it is an alarm: a gust's edge does not."""
_SETTLING = 1.0
"""Periods of the filter's corner after a gap that are not judged."""
_REGIME_HZ = 0.5
"""Airspeed and throttle are smoothed so far before they are compared with what was calibrated."""


@dataclass(frozen=True, slots=True)
class Flown:
    """Smoothed airspeed, throttle, and lift over dynamic pressure; shape (n,) each."""

    speed_m_s: FloatArray
    throttle: FloatArray
    lift_m_s2: FloatArray


def flown_of(motion: Motion, reference_m_s: float) -> Flown:
    """Under which conditions an aircraft flew."""
    from scipy import signal  # takes longer to load than a flight to judge

    smooth = signal.butter(2, min(_REGIME_HZ, 0.4 * motion.rate_hz), fs=motion.rate_hz)

    def low(values: FloatArray) -> FloatArray:
        out: FloatArray = signal.lfilter(*smooth, values, zi=signal.lfilter_zi(*smooth) * values[0])[0]
        return out

    speed = low(motion.airspeed_m_s)
    lift = low(-motion.accelerations_m_s2[2]) / np.maximum(speed / reference_m_s, 0.1) ** 2
    return Flown(speed, low(motion.throttle), lift)


def covered(regime: Regime, flown: Flown) -> dict[str, BoolArray]:
    """Which samples are inside the calibrated regime, for each reason that a sample may be outside."""
    return {
        "airspeed": (flown.speed_m_s >= regime.airspeed_low_m_s) & (flown.speed_m_s <= regime.airspeed_high_m_s),
        "throttle": flown.throttle >= regime.throttle_low,
        "stall": flown.lift_m_s2 <= regime.lift_high_m_s2,
    }


def inputs_of(axis: AxisModel, motion: Motion, usable: BoolArray, reference_m_s: float) -> Inputs:
    """Residual of an axis over one flight, and what a loss and an offset would leave in it."""
    filtered = Filtered(motion, corner_hz=axis.corner_hz, reference_m_s=reference_m_s)
    columns = FORMS[axis.form].regression(filtered).delayed(axis.delay_s, motion.rate_hz)
    return whitened(residual_of(axis, columns, settled(axis, motion, usable), motion.rate_hz), axis.whitening)


def residual_of(axis: AxisModel, columns: Regression, usable: BoolArray, rate_hz: float) -> Inputs:
    """Residual of a form whose columns are there."""
    moved = np.asarray(axis.others) @ columns.others + axis.offset * columns.offset
    if FORMS[axis.form].inverse:
        residual = moved - columns.command
    else:
        residual = columns.answer - axis.gain * columns.command - moved
    loss = -axis.gain * columns.command
    lag = rate_hz * np.gradient(loss)
    return Inputs(residual, loss, axis.gain * columns.offset, usable, lag, axis.residual_var)


def whitened(inputs: Inputs, coefficients: tuple[float, ...]) -> Inputs:
    """Take what the past predicts of the residual out of everything."""
    if not coefficients:
        return inputs
    from scipy import signal

    taps = np.concatenate(([1.0], -np.asarray(coefficients)))
    channels = (inputs.residual, inputs.loss, inputs.offset, inputs.lag)
    residual, loss, offset, lag = (signal.lfilter(taps, [1.0], x) for x in channels)
    return Inputs(residual, loss, offset, inputs.usable, lag, inputs.variance)


def settled(axis: AxisModel, motion: Motion, usable: BoolArray) -> BoolArray:
    """What is usable, and not soon after a gap."""
    settling = max(1, round(_SETTLING / axis.corner_hz * motion.rate_hz))
    broken = ~motion.present
    broken[0] = True
    return usable & ~_soon_after(broken, settling)


def _soon_after(events: BoolArray, samples: int) -> BoolArray:
    last = np.maximum.accumulate(np.where(events, np.arange(events.size), -samples - 1))
    near: BoolArray = np.arange(events.size) - last <= samples
    return near


def windows_of(axis: AxisModel, inputs: Inputs, rate_hz: float) -> list[Sliding]:
    """Estimates in the windows of each length."""
    return [sliding(inputs, spread.samples(rate_hz), axis.noise_var) for spread in axis.spreads]


def distances(axis: AxisModel, inputs: Inputs, windows: list[Sliding], rate_hz: float) -> list[FloatArray]:
    """J in the windows of each length."""
    found = []
    for estimates, spread in zip(windows, axis.spreads, strict=True):
        window = spread.covariance
        known = expected(inputs, spread.samples(rate_hz), axis.noise_var, axis.of_flights(spread), window)
        found.append(distance(estimates, known, window, loss_matters=axis.own_command))
    return found


def smallest_of(axis: AxisModel, inputs: Inputs, windows: list[Sliding], rate_hz: float) -> FloatArray:
    """Smallest loss and offset [us] that the windows of each length would have shown; shape (k, 2, n)."""
    found = []
    for estimates, spread in zip(windows, axis.spreads, strict=True):
        window = spread.covariance
        known = expected(inputs, spread.samples(rate_hz), axis.noise_var, axis.of_flights(spread), window)
        found.append(smallest(estimates, known, window, axis.suspect * spread.scale))
    return np.array(found)


def shares_of(axis: AxisModel, inputs: Inputs, windows: list[Sliding], rate_hz: float) -> FloatArray:
    """J in the windows of each length, as multiples of the calibration's largest; shape (k, n)."""
    found = distances(axis, inputs, windows, rate_hz)
    return np.array([j / spread.scale for j, spread in zip(found, axis.spreads, strict=True)])


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


def statistic(axis: AxisModel, inputs: Inputs, windows: list[Sliding], rate_hz: float) -> FloatArray:
    """Largest J of all windows at each sample, as a multiple of the calibration's largest, after persistence."""
    from scipy import ndimage

    shares = [*shares_of(axis, inputs, windows, rate_hz)]
    if axis.own_command:
        slow = zip(slowness(axis, inputs, rate_hz), axis.spreads, strict=True)
        shares += [j / spread.lag_scale for j, spread in slow if spread.lag_scale is not None]
    largest = np.max(shares, axis=0)
    length = max(1, round(_PERSISTENCE_S * rate_hz))
    kept: FloatArray = ndimage.minimum_filter1d(largest, length, origin=(length - 1) // 2, mode="constant", cval=0.0)
    return kept
