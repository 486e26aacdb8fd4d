"""The one compiled kernel: a servo and its residual, event by event, on true time stamps.

Between two events (a command taking effect, a position being measured) everything has a closed form, so the
result does not depend on how the samples are spaced:

1. **Linear dynamics** (`Modes`): each mode relaxes towards the held or ramped command,
   ``z <- u(h) - s/a + exp(-a h) (z - u(0) + s/a)`` for a command ``u(0) + s tau``.
2. **Rate limit**: the position follows the linear motion until that becomes too fast, then runs at the limit
   until it meets the linear motion again; both instants are located by bisection.
3. **Position limit**: a stop.
4. **Residual filter**: ``Qy`` of the nullspace filter in the lag form, see `servofd.detection.residual`.

A whole log and a single live sample run through the same `observe`.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from servofd.models.state import SLOTS, FilterParameters, Memory, ServoParameters, compiled, fixed, inlined, new_memory
from servofd.types import FloatArray

if TYPE_CHECKING:
    from numpy.typing import NDArray

_SAME_STEP_S = 1e-7
"""Steps this close share an exponential, corrected by a three-term series (error below 1e-15)."""

_NO_STEP_S = 1e-12
_ROUND_OFF_S = 5e-13
"""Differences of time stamps vary by this much for rounding alone, after an hour; it moves no servo by 1e-9 deg."""
_SEARCH_STEP_S, _SEARCH_GROWTH, _FASTEST_SHARE = 1e-3, 1.3, 0.1
_BISECTIONS = 50

RESTART_NONE, RESTART_FILTER, RESTART_ALL = 0, 1, 2


@inlined
def _slot_for(servo: ServoParameters, memory: Memory, step_s: float) -> int:
    """Index of the cached exponentials for a step of about this length, filled if need be."""
    for slot in range(SLOTS):
        if abs(memory.slot_step_s[slot] - step_s) <= _SAME_STEP_S:
            return slot
    slot = memory.cursor[1]
    memory.cursor[1] = (slot + 1) % SLOTS
    memory.slot_step_s[slot] = step_s
    for i in range(servo.decay_rad_s.size):
        memory.slot_factor[slot, i] = np.exp(-servo.decay_rad_s[i] * step_s)
    return int(slot)


@compiled
def _linear_position(servo: ServoParameters, memory: Memory, after_s: float) -> float:
    """Position of the linear dynamics `after_s` into the interval that starts at the memory's time [deg]."""
    held, slope = memory.motion[1], memory.motion[2]
    total = 0.0
    for i in range(servo.decay_rad_s.size):
        a = servo.decay_rad_s[i]
        target = held - slope / a
        mode = target + slope * after_s + np.exp(-a * after_s) * (memory.modes[i] - target)
        total += (servo.weight[i] * mode).real
    return total


@compiled
def _linear_rate(servo: ServoParameters, memory: Memory, after_s: float) -> float:
    """Rate of the same motion [deg/s]."""
    held, slope = memory.motion[1], memory.motion[2]
    total = 0.0
    for i in range(servo.decay_rad_s.size):
        a = servo.decay_rad_s[i]
        rate = slope - a * np.exp(-a * after_s) * (memory.modes[i] - held + slope / a)
        total += (servo.weight[i] * rate).real
    return total


@inlined
def _fastest_possible(servo: ServoParameters, memory: Memory) -> float:
    """Upper bound of the linear rate from now until the next command [deg/s]."""
    held, slope = memory.motion[1], memory.motion[2]
    bound = 0.0
    for i in range(servo.decay_rad_s.size):
        a = servo.decay_rad_s[i]
        deviation = a * (memory.modes[i] - held) + slope
        weighted = servo.weight[i] * deviation
        bound += abs(weighted.real) + abs(weighted.imag) + abs(slope * servo.weight[i].real)
    return bound


@compiled
def _excess_rate(servo: ServoParameters, memory: Memory, after_s: float) -> float:
    """How far the linear rate lies outside the rate limits (positive: outside) [deg/s]."""
    rate = _linear_rate(servo, memory, after_s)
    return max(rate - servo.rate_up_deg_s, -rate - servo.rate_down_deg_s)


