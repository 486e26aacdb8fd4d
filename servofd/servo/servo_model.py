"""A servo model: a linear servo and the sizes of its effects."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from servofd.core.errors import DesignError
from servofd.core.types import FloatArray
from servofd.servo.context import NO_CONTEXT, Context
from servofd.servo.effect import Effect
from servofd.servo.effects.commands import Delay
from servofd.servo.effects.linkage import RateLimit
from servofd.servo.library import Servo
from servofd.servo.loop import MOST_POLES, scaled
from servofd.servo.motion import Motion
from servofd.servo.physics import Physics, rate_fields
from servofd.servo.transfer import TransferFunction


@dataclass(frozen=True, slots=True)
class ServoModel:
    """What a command does to a surface.

    Parameters
    ----------
    transfer : TransferFunction
        The linear servo (thesis Eq. 3.1).
    physics : Physics
        Sizes of its effects, its delay among them.
    context : Context
        What is around it.

    Examples
    --------
    >>> from servofd.servo.library import servo_named
    >>> (ServoModel.of(servo_named("hs225bb-eq31")) + RateLimit(100.0)).physics.follow_up_deg_s
    100.0
    """

    transfer: TransferFunction
    physics: Physics = field(default_factory=Physics)
    context: Context = field(default=NO_CONTEXT, repr=False, compare=False)

    @classmethod
    def of(cls, servo: Servo) -> ServoModel:
        """Model of a servo of the library, or of a file."""
        model = cls(servo.transfer) + Delay(servo.transport_delay_s)
        return model if servo.rate_limit_deg_s is None else model + RateLimit(servo.rate_limit_deg_s)

    def __add__(self, effect: Effect) -> ServoModel:
        return self.with_physics(self.physics._replace(**effect.sizes))

    def with_physics(self, physics: Physics) -> ServoModel:
        """The same servo with all effects, as ``servofd explain`` finds them: scaled poles become poles."""
        as_it_is = physics._replace(bandwidth_scale=1.0, slow_scale=1.0, pair_scale=1.0, damping_scale=1.0)
        return ServoModel(scaled(self.transfer, physics.scales), as_it_is)

    @property
    def delay_s(self) -> float:
        """Transport delay [s]."""
        return self.physics.delay_s

    @property
    def has_places(self) -> bool:
        """Whether its slow pole may act elsewhere: one of three, and real."""
        return len(self.transfer.denominator) == MOST_POLES + 1

    def explainable(self) -> ServoModel:
        """The same; raises `DesignError` if effects cannot act inside it: it has zeros, or more than three poles."""
        zeros, poles = len(self.transfer.numerator) - 1, len(self.transfer.denominator) - 1
        if zeros or not 1 <= poles <= MOST_POLES:
            raise DesignError(
                f"a servo of order {poles} with {zeros} zeros cannot be explained: servos of one to three poles and no "
                "zeros can"
            )
        return self

    def linear(self) -> ServoModel:
        """Only the delay and the linear dynamics, without limits."""
        return ServoModel(self.transfer, Physics(delay_s=self.delay_s))

    def slower(self, bandwidth_scale: float) -> ServoModel:
        """The servo with every pole scaled."""
        scale = bandwidth_scale * self.physics.bandwidth_scale
        return replace(self, physics=self.physics._replace(bandwidth_scale=scale))

    def weaker(self, share: float) -> ServoModel:
        """The servo with every rate limit lower by a share.

        Examples
        --------
        >>> from servofd.servo.library import servo_named
        >>> ServoModel.of(servo_named("s3151")).weaker(0.2).rates_deg_s
        (212.0, 212.0)
        """
        lower = {name: (1.0 - share) * getattr(self.physics, name) for name in rate_fields()}
        return replace(self, physics=self.physics._replace(**lower))

    @property
    def rates_deg_s(self) -> tuple[float, float]:
        """Fastest motion upwards and downwards [deg/s]; infinite if nothing limits it."""
        p = self.physics
        up_deg_s = min(p.rate_up_deg_s, p.follow_up_deg_s, p.set_point_deg_s)
        return up_deg_s, min(p.rate_down_deg_s, p.follow_down_deg_s, p.set_point_deg_s)

    @property
    def stops_deg(self) -> tuple[float, float]:
        """Lowest and highest position of the surface: stops of the linkage or of the servo [deg]."""
        p = self.physics
        return max(p.lower_deg, p.gain * p.stop_lower_deg), min(p.upper_deg, p.gain * p.stop_upper_deg)

    def servo(self, context: Context = NO_CONTEXT) -> ServoModel:
        """What is simulated, for commands that are delayed already."""
        physics = self.physics
        # Frames begin when they begin, and are received a delay later.
        phase = physics.frame_phase + (physics.delay_s / physics.frame_s if physics.frame_s > 0.0 else 0.0)
        return ServoModel(self.transfer, physics._replace(delay_s=0.0, frame_phase=phase), context)

    def simulate(self, command_s: FloatArray, command_deg: FloatArray, at_s: FloatArray) -> FloatArray:
        """Deflection at given times under a held command, exactly, whatever the spacing of the samples.

        Parameters
        ----------
        command_s, command_deg : ndarray, shape (n,)
            When each command was given [s] and what it asked for [deg]; it holds until the next.
        at_s : ndarray, shape (m,)
            Times [s], rising.

        Returns
        -------
        ndarray, shape (m,)
            Deflection [deg], starting from rest at the first command.

        Examples
        --------
        >>> from servofd.servo.library import servo_named
        >>> model = ServoModel.of(servo_named("s9254"))
        >>> model.simulate(np.array([0.0, 0.1]), np.array([0.0, 5.0]), np.array([0.0, 0.1, 0.5])).round(3)
        array([0., 0., 5.])
        """
        return self.motion(command_s, command_deg).at(np.asarray(at_s, dtype=float))

    def motion(self, command_s: FloatArray, command_deg: FloatArray, context: Context = NO_CONTEXT) -> Motion:
        """The servo at rest at the first of its commands, to be simulated piece by piece."""
        command_s, command_deg = np.asarray(command_s, dtype=float), np.asarray(command_deg, dtype=float)
        motion = Motion(self.servo(context))
        motion.receive(command_s + self.delay_s, command_deg, np.zeros(command_s.size))
        if command_s.size:
            motion.rest(float(command_s[0]))
        return motion
