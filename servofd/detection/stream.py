"""Residual and threshold of one surface, piece by piece as commands and positions come in, and what is remembered.

The steps are those of an audit (`servofd.detection.changes`, and `servofd.detection.named` for what a named servo does
otherwise); each carries its memory from one piece to the next, so that it does not matter how a stream is cut. A
position waits for the next command, since what was lost is put back on the straight line between two.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from servofd.aircraft.pace import Rhythm, gap_s, rhythm
from servofd.aircraft.series import Series
from servofd.core.series import subdivided
from servofd.detection.changes import STATISTICS, Memory, Tests, first_over, follow
from servofd.detection.moving import Asked
from servofd.detection.residual import Residuals, Threshold
from servofd.estimate.family import LONGEST_PAUSE_S
from servofd.estimate.fit import residual
from servofd.estimate.record import FINE_S, LONGEST_S, load_at, loads, new_memory, powers, put_back, starts, unknown_deg
from servofd.servo.context import NO_CONTEXT
from servofd.servo.effects.commands import Commands

if TYPE_CHECKING:
    from collections.abc import Callable

    from servofd.aircraft.schema import Surface
    from servofd.core.types import BoolArray, FloatArray, Marks
    from servofd.detection.faults import Found, Named
    from servofd.detection.moving import Moving
    from servofd.detection.residual import ThresholdKind
    from servofd.servo.context import Context

_DROPPED = 4
"""One part in so many is dropped when the room is full."""
_OF_RESIDUALS = ("time_s", "simulated_deg", "measured_deg", "residual_deg", "settled", "restart")
_OF_LEVELS = ("level_deg", "sigma_deg", "noise_deg")


class Latest:
    """Columns of numbers in order of their first one, a time [s]; `capacity` at most, the latest of them."""

    def __init__(self, rows: int, capacity: int) -> None:
        self._rows = np.zeros((rows, capacity))
        self.size = 0

    @property
    def rows(self) -> FloatArray:
        """Of shape (rows, `size`), without copies."""
        return self._rows[:, : self.size]

    @property
    def time_s(self) -> FloatArray:
        """Times of the columns, shape (n,) [s]."""
        return self._rows[0, : self.size]

    @property
    def last_s(self) -> float:
        """Time of the latest column [s]; NaN without any."""
        return float(self.time_s[-1]) if self.size else float("nan")

    def append(self, columns: FloatArray) -> int:
        """Add some, of shape (rows, n), and tell how many of the oldest had to be dropped."""
        dropped = at = 0
        while at < columns.shape[1]:
            if self.size == self._rows.shape[1]:
                fewer = self.size // _DROPPED
                self._rows[:, : self.size - fewer] = self._rows[:, fewer : self.size].copy()
                self.size, dropped = self.size - fewer, dropped + fewer
            count = min(columns.shape[1] - at, self._rows.shape[1] - self.size)
            self._rows[:, self.size : self.size + count] = columns[:, at : at + count]
            self.size, at = self.size + count, at + count
        return dropped


class History(Latest):
    """Evaluated samples."""

    def __init__(self, capacity: int) -> None:
        super().__init__(len(_OF_RESIDUALS) + len(_OF_LEVELS), capacity)

    def keep(self, residuals: Residuals, threshold: Threshold) -> None:
        """Add those of a piece."""
        rows = [getattr(residuals, name) for name in _OF_RESIDUALS] + [getattr(threshold, name) for name in _OF_LEVELS]
        self.append(np.array(rows, dtype=float))

    def forget(self, from_s: float, until_s: float) -> None:
        """Drop samples after one time until another [s]."""
        first, last = np.searchsorted(self.time_s, (from_s, until_s), side="right").tolist()
        left = self.rows[:, last:].copy()
        self.size = first
        self.append(left)

    def first_from(self, time_s: float) -> float:
        """Time of the first sample from then on [s], or of the latest."""
        return float(self.time_s[min(int(np.searchsorted(self.time_s, time_s)), self.size - 1)])

    def snapshot(self, kind: ThresholdKind, from_s: float, until_s: float) -> tuple[Residuals, Threshold]:
        """Residuals and threshold from a time until another [s], copied; models begin anew with them."""
        last = int(np.searchsorted(self.time_s, until_s, side="right"))
        rows = self.rows[:, min(int(np.searchsorted(self.time_s, from_s)), last - 1) : last].copy()
        known, levels = dict(zip(_OF_RESIDUALS, rows, strict=False)), rows[len(_OF_RESIDUALS) :]
        known |= {"settled": known["settled"] != 0.0, "restart": known["restart"].astype(np.int8)}
        known["restart"][0] = 1
        threshold = Threshold(kind, **dict(zip(_OF_LEVELS, levels, strict=True)))
        return Residuals(**known), threshold


class CommandBuffer(Latest):
    """Commands of one surface."""

    def __init__(self, capacity: int) -> None:
        super().__init__(3, capacity)

    def add(self, time_s: FloatArray, command_deg: FloatArray) -> int:
        """Add some that hold, of shape (n,), and tell how many of the oldest had to be dropped."""
        return self.append(np.stack([time_s, command_deg, np.zeros(time_s.size)]))

    def commands(self) -> Commands:
        """The same without copies."""
        return Commands(*self.rows)

    def copied(self, from_s: float) -> Commands:
        """Those that matter from then on [s], to be kept."""
        first = max(int(np.searchsorted(self.time_s, from_s - LONGEST_PAUSE_S)) - 1, 0)
        return Commands(*self.rows[:, first:].copy())


MEMORY_S = 600.0
"""How much of a flight a monitor remembers."""
FASTEST_COMMANDS_S = 0.005
"""Shortest period of commands for which room is kept [s]."""


BY_WINDOWS, BY_LEVEL, BY_OTHER = 1, 2, 3
"""What raises an alarm: windows alone, of which the bank tells more, residuals over their threshold, or the windows of
another witness."""


class Piece(NamedTuple):
    """What has been decided; all of shape (n,), one entry per position."""

    residuals: Residuals
    threshold: Threshold
    alarm: Marks
    """What raises one where an alarm is raised, else 0."""
    sharp: BoolArray
    """Whether what arrived tells of the servo, and not mostly of the commands that did not."""


class Remembered(NamedTuple):
    """A copy of what a stream remembers of a surface."""

    residuals: Residuals
    threshold: Threshold
    commands: Commands
    """As they reach the servo."""


class Following:
    """What a monitor hands commands and readings of one surface to, a reading every so often [s]."""

    is_of_two = False
    """Whether another witness is followed beside the position."""
    beside: Piece | None = None
    """What was decided just now of its current, where a position is followed as well."""
    logged: CommandBuffer
    """Commands as they came."""

    def __init__(self, period_s: float) -> None:
        self.latched = 0
        self.history = History(int(MEMORY_S / max(period_s, 1e-3)))
        self.latest_s = -np.inf
        self._newest: tuple[float, float] = (-np.inf, 0.0)
        """The latest command, when [s] and what [deg]."""
        self._positions: list[tuple[float, float]] = []

    def commands(self, time_s: FloatArray, command_deg: FloatArray) -> None:
        """Add commands [deg], of shape (n,); what is no later than one before is left out."""
        latest_s = np.maximum.accumulate(np.append(self._newest[0], time_s))
        fresh = time_s > latest_s[:-1]
        if fresh.any():
            self._take(time_s[fresh], command_deg[fresh])
            self._newest = float(time_s[fresh][-1]), float(command_deg[fresh][-1])

    def _take(self, time_s: FloatArray, command_deg: FloatArray) -> None:
        """Keep commands that are later than those before."""
        raise NotImplementedError

    def position(self, time_s: float, measured_deg: float) -> None:
        """Add a reading, NaN where there is none; one that is no later than the one before is left out."""
        if time_s > self.latest_s:
            self.latest_s = time_s
            self._positions.append((time_s, measured_deg))

    def drawn(self, time_s: float, current: float) -> None:
        """Add a reading of the current beside the position, in the unit of its channel."""

    @property
    def is_waiting(self) -> bool:
        """Whether any reading waits for a command."""
        return bool(self._positions)

    def lost_share(self, since_s: float) -> float:  # noqa: ARG002 - of a steady stream
        """Share of the commands that were lost since then [s]; 0 where their rhythm is not known."""
        return 0.0

    def surroundings(self, context: Context) -> None:
        """Airspeed and supply, as far as they are known by now."""
        raise NotImplementedError

    def evaluate(self, *, final: bool = False) -> Piece | None:
        """Evaluate what can be decided by now; everything if nothing more will come. None if that is nothing."""
        raise NotImplementedError

    def found(self, seen: Remembered, names: dict[float, Named]) -> Found:
        """Faults and suspicions of what is remembered; depends on nothing that changes as the stream goes on."""
        raise NotImplementedError

    def finder(self, seen: Remembered, names: dict[float, Named], until_s: float) -> Callable[[], Found]:  # noqa: ARG002 - of another witness
        """Finds them in what is remembered until a time [s]."""
        return partial(self.found, seen, names)

    def again(self) -> None:
        """Begin the tests anew, because the alarm that stood is over."""
        raise NotImplementedError


_BACK_S: Final = 3.0
"""Positions of the last seconds that are kept, for what begins or pauses there [s]."""
_LATE: Final = 2.0


class Stream(Following):
    """The position of a surface beside its healthy servo.

    `command_s` are the times of the first commands, for their rhythm, and `sent_period_s` what passes between commands
    as they were sent, where most of them get lost [s]; `judge` finds the faults of what is remembered, of which the
    noise of the positions is known.
    """

    def __init__(
        self,
        moving: Moving,
        surface: Surface,
        period_s: float,
        command_s: FloatArray,
        sent_period_s: float | None,
        judge: Callable[[Series, FloatArray, dict[float, Named]], Found],
    ) -> None:
        super().__init__(period_s)
        self.surface, self._moving, self._judge, self._period_s = surface, moving, judge, period_s
        self.longest_gap_s = gap_s(command_s) if sent_period_s is None else LONGEST_S
        self.sent_period_s = sent_period_s
        self._context = NO_CONTEXT
        self._begin_tests()
        self._before = np.zeros(len(STATISTICS))
        fastest_s = FINE_S if surface.command_period_s is not None else FASTEST_COMMANDS_S
        self.logged = CommandBuffer(int(MEMORY_S / fastest_s))
        self._beat = rhythm(command_s) if sent_period_s is None else Rhythm.of_link(sent_period_s)
        loses = surface.command_period_s is None and np.isfinite(self._beat.period_s)
        self._filled = CommandBuffer(int(MEMORY_S / fastest_s)) if loses else self.logged
        self._unknown = new_memory()
        self._seen = np.zeros((2, 0))
        self._begun_s = np.nan

    def lost_share(self, since_s: float) -> float:
        """Share of the commands that were lost since then [s]; 0 where their rhythm is not known."""
        came_s = self.logged.time_s[np.searchsorted(self.logged.time_s, since_s) :]
        if self._filled is self.logged or came_s.size < 2:
            return 0.0
        sent = max(float(came_s[-1] - came_s[0]) / self._beat.period_s, 1.0)
        return max(1.0 - (came_s.size - 1) / sent, 0.0)

    def again(self) -> None:
        """Begin the tests anew, because the alarm that stood is over."""
        self._memory, self.latched = Memory(self._tests), 0
        self._before = np.zeros(len(STATISTICS))

    def surroundings(self, context: Context) -> None:
        """Airspeed and supply, as far as they are known by now."""
        began = context.airspeed_s.size > 0 and not self._context.airspeed_s.size
        self._context = context
        self._moving.surroundings(context)
        if began:
            self._begin_tests()

    def _begin_tests(self) -> None:
        """Make ready what tests a residual; without airspeed more is unknown."""
        known, is_lossy = self._moving.known, self.sent_period_s is not None
        known = known if self._context.airspeed_s.size else known.without_airspeed()
        self._tests = Tests.of(known, self._period_s, is_lossy=is_lossy, missed_deg=self._moving.missed_deg)
        self._memory = Memory(self._tests)

    def found(self, seen: Remembered, names: dict[float, Named]) -> Found:
        """What the audit finds in what is remembered."""
        residuals, threshold, commands = seen
        segment = Series("", commands.effective_s, commands.command_deg, residuals.time_s, residuals.measured_deg)
        segment = replace(segment, sent_period_s=self.sent_period_s, context=residuals.context)
        return self._judge(segment, threshold.noise_deg, names)

    def evaluate(self, *, final: bool = False) -> Piece | None:
        """Evaluate what can be decided by now; everything if nothing more will come. None if that is nothing.

        A position waits for the next command, but not for longer than twice the longest gap.
        """
        known_s = self._newest[0]
        if final or self.latest_s - known_s > _LATE * self.longest_gap_s:
            known_s = np.inf
        count = sum(1 for time_s, _ in self._positions if time_s <= known_s)
        if not count or not self.logged.size:
            return None
        ready, self._positions = self._positions[:count], self._positions[count:]
        return self._judged(np.array(ready, dtype=float).T.copy())

    def _take(self, time_s: FloatArray, command_deg: FloatArray) -> None:
        """Keep commands, and put back those that a link has lost between them."""
        ends = time_s, command_deg
        if np.isfinite(self._newest[0]):
            ends = np.append(self._newest[0], time_s), np.append(self._newest[1], command_deg)
        known = ends[0].size - time_s.size
        if self._filled is not self.logged:
            filled_s, filled_deg = put_back(*ends, self._beat, self.longest_gap_s)
            self._moving.forget(self._filled.add(filled_s[known:], filled_deg[known:]))
        elif self.surface.command_period_s is not None:
            steps_s = np.diff(ends[0])
            pieces = np.where(steps_s <= self.longest_gap_s, np.maximum(np.round(steps_s / FINE_S), 1.0), 1.0)
            time_s, command_deg = (each[known:] for each in subdivided(*ends, pieces.astype(np.int64)))
        dropped = self.logged.add(time_s, command_deg)
        if self._filled is self.logged:
            self._moving.forget(dropped)
        else:
            self._unknown[0] = max(self._unknown[0] - dropped, 0.0)

    def position(self, time_s: float, measured_deg: float) -> None:
        """Add a position [deg]; one that is no later than the one before, or none, is left out."""
        if np.isfinite(measured_deg):
            super().position(time_s, measured_deg)

    def _judged(self, ready: FloatArray) -> Piece:
        """Residual, threshold and alarms of positions (2, n) whose commands are known."""
        known, moving = self._moving.known, self._moving
        start_deg, usable = self._starts(ready)
        time_s, measured_deg = ready
        load, power = loads(self._context, time_s, known.airspeed_m_s), powers(self._context, time_s, known.supply_v)
        usable = usable & (load <= load_at(known.last_judged_m_s))
        moved = moving.moved(Asked(self._filled.commands(), time_s, load, power, start_deg))
        noise_deg, lost_deg = moving.noise_deg(moved, measured_deg), np.zeros(time_s.size)
        if self._filled is not self.logged:
            arrived = self.logged.commands()
            asked = arrived.effective_s, arrived.command_deg
            lost_deg = unknown_deg(asked, self._beat, known.theta, time_s, self._unknown, self.longest_gap_s)
            noise_deg = np.hypot(noise_deg, lost_deg)
        error_deg, _ = residual(measured_deg, moved.reading_deg, known.reach_deg)
        judged_deg = np.where(usable, error_deg, np.nan)
        tested = follow(self._tests, self._memory, time_s, judged_deg, moved.slopes, noise_deg, lost_deg)
        residuals, threshold, passed = moving.shown(moved, measured_deg, usable, tested, noise_deg)
        count = 0 if moving.alone else len(tested.statistics)
        statistics = tested.statistics[:count, : len(STATISTICS)]
        raised = self._alarms(time_s, passed, tested.grid_s[:count], statistics)
        self.history.keep(residuals, threshold)
        return Piece(residuals, threshold, raised, tested.sharp)

    def _starts(self, ready: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Where to begin anew and what to judge, from the last seconds and what is ready."""
        self._seen = np.concatenate([self._seen, ready], axis=1)
        time_s, measured_deg = self._seen
        commands = self.logged.commands()
        first = max(int(np.searchsorted(commands.effective_s, time_s[0] - self.longest_gap_s)) - 1, 0)
        command_s = commands.effective_s[first:]
        held_s = None if self.sent_period_s is None else self._beat.longest_s
        asked_deg = commands.command_deg[first:] if self._moving.at_once else None
        start_deg, usable = starts(
            command_s, time_s, measured_deg, self.longest_gap_s, self._begun_s, held_s, asked_deg
        )
        if not np.isfinite(self._begun_s):
            begun = np.flatnonzero(np.isfinite(start_deg))
            if begun.size:
                self._begun_s = float(time_s[begun[0]])
        count = ready.shape[1]
        kept = max(int(np.searchsorted(time_s, time_s[-1] - _BACK_S)) - 1, 0)  # and the one before, for pauses
        self._seen = self._seen[:, kept:]
        return start_deg[-count:], usable[-count:]

    def _alarms(self, time_s: FloatArray, passed: FloatArray, grid_s: FloatArray, statistics: FloatArray) -> Marks:
        """Where an alarm is raised, shape (n,), by the fast test over its threshold (n,) and the windows (g, k)."""
        by_level_s, by_windows_s = first_over(self._tests.limits, self._before, (time_s, passed), (grid_s, statistics))
        if len(statistics):
            self._before = statistics[-1]
        raised = np.zeros(time_s.size, dtype=np.int8)
        for what, at_s in ((BY_WINDOWS, by_windows_s), (BY_LEVEL, by_level_s)):
            if at_s < np.inf and self.latched < what:
                raised[int(np.searchsorted(time_s, at_s))] = self.latched = what
        return raised
