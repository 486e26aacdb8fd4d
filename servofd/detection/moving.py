"""A healthy servo on its way beside a flight: how it moves, its noise, and what is left of the positions.

What a named servo does otherwise is in `servofd.detection.named`; what is tested of the residual, in
`servofd.detection.changes`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from servofd.detection.changes import STATISTICS, UNSEEN_S, Memory, Tested, Tests, follow, thresholds_of
from servofd.detection.residual import Residuals, Threshold
from servofd.estimate.family import new_state, sensitivities, simulated, variants
from servofd.estimate.fit import peaks, residual
from servofd.estimate.record import load_at

if TYPE_CHECKING:
    from servofd.aircraft.calibrated import CalibratedServo, Noise
    from servofd.core.types import BoolArray, FloatArray
    from servofd.estimate.record import Record
    from servofd.servo.context import Context

_MOST_HELD: Final = 4
"""Rows for which a logger holds a value, as marks know it (`servofd.aircraft.marks.Why.HELD`)."""


OtherMotion = Callable[..., "FloatArray"]
"""Where a servo with other parameters is at some samples (m,) [deg]; see `servofd.detection.named.Moves`."""


class Asked(NamedTuple):
    """What acts on a servo in a piece of a flight; arrays of shape (m,) unless said."""

    commands: tuple[FloatArray, FloatArray, FloatArray]
    """Times, values and slopes of those that are held, shape (n,)."""
    time_s: FloatArray
    load: FloatArray
    """Dynamic pressure over 300 Pa."""
    power: FloatArray
    """Supply over the usual one."""
    start_deg: FloatArray
    """Where it begins anew; NaN where it goes on."""


class Moved(NamedTuple):
    """How a healthy servo moves in a piece of a flight; arrays of shape (m,) unless said."""

    time_s: FloatArray
    reading_deg: FloatArray
    slopes: FloatArray
    """Sensitivities and patterns, shape (m, parameters + patterns)."""
    speed_deg_s: FloatArray
    """Of the servo, and the one that its drive aims at, shape (m, 2)."""
    start_deg: FloatArray
    """Where it begins anew; NaN where it goes on."""


class Shown(NamedTuple):
    """What is shown of a piece of a flight."""

    residuals: Residuals
    threshold: Threshold
    passed: FloatArray
    """By how much the residual passes its threshold so often in a row that it is an alarm, from 1 on, shape (m,)."""


class Moving:
    """A healthy servo on its way beside a flight, piece by piece: one of the family."""

    missed_deg = 0.0
    """What its model is known to miss of how a sound servo moves."""
    alone = False
    """Whether the threshold that is shown is the user's, and the only test."""
    at_once = False
    """Whether it is judged from where it begins at rest on, and not after a second."""
    own: OtherMotion | None = None
    """Its motion with other parameters, where that is not the family's."""

    def __init__(self, known: CalibratedServo, period_s: float) -> None:
        self.known, self._limit = known, thresholds_of(known)[0]
        self._table = variants(known.theta, middle_deg=known.middle_deg)
        self._state = new_state(self._table.shape[0])
        self._noise, self._peak = known.noise.at(period_s), np.array([0.0, np.nan])
        self._may_hold, self._last_deg, self._repeats = period_s > UNSEEN_S, np.nan, 0

    def surroundings(self, context: Context) -> None:
        """Airspeed and supply as far as they are known by now; its own come with each piece."""

    def forget(self, commands: int) -> None:
        """The oldest commands are no longer held."""
        self._state.forget(commands)

    def moved(self, asked: Asked) -> Moved:
        """How it moves at the next instants."""
        position_deg, speed_deg_s = simulated(self._table, self._state, *asked)
        reading_deg, slopes = sensitivities(position_deg, speed_deg_s, self.known.theta, self.known.reach_deg)
        return Moved(asked.time_s, reading_deg, slopes, speed_deg_s, asked.start_deg)

    def noise_deg(self, moved: Moved, measured_deg: FloatArray) -> FloatArray:  # noqa: ARG002 - known from good flights
        """Standard deviation of the noise of the positions (m,), as known at each instant [deg]."""
        return self._noise.sigma_deg(peaks(moved.speed_deg_s, moved.time_s, self._peak))

    def shown(
        self, moved: Moved, measured_deg: FloatArray, judged: BoolArray, tested: Tested, noise_deg: FloatArray
    ) -> Shown:
        """The error of the prediction, and the level that three in a row would have to pass; shape (m,) each."""
        error_deg, _ = residual(measured_deg, moved.reading_deg, self.known.reach_deg)
        error_deg = np.where(judged, error_deg, np.nan)
        anew = np.isfinite(moved.start_deg).astype(np.int8)
        residuals = Residuals(moved.time_s, moved.reading_deg, measured_deg, error_deg, judged, anew)
        threshold = Threshold("interval", self._limit * tested.sigma_deg, tested.sigma_deg, noise_deg)
        passed = tested.triple / self._limit
        if self._may_hold:
            passed[self._is_held(measured_deg)] = 0.0
        return Shown(residuals, threshold, passed)

    def _is_held(self, measured_deg: FloatArray) -> BoolArray:
        """Whether a position is that of two to four rows before it, shape (m,): for so long a slow logger may hold it.

        What repeats for longer is a surface that stands.
        """
        rows = np.arange(measured_deg.size)
        changed = measured_deg != np.append(self._last_deg, measured_deg[:-1])
        since = np.maximum.accumulate(np.where(changed, rows, -1))
        repeats = np.where(since >= 0, rows - since, rows + 1 + self._repeats)
        if rows.size:
            self._last_deg, self._repeats = float(measured_deg[-1]), int(repeats[-1])
        return (repeats >= 2) & (repeats <= _MOST_HELD)


