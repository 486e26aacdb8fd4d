"""The compiled simulation: one servo with all effects, each at its physical place, on true time stamps.

Between events (a command taking effect, a position being measured) the loop is advanced by exact matrices. Dead band
and saturation are straight pieces of slope 1 or 0, chosen by the error in the middle of each step, so that within
a piece nothing is approximated. Friction is the constant deceleration that would stop the servo by the end of the
step, as far as its strength allows (docs/explain.md, E5 to E7). A step goes from event to event unless something
switches on its way (the error crosses an edge, the motion reverses): only then is it taken again in short ones.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from servofd.models.loop_steps import build, coasted, compiled, fade, flexed_tip, inlined, moved, row
from servofd.models.physics import Loop, Physics
from servofd.types import FloatArray

__all__ = ["framed", "heard", "new_memory", "run"]

_NO_STEP_S = 1e-10
_SAME_STEP_S = 1e-9
"""Steps that differ by less share their matrices: less than 1e-6 deg at 1000 deg/s."""
_STILL_DEG = 1e-5
_SLOTS, _MOST_BUILT = 8, 64
"""Matrices of that many lengths of step are kept; where the stamps jitter, none are made any more after so many."""
_READY = 3
_PER_DEG = math.pi / 180.0
_STATES = 17
(
    _CLOCK,
    _Y,
    _V,
    _TORQUE,
    _U,
    _S,
    _WANTED,
    _FOLLOWED,
    _FLEXED,
    _SWING,
    _PLAYED,
    _STATIC,
    _LAGGED,
    _CURSOR,
    _BUILT,
    _OLDER,
    _LATEST,
) = range(_STATES)


def new_memory(start_deg: float) -> FloatArray:
    """Memory of a servo at rest where its surface was measured [deg], shape (25,); `run` starts at its first instant.

    Time [s], the loop's states, command in force and its slope, wanted set point, positions along the linkage, how
    many of the commands have taken effect, and the lengths of step whose matrices are kept, so that a run in pieces
    takes the same steps as the run in one go.
    """
    memory = np.zeros(_STATES + _SLOTS)
    memory[_CLOCK] = np.nan
    memory[_STATES:] = -1.0
    memory[_STATIC] = start_deg
    return memory


def heard(memory: FloatArray) -> int:
    """How many of the commands of the last run have taken effect."""
    return int(memory[_CURSOR])


def run(
    physics: Physics,
    loop: Loop,
    dc_gain: float,
    longest_s: float,
    effective_s: FloatArray,
    command_deg: FloatArray,
    slope_deg_s: FloatArray,
    at_s: FloatArray,
    pressure_pa: FloatArray,
    voltage_v: FloatArray,
    memory: FloatArray,
) -> FloatArray:
    """Measured position at the rising times `at_s` [deg], shape (m,), from where the memory stands.

    The memory is moved on: run again with later times, and with the commands from its cursor on.
    """
    result, table = np.empty(at_s.size), np.empty((2 * _SLOTS, 3, 7))
    fades = np.zeros((_SLOTS + 1, 4))
    inputs = effective_s, command_deg, slope_deg_s, at_s, pressure_pa, voltage_v
    _run(physics, loop, dc_gain, longest_s, *inputs, memory, memory[_STATES:], table, fades, result)
    return result


@inlined
def _deflected(physics: Physics, played: float) -> float:
    """Deflection of the surface, from the position of the servo at the end of its play [deg]."""
    bent = 1.0 + played * (physics.quadratic_per_deg + played * physics.cubic_per_deg2)
    return float(max(min(physics.gain * played * bent, physics.upper_deg), physics.lower_deg) + physics.bias_deg)


@compiled
def _run(  # noqa: C901, PLR0912, PLR0915 - one function, because calls would take most of its time
    physics: Physics,
    loop: Loop,
    dc_gain: float,
    longest_s: float,
    effective_s: FloatArray,
    command_deg: FloatArray,
    slope_deg_s: FloatArray,
    at_s: FloatArray,
    pressure_pa: FloatArray,
    voltage_v: FloatArray,
    memory: FloatArray,
    built_s: FloatArray,
    table: FloatArray,
    fades: FloatArray,
    result: FloatArray,
) -> None:
    """The same with room for lengths of step, their matrices, what fades within them, and the result.

    Of the matrices there are two for each length of step: while the error acts, and while it does not. The last entry
    of the last array but one, which is also that of slot -1, is for steps that are not kept.
    """
    grid_s, order = loop.grid_s, loop.order
    closed, opened, closed_rate, opened_rate = loop.closed, loop.opened, loop.closed_rate, loop.opened_rate
    whole_s = grid_s * closed.shape[0]
    short_s = min(longest_s, whole_s)
    built, older, latest = int(memory[_BUILT]), int(memory[_OLDER]), int(memory[_LATEST])
    for k in range(_SLOTS):
        fades[k, _READY] = 0.0
    fading = physics.lag_s > 0.0 or physics.resonance_hz > 0.0
    dead = 0.5 * physics.deadband_deg + (physics.friction_deg / dc_gain if order == 1 else 0.0)
    insensitive = 0.5 * physics.insensitive_deg
    edge = max(dead, insensitive)
    per_rate, per_error = loop.error_per_rate_s / dc_gain, loop.load_per_error
    up, down = physics.rate_up_deg_s * per_rate, physics.rate_down_deg_s * per_rate
    sags = physics.deg_s_per_v < math.inf
    most, least = up, -down
    friction = physics.friction_deg / dc_gain * per_error
    rubs = order > 1 and (friction > 0.0 or physics.load_friction > 0.0)
    bends = edge > 0.0
    saturates = sags or up < math.inf or down < math.inf
    loaded = physics.airload_per_pa != 0.0 or physics.droop_deg != 0.0
    stop_upper, stop_lower = physics.stop_upper_deg / dc_gain, physics.stop_lower_deg / dc_gain
    blocked = stop_upper < math.inf or stop_lower > -math.inf
    natural, half = 2.0 * math.pi * physics.resonance_hz, 0.5 * physics.backlash_deg
    slews, rooted = physics.set_point_deg_s < math.inf, physics.knee_deg < math.inf
    per_knee = dc_gain / physics.knee_deg
    fastest, fastest_down = physics.follow_up_deg_s / dc_gain, physics.follow_down_deg_s / dc_gain
    lags = fastest < math.inf or fastest_down < math.inf
    turns = rubs or half > 0.0
    # Without any of these the deflection follows from the position at that instant.
    linked = lags or half > 0.0 or fading
    if slews or rooted or physics.load_friction > 0.0 or fading:
        whole_s = min(2.0 * short_s, whole_s)
    if not (bends or saturates or turns or lags or blocked):
        short_s = math.inf  # nothing ever switches
    c = 0
    if math.isnan(memory[_CLOCK]):
        start_deg, clock = memory[_STATIC], at_s[0]
        followed = (start_deg - physics.bias_deg) / physics.gain
        flexed, swing, played, static, lagged = followed, 0.0, followed, start_deg, start_deg
        y, v, torque, u, s = followed / dc_gain, 0.0, 0.0, followed / dc_gain, 0.0
        while c < effective_s.size and effective_s[c] <= clock:
            u, s = command_deg[c] + slope_deg_s[c] * (clock - effective_s[c]), slope_deg_s[c]
            c += 1
        wanted = u
        if slews:
            s = 0.0
    else:
        clock, y, v, torque, u = memory[_CLOCK], memory[_Y], memory[_V], memory[_TORQUE], memory[_U]
        s, wanted, followed, flexed = memory[_S], memory[_WANTED], memory[_FOLLOWED], memory[_FLEXED]
        swing, played, static, lagged = memory[_SWING], memory[_PLAYED], memory[_STATIC], memory[_LAGGED]
    for n in range(at_s.size):
        now = at_s[n]
        if sags:
            volt_limit = physics.deg_s_per_v * voltage_v[n] * per_rate
            most, least = min(up, volt_limit), -min(down, volt_limit)
        top, bottom = most + dead, least - dead
        while True:
            commanded = c < effective_s.size and effective_s[c] <= now
            # A command that arrives late takes effect at once.
            until = max(effective_s[c], clock) if commanded else now
            left = until - clock
            clock = until
            count, h = 0, left
            if left > _NO_STEP_S:
                count = 1 if left <= whole_s else math.ceil(left / whole_s - 1e-9)
                h = left / count
            wary, slot, is_new = h > short_s, -1, True
            while count > 0:
                if is_new:
                    is_new, slot = False, older
                    if abs(built_s[slot] - h) >= _SAME_STEP_S:  # most often two lengths take turns
                        slot = -1
                        for k in range(_SLOTS):
                            if abs(built_s[k] - h) < _SAME_STEP_S:
                                slot = k
                    if slot < 0 and built < _MOST_BUILT:
                        slot = built % _SLOTS
                        built_s[slot] = h
                        built += 1
                        fades[slot, _READY] = 0.0
                    if slot >= 0 and fades[slot, _READY] == 0.0:
                        build(table, 2 * slot, closed, closed_rate, grid_s, built_s[slot])
                        build(table, 2 * slot + 1, opened, opened_rate, grid_s, built_s[slot])
                        fade(fades, slot, physics.lag_s, natural, physics.resonance_damping, built_s[slot])
                        fades[slot, _READY] = 1.0
                    elif slot < 0 and fading:
                        fade(fades, _SLOTS, physics.lag_s, natural, physics.resonance_damping, h)
                    older, latest = latest, max(slot, 0)
                if slews:
                    s = max(min((wanted - u) / h, physics.set_point_deg_s), -physics.set_point_deg_s)
                middle = y + 0.5 * h * v
                error = u + 0.5 * h * s - middle
                bent = error
                if bends:
                    bent = max(error - dead, 0.0) + min(error + dead, 0.0)
                    if abs(error) < insensitive:
                        bent = 0.0
                if rooted:
                    bent /= math.sqrt(1.0 + abs(bent) * per_knee)
                held = bent > most or bent < least or (bends and bent == 0.0)
                pushed = max(min(bent, most), least) if held else bent - error
                load = 0.0
                if loaded:
                    load = -per_error * (
                        physics.airload_per_pa * pressure_pa[n] * middle
                        + physics.droop_deg * math.sin(middle * _PER_DEG)
                    )
                x = (y, v, torque, u, s, pushed, load)
                # Branches, because the processor foresees which it is; it would have to wait for an index.
                if slot >= 0 and held:
                    k, share = 2 * slot + 1, 1.0
                    y1, v1, torque1 = coasted(table, k, x)
                    by_y, by_v, by_torque = table[k, 0, 6], table[k, 1, 6], table[k, 2, 6]
                elif slot >= 0:
                    k, share = 2 * slot, 1.0
                    y1, v1, torque1 = row(table, k, 0, x), row(table, k, 1, x), row(table, k, 2, x)
                    by_y, by_v, by_torque = table[k, 0, 6], table[k, 1, 6], table[k, 2, 6]
                elif held:
                    y1, v1, torque1 = moved(opened, opened_rate, grid_s, h, x)
                else:
                    y1, v1, torque1 = moved(closed, closed_rate, grid_s, h, x)
                rested = False
                if rubs:
                    limit = friction
                    if physics.load_friction > 0.0:
                        limit += physics.load_friction * (
                            abs(torque) if order == 3 else abs(max(min(bent, most), least)) * per_error
                        )
                    if slot < 0:  # in proportion to the time between two steps of the grid
                        k = min(max(int(h / grid_s + 0.5), 1), closed.shape[0]) - 1
                        share = h / ((k + 1) * grid_s)
                        by_y, by_v, by_torque = closed[k, 0, 6] * share, closed[k, 1, 6], closed[k, 2, 6] * share
                        if held:
                            by_y, by_v, by_torque = opened[k, 0, 6] * share, opened[k, 1, 6], opened[k, 2, 6] * share
                    brake = max(min(-v1 / (by_v * share), limit), -limit)
                    rested = abs(brake) < limit
                    brake *= share
                    y1 += by_y * brake
                    v1 += by_v * brake
                    torque1 += by_torque * brake
                if wary:
                    begin, end = u - y, u + h * s - y1
                    low, high = min(begin, end, error), max(begin, end, error)
                    if (
                        (bends and (low <= edge < high or low < -edge <= high))
                        or (saturates and (low <= top < high or low < bottom <= high))
                        or (turns and (rested or v * v1 <= 0.0) and abs(y1 - y) >= _STILL_DEG)
                        or (lags and (followed != dc_gain * y or max(v, v1) > fastest or min(v, v1) < -fastest_down))
                        or (blocked and (max(y, y1) >= stop_upper or min(y, y1) <= stop_lower))
                    ):
                        left = count * h
                        count = math.ceil(left / short_s - 1e-9)
                        h, wary, is_new = left / count, False, True
                        continue
                count -= 1
                y, v, torque = y1, v1, torque1
                u += h * s
                if blocked:
                    if y > stop_upper:
                        y, v = stop_upper, min(v, 0.0)
                    elif y < stop_lower:
                        y, v = stop_lower, max(v, 0.0)
                if not linked:
                    continue
                before, followed = followed, dc_gain * y
                if lags:
                    followed = max(
                        min(followed, before + physics.follow_up_deg_s * h), before - physics.follow_down_deg_s * h
                    )
                if natural > 0.0:
                    flexed, swing = flexed_tip(
                        natural, physics.resonance_damping, h, fades[slot], (before, followed), (flexed, swing)
                    )
                else:
                    flexed = followed
                played = max(min(played, flexed + half), flexed - half)
                if physics.lag_s > 0.0:
                    before, static = static, _deflected(physics, played)
                    drift = (static - before) / h * physics.lag_s
                    lagged = static - drift + fades[slot, 0] * (lagged - before + drift)
            if not commanded:
                break
            wanted = command_deg[c]
            if not slews:
                u, s = wanted, slope_deg_s[c]
            c += 1
        if not linked:
            played = dc_gain * y
        if physics.lag_s <= 0.0:
            lagged = _deflected(physics, played)
        if physics.output_step_deg > 0.0:
            result[n] = physics.output_step_deg * math.floor(lagged / physics.output_step_deg + 0.5)
        else:
            result[n] = lagged
    if not linked:
        followed, flexed, static = played, played, lagged
    memory[_CLOCK], memory[_Y], memory[_V], memory[_TORQUE], memory[_U] = clock, y, v, torque, u
    memory[_S], memory[_WANTED], memory[_FOLLOWED], memory[_FLEXED] = s, wanted, followed, flexed
    memory[_SWING], memory[_PLAYED], memory[_STATIC], memory[_LAGGED] = swing, played, static, lagged
    memory[_CURSOR], memory[_BUILT], memory[_OLDER], memory[_LATEST] = c, built, older, latest


@njit(cache=True, error_model="numpy")
def framed(
    time_s: FloatArray, command_deg: FloatArray, slope_deg_s: FloatArray, period_s: float, phase: float
) -> tuple[FloatArray, FloatArray]:
    """Commands as pulse frames carry them: the one in force when each frame begins, held until the next."""
    first = math.ceil(time_s[0] / period_s - phase)
    count = max(math.floor(time_s[-1] / period_s - phase) - first + 2, 1)
    frame_s, frame_deg = np.empty(count), np.empty(count)
    c = 0
    for k in range(count):
        frame_s[k] = (first + k + phase) * period_s
        while c + 1 < time_s.size and time_s[c + 1] <= frame_s[k]:
            c += 1
        frame_deg[k] = command_deg[c] + slope_deg_s[c] * max(frame_s[k] - time_s[c], 0.0)
    return frame_s, frame_deg
