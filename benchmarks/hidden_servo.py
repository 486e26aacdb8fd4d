"""A servo from its motor to its surface, integrated in steps of 0.1 ms, for data in which an effect is hidden.

A direct-current motor with inductance and back-EMF turns the shaft, a proportional loop drives the motor:

    y' = v,   v' = -p v + tau - load - friction,   tau' = -q tau - r v + K drive(target - y)

with p the bearing's viscosity, q the winding's resistance over its inductance, r the back-EMF and K the loop's gain.
Without friction, load and limits the response is K / (s^3 + (p + q) s^2 + (p q + r) s + K), which is thesis Eq. 3.1 for
the right numbers. It has nothing in common with servofd's kernel: there modes are advanced in closed form from event to
event, here forces are summed up 10 000 times a second, and what limits the rate is the supply of the motor.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from servofd.core.types import BoolArray, FloatArray

__all__ = ["STEP_S", "Machine", "Motor", "run"]

STEP_S = 1e-4
_FAR = 1e9
"""No limit; finite, because 0 times infinity is not a number."""
_REAL_POLE_RAD_S, _DAMPING_RAD_S, _STIFFNESS_RAD2_S2 = 24.84, 70.04, 4921.0
"""Thesis Eq. 3.1: (s + 24.84) (s^2 + 70.04 s + 4921)."""


class Motor(NamedTuple):
    """Constants of the linear motion."""

    viscosity_rad_s: float
    winding_rad_s: float
    back_emf_rad2_s2: float
    loop_rad3_s3: float

    @classmethod
    def of(cls, bandwidth_scale: float = 1.0, damping_scale: float = 1.0, viscosity_share: float = 0.1) -> Motor:
        """Motor whose response is Eq. 3.1, its poles scaled, and the damping of the complex pair on top.

        A share of the losses p + q is in the bearing, the rest in the winding: the response leaves that open, but
        friction and load act between the two.
        """
        pole, stiffness = bandwidth_scale * _REAL_POLE_RAD_S, bandwidth_scale**2 * _STIFFNESS_RAD2_S2
        damping = bandwidth_scale * damping_scale * _DAMPING_RAD_S
        losses = pole + damping
        viscosity = viscosity_share * losses
        winding = losses - viscosity
        return cls(viscosity, winding, stiffness + pole * damping - viscosity * winding, pole * stiffness)

    def pull_of(self, error_deg: float) -> float:
        """Acceleration with which the motor pulls at standstill when the loop sees this error [deg/s^2]."""
        return error_deg * self.loop_rad3_s3 / self.winding_rad_s

    def error_at(self, rate_deg_s: float) -> float:
        """Error that keeps the shaft turning at a rate: what a supply that allows no more clips [deg]."""
        return rate_deg_s * (self.viscosity_rad_s * self.winding_rad_s + self.back_emf_rad2_s2) / self.loop_rad3_s3


class Machine(NamedTuple):
    """All that a servo and its linkage do beside linear motion; the defaults do nothing."""

    half_dead_deg: float = 0.0
    hard_dead: float = 0.0
    """1: outside of the dead band the loop sees the whole error; 0: what is beyond the edge."""
    up_deg: float = _FAR
    """Error at which the drive is fully on."""
    down_deg: float = _FAR
    per_volt_deg: float = _FAR
    """The same for each volt of supply."""
    air_pull: float = 0.0
    """Acceleration by hinge moment, for each degree and pascal [1/(s^2 Pa)]."""
    weight_pull: float = 0.0
    """Acceleration by a weight on the horn that hangs at 0 deg, for a level arm [deg/s^2]."""
    knee_deg: float = _FAR
    """Error far above which the drive grows as its root: a supply that gives no more current."""
    friction_pull: float = 0.0
    """Coulomb friction, as the acceleration it takes away [deg/s^2]."""
    rub_pull: float = 0.0
    """Further friction for each degree of deflection: a loaded bearing [1/s^2]."""
    rub_share: float = 0.0
    """Further friction as a share of the motor's pull: loaded teeth."""
    bristle_deg: float = 0.0
    """Pre-sliding of LuGre friction; 0: Coulomb friction."""
    set_point_deg_s: float = _FAR
    """Speed with which the firmware lets the set point run."""
    shaft_low_deg: float = -_FAR
    """Stops on which the shaft stalls."""
    shaft_high_deg: float = _FAR
    half_play_deg: float = 0.0
    arm_rad: float = 0.0
    """How far from square to its rod the servo arm stands at neutral."""
    gain: float = 1.0
    flex_rad_s: float = 0.0
    """Natural frequency of the surface on an elastic rod; 0: stiff."""
    flex_damping: float = 0.0
    low_deg: float = -_FAR
    """Stops of the surface; the servo bends the linkage and runs on."""
    high_deg: float = _FAR
    lag_s: float = 0.0


