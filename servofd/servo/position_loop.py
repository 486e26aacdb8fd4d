"""The compiled simulation: one servo with all effects, each at its physical place, on true time stamps.

Between events (a command taking effect, a position being measured) the loop is advanced by exact matrices. Dead band
and saturation are straight pieces of slope 1 or 0, chosen by the error in the middle of each step, so that within
a piece nothing is approximated. Friction is the constant deceleration that would stop the servo by the end of the
step, as far as its strength allows; of a servo that it holds, only the torque winds up (docs/explain.md, E5 to E7).
A step goes from event to event unless something switches on its way (the error crosses an edge, the motion reverses):
only then is it taken again in short ones. What hangs on the shaft is carried on afterwards (`servofd.servo.linkage`).
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import numpy as np

from logparsers import compiled as compiler
from servofd.core.types import FloatArray
from servofd.servo.linkage import LINKAGE, begin_linkage, carried, deflected, rest_linkage
from servofd.servo.loop_steps import ROW, build, coasted, column, compiled, inner, row, sine
from servofd.servo.physics import Loop, Physics

_NO_STEP_S = 1e-10
_SAME_STEP_S = 1e-9
"""Steps that differ by less share their matrices: less than 1e-6 deg at 1000 deg/s."""
_STILL_DEG = 1e-5
_SLOTS = 8
"""Matrices of that many lengths of step are kept."""
_PER_DEG = math.pi / 180.0
_NEAR_LIMIT = 0.8
"""Share of its largest speed from which on an output that follows is told of steps of the matrices' grid: between them
the shaft is a cubic to 1e-8 deg."""
_NOTES, _MOST_STEPS = 512, 128
"""Steps of the shaft that are noted for the linkage, and the most that are taken at once."""
_STATES = 12
(
    _CLOCK,
    _Y,
    _V,
    _TORQUE,
    _U,
    _S,
    _WANTED,
    _CURSOR,
    _BUILT,
    _OLDER,
    _LATEST,
    _NOTED,
) = range(_STATES)


def new_memory(start_deg: float) -> FloatArray:
    """Memory of a servo at rest where its surface was measured [deg], shape (k,); `run` starts at its first instant.

    Time [s], the loop's states, command in force and its slope, wanted set point, how many of the commands have taken
    effect, the lengths of step whose matrices are kept, so that a run in pieces takes the same steps as the run in one
    go, and the linkage's.
    """
    memory = np.zeros(_STATES + _SLOTS + LINKAGE)
    memory[_CLOCK] = np.nan
    memory[_STATES : _STATES + _SLOTS] = -1.0
    memory[_Y] = start_deg
    return memory


def stretch(memory: FloatArray, loop: Loop, scale: float) -> None:
    """Go on from the same position with all poles scaled, as if time had been stretched."""
    memory[_V] *= scale
    if not loop.filters:  # else the third state is a command
        memory[_TORQUE] *= scale * scale


def received(memory: FloatArray) -> int:
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
    load: FloatArray | None = None,
) -> FloatArray:
    """Measured position at the rising times `at_s` [deg], shape (m,), from where the memory stands.

    The memory is moved on: run again with later times, and with the commands from its cursor on. From memories of shape
    (p, k), one per row, positions are of shape (p, m). A load that was logged acts until the instant it is given for.
    """
    known = np.zeros(at_s.size) if load is None else load
    given = (effective_s, command_deg, slope_deg_s, at_s, pressure_pa, voltage_v, known)
    inputs = tuple(_plain(each) for each in given)
    memories = np.atleast_2d(memory)
    result = np.empty((memories.shape[0], at_s.size))
    room = np.empty((2 * _SLOTS, 3 * ROW)), np.empty((_NOTES, 5))
    _run(tuple(physics), tuple(loop), dc_gain, longest_s, inputs, memories, *room, result)
    return result if memory.ndim > 1 else result[0]


def _plain(values: FloatArray) -> FloatArray:
    """Values as all others lie in memory: what a log lends is read-only, for which everything is compiled once more."""
    return values if values.flags.carray else np.array(values)


@compiled
def _run(
    sizes: tuple[float, ...],
    matrices: tuple[Any, ...],
    dc_gain: float,
    longest_s: float,
    inputs: tuple[FloatArray, ...],
    memories: FloatArray,
    table: FloatArray,
    notes: FloatArray,
    results: FloatArray,
) -> None:
    """The same with room for matrices, for steps of the shaft, and for the results.

    Sizes and matrices come without their names, which took 10 us to recognize, at every call.
    """
    physics, loop = Physics(*sizes), Loop(*matrices)
    for k in range(memories.shape[0]):
        _run_from(physics, loop, dc_gain, longest_s, inputs, memories[k], table, notes, results[k])


@inner
def _run_from(
    physics: Physics,
    loop: Loop,
    dc_gain: float,
    longest_s: float,
    inputs: tuple[FloatArray, ...],
    memory: FloatArray,
    table: FloatArray,
    notes: FloatArray,
    result: FloatArray,
) -> None:
    """The same from one memory."""
    link = memory[_STATES + _SLOTS :]
    linked = begin_linkage(link, physics)
    for k in range(2 * _SLOTS):
        table[k, 0] = np.nan
    if math.isnan(memory[_CLOCK]):
        start_deg = memory[_Y]
        shaft = (start_deg - physics.bias_deg) / physics.gain
        rest_linkage(link, shaft, start_deg)
        memory[_Y] = memory[_U] = shaft / dc_gain
        if loop.filters:
            memory[_TORQUE] = memory[_Y]
    first = np.int64(0)  # a literal is a type of its own, for which the rest would be compiled as well
    while first < result.size:
        last = _turned(physics, loop, dc_gain, longest_s, inputs, memory, table, notes, linked, first, result)
        if linked:
            carried(link, notes, int(memory[_NOTED]), result, first, last)
        first = last
    if not linked:
        for n in range(result.size):
            result[n] = deflected(link, result[n])
        rest_linkage(link, dc_gain * memory[_Y], result[-1])
    step_deg = physics.output_step_deg
    if step_deg > 0.0:
        for n in range(result.size):
            result[n] = step_deg * math.floor(result[n] / step_deg + 0.5)


@inner
def _turned(  # noqa: C901, PLR0912, PLR0915 - one function, because calls would take most of its time
    physics: Physics,
    loop: Loop,
    dc_gain: float,
    longest_s: float,
    inputs: tuple[FloatArray, ...],
    memory: FloatArray,
    table: FloatArray,
    notes: FloatArray,
    linked: bool,
    first: int,
    result: FloatArray,
) -> int:
    """Turn the shaft from one of the instants until there is no more room for notes; the instant after the last.

    Its positions at the instants are the result, or, if it is noted for a linkage, how many steps were taken until
    then. Of the matrices there are two for each length of step: while the error acts, and while it does not.
    """
    effective_s, command_deg, slope_deg_s, at_s, pressure_pa, voltage_v, known = inputs
    built_s = memory[_STATES:]
    grid_s, order, stiffness = loop.grid_s, loop.order, loop.closed_rate[loop.order - 1, 5]
    filters = loop.filters
    fast_up, fast_down = physics.speed_up_deg_s / dc_gain, -physics.speed_down_deg_s / dc_gain
    tires = physics.speed_deg_s_per_v < math.inf
    races = tires or fast_up < math.inf or fast_down > -math.inf
    grips, per_speed = physics.stribeck > 0.0, dc_gain / physics.stribeck_deg_s
    closed, opened = loop.closed, loop.opened
    by_speed, loss = -loop.closed_rate[2, 1], -loop.closed_rate[2, 2]
    whole_s = grid_s * (closed.shape[0] - 1)
    short_s = min(longest_s, whole_s)
    built, older, latest = int(memory[_BUILT]), int(memory[_OLDER]), int(memory[_LATEST])
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
    weighs = physics.droop_deg != 0.0
    loaded = weighs or physics.airload_per_pa != 0.0 or physics.load_deg != 0.0
    stop_upper, stop_lower = physics.stop_upper_deg / dc_gain, physics.stop_lower_deg / dc_gain
    blocked = stop_upper < math.inf or stop_lower > -math.inf
    slews, rooted = physics.set_point_deg_s < math.inf, physics.knee_deg < math.inf
    per_knee = dc_gain / physics.knee_deg
    if slews or rooted:
        # Half of the usual step, whatever the shorter ones are.
        whole_s = min((5.0 if insensitive > 0.0 else 2.0) * short_s, whole_s)
    if not (bends or saturates or rubs or blocked or races):
        short_s = math.inf  # nothing ever switches
    # An output that follows no faster than it can is told all of a shaft's motion that may be too fast for it.
    near_up, near_down = (
        _NEAR_LIMIT * physics.follow_up_deg_s / dc_gain,
        -_NEAR_LIMIT * physics.follow_down_deg_s / dc_gain,
    )
    fine_s = grid_s if near_up < math.inf or near_down > -math.inf else math.inf
    most_s = _MOST_STEPS * min(short_s, whole_s, fine_s)
    y, v, torque, u = memory[_Y], memory[_V], memory[_TORQUE], memory[_U]
    s, wanted, clock = memory[_S], memory[_WANTED], memory[_CLOCK]
    c = int(memory[_CURSOR]) if first > 0 else 0
    if math.isnan(clock):
        clock = at_s[0]
        while c < effective_s.size and effective_s[c] <= clock:
            u, s = command_deg[c] + slope_deg_s[c] * (clock - effective_s[c]), slope_deg_s[c]
            c += 1
        wanted = u
        if slews:
            s = 0.0
    point, most_deg = u, 0.0
    noted, last = 0, first
    while last < at_s.size:
        n = last
        now = at_s[n]
        if sags:
            volt_limit = physics.deg_s_per_v * voltage_v[n] * per_rate
            most, least = min(up, volt_limit), -min(down, volt_limit)
        if tires:
            volt_limit = physics.speed_deg_s_per_v * voltage_v[n]
            fast_up = min(physics.speed_up_deg_s, volt_limit) / dc_gain
            fast_down = -min(physics.speed_down_deg_s, volt_limit) / dc_gain
        top, bottom = most + dead, least - dead
        while noted <= _NOTES - _MOST_STEPS:
            commanded = c < effective_s.size and effective_s[c] <= now
            # A command that arrives late takes effect at once.
            until = max(effective_s[c], clock) if commanded else now
            pauses = until - clock > most_s
            if pauses:
                until = clock + most_s
            left = until - clock
            clock = until
            count, h = 0, left
            if left > _NO_STEP_S:
                count = 1 if left <= whole_s else math.ceil(left / whole_s - 1e-9)
                h = left / count
            wary, slot, is_new = h > min(short_s, fine_s), older, True
            while count > 0:
                if is_new:
                    is_new, slot = False, older
                    if abs(built_s[slot] - h) >= _SAME_STEP_S:  # most often two lengths take turns
                        slot = -1
                        for k in range(_SLOTS):
                            if abs(built_s[k] - h) < _SAME_STEP_S:
                                slot = k
                    if slot < 0:
                        slot = built % _SLOTS
                        built_s[slot] = h
                        built += 1
                        table[2 * slot, 0] = table[2 * slot + 1, 0] = np.nan
                    older, latest = latest, slot
                if slews:
                    most_deg, travel_deg = physics.set_point_deg_s * h, wanted - point
                    if abs(travel_deg) < most_deg:  # where it is on the average of a step in which it arrives
                        u, s = wanted - 0.5 * travel_deg * abs(travel_deg) / most_deg, 0.0
                    else:
                        u, s = point, math.copysign(physics.set_point_deg_s, travel_deg)
                middle = y + 0.5 * h * v
                error, come, gone = u + 0.5 * h * s - middle, u, u + h * s
                if filters:  # what the slow pole lets through of the command takes its place, in the third state
                    k = 2 * slot
                    if math.isnan(table[k, 0]):
                        build(table, k, closed, grid_s, built_s[slot])
                    left, filled, ramped = table[k, 2 * ROW + 2], table[k, 2 * ROW + 3], table[k, 2 * ROW + 4]
                    come, gone = torque, left * torque + filled * u + ramped * s
                    error = 0.5 * (come + gone) - middle
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
                    load = physics.airload_per_pa * pressure_pa[n] * middle - physics.load_deg * known[n]
                    if weighs:
                        load += physics.droop_deg * sine((middle - physics.hangs_deg) * _PER_DEG)
                    load *= -per_error
                x = (y, v, torque, u, s, pushed, load)
                limit, sticks, wound = friction, False, 0.0
                if rubs:
                    if grips:
                        slip = v * per_speed
                        limit *= 1.0 + physics.stribeck * math.exp(-slip * slip)
                    rest_limit = limit
                    if order == 3 and physics.load_friction > 0.0:  # by the torque in mid-step
                        grows = stiffness * max(min(bent, most), least) - by_speed * v - loss * torque
                        limit += physics.load_friction * abs(torque + 0.5 * h * grows)
                    elif order != 3:
                        limit += physics.load_friction * abs(max(min(bent, most), least)) * per_error
                    if v == 0.0:
                        acts, grows = (pushed, 0.0) if held else (pushed + come - y, (gone - come) / h)
                        before, wound = stiffness * acts, stiffness * (acts + h * grows)
                        if order == 3:
                            if math.isnan(table[2 * slot, 0]):
                                build(table, 2 * slot, closed, grid_s, built_s[slot])
                            left, filled, ramped = column(table, 2 * slot, ROW - 1)
                            before, wound = torque, left * torque + filled * acts + ramped * grows
                        least_limit, most_limit = limit, limit
                        if order == 3:
                            least_limit = rest_limit + physics.load_friction * abs(before)
                            most_limit = rest_limit + physics.load_friction * abs(wound)
                        sticks = abs(before + load) <= least_limit and abs(wound + load) <= most_limit
                # Branches, because the processor foresees which it is; it would have to wait for an index.
                if sticks:
                    y1, v1, torque1 = y, 0.0, wound if order == 3 else torque
                elif held:
                    k = 2 * slot + 1
                    if math.isnan(table[k, 0]):
                        build(table, k, opened, grid_s, built_s[slot])
                    y1, v1, torque1 = coasted(table, k, x)
                    by_y, by_v, by_torque = column(table, k, 6)
                else:
                    k = 2 * slot
                    if math.isnan(table[k, 0]):
                        build(table, k, closed, grid_s, built_s[slot])
                    y1, v1, torque1 = row(table, k, 0, x), row(table, k, 1, x), row(table, k, 2, x)
                    by_y, by_v, by_torque = column(table, k, 6)
                rested = False
                if rubs and not sticks:
                    brake = max(min(-v1 / by_v, limit), -limit)
                    rested = abs(brake) < limit
                    y1 += by_y * brake
                    v1 += by_v * brake
                    torque1 += by_torque * brake
                    if rested:
                        v1 = 0.0
                if filters:
                    torque1 = gone
                raced = False
                if races and not sticks and not (fast_down <= v1 <= fast_up):
                    # Held back at its fastest from where it came to be; until then its speed grew evenly.
                    raced = v != (fast_up if v1 > 0.0 else fast_down)
                    fastest = fast_up if v1 > 0.0 else fast_down
                    grown = min(max((fastest - v) / (v1 - v), 0.0), 1.0) if v1 != v else 0.0
                    y1, v1 = y + h * (0.5 * grown * (v + fastest) + (1.0 - grown) * fastest), fastest
                if wary:
                    begin, end = come - y, gone - y1
                    low, high = min(begin, end, error), max(begin, end, error)
                    part_s, mean = short_s, (y1 - y) / h
                    if h > fine_s and (max(v, v1, mean) > near_up or min(v, v1, mean) < near_down):
                        part_s = fine_s
                    if part_s == fine_s or (
                        h > short_s
                        and (
                            (bends and (low <= edge < high or low < -edge <= high))
                            or (saturates and (low <= top < high or low < bottom <= high))
                            or (rubs and not sticks and (rested or v * v1 <= 0.0) and abs(y1 - y) >= _STILL_DEG)
                            or (blocked and (max(y, y1) >= stop_upper or min(y, y1) <= stop_lower))
                            or raced
                            or (races and (v in (fast_up, fast_down)) and v1 != v)
                        )
                    ):
                        clock -= (count - 1) * h
                        pauses = True
                        count = math.ceil(h / part_s - 1e-9)
                        h, wary, is_new = h / count, False, True
                        continue
                count -= 1
                u += h * s
                if slews:
                    point += max(min(wanted - point, most_deg), -most_deg)
                    u = point
                if blocked:
                    if y1 > stop_upper:
                        y1, v1 = stop_upper, min(v1, 0.0)
                    elif y1 < stop_lower:
                        y1, v1 = stop_lower, max(v1, 0.0)
                if linked and noted == notes.shape[0]:  # it chatters more often than is noted: the last note goes on
                    notes[noted - 1, 0] += h
                    notes[noted - 1, 3], notes[noted - 1, 4] = dc_gain * y1, dc_gain * v1
                elif linked:
                    notes[noted, 0], notes[noted, 1], notes[noted, 3] = h, dc_gain * y, dc_gain * y1
                    notes[noted, 2], notes[noted, 4] = dc_gain * v, dc_gain * v1
                    if order == 1 and fine_s == math.inf:
                        notes[noted, 2] = notes[noted, 4] = dc_gain * (y1 - y) / h
                    elif order == 1:
                        notes[noted, 2] = dc_gain * (stiffness * (pushed if held else pushed + come - y) + load)
                        notes[noted, 4] = dc_gain * (stiffness * (pushed if held else pushed + gone - y1) + load)
                    noted += 1
                y, v, torque = y1, v1, torque1
            if pauses:
                continue
            if not commanded:
                result[n] = noted if linked else dc_gain * y
                last += 1
                break
            wanted = command_deg[c]
            if not slews:
                u, s = wanted, slope_deg_s[c]
            c += 1
        if last == n:
            break
    memory[_CLOCK], memory[_Y], memory[_V], memory[_TORQUE], memory[_U] = clock, y, v, torque, u
    memory[_S], memory[_WANTED] = s, wanted
    memory[_CURSOR], memory[_BUILT], memory[_OLDER], memory[_LATEST] = c, built, older, latest
    memory[_NOTED] = noted
    return last


@partial(compiler.compiled, error_model="numpy")
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
