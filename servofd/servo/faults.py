"""Faults that the simulator can put into a servo, each at a chosen time: the failure modes of thesis 2.2.

Adding one is adding a class here and a line in `FAULTS`. Sizes left out are those of a fault that a pilot would
notice on the ground; no source prescribes them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from servofd.core.errors import ConfigError
from servofd.servo.failing import Fault
from servofd.servo.play import play

if TYPE_CHECKING:
    from collections.abc import Callable

    from servofd.core.types import FloatArray
    from servofd.servo.motion import AnyServo

_STOP_DEG = 25.0
"""Where a servo that runs away comes to rest if nothing says where its stop is: the FASER surfaces' full travel."""
_UNLOADED_RATE_DEG_S = 400.0
"""Speed of a servo that runs away if its rate limit is not known: thesis Appendix A gives 332 deg/s at 4.8 V and
417 deg/s at 6 V for the HS-225BB."""
_TONES = 32
"""Sines that make up a surface's motion in the wind: enough for deflections to be spread like Gaussian ones."""


@dataclass(frozen=True, slots=True)
class Stuck(Fault):
    """The shaft jams (thesis 4.2.2): where it happens to be, or at `position_deg` once it is there.

    Examples
    --------
    >>> from servofd.servo.servo_model import ServoModel
    >>> from servofd.servo.library import servo_named
    >>> t = np.arange(0.0, 2.0, 0.5)
    >>> Stuck(1.0).deflection(ServoModel.of(servo_named("s9254")), t, 10.0 * t, t).round(2)
    array([0., 0., 5., 5.])
    """

    kind: ClassVar[str] = "stuck"
    position_deg: float | None = None

    def received(self, command_deg: FloatArray, before_deg: float) -> FloatArray:  # noqa: ARG002
        """The position it goes to, if one is given."""
        return command_deg if self.position_deg is None else np.full(command_deg.size, self.position_deg)

    def moved(self, servo: AnyServo, elapsed_s: FloatArray, deflection_deg: FloatArray) -> FloatArray:  # noqa: ARG002
        """Not at all, unless it is on its way to a given position."""
        return np.full(elapsed_s.size, deflection_deg[0]) if self.position_deg is None else deflection_deg


@dataclass(frozen=True, slots=True)
class Bias(Fault):
    """Constant offset (a linkage that slipped, a trim that was lost): the servo moves to it as to any command.

    Examples
    --------
    >>> Bias(1.0, bias_deg=-2.0).received(np.array([0.0, 5.0]), 0.0)
    array([-2.,  3.])
    """

    kind: ClassVar[str] = "bias"
    bias_deg: float = 2.0

    def received(self, command_deg: FloatArray, before_deg: float) -> FloatArray:  # noqa: ARG002
        """The command and the offset."""
        return command_deg + self.bias_deg


@dataclass(frozen=True, slots=True)
class HardOver(Fault):
    """The servo runs away: at its rate limit to `position_deg`, but no further than to its stop, and stays there.

    Without `position_deg` it goes to the upper stop; the sign of `position_deg` gives the direction.

    Examples
    --------
    >>> from servofd.servo.servo_model import ServoModel
    >>> from servofd.servo.library import servo_named
    >>> servo = ServoModel.of(servo_named("s3151")).parameters()
    >>> HardOver(1.0, -30.0).moved(servo, np.array([0.0, 0.1, 0.2]), np.zeros(3))
    array([  0. , -26.5, -30. ])
    """

    kind: ClassVar[str] = "hardover"
    position_deg: float | None = None

    def moved(self, servo: AnyServo, elapsed_s: FloatArray, deflection_deg: FloatArray) -> FloatArray:
        """At the rate limit to the stop, from wherever it was."""
        stop_deg = servo.upper_deg if math.isfinite(servo.upper_deg) else _STOP_DEG
        goal_deg = stop_deg if self.position_deg is None else self.position_deg
        way_deg = np.clip(goal_deg, servo.lower_deg, servo.upper_deg) - deflection_deg[0]
        rate_deg_s = servo.rate_up_deg_s if way_deg > 0.0 else servo.rate_down_deg_s
        rate_deg_s = rate_deg_s if math.isfinite(rate_deg_s) else _UNLOADED_RATE_DEG_S
        moved_deg: FloatArray = deflection_deg[0] + np.sign(way_deg) * np.minimum(rate_deg_s * elapsed_s, abs(way_deg))
        return moved_deg


