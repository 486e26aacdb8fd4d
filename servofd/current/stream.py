"""The current of a surface as a monitor follows it: what an audit finds in a log, found as its readings come."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from servofd.aircraft.current import CalibratedCurrent, CurrentSource
from servofd.aircraft.schema import UNKNOWN_SERVO, Aircraft
from servofd.core.errors import DesignError
from servofd.core.types import BoolArray, FloatArray
from servofd.current.evidence import GRID_S, LOOKS_S, Evidence
from servofd.current.judge import faults_of, held, is_witness, no_witness, shares_of
from servofd.current.model import CurrentSeries, Motion, Seen, see
from servofd.detection.faults import Found, Named
from servofd.detection.residual import Residuals, Threshold
from servofd.detection.stream import (
    BY_WINDOWS,
    FASTEST_COMMANDS_S,
    MEMORY_S,
    CommandBuffer,
    Following,
    Piece,
    Remembered,
)
from servofd.detection.verdict import WITHIN_SIGMAS
from servofd.servo.context import NO_CONTEXT, Context
from servofd.servo.library import ORDINARY
from servofd.servo.servo_model import ServoModel

if TYPE_CHECKING:
    from servofd.detection.seen import Pace

SLOWEST_HZ: Final = 0.5
"""Two readings in the shortest manoeuvre: a current at 1 Hz still tells a servo that is blocked within 20 s."""
_SETTLES_S: Final = 4.0
"""Before the first reading of a window the motion is followed for so long: hobby servos forget faster."""
_KEPT: Final = 16
"""Windows that ended before which are kept: at 0.5 Hz a share has to last over five."""
_LATE_S: Final = 1.0
"""A command that comes later than this after a reading is not waited for: it says nothing of that motion."""


def motion_model(aircraft: Aircraft, name: str) -> ServoModel:
    """The servo whose motion a current belongs to; an ordinary one where it is not known."""
    if aircraft.surfaces[name].servo == UNKNOWN_SERVO:
        return ServoModel.of(ORDINARY)
    return aircraft.model(name)


@dataclass(frozen=True, slots=True)
class OfCurrent:
    """The current of a healthy servo, beside which a stream of readings is seen."""

    name: str
    model: ServoModel
    source: CurrentSource
    known: CalibratedCurrent

    @property
    def stands_loss(self) -> bool:
        """Lost commands cost it some readings and not its sense."""
        return True

    @property
    def slowest_hz(self) -> float:
        """Hubs report once a second."""
        return SLOWEST_HZ

    @property
    def needs(self) -> frozenset[str]:
        """Airspeed and supply, where its good flights held them."""
        acting = {"airspeed_m_s": self.known.airspeed_m_s != 0.0, "servo_voltage_v": self._is_of_common_supply}
        return frozenset(need for need, acts in acting.items() if acts)

    @property
    def _is_of_common_supply(self) -> bool:
        """Whether its supply is that of all servos: one that is read beside its current is not sent."""
        return self.known.supply_v > 0.0 and not self.source.voltage

    def stream(self, pace: Pace) -> CurrentStream:
        """See a stream beside it.

        Raises `DesignError` if the current of its good flights goes with nothing that it is asked to do.
        """
        if not is_witness(self.known):
            raise DesignError(no_witness(self.known))
        return CurrentStream(self, pace.period_s)

    def seen(self, readings: FloatArray, commands: tuple[FloatArray, FloatArray], context: Context) -> Seen:
        """Readings (2, n), times [s] and amperes, on commands: times [s] and deflections [deg], shape (m,) each."""
        if not self._is_of_common_supply:
            context = replace(context, voltage_s=NO_CONTEXT.voltage_s, voltage_v=NO_CONTEXT.voltage_v)
        motion = Motion.of(self.model, *commands, float(readings[0, -1]))
        return see(CurrentSeries(self.name, readings[0], readings[1], motion, context), self.known)


class CurrentStream(Following):
    """One surface that is watched by its current alone."""

    def __init__(self, healthy: OfCurrent, period_s: float) -> None:
        super().__init__(period_s)
        self._healthy = healthy
        self.logged = CommandBuffer(int(MEMORY_S / FASTEST_COMMANDS_S))
        self._context = NO_CONTEXT
        self._passed_s = -np.inf
        """Time of the latest reading that was evaluated [s]."""
        self._next_s = np.nan
        """When the next windows end [s]."""
        self._shares: FloatArray = np.zeros(0)
        """Of its limit, what the windows that ended before reached."""

    def _take(self, time_s: FloatArray, command_deg: FloatArray) -> None:
        """Keep commands."""
        self.logged.add(time_s, command_deg)

    def position(self, time_s: float, measured_deg: float) -> None:
        """Add a reading, in the unit of its channel; one that is no number is left out."""
        if np.isfinite(measured_deg):
            super().position(time_s, self._healthy.source.scale * measured_deg)

    def surroundings(self, context: Context) -> None:
        """Airspeed and supply, as far as they are known by now."""
        self._context = context

    def again(self) -> None:
        """Look again, because the alarm that stood is over."""
        self.latched = 0

    def evaluate(self, *, final: bool = False) -> Piece | None:
        """Evaluate the readings of the last half second, once they are there with their commands."""
        if not self._positions or not self.logged.size:
            return None
        if np.isnan(self._next_s):
            self._next_s = self._positions[0][0] + GRID_S
        known_s = np.inf if final else max(self._newest[0], self.latest_s - _LATE_S)
        readings = np.array([row for row in self._positions if row[0] <= known_s]).reshape(-1, 2).T
        if readings.shape[1] < 2 or readings[0, -1] <= self._passed_s or (readings[0, -1] < self._next_s and not final):
            return None
        commands = self.logged.commands()
        first = max(int(np.searchsorted(commands.effective_s, readings[0, 0] - _SETTLES_S)) - 1, 0)
        asked = commands.effective_s[first:], commands.command_deg[first:]
        seen = self._healthy.seen(readings, asked, self._context)
        due_s = np.arange(self._next_s, readings[0, -1] + 1e-9, GRID_S)
        self._next_s += GRID_S * due_s.size
        fresh = readings[0] > self._passed_s
        self._passed_s = float(readings[0, -1])
        kept_s = self._passed_s - LOOKS_S[-1]
        self._positions = [row for row in self._positions if row[0] >= kept_s]
        return self._judged(seen, fresh, self._raised_s(seen, due_s))

    def _raised_s(self, seen: Seen, due_s: FloatArray) -> FloatArray:
        """Which of these instants a fault is reported at [s]."""
        if not due_s.size:
            return due_s
        evidence = Evidence.of({self._healthy.name: seen})
        self._shares = np.append(self._shares[-_KEPT:], shares_of(evidence, evidence.gains(due_s)).max(axis=0))
        raised = held(self._shares, seen.series.period_s)[-due_s.size :] >= 1.0
        return np.asarray(due_s[raised])

    def _judged(self, seen: Seen, fresh: BoolArray, worth_s: FloatArray) -> Piece:
        """What is shown of the fresh readings, and the first instant that is worth a look."""
        sigma_a = seen.sigma_a[fresh]
        time_s = seen.series.time_s[fresh]
        residuals = Residuals(
            time_s, seen.healthy_a[fresh], seen.series.current_a[fresh], seen.error_a[fresh], seen.usable[fresh],
            np.zeros(sigma_a.size, dtype=np.int8), self._context,
        )  # fmt: skip
        threshold = Threshold("interval", WITHIN_SIGMAS * sigma_a, sigma_a, sigma_a)
        raised = np.zeros(time_s.size, dtype=np.int8)
        if worth_s.size and not self.latched:
            raised[min(int(np.searchsorted(time_s, worth_s[0])), time_s.size - 1)] = self.latched = BY_WINDOWS
        self.history.keep(residuals, threshold)
        return Piece(residuals, threshold, raised, np.ones(time_s.size, dtype=bool))

    def remembered(self, context: Context, from_s: float, until_s: float) -> Remembered | None:
        """A copy of what is remembered between two times [s]; None of less than two readings with a command."""
        if self.history.size < 2 or not self.logged.size:
            return None
        residuals, threshold = self.history.snapshot("interval", from_s, until_s)
        residuals = replace(residuals, context=context)
        return Remembered(residuals, threshold, self.logged.copied(from_s)) if residuals.time_s.size > 1 else None

    def seen(self, known: Remembered) -> Seen:
        """Readings that are remembered, beside a healthy servo."""
        readings = np.stack([known.residuals.time_s, known.residuals.measured_deg])
        commands = known.commands.effective_s, known.commands.command_deg
        return self._healthy.seen(readings, commands, known.residuals.context)

    def found(self, seen: Remembered, names: dict[float, Named]) -> Found:  # noqa: ARG002 - each look names anew
        """What an audit finds in what is remembered."""
        if seen.residuals.time_s.size < 2 or not seen.commands.effective_s.size:
            return Found((), (), seen.residuals.residual_deg)
        found = faults_of(self.seen(seen))
        faults, suspicions = (tuple(one for one in found if one.level == level) for level in ("fault", "suspect"))
        return Found(faults, suspicions, seen.residuals.residual_deg)
