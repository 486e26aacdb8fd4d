r"""What a current leaves of its healthy servos, as (x, A, Sigma) for the windows of `servofd.core.windows`.

Readings of current are spikes over a small noise, and what motion draws varies by shares. Both become a noise of about
one after :math:`a(i) = \operatorname{asinh}((i - i_0) / \sigma_0)`, with the current at rest :math:`i_0` and its noise
:math:`\sigma_0`: it is the current near rest, and its logarithm in motion. For a servo, or several on one wire, that
draw :math:`h_k` for their motion,

.. math:: e = a(i) - a(i_0 + \textstyle\sum_k h_k),

the terms of the healthy currents differ by Sigma (A holds what a change of each leaves in e), and a fault leaves a
pattern x: *unpowered* takes the motion of a servo away; *blocked* as well, and adds a stall wherever its command is
away from a place; *binding* leaves the logarithm of how many times as much it draws. The first two have size one.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np

from servofd.core.types import BoolArray, FloatArray
from servofd.core.windows import Sizes, Sums, distance, fitted
from servofd.current.model import CurrentSeries, Seen

GRID_S: Final = 0.5
"""Windows end so often [s]."""
LOOKS_S: Final = (2.5, 5.0, 10.0, 20.0)
"""Lengths of the windows: from two readings at 1 Hz to several manoeuvres [s]."""
ALIKE_S: Final = 0.1
"""What a model lacks lasts as long as a movement: of readings that are closer the mean is judged [s]."""
PUSHES: Final = 0.5
"""Share of its stall from which on a reading tells how large it is."""
SLACK_DEG: Final = 4.0
"""Distance of a command from the surface at which the motor pushes with all it has [deg]."""
_PLACES, _FINE = 9, 33
"""Places of the command's range at which a blocked servo may stand, to notice it and to name it."""
_STALL: Final = 1.5
"""Times what motion draws at most that a stalled servo draws at least."""
_USUAL: Final = 3.0
"""Times that least by which the pattern of a blocked servo is drawn: those of the simulations draw 1 to 8 times."""


class Kind(NamedTuple):
    """How a kind of fault is judged."""

    size: float | None
    """What its size is; None if it may be any."""
    deviation: float
    """Of its size from that."""
    healthy: float
    """Deviation of the size in healthy windows, beyond what the terms of the current differ by."""
    limit: float
    """Nats by which it has to be likelier than a healthy servo, or more where good flights reached more."""
    shortest_s: float = 0.0
    """Shortest window that it is judged by [s]: some seconds of hard work are the air's."""


KINDS: Final = {
    "unpowered": Kind(1.0, 0.15, 0.15, 10.0),
    "blocked": Kind(1.0, 0.3, 0.15, 8.0),
    "binding": Kind(None, 0.0, 0.15, 5.0, 10.0),
}
"""Limits are above what 13 h of good servos at 1 to 50 Hz reach, known from good flights or from the same log, on even
seeds of ``benchmarks/currents.py good --first 2 --count 10``: 9.1, 5.0 and 4.4 nats, but for one stretch at 1 Hz that
no kind of fault explains (11.2)."""


class Change(NamedTuple):
    """A change of one servo, or of all, and the pattern that it leaves, shape (m,)."""

    kind: str
    names: tuple[str, ...]
    pattern: FloatArray
    place_deg: float = np.nan
    share: FloatArray | None = None
    """Of its stall that a blocked servo draws, shape (m,)."""


_NONE: Final = Sizes.nothing(np.zeros((1, 1)))


