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
from functools import partial
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np

from logparsers import compiled as compiler
from servofd.core.types import ComplexArray, FloatArray

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from servofd.core.types import BoolArray

Kind = TypeVar("Kind", np.float64, np.int8, np.bool_)

SAME_STEP_S = 1e-7
"""Steps this close share an exponential, corrected by a three-term series (error below 1e-15)."""
SLOTS = 4
"""Step lengths whose exponentials are kept. A uniform log with a fractional delay alternates between two."""

compiled = partial(compiler.compiled, error_model="numpy", fastmath={"contract"}, _nrt=False)
inlined = partial(compiler.compiled, error_model="numpy", fastmath={"contract"}, _nrt=False, inline="always")
inner = partial(compiled, no_cpython_wrapper=True)
"""No reference counting inside: nothing here allocates, and it would take 9/10 of the time (measured). What only other
compiled functions call needs no door for Python, which takes as long to compile as the function."""


class ServoParameters(NamedTuple):
    """A servo without effects, as the kernel sees it; a limit that is absent is infinite."""

    decay_rad_s: ComplexArray
    weight: ComplexArray
    rate_down_deg_s: float
    rate_up_deg_s: float
    lower_deg: float
    upper_deg: float

    def slower(self, bandwidth_scale: float) -> ServoParameters:
        """The servo with every pole scaled: its modes keep their weights."""
        return self._replace(decay_rad_s=self.decay_rad_s * bandwidth_scale)

    def limited(self, rate_deg_s: float) -> ServoParameters:
        """The servo that turns no faster than this [deg/s]."""
        up, down = min(rate_deg_s, self.rate_up_deg_s), min(rate_deg_s, self.rate_down_deg_s)
        return self._replace(rate_up_deg_s=up, rate_down_deg_s=down)

    def weaker(self, share: float) -> ServoParameters:
        """The servo with every rate limit lower by a share."""
        up, down = (1.0 - share) * self.rate_up_deg_s, (1.0 - share) * self.rate_down_deg_s
        return self._replace(rate_up_deg_s=up, rate_down_deg_s=down)


class Memory(NamedTuple):
    """Everything that changes from sample to sample; arrays, so that it can be updated in place and copied."""

    modes: ComplexArray
    """Of shape (m,): position each mode would reach [deg]."""
    motion: FloatArray
    """Of shape (7,): time [s], held command [deg], its slope [deg/s], position [deg], rate-limited (-1, 0, 1), a speed
    that the linear motion cannot exceed under this command [deg/s], NaN if none is known yet, and whether any
    command came."""
    cursor: np.ndarray[tuple[int], np.dtype[np.int64]]
    """Of shape (1,): next exponential slot to overwrite."""
    slot_step_s: FloatArray
    """Of shape (slots,)."""
    slot_factor: ComplexArray
    """Of shape (slots, m)."""


def fixed(values: NDArray[Kind]) -> NDArray[Kind]:
    """The same values, contiguous and read-only: compiled for them alone, a function is compiled once.

    Examples
    --------
    >>> fixed(np.arange(6.0)[::2]).flags.writeable
    False
    """
    view = np.ascontiguousarray(values).view()
    view.setflags(write=False)
    return view


def new_memory(servo: ServoParameters) -> Memory:
    """Memory before the first sample."""
    modes = servo.decay_rad_s.size
    return Memory(
        modes=np.zeros(modes, dtype=np.complex128),
        motion=np.array([0.0, 0.0, 0.0, 0.0, 0.0, np.nan, 0.0]),
        cursor=np.zeros(1, dtype=np.int64),
        slot_step_s=np.full(SLOTS, -1.0),
        slot_factor=np.zeros((SLOTS, modes), dtype=np.complex128),
    )


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


@inner
def _linear(servo: ServoParameters, memory: Memory, after_s: float) -> tuple[float, float]:
    """Position [deg] and rate [deg/s] of the linear dynamics `after_s` into the interval that begins now."""
    held, slope = memory.motion[1], memory.motion[2]
    position = rate = 0.0
    for i in range(servo.decay_rad_s.size):
        a = servo.decay_rad_s[i]
        target = held - slope / a
        free = np.exp(-a * after_s) * (memory.modes[i] - target)
        position += (servo.weight[i] * (target + slope * after_s + free)).real
        rate += (servo.weight[i] * (slope - a * free)).real
    return position, rate