@dataclass(frozen=True, slots=True, eq=False)
class Watched:
    """A stretch of flight of a surface beside its healthy servo; arrays of shape (m,) unless said."""

    known: CalibratedServo
    noise: Noise
    """At the rate of this flight."""
    record: Record
    reading_deg: FloatArray
    """Of the healthy servo."""
    slopes: FloatArray
    """Sensitivities and patterns, shape (m, parameters + patterns)."""
    judged: BoolArray
    noise_deg: FloatArray
    """Of the reading, and of the commands that were lost."""
    lost_deg: FloatArray
    """Of the latter alone."""
    tests: Tests
    tested: Tested
    shown: Shown
    alone: bool
    """Whether the threshold that is shown is the user's, and the only test."""
    own: OtherMotion | None
    """Motion of a named servo with other parameters; None for one of the family."""

    @property
    def ends_deg(self) -> tuple[float, float]:
        """Ends of the travel: those of the flights that it was fitted to, or as far as this one asked it to go."""
        if self.own is None or not self.reading_deg.size:
            return self.known.reach_deg
        return float(np.min(self.reading_deg)), float(np.max(self.reading_deg))

    @property
    def looked(self) -> tuple[Tests, Tested, BoolArray]:
        """Its tests, what came of them, and which samples they took."""
        return self.tests, self.tested, self.judged

    @property
    def sigma_deg(self) -> FloatArray:
        """Total."""
        return self.tested.sigma_deg

    @property
    def error_deg(self) -> FloatArray:
        """Residual; NaN where none is judged."""
        error_deg, _ = residual(self.record.measured_deg, self.reading_deg, self.known.reach_deg)
        return np.where(self.judged, error_deg, np.nan)


def watched(
    known: CalibratedServo, record: Record, moving: Moving | None = None, noise_deg: FloatArray | None = None
) -> Watched:
    """Simulate the healthy servo beside a record, and see what can be judged.

    `moving` moves it, as one of the family if left out; `noise_deg` (m,) is the noise of the positions, where a stream
    has seen more of them than these.
    """
    moving = moving or Moving(known, record.period_s)
    moved, noise_deg, lost_deg, tests = _beside(moving, record, noise_deg)
    error_deg, _ = residual(record.measured_deg, moved.reading_deg, known.reach_deg)
    usable = record.usable & (record.load <= load_at(known.last_judged_m_s))
    judged_deg = np.where(usable, error_deg, np.nan)
    tested = follow(tests, Memory(tests), record.time_s, judged_deg, moved.slopes, noise_deg, lost_deg)
    shown = moving.shown(moved, record.measured_deg, usable, tested, noise_deg)
    noise = known.noise.at(record.period_s)
    return Watched(
        known, noise, record, moved.reading_deg, moved.slopes, usable, noise_deg, lost_deg, tests, tested, shown,
        moving.alone, moving.own,
    )  # fmt: skip


def _beside(
    moving: Moving, record: Record, noise_deg: FloatArray | None
) -> tuple[Moved, FloatArray, FloatArray, Tests]:
    """How a healthy servo moves beside a record, and what tests need to know.

    Between them the noise of its positions, and how much of it comes of lost commands, (m,) each [deg].
    """
    moved = moving.moved(Asked(record.commands, record.time_s, record.load, record.power, record.start_deg))
    lost_deg = record.unknown_deg(moving.known.theta)
    if noise_deg is None:
        noise_deg = np.hypot(moving.noise_deg(moved, record.measured_deg), lost_deg)
    tests = Tests.of(moving.known, record.period_s, is_lossy=record.is_lossy, missed_deg=moving.missed_deg)
    return moved, noise_deg, lost_deg, tests


def statistics_of(known: CalibratedServo, record: Record, error_deg: FloatArray) -> FloatArray:
    """Largest value of each statistic for some residuals (m,) of a flight, as far as two in a row reach it."""
    moved, noise_deg, lost_deg, tests = _beside(Moving(known, record.period_s), record, None)
    tested = follow(tests, Memory(tests), record.time_s, error_deg, moved.slopes, noise_deg, lost_deg)
    statistics = tested.statistics[:, : len(STATISTICS)]
    if len(statistics) < 2:
        return np.zeros(len(STATISTICS))
    largest: FloatArray = np.minimum(statistics[1:], statistics[:-1]).max(axis=0)
    largest[0] = statistics[:, 0].max()
    return largest