@compiled
def _limited(servo: ServoParameters, memory: Memory, step_s: float) -> tuple[float, float]:
    """Position and limiting direction at the end of an interval in which the rate limit may act."""
    now, position, direction = 0.0, memory.motion[3], memory.motion[4]
    while True:
        if direction == 0.0:
            begin = _first_change(servo, memory, now, step_s, 0.0, 0.0, 0.0)
            if begin >= step_s:
                return _linear_position(servo, memory, step_s), 0.0
            now, position = begin, _linear_position(servo, memory, begin)
            direction = 1.0 if _linear_rate(servo, memory, begin) > 0.0 else -1.0
        rate = servo.rate_up_deg_s if direction > 0.0 else -servo.rate_down_deg_s
        meet = _first_change(servo, memory, now, step_s, position, rate, direction)
        if meet >= step_s:
            return position + rate * (step_s - now), direction
        now, direction = meet, 0.0
        if _excess_rate(servo, memory, now) > 0.0:
            position = _linear_position(servo, memory, now)
            direction = 1.0 if _linear_rate(servo, memory, now) > 0.0 else -1.0


@compiled
def _change(
    servo: ServoParameters,
    memory: Memory,
    at_s: float,
    start_s: float,
    position: float,
    rate: float,
    direction: float,
) -> float:
    """Positive once the state has changed: limit exceeded (when following), caught up (when limited)."""
    if direction == 0.0:
        return _excess_rate(servo, memory, at_s)
    return direction * (position + rate * (at_s - start_s) - _linear_position(servo, memory, at_s))


@compiled
def _closest(servo: ServoParameters, memory: Memory, low: float, high: float, rate: float, direction: float) -> float:
    """Instant at which the linear motion comes closest to the limited one, if it turns within the interval."""
    if direction == 0.0:
        return high
    if direction * (rate - _linear_rate(servo, memory, low)) <= 0.0:
        return high
    if direction * (rate - _linear_rate(servo, memory, high)) >= 0.0:
        return high
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        if direction * (rate - _linear_rate(servo, memory, middle)) > 0.0:
            low = middle
        else:
            high = middle
    return low


@compiled
def _first_change(
    servo: ServoParameters,
    memory: Memory,
    start_s: float,
    end_s: float,
    position: float,
    rate: float,
    direction: float,
) -> float:
    """First instant in the interval at which following turns into limiting or back; `end_s` if none."""
    fastest = 0.0
    for i in range(servo.decay_rad_s.size):
        fastest = max(fastest, abs(servo.decay_rad_s[i]))
    # Right after a command the fast modes move; the longer ago it was, the slower what is left of the motion.
    width = min(_SEARCH_STEP_S, _FASTEST_SHARE / fastest)
    low = start_s
    while low < end_s:
        high = min(low + width, end_s)
        found = high
        if _change(servo, memory, high, start_s, position, rate, direction) <= 0.0:
            # The linear motion may have met the limited one and turned away again within this step.
            found = _closest(servo, memory, low, high, rate, direction)
        if _change(servo, memory, found, start_s, position, rate, direction) > 0.0:
            for _ in range(_BISECTIONS):
                middle = 0.5 * (low + found)
                if _change(servo, memory, middle, start_s, position, rate, direction) > 0.0:
                    found = middle
                else:
                    low = middle
            return found
        low, width = high, min(_SEARCH_STEP_S, _SEARCH_GROWTH * width)
    return end_s


@inlined
def _advance(servo: ServoParameters, memory: Memory, until_s: float) -> None:
    """Move the servo on to `until_s` under the command it holds."""
    motion = memory.motion
    step_s = until_s - motion[0]
    if step_s <= _NO_STEP_S:
        return
    limited = motion[4] != 0.0 or motion[5] > min(servo.rate_up_deg_s, servo.rate_down_deg_s)
    position, direction = _limited(servo, memory, step_s) if limited else (0.0, 0.0)
    slot = _slot_for(servo, memory, step_s)
    rest_s = step_s - memory.slot_step_s[slot]
    held, slope = motion[1], motion[2]
    total = 0.0
    for i in range(servo.decay_rad_s.size):
        factor = memory.slot_factor[slot, i]
        if abs(rest_s) > _ROUND_OFF_S:
            x = servo.decay_rad_s[i] * rest_s
            factor *= 1.0 - x * (1.0 - 0.5 * x)
        if slope == 0.0:
            mode = held + factor * (memory.modes[i] - held)
        else:
            target = held - slope / servo.decay_rad_s[i]
            mode = target + slope * step_s + factor * (memory.modes[i] - target)
        memory.modes[i] = mode
        total += servo.weight[i].real * mode.real - servo.weight[i].imag * mode.imag
    motion[0] = until_s
    motion[1] = held + slope * step_s
    motion[3], motion[4] = (position, direction) if limited else (total, 0.0)


