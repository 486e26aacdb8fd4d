"""A part of a flight made ready once, to be flown by one servo after another: what a fit does a thousand times."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from servofd.detection.residual import Commands, ResidualGenerator, commands_at_servo, followed, rhythm

if TYPE_CHECKING:
    from servofd.aircraft.segment import Segment
    from servofd.core.types import FloatArray
    from servofd.detection.starts import Starts
    from servofd.servo.servo_model import ServoModel


@dataclass(frozen=True, slots=True, eq=False)
class Simulator:
    """Commands and starts of a segment, which do not depend on the servo; the residual, most of the cost, is left out.

    Examples
    --------
    >>> import numpy as np
    >>> from servofd.servo.servo_model import ServoModel
    >>> from servofd.aircraft.segment import Segment
    >>> from servofd.servo.library import servo_named
    >>> model = ServoModel.of(servo_named("hs225bb-eq31"))
    >>> time_s = np.arange(1000) / 100.0
    >>> segment = Segment("elevator", time_s, np.sin(time_s), time_s, np.zeros(1000))
    >>> generator = ResidualGenerator(model, 30.0)
    >>> simulator = Simulator.of(generator, segment)
    >>> bool(np.array_equal(simulator.simulated_deg(model), generator.run(segment).simulated_deg))
    True
    """

    segment: Segment
    commands: Commands
    """As a servo without a delay gets them."""
    starts: Starts
    longest_gap_s: float
    """Longest interval between samples that is bridged."""

    @classmethod
    def of(cls, generator: ResidualGenerator, segment: Segment) -> Simulator:
        """Make ready what the generator's filter would take: gaps and starts are found for its pole."""
        from servofd.detection.starts import find_starts

        gap_s = generator.longest_gap_s(segment)
        starts = find_starts(segment, gap_s, generator.blanking_s, rhythm(segment.command_s).longest_s)
        return cls(segment, commands_at_servo(segment, 0.0, gap_s), starts, gap_s)

    def with_commands(self, command_deg: FloatArray) -> Simulator:
        """The same part of the flight with other commands, shape (n,), at the instants of those that it has."""
        segment = replace(self.segment, command_deg=command_deg)
        return replace(self, segment=segment, commands=commands_at_servo(segment, 0.0, self.longest_gap_s))

    def simulated_deg(self, model: ServoModel) -> FloatArray:
        """Deflection of a servo [deg], shape (n,), as its residual generator would have it."""
        measured_deg, restart, _ = self.starts
        commands = replace(self.commands, effective_s=self.commands.effective_s + model.plan.delay_s)
        return followed(model.servo(self.segment.context), commands, self.segment.measured_s, measured_deg, restart)