@dataclass(frozen=True, slots=True)
class Floating(Fault):
    """The linkage is off: the wind moves the surface about `mean_deg`, smoothly, whatever the command.

    Tones of random phase between nothing and `bandwidth_hz`; `amplitude_deg` is that of a sine of the same power, so
    that the standard deviation is `amplitude_deg` / sqrt(2). The surface leaves the position at which the linkage
    broke within about 1 / (2 pi bandwidth).

    Examples
    --------
    >>> moved_deg = Floating(1.0, mean_deg=3.0).moved(None, np.arange(0.0, 600.0, 0.1), np.zeros(6000))
    >>> float(moved_deg[0]), round(float(moved_deg.mean()), 1), round(float(moved_deg.std()), 1)
    (0.0, 3.0, 2.8)
    """

    kind: ClassVar[str] = "floating"
    positive: ClassVar[tuple[str, ...]] = ("amplitude_deg", "bandwidth_hz")
    amplitude_deg: float = 4.0
    bandwidth_hz: float = 1.0
    mean_deg: float = 0.0
    seed: float = 0

    def __post_init__(self) -> None:
        Fault.__post_init__(self)
        if self.seed < 0 or self.seed != int(self.seed):
            raise ConfigError(f"floating: seed must be a whole number of zero or more, not {self.seed}")

    def moved(self, servo: AnyServo, elapsed_s: FloatArray, deflection_deg: FloatArray) -> FloatArray:  # noqa: ARG002
        """As the wind wants it."""
        rng = np.random.default_rng(int(self.seed))
        tones_hz = self.bandwidth_hz * (np.arange(_TONES) + rng.random(_TONES)) / _TONES
        phases = rng.uniform(0.0, 2.0 * np.pi, _TONES)
        wind_deg = np.full(elapsed_s.size, self.mean_deg)
        for tone_hz, phase in zip(tones_hz, phases, strict=True):
            wind_deg += self.amplitude_deg / np.sqrt(_TONES) * np.sin(2.0 * np.pi * tone_hz * elapsed_s + phase)
        forgotten = np.exp(-2.0 * np.pi * self.bandwidth_hz * elapsed_s)
        moved_deg: FloatArray = wind_deg + forgotten * (deflection_deg[0] - wind_deg[0])
        return moved_deg


@dataclass(frozen=True, slots=True)
class Oscillation(Fault):
    """The servo swings: on top of its motion ("liquid"), or in place of it about where it was ("solid").

    Examples
    --------
    >>> liquid, solid = Oscillation(0.0, 1.0, 0.25), Oscillation(0.0, 1.0, 0.25, replaces=True)
    >>> liquid.moved(None, np.array([0.0, 1.0]), np.array([5.0, 6.0]))
    array([5., 7.])
    >>> solid.moved(None, np.array([0.0, 1.0]), np.array([5.0, 6.0]))
    array([5., 6.])
    """

    kind: ClassVar[str] = "oscillation"
    positive: ClassVar[tuple[str, ...]] = ("amplitude_deg", "frequency_hz")
    amplitude_deg: float = 1.5
    frequency_hz: float = 3.0
    replaces: bool = False

    def __post_init__(self) -> None:
        Fault.__post_init__(self)
        if self.replaces not in (0, 1):
            raise ConfigError(f"oscillation: replaces must be 0 (on top of the motion) or 1, not {self.replaces}")

    def moved(self, servo: AnyServo, elapsed_s: FloatArray, deflection_deg: FloatArray) -> FloatArray:  # noqa: ARG002
        """A sine that begins at its zero."""
        about_deg = deflection_deg[0] if self.replaces else deflection_deg
        moved_deg: FloatArray = about_deg + self.amplitude_deg * np.sin(2.0 * np.pi * self.frequency_hz * elapsed_s)
        return moved_deg


