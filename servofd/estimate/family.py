"""The family of servos that a calibration fits, simulated beside its own sensitivities.

A choice of the effects that every servo may have (`servofd.servo.effects`) on a loop of two poles: a geared motor
behind a proportional loop. All torques are written as the position error that would balance them, so that friction and
load are in degrees:

    v' = omega^2 (s sat(e, E) - load - friction sign(v)) - 2 zeta omega v,    E = 2 zeta R / omega

with e = gain * command(t - delay) - x less its dead band, and s the share of its torque that the motor has (supply
over the usual one). With E so, the largest speed is R. The surface is carried along within its play and is pushed
through it to the loaded side by the air. The reading may be bent, off and late.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np

from servofd.aircraft.priors import ADDED, FITTED, NAMES, PRIORS
from servofd.core.types import FloatArray
from servofd.servo.effect import Effect
from servofd.servo.effects.commands import CommandGain, Commands
from servofd.servo.effects.linkage import Backlash
from servofd.servo.effects.motor import DeadBand, MotorRate, Torque
from servofd.servo.effects.sensor import Bias
from servofd.servo.effects.shaft import AirLoad, AirTrim, Friction, ServoStop, StribeckFriction
from servofd.servo.motion import Machine, State, around_servo, machine_of
from servofd.servo.physics import Physics
from servofd.servo.transfer import TransferFunction

PRESSURE_PA: Final = 300.0
"""Dynamic pressure that loads refer to: 22 m/s at sea level."""
REACH_DEG: Final = 25.0
"""Deflection that bends of the reading refer to, or the largest one seen."""
LONGEST_PAUSE_S: Final = 5.0
"""Between positions; after it the simulation begins anew from the position."""
_TURN_DEG: Final = 360.0
"""Beyond all that is asked for: further no surface goes."""
_LEAST_ASKED_DEG: Final = 16.0
"""Smallest range for which steps of the simulation are planned [deg]."""
_FINER: Final = 0.3
"""Steps are so much longer than elsewhere: errors of the position stay below 0.01 deg rms."""
EFFECTS: Final[tuple[type[Effect], ...]] = (
    CommandGain, DeadBand, MotorRate, Torque, Friction, StribeckFriction, AirLoad, AirTrim, ServoStop, Backlash, Bias,
    *ADDED,
)  # fmt: skip
_LOOP: Final = TransferFunction((1.0,), (1.0, 2.0, 1.0))
"""One of 1 rad/s without overshoot, which each servo scales."""

(
    _GAIN, _BIAS, _DELAY, _OMEGA, _ZETA, _RATE, _DEAD, _FRICTION, _PLAY, _HINGE, _HINGE0, _BEND2, _BEND3, *_MORE,
) = range(FITTED)  # fmt: skip
_POWER = FITTED
_SIMULATED: Final = (_GAIN, _OMEGA, _ZETA, _RATE, _DEAD, _FRICTION, _PLAY, _HINGE, _HINGE0, *_MORE)
"""Parameters whose sensitivities need a simulation of their own; those of the others are known from the position."""
PATTERNS: Final = ("weak", "play")
"""Finite changes: half the torque, 2 deg of play."""
_USUAL = np.append([prior.value for prior in PRIORS], 0.0)
_TRACKS: Final = 1 + len(_SIMULATED)
_STEPS = np.array([PRIORS[k].step for k in _SIMULATED])
"""By how much each of these differs."""


def middle_of(reach_deg: tuple[float, float]) -> float:
    """Deflection about which a servo's gain and bends act: zero, or the end of its reach that is nearest to it [deg].

    Examples
    --------
    >>> middle_of((-20.0, 25.0)), middle_of((171.0, 189.0))
    (0.0, 171.0)
    """
    return min(max(reach_deg[0], 0.0), reach_deg[1])


def variants(theta: FloatArray, *, patterns: bool = True, middle_deg: float = 0.0) -> FloatArray:
    """Servos to be simulated side by side, shape (V, 14): the servo itself, one per sensitivity, one per pattern.

    Their gains act about `middle_deg`; the table holds their offsets at a command of 0.
    """
    base = np.append(theta, 0.0)
    table = np.tile(base, (_TRACKS + patterns * len(PATTERNS), 1))
    table[np.arange(1, _TRACKS), _SIMULATED] += _STEPS
    if patterns:
        table[_TRACKS, _POWER] += np.log(0.5)
        table[_TRACKS + 1, _PLAY] += 2.0
    table[:, _BIAS] += middle_deg * (1.0 - table[:, _GAIN])
    return table


@dataclass(slots=True, eq=False)
class Progress:
    """State of servos that are simulated side by side; moved on by `simulated`."""

    state: State
    received: int = 0
    """Commands, of those that are held, that have reached the servos."""
    asked_deg: float = 0.0
    """The furthest that any command asked for [deg]."""

    def forget(self, commands: int) -> None:
        """The oldest commands are no longer held."""
        self.received = max(self.received - commands, 0)


def new_state(count: int) -> Progress:
    """State of several servos before their first position."""
    return Progress(_at_rest(count).copy())


@lru_cache(maxsize=8)
def _at_rest(count: int) -> State:
    return machine_of(_LOOP, [_servo(_USUAL, 0.0)] * count, effects=EFFECTS).new_state()


def _servo(row: FloatArray, furthest_deg: float) -> Physics:
    """Sizes of the effects of one servo of a table."""
    values = row.tolist()
    rate_deg_s = math.exp(values[_RATE])
    stops = {}
    if values[_HINGE] < 0.0:  # an overbalanced surface that its servo no longer holds
        stops = {"stop_lower_deg": -furthest_deg, "stop_upper_deg": furthest_deg}
    return Physics(
        command_gain=values[_GAIN], bias_deg=values[_BIAS], pair_scale=math.exp(values[_OMEGA]),
        damping_scale=math.exp(values[_ZETA]), rate_up_deg_s=rate_deg_s, rate_down_deg_s=rate_deg_s,
        torque=math.exp(values[_POWER]), deadband_deg=values[_DEAD], friction_deg=values[_FRICTION],
        airload_per_pa=values[_HINGE] / PRESSURE_PA, air_trim_per_pa=values[_HINGE0] / PRESSURE_PA,
        backlash_deg=values[_PLAY], **stops, **{NAMES[k]: values[k] for k in _MORE},
    )  # fmt: skip


@lru_cache(maxsize=160)
def _machine(table: bytes, count: int, furthest_deg: float) -> Machine:
    """The servos of a table, made once: a stream asks for the same ones at each sample, and for the same faults."""
    rows = np.frombuffer(table).reshape(count, -1)
    return machine_of(_LOOP, [_servo(row, furthest_deg) for row in rows], _FINER, EFFECTS)


def simulated(
    table: FloatArray, progress: Progress, commands: tuple[FloatArray, FloatArray, FloatArray], time_s: FloatArray,
    load: FloatArray, power: FloatArray, start_deg: FloatArray,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Simulate all servos of a table to each of some times.

    `table` (V, 14), commands (n,): times, values and slopes; times, `load` (dynamic pressure over 300 Pa), `power`
    (torque over the usual one) and `start_deg` (where to start anew; NaN: go on) of shape (m,). Gives positions (m, V)
    before bends of the reading [deg], and speeds (m, 2) [deg/s]: of the first servo, and the one that its drive aims
    at.
    """
    if not time_s.size or not commands[0].size:
        return np.empty((time_s.size, table.shape[0])), np.empty((time_s.size, 2))
    base, since = table[0], max(progress.received - 1, 0)  # the command in force is the last that was received
    command_s, command_deg, slope_deg_s = (each[since:] for each in commands)
    progress.asked_deg = max(progress.asked_deg, float(np.abs(command_deg).max()))
    furthest_deg = _TURN_DEG + 2.0 ** math.ceil(math.log2(max(progress.asked_deg, _LEAST_ASKED_DEG)))
    machine = _machine(np.ascontiguousarray(table).tobytes(), table.shape[0], furthest_deg)
    effective_s = command_s + base[_DELAY]
    new = slice(progress.received - since, None)
    begins = np.isfinite(start_deg)
    anew = begins.copy()
    anew[0] |= time_s[0] - progress.state.clock[0] > LONGEST_PAUSE_S
    anew[1:] |= time_s[1:] - time_s[:-1] > LONGEST_PAUSE_S
    moving_deg_s = np.empty(time_s.size)
    position_deg, used = machine.run(
        progress.state, Commands(effective_s[new], command_deg[new], slope_deg_s[new]), time_s,
        anew=anew, measured_deg=np.where(begins, start_deg, 0.0), speed_deg_s=moving_deg_s,
        around=around_servo(time_s.size, pressure_pa=load * PRESSURE_PA, power=power),
    )  # fmt: skip
    progress.received += used
    held = np.maximum(np.searchsorted(effective_s, time_s, side="right") - 1, 0)
    error_deg = base[_GAIN] * command_deg[held] - (position_deg[:, 0] - base[_BIAS])
    most_deg_s = math.exp(base[_RATE])
    aimed_deg_s = np.clip(error_deg / machine.loops[0].error_s, -most_deg_s, most_deg_s)
    return position_deg, np.column_stack([moving_deg_s, aimed_deg_s])


def bent(position_deg: FloatArray, theta: FloatArray, reach_deg: tuple[float, float]) -> tuple[FloatArray, FloatArray]:
    """What the reading adds to a position (m,) [deg], and what each unit of both bends would, shape (m, 2).

    Bends are those of the deflections seen, and stay as they are beyond; about zero, or about the end of the reach that
    is nearest to it.
    """
    low, high = reach_deg
    middle = middle_of(reach_deg)
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
    out[:, _SIMULATED] = (position_deg[:, 1:_TRACKS] - base[:, None]) / _STEPS
    out[:, _BIAS] = 1.0
    out[:, _DELAY] = -speed_deg_s[:, 0]
    out[:, _BEND2], out[:, _BEND3] = shapes[:, 0], shapes[:, 1]
    out[:, FITTED:] = position_deg[:, _TRACKS:] - base[:, None]
    return base + added, out
