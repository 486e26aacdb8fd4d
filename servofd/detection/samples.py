"""Sample by sample: where servo and filter have to start anew, and the filter Qy as a weighted sum of lags."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from servofd.core.types import BoolArray, ComplexArray, FloatArray
from servofd.servo.kernel import SAME_STEP_S, compiled, fixed, inner

if TYPE_CHECKING:
    from servofd.aircraft.segment import Segment

RESTART_NONE, RESTART_FILTER, RESTART_ALL = 0, 1, 2


def new_starts_memory() -> FloatArray:
    """Whether servo and filter have started, the last position used [s], the last start [s], and the next command."""
    return np.array([0.0, 0.0, -np.inf, -np.inf, 0.0])


class Starts(NamedTuple):
    """All arrays of shape (n,), one entry per measurement time."""

    measured_deg: FloatArray
    """NaN where there was no position, or no recent command to judge it by."""
    restart: NDArray[np.int8]
    """What has to start anew at this sample: nothing, the filter, or model and filter."""
    settled: BoolArray
    """True where a position is there and the last start lies far enough back."""


def find_starts(segment: Segment, longest_gap_s: float, blanking_s: float, fresh_s: float = np.inf) -> Starts:
    """Mark the samples of a segment; what limits [s] mean is told by `mark_starts`."""
    commands = segment.command_s, segment.measured_s, segment.measured_deg
    return mark_starts(new_starts_memory(), *commands, (longest_gap_s, fresh_s, blanking_s))


def mark_starts(
    memory: FloatArray,
    command_s: FloatArray,
    measured_s: FloatArray,
    measured_deg: FloatArray,
    limits_s: tuple[float, float, float],
) -> Starts:
    """Mark the next samples, of shape (n,); the memory moves on with them, `command_s` are all commands so far.

    Limits are the longest interval without commands or positions that is bridged, the age of a command beyond which
    the next one is known to have been lost, and for how long after a start nothing is judged.
    """
    size = measured_s.size
    starts = Starts(np.empty(size), np.empty(size, dtype=np.int8), np.empty(size, dtype=bool))
    _mark(memory, command_s, measured_s, measured_deg, limits_s, *starts)
    return starts


@compiled
def _mark(
    memory: FloatArray,
    command_s: FloatArray,
    measured_s: FloatArray,
    measured_deg: FloatArray,
    limits_s: tuple[float, float, float],
    usable_deg: FloatArray,
    restart: NDArray[np.int8],
    settled: BoolArray,
) -> None:
    longest_gap_s, fresh_s, blanking_s = limits_s
    c = int(memory[4])
    servo_known, filter_known = memory[0] != 0.0, memory[1] != 0.0
    last_used_s, last_start_s = memory[2], memory[3]
    for k in range(measured_s.size):
        now = measured_s[k]
        while c < command_s.size and command_s[c] <= now:
            # What the servo did while no command was logged for long, nobody knows.
            if c > 0 and command_s[c] - command_s[c - 1] > longest_gap_s:
                servo_known = False
            c += 1
        commanded = c > 0 and now - command_s[c - 1] <= longest_gap_s
        usable = commanded and np.isfinite(measured_deg[k])
        restart[k] = RESTART_NONE
        if commanded and not servo_known:
            restart[k] = RESTART_ALL
            servo_known, filter_known = True, usable
        elif usable and (not filter_known or now - last_used_s > longest_gap_s):
            restart[k] = RESTART_FILTER
            filter_known = True
        if restart[k] != RESTART_NONE:
            last_start_s = now
        if usable:
            last_used_s = now
        usable_deg[k] = measured_deg[k] if usable else np.nan
        # Inside a hole the command is made up from the one after it; at the end of a log there is none.
        made_up = c > 0 and now - command_s[c - 1] > fresh_s
        settled[k] = usable and now - last_start_s >= blanking_s and not made_up
    memory[0], memory[1], memory[2], memory[3], memory[4] = servo_known, filter_known, last_used_s, last_start_s, c


class FilterParameters(NamedTuple):
    """The measured branch ``Qy`` of a nullspace filter."""

    pole_rad_s: float
    decay_rad_s: ComplexArray
    """All poles of the servo, negated, both members of each pair, of shape (n,)."""
    dc_gain: float


class FilterMemory(NamedTuple):
    """What changes from sample to sample while several signals of the same instants are filtered."""

    lags: FloatArray
    """Of shape (r, n + 1): successive lags of each signal [deg]."""
    weights: FloatArray
    """Of shape (n + 1,): shares of the lags in the residual for the step length below."""
    step: FloatArray
    """Of shape (3,): step length [s] of the weights, its lag factor, time of the last filtered sample [s]."""
    polynomial: ComplexArray
    """Of shape (n + 1,): room for the calculation of the weights."""

    @classmethod
    def of(cls, residual_filter: FilterParameters, signals: int) -> FilterMemory:
        """Memory before the first sample."""
        lags = residual_filter.decay_rad_s.size + 1
        return cls(
            np.zeros((signals, lags)), np.zeros(lags), np.array([-1.0, 0.0, 0.0]), np.zeros(lags, dtype=np.complex128)
        )


@inner
def _weigh_lags(residual_filter: FilterParameters, memory: FilterMemory, step_s: float) -> None:
    """Shares of the lags for this step length: the servo's characteristic polynomial written in the lag."""
    lag = math.exp(-residual_filter.pole_rad_s * step_s)
    order = residual_filter.decay_rad_s.size
    polynomial = memory.polynomial
    for i in range(order + 1):
        polynomial[i] = 1.0 if i == 0 else 0.0
    free = 1.0 + 0.0j
    for i in range(order):
        factor = np.exp(-residual_filter.decay_rad_s[i] * step_s)
        ratio = np.exp((residual_filter.pole_rad_s - residual_filter.decay_rad_s[i]) * step_s)
        for j in range(i + 1, 0, -1):
            polynomial[j] = (1.0 - ratio) * polynomial[j] + ratio * polynomial[j - 1]
        polynomial[0] *= 1.0 - ratio
        free *= 1.0 - factor
    scale = 1.0 / (residual_filter.dc_gain * free.real)
    for j in range(order + 1):
        # Entry j multiplies the lag of order n + 1 - j; the lags are stored by rising order.
        memory.weights[order - j] = polynomial[j].real * scale
        scale *= 1.0 - lag
    memory.step[0] = step_s
    memory.step[1] = lag


