"""The model of an axis: which motion answers a command, what else moves it, and how far a flight is from it.

Each form is linear in its unknowns, so that a lost share and an offset of the command enter linearly as well. With the
command u [us], the airspeed ratio v = V / V0 and a low-pass filter F that is the same for everything::

    forward   F y = K F(g u) + K beta F(g) + sum c_i F z_i        y a rate, an acceleration, a specific force
    inverse   F u = -beta + sum c_i F z_i                         the command that the motion shows

g is the dependence of the surface's effect on dynamic pressure: v for a rate in balance, v^2 for an acceleration.
Forces are proportional to v^2, damping to v (Etkin and Reid, Dynamics of Flight, 3rd ed., sec. 4.9).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from servofd.core.types import BoolArray, FloatArray
from servofd.core.windows import Sums

if TYPE_CHECKING:
    from servofd.aircraft.axes import AxisModel, Regime
    from servofd.axes.motion import Motion


DELAYS_S = (0.0, 0.04, 0.08, 0.12, 0.16, 0.2, 0.25, 0.3, 0.4)
"""Delays between command and motion that are tried [s]."""
_DAMPING = 0.8
"""Damping of the filter of an axis."""


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

    `answer` (shape (n,)): the motion of a forward form; zero of an inverse one. `command` (shape (n,)): f(g u) [us].
    `offset` (shape (n,)): f(g). `others` (shape (k, n)): what else moves the aircraft.
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
    unit: str
    """Of what it compares."""
    answer: Callable[[Filtered], tuple[FloatArray | None, FloatArray]]
    """Filtered answer, None of an inverse form, and g."""
    others: Callable[[Filtered], list[FloatArray]]
    """What else moves the aircraft, filtered."""

    @property
    def inverse(self) -> bool:
        """Whether it shows the command by the motion."""
        return self.unit == "us"

    def regression(self, filtered: Filtered) -> Regression:
        """Columns of one flight."""
        answer, weight = self.answer(filtered)
        asked = filtered.throttle if self.command == "throttle" else filtered.commands_us[self.command]
        return Regression(
            np.zeros_like(asked) if answer is None else answer,
            filtered.low(weight * asked),
            filtered.low(weight),
            np.array(self.others(filtered)),
        )


FORMS: Mapping[str, Form] = {
    form.name: form
    for form in (
        Form(
            "roll_rate", "roll", "roll", "deg/s", lambda s: (s.low(s.p), s.v),
            lambda s: [s.low(s.r), s.low(s.ay / s.v), s.low(s.bank), s.slope(s.p / s.v)],
        ),
        Form(
            "roll_acceleration", "roll", "roll", "deg/s2", lambda s: (s.slope(s.p), s.v**2),
            lambda s: [s.low(s.v * s.p), s.low(s.v * s.r), s.low(s.ay), s.low(s.bank)],
        ),
        Form(
            "pitch_inverse", "pitch", "pitch", "us", lambda s: (None, np.ones_like(s.v)),
            lambda s: [
                s.low(s.az / s.v**2), s.low(s.q / s.v), s.low(s.throttle / s.v**2), s.slope(s.q / s.v**2),
                s.low(s.r * s.bank / s.v**2), s.slope(s.az / s.v**2),
            ],
        ),
        Form(
            "pitch_acceleration", "pitch", "pitch", "deg/s2", lambda s: (s.slope(s.q), s.v**2),
            lambda s: [s.low(s.az), s.low(s.v * s.q), s.low(s.throttle), s.low(s.r * s.bank), s.slope(s.az / s.v)],
        ),
        Form(
            "side_force", "side", "yaw", "m/s2", lambda s: (s.low(s.ay), s.v**2),
            lambda s: [s.low(s.v * s.p), s.low(s.v * s.r), s.low(s.bank), s.low(s.throttle)],
        ),
        Form(
            "yaw_rate", "side", "yaw", "deg/s", lambda s: (s.low(s.r), s.v),
            lambda s: [s.low(s.bank / s.v), s.low(s.p), s.low(s.ay / s.v), s.low(s.throttle), s.slope(s.r / s.v)],
        ),
        Form(
            "yaw_acceleration", "side", "yaw", "deg/s2", lambda s: (s.slope(s.r), s.v**2),
            lambda s: [s.low(s.v * s.r), s.low(s.v * s.p), s.low(s.ay), s.low(s.bank), s.low(s.throttle)],
        ),
        Form(
            "specific_thrust", "thrust", "throttle", "m/s2", lambda s: (s.low(s.ax), np.ones_like(s.v)),
            lambda s: [s.low(s.v), s.low(s.v**2), s.low(s.az**2 / s.v**2)],
        ),
    )
}  # fmt: skip
"""By name; calibration takes for each axis the one under which a lost axis stands out most."""


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
    rate_hz: float = 1.0

    def part(self, first: int, last: int) -> Inputs:
        """From a sample to another, without what came before."""
        names = ("residual", "loss", "offset", "usable", "lag")
        return replace(self, **{name: getattr(self, name)[first:last] for name in names})

    def less(self, loss: float, offset: float, lag_s: float = 0.0) -> Inputs:
        """What is left beyond a loss, an offset [us] and a lag."""
        left = self.residual - loss * self.loss - offset * self.offset
        return replace(self, residual=left - lag_s * self.lag if lag_s else left)

    @property
    def usable_s(self) -> float:
        """How much of it counts [s]."""
        return float(self.usable.sum()) / self.rate_hz

    @cached_property
    def sums(self) -> Sums:
        """Cumulative products of lag, loss, offset and residual."""
        lag = self.lag if self.lag.size else np.zeros_like(self.loss)
        return Sums.of(np.array([lag, self.loss, self.offset, self.residual]), self.usable)


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
    return Inputs(residual, loss, axis.gain * columns.offset, usable, lag, axis.residual_var, rate_hz)


def whitened(inputs: Inputs, coefficients: tuple[float, ...]) -> Inputs:
    """Take what the past predicts of the residual out of everything."""
    if not coefficients:
        return inputs
    from scipy import signal

    taps = np.concatenate(([1.0], -np.asarray(coefficients)))
    channels = (inputs.residual, inputs.loss, inputs.offset, inputs.lag)
    residual, loss, offset, lag = (signal.lfilter(taps, [1.0], x) for x in channels)
    return replace(inputs, residual=residual, loss=loss, offset=offset, lag=lag)


def settled(axis: AxisModel, motion: Motion, usable: BoolArray) -> BoolArray:
    """What is usable, and not soon after a gap."""
    settling = max(1, round(_SETTLING / axis.corner_hz * motion.rate_hz))
    place = np.arange(usable.size)
    last_gap = np.maximum.accumulate(np.where(motion.present, 0, place))  # and the beginning is one
    long_after: BoolArray = place - last_gap > settling
    return usable & long_after
