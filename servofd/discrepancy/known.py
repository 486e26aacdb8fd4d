"""What is known of a servo before its log is seen: that it is of a given type, or nothing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product

from servofd.servo.effect import Effect
from servofd.servo.effects.commands import ClockOffset, PwmFrame
from servofd.servo.effects.own import Damping, SlowDynamics
from servofd.servo.effects.sensor import SensorLag
from servofd.servo.effects.shaft import TiltedLoad

Point = Mapping[str, float]
"""Some of a servo's own numbers, by field of `Physics`."""

_STRAINED = 3.0
"""Standard deviations at which one of the servo's own numbers may stand in for something else."""
_GAIN_SHARE = 0.03
"""A servo that controls its position comes to where it is sent, within some percent of its horn and sensor (standard
deviation)."""


@dataclass(frozen=True, slots=True, eq=False)
class Known:
    """What is known of a servo: how far its own numbers may be from the given ones, and what they cover."""

    spread: Mapping[str, float]
    """Standard deviation of each: of poles and damping as shares, of the gain, the delay [s] and the zero [deg]."""
    covers: frozenset[type[Effect]]
    """Effects that are no names, as the servo's own numbers do the same, or no such servo has them."""
    smallest: Point
    """Sizes [s] below which an effect is none, where they are not those of the catalogue."""
    strained: float = _STRAINED
    """Standard deviations of a number at which an effect may take its place."""
    gain_share: float = float("inf")
    """Standard deviation of the share of a command that is lost at rest without an effect."""
    grid: tuple[Point, ...] = ()
    """Points on which a search for the servo begins, the likeliest of which are fitted."""
    starts: tuple[Point, ...] = ()
    """Points that are fitted as well; none where the given servo is of its type, and no other is looked for."""


_OF_A_TYPE = {
    "slow_scale": 0.03,
    "pair_scale": 0.03,
    "damping_scale": 0.06,
    "gain": 0.01,
    "delay_s": 1.5e-3,
    "bias_deg": 0.08,
}
"""How far servos of one type differ: poles 3 %, damping 6 %, gain 1 %, 1.5 ms, 0.08 deg."""
_UNKNOWN = {"slow_scale": 1.5, "pair_scale": 1.5, "damping_scale": 1.5, "delay_s": 5e-3}
"""The same of an unknown servo, where it is another."""
_UNKNOWN_LATE_S = 0.01
"""Delay below which an unknown servo is not late [s]."""

A_TYPE = Known(_OF_A_TYPE, frozenset({TiltedLoad}), {})
"""It is of the given type, whose weight is balanced about its hinge, or hangs at zero."""
NOTHING = Known(
    _OF_A_TYPE | _UNKNOWN,
    frozenset({SlowDynamics, Damping, SensorLag, ClockOffset, PwmFrame}),
    {"delay_s": _UNKNOWN_LATE_S},
    strained=float("inf"),
    gain_share=_GAIN_SHARE,
    # 1 to 40 Hz, loosely and well damped, its slow pole anywhere.
    grid=tuple(
        {"pair_scale": pair, "damping_scale": damping, "slow_scale": slow}
        for pair, damping, slow in product((0.25, 0.5, 1.0, 2.0, 4.0, 8.0), (0.3, 0.7, 1.4), (0.05, 0.2, 1.0))
    ),
    # Of a servo of 5 Hz: one that is weak, three as small servos are, and one whose poles other effects hide.
    starts=(
        {"pair_scale": 0.8},
        {"pair_scale": 2.0},
        {"pair_scale": 2.2, "damping_scale": 0.65, "slow_scale": 0.125},
        {"pair_scale": 4.0, "damping_scale": 1.5},
        {"pair_scale": 8.0, "damping_scale": 1.2},
    ),
)
"""It is any servo: its poles are found along with what it may lack."""
