"""The model of an axis at work: its residual over a flight, and how far that is from healthy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from servofd.axes.forms import FORMS, Filtered, Regression
from servofd.estimate.axis_windows import Inputs, Sliding, distance, expected, lags, sliding, smallest

if TYPE_CHECKING:
    from servofd.aircraft.axes import AxisModel, Regime
    from servofd.axes.motion import Motion
    from servofd.core.types import BoolArray, FloatArray

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
