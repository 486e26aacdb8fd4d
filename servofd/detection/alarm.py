"""From residual to faults: threshold, latching, onset."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from servofd.models.play import play

if TYPE_CHECKING:
    from servofd.detection.residual import Residuals
    from servofd.types import FloatArray

__all__ = ["Episode", "find_episodes"]

_QUIET_SHARE = 0.5
_TRAVEL_TO_CLEAR = 20.0
_ONSET_SHARE = 0.1
_ONSET_SIGMAS = 4.5
_QUIET_BEFORE_ONSET_S = 0.5
_SAMPLES_FOR_NOISE = 100
_MAD_TO_SIGMA = 1.4826


@dataclass(frozen=True, slots=True)
class Episode:
    """A fault from its onset until the surface has proved to be well again.

    Parameters
    ----------
    start_s : float
        Best estimate of when it began to show [s]: the residual leaves its noise and does not come back.
    alarm_s : float
        First instant at which |residual| >= threshold (thesis Eq. 4.12) [s]; uses no later sample.
    end_s : float or None
        When it was last seen [s]; None if it lasts to the end of the log.
    """

    start_s: float
    alarm_s: float
    end_s: float | None


def find_episodes(residuals: Residuals, immobile_deg: FloatArray, threshold_deg: float) -> tuple[Episode, ...]:
    """Group threshold crossings into faults.

    The alarm latches. It clears only on evidence: |residual| stayed below half the threshold during manoeuvres in
    which that of an immobile surface would have made large moves (beyond a zone of twice the threshold, 20
    thresholds of travel in all). A stuck servo between two manoeuvres is quiet without being well, and stays
    one fault; so does one that is commanded faster than the filter can see.

    Parameters
    ----------
    residuals : Residuals
        Of one surface.
    immobile_deg : ndarray, shape (n,)
        Residual that the same command would cause if the surface did not move at all [deg].
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
    travel_deg = _large_travel(immobile_deg[judged], threshold_deg)
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
            onset = _onset(time_s, size_deg, earliest, alarm, threshold_deg)
            end_s = float(time_s[group[-1]]) if cleared else None
            episodes.append(Episode(float(time_s[onset]), float(time_s[alarm]), end_s))
    return tuple(episodes)


def _large_travel(immobile_deg: FloatArray, threshold_deg: float) -> FloatArray:
    """Path that the residual of an immobile surface covers beyond a zone of twice the threshold [deg]."""
    coarse = play(immobile_deg, 2.0 * threshold_deg, float(immobile_deg[0]))
    travel: FloatArray = np.cumsum(np.abs(np.diff(coarse, prepend=coarse[0])))
    return travel


def _onset(time_s: FloatArray, size_deg: FloatArray, earliest: int, alarm: int, threshold_deg: float) -> int:
    """First sample outside the noise after the last quiet half second before the alarm."""
    before = size_deg[earliest:alarm]
    level_deg = _ONSET_SHARE * threshold_deg
    if before.size >= _SAMPLES_FOR_NOISE:
        level_deg = max(level_deg, _ONSET_SIGMAS * _MAD_TO_SIGMA * float(np.median(before)))
    level_deg = min(level_deg, threshold_deg)  # with no healthy time before it, the noise is the fault itself
    outside = earliest + np.flatnonzero(size_deg[earliest : alarm + 1] >= level_deg)
    pauses_s = np.diff(time_s[outside], prepend=-np.inf)
    return int(outside[np.flatnonzero(pauses_s >= _QUIET_BEFORE_ONSET_S)[-1]])
