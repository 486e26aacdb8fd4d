"""Readings that jump away and back: no servo does.

A sample that leaves its two predecessors by more than ten standard deviations of noise may be a glitch. The next one to
three samples tell: if they are back where those before it were, it was one. The noise is that of all second differences
so far, and where many positions jump, jumping is what this one does.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from servofd.core.statistics import LEAST_DIVISOR, MAD_TO_SIGMA
from servofd.core.types import BoolArray, FloatArray
from servofd.servo.loops import compiled, inlined

_PER_OCTAVE, _LOWEST_OCTAVE, _BINS = 16, -20, 640
"""From 1e-6 to 1e6, within 2.2 %."""


class RunningMedian(NamedTuple):
    """A histogram of logarithms, and where its middle is."""

    counts: NDArray[np.int64]
    place: NDArray[np.int64]
    """Of shape (3,): bin of the median, how many values lie below that, how many there are."""


def new_running_median() -> RunningMedian:
    """State of a running median before the first value."""
    return RunningMedian(np.zeros(_BINS, dtype=np.int64), np.zeros(3, dtype=np.int64))


@compiled
def with_value(median: RunningMedian, value: float) -> float:
    """Add a value above zero, and tell the median of all."""
    counts, place = median
    octave = np.log2(max(value, LEAST_DIVISOR))
    bin_ = int(min(max((octave - _LOWEST_OCTAVE) * _PER_OCTAVE, 0.0), _BINS - 1.0))
    counts[bin_] += 1
    place[2] += 1
    if bin_ < place[0]:
        place[1] += 1
    while place[1] > (place[2] - 1) // 2:
        place[0] -= 1
        place[1] -= counts[place[0]]
    while place[1] + counts[place[0]] <= (place[2] - 1) // 2:
        place[1] += counts[place[0]]
        place[0] += 1
    result: float = 2.0 ** ((place[0] + 0.5) / _PER_OCTAVE + _LOWEST_OCTAVE)
    return result


_AWAY_SIGMAS, _AGREEMENT_SIGMAS = 10.0, 8.0
"""Standard deviations of noise by which a glitch is away, and within which its neighbours agree."""
_MOST_GLITCHES, _FEW_GLITCHES = 0.02, 2
"""Where more than this share of the positions so far jump, jumping is what this position does."""
_LEAST_NOISE_DEG = 0.05
"""The noise is taken to be no less: what jumps by less than ten times that is no glitch."""
_MEDIAN_TO_SIGMA = float(MAD_TO_SIGMA / np.sqrt(6.0))
"""Median absolute second difference of white noise to its standard deviation."""
_FEWEST_BEFORE_GLITCH = 8
"""Samples that have to come before the noise is known."""
_WIDEST = 2
"""Samples that a glitch lasts at most."""


class GlitchMemory(NamedTuple):
    """What one piece of a stream leaves to the next."""

    curvature: RunningMedian
    state: FloatArray
    """Of shape (5,): the last two errors [deg], the noise [deg], how many samples were seen, how many were glitches."""


def new_glitch_memory() -> GlitchMemory:
    """Memory before the first sample."""
    return GlitchMemory(new_running_median(), np.array([np.nan, np.nan, _LEAST_NOISE_DEG, 0.0, 0.0]))


@compiled
def decide(
    memory: GlitchMemory, error_deg: FloatArray, restart: NDArray[np.int8], glitch: BoolArray, final: bool
) -> int:
    """Mark the glitches among the next samples in the last array but one, and tell how many samples are decided.

    The rest, three at most, waits for what comes after it, unless this is the end. A NaN is no sample; where `restart`
    is not zero, what was before does not count.
    """
    state = memory.state
    size, k = error_deg.size, 0
    while k < size:
        glitch[k] = False
        value = error_deg[k]
        if restart[k] != 0:
            state[0] = state[1] = np.nan
        if np.isnan(value):
            k += 1
            continue
        before_that, before, noise = state[0], state[1], state[2]
        if (
            state[3] >= _FEWEST_BEFORE_GLITCH
            and abs(value - before) > _AWAY_SIGMAS * noise
            and abs(before - before_that) <= _AGREEMENT_SIGMAS * noise
            and state[4] < max(_MOST_GLITCHES * state[3], float(_FEW_GLITCHES))
        ):
            width = _width(error_deg, restart, k, before, noise, final)
            if width < 0:
                return k
            if width > 0:
                marked, j = 0, k
                while marked < width:
                    glitch[j] = not np.isnan(error_deg[j])
                    marked += glitch[j]
                    j += 1
                state[3] += width
                state[4] += width
                k = j
                continue
        curvature = abs(value - 2.0 * before + before_that)
        if not np.isnan(curvature):
            state[2] = max(_MEDIAN_TO_SIGMA * with_value(memory.curvature, curvature), _LEAST_NOISE_DEG)
        state[0], state[1] = before, value
        state[3] += 1.0
        k += 1
    return k


@inlined
def _width(
    error_deg: FloatArray, restart: NDArray[np.int8], first: int, before: float, noise: float, final: bool
) -> int:
    """Samples that are away, 0 if they do not come back as they should, -1 if that is not known yet."""
    away = back = 0
    for k in range(first, error_deg.size):
        if k > first and restart[k] != 0:
            return 0
        distance = abs(error_deg[k] - before)
        if np.isnan(distance):
            continue
        if back == 0 and distance > _AWAY_SIGMAS * noise:
            away += 1
            if away > _WIDEST:
                return 0
        elif distance <= _AGREEMENT_SIGMAS * noise:
            back += 1
            if back == 2:
                return away
        else:
            return 0
    return 0 if final else -1


def glitches(error_deg: FloatArray, restart: NDArray[np.int8] | None = None) -> BoolArray:
    """Samples that jump away from their neighbours, alone or in pairs, while the neighbours agree; shape (n,)."""
    found = np.zeros(error_deg.size, dtype=bool)
    starts = np.zeros(error_deg.size, dtype=np.int8) if restart is None else restart
    decide(new_glitch_memory(), np.ascontiguousarray(error_deg), starts, found, True)
    return found
