"""The family of servos that a calibration fits, simulated beside its own sensitivities.

A geared motor behind a proportional loop: torque in proportion to the position error up to a limit, back-EMF and
damping in proportion to speed, Coulomb friction, a hinge moment in proportion to dynamic pressure, play between motor
and surface, and a reading that may be bent, off and late. All torques are written as the position error that would
balance them, so that friction and load are in degrees:

    v' = omega^2 (s sat(e, E) - load - friction sign(v)) - 2 zeta omega v,    E = 2 zeta R / omega

with e = gain * command(t - delay) - x less its dead band, and s the share of its torque that the motor has (supply
over the usual one). With E so, the largest speed is R. The surface is carried along within its play and is pushed
through it to the loaded side by the air.

The command is averaged over each step, so that the position depends smoothly on the delay.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np

from logparsers.compiled import compiled
from servofd.aircraft.priors import FITTED, PRIORS

if TYPE_CHECKING:
    from servofd.core.types import FloatArray

PRESSURE_PA: Final = 300.0
"""Dynamic pressure that loads refer to: 22 m/s at sea level."""
REACH_DEG: Final = 25.0
"""Deflection that bends of the reading refer to, or the largest one seen."""
_STEP_S: Final = 0.002
LONGEST_PAUSE_S: Final = 5.0
"""Between positions; after it the simulation begins anew from the position."""


_GAIN, _BIAS, _DELAY, _OMEGA, _ZETA, _RATE, _DEAD, _FRICTION, _PLAY, _HINGE, _HINGE0, _BEND2, _BEND3 = range(FITTED)
_POWER = FITTED
_SIMULATED: Final = (_GAIN, _OMEGA, _ZETA, _RATE, _DEAD, _FRICTION, _PLAY, _HINGE, _HINGE0)
"""Parameters whose sensitivities need a simulation of their own; those of the others are known from the position."""
PATTERNS: Final = ("weak", "poles", "play", "dead")
"""Finite changes: half the torque, half of all poles, 2 deg of play, 1.5 deg of dead band."""
_TRACKS: Final = 1 + len(_SIMULATED)


def variants(theta: FloatArray, *, patterns: bool = True) -> FloatArray:
    """Servos to be simulated side by side, shape (V, 14): the servo itself, one per sensitivity, one per pattern.

    Examples
    --------
    >>> theta = np.array([prior.value for prior in PRIORS])
    >>> variants(theta).shape, variants(theta, patterns=False).shape
    ((14, 14), (10, 14))
    """
    base = np.append(theta, 0.0)
    rows = [base]
    for k in _SIMULATED:
        row = base.copy()
        row[k] += PRIORS[k].step
        rows.append(row)
    if patterns:
        rows += patterns_of(base)
    return np.array(rows)


def patterns_of(base: FloatArray) -> list[FloatArray]:
    """Servos with each of the finite changes."""
    weak, poles, play, dead = (base.copy() for _ in PATTERNS)
    weak[_POWER] += np.log(0.5)
    poles[_OMEGA] += np.log(0.5)
    poles[_RATE] += np.log(0.5)
    play[_PLAY] += 2.0
    dead[_DEAD] += 1.5
    return [weak, poles, play, dead]


def new_state(count: int) -> FloatArray:
    """Memory of `advance` for so many servos: time, cursor and three numbers of each.

    Examples
    --------
    >>> new_state(2).shape
    (3, 3)
    """
    state = np.zeros((count + 1, 3))
    state[0, 0] = np.nan
    return state


@partial(compiled, error_model="numpy", fastmath={"contract", "reassoc", "nsz"})
def advance(  # noqa: C901, PLR0912, PLR0915 - one loop over time
    table: FloatArray, state: FloatArray, command_s: FloatArray, command_deg: FloatArray, time_s: FloatArray,
    load: FloatArray, power: FloatArray, start_deg: FloatArray, position_deg: FloatArray, speed_deg_s: FloatArray,
) -> None:  # fmt: skip
    """Simulate all servos of a table to each of some times.

    `table` (V, 14), `state` from `new_state`, commands of shape (n,); times, `load` (dynamic pressure over 300 Pa),
    `power` (torque over the usual one) and `start_deg` (where to start anew; NaN: go on) of shape (m,). Fills
    `position_deg` (m, V), before bends of the reading, and `speed_deg_s` (m, 2): the speed of the first servo and the
    one that its drive aims at.
    """
    count = table.shape[0]
    x, v, y = np.empty(count), np.empty(count), np.empty(count)
    w2, drag, limit, force = np.empty(count), np.empty(count), np.empty(count), np.empty(count)
    for j in range(count):
        omega, zeta, rate = np.exp(table[j, 3]), np.exp(table[j, 4]), np.exp(table[j, 5])
        w2[j], drag[j] = omega * omega, 2.0 * zeta * omega
        limit[j] = drag[j] * rate / w2[j]
        force[j] = np.exp(table[j, 13])
        x[j], v[j], y[j] = state[j + 1, 0], state[j + 1, 1], state[j + 1, 2]
    delay = table[0, 2]
    furthest = 360.0  # a turn beyond all that is asked for
    for k in range(command_deg.shape[0]):
        furthest = max(furthest, 360.0 + abs(command_deg[k]))
    now, cursor = state[0, 0], int(state[0, 1])
    last = command_s.shape[0] - 1
    for i in range(time_s.shape[0]):
        begin = start_deg[i]
        if not np.isnan(begin) or np.isnan(now) or time_s[i] - now > LONGEST_PAUSE_S:
            if np.isnan(begin):
                begin = 0.0
            for j in range(count):
                x[j] = begin - table[j, 1]
                v[j] = 0.0
                y[j] = x[j]
            now = time_s[i]
            while cursor < last and command_s[cursor + 1] <= now - delay:
                cursor += 1
        steps = int(np.ceil((time_s[i] - now) / 0.002 - 1e-9))
        h = (time_s[i] - now) / steps if steps > 0 else 0.0
        pushed = 1.0 - np.exp(-25.0 * load[i] * h)
        for k in range(steps):
            a = now + k * h - delay
            b = a + h
            while cursor < last and command_s[cursor + 1] <= a:
                cursor += 1
            u = 0.0
            while cursor < last and command_s[cursor + 1] < b:
                if command_s[cursor + 1] > a:
                    u += (command_s[cursor + 1] - a) * command_deg[cursor]
                    a = command_s[cursor + 1]
                cursor += 1
            u = (u + (b - a) * command_deg[cursor]) / h
            for j in range(count):
                error = table[j, 0] * u - x[j]
                half = 0.5 * table[j, 6]
                error -= min(half, max(-half, error))
                error = min(limit[j], max(-limit[j], error))
                loaded = load[i] * (table[j, 9] * x[j] + table[j, 10])
                slowed = 1.0 / (1.0 + h * drag[j])
                free = (v[j] + h * w2[j] * (force[j] * power[i] * error - loaded)) * slowed
                grip = h * w2[j] * table[j, 7] * slowed
                free -= min(grip, max(-grip, free))
                v[j] = free
                x[j] += h * free
                side = min(1.0, max(-1.0, loaded * 10.0))
                half = 0.5 * table[j, 8]
                at = y[j] + pushed * (x[j] - side * half - y[j])
                y[j] = min(x[j] + half, max(x[j] - half, at))
        now = time_s[i]
        for j in range(count):
            if abs(x[j]) > furthest:  # an overbalanced surface that its servo no longer holds
                x[j], v[j] = min(furthest, max(-furthest, x[j])), 0.0
                y[j] = x[j]
            position_deg[i, j] = y[j] + table[j, 1]
        speed_deg_s[i, 0] = v[0]
        held = command_deg[cursor] * table[0, 0] - x[0]
        speed_deg_s[i, 1] = min(limit[0], max(-limit[0], held)) * w2[0] / drag[0]
    for j in range(count):
        state[j + 1, 0], state[j + 1, 1], state[j + 1, 2] = x[j], v[j], y[j]
    state[0, 0], state[0, 1] = now, float(cursor)


def simulated(
    table: FloatArray, state: FloatArray, commands: tuple[FloatArray, FloatArray], time_s: FloatArray,
    load: FloatArray, power: FloatArray, start_deg: FloatArray,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Positions (m, V) before bends [deg], and speeds (m, 2) [deg/s]."""
    position_deg, speed_deg_s = np.empty((time_s.size, table.shape[0])), np.empty((time_s.size, 2))
    if time_s.size and commands[0].size:
        advance(table, state, *commands, time_s, load, power, start_deg, position_deg, speed_deg_s)
    return position_deg, speed_deg_s


