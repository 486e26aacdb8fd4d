"""Residual and threshold of one surface, piece by piece as commands and positions come in, and what is remembered.

The steps are those of an audit (`servofd.detection.residual`, `servofd.detection.threshold`, or for a calibrated
surface `servofd.detection.changes`); each carries its memory from one piece to the next, so that it does not matter
how a stream is cut. A position waits until no command can come any more that it depends on: for the next command where
that is overdue, since what was lost is put back on the straight line between both.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from servofd.aircraft.series import settled_from_s
from servofd.detection.changes import STATISTICS, Memory, Tests, exceeded, follow, shown, thresholds_of
from servofd.detection.faults import judge_stretch
from servofd.detection.named import (
    beside,
    in_a_row,
    judged_named,
    named_servo,
    noise_of_named,
    own_slopes,
    tests_of_named,
    watched_named,
)
from servofd.detection.residual import (
    PEAK_OF_LAGS,
    RECENT_COMMANDS,
    RESTART_ALL,
    Commands,
    FilterMemory,
    ResidualGenerator,
    Residuals,
    filter_in_place,
    go_on,
    mark_starts,
    new_starts_memory,
    unseen_deg,
)
from servofd.detection.threshold import Evaluation, Threshold, constant_threshold
from servofd.estimate.family import LONGEST_PAUSE_S, new_state, sensitivities, simulated, variants
from servofd.estimate.fit import peaks, residual
from servofd.estimate.record import (
    FINE_S,
    HOLDS,
    LONGEST_S,
    gap_s,
    load_at,
    loads,
    new_memory,
    powers,
    put_back,
    starts,
    unknown_deg,
)
from servofd.servo.context import NO_CONTEXT
from servofd.servo.motion import Motion

if TYPE_CHECKING:
    from servofd.aircraft.calibrated import CalibratedServo
    from servofd.aircraft.schema import Surface
    from servofd.core.types import BoolArray, FloatArray, Marks
    from servofd.detection.faults import Found, Named
    from servofd.detection.residual import Rhythm
    from servofd.detection.threshold import ThresholdKind
    from servofd.servo.context import Context

_DROPPED = 4
"""One part in so many is dropped when the room is full."""
_OF_RESIDUALS = ("time_s", "simulated_deg", "measured_deg", "residual_deg", "settled", "immobile_deg", "restart")
_OF_LEVELS = ("level_deg", "tolerance_deg", "saturated_deg", "sigma_deg")


class History:
    """Evaluated samples, the latest of them; `capacity` at most."""

    ROWS = len(_OF_RESIDUALS) + len(_OF_LEVELS)

    def __init__(self, capacity: int) -> None:
        self._rows = np.zeros((self.ROWS, capacity))
        self.size = 0

    def append(self, rows: FloatArray) -> None:
        """Add samples, of shape (`ROWS`, n)."""
        capacity, count = self._rows.shape[1], rows.shape[1]
        if self.size + count > capacity:
            kept = max(min(self.size, capacity - capacity // _DROPPED - count), 0)
            self._rows[:, :kept] = self._rows[:, self.size - kept : self.size].copy()
            self.size = kept
        count = min(count, capacity)
        self._rows[:, self.size : self.size + count] = rows[:, rows.shape[1] - count :]
        self.size += count

    @property
    def last_s(self) -> float:
        """Time of the latest sample [s]; NaN without any."""
        return float(self._rows[0, self.size - 1]) if self.size else float("nan")

    @staticmethod
    def packed(residuals: Residuals, threshold: Threshold) -> FloatArray:
        """Rows of a piece, of shape (`ROWS`, n)."""
        rows = [getattr(residuals, name) for name in _OF_RESIDUALS] + [getattr(threshold, name) for name in _OF_LEVELS]
        return np.array(rows, dtype=float)

    def first_from(self, time_s: float) -> float:
        """Time of the first sample from then on [s], or of the latest."""
        return float(self._rows[0, min(int(np.searchsorted(self._rows[0, : self.size], time_s)), self.size - 1)])

    def snapshot(
        self, kind: ThresholdKind, noise_gain: float, from_s: float, until_s: float
    ) -> tuple[Residuals, Threshold]:
        """Residuals and threshold from a time until another [s], copied; models begin anew with them."""
        time_s = self._rows[0, : self.size]
        last = int(np.searchsorted(time_s, until_s, side="right"))
        rows = self._rows[:, min(int(np.searchsorted(time_s, from_s)), last - 1) : last].copy()
        known, levels = dict(zip(_OF_RESIDUALS, rows, strict=False)), rows[len(_OF_RESIDUALS) :]
        known |= {"settled": known["settled"] != 0.0, "restart": known["restart"].astype(np.int8)}
        known["restart"][0] = RESTART_ALL
        threshold = Threshold(kind, noise_gain=noise_gain, **dict(zip(_OF_LEVELS, levels, strict=True)))
        return Residuals(**known), threshold


class CommandBuffer:
    """Commands of one surface as they are logged and as they reach the servo, with what was lost put back.

    The same as `servofd.detection.residual.commands_at_servo`, command by command.
    """

    def __init__(self, capacity: int) -> None:
        self._rows = np.zeros((3, capacity))
        self.size = 0

    def append(self, time_s: float, command_deg: float, slope_deg_s: float) -> int:
        """Add one, and tell how many of the oldest had to be dropped."""
        dropped = 0
        if self.size == self._rows.shape[1]:
            dropped = self.size // _DROPPED
            self._rows[:, : self.size - dropped] = self._rows[:, dropped : self.size].copy()
            self.size -= dropped
        self._rows[:, self.size] = time_s, command_deg, slope_deg_s
        self.size += 1
        return dropped

    def bend(self, command_deg: float, step_s: float) -> None:
        """Let the latest command run straight to the next one, which comes so much later."""
        if self.size:
            self._rows[2, self.size - 1] = (command_deg - self._rows[1, self.size - 1]) / step_s

    @property
    def time_s(self) -> FloatArray:
        """Times of the samples, shape (n,) [s]."""
        return self._rows[0, : self.size]

    def commands(self) -> Commands:
        """The same without copies."""
        return Commands(*self._rows[:, : self.size])

    def copied(self, from_s: float) -> Commands:
        """Those that matter from then on [s], to be kept."""
        first = max(int(np.searchsorted(self.time_s, from_s - LONGEST_PAUSE_S)) - 1, 0)
        return Commands(*self._rows[:, first : self.size].copy())


MEMORY_S = 600.0
"""How much of a flight a monitor remembers."""
_SURELY_NEXT = 0.75
"""Share of the command period within which no made-up command lies: between 1.5 and 2 periods, halved."""
FASTEST_COMMANDS_S = 0.005
"""Shortest period of commands for which room is kept [s]."""


BY_WINDOWS, BY_LEVEL = 1, 2
"""What raises an alarm: windows alone, of which the bank tells more, or residuals over their threshold."""


class Piece(NamedTuple):
    """What has been decided; all of shape (n,), one entry per position."""

    residuals: Residuals
    threshold: Threshold
    alarm: Marks
    """`BY_LEVEL` or `BY_WINDOWS` where an alarm is raised, else 0."""


class Remembered(NamedTuple):
    """A copy of what a stream remembers of a surface."""

    residuals: Residuals
    threshold: Threshold
    commands: Commands
    """As they reach the servo."""


class Following:
    """What a monitor hands commands and readings of one surface to, a reading every so often [s]."""

    noise_gain = 1.0
    """Of the residual's noise over the reading's."""
    doubts_wiring = False
    """Whether sign and scale may be wrong, which the good flights of a calibrated surface have shown to be right."""
    logged: CommandBuffer
    effective: CommandBuffer
    """Commands as they came, and as they reach the servo."""

    def __init__(self, period_s: float) -> None:
        self.latched = 0
        self.history = History(int(MEMORY_S / max(period_s, 1e-3)))
        self.latest_s = -np.inf
        self._newest: tuple[float, float] = (-np.inf, 0.0)
        """The latest command, when [s] and what [deg]."""
        self._positions: list[tuple[float, float]] = []

    def command(self, time_s: float, command_deg: float) -> None:
        """Add a command [deg]; one that is no later than the one before is left out."""
        raise NotImplementedError

    def position(self, time_s: float, measured_deg: float) -> None:
        """Add a reading, NaN where there is none; one that is no later than the one before is left out."""
        if time_s > self.latest_s:
            self.latest_s = time_s
            self._positions.append((time_s, measured_deg))

    @property
    def is_waiting(self) -> bool:
        """Whether any reading waits for a command."""
        return bool(self._positions)

    def surroundings(self, context: Context) -> None:
        """Airspeed and supply, as far as they are known by now."""
        raise NotImplementedError

    def evaluate(self, *, final: bool = False) -> Piece | None:
        """Evaluate what can be decided by now; everything if nothing more will come. None if that is nothing."""
        raise NotImplementedError

    def found(self, seen: Remembered, names: dict[float, Named]) -> Found:
        """Faults and suspicions of what is remembered; depends on nothing that changes as the stream goes on."""
        raise NotImplementedError

    def again(self) -> None:
        """Begin the tests anew, because the alarm that stood is over."""
        raise NotImplementedError


class _Waiting(Following):
    """What both kinds of positions do: they wait until they are decided, and then are tested."""

    def __init__(self, surface: Surface, known: CalibratedServo, period_s: float, longest_gap_s: float) -> None:
        super().__init__(period_s)
        self.surface, self.longest_gap_s = surface, longest_gap_s
        self._known_servo, self._period_s = known, period_s
        self._limits = thresholds_of(known)
        self._table = variants(known.theta)
        self._state = new_state(self._table.shape[0])
        self._context = NO_CONTEXT
        self._begin_tests()
        self._before = np.zeros(len(STATISTICS))

    def again(self) -> None:
        """Begin the tests anew, because the alarm that stood is over."""
        self._memory, self.latched = Memory(self._tests), 0
        self._before = np.zeros(len(STATISTICS))

    def evaluate(self, *, final: bool = False) -> Piece | None:
        """Evaluate what can be decided by now; everything if nothing more will come. None if that is nothing."""
        known_s, patience_s = self._known()
        if final or self.latest_s - self._newest[0] > patience_s:
            known_s = np.inf
        count = sum(1 for time_s, _ in self._positions if time_s <= known_s)
        if not count:
            return None
        ready, self._positions = self._positions[:count], self._positions[count:]
        rows = self._simulated(np.array(ready, dtype=float).T.copy())
        return None if rows is None else self._judged(rows)

    def _begin_tests(self) -> None:
        """Make ready what tests a residual."""
        self._tests = self._new_tests()
        self._memory = Memory(self._tests)

    def _new_tests(self) -> Tests:
        raise NotImplementedError

    def _alarms(self, time_s: FloatArray, passed: FloatArray, grid_s: FloatArray, statistics: FloatArray) -> Marks:
        """Where an alarm is raised, shape (n,), by the fast test over its threshold (n,) and the windows (g, k)."""
        ratios = exceeded(self._limits, self._before, statistics)
        if len(statistics):
            self._before = statistics[-1]
        raised = np.zeros(time_s.size, dtype=np.int8)
        for what, over_s in ((BY_WINDOWS, grid_s[ratios >= 1.0]), (BY_LEVEL, time_s[passed >= 1.0])):
            if over_s.size and self.latched < what:
                raised[int(np.searchsorted(time_s, over_s[0]))] = self.latched = what
        return raised

    def _known(self) -> tuple[float, float]:
        """Until when no command can come any more [s], and for how long one is waited for [s]."""
        raise NotImplementedError

    def _simulated(self, ready: FloatArray) -> FloatArray | None:
        """Rows of what is ready (2, n): time, simulated, measured, whether to judge, where to start anew; then more.

        None before any command.
        """
        raise NotImplementedError

    def _judged(self, rows: FloatArray) -> Piece:
        """Residual, threshold and alarms of what was decided."""
        raise NotImplementedError


class Stream(_Waiting):
    """A surface whose servo is named."""

    doubts_wiring = True

    def __init__(self, generator: ResidualGenerator, surface: Surface, period_s: float, beat: Rhythm) -> None:
        self._evaluation = Evaluation(generator, surface.tolerances, period_s)
        self.noise_gain = self._evaluation.noise_gain
        known = named_servo(generator.model, surface.tolerances, period_s)
        super().__init__(surface, known, period_s, generator.longest_gap_s_at(period_s))
        self._generator, self._beat = generator, beat
        self._filter = generator.filter_parameters()
        self._delay_s = generator.model.delay_s
        servo = generator.model.servo()
        self._motions = [Motion(each) for each in (servo, *beside(servo, surface.tolerances))]
        self._cursors = [np.zeros(1, dtype=np.int64) for _ in self._motions]
        self._passed = PEAK_OF_LAGS * generator.pole_rad_s * period_s
        room = int(MEMORY_S / max(min(period_s, beat.period_s), FASTEST_COMMANDS_S))
        self.logged, self.effective = CommandBuffer(4096), CommandBuffer(room)
        self._starts = new_starts_memory()
        self._last = np.array([np.nan, np.nan])
        """The sample before, its time [s] and the healthy deflection [deg]."""
        self._ratios = np.zeros(0)
        """Residual over threshold of the judged samples before, as many as make an alarm together with one more."""
        self._lags = FilterMemory.of(self._filter, 3)
        self._unseen: list[tuple[float, float]] = []
        self._logged_s, self._begun_s, self._settled_s = np.inf, np.nan, np.inf
        """When the first command came [s], the first position that had one, and from when on it has settled."""
        self._early: list[tuple[float, float]] = []

    def surroundings(self, context: Context) -> None:
        """Airspeed and supply, as far as they are known by now; effects of the servo may depend on them."""
        self._context = context
        for motion in self._motions:
            motion.context = context

    def _new_tests(self) -> Tests:
        return tests_of_named(self._known_servo, self._period_s)

    def found(self, seen: Remembered, names: dict[float, Named]) -> Found:
        """What the audit finds in what is remembered."""
        flight = watched_named(self._generator, self.surface, *seen, self._period_s)
        return judged_named(flight, tells=self.surface.tells_small_faults, asked=False, names=names)

    def command(self, time_s: float, command_deg: float) -> None:
        """Add a command [deg]; one that is no later than the one before is left out."""
        if not time_s > self._newest[0]:
            return
        shift_s, step_s = self._delay_s, time_s - self._newest[0]
        if self.surface.command_period_s is not None:
            # Thinned commands run straight to the next one; no position is evaluated until that is known.
            shift_s += self.surface.command_period_s / 2.0
            if step_s <= self.longest_gap_s:
                self.effective.bend(command_deg, step_s)
        elif self._beat.longest_s < step_s <= self.longest_gap_s:
            self._put_back(time_s, command_deg, shift_s)
        self._add(time_s + shift_s, command_deg, 0.0)
        self._newest = (time_s, command_deg)
        self._logged_s = min(self._logged_s, time_s)
        dropped = self.logged.append(time_s, command_deg, 0.0)
        self._starts[4] = max(self._starts[4] - dropped, 0.0)

    def _add(self, effective_s: float, command_deg: float, slope_deg_s: float) -> None:
        dropped = self.effective.append(effective_s, command_deg, slope_deg_s)
        self._state.forget(dropped)
        for cursor in self._cursors:
            cursor[0] = max(cursor[0] - dropped, 0)

    def _put_back(self, time_s: float, command_deg: float, shift_s: float) -> None:
        """Commands that were lost, on the straight line between their neighbours."""
        step_s, (before_s, before_deg) = time_s - self._newest[0], self._newest
        recent_deg = self.logged.commands().command_deg[-RECENT_COMMANDS - 1 :]
        pieces = int(np.round(step_s / self._beat.period_s))
        for place in range(1, pieces):
            share = place / pieces
            self._add(before_s + share * step_s + shift_s, before_deg + share * (command_deg - before_deg), 0.0)
        size_deg = self._passed * unseen_deg(recent_deg, pieces - 1)
        self._unseen.append((before_s + step_s / pieces + shift_s, size_deg))

    def _known(self) -> tuple[float, float]:
        known_s = self._newest[0]
        if self.surface.command_period_s is None and np.isfinite(self._beat.period_s):
            known_s += _SURELY_NEXT * self._beat.period_s
        return known_s, self.longest_gap_s

    def _simulated(self, ready: FloatArray) -> FloatArray:
        """What a healthy servo would have done, the slowest one tolerated, what lost commands may add; then slopes."""
        time_s, measured_deg = ready
        limits_s = self.longest_gap_s, self._beat.longest_s, self._generator.blanking_s
        starts = mark_starts(self._starts, self.logged.time_s, time_s, measured_deg, limits_s)
        if np.isnan(self._begun_s) and self._logged_s < np.inf:
            self._begun_s = max(self._logged_s, float(time_s[0]))
        if not np.isfinite(self._settled_s) and np.isfinite(self._begun_s):
            self._early += zip(time_s.tolist(), measured_deg.tolist(), strict=True)
            given = self.logged.commands()
            asked = self.logged.time_s, given.command_deg
            self._settled_s = settled_from_s(self._begun_s, asked, *np.array(self._early).T)
        starts = starts._replace(settled=starts.settled & (time_s >= self._settled_s))
        commands = self.effective.commands()
        moved = [
            go_on(motion, commands, cursor, time_s, starts.measured_deg, starts.restart)
            for motion, cursor in zip(self._motions, self._cursors, strict=True)
        ]
        added_deg = np.zeros(time_s.size)
        while self._unseen and self._unseen[0][0] <= time_s[-1]:
            at_s, size_deg = self._unseen.pop(0)
            added_deg[np.searchsorted(time_s, at_s)] += size_deg
        healthy_deg, *others_deg = moved
        held = commands.effective_s - self._delay_s, commands.command_deg, commands.slope_deg_s
        start_deg = np.where(starts.restart == RESTART_ALL, starts.measured_deg, np.nan)
        position_deg, speed_deg_s = simulated(
            self._table, self._state, held, time_s, loads(self._context, time_s), np.ones(time_s.size), start_deg
        )
        known = self._known_servo
        _, slopes = sensitivities(position_deg, speed_deg_s, known.theta, known.reach_deg)
        slopes = own_slopes(slopes, time_s, (healthy_deg, *others_deg), self.surface.tolerances, self._last)
        rows = time_s, healthy_deg, starts.measured_deg, starts.settled, starts.restart, others_deg[-1], added_deg
        return np.concatenate([np.stack(rows), slopes.T])

    def _judged(self, rows: FloatArray) -> Piece:
        time_s, simulated_deg, measured_deg = rows[0].copy(), rows[1].copy(), rows[2].copy()
        restart, settled = rows[4].astype(np.int8), rows[3] != 0.0
        residual_deg = measured_deg - simulated_deg
        others_deg = np.stack([-simulated_deg, rows[5] - simulated_deg])
        filter_in_place(self._filter, self._lags, time_s, residual_deg, restart, others_deg)
        residuals = Residuals(time_s, simulated_deg, measured_deg, residual_deg, settled, others_deg[0], restart)
        limited = self._generator.model.weaker(self.surface.tolerances.rate) is not self._generator.model
        rate_error_deg = others_deg[1] if limited else np.zeros(0)
        sigmas = self.surface.threshold_sigmas
        threshold = self._evaluation.threshold(residuals, rate_error_deg, rows[6].copy(), sigmas)
        if self.surface.threshold == "constant":
            threshold = constant_threshold(threshold, self.surface.threshold_deg)
        tested_deg = np.where(settled, residuals.error_deg, np.nan)
        slopes, noise_deg = rows[7:].T.copy(), noise_of_named(threshold)
        _, _, grid_s, table = follow(self._tests, self._memory, time_s, tested_deg, slopes, noise_deg)
        # A level that the file or the user names is the only test.
        count = 0 if self.surface.threshold == "constant" else len(table)
        alarm = self._alarms(time_s, self._over(residuals, threshold), grid_s[:count], table[:count, : len(STATISTICS)])
        self.history.append(History.packed(residuals, threshold))
        return Piece(residuals, threshold, alarm)

    def _over(self, residuals: Residuals, threshold: Threshold) -> FloatArray:
        """The residual over its threshold, as in `servofd.detection.named.over`, with the samples before."""
        judged = residuals.settled
        ratios = residuals.residual_deg[judged] / threshold.level_deg[judged]
        kept = self.surface.persistence - 1
        before, self._ratios = self._ratios, np.append(self._ratios, ratios)[-kept:] if kept else self._ratios
        out = np.zeros(judged.size)
        out[judged] = in_a_row(np.append(before, ratios), kept + 1)[before.size :]
        return out


_BACK_S: Final = 3.0
"""Positions of the last seconds that are kept, for what begins or pauses there [s]."""
_LATE: Final = 2.0


class CalibratedStream(_Waiting):
    """A calibrated surface.

    `command_s` are the times of the first commands, for their rhythm, and `sent_period_s` what passes between commands
    as they were sent, where most of them get lost [s].
    """

    def __init__(
        self,
        known: CalibratedServo,
        surface: Surface,
        period_s: float,
        command_s: FloatArray,
        sent_period_s: float | None = None,
    ) -> None:
        longest_gap_s = gap_s(command_s) if sent_period_s is None else LONGEST_S
        self.sent_period_s = sent_period_s
        super().__init__(surface, known, period_s, longest_gap_s)
        self._noise = known.noise.noise.at(period_s)
        self._peak = np.array([0.0, np.nan])
        fastest_s = FINE_S if surface.command_period_s is not None else FASTEST_COMMANDS_S
        self.logged = CommandBuffer(int(MEMORY_S / fastest_s))
        self.effective = self.logged
        self._filled = self.logged if sent_period_s is None else CommandBuffer(int(MEMORY_S / fastest_s))
        self._unknown = new_memory()
        self._seen = np.zeros((2, 0))
        self._begun_s = np.nan

    def surroundings(self, context: Context) -> None:
        """Airspeed and supply, as far as they are known by now."""
        began = context.airspeed_s.size > 0 and not self._context.airspeed_s.size
        self._context = context
        if began:
            self._begin_tests()

    def found(self, seen: Remembered, names: dict[float, Named]) -> Found:
        """What the audit finds in what is remembered."""
        return judge_stretch(self._known_servo, seen.residuals, seen.commands, self.sent_period_s, names)

    def _new_tests(self) -> Tests:
        """Without airspeed more is unknown."""
        known = self._known_servo if self._context.airspeed_s.size else self._known_servo.without_airspeed()
        is_lossy = self.sent_period_s is not None
        return Tests.of(known.noise.noise, known.covariance, self._period_s, is_lossy=is_lossy)

    def command(self, time_s: float, command_deg: float) -> None:
        """Add a command [deg]; one that is no later than the one before is left out."""
        before_s, before_deg = self._newest
        if not time_s > before_s:
            return
        if self.sent_period_s is not None:
            self._fill(time_s, command_deg)
        elif self.surface.command_period_s is not None and time_s - before_s < 1.0:
            pieces = max(round((time_s - before_s) / FINE_S), 1)
            for place in range(1, pieces):
                share = place / pieces
                self._add(before_s + share * (time_s - before_s), before_deg + share * (command_deg - before_deg))
        self._add(time_s, command_deg)
        self._newest = (time_s, command_deg)

    def position(self, time_s: float, measured_deg: float) -> None:
        """Add a position [deg]; one that is no later than the one before, or none, is left out."""
        if np.isfinite(measured_deg):
            super().position(time_s, measured_deg)

    def _add(self, time_s: float, command_deg: float) -> None:
        dropped = self.logged.append(time_s, command_deg, 0.0)
        if self._filled is self.logged:
            self._state.forget(dropped)
        else:
            self._unknown[0] = max(self._unknown[0] - dropped, 0.0)

    def _fill(self, time_s: float, command_deg: float) -> None:
        """Commands that were lost before this one, and it."""
        (before_s, before_deg), period_s = self._newest, self.sent_period_s or np.inf
        filled = [(time_s, command_deg)]
        if HOLDS * period_s < time_s - before_s <= LONGEST_S:
            ends = np.array([before_s, time_s]), np.array([before_deg, command_deg])
            filled = list(zip(*(column[1:].tolist() for column in put_back(*ends, period_s)), strict=True))
        for at_s, asked_deg in filled:
            dropped = self._filled.append(at_s, asked_deg, 0.0)
            self._state.forget(dropped)

    def _known(self) -> tuple[float, float]:
        return self._newest[0], _LATE * self.longest_gap_s

    def _simulated(self, ready: FloatArray) -> FloatArray | None:
        """What the servo would have done; then its noise, sensitivities and patterns. Nothing before any command."""
        if self.logged.size == 0:
            return None
        known = self._known_servo
        start_deg, usable = self._starts(ready)
        time_s, measured_deg = ready
        load = loads(self._context, time_s, known.airspeed_m_s)
        usable = usable & (load <= load_at(known.last_judged_m_s))
        power = powers(self._context, time_s, known.supply_v)
        commands = self._filled.commands()
        position_deg, speed_deg_s = simulated(
            self._table,
            self._state,
            (commands.effective_s, commands.command_deg, commands.slope_deg_s),
            time_s,
            load,
            power,
            start_deg,
        )
        reading_deg, slopes = sensitivities(position_deg, speed_deg_s, known.theta, known.reach_deg)
        noise_deg = self._noise.sigma_deg(peaks(speed_deg_s, time_s, self._peak))
        if self.sent_period_s is not None:
            arrived = self.logged.commands()
            asked = arrived.effective_s, arrived.command_deg
            lost = unknown_deg(asked, self.sent_period_s, known.theta, time_s, self._unknown)
            noise_deg = np.hypot(noise_deg, lost)
        rows = [time_s, reading_deg, measured_deg, usable, np.isfinite(start_deg), noise_deg]
        return np.concatenate([np.stack(rows), slopes.T])

    def _starts(self, ready: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Where to begin anew and what to judge, from the last seconds and what is ready."""
        self._seen = np.concatenate([self._seen, ready], axis=1)
        time_s, measured_deg = self._seen
        commands = self.logged.commands()
        first = max(int(np.searchsorted(commands.effective_s, time_s[0] - self.longest_gap_s)) - 1, 0)
        command_s = commands.effective_s[first:]
        held_s = None if self.sent_period_s is None else HOLDS * self.sent_period_s
        start_deg, usable = starts(command_s, time_s, measured_deg, self.longest_gap_s, self._begun_s, held_s)
        if not np.isfinite(self._begun_s):
            begun = np.flatnonzero(np.isfinite(start_deg))
            if begun.size:
                self._begun_s = float(time_s[begun[0]])
        count = ready.shape[1]
        kept = max(int(np.searchsorted(time_s, time_s[-1] - _BACK_S)) - 1, 0)  # and the one before, for pauses
        self._seen = self._seen[:, kept:]
        return start_deg[-count:], usable[-count:]

    def _judged(self, rows: FloatArray) -> Piece:
        time_s, reading_deg, measured_deg, usable = rows[0].copy(), rows[1].copy(), rows[2].copy(), rows[3] != 0.0
        error_deg, _ = residual(measured_deg, reading_deg, self._known_servo.reach_deg)
        error_deg = np.where(usable, error_deg, np.nan)
        sigma_deg, triple, grid_s, table = follow(
            self._tests, self._memory, time_s, error_deg, rows[6:].T.copy(), rows[5].copy()
        )
        residuals, threshold = shown(
            (time_s, reading_deg, measured_deg, error_deg),
            usable,
            rows[4] != 0.0,
            self._limits[0],
            sigma_deg,
        )
        raised = self._alarms(time_s, triple / self._limits[0], grid_s, table[:, : len(STATISTICS)])
        self.history.append(History.packed(residuals, threshold))
        return Piece(residuals, threshold, raised)