@compiled
def _settle(servo: ServoParameters, memory: Memory, time_s: float, measured_deg: float, commanded: bool) -> None:
    """Start at rest where the surface was measured, or else where the command in force wants it."""
    motion, gain = memory.motion, 0.0
    for i in range(servo.decay_rad_s.size):
        gain += servo.weight[i].real
    motion[1] += motion[2] * (time_s - motion[0])
    rest = motion[1] if math.isnan(measured_deg) else measured_deg / gain
    if not commanded and not math.isnan(measured_deg):
        # No command has arrived yet: what holds the surface where it is can only be an earlier one.
        motion[1] = rest
    for i in range(servo.decay_rad_s.size):
        memory.modes[i] = rest
    motion[0], motion[3], motion[4] = time_s, gain * rest, 0.0
    motion[5] = _fastest_possible(servo, memory)


@compiled
def _weigh_lags(residual_filter: FilterParameters, memory: Memory, step_s: float) -> None:
    """Shares of the lags for this step length: the servo's characteristic polynomial written in the lag."""
    lag = math.exp(-residual_filter.pole_rad_s * step_s)
    order = residual_filter.decay_rad_s.size
    polynomial = memory.polynomial
    polynomial[:] = 0.0
    polynomial[0] = 1.0
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
        memory.lag_weights[order - j] = polynomial[j].real * scale
        scale *= 1.0 - lag
    memory.lag_step[0] = step_s
    memory.lag_step[1] = lag


def lag_weights(residual_filter: FilterParameters, step_s: float) -> FloatArray:
    """Shares of the lags in the residual for one step length, of shape (n + 1,)."""
    servo = ServoParameters(np.zeros(0, complex), np.zeros(0, complex), 0.0, 0.0, 0.0, 0.0)
    memory = new_memory(servo, residual_filter)
    _weigh_lags(residual_filter, memory, step_s)
    return memory.lag_weights


@inlined
def _filter(residual_filter: FilterParameters, memory: Memory, time_s: float, error_deg: float) -> float:
    """Next residual from the next simulation error."""
    step_s = time_s - memory.lag_step[2]
    memory.lag_step[2] = time_s
    if abs(step_s - memory.lag_step[0]) > _SAME_STEP_S:
        _weigh_lags(residual_filter, memory, step_s)
    lag = memory.lag_step[1]
    value, residual = error_deg, 0.0
    for j in range(memory.lags.size):
        value = lag * memory.lags[j] + (1.0 - lag) * value
        memory.lags[j] = value
        residual += memory.lag_weights[j] * value
    return residual


def observe(
    servo: ServoParameters,
    residual_filter: FilterParameters,
    memory: Memory,
    effective_s: FloatArray,
    command_deg: FloatArray,
    slope_deg_s: FloatArray,
    measured_s: FloatArray,
    measured_deg: FloatArray,
    restart: NDArray[np.int8],
    simulated_deg: FloatArray,
    residual_deg: FloatArray,
) -> None:
    """Simulate the servo up to each measurement and filter the difference; results go into the last two arrays.

    `effective_s` are the instants at which commands reach the servo (logged time plus delay). A measurement
    of NaN advances the simulation only. Call again with more data to continue where the memory stands.
    """
    asked = fixed(effective_s), fixed(command_deg), fixed(slope_deg_s)
    seen = fixed(measured_s), fixed(measured_deg), fixed(restart)
    _observe(servo, residual_filter, memory, *asked, *seen, simulated_deg, residual_deg)