@inlined
def _fastest_possible(servo: ServoParameters, modes: ComplexArray, held: float, slope: float) -> float:
    """Upper bound of the linear rate from now until the next command [deg/s]."""
    bound = 0.0
    for i in range(servo.decay_rad_s.size):
        a = servo.decay_rad_s[i]
        deviation = a * (modes[i] - held) + slope
        weighted = servo.weight[i] * deviation
        bound += abs(weighted.real) + abs(weighted.imag) + abs(slope * servo.weight[i].real)
    return bound


@inner
def _limited(servo: ServoParameters, memory: Memory, step_s: float) -> tuple[float, float]:
    """Position and limiting direction at the end of an interval in which the rate limit may act."""
    now, position, direction = 0.0, memory.motion[3], memory.motion[4]
    while True:
        if direction == 0.0:
            # The rate of a servo of first order jumps with its command, and may soon have fallen again.
            if _change(servo, memory, now, now, 0.0, 0.0, 0.0) <= 0.0:
                now = _first_change(servo, memory, now, step_s, 0.0, 0.0, 0.0)
            if now >= step_s:
                return _linear(servo, memory, step_s)[0], 0.0
            position, linear_rate = _linear(servo, memory, now)
            direction = 1.0 if linear_rate > 0.0 else -1.0
        rate = servo.rate_up_deg_s if direction > 0.0 else -servo.rate_down_deg_s
        meet = _first_change(servo, memory, now, step_s, position, rate, direction)
        if meet >= step_s:
            return position + rate * (step_s - now), direction
        now, direction = meet, 0.0


@inner
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
    linear, linear_rate = _linear(servo, memory, at_s)
    if direction == 0.0:
        return max(linear_rate - servo.rate_up_deg_s, -linear_rate - servo.rate_down_deg_s)
    return direction * (position + rate * (at_s - start_s) - linear)


@inner
def _closest(servo: ServoParameters, memory: Memory, low: float, high: float, rate: float, direction: float) -> float:
    """Instant at which the linear motion comes closest to the limited one, if it turns within the interval."""
    if direction == 0.0:
        return high
    if direction * (rate - _linear(servo, memory, low)[1]) <= 0.0:
        return high
    if direction * (rate - _linear(servo, memory, high)[1]) >= 0.0:
        return high
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        if direction * (rate - _linear(servo, memory, middle)[1]) > 0.0:
            low = middle
        else:
            high = middle
    return low


@inner
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
def _next_mode(
    servo: ServoParameters, memory: Memory, i: int, slot: int, step_s: float, held: float, slope: float
) -> complex:
    """Where a mode will be a step later [deg]."""
    factor, rest_s = memory.slot_factor[slot, i], step_s - memory.slot_step_s[slot]
    if abs(rest_s) > _ROUND_OFF_S:
        x = servo.decay_rad_s[i] * rest_s
        factor *= 1.0 - x * (1.0 - 0.5 * x)
    if slope == 0.0:
        return held + factor * (memory.modes[i] - held)
    target = held - slope / servo.decay_rad_s[i]
    return target + slope * step_s + factor * (memory.modes[i] - target)


@inlined
def _expected(effective_s: FloatArray, c: int, at_s: FloatArray, anew: BoolArray, k: int) -> bool:
    """Whether a next command is known, and comes before the servo begins anew after `k`."""
    end = k + 1
    while end < at_s.size and not anew[end]:
        end += 1
    return c < effective_s.size and (end == at_s.size or effective_s[c] <= at_s[end - 1])