def run(
    motor: Motor,
    machine: Machine,
    heard_s: FloatArray,
    heard_deg: FloatArray,
    start_s: float,
    supply_v: FloatArray,
    pressure_pa: FloatArray,
    locked: BoolArray,
) -> FloatArray:
    """Let the servo follow what it hears.

    Parameters
    ----------
    heard_s, heard_deg : ndarray, shape (n,)
        When each command reaches the servo [s], rising, and what it asks for [deg]; it holds until the next.
    start_s : float
        When the servo is at rest at the first command [s].
    supply_v, pressure_pa, locked : ndarray, shape (m,)
        Supply voltage, dynamic pressure and whether the shaft is held fast, each for 10 ms from `start_s` on.

    Returns
    -------
    ndarray, shape (100 m,)
        Deflection as the surface's sensor sees it [deg], at the ends of the steps.
    """
    shaft_deg, sensed_deg = np.empty((2, 100 * supply_v.size))
    _turn(motor, machine, heard_s, heard_deg, start_s, supply_v, pressure_pa, locked, shaft_deg)
    _carry(machine, shaft_deg, sensed_deg)
    return sensed_deg


@njit(cache=True, inline="always")
def _drive(machine: Machine, error_deg: float, supply_v: float) -> float:
    """What the amplifier makes of the error: nothing within the dead band, no more than the supply gives."""
    half = machine.half_dead_deg
    if half > 0.0:
        if abs(error_deg) <= half:
            return 0.0
        if machine.hard_dead == 0.0:
            error_deg -= half if error_deg > 0.0 else -half
    if machine.knee_deg < _FAR:
        error_deg *= np.sqrt(machine.knee_deg / (machine.knee_deg + abs(error_deg)))
    most = machine.per_volt_deg * supply_v
    return min(max(error_deg, -min(machine.down_deg, most)), machine.up_deg, most)


@njit(cache=True, inline="always")
def _load(machine: Machine, shaft_deg: float, pressure_pa: float) -> float:
    """Acceleration against the motor by air and weight."""
    pull = machine.air_pull * pressure_pa * shaft_deg
    if machine.weight_pull != 0.0:
        pull += machine.weight_pull * np.sin(np.radians(shaft_deg))
    return pull


@njit(cache=True, inline="always")
def _drag(machine: Machine, shaft: float, speed: float, torque: float, load: float) -> tuple[float, bool]:
    """What Coulomb friction takes away from the acceleration, and whether it holds the shaft (Karnopp)."""
    grip = machine.friction_pull + machine.rub_pull * abs(shaft) + machine.rub_share * abs(torque)
    if grip == 0.0:
        return 0.0, False
    if speed == 0.0:
        return (grip if torque > load else -grip), abs(torque - load) <= grip
    return (grip if speed > 0.0 else -grip), False


@njit(cache=True, inline="always")
def _mean_heard(heard_s: FloatArray, heard_deg: FloatArray, c: int, end_s: float) -> tuple[float, int]:
    """Mean of what is heard over a step, exact to the second order whenever it changes; the command at its end."""
    left_s, area = end_s - STEP_S, 0.0
    while c + 1 < heard_s.size and heard_s[c + 1] < end_s:
        at_s = max(heard_s[c + 1], end_s - STEP_S)
        area += heard_deg[c] * (at_s - left_s)
        left_s = at_s
        c += 1
    return (area + heard_deg[c] * (end_s - left_s)) / STEP_S, c