def lag_weights(residual_filter: FilterParameters, step_s: float) -> FloatArray:
    """Shares of the lags in the residual for one step length, of shape (n + 1,)."""
    memory = FilterMemory.of(residual_filter, 1)
    filtered_rows(residual_filter, memory, np.array([0.0, step_s]), np.zeros(2), np.array([1, 0], dtype=np.int8))
    return memory.weights


def filtered_rows(
    residual_filter: FilterParameters,
    memory: FilterMemory,
    time_s: FloatArray,
    rows_deg: FloatArray,
    restart: NDArray[np.int8],
) -> FloatArray:
    """Residuals of one or several signals of the same instants [deg], shape (n,) or (r, n); the memory moves on.

    A sample that is NaN in the first row is left out in all of them; the filter starts anew where `restart` is not 0.
    """
    result, shape = np.empty(rows_deg.shape), (memory.lags.shape[0], time_s.size)
    rows = fixed(rows_deg.reshape(shape))
    _filter(residual_filter, memory, fixed(time_s), rows, fixed(restart), result.reshape(shape))
    return result


@compiled
def _filter(
    residual_filter: FilterParameters,
    memory: FilterMemory,
    time_s: FloatArray,
    rows_deg: FloatArray,
    restart: NDArray[np.int8],
    filtered_deg: FloatArray,
) -> None:
    lags = memory.lags
    for k in range(time_s.size):
        now = time_s[k]
        if math.isnan(rows_deg[0, k]):
            for r in range(lags.shape[0]):
                filtered_deg[r, k] = math.nan
            continue
        if restart[k] != 0:
            memory.step[2] = now
            for r in range(lags.shape[0]):
                for j in range(lags.shape[1]):
                    lags[r, j] = rows_deg[r, k]
                filtered_deg[r, k] = rows_deg[r, k] / residual_filter.dc_gain
            continue
        step_s = now - memory.step[2]
        memory.step[2] = now
        if abs(step_s - memory.step[0]) > SAME_STEP_S:
            _weigh_lags(residual_filter, memory, step_s)
        lag = memory.step[1]
        for r in range(lags.shape[0]):
            value, residual = rows_deg[r, k], 0.0
            for j in range(lags.shape[1]):
                value = lag * lags[r, j] + (1.0 - lag) * value
                lags[r, j] = value
                residual += memory.weights[j] * value
            filtered_deg[r, k] = residual