@compiled
def run(  # noqa: C901, PLR0912, PLR0915 - one function, because its state would be stored and loaded at each call
    servo: ServoParameters,
    memory: Memory,
    effective_s: FloatArray,
    command_deg: FloatArray,
    slope_deg_s: FloatArray,
    at_s: FloatArray,
    anew: BoolArray,
    measured_deg: FloatArray,
    position_deg: FloatArray,
) -> int:
    """Move the servo on to each of some instants; its positions go into the last array.

    `effective_s` are the instants at which commands reach the servo (logged time plus delay). At each instant of `anew`
    it is at rest where it was measured, or where its command wants it if that is NaN; these two may be empty. Call it
    again with later instants, and with the commands from the returned number on, to continue where the memory stands.
    """
    motion, c, k, gain, per_deg, per_slope = memory.motion, 0, 0, 0.0, 0.0, 0.0
    now, held, slope, position = motion[0], motion[1], motion[2], motion[3]
    direction, fastest, commanded = motion[4], motion[5], motion[6]
    slowest_limit = min(servo.rate_up_deg_s, servo.rate_down_deg_s)
    for i in range(servo.weight.size):
        gain += servo.weight[i].real
        weighted = servo.weight[i] * servo.decay_rad_s[i]
        per_deg += abs(weighted.real) + abs(weighted.imag)
        per_slope += 2.0 * abs(servo.weight[i].real) + abs(servo.weight[i].imag)
    if math.isnan(fastest):
        fastest = _fastest_possible(servo, memory.modes, held, slope)
    while k < at_s.size:
        if k < anew.size and anew[k]:
            heard = c
            while c < effective_s.size and effective_s[c] <= at_s[k]:
                c += 1
            if c > heard:
                now, held, slope, commanded = effective_s[c - 1], command_deg[c - 1], slope_deg_s[c - 1], 1.0
            elif commanded == 0.0 and _expected(effective_s, c, at_s, anew, k):
                now, held, slope = at_s[k], command_deg[c], 0.0
            held += slope * (at_s[k] - now)
            rest_deg = held if math.isnan(measured_deg[k]) else measured_deg[k] / gain
            if commanded == 0.0:  # what holds it can only have been an earlier command
                held = rest_deg
            for i in range(memory.modes.size):
                memory.modes[i] = rest_deg
            now, position, direction = at_s[k], gain * rest_deg, 0.0
            fastest = _fastest_possible(servo, memory.modes, held, slope)
        is_command = c < effective_s.size and effective_s[c] <= at_s[k]
        until = effective_s[c] if is_command else at_s[k]
        step_s = until - now
        if step_s > _NO_STEP_S:
            limited = direction != 0.0 or fastest > slowest_limit
            if limited:
                motion[1], motion[2], motion[3], motion[4] = held, slope, position, direction
                position, direction = _limited(servo, memory, step_s)
            slot, total = _slot_for(servo, memory, step_s), 0.0
            for i in range(servo.decay_rad_s.size):
                mode = _next_mode(servo, memory, i, slot, step_s, held, slope)
                memory.modes[i] = mode
                total += servo.weight[i].real * mode.real - servo.weight[i].imag * mode.imag
            now = until
            held += slope * step_s
            position = position if limited else total
        if is_command:
            # No more than it was and what this command can add; that is looked at closer where it may be too fast.
            fastest += per_deg * abs(command_deg[c] - held) + per_slope * abs(slope_deg_s[c] - slope)
            held, slope, commanded = command_deg[c], slope_deg_s[c], 1.0
            if fastest > slowest_limit:
                fastest = _fastest_possible(servo, memory.modes, held, slope)
            c += 1
        else:
            position_deg[k] = min(max(position, servo.lower_deg), servo.upper_deg)
            k += 1
    motion[0], motion[1], motion[2], motion[3] = now, held, slope, position
    motion[4], motion[5], motion[6] = direction, fastest, commanded
    return c


@compiled
def _play(values: FloatArray, half_width: float, start: float, result: FloatArray) -> None:
    held = start
    for k in range(values.size):
        held = min(max(held, values[k] - half_width), values[k] + half_width)
        result[k] = held


def play(values: FloatArray, width: float, start: float) -> FloatArray:
    """Follow `values` only when they would leave a zone of full width `width` around the result.

    Parameters
    ----------
    values : ndarray, shape (n,)
        Signal.
    start : float
        Result before the first sample.

    Returns
    -------
    ndarray, shape (n,)
        Never further than half the width from the signal.

    Examples
    --------
    >>> play(np.array([0.0, 1.0, 3.0, 2.0, -1.0]), 2.0, 0.0)
    array([0., 0., 2., 2., 0.])
    """
    result = np.empty(values.size)
    _play(fixed(np.asarray(values, dtype=float)), width / 2.0, start, result)
    return result
