"""Servos that are slower, or move by less, since some instant and to the end of a flight: the whole of it shows that.

A servo that has lost half of its speed follows calm commands almost as before: no window of seconds tells it from one
whose model is a little wrong. What the model lacks is there from the beginning, though, and so is whatever it learnt
from a part that was not sound; a change is not. With A and b the sums of products of the whitened sensitivities, and of
these with the residual (n: of all parameters, over the whole flight; h: of a change, since an instant t),

    z(t) = (b_h(t) - A_hn(t) M b_n) / sqrt(A_hh(t) - A_hn(t) M A_nh(t) + 1),    M = (A_nn + Sigma^-1)^-1,

is the score of a change that sets in then and stays, of unit variance where the model is right; where it leaves more
than the noise, over what it leaves. Half its square is what the change explains, in nats. Servos of one supply lose
their speed at once, and add up what each explains.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from servofd.aircraft.priors import FITTED, NAMES
from servofd.detection.changes import ROW, UNITS
from servofd.estimate.family import PATTERNS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servofd.core.types import FloatArray, IntArray
    from servofd.detection.moving import Watched

_COLUMNS: Final = (
    FITTED + PATTERNS.index("weak"), NAMES.index("gain"), FITTED + PATTERNS.index("play"), NAMES.index("bias_deg"),
)  # fmt: skip
"""Changes that are looked for: half the torque, travel that is lost, play, and an offset to either side."""
_WEAK, _LOST, _OFFSET, _FAULTS = 0, 1, 3, slice(0, 2)
"""Places of some, and of those that are a fault where the whole flight alone shows them."""
_ROWS: Final = 65_536
"""Samples that are worked on at a time: those of a day take more memory than there is."""
_SHORTEST_S: Final = 5.0
"""Least time before and after an instant."""
_LARGEST: Final = 6.0
"""Standard deviations that one residual counts for: a jam is not slowness, however long it lasts."""
_ALONE: Final = 24.0
"""Score of either change that no sound servo reaches, 1.4 times the largest: 17.7 and 16.5 of 466 surfaces of 100
aircraft that were fitted to their log, 17.0 and 12.1 of 742 of 14 that were calibrated on another flight (even seeds of
`benchmarks/strangers.py`). At half speed 46 of 56 of the latter are found with it, 25 without."""
_TOGETHER_NATS: Final = 100.0
"""What servos of one log have to explain together, without the one that explains most: 190 and more in 14 flights
with much motion whose servos all lost half their speed. Of the same aircraft 44 in sound flights, and 99 beside a servo
that failed, each taken at its best instant (`benchmarks/evidence.py`, even seeds); 85 and 138 with those that were
calibrated."""
_LITTLE: Final = 8.0
"""Score below which no change is worth looking for, of either sign."""
_EACH: Final = 6.0
"""Score of a servo that is one of them: the least is 9.3 in those 14 flights. More than half of a log's are."""
WITHIN_S: Final = 2.0
"""Time around the instant of all in which each shows it best."""


class Lasting(NamedTuple):
    """Scores of changes that last to the end, shape (g, 4), by the instants in which they set in [s], shape (g,)."""

    since_s: FloatArray
    scores: FloatArray

    def slower(self, at_s: FloatArray) -> FloatArray:
        """Scores of being slower since some instants [s], of their shape; 0 before the first and after the last known.

        Where nothing is judged for a while, that of the end of the hole: only what comes after an instant tells.
        """
        place = np.searchsorted(self.since_s, at_s)
        is_before = at_s < self.since_s.min(initial=np.inf)
        return np.where(is_before, 0.0, np.append(self.scores[:, _WEAK], 0.0)[place])

    def is_slower_near(self, at_s: float) -> bool:
        """Whether it shows at an instant [s], or next after it, what servos of one supply show together."""
        near = np.abs(self.since_s - at_s) <= WITHIN_S
        place = int(np.searchsorted(self.since_s, at_s))
        near[place : place + 1] |= place > 0
        return bool(self.scores[near, _WEAK].max(initial=0.0) > _EACH)

    def beyond_doubt_s(self) -> float:
        """When a change set in that no sound servo shows [s]; infinite without one."""
        best = self.scores[:, _FAULTS].max(axis=1, initial=0.0)
        return float(self.since_s[np.argmax(best)]) if best.max(initial=0.0) > _ALONE else np.inf

    def shows_none(self) -> bool:
        """Whether the whole flight moves alike: no change explains much of it, for the worse or for the better."""
        return self.since_s.size > 0 and float(np.abs(self.scores).max()) < _LITTLE


