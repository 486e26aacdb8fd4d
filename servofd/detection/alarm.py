"""From residual to faults: threshold, persistence, suspicion, latching, onset."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from servofd.detection.latch import QUIET_SHARE, latch, new_latch_memory
from servofd.estimate.statistics import MAD_TO_SIGMA

if TYPE_CHECKING:
    from servofd.core.types import BoolArray, FloatArray, IntArray
    from servofd.detection.residual import Residuals
    from servofd.detection.threshold import Threshold

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
    """A fault, or the suspicion of one, from its onset until the surface has proved to be well again.

    Parameters
    ----------
    start_s : float
        First estimate of when it began to show [s]: the residual leaves its noise and does not come back. Of a
        suspicion, when it was raised.
    alarm_s : float
        First instant at which |residual| >= threshold (thesis Eq. 4.12) for as many samples as asked for, or of a
        suspicion, when it was raised [s]; uses no later sample.
    end_s : float or None
        When it was last seen [s]; None if it lasts to the end of the log.
    level : {"suspect", "fault"}
        Whether the threshold was crossed.
    suspected_s : float or None
        When a suspicion came before the alarm of a fault [s].
    """

    start_s: float
    alarm_s: float
    end_s: float | None
    level: Level = "fault"
    suspected_s: float | None = None


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

    Parameters
    ----------
    suspicion : ndarray of bool, shape (n,), optional
        Where something too small for the threshold has lasted too long.
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