@compiled
def _observe(
    servo: ServoParameters,
    residual_filter: FilterParameters,
    memory: Memory,
    effective_s: FloatArray,
    command_deg: FloatArray,
    slope_deg_s: FloatArray,
    measured_s: FloatArray,
    measured_deg: FloatArray,
    restart: NDArray[np.int8],
    simulated_deg: FloatArray,
    residual_deg: FloatArray,
) -> None:
    motion, lags = memory.motion, memory.lags
    for k in range(measured_s.size):
        now = measured_s[k]
        c = memory.cursor[0]
        if restart[k] == RESTART_ALL:
            if c == 0 and effective_s.size > 0:
                motion[0], motion[1], motion[2] = now, command_deg[0], 0.0
            while c < effective_s.size and effective_s[c] <= now:
                motion[0], motion[1], motion[2] = effective_s[c], command_deg[c], slope_deg_s[c]
                c += 1
            _settle(servo, memory, now, measured_deg[k], c > 0)
        while c < effective_s.size and effective_s[c] <= now:
            _advance(servo, memory, effective_s[c])
            motion[1], motion[2] = command_deg[c], slope_deg_s[c]
            motion[5] = _fastest_possible(servo, memory)
            c += 1
        memory.cursor[0] = c
        _advance(servo, memory, now)
        simulated = min(max(motion[3], servo.lower_deg), servo.upper_deg)
        simulated_deg[k] = simulated
        error = measured_deg[k] - simulated
        if math.isnan(error):
            residual_deg[k] = math.nan
        elif restart[k] != RESTART_NONE:
            lags[:] = error
            memory.lag_step[2] = now
            residual_deg[k] = error / residual_filter.dc_gain
        else:
            residual_deg[k] = _filter(residual_filter, memory, now, error)


def evaluate(
    residual_filter: FilterParameters,
    memory: Memory,
    measured_s: FloatArray,
    error_deg: FloatArray,
    restart: NDArray[np.int8],
    residual_deg: FloatArray,
) -> None:
    """Filter a simulation error that is already there, as `observe` would; the result goes into the last array."""
    _evaluate(residual_filter, memory, fixed(measured_s), fixed(error_deg), fixed(restart), residual_deg)


@compiled
def _evaluate(
    residual_filter: FilterParameters,
    memory: Memory,
    measured_s: FloatArray,
    error_deg: FloatArray,
    restart: NDArray[np.int8],
    residual_deg: FloatArray,
) -> None:
    for k in range(measured_s.size):
        error = error_deg[k]
        if math.isnan(error):
            residual_deg[k] = math.nan
        elif restart[k] != RESTART_NONE:
            memory.lags[:] = error
            memory.lag_step[2] = measured_s[k]
            residual_deg[k] = error / residual_filter.dc_gain
        else:
            residual_deg[k] = _filter(residual_filter, memory, measured_s[k], error)


@compiled
def evaluate_rows(
    residual_filter: FilterParameters,
    memory: Memory,
    lags: FloatArray,
    measured_s: FloatArray,
    rows_deg: FloatArray,
    restart: np.ndarray[tuple[int], np.dtype[np.int8]],
    filtered_deg: FloatArray,
) -> None:
    """Filter several signals of the same instants, of shape (r, n), as `evaluate` would each; NaN in all or none.

    `lags`, of shape (r, order + 1), are theirs; the memory holds the weights.
    """
    for k in range(measured_s.size):
        now = measured_s[k]
        if math.isnan(rows_deg[0, k]):
            filtered_deg[:, k] = math.nan
            continue
        if restart[k] != RESTART_NONE:
            memory.lag_step[2] = now
            for r in range(lags.shape[0]):
                lags[r, :] = rows_deg[r, k]
                filtered_deg[r, k] = rows_deg[r, k] / residual_filter.dc_gain
            continue
        step_s = now - memory.lag_step[2]
        memory.lag_step[2] = now
        if abs(step_s - memory.lag_step[0]) > _SAME_STEP_S:
            _weigh_lags(residual_filter, memory, step_s)
        lag = memory.lag_step[1]
        for r in range(lags.shape[0]):
            value, residual = rows_deg[r, k], 0.0
            for j in range(lags.shape[1]):
                value = lag * lags[r, j] + (1.0 - lag) * value
                lags[r, j] = value
                residual += memory.lag_weights[j] * value
            filtered_deg[r, k] = residual
