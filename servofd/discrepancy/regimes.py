"""Conditions under which model and measurement are compared, and the error under each of them."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from servofd.core.series import rms

if TYPE_CHECKING:
    from servofd.core.types import BoolArray, FloatArray
    from servofd.discrepancy.record import Record

_BINS, _FEWEST_PER_BIN = 14, 12
_SWING_S = 0.5
REST, FAST = 0.3, 0.8
"""Quantiles of the speed below which a servo is taken to rest, and above which it is fast."""
AFTER_REVERSAL_S = 0.3
_CHANGES = 0.05
"""What surrounds the aircraft is a condition only if it changes by this share."""
_BAND = (5.0, 50.0, 95.0)
_STANDS_STILL = 1e-6
"""In the unit of a quantity: less is rounding."""


class Quantity(NamedTuple):
    """Something that an error may depend on."""

    name: str
    unit: str
    values: FloatArray
    """Shape (n,), for all samples of the record."""


class Bins(NamedTuple):
    """Distribution of an error over a quantity; all of shape (k,)."""

    centre: FloatArray
    low_deg: FloatArray
    """5 % quantile."""
    median_deg: FloatArray
    high_deg: FloatArray
    """95 % quantile."""


class RegimeError(NamedTuple):
    """Error under one condition."""

    name: str
    share: float
    """Of the samples that count."""
    before_deg: float
    """Root mean square of the model's error as it was."""
    after_deg: float


def quantities(record: Record, simulated_deg: FloatArray) -> tuple[Quantity, ...]:
    """What an error is drawn over: command rate, deflection, speed, amplitude, time, and the context that was logged.

    Parameters
    ----------
    simulated_deg : ndarray, shape (n,)
        Position of the better model, which knows the motion without the noise of the measurement [deg].

    Examples
    --------
    >>> from servofd.discrepancy.record import record_of, simulate
    >>> from servofd.servo.servo_model import ServoModel
    >>> from servofd.aircraft.segment import Segment
    >>> from servofd.servo.library import servo_named
    >>> t = np.arange(0.0, 10.0, 0.01)
    >>> model = ServoModel.of(servo_named("hs225bb-eq31"))
    >>> record = record_of(Segment("x", t, 5.0 * np.sin(t), t, np.zeros(t.size)), model)
    >>> found = {q.name: q for q in quantities(record, simulate(record, record.plant.neutral))}
    >>> round(float(found["command rate"].values[:300].max()), 1)
    5.0
    """
    time_s = record.time_s
    command = np.interp(time_s, record.commands.effective_s, record.commands.command_deg)
    speed = np.gradient(simulated_deg, time_s)
    found = [
        Quantity("command rate", "deg/s", np.gradient(smooth(command), time_s)),
        Quantity("deflection", "deg", simulated_deg),
        Quantity("speed", "deg/s", speed),
        Quantity("amplitude of the command", "deg", _swing(command, max(1, round(_SWING_S / record.period_s)))),
        Quantity("time", "s", time_s),
    ]
    for name, unit, values in (
        ("dynamic pressure", "Pa", record.pressure_pa),
        ("supply voltage", "V", record.voltage_v),
        ("temperature", "°C", record.temperature_c),
    ):
        if values is not None and np.ptp(values[record.counts]) > _CHANGES * np.abs(values[record.counts]).max():
            found.append(Quantity(name, unit, values))
    return tuple(q for q in found if np.ptp(q.values[record.counts]) > _STANDS_STILL)


def binned(quantity: Quantity, error_deg: FloatArray, counts: BoolArray) -> Bins:
    """Quantiles of an error in bins of a quantity; bins of equal numbers of samples, of time equal lengths.

    Examples
    --------
    >>> x = np.linspace(0.0, 1.0, 1000)
    >>> found = binned(Quantity("x", "deg", x), 2.0 * x, np.ones(1000, dtype=bool))
    >>> bool(np.allclose(found.median_deg, 2.0 * found.centre, atol=0.01))
    True
    """
    values, error = quantity.values[counts], error_deg[counts]
    if quantity.name == "time":
        edges = np.linspace(values.min(), values.max(), 4 * _BINS + 1)
    else:
        edges = np.unique(np.quantile(values, np.linspace(0.0, 1.0, _BINS + 1)))
    index = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, edges.size - 2)
    rows = [
        (float(np.median(values[index == k])), *np.percentile(error[index == k], _BAND))
        for k in range(edges.size - 1)
        if np.count_nonzero(index == k) >= _FEWEST_PER_BIN
    ]
    return Bins(*np.array(rows).reshape(-1, 4).T)


def errors_by_regime(
    record: Record, before_deg: FloatArray, after_deg: FloatArray, simulated_deg: FloatArray
) -> tuple[RegimeError, ...]:
    """Error before and after under conditions that have a name.

    Parameters
    ----------
    before_deg, after_deg : ndarray, shape (n,)
        Error of the model as it was, and of the better one [deg].
    simulated_deg : ndarray, shape (n,)
        Position of the better model [deg].
    """
    speed = np.gradient(simulated_deg, record.time_s)
    size = np.abs(speed)
    rest, fast = np.quantile(size[record.counts], [REST, FAST])
    turned = np.flatnonzero(np.diff(np.sign(np.where(size > rest, speed, 0.0)), prepend=0.0) != 0.0)
    last = np.searchsorted(turned, np.arange(speed.size), side="right") - 1
    since_s = np.full(speed.size, np.inf)
    if turned.size:
        since_s[last >= 0] = (record.time_s - record.time_s[turned[np.maximum(last, 0)]])[last >= 0]
    outer = np.quantile(np.abs(simulated_deg[record.counts]), FAST)
    half_s = float(np.median(record.time_s[record.counts]))
    moving = {
        f"at rest (below {rest:.3g} deg/s)": size <= rest,
        f"fast (above {fast:.3g} deg/s)": size > fast,
        "moving up": (speed > 0.0) & (size > rest),
        "moving down": (speed < 0.0) & (size > rest),
        f"within {AFTER_REVERSAL_S:g} s after it starts, stops or turns": since_s < AFTER_REVERSAL_S,
    }
    regimes = {
        "all": np.ones(speed.size, dtype=bool),
        **(moving if fast > _STANDS_STILL else {}),
        f"far out (beyond ±{outer:.3g} deg)": np.abs(simulated_deg) > outer,
        f"first half (to {half_s:.1f} s)": record.time_s <= half_s,
        f"second half (from {half_s:.1f} s)": record.time_s > half_s,
    }
    total = max(int(record.counts.sum()), 1)
    return tuple(
        RegimeError(name, int(chosen.sum()) / total, rms(before_deg[chosen]), rms(after_deg[chosen]))
        for name, chosen in ((name, inside & record.counts) for name, inside in regimes.items())
        if chosen.any()
    )


def smooth(values: FloatArray) -> FloatArray:
    """Mean of each value and the two on either side."""
    smoothed: FloatArray = np.convolve(np.pad(values, 2, mode="edge"), np.full(5, 0.2), mode="valid")
    return smoothed


def _swing(values: FloatArray, width: int) -> FloatArray:
    """Half of the range of the last `width` values."""
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(values, (width, 0), mode="edge"), width + 1)
    swing: FloatArray = 0.5 * np.ptp(windows, axis=1)
    return swing