@dataclass(frozen=True, slots=True)
class DeadBand(Fault):
    """Increased dead band or stiction (thesis 4.2.1): the servo rests until it is `width_deg` / 2 off its command.

    Examples
    --------
    >>> DeadBand(0.0, width_deg=2.0).received(np.array([0.5, 3.0, 2.5]), 0.0)
    array([0., 2., 2.])
    """

    kind: ClassVar[str] = "deadband"
    positive: ClassVar[tuple[str, ...]] = ("width_deg",)
    width_deg: float = 3.0

    def received(self, command_deg: FloatArray, before_deg: float) -> FloatArray:
        """The command through a dead zone."""
        return play(command_deg, self.width_deg, before_deg)


@dataclass(frozen=True, slots=True)
class Slow(Fault):
    """The servo has become slower: every pole times `bandwidth_scale`, its rate limit (if any) times `rate_scale`.

    Left out, `bandwidth_scale` is 0.5; or 1 if a `rate_scale` below 1 says that the rate limit is what has changed.
    Poles scaled are time stretched: each mode goes on from where it is, only slower, so that the position does not
    jump when the fault comes or goes.

    Examples
    --------
    >>> from servofd.servo.servo_model import ServoModel
    >>> from servofd.servo.library import servo_named
    >>> servo = ServoModel.of(servo_named("s3151")).parameters()
    >>> round(Slow(0.0, rate_scale=0.1).become(servo).rate_up_deg_s, 6)
    26.5
    """

    kind: ClassVar[str] = "slow"
    positive: ClassVar[tuple[str, ...]] = ("bandwidth_scale", "rate_scale")
    bandwidth_scale: float | None = None
    rate_scale: float = 1.0

    def __post_init__(self) -> None:
        if self.bandwidth_scale is None:
            object.__setattr__(self, "bandwidth_scale", 1.0 if self.rate_scale < 1.0 else 0.5)
        Fault.__post_init__(self)
        for name in self.positive:
            if getattr(self, name) > 1.0:
                raise ConfigError(f"slow: {name} must be at most 1, not {getattr(self, name)}")

    def become(self, servo: AnyServo) -> AnyServo:
        """The same servo, slower."""
        return servo.slower(self.bandwidth_scale or 1.0).weaker(1.0 - self.rate_scale)


@dataclass(frozen=True, slots=True)
class LossOfEffectiveness(Fault):
    """The surface moves only `gain` times what is asked, about its neutral position, as if that had been the command.

    Examples
    --------
    >>> LossOfEffectiveness(0.0, gain=0.5).received(np.array([4.0, -2.0]), 0.0)
    array([ 2., -1.])
    """

    kind: ClassVar[str] = "loss_of_effectiveness"
    gain: float = 0.6

    def __post_init__(self) -> None:
        Fault.__post_init__(self)
        if not 0.0 <= self.gain < 1.0:
            raise ConfigError(f"loss_of_effectiveness: gain must be at least 0 and below 1, not {self.gain}")

    def received(self, command_deg: FloatArray, before_deg: float) -> FloatArray:  # noqa: ARG002
        """A part of the command."""
        return self.gain * command_deg


FAULTS: dict[str, Callable[..., Fault]] = {
    fault.kind: fault for fault in (Stuck, Bias, HardOver, Floating, Oscillation, DeadBand, Slow, LossOfEffectiveness)
}
"""Faults that a user can ask for by name."""
