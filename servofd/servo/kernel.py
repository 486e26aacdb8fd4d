"""The compiled kernel of a servo without effects, event by event, on true time stamps.

Between two events (a command taking effect, a position being measured) everything has a closed form, so the
result does not depend on how the samples are spaced:

1. **Linear dynamics** (`Modes`): each mode relaxes towards the held or ramped command,
   ``z <- u(h) - s/a + exp(-a h) (z - u(0) + s/a)`` for a command ``u(0) + s tau``.
2. **Rate limit**: the position follows the linear motion until that becomes too fast, then runs at the limit
   until it meets the linear motion again; both instants are located by bisection.
3. **Position limit**: a stop.

A whole log and a single live sample run through the same `run`, which `servofd.servo.motion` calls.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from servofd.servo.state import SAME_STEP_S, SLOTS, Memory, ServoParameters, compiled, exactly, inlined

if TYPE_CHECKING:
    from servofd.core.types import BoolArray, FloatArray

_NO_STEP_S = 1e-12
_ROUND_OFF_S = 5e-13
"""Differences of time stamps vary by this much for rounding alone, after an hour; it moves no servo by 1e-9 deg."""
_SEARCH_STEP_S, _SEARCH_GROWTH, _FASTEST_SHARE = 1e-3, 1.3, 0.1
_BISECTIONS = 50


@inlined
def _slot_for(servo: ServoParameters, memory: Memory, step_s: float) -> int:
    """Index of the cached exponentials for a step of about this length, filled if need be."""
    for slot in range(SLOTS):
        if abs(memory.slot_step_s[slot] - step_s) <= SAME_STEP_S:
            return slot
    slot = memory.cursor[0]
    memory.cursor[0] = (slot + 1) % SLOTS
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
            # The rate of a servo of first order jumps with its command, and may soon have fallen again.
            if _excess_rate(servo, memory, now) <= 0.0:
                now = _first_change(servo, memory, now, step_s, 0.0, 0.0, 0.0)
            if now >= step_s:
                return _linear_position(servo, memory, step_s), 0.0
            position = _linear_position(servo, memory, now)
            direction = 1.0 if _linear_rate(servo, memory, now) > 0.0 else -1.0
        rate = servo.rate_up_deg_s if direction > 0.0 else -servo.rate_down_deg_s
        meet = _first_change(servo, memory, now, step_s, position, rate, direction)
        if meet >= step_s:
            return position + rate * (step_s - now), direction
        now, direction = meet, 0.0


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
def run(
    servo: ServoParameters,
    memory: Memory,
    effective_s: FloatArray,
    command_deg: FloatArray,
    slope_deg_s: FloatArray,
    at_s: FloatArray,
    position_deg: FloatArray,
) -> int:
    """Move the servo on to each of some instants; its positions go into the last array.

    `effective_s` are the instants at which commands reach the servo (logged time plus delay). Call again with later
    instants, and with the commands from the returned number on, to continue where the memory stands.
    """
    motion, c = memory.motion, 0
    if math.isnan(motion[5]):
        motion[5] = _fastest_possible(servo, memory)
    for k in range(at_s.size):
        while c < effective_s.size and effective_s[c] <= at_s[k]:
            _advance(servo, memory, effective_s[c])
            motion[1], motion[2] = command_deg[c], slope_deg_s[c]
            motion[5] = _fastest_possible(servo, memory)
            c += 1
        _advance(servo, memory, at_s[k])
        position_deg[k] = min(max(motion[3], servo.lower_deg), servo.upper_deg)
    return c


@exactly
def run_from_starts(
    servo: ServoParameters,
    memory: Memory,
    gain: float,
    effective_s: FloatArray,
    command_deg: FloatArray,
    slope_deg_s: FloatArray,
    at_s: FloatArray,
    measured_deg: FloatArray,
    anew: BoolArray,
    position_deg: FloatArray,
) -> None:
    """The same for a whole flight, at rest where it was measured at each instant of `anew`; `gain` is that at rest."""
    motion, first, last, begin, commanded = memory.motion, 0, 0, 0, False
    while begin < at_s.size:
        end = begin + 1
        while end < at_s.size and not anew[end]:
            end += 1
        now_s, heard = at_s[begin], first
        while last < effective_s.size and effective_s[last] <= at_s[end - 1]:
            last += 1
        while first < last and effective_s[first] <= now_s:
            first += 1
        if first > heard:
            motion[0], motion[1], motion[2] = effective_s[first - 1], command_deg[first - 1], slope_deg_s[first - 1]
            commanded = True
        elif not commanded and first < last:
            motion[0], motion[1], motion[2] = now_s, command_deg[first], 0.0
        motion[1] += motion[2] * (now_s - motion[0])
        rest_deg = measured_deg[begin] / gain if anew[begin] and not math.isnan(measured_deg[begin]) else motion[1]
        if not commanded:
            motion[1] = rest_deg
        memory.modes[:] = rest_deg
        motion[0], motion[3], motion[4], motion[5] = now_s, gain * rest_deg, 0.0, math.nan
        ahead = slice(first, last)
        done = run(
            servo,
            memory,
            effective_s[ahead],
            command_deg[ahead],
            slope_deg_s[ahead],
            at_s[begin:end],
            position_deg[begin:end],
        )
        first += done
        commanded = commanded or done > 0
        begin = end
