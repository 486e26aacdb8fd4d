"""Residual and threshold of one surface, piece by piece as commands and positions come in.

The steps are those of an audit (`servofd.detection.prepare`, `servofd.detection.threshold`); each carries its memory
from one piece to the next, so that it does not matter how a stream is cut. A position waits until no command can come
any more that it depends on: for the next command where that is overdue, since what was lost is put back on the
straight line between both; and for up to three positions after a jump, which may have been a glitch.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from servofd.detection.glitches import decide, new_glitch_memory
from servofd.detection.history import CommandBuffer, History
from servofd.detection.lags import FilterMemory, filtered_rows
from servofd.detection.latch import latch, new_latch_memory
from servofd.detection.residual import Residuals, go_on
from servofd.detection.starts import mark_starts, new_starts_memory
from servofd.detection.threshold import (
    PEAK_OF_LAGS,
    RECENT_COMMANDS,
    Evaluation,
    Threshold,
    constant_threshold,
    slower_generator,
    suspicion,
    unseen_deg,
)
from servofd.servo.motion import on_its_way

if TYPE_CHECKING:
    from servofd.aircraft.schema import Surface
    from servofd.core.types import BoolArray, FloatArray
    from servofd.detection.residual import ResidualGenerator, Rhythm
    from servofd.servo.context import Context

MEMORY_S = 600.0
"""How much of a flight a monitor remembers."""
_SURELY_NEXT = 0.75
"""Share of the command period within which no made-up command lies: between 1.5 and 2 periods, halved."""
FASTEST_COMMANDS_S = 0.005
_PENDING_ROWS = 7
_NOTHING_READY = np.zeros((2, 0))


class Piece(NamedTuple):
    """What has been decided; all of shape (n,), one entry per position."""

    residuals: Residuals
    threshold: Threshold
    suspicious: BoolArray
    alarm: BoolArray
    """True where an alarm is raised."""
    clear: BoolArray
    """True where the alarm that stands has been disproved."""


class Stream:
    """One surface."""

    def __init__(self, generator: ResidualGenerator, surface: Surface, period_s: float, beat: Rhythm) -> None:
        self._generator, self._surface, self._beat = generator, surface, beat
        self.longest_gap_s = generator.longest_gap_s_at(period_s)
        self.evaluation = Evaluation(generator, surface.tolerances, period_s)
        self._filter = generator.filter_parameters()
        self._delay_s = generator.model.plan.delay_s
        slower = slower_generator(generator, surface.tolerances.rate)
        self._motions = [on_its_way(each.model.servo()) for each in (generator, slower) if each is not None]
        self._cursors = [np.zeros(1, dtype=np.int64) for _ in self._motions]
        self._passed = PEAK_OF_LAGS * generator.pole_rad_s * period_s
        seconds = int(MEMORY_S / max(period_s, 1e-3))
        self.history = History(seconds)
        period_s = min(period_s, beat.period_s)
        room = int(MEMORY_S / max(period_s, FASTEST_COMMANDS_S))
        self.logged, self.effective = CommandBuffer(4096), CommandBuffer(room)
        self._starts, self._glitch, self._latch = new_starts_memory(), new_glitch_memory(), new_latch_memory()
        self._cusum = np.zeros(2)
        self._lags = FilterMemory.of(self._filter, 3)
        self._positions: list[tuple[float, float]] = []
        self._pending = np.zeros((_PENDING_ROWS, 0))
        self._unseen: list[tuple[float, float]] = []
        self._newest_s = -np.inf
        self.latest_s = -np.inf

    def surroundings(self, context: Context) -> None:
        """Airspeed and supply, as far as they are known by now; effects of the servo may depend on them."""
        for motion in self._motions:
            motion.context = context

    def command(self, time_s: float, command_deg: float) -> None:
        """Add a command [deg]; one that is no later than the one before is left out."""
        if not time_s > self._newest_s:
            return
        shift_s = self._delay_s
        if self._surface.command_period_s is not None:
            self._straight(time_s, command_deg, shift_s + self._surface.command_period_s / 2.0)
        else:
            self._put_back(time_s, command_deg, shift_s)
            self._add(time_s + shift_s, command_deg, 0.0)
        self._newest_s = time_s
        dropped = self.logged.append(time_s, command_deg, 0.0)
        self._starts.cursor[0] = max(self._starts.cursor[0] - dropped, 0)

    def position(self, time_s: float, measured_deg: float) -> None:
        """Add a position [deg], NaN where there is none; one that is no later than the one before is left out."""
        if time_s > self.latest_s:
            self.latest_s = time_s
            self._positions.append((time_s, measured_deg))

    @property
    def is_waiting(self) -> bool:
        """Whether any position waits for a command."""
        return bool(self._positions)

    def again(self) -> None:
        """The alarm that stood is over."""
        self._latch.state[3:5] = 0.0

    def evaluate(self, *, final: bool = False) -> Piece | None:
        """Evaluate what can be decided by now; everything if nothing more will come. None if that is nothing."""
        ready = self._ready(final=final)
        if ready.size == 0 and not final:
            return None  # what waits behind a jump waits for a position
        self._simulate(ready)
        pending = self._pending
        if pending.shape[1] == 0:
            return None
        glitch = np.zeros(pending.shape[1], dtype=bool)
        error_deg = np.ascontiguousarray(pending[2] - pending[1])
        count = decide(self._glitch, error_deg, pending[4].astype(np.int8), glitch, final)
        self._pending = pending[:, count:]
        if count == 0:
            return None
        return self._judged(pending[:, :count], glitch[:count])

    def _add(self, effective_s: float, command_deg: float, slope_deg_s: float) -> None:
        dropped = self.effective.append(effective_s, command_deg, slope_deg_s)
        for cursor in self._cursors:
            cursor[0] = max(cursor[0] - dropped, 0)

    def _straight(self, time_s: float, command_deg: float, shift_s: float) -> None:
        """Thinned commands run straight to the next one; no position is evaluated until that is known."""
        step_s = time_s - self._newest_s
        if step_s <= self.longest_gap_s:
            self.effective.bend(command_deg, step_s)
        self._add(time_s + shift_s, command_deg, 0.0)

    def _put_back(self, time_s: float, command_deg: float, shift_s: float) -> None:
        """Commands that were lost, on the straight line between their neighbours."""
        step_s, before_s = time_s - self._newest_s, self._newest_s
        if not self._beat.longest_s < step_s <= self.longest_gap_s:
            return
        recent_deg = self.logged.commands().command_deg[-RECENT_COMMANDS - 1 :]
        pieces = int(np.round(step_s / self._beat.period_s))
        for place in range(1, pieces):
            share = place / pieces
            self._add(before_s + share * step_s + shift_s, recent_deg[-1] + share * (command_deg - recent_deg[-1]), 0.0)
        size_deg = self._passed * unseen_deg(recent_deg, pieces - 1)
        self._unseen.append((before_s + step_s / pieces + shift_s, size_deg))

    def _ready(self, *, final: bool) -> FloatArray:
        """Positions that no later command can change, of shape (2, n)."""
        known_s = self._newest_s
        if self._surface.command_period_s is None and np.isfinite(self._beat.period_s):
            known_s += _SURELY_NEXT * self._beat.period_s
        if final or self.latest_s - self._newest_s > self.longest_gap_s:
            known_s = np.inf
        count = sum(1 for time_s, _ in self._positions if time_s <= known_s)
        if count == 0:
            return _NOTHING_READY
        ready, self._positions = self._positions[:count], self._positions[count:]
        return np.array(ready, dtype=float).reshape(-1, 2).T.copy()

    def _simulate(self, ready: FloatArray) -> None:
        """Add what a healthy servo, and the slowest one tolerated, would have done."""
        time_s, measured_deg = ready
        if time_s.size == 0:
            return
        starts = mark_starts(
            self._starts,
            self.logged.time_s,
            time_s,
            measured_deg,
            self.longest_gap_s,
            self._beat.longest_s,
            self._generator.blanking_s,
        )
        commands = self.effective.commands()
        moved = [
            go_on(motion, commands, cursor, time_s, starts.measured_deg, starts.restart)
            for motion, cursor in zip(self._motions, self._cursors, strict=True)
        ]
        simulated_deg, slower_deg = moved[0], moved[-1]
        added_deg = np.zeros(time_s.size)
        while self._unseen and self._unseen[0][0] <= time_s[-1]:
            at_s, size_deg = self._unseen.pop(0)
            added_deg[np.searchsorted(time_s, at_s)] += size_deg
        rows = [time_s, simulated_deg, starts.measured_deg, starts.settled, starts.restart, slower_deg, added_deg]
        waiting = self._pending.shape[1]
        pending = np.empty((_PENDING_ROWS, waiting + time_s.size))
        pending[:, :waiting] = self._pending
        for place, row in enumerate(rows):
            pending[place, waiting:] = row
        self._pending = pending

    def _judged(self, rows: FloatArray, glitch: BoolArray) -> Piece:
        """Residual, threshold and alarms of what was decided."""
        time_s, simulated_deg, measured_deg = rows[0].copy(), rows[1].copy(), np.where(glitch, np.nan, rows[2])
        restart = rows[4].astype(np.int8)
        inputs = np.empty((3, time_s.size))
        inputs[0] = measured_deg - simulated_deg
        inputs[1] = -simulated_deg
        inputs[2] = rows[5] - simulated_deg
        outputs = filtered_rows(self._filter, self._lags, time_s, inputs, restart)
        settled = (rows[3] != 0.0) & ~glitch
        residuals = Residuals(time_s, simulated_deg, measured_deg, outputs[0], settled, outputs[1], restart)
        rate_error_deg = outputs[2] if len(self._motions) > 1 else np.zeros(0)
        sigmas = self._surface.threshold_sigmas
        threshold = self.evaluation.threshold(residuals, rate_error_deg, rows[6].copy(), sigmas)
        if self._surface.threshold == "constant":
            threshold = constant_threshold(threshold, self._surface.threshold_deg)
        suspicious = suspicion(residuals, threshold, self._cusum)
        alarm, clear = self._latched(residuals, threshold)
        self.history.append(History.packed(residuals, threshold, suspicious))
        return Piece(residuals, threshold, suspicious, alarm, clear)

    def _latched(self, residuals: Residuals, threshold: Threshold) -> tuple[BoolArray, BoolArray]:
        judged = residuals.settled
        found = latch(
            self._latch,
            residuals.residual_deg[judged],
            threshold.level_deg[judged],
            residuals.immobile_deg[judged],
            self._surface.persistence,
            self._surface.threshold_deg if self._surface.threshold == "constant" else np.nan,
        )
        alarm, clear = np.zeros(judged.size, dtype=bool), np.zeros(judged.size, dtype=bool)
        alarm[judged], clear[judged] = found.alarm, found.clear
        return alarm, clear
