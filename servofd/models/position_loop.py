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

from servofd.models.physics import Loop, Physics
from servofd.types import FloatArray

__all__ = ["framed", "heard", "new_memory", "run", "step_matrices"]

_NO_STEP_S = 1e-10
_SAME_STEP_S = 1e-9
"""Steps that differ by less share their matrices: less than 1e-6 deg at 1000 deg/s."""
_STILL_DEG = 1e-5
_SLOTS, _MOST_BUILT = 4, 64
"""Matrices of that many lengths of step are kept; where the stamps jitter, none are made any more after so many."""
_PER_DEG = math.pi / 180.0
_STATES = 15
_CLOCK, _Y, _V, _TORQUE, _U, _S, _WANTED, _FOLLOWED, _FLEXED, _SWING, _PLAYED, _STATIC, _LAGGED, _CURSOR, _BUILT = (
    range(_STATES)
)


def new_memory(start_deg: float) -> FloatArray:
    """Memory of a servo at rest where its surface was measured [deg], shape (19,); `run` starts at its first instant.

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


@njit(cache=True, error_model="numpy")
def step_matrices(rate: FloatArray, grid_s: float, count: int) -> FloatArray:
    """States after 1..count grid steps, shape (count, 3, 7), from their derivatives, shape (3, 7)."""
    size = 7
    whole = np.zeros((size, size))
    whole[:3] = rate
    whole[3, 4] = 1.0  # the command runs on at its slope
    one = np.eye(size)
    term = np.eye(size)
    fine = grid_s / 16.0
    for k in range(1, 9):
        term = term @ whole * (fine / k)
        one += term
    for _ in range(4):
        one = one @ one
    steps = np.zeros((count, 3, size))
    power = np.eye(size)
    for k in range(count):
        power = power @ one
        steps[k] = power[:3]
    return steps


@njit(cache=True, error_model="numpy", inline="always")
def _row(m: FloatArray, k: int, i: int, x: tuple[float, ...]) -> float:
    """One state after step `k` of a table, from states and inputs."""
    return float(
        m[k, i, 0] * x[0]
        + m[k, i, 1] * x[1]
        + m[k, i, 2] * x[2]
        + m[k, i, 3] * x[3]
        + m[k, i, 4] * x[4]
        + m[k, i, 5] * x[5]
        + m[k, i, 6] * x[6]
    )


@njit(cache=True, error_model="numpy", inline="always")
def _slope(r: FloatArray, x: tuple[float, ...]) -> tuple[float, float, float]:
    """Derivatives of the three states; most entries of the matrix are zero by construction."""
    return (
        r[0, 0] * x[0] + r[0, 1] * x[1] + r[0, 3] * x[3] + r[0, 5] * x[5] + r[0, 6] * x[6],
        r[1, 0] * x[0] + r[1, 1] * x[1] + r[1, 2] * x[2] + r[1, 3] * x[3] + r[1, 5] * x[5] + r[1, 6] * x[6],
        r[2, 0] * x[0] + r[2, 1] * x[1] + r[2, 2] * x[2] + r[2, 3] * x[3] + r[2, 5] * x[5],
    )


@njit(cache=True, error_model="numpy", inline="always")
def _moved(steps: FloatArray, rate: FloatArray, grid_s: float, h: float, x: tuple[float, ...]) -> tuple[float, ...]:
    """States after `h`: whole grid steps from the table, the rest as a series."""
    count = min(int(h / grid_s + 1e-6), steps.shape[0])
    rest = h - count * grid_s
    y, v, torque = x[0], x[1], x[2]
    if count > 0:
        k = count - 1
        y, v, torque = _row(steps, k, 0, x), _row(steps, k, 1, x), _row(steps, k, 2, x)
    if rest > _NO_STEP_S:
        # Only the first derivative sees the inputs, the second the command's slope; then they are used up.
        u = x[3] + x[4] * count * grid_s
        d1 = _slope(rate, (y, v, torque, u, 0.0, x[5], x[6]))
        d2 = _slope(rate, (d1[0], d1[1], d1[2], x[4], 0.0, 0.0, 0.0))
        d3 = _slope(rate, (d2[0], d2[1], d2[2], 0.0, 0.0, 0.0, 0.0))
        d4 = _slope(rate, (d3[0], d3[1], d3[2], 0.0, 0.0, 0.0, 0.0))
        y += rest * (d1[0] + rest / 2.0 * (d2[0] + rest / 3.0 * (d3[0] + rest / 4.0 * d4[0])))
        v += rest * (d1[1] + rest / 2.0 * (d2[1] + rest / 3.0 * (d3[1] + rest / 4.0 * d4[1])))
        torque += rest * (d1[2] + rest / 2.0 * (d2[2] + rest / 3.0 * (d3[2] + rest / 4.0 * d4[2])))
    return y, v, torque


@njit(cache=True, error_model="numpy")
def _build(slots: FloatArray, slot: int, steps: FloatArray, rate: FloatArray, grid_s: float, h: float) -> None:
    """Matrix of a step of length `h`, column by column."""
    for j in range(7):
        one = np.zeros(7)
        one[j] = 1.0
        unit = (one[0], one[1], one[2], one[3], one[4], one[5], one[6])
        slots[slot, 0, j], slots[slot, 1, j], slots[slot, 2, j] = _moved(steps, rate, grid_s, h, unit)


@njit(cache=True, error_model="numpy", inline="always")
def _flexed(
    natural: float, damping: float, h: float, decay: FloatArray, drive: tuple[float, float], tip: tuple[float, float]
) -> tuple[float, float]:
    """Position and speed of a flexible tip whose root moves straight from one position to the other.

    `decay` holds cosine and sine of its free swing over `h`, as far as it dies away.
    """
    slope = (drive[1] - drive[0]) / h
    lag = 2.0 * damping / natural * slope
    turn = natural * math.sqrt(1.0 - damping * damping)
    away, speed = tip[0] - (drive[0] - lag), tip[1] - slope
    swing = (speed + damping * natural * away) / turn
    position = drive[1] - lag + away * decay[1] + swing * decay[2]
    return position, slope + speed * decay[1] - (away * turn + damping * natural * swing) * decay[2]


@njit(cache=True, error_model="numpy")
def _fade(fades: FloatArray, slot: int, lag_s: float, natural: float, damping: float, h: float) -> None:
    """What is left after `h` of a sensor's lag, and cosine and sine of the free swing of a flexible tip."""
    if lag_s > 0.0:
        fades[slot, 0] = math.exp(-h / lag_s)
    decay, turn = math.exp(-damping * natural * h), natural * math.sqrt(1.0 - damping * damping)
    fades[slot, 1], fades[slot, 2] = decay * math.cos(turn * h), decay * math.sin(turn * h)