def bent(position_deg: FloatArray, theta: FloatArray, reach_deg: tuple[float, float]) -> tuple[FloatArray, FloatArray]:
    """What the reading adds to a position (m,) [deg], and what each unit of both bends would, shape (m, 2).

    Bends are those of the deflections seen, and stay as they are beyond; about zero, or about the end of the reach that
    is nearest to it.
    """
    low, high = reach_deg
    middle = min(max(low, 0.0), high)
    share = (np.clip(position_deg, low, high) - middle) / max(REACH_DEG, high - middle, middle - low)
    shapes = np.stack([share**2, share**3 - share], axis=-1)
    added: FloatArray = shapes @ theta[_BEND2 : _BEND3 + 1]
    return added, shapes


def sensitivities(
    position_deg: FloatArray, speed_deg_s: FloatArray, theta: FloatArray, reach_deg: tuple[float, float]
) -> tuple[FloatArray, FloatArray]:
    """Reading of the servo (m,) [deg], and what a unit of each parameter, then each pattern, adds to it (m, 13 + p).

    From positions (m, V) of `variants`, and speeds (m, 2) of the first of them.
    """
    base = position_deg[:, 0]
    added, shapes = bent(base, theta, reach_deg)
    out = np.empty((base.size, FITTED + position_deg.shape[1] - _TRACKS))
    for place, k in enumerate(_SIMULATED):
        out[:, k] = (position_deg[:, 1 + place] - base) / PRIORS[k].step
    out[:, _BIAS] = 1.0
    out[:, _DELAY] = -speed_deg_s[:, 0]
    out[:, _BEND2], out[:, _BEND3] = shapes[:, 0], shapes[:, 1]
    for place in range(_TRACKS, position_deg.shape[1]):
        out[:, FITTED + place - _TRACKS] = position_deg[:, place] - base
    return base + added, out
