"""A servo model: effects in the order in which the command meets them."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import reduce
from typing import TYPE_CHECKING

import numpy as np

from servofd.core.errors import DesignError
from servofd.servo.context import NO_CONTEXT
from servofd.servo.effects import Delay, Effect, Extension, LinearDynamics, Plan, RateLimit, neutral_of
from servofd.servo.physics import RATE_FIELDS, Physics, Plant

if TYPE_CHECKING:
    from servofd.core.types import FloatArray
    from servofd.servo.context import Context
    from servofd.servo.kernel import ServoParameters
    from servofd.servo.library import Servo
    from servofd.servo.motion import AnyServo, ExtendedMotion, ExtendedServo, PlainMotion
    from servofd.servo.transfer import TransferFunction


@dataclass(frozen=True, slots=True)
class ServoModel:
    """What a command does to a surface.

    Parameters
    ----------
    effects : tuple of Effect
        Sorted by the place where they act.

    Raises
    ------
    DesignError
        If no effect gives the linear dynamics.

    Examples
    --------
    >>> from servofd.servo.effects import RateLimit
    >>> from servofd.servo.library import servo_named
    >>> (ServoModel.of(servo_named("hs225bb-eq31")) + RateLimit(100.0)).plan.rate_up_deg_s
    100.0
    """

    effects: tuple[Effect, ...]
    plan: Plan = field(init=False, repr=False, compare=False)
    """All effects together."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "effects", tuple(sorted(self.effects, key=lambda effect: effect.place)))
        object.__setattr__(self, "plan", reduce(lambda plan, effect: effect.install(plan), self.effects, Plan()))
        if self.plan.transfer is None:
            raise DesignError("a servo model needs linear dynamics")

    @classmethod
    def of(cls, servo: Servo) -> ServoModel:
        """Model of a servo from its description: transport delay, linear dynamics, rate limit."""
        effects: list[Effect] = [Delay(servo.transport_delay_s), LinearDynamics(servo.transfer)]
        if servo.rate_limit_deg_s is not None:
            effects.append(RateLimit(servo.rate_limit_deg_s))
        return cls(tuple(effects))

    def __add__(self, effect: Effect) -> ServoModel:
        return ServoModel((*self.effects, effect))

    @property
    def transfer(self) -> TransferFunction:
        """Linear dynamics."""
        transfer = self.plan.transfer
        if transfer is None:
            raise DesignError("a servo model needs linear dynamics")
        return transfer

    def linear(self) -> ServoModel:
        """Only the delay and the linear dynamics, without limits."""
        return ServoModel((Delay(self.plan.delay_s), LinearDynamics(self.transfer)))

    def extended(self, context: Context = NO_CONTEXT) -> ExtendedServo | None:
        """The servo with its effects, for commands that are delayed already; None if it has none.

        Examples
        --------
        >>> from servofd.servo.physics import Physics
        >>> from servofd.servo.library import servo_named
        >>> model = ServoModel.of(servo_named("hs225bb-eq31"))
        >>> model.extended() is None, (model + Extension(Physics(backlash_deg=0.5))).extended().play_deg
        (True, 0.25)
        """
        from servofd.servo.motion import ExtendedServo

        physics = self.plan.physics
        if physics is None:
            return None
        # Frames begin when they begin, and are received a delay later.
        phase = physics.frame_phase + (physics.delay_s / physics.frame_s if physics.frame_s > 0.0 else 0.0)
        return ExtendedServo(Plant(self.transfer, Physics()), physics._replace(delay_s=0.0, frame_phase=phase), context)

    def weaker(self, share: float) -> ServoModel:
        """The servo with every rate limit lower by a share; the same if it has none."""
        plan = self.plan
        if plan.physics is not None:
            lower = {name: (1.0 - share) * getattr(plan.physics, name) for name in RATE_FIELDS}
            return self + Extension(plan.physics._replace(**lower))
        limit_deg_s = min(plan.rate_up_deg_s, plan.rate_down_deg_s)
        return self + RateLimit((1.0 - share) * limit_deg_s) if limit_deg_s < float("inf") else self

    @property
    def needs(self) -> frozenset[str]:
        """What of the servo's surroundings its effects depend on."""
        physics = self.plan.physics
        if physics is None:
            return frozenset()
        acts = {
            "airspeed_m_s": physics.airload_per_pa != 0.0,
            "servo_voltage_v": min(physics.deg_s_per_v, physics.speed_deg_s_per_v) < float("inf"),
            "servo_current_a": physics.deg_per_a != 0.0,
            "servo_load": physics.load_deg != 0.0,
        }
        return frozenset(name for name, does in acts.items() if does)

    def parameters(self) -> ServoParameters:
        """The model as the kernel sees it."""
        from servofd.servo.kernel import ServoParameters

        plan, modes = self.plan, self.transfer.modes()
        return ServoParameters(
            decay_rad_s=modes.decay_rad_s,
            weight=modes.weight,
            rate_down_deg_s=plan.rate_down_deg_s,
            rate_up_deg_s=plan.rate_up_deg_s,
            lower_deg=plan.lower_deg,
            upper_deg=plan.upper_deg,
        )

    def servo(self, context: Context = NO_CONTEXT) -> AnyServo:
        """What is simulated, for commands that are delayed already."""
        return self.extended(context) or self.parameters()

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

    def motion(
        self, command_s: FloatArray, command_deg: FloatArray, context: Context = NO_CONTEXT
    ) -> PlainMotion | ExtendedMotion:
        """The servo at rest at the first of its commands, to be simulated piece by piece."""
        from servofd.servo.motion import on_its_way

        command_s, command_deg = np.asarray(command_s, dtype=float), np.asarray(command_deg, dtype=float)
        motion = on_its_way(self.servo(context))
        motion.receive(command_s + self.plan.delay_s, command_deg, np.zeros(command_s.size))
        if command_s.size:
            motion.rest(float(command_s[0]))
        return motion


def plant_of(model: ServoModel) -> Plant:
    """Position loop with the poles, the delay and the limits of a servo model.

    Examples
    --------
    >>> from servofd.servo.library import servo_named
    >>> plant = plant_of(ServoModel.of(servo_named("hs225bb-eq31")))
    >>> round(plant.loop().error_per_rate_s, 5)  # 332 deg/s need 18.1 deg of error
    0.05449
    """
    transfer = model.transfer
    if len(transfer.numerator) != 1 or not 2 <= len(transfer.denominator) <= 4:
        raise DesignError(
            f"a servo of order {len(transfer.denominator) - 1} with {len(transfer.numerator) - 1} zeros cannot be "
            "explained: servos of one to three poles and no zeros can"
        )
    return Plant(transfer, neutral_of(model.plan))
