"""From residual to alarms: persistence, suspicion, latching, onset; sample by sample, in flight and in audits alike."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from servofd.detection.glitches import RunningMedian, new_running_median, with_value
from servofd.estimate.statistics import MAD_TO_SIGMA
from servofd.servo.kernel import compiled

if TYPE_CHECKING:
    from servofd.core.types import BoolArray, FloatArray, IntArray
    from servofd.detection.residual import Residuals
    from servofd.detection.threshold import Threshold

QUIET_SHARE = 0.5
_TRAVEL_TO_CLEAR = 20.0


class LatchMemory(NamedTuple):
    """What one piece of a stream leaves to the next."""

    level: RunningMedian
    state: FloatArray
    """Of shape (6,): play of the immobile residual [deg], travel and travel at the last loud sample [thresholds],
    samples in a row beyond the level with their sign, whether an alarm stands, and the group of loud samples."""


class Latched(NamedTuple):
    """All of shape (n,), one entry per judged sample."""

    alarm: BoolArray
    """True where an alarm is raised."""
    clear: BoolArray
    """True where the alarm that stands has been disproved."""
    group: NDArray[np.int64]
    """Number of the group of loud samples; -1 where it is quiet."""


def new_latch_memory() -> LatchMemory:
    """Memory before the first sample."""
    return LatchMemory(new_running_median(), np.array([np.nan, 0.0, np.nan, 0.0, 0.0, 0.0]))


def latch(
    memory: LatchMemory,
    residual_deg: FloatArray,
    level_deg: FloatArray,
    immobile_deg: FloatArray,
    persistence: int,
    fixed_deg: float,
) -> Latched:
    """Follow the next judged samples, each of shape (n,); `fixed_deg` is a constant level, NaN if it varies."""
    size = residual_deg.size
    result = Latched(np.zeros(size, dtype=bool), np.zeros(size, dtype=bool), np.full(size, -1, dtype=np.int64))
    _latch(memory, residual_deg, level_deg, immobile_deg, float(persistence), fixed_deg, *result)
    return result


@compiled
def _latch(
    memory: LatchMemory,
    residual_deg: FloatArray,
    level_deg: FloatArray,
    immobile_deg: FloatArray,
    persistence: float,
    fixed_deg: float,
    alarm: BoolArray,
    clear: BoolArray,
    group: NDArray[np.int64],
) -> None:
    state = memory.state
    held, travel, loud_travel, row, stands, number = state[0], state[1], state[2], state[3], state[4], state[5]
    for k in range(residual_deg.size):
        # What a large move is, is told by the usual level so far; and by this one, while the command is lively.
        typical = fixed_deg if not np.isnan(fixed_deg) else with_value(memory.level, level_deg[k])
        typical = max(typical, level_deg[k])
        moved = held if not np.isnan(held) else immobile_deg[k]
        moved = min(max(moved, immobile_deg[k] - typical), immobile_deg[k] + typical)
        travel += abs(moved - held) / typical if not np.isnan(held) else 0.0
        held = moved
        size = abs(residual_deg[k])
        proved = travel - loud_travel >= _TRAVEL_TO_CLEAR
        if stands != 0.0 and proved:
            clear[k], stands = True, 0.0
        if size >= QUIET_SHARE * level_deg[k]:
            if proved:
                number += 1.0
            loud_travel = travel
            group[k] = int(number)
        side = 0.0 if size < level_deg[k] else (1.0 if residual_deg[k] > 0.0 else -1.0)
        row = row + side if row * side > 0.0 else side
        if abs(row) >= persistence and stands == 0.0:
            alarm[k], stands = True, 1.0
    state[0], state[1], state[2], state[3], state[4], state[5] = held, travel, loud_travel, row, stands, number


Level = Literal["suspect", "fault"]

_ONSET_SIGMAS = 4.5
_QUIET_BEFORE_ONSET_S = 0.5
_SAMPLES_FOR_NOISE = 100
_SUSPICION_LASTS_S = 10.0
"""The cumulative sum and the deviations look back about that far."""
_MEMORY_S = 60.0
"""How far back an onset is looked for."""


@dataclass(frozen=True, slots=True)
class Episode:
    """A fault, or the suspicion of one, from its onset until the surface has proved to be well again."""

    start_s: float
    """First estimate of when it began to show [s]: the residual leaves its noise and does not come back. Of a
    suspicion, when it was raised."""
    alarm_s: float
    """First instant at which |residual| >= threshold (thesis Eq. 4.12) for as many samples as asked for, or of a
    suspicion, when it was raised [s]; uses no later sample."""
    end_s: float | None
    """When it was last seen [s]; None if it lasts to the end of the log."""
    level: Level = "fault"
    """Whether the threshold was crossed."""
    suspected_s: float | None = None
    """When a suspicion came before the alarm of a fault [s]."""


def find_episodes(
    residuals: Residuals, threshold: Threshold, *, persistence: int = 1, suspicion: BoolArray | None = None
) -> tuple[Episode, ...]:
    """Group threshold crossings into faults, and what lies between them into suspicions.

    The alarm latches. It clears only on evidence: |residual| stayed below half the threshold during manoeuvres in
    which that of an immobile surface would have made large moves (beyond a zone of twice the threshold, 20
    thresholds of travel in all). A stuck servo between two manoeuvres is quiet without being well, and stays
    one fault; so does one that is commanded faster than the filter can see.

    Suspicions remember: they end when none was raised for 10 s, and what is raised within 10 s after a fault is an
    echo of that.
    """
    noticeable = np.abs(residuals.residual_deg) >= QUIET_SHARE * threshold.level_deg
    if not np.any(residuals.settled & (noticeable if suspicion is None else noticeable | suspicion)):
        return ()
    judged = np.flatnonzero(residuals.settled)
    time_s = residuals.time_s[judged]
    faults = _faults(residuals, threshold, judged, persistence)
    if suspicion is None:
        return faults
    suspected = _suspected(time_s, time_s[suspicion[judged] & ~_echoes(time_s, faults)])
    raised = [_with_suspicion(fault, suspected) for fault in faults]
    alone = (s for s in suspected if not any(_announces(s, fault) for fault in faults))
    return tuple(sorted([*raised, *alone], key=lambda episode: episode.start_s))


def _echoes(time_s: FloatArray, faults: tuple[Episode, ...]) -> BoolArray:
    """Instants during a fault and shortly after it, when suspicion is no news."""
    after_s = [np.inf if fault.end_s is None else fault.end_s + _SUSPICION_LASTS_S for fault in faults]
    steps = np.zeros(time_s.size + 1, dtype=np.int64)
    np.add.at(steps, np.searchsorted(time_s, [fault.alarm_s for fault in faults]), 1)
    np.add.at(steps, np.searchsorted(time_s, after_s, side="right"), -1)
    echo: BoolArray = np.cumsum(steps[:-1]) > 0
    return echo


def _faults(residuals: Residuals, threshold: Threshold, judged: IntArray, persistence: int) -> tuple[Episode, ...]:
    size_deg, time_s = np.abs(residuals.residual_deg[judged]), residuals.time_s[judged]
    found = latch(
        new_latch_memory(),
        residuals.residual_deg[judged],
        threshold.level_deg[judged],
        residuals.immobile_deg[judged],
        persistence,
        threshold.typical_deg if threshold.kind == "constant" else np.nan,
    )
    raised, tolerance_deg = np.flatnonzero(found.alarm), threshold.tolerance_deg[judged]
    loud = np.flatnonzero(found.group >= 0)
    first, behind = (np.searchsorted(found.group[loud], found.group[raised], side) for side in ("left", "right"))
    last_cleared = int(np.flatnonzero(found.clear)[-1]) if found.clear.any() else -1
    episodes = []
    for alarm, begin, end in zip(raised.tolist(), first.tolist(), behind.tolist(), strict=True):
        earliest = int(loud[begin - 1]) + 1 if begin else 0
        onset = _onset(time_s, size_deg, tolerance_deg, earliest, alarm)
        end_s = float(time_s[loud[end - 1]]) if last_cleared > alarm else None
        episodes.append(Episode(float(time_s[onset]), float(time_s[alarm]), end_s))
    return tuple(episodes)


def _suspected(time_s: FloatArray, raised_s: FloatArray) -> list[Episode]:
    """Stretches of suspicion."""
    if raised_s.size == 0:
        return []
    stretches = np.split(raised_s, np.flatnonzero(np.diff(raised_s) > _SUSPICION_LASTS_S) + 1)
    return [
        Episode(
            float(stretch[0]),
            float(stretch[0]),
            float(stretch[-1]) if time_s[-1] - stretch[-1] > _SUSPICION_LASTS_S else None,
            "suspect",
        )
        for stretch in stretches
    ]


def _announces(suspect: Episode, fault: Episode) -> bool:
    """Whether a suspicion came shortly before an alarm."""
    ends_s = np.inf if suspect.end_s is None else suspect.end_s
    return bool(suspect.start_s < fault.alarm_s and ends_s + _SUSPICION_LASTS_S >= fault.start_s)


def _with_suspicion(fault: Episode, suspected: list[Episode]) -> Episode:
    """A fault with the suspicion that announced it."""
    before = [s.alarm_s for s in suspected if _announces(s, fault)]
    return replace(fault, suspected_s=before[-1]) if before else fault


def _onset(time_s: FloatArray, size_deg: FloatArray, tolerance_deg: FloatArray, earliest: int, alarm: int) -> int:
    """First sample beyond noise and tolerance after the last quiet half second before the alarm."""
    earliest = max(earliest, int(np.searchsorted(time_s, time_s[alarm] - _MEMORY_S)))
    before = size_deg[earliest:alarm]
    level_deg = tolerance_deg[earliest : alarm + 1]
    if before.size >= _SAMPLES_FOR_NOISE:
        level_deg = np.maximum(level_deg, _ONSET_SIGMAS * MAD_TO_SIGMA * float(np.median(before)))
    level_deg = np.minimum(level_deg, size_deg[alarm])  # with no healthy time before it, the noise is the fault itself
    outside = earliest + np.flatnonzero(size_deg[earliest : alarm + 1] >= level_deg)
    pauses_s = np.diff(time_s[outside], prepend=-np.inf)
    return int(outside[np.flatnonzero(pauses_s >= _QUIET_BEFORE_ONSET_S)[-1]])