@njit(cache=True)
def _turn(
    motor: Motor,
    machine: Machine,
    heard_s: FloatArray,
    heard_deg: FloatArray,
    start_s: float,
    supply_v: FloatArray,
    pressure_pa: FloatArray,
    locked: BoolArray,
    shaft_deg: FloatArray,
) -> None:
    """Turn the shaft by second-order Runge-Kutta steps; Coulomb friction is the same over a whole step."""
    h = STEP_S
    p, q = motor.viscosity_rad_s, motor.winding_rad_s
    r, loop = motor.back_emf_rad2_s2, motor.loop_rad3_s3
    shaft, speed, torque = heard_deg[0], 0.0, 0.0
    set_point, bristle = heard_deg[0], 0.0
    most = machine.set_point_deg_s * h
    stiffness = machine.friction_pull / machine.bristle_deg if machine.bristle_deg > 0.0 else 0.0
    c = 0
    for k in range(shaft_deg.size):
        target, c = _mean_heard(heard_s, heard_deg, c, start_s + (k + 1) * h)
        set_point += min(max(target - set_point, -most), most)
        volts, pascals = supply_v[k // 100], pressure_pa[k // 100]
        load = _load(machine, shaft, pascals)
        if stiffness > 0.0:
            # LuGre; bristles damped critically for the shaft that hangs on them, 2 sqrt(stiffness).
            yielding = speed - abs(speed) * bristle / machine.bristle_deg
            drag, fast = stiffness * bristle + 2.0 * np.sqrt(stiffness) * yielding, False
            bristle += h * yielding
        else:
            drag, fast = _drag(machine, shaft, speed, torque, load)
        middle_torque = torque + 0.5 * h * (-q * torque - r * speed + loop * _drive(machine, set_point - shaft, volts))
        if fast or locked[k // 100]:
            speed = 0.0
            torque += h * (-q * middle_torque + loop * _drive(machine, set_point - shaft, volts))
        else:
            middle = shaft + 0.5 * h * speed
            middle_speed = speed + 0.5 * h * (torque - p * speed - load - drag)
            after = speed + h * (middle_torque - p * middle_speed - _load(machine, middle, pascals) - drag)
            torque += h * (-q * middle_torque - r * middle_speed + loop * _drive(machine, set_point - middle, volts))
            if drag != 0.0 and stiffness == 0.0 and speed * after < 0.0:
                # Friction brings the shaft to rest within the step and does not turn it back.
                shaft += 0.5 * h * speed * speed / (speed - after)
                speed = 0.0
            else:
                shaft += h * middle_speed
                speed = after
        if not machine.shaft_low_deg <= shaft <= machine.shaft_high_deg:
            shaft = min(max(shaft, machine.shaft_low_deg), machine.shaft_high_deg)
            speed = 0.0
        shaft_deg[k] = shaft


@njit(cache=True)
def _carry(machine: Machine, shaft_deg: FloatArray, sensed_deg: FloatArray) -> None:
    """Carry the shaft's motion on to the surface and its sensor: play, rod, elastic surface, stops, lag."""
    h, half = STEP_S, machine.half_play_deg
    sine, cosine = np.sin(machine.arm_rad), np.cos(machine.arm_rad)
    square, drain = machine.flex_rad_s**2, 2.0 * machine.flex_damping * machine.flex_rad_s
    follow = 1.0 - np.exp(-h / machine.lag_s) if machine.lag_s > 0.0 else 1.0
    held, flex_speed = shaft_deg[0], 0.0
    for k in range(shaft_deg.size):
        held = min(max(held, shaft_deg[k] - half), shaft_deg[k] + half)
        horn = held
        if machine.arm_rad != 0.0:
            # Arm and horn move alike at neutral; what the arm moves the rod along turns the horn.
            moved = (np.sin(np.radians(held) + machine.arm_rad) - sine) / cosine
            horn = np.degrees(np.arcsin(min(max(moved, -1.0), 1.0)))
        horn *= machine.gain
        if k == 0:
            flex, before, sensed = horn, horn, min(max(horn, machine.low_deg), machine.high_deg)
        surface = horn
        if square > 0.0:
            middle = flex + 0.5 * h * flex_speed
            middle_speed = flex_speed + 0.5 * h * (square * (before - flex) - drain * flex_speed)
            flex += h * middle_speed
            flex_speed += h * (square * (0.5 * (before + horn) - middle) - drain * middle_speed)
            before, surface = horn, flex
        sensed += follow * (min(max(surface, machine.low_deg), machine.high_deg) - sensed)
        sensed_deg[k] = sensed