@njit(cache=True, error_model="numpy", inline="always")
def _piece(error: float, dead: float, most: float, least: float) -> int:
    """Straight piece of the characteristic on which an error lies: 0 is a dead band, 2 and -2 are saturations."""
    return int((error > dead) - (error < -dead) + (error > most) - (error < least))


@njit(cache=True, error_model="numpy", nogil=True, fastmath={"contract", "nsz", "arcp"})
def run(  # noqa: C901, PLR0912, PLR0915 - one function, because calls would take most of its time
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
    result = np.empty(at_s.size)
    closed, opened, grid_s, order = loop.closed, loop.opened, loop.grid_s, loop.order
    whole_s = grid_s * closed.shape[0]
    short_s = min(longest_s, whole_s)
    built_s, built = memory[_STATES:], int(memory[_BUILT])
    closed_slot, opened_slot = np.empty((_SLOTS, 3, 7)), np.empty((_SLOTS, 3, 7))
    # The last row, which is also that of slot -1, is for steps that are not kept.
    fades, fading = np.zeros((_SLOTS + 1, 3)), physics.lag_s > 0.0 or physics.resonance_hz > 0.0
    dead = 0.5 * physics.deadband_deg + (physics.friction_deg / dc_gain if order == 1 else 0.0)
    insensitive = 0.5 * physics.insensitive_deg
    per_rate, per_error = loop.error_per_rate_s / dc_gain, loop.load_per_error
    up, down = physics.rate_up_deg_s * per_rate, physics.rate_down_deg_s * per_rate
    friction = physics.friction_deg / dc_gain * per_error
    rubs = order > 1 and (friction > 0.0 or physics.load_friction > 0.0)
    bends = dead > 0.0 or insensitive > 0.0
    loaded = physics.airload_per_pa != 0.0 or physics.droop_deg != 0.0
    stop_upper, stop_lower = physics.stop_upper_deg / dc_gain, physics.stop_lower_deg / dc_gain
    natural, half = 2.0 * math.pi * physics.resonance_hz, 0.5 * physics.backlash_deg
    slews, rooted = physics.set_point_deg_s < math.inf, physics.knee_deg < math.inf
    knee = physics.knee_deg / dc_gain
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
    for slot in range(_SLOTS):
        if built_s[slot] > 0.0:
            _build(closed_slot, slot, closed, loop.closed_rate, grid_s, built_s[slot])
            _build(opened_slot, slot, opened, loop.opened_rate, grid_s, built_s[slot])
            _fade(fades, slot, physics.lag_s, natural, physics.resonance_damping, built_s[slot])
    edge = max(dead, insensitive)
    fastest, fastest_down = physics.follow_up_deg_s / dc_gain, physics.follow_down_deg_s / dc_gain
    lags = fastest < math.inf or fastest_down < math.inf
    if slews or rooted or physics.load_friction > 0.0 or natural > 0.0 or physics.lag_s > 0.0:
        whole_s = min(2.0 * short_s, whole_s)
    for n in range(at_s.size):
        now = at_s[n]
        volt_limit = physics.deg_s_per_v * voltage_v[n] * per_rate if physics.deg_s_per_v < math.inf else math.inf
        most, least = min(up, volt_limit), -min(down, volt_limit)
        while True:
            commanded = c < effective_s.size and effective_s[c] <= now
            # A command that arrives late takes effect at once.
            until = max(effective_s[c], clock) if commanded else now
            left = until - clock
            clock = until
            cap = whole_s
            while left > _NO_STEP_S:
                h = left / math.ceil(left / cap - 1e-9)
                slot = -1
                for k in range(_SLOTS):
                    if abs(built_s[k] - h) < _SAME_STEP_S:
                        slot = k
                if slot < 0 and built < _MOST_BUILT:
                    slot = built % _SLOTS
                    _build(closed_slot, slot, closed, loop.closed_rate, grid_s, h)
                    _build(opened_slot, slot, opened, loop.opened_rate, grid_s, h)
                    built_s[slot] = h
                    built += 1
                    _fade(fades, slot, physics.lag_s, natural, physics.resonance_damping, h)
                elif slot < 0 and fading:
                    _fade(fades, _SLOTS, physics.lag_s, natural, physics.resonance_damping, h)
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
                    bent /= math.sqrt(1.0 + abs(bent) / knee)
                held = bent > most or bent < least or (bends and bent == 0.0)
                pushed = max(min(bent, most), least) if held else bent - error
                load = 0.0
                if loaded:
                    load = -per_error * (
                        physics.airload_per_pa * pressure_pa[n] * middle
                        + physics.droop_deg * math.sin(middle * _PER_DEG)
                    )
                x = (y, v, torque, u, s, pushed, load)
                if slot >= 0:
                    steps = opened_slot if held else closed_slot
                    y1, v1, torque1 = _row(steps, slot, 0, x), _row(steps, slot, 1, x), _row(steps, slot, 2, x)
                elif held:
                    y1, v1, torque1 = _moved(opened, loop.opened_rate, grid_s, h, x)
                else:
                    y1, v1, torque1 = _moved(closed, loop.closed_rate, grid_s, h, x)
                rested = False
                if rubs:
                    limit = friction
                    if physics.load_friction > 0.0:
                        limit += physics.load_friction * (
                            abs(torque) if order == 3 else abs(max(min(bent, most), least)) * per_error
                        )
                    steps = opened if held else closed
                    # Response to a deceleration: exact on the grid, in proportion to the time between.
                    k = min(max(int(h / grid_s + 0.5), 1), steps.shape[0]) - 1
                    share = h / ((k + 1) * grid_s)
                    brake = max(min(-v1 / (steps[k, 1, 6] * share), limit), -limit)
                    rested = abs(brake) < limit
                    y1 += steps[k, 0, 6] * share * share * brake
                    v1 += steps[k, 1, 6] * share * brake
                    torque1 += steps[k, 2, 6] * share * share * brake
                if cap > short_s:
                    still = abs(y1 - y) < _STILL_DEG
                    turned = v * v1 <= 0.0 and not still
                    top, bottom = most + dead, least - dead
                    piece = _piece(error, edge, top, bottom)
                    if (
                        _piece(u - y, edge, top, bottom) != piece
                        or _piece(u + h * s - y1, edge, top, bottom) != piece
                        or (turned and (rubs or half > 0.0))
                        or (rested and not still)
                        or (lags and (followed != dc_gain * y or max(v, v1) > fastest or min(v, v1) < -fastest_down))
                        or max(y, y1) >= stop_upper
                        or min(y, y1) <= stop_lower
                    ):
                        cap = short_s
                        continue
                left -= h
                y, v, torque = y1, v1, torque1
                u += h * s
                if y > stop_upper:
                    y, v = stop_upper, min(v, 0.0)
                elif y < stop_lower:
                    y, v = stop_lower, max(v, 0.0)
                before, position = followed, dc_gain * y
                followed = max(
                    min(position, before + physics.follow_up_deg_s * h), before - physics.follow_down_deg_s * h
                )
                if natural > 0.0:
                    flexed, swing = _flexed(
                        natural, physics.resonance_damping, h, fades[slot], (before, followed), (flexed, swing)
                    )
                else:
                    flexed = followed
                played = max(min(played, flexed + half), flexed - half)
                before = static
                static = (
                    physics.gain
                    * played
                    * (1.0 + played * (physics.quadratic_per_deg + played * physics.cubic_per_deg2))
                )
                static = max(min(static, physics.upper_deg), physics.lower_deg) + physics.bias_deg
                if physics.lag_s > 0.0:
                    drift = (static - before) / h * physics.lag_s
                    lagged = static - drift + fades[slot, 0] * (lagged - before + drift)
                else:
                    lagged = static
            if not commanded:
                break
            wanted = command_deg[c]
            if not slews:
                u, s = wanted, slope_deg_s[c]
            c += 1
        if physics.output_step_deg > 0.0:
            result[n] = physics.output_step_deg * math.floor(lagged / physics.output_step_deg + 0.5)
        else:
            result[n] = lagged
    memory[_CLOCK], memory[_Y], memory[_V], memory[_TORQUE], memory[_U] = clock, y, v, torque, u
    memory[_S], memory[_WANTED], memory[_FOLLOWED], memory[_FLEXED] = s, wanted, followed, flexed
    memory[_SWING], memory[_PLAYED], memory[_STATIC], memory[_LAGGED] = swing, played, static, lagged
    memory[_CURSOR], memory[_BUILT] = c, built
    return result


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