NOTHING_LASTS: Final = Lasting(np.zeros(0), np.zeros((0, len(_COLUMNS))))
"""Of a flight that is too short, or of a servo that is not judged by it."""


def lasting(flight: Watched) -> Lasting:
    """How sure a servo has changed since each second of a flight."""
    error_deg = flight.error_deg
    judged = np.flatnonzero(flight.judged & np.isfinite(error_deg))
    seconds = np.unique(np.floor(flight.record.time_s[judged]))
    usual = np.zeros((FITTED + 1, FITTED + 1))
    each, samples = np.zeros((seconds.size, len(_COLUMNS), FITTED + 2)), 0
    for begin in range(0, judged.size, _ROWS):
        time_s, rows = _whitened(flight, error_deg, judged[max(begin - 2, 0) : begin + _ROWS])
        if not time_s.size:
            continue
        others, left = rows[:, :FITTED], rows[:, -1:]
        plain = np.concatenate([others, left], axis=1)
        usual += plain.T @ plain
        samples += time_s.size
        here, firsts = np.unique(np.searchsorted(seconds, np.floor(time_s)), return_index=True)
        for place, column in enumerate(_COLUMNS):
            change = rows[:, [column]]
            products = np.concatenate([others, change, left], axis=1) * change
            each[here, place] += np.add.reduceat(products, firsts, axis=0)
    inside = (seconds >= seconds[:1] + _SHORTEST_S) & (seconds <= seconds[-1:] - _SHORTEST_S)
    if not inside.any() or not samples:
        return NOTHING_LASTS
    scaled = flight.known.covariance / np.outer(UNITS[:FITTED], UNITS[:FITTED])
    given = np.linalg.inv(usual[:-1, :-1] + np.linalg.inv(scaled))
    known = given @ usual[:-1, -1]
    whole = np.append(-known, 1.0)
    noise = max(float(whole @ usual @ whole) / samples, 1.0)
    after = np.cumsum(each[::-1], axis=0)[::-1][inside]
    shared, alone, errors = after[..., :FITTED], after[..., FITTED], after[..., -1]
    free = np.maximum(alone - np.einsum("sci,ij,scj->sc", shared, given, shared), 0.0)
    scores = (errors - shared @ known) / np.sqrt(noise * (free + 1.0))
    scores[:, _LOST] *= -1.0
    scores[:, _OFFSET] = np.abs(scores[:, _OFFSET])
    return Lasting(seconds[inside], scores)


def _whitened(flight: Watched, error_deg: FloatArray, rows: IntArray) -> tuple[FloatArray, FloatArray]:
    """Times of samples (k,), and their sensitivities and residual without the noise's colour, (k, parameters + 3).

    `rows` are judged ones, in order; a sample counts that follows two others.
    """
    columns = np.column_stack([flight.slopes[rows] * UNITS, error_deg[rows]]) / flight.noise_deg[rows, None]
    time_s, (first, second) = flight.record.time_s[rows], flight.noise.colour
    left = (columns[2:] - first * columns[1:-1] - second * columns[:-2]) / flight.noise.innovation
    in_a_row = time_s[2:] - time_s[:-2] <= 2.0 * ROW * flight.record.period_s
    left[:, -1] = np.clip(left[:, -1], -_LARGEST, _LARGEST)
    return time_s[2:][in_a_row], left[in_a_row]


def slow_together(servos: Sequence[Lasting]) -> float:
    """Since when most servos of a log are slower, by what they explain together [s]; infinite if they are not.

    Examples
    --------
    >>> since_s = np.arange(5.0, 55.0)
    >>> slower = np.where(np.abs(since_s - 30.0) < 2.0, 15.0, 0.0)
    >>> one = Lasting(since_s, np.outer(slower, [1.0, 0.0, 0.0, 0.0]))
    >>> slow_together([one, one]), slow_together([one])
    (30.0, inf)
    """
    known = [each for each in servos if each.since_s.size]
    if len(known) < 2:
        return np.inf
    at_s = np.unique(np.concatenate([each.since_s for each in known]))
    around_s = at_s[:, None] + np.linspace(-WITHIN_S, WITHIN_S, 5)
    scores = np.stack([each.slower(around_s).max(axis=1) for each in known])
    nats = 0.5 * np.sign(scores) * scores**2
    others = nats.sum(axis=0) - nats.max(axis=0)
    best_s = at_s[others == others.max()]
    after_holes = np.append(0, 1 + np.flatnonzero(np.diff(best_s) > WITHIN_S))
    since_s = float(np.mean(best_s[after_holes[-1] :]))
    members = sum(each.is_slower_near(since_s) for each in known)
    return since_s if others.max() > _TOGETHER_NATS and 2 * members > len(known) else np.inf
