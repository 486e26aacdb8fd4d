"""A calibrated surface as a stream: what `servofd.detection.watch` makes of a whole log, piece by piece.

Samples wait until the command at their time is known, and for up to three positions after a jump, which may have been a
glitch; nothing else waits.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from servofd.detection.changes import STATISTICS, Memory, Tests, follow
from servofd.detection.glitches import decide, new_glitch_memory
from servofd.detection.history import CommandBuffer, History
from servofd.detection.probability.cusum import CusumDesign
from servofd.detection.residual import Residuals
from servofd.detection.stream import FASTEST_COMMANDS_S, MEMORY_S, Piece
from servofd.detection.threshold import Threshold
from servofd.detection.watch import exceeded, thresholds_of
from servofd.estimate.family import new_state, sensitivities, simulated, variants
from servofd.estimate.fit import peaks, residual
from servofd.estimate.lost import HOLDS, LONGEST_S, new_memory, put_back, unknown_deg
from servofd.estimate.record import FINE_S, gap_s, load_at, loads, powers, starts
from servofd.servo.context import NO_CONTEXT

if TYPE_CHECKING:
    from servofd.aircraft.calibrated import CalibratedServo
    from servofd.aircraft.schema import Surface
    from servofd.core.types import BoolArray, FloatArray
    from servofd.servo.context import Context

_BACK_S: Final = 3.0
_LATE: Final = 2.0


class _Evaluation(NamedTuple):
    """What a snapshot needs beside the history."""

    cusum: CusumDesign


class CalibratedStream:
    """One surface.

    Parameters
    ----------
    known : CalibratedServo
        Servo, noise and thresholds.
    surface : Surface
        Its channels.
    period_s : float
        Usual time between positions [s].
    command_s : ndarray, shape (n,)
        Times of the first commands, for their rhythm [s].
    sent_period_s : float, optional
        Between commands as they were sent [s], where most of them get lost.
    """

    def __init__(
        self,
        known: CalibratedServo,
        surface: Surface,
        period_s: float,
        command_s: FloatArray,
        sent_period_s: float | None = None,
    ) -> None:
        self._known, self._surface = known, surface
        self._gap_s = gap_s(command_s) if sent_period_s is None else LONGEST_S
        self.longest_gap_s = self._gap_s
        self._limits = thresholds_of(known)
        self.sent_period_s = sent_period_s
        self._noise = known.noise.noise.at(period_s)
        self._period_s = period_s
        self._context = NO_CONTEXT
        self._begin_tests()
        self._table = variants(known.theta)
        self._state = new_state(self._table.shape[0])
        self._glitch = new_glitch_memory()
        self._peak = np.array([0.0, np.nan])
        self.evaluation = _Evaluation(CusumDesign(1.0, np.inf, 1.0, period_s))
        self.history = History(int(MEMORY_S / max(period_s, 1e-3)))
        fastest_s = FINE_S if surface.command_period_s is not None else FASTEST_COMMANDS_S
        self.logged = CommandBuffer(int(MEMORY_S / fastest_s))
        self.effective = self.logged
        self._filled = self.logged if sent_period_s is None else CommandBuffer(int(MEMORY_S / fastest_s))
        self._unknown = new_memory()
        self._positions: list[tuple[float, float]] = []
        self._seen = np.zeros((2, 0))
        self._begun_s = np.nan
        self._newest: tuple[float, float] = (-np.inf, 0.0)
        self._pending: list[FloatArray] = []
        self._before = np.zeros(len(STATISTICS))
        self.latched = False
        self.latest_s = -np.inf

    def surroundings(self, context: Context) -> None:
        """Airspeed and supply, as far as they are known by now."""
        began = context.airspeed_s.size > 0 and not self._context.airspeed_s.size
        self._context = context
        if began:
            self._begin_tests()

    def _begin_tests(self) -> None:
        """Without airspeed more is unknown."""
        known = self._known if self._context.airspeed_s.size else self._known.without_airspeed()
        is_lossy = self.sent_period_s is not None
        self._tests = Tests.of(known.noise.noise, known.covariance, self._period_s, is_lossy=is_lossy)
        self._memory = Memory(self._tests)

    def command(self, time_s: float, command_deg: float) -> None:
        """Add a command [deg]; one that is no later than the one before is left out."""
        before_s, before_deg = self._newest
        if not time_s > before_s:
            return
        if self.sent_period_s is not None:
            self._fill(time_s, command_deg)
        elif self._surface.command_period_s is not None and time_s - before_s < 1.0:
            pieces = max(round((time_s - before_s) / FINE_S), 1)
            for place in range(1, pieces):
                share = place / pieces
                self._add(before_s + share * (time_s - before_s), before_deg + share * (command_deg - before_deg))
        self._add(time_s, command_deg)
        self._newest = (time_s, command_deg)

    def position(self, time_s: float, measured_deg: float) -> None:
        """Add a position [deg]; one that is no later than the one before, or none, is left out."""
        if time_s > self.latest_s and np.isfinite(measured_deg):
            self.latest_s = time_s
            self._positions.append((time_s, measured_deg))

    def again(self) -> None:
        """Begin the tests anew, because the alarm that stood is over."""
        self._memory, self.latched = Memory(self._tests), False
        self._before = np.zeros(len(STATISTICS))

    @property
    def is_waiting(self) -> bool:
        """Whether any position waits for a command."""
        return bool(self._positions)

    def evaluate(self, *, final: bool = False) -> Piece | None:
        """Evaluate what can be decided by now; everything if nothing more will come. None if that is nothing."""
        self._simulate(self._ready(final=final))
        if not self._pending:
            return None
        rows = np.concatenate(self._pending, axis=1) if len(self._pending) > 1 else self._pending[0]
        glitch = np.zeros(rows.shape[1], dtype=bool)
        error_deg, _ = residual(rows[2], rows[1], self._known.reach_deg)
        error_deg = np.where(rows[3] != 0.0, error_deg, np.nan)
        count = decide(self._glitch, error_deg, rows[4].astype(np.int8), glitch, final)
        self._pending = [rows[:, count:]] if count < rows.shape[1] else []
        return self._judged(rows[:, :count], error_deg[:count], glitch[:count]) if count else None

    def _add(self, time_s: float, command_deg: float) -> None:
        dropped = self.logged.append(time_s, command_deg, 0.0)
        if self._filled is self.logged:
            self._state[0, 1] = max(self._state[0, 1] - dropped, 0.0)
        else:
            self._unknown[0] = max(self._unknown[0] - dropped, 0.0)

    def _fill(self, time_s: float, command_deg: float) -> None:
        """Commands that were lost before this one, and it."""
        before_s, before_deg = self._newest
        known = slice(int(np.isfinite(before_s)), None)
        ends = np.array([before_s, time_s][1 - known.start :]), np.array([before_deg, command_deg][1 - known.start :])
        filled = put_back(*ends, self.sent_period_s or np.inf)
        for at_s, asked_deg in zip(*(column[known] for column in filled), strict=True):
            dropped = self._filled.append(at_s, asked_deg, 0.0)
            self._state[0, 1] = max(self._state[0, 1] - dropped, 0.0)

    def _ready(self, *, final: bool) -> FloatArray:
        known_s = self._newest[0]
        if final or self.latest_s - known_s > _LATE * self._gap_s:
            known_s = np.inf
        count = sum(1 for time_s, _ in self._positions if time_s <= known_s)
        ready, self._positions = self._positions[:count], self._positions[count:]
        return np.array(ready, dtype=float).reshape(-1, 2).T.copy()

    def _simulate(self, ready: FloatArray) -> None:
        count = ready.shape[1]
        if count == 0 or self.logged.size == 0:
            return
        start_deg, usable = self._starts(ready)
        time_s, measured_deg = ready
        load = loads(self._context, time_s, self._known.airspeed_m_s)
        usable = usable & (load <= load_at(self._known.last_judged_m_s))
        power = powers(self._context, time_s, self._known.supply_v)
        commands = self._filled.commands()
        position_deg, speed_deg_s = simulated(
            self._table, self._state, (commands.effective_s, commands.command_deg), time_s, load, power, start_deg
        )
        reading_deg, slopes = sensitivities(position_deg, speed_deg_s, self._known.theta, self._known.reach_deg)
        noise_deg = self._noise.sigma_deg(peaks(speed_deg_s, time_s, self._peak))
        if self.sent_period_s is not None:
            arrived = self.logged.commands()
            asked = arrived.effective_s, arrived.command_deg
            lost = unknown_deg(asked, self.sent_period_s, self._known.theta, time_s, self._unknown)
            noise_deg = np.hypot(noise_deg, lost)
        rows = [time_s, reading_deg, measured_deg, usable, np.isfinite(start_deg), noise_deg]
        self._pending.append(np.concatenate([np.stack(rows), slopes.T]))

    def _starts(self, ready: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Where to begin anew and what to judge, from the last seconds and what is ready."""
        self._seen = np.concatenate([self._seen, ready], axis=1)
        time_s, measured_deg = self._seen
        commands = self.logged.commands()
        first = max(int(np.searchsorted(commands.effective_s, time_s[0] - self._gap_s)) - 1, 0)
        command_s = commands.effective_s[first:]
        held_s = None if self.sent_period_s is None else HOLDS * self.sent_period_s
        start_deg, usable = starts(command_s, time_s, measured_deg, self._gap_s, self._begun_s, held_s)
        if not np.isfinite(self._begun_s):
            begun = np.flatnonzero(np.isfinite(start_deg))
            if begun.size:
                self._begun_s = float(time_s[begun[0]])
        count = ready.shape[1]
        kept = max(int(np.searchsorted(time_s, time_s[-1] - _BACK_S)) - 1, 0)  # and the one before, for pauses
        self._seen = self._seen[:, kept:]
        return start_deg[-count:], usable[-count:]

    def _judged(self, rows: FloatArray, error_deg: FloatArray, glitch: BoolArray) -> Piece:
        time_s, reading_deg, measured_deg = rows[0].copy(), rows[1].copy(), rows[2].copy()
        usable = (rows[3] != 0.0) & ~glitch
        error_deg = np.where(usable, error_deg, np.nan)
        sigma_deg, triple, grid_s, table = follow(
            self._tests, self._memory, time_s, error_deg, rows[6:].T.copy(), rows[5].copy()
        )
        rest = np.zeros(time_s.size)
        residuals = Residuals(
            time_s, reading_deg, measured_deg, error_deg, usable, -reading_deg, rows[4].astype(np.int8)
        )
        level_deg = self._limits[0] * sigma_deg
        threshold = Threshold("interval", level_deg, rest, rest, sigma_deg, self.evaluation.cusum, rest)
        raised = np.zeros(time_s.size, dtype=bool)
        at_s = self._alarm_s(time_s, triple, grid_s, table[:, : len(STATISTICS)])
        if np.isfinite(at_s):
            raised[int(np.searchsorted(time_s, at_s))] = True
            self.latched = True
        quiet = np.zeros(time_s.size, dtype=bool)
        self.history.append(History.packed(residuals, threshold, quiet))
        return Piece(residuals, threshold, quiet, raised, quiet)

    def _alarm_s(self, time_s: FloatArray, triple: FloatArray, grid_s: FloatArray, table: FloatArray) -> float:
        """When an alarm is raised in this piece; infinite if none is."""
        ratios = exceeded(self._limits, self._before, table)
        if len(table):
            self._before = table[-1]
        if self.latched:
            return float("inf")
        direct = time_s[triple >= self._limits[0]]
        second = grid_s[ratios >= 1.0]
        return float(min(direct.min(initial=np.inf), second.min(initial=np.inf)))
