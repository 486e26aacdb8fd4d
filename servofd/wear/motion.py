"""Simulated against measured motion, for many servos in a row."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from servofd.detection.bank.window import noise_deg
from servofd.detection.residual import ResidualGenerator, Simulator
from servofd.estimate.statistics import memory
from servofd.feedback.fit import POLE_RAD_S

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from servofd.calibrating.flights import Flight
    from servofd.core.types import BoolArray, FloatArray
    from servofd.wear.servo import FlownServo

_FORGOTTEN_S = 1.0
"""After a start the servo was somewhere nobody knows; the slowest ones of the library forget it by then."""
_FORGOTTEN_SHARE = 0.1
"""Of a short test, which begins at rest."""
_MEMORY_S = 1.0
_NEVER = 0.999
"""Share of the speeds among which the largest is looked for: single samples are left out."""


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Flights of one surface, ready to be compared with a simulation."""

    simulators: tuple[Simulator, ...]
    used: tuple[BoolArray, ...]
    """Rows of each flight with a position that a simulation can be held against."""

    @classmethod
    def of(cls, flights: Sequence[Flight], servo: FlownServo) -> Motion:
        """Find the rows; they do not depend on the numbers of the servo."""
        generator = ResidualGenerator(servo.model, POLE_RAD_S)
        simulators = tuple(Simulator.of(generator, flight.segment) for flight in flights)
        return cls(simulators, tuple(_usable(each) for each in simulators))

    @property
    def measured_deg(self) -> FloatArray:
        """Position in all used rows [deg], shape (n,)."""
        return np.concatenate([each.segment.measured_deg[rows] for each, rows in self._pairs()])

    def with_commands(self, changed: Callable[[FloatArray], FloatArray]) -> Motion:
        """The same flights with commands [deg] that a function has changed."""
        return replace(self, simulators=tuple(r.with_commands(changed(r.segment.command_deg)) for r in self.simulators))

    def simulated_deg(self, servo: FlownServo) -> FloatArray:
        """Deflection of a servo in all used rows [deg], shape (n,)."""
        model = servo.model
        return np.concatenate([each.simulated_deg(model)[rows] for each, rows in self._pairs()])

    def split(self, values: FloatArray) -> list[FloatArray]:
        """What belongs to each flight of an array of shape (n,)."""
        return np.split(values, np.cumsum([np.count_nonzero(rows) for rows in self.used])[:-1])

    def top_speed_deg_s(self, servo: FlownServo) -> float:
        """Largest speed that a servo without its rate limit would have [deg/s], single samples left out."""
        parts = self.split(self.simulated_deg(replace(servo, rate_limit_deg_s=None)))
        speeds = [
            np.abs(np.diff(part) / np.diff(each.segment.measured_s[rows]))
            for part, (each, rows) in zip(parts, self._pairs(), strict=True)
        ]
        every = np.concatenate(speeds)
        return float(np.quantile(every, _NEVER)) if every.size else 0.0

    @property
    def period_s(self) -> float:
        """Median sample time of the first flight [s]."""
        return self.simulators[0].segment.period_s

    def memory(self, error_deg: FloatArray) -> float:
        """Long-run variance of an error over its variance, at least 1."""
        return memory(self.split(error_deg), max(1, round(_MEMORY_S / self.period_s)))

    def _pairs(self) -> Iterable[tuple[Simulator, BoolArray]]:
        """Each flight with its rows."""
        return zip(self.simulators, self.used, strict=True)


def _usable(simulator: Simulator) -> BoolArray:
    from servofd.detection.samples import RESTART_ALL

    time_s, starts = simulator.segment.measured_s, simulator.starts
    begins = np.flatnonzero(starts.restart == RESTART_ALL)
    if begins.size == 0:
        return np.zeros(time_s.size, dtype=bool)
    last = np.searchsorted(begins, np.arange(time_s.size), side="right") - 1
    since_s = time_s - time_s[begins[np.maximum(last, 0)]]
    forgotten_s = min(_FORGOTTEN_S, _FORGOTTEN_SHARE * simulator.segment.duration_s)
    usable: BoolArray = starts.settled & (last >= 0) & (since_s >= forgotten_s)
    return usable


def noise_of(measured_deg: FloatArray, error_deg: FloatArray) -> float:
    """Standard deviation of the measurement noise [deg], that of rounding included."""
    steps = np.diff(np.unique(measured_deg))
    step_deg = float(np.median(steps)) if steps.size > 1 else 0.0
    return float(max(noise_deg(error_deg), step_deg / np.sqrt(12.0)))
