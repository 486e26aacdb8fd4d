"""From residual to faults: threshold, latching, onset."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from servofd.models.play import play

if TYPE_CHECKING:
    from servofd.detection.residual import Residuals
    from servofd.segment import Segment
    from servofd.types import FloatArray

__all__ = ["Episode", "find_episodes"]

_QUIET_SHARE = 0.5
_TRAVEL_TO_CLEAR = 20.0
_ONSET_SHARE = 0.1
_ONSET_SIGMAS = 3.0
_SAMPLES_FOR_NOISE = 100
_MAD_TO_SIGMA = 1.4826


@dataclass(frozen=True, slots=True)
class Episode:
    """A fault from its onset until the surface has proved to be well again.

    Parameters
    ----------
    start_s : float
        Best estimate of when it began to show [s]: the residual leaves its noise.
    alarm_s : float
        First instant at which |residual| >= threshold (thesis Eq. 4.12) [s]; uses no later sample.
    end_s : float or None
        When it was last seen [s]; None if it lasts to the end of the log.
    """

    start_s: float
    alarm_s: float
    end_s: float | None


def find_episodes(segment: Segment, residuals: Residuals, threshold_deg: float) -> tuple[Episode, ...]:
    """Group threshold crossings into faults.

    The alarm latches. It clears only on evidence: the command must have made large moves (beyond a zone of
    twice the threshold, 20 thresholds of travel in all) while |residual| stayed below half the threshold. A
    stuck servo between two manoeuvres is quiet without being well, and stays one fault.

    Parameters
    ----------
    segment : Segment
        For the command's motion.
    residuals : Residuals
        Of that segment.
    threshold_deg : float
        Alarm level [deg].

    Returns
    -------
    tuple of Episode
        In order of time.
    """
    judged = np.flatnonzero(residuals.settled)
    size_deg = np.abs(residuals.residual_deg[judged])
    time_s = residuals.time_s[judged]
    loud = np.flatnonzero(size_deg >= _QUIET_SHARE * threshold_deg)
    if loud.size == 0:
        return ()
    travel_deg = _large_travel(segment, residuals, threshold_deg)[judged]
    enough_deg = _TRAVEL_TO_CLEAR * threshold_deg
    quiet_deg = np.diff(np.append(travel_deg[loud], travel_deg[-1]))
    last_of_group = np.flatnonzero(quiet_deg >= enough_deg)
    bounds = np.concatenate([[0], last_of_group + 1, [loud.size]])
    episodes = []
    for first, end in itertools.pairwise(bounds):
        group = loud[first:end]
        crossings = group[size_deg[group] >= threshold_deg]
        if crossings.size:
            cleared = quiet_deg[end - 1] >= enough_deg
            alarm = int(crossings[0])
            earliest = int(loud[first - 1]) + 1 if first else 0
            onset = _onset(size_deg, earliest, alarm, threshold_deg)
            end_s = float(time_s[group[-1]]) if cleared else None
            episodes.append(Episode(float(time_s[onset]), float(time_s[alarm]), end_s))
    return tuple(episodes)


def _large_travel(segment: Segment, residuals: Residuals, threshold_deg: float) -> FloatArray:
    """Path of the command beyond a zone of twice the threshold, counted while the surface was judged [deg]."""
    coarse = play(segment.command_deg, 2.0 * threshold_deg, float(segment.command_deg[0]))
    latest = np.searchsorted(segment.command_s, residuals.time_s, side="right") - 1
    moved_deg = np.abs(np.diff(coarse[np.maximum(latest, 0)], prepend=coarse[0]))
    travel: FloatArray = np.cumsum(np.where(residuals.settled, moved_deg, 0.0))
    return travel


def _onset(size_deg: FloatArray, earliest: int, alarm: int, threshold_deg: float) -> int:
    """Sample after the last one before the alarm whose residual was still within its noise."""
    before = size_deg[earliest:alarm]
    level_deg = _ONSET_SHARE * threshold_deg
    if before.size >= _SAMPLES_FOR_NOISE:
        level_deg = max(level_deg, _ONSET_SIGMAS * _MAD_TO_SIGMA * float(np.median(before)))
    inside = np.flatnonzero(before < level_deg)
    return min(earliest + int(inside[-1]) + 1, alarm) if inside.size else alarm