class Fit(NamedTuple):
    """What windows say of each change, of shape (changes, n)."""

    gain: FloatArray
    """Nats by which it is likelier than every healthy servo."""
    fit: FloatArray
    """Nats of the readings that it explains."""
    size: FloatArray
    deviation: FloatArray
    """Of the size."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """(x, A, Sigma) of a reading of current, over its noise; arrays of shape (m,) or (rows, m)."""

    seen: Mapping[str, Seen]
    slopes: FloatArray
    """What a change of each term of the healthy currents leaves: A."""
    precision: FloatArray
    """Inverse of Sigma."""
    motion_a: Mapping[str, FloatArray]
    """What each healthy servo draws for its motion."""
    good_a: FloatArray
    """All of that."""
    drawn_a: FloatArray
    """What was read beyond the current at rest."""
    still_a: float
    """Noise of a reading at rest."""
    weight: FloatArray
    """One over the noise of e."""

    @classmethod
    def of(cls, seen: Mapping[str, Seen]) -> Evidence:
        """Of one servo, or of each of several on one wire beside what the others draw for their motion."""
        seen = {name: thinned(one) for name, one in seen.items()}
        first, *others = seen.values()
        motion_a = {name: np.maximum(one.healthy_a - one.known.theta[0], 0.0) for name, one in seen.items()}
        good_a = np.asarray(np.sum(list(motion_a.values()), axis=0))
        others_a = np.sum([one.healthy_a - one.known.theta[0] for one in others], axis=0)
        still_a = max(one.known.noise.still_a for one in seen.values())
        spread_a = [one.known.noise.share * motion_a[name] for name, one in seen.items()]
        steep = np.hypot(still_a, good_a)
        weight = steep / np.sqrt(still_a**2 + np.sum(np.square(spread_a), axis=0))
        slopes = np.concatenate([one.slopes.T for one in seen.values()]) * (weight / steep)
        blocks: list[FloatArray] = [np.asarray(np.linalg.inv(one.known.covariance)) for one in seen.values()]
        precision = blocks[0]
        if others:
            from scipy.linalg import block_diag  # takes longer to load than a flight to judge

            precision = block_diag(*blocks)
        drawn_a = first.series.current_a - first.known.theta[0] + others_a
        return cls(seen, slopes, precision, motion_a, good_a, drawn_a, still_a, weight)

    @property
    def series(self) -> CurrentSeries:
        """Its readings."""
        return next(iter(self.seen.values())).series

    @cached_property
    def usable(self) -> BoolArray:
        """Which readings count."""
        return np.asarray(np.all([one.usable for one in self.seen.values()], axis=0))

    @property
    def is_own(self) -> bool:
        """Whether the log itself is all that is known of what it draws."""
        return any(one.known.fitted_between_s is not None for one in self.seen.values())

    def _left(self, draws_a: FloatArray) -> FloatArray:
        """What is left of a current beyond that at rest [A]."""
        left: FloatArray = self.weight * (np.arcsinh(draws_a / self.still_a) - np.arcsinh(self.good_a / self.still_a))
        return left

    @cached_property
    def error(self) -> FloatArray:
        """What is left of what was read: e."""
        return self._left(np.maximum(self.drawn_a, -self.still_a))

    @cached_property
    def changes(self) -> tuple[Change, ...]:
        """The faults that are looked for."""
        return tuple(self._changes(_PLACES))

    @cached_property
    def fine(self) -> tuple[Change, ...]:
        """The same, with more places of a blocked servo."""
        return tuple(self._changes(_FINE))

    def _changes(self, count: int) -> Iterator[Change]:
        for name, one in self.seen.items():
            motion, motion_a = one.series.motion, self.motion_a[name]
            yield Change("unpowered", (name,), self._left(self.good_a - motion_a))
            yield Change("binding", (name,), self.weight * motion_a / np.hypot(self.still_a, self.good_a))
            if motion.known.any():
                places = np.quantile(motion.asked_deg[motion.known], np.linspace(0.0, 1.0, count))
                yield from self._blocked(name, np.unique(places), _USUAL * least_stall(one))
        if len(self.seen) > 1:
            yield Change("unpowered", tuple(self.seen), self._left(np.zeros_like(self.good_a)))

    def _blocked(self, name: str, places_deg: FloatArray, stall_a: float) -> Iterator[Change]:
        """A servo that stands at each of some places, and draws so much where its command is away."""
        known, motion = self.seen[name].known, self.seen[name].series.motion
        away = np.clip(np.abs(motion.asked_deg[:, None] - places_deg) / SLACK_DEG, 0.0, 1.0) ** 2
        shares = motion.rows(self.series.time_s, known.lag_s, known.width_s, away).T
        for place, share in zip(places_deg.tolist(), shares, strict=True):
            pattern = self._left(self.good_a - self.motion_a[name] + stall_a * share)
            yield Change("blocked", (name,), pattern, place, share)

    def sized(self, change: Change, from_s: float, to_s: float) -> Change:
        """A blocked servo with the stall that it draws between two times; others as they are."""
        if change.share is None:
            return change
        rows = self.usable & (self.series.time_s >= from_s) & (self.series.time_s <= to_s) & (change.share > PUSHES)
        if not rows.any():
            return change
        stall_a = max(float(np.median(self.drawn_a[rows] / change.share[rows])), self.still_a)
        return next(self._blocked(change.names[0], np.array([change.place_deg]), stall_a))

    @cached_property
    def grid_s(self) -> FloatArray:
        """When windows of a log end [s]."""
        first_s, last_s = (float(self.series.time_s[k]) for k in (0, -1))
        return np.asarray(np.minimum(np.arange(first_s + GRID_S, last_s + GRID_S, GRID_S), last_s))

    @cached_property
    def all_gains(self) -> FloatArray:
        """`gains` of the windows of a log."""
        return self.gains(self.grid_s)

    def gains(self, at_s: FloatArray, from_s: float = -math.inf) -> FloatArray:
        """Largest gain of each change in the windows that end at some instants, shape (changes, n)."""
        shortest_s = np.array([[KINDS[change.kind].shortest_s] for change in self.changes])
        windows = zip(LOOKS_S, self.windows(at_s, from_s), strict=True)
        gains = [np.where(shortest_s <= look_s, one.gain, 0.0) for look_s, one in windows]
        return np.asarray(np.max(gains, axis=0))

    def windows(self, at_s: FloatArray, from_s: float, looks_s: Sequence[float] = LOOKS_S) -> list[Fit]:
        """Windows of each length that end at some instants of a grid, and begin after a time."""
        time_s = self.series.time_s
        grid_s = np.append(np.arange(at_s[0], min(time_s[0], at_s[0]) - GRID_S, -GRID_S), at_s[1:])
        begins = np.unique(np.append(0, np.searchsorted(time_s, grid_s, side="right")))
        edge = np.append(begins[begins < time_s.size], time_s.size)
        sums = Sums.of(self._columns(self.changes), self.usable, edge[:-1])
        ends = np.searchsorted(edge, np.searchsorted(time_s, at_s, side="right"))
        found = []
        for look_s in looks_s:
            first = np.searchsorted(time_s, np.maximum(at_s - look_s, from_s), side="right")
            window = sums.between(np.minimum(np.searchsorted(edge, first), ends), ends)
            found.append(self._fit(self.changes, window))
        return found

    def whole(self, from_s: float, to_s: float, changes: Sequence[Change]) -> Fit:
        """One window between two times, of some changes."""
        rows = slice(*np.searchsorted(self.series.time_s, (from_s, np.nextafter(to_s, np.inf))).tolist())
        return self._fit(changes, Sums.of(self._columns(changes)[:, rows], self.usable[rows]).between(0, -1))

    def _columns(self, changes: Sequence[Change]) -> FloatArray:
        """A, each x and e."""
        return np.vstack([self.slopes, *(change.pattern for change in changes), self.error])

    def _fit(self, changes: Sequence[Change], window: Sums) -> Fit:
        left = window.given(len(self.slopes), self.precision)
        count = np.maximum(window.samples, 1.0)
        found = [fitted(left, 1, columns=(k, len(changes))) for k in range(len(changes))]
        noise = np.maximum(np.fmin.reduce([one.left for one in found]) / count, 1.0)
        places = math.log(max(sum(change.share is not None for change in changes) / len(self.seen), 1.0))
        is_read, rows = window.samples > 1, []
        for change, one in zip(changes, found, strict=True):
            kind, at = KINDS[change.kind], one.scaled(np.maximum(one.left / count, 1.0))
            away, off = distance(at.beyond(_NONE, np.array([[kind.healthy**2]]))), np.zeros(is_read.size)
            if kind.size is not None:
                expected = Sizes(np.array([[kind.size]]), np.array([[[kind.deviation**2]]]))
                off = distance(at.beyond(expected, np.zeros((1, 1))), None)
            explained = np.where(at.value[0] > 0.0, one.explained / noise, 0.0) - off
            cost = 0.0 if change.share is None else places
            deviation = np.sqrt(np.nan_to_num(at.covariance[0, 0], nan=np.inf))
            gains = (np.where(is_read, nats, 0.0) for nats in (0.5 * (away - off), 0.5 * explained - cost))
            rows.append([*gains, np.nan_to_num(at.value[0]), deviation])
        return Fit(*np.array(rows).transpose(1, 0, 2))

    def odds(self, change: Change, size: float) -> FloatArray:
        """Nats by which a change of a size is likelier than a healthy servo, for each reading (m,)."""
        x = change.pattern * size
        return np.where(self.usable, x * (self.error - 0.5 * x), 0.0)


def thinned(seen: Seen) -> Seen:
    """The same with the means of readings that are closer than what a model lacks lasts: they say a thing once."""
    time_s = seen.series.time_s
    if time_s.size < 2 or seen.series.period_s > 0.5 * ALIKE_S:
        return seen
    begins = np.flatnonzero(np.diff(np.floor((time_s - time_s[0]) / ALIKE_S), prepend=-1.0))
    counts = np.maximum(np.add.reduceat(seen.usable.astype(np.float64), begins), 1.0)

    def mean(values: FloatArray) -> FloatArray:
        sums = np.add.reduceat(np.where(seen.usable, values.T, 0.0), begins, axis=-1)
        return np.asarray((sums / counts).T)

    last = np.append(begins[1:], time_s.size) - 1
    series = replace(seen.series, time_s=time_s[last], current_a=mean(seen.series.current_a))
    slopes, healthy_a, moving, noise_a = map(mean, (seen.slopes, seen.healthy_a, seen.moving, seen.noise_a))
    usable = np.logical_or.reduceat(seen.usable, begins)
    return Seen(series, seen.known, slopes, healthy_a, moving, noise_a, usable)


def least_stall(seen: Seen) -> float:
    """What a stalled servo draws at least beyond its idle current [A]."""
    return _STALL * max(seen.known.moving_a or largest_of([seen]), 3.0 * seen.known.noise.still_a)


def largest_of(good: Sequence[Seen]) -> float:
    """What a good servo draws at most for the motions of some flights, but for a reading in a hundred [A]."""
    healthy_a = np.concatenate([seen.healthy_a[seen.usable] for seen in good])
    return float(np.quantile(healthy_a, 0.99)) if healthy_a.size else 0.0
