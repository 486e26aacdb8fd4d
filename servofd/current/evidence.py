r"""What a current leaves of its healthy servos, as (x, A, Sigma) for the windows of `servofd.core.windows`.

Readings of current are spikes over a small noise, and what motion draws varies by shares. Both become a noise of about
one after :math:`a(i) = \operatorname{asinh}((i - i_0) / \sigma_0)`, with the current at rest :math:`i_0` and its noise
:math:`\sigma_0`: it is the current near rest, and its logarithm in motion. For a servo, or several on one wire, that
draw :math:`h_k` for their motion,

.. math:: e = a(i) - a(i_0 + \textstyle\sum_k h_k),

the terms of the healthy currents differ by Sigma (A holds what a change of each leaves in e), and a fault leaves a
pattern x: *unpowered* takes the motion of a servo away; *blocked* as well, and adds a stall wherever its command is away
from a place; *binding* leaves the logarithm of how many times as much it draws. The first two have size one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from servofd.core.windows import Sizes, Sums, distance, fitted

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from servofd.core.types import BoolArray, FloatArray
    from servofd.current.model import CurrentSeries, Seen

GRID_S: Final = 0.5
"""Windows end so often [s]."""
LOOKS_S: Final = (2.5, 5.0, 10.0, 20.0)
"""Lengths of the windows: from two readings at 1 Hz to several manoeuvres [s]."""
ALIKE_S: Final = 0.1
"""What a model lacks lasts as long as a movement: readings that are closer count once [s]."""
PUSHES: Final = 0.5
"""Share of its stall from which on a reading tells how large it is."""
SLACK_DEG: Final = 4.0
"""Distance of a command from the surface at which the motor pushes with all it has [deg]."""
_PLACES, _FINE = 9, 33
"""Places of the command's range at which a blocked servo may stand, to notice it and to name it."""
_STALL: Final = 1.5
"""Times what motion draws at most that a stalled servo draws at least."""
_USUAL: Final = 3.0
"""Times that least by which the pattern of a blocked servo is drawn: the servos of the simulations draw 1 to 8 times."""


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
    lasts_s: float
    """For so long it has to be [s]."""
    shortest_s: float = 0.0
    """Shortest window that it is judged by [s]: some seconds of hard work are the air's."""


KINDS: Final = {
    "unpowered": Kind(1.0, 0.15, 0.15, 10.0, 0.5),
    "blocked": Kind(1.0, 0.3, 0.15, 8.0, 0.5),
    "binding": Kind(None, 0.0, 0.15, 5.0, 0.5, 10.0),
}
"""Chosen on even seeds of ``benchmarks/currents.py good --first 2 --count 10``, 13 h of good servos at 1 to 50 Hz, known
from good flights or from the same log: they reach 9.1, 5.0 and 4.4 nats, but for one stretch at 1 Hz that no kind of
fault explains (11.2)."""


class Change(NamedTuple):
    """A change of one servo, or of all, and the pattern that it leaves, shape (m,)."""

    kind: str
    names: tuple[str, ...]
    pattern: FloatArray
    place_deg: float = np.nan
    share: FloatArray | None = None
    """Of its stall that a blocked servo draws, shape (m,)."""


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
    """What a change of each term of the healthy currents leaves, over its noise: A."""
    precision: FloatArray
    """Inverse of Sigma."""
    drawn_a: FloatArray
    """Beyond the current at rest."""
    good_a: FloatArray
    """The same of healthy servos."""
    still_a: float
    """Noise of a reading at rest."""
    weight: FloatArray
    """One over the noise of e, smaller where readings are alike."""

    @classmethod
    def of(cls, seen: Mapping[str, Seen]) -> Evidence:
        """Of one servo, or of each of several on one wire beside what the others draw for their motion."""
        each = tuple(seen.values())
        first = each[0]
        motion = {name: np.maximum(one.healthy_a - one.known.theta[0], 0.0) for name, one in seen.items()}
        others_a = np.sum([one.healthy_a - one.known.theta[0] for one in each[1:]], axis=0)
        drawn_a = first.series.current_a - first.known.theta[0] + others_a
        total = np.sum(list(motion.values()), axis=0)
        still = max(one.known.noise.still_a for one in each)
        steep = np.hypot(still, total)
        noise_a = np.sqrt(
            still**2
            + np.sum([(o.known.noise.share * m) ** 2 for o, m in zip(each, motion.values(), strict=True)], axis=0)
        )
        weight = np.sqrt(each_of(first.series)) * steep / noise_a
        slopes = np.concatenate([one.slopes.T for one in each]) * (weight / steep)
        size = first.slopes.shape[1]
        precision = np.zeros((len(slopes), len(slopes)))
        for k, one in enumerate(each):
            part = slice(k * size, (k + 1) * size)
            precision[part, part] = np.linalg.inv(one.known.covariance)
        return cls(seen, slopes, precision, drawn_a, total, still, weight)

    def left(self, draws_a: FloatArray) -> FloatArray:
        """What is left of a current beyond that at rest [A]."""
        return self.weight * (np.arcsinh(draws_a / self.still_a) - np.arcsinh(self.good_a / self.still_a))

    @cached_property
    def error(self) -> FloatArray:
        """What is left of what was read: e."""
        return self.left(np.maximum(self.drawn_a, -self.still_a))

    @cached_property
    def changes(self) -> tuple[Change, ...]:
        """The faults that are looked for."""
        return self._changes(_PLACES)

    @cached_property
    def fine(self) -> tuple[Change, ...]:
        """The same, with more places of a blocked servo."""
        return self._changes(_FINE)

    def _changes(self, count: int) -> tuple[Change, ...]:
        found = []
        for name, one in self.seen.items():
            motion_a = np.maximum(one.healthy_a - one.known.theta[0], 0.0)
            share = self.weight * motion_a / np.hypot(self.still_a, self.good_a)
            found += [
                Change("unpowered", (name,), self.left(self.good_a - motion_a)),
                Change("binding", (name,), share),
            ]
            motion = one.series.motion
            places = (
                np.quantile(motion.asked_deg[motion.known], np.linspace(0.0, 1.0, count)) if motion.known.any() else ()
            )
            found += self.blocked(name, np.unique(places), _USUAL * least_stall(one))
        if len(self.seen) > 1:
            found.append(Change("unpowered", tuple(self.seen), self.left(np.zeros_like(self.good_a))))
        return tuple(found)

    def blocked(self, name: str, places_deg: FloatArray, stall_a: float) -> list[Change]:
        """A servo that stands at each of some places, and draws so much where its command is away."""
        one = self.seen[name]
        known, motion = one.known, one.series.motion
        away = np.clip(np.abs(motion.asked_deg[:, None] - places_deg) / SLACK_DEG, 0.0, 1.0) ** 2
        shares = motion.rows(one.series.time_s, known.lag_s, known.width_s, away).T
        others_a = self.good_a - np.maximum(one.healthy_a - known.theta[0], 0.0)
        return [
            Change("blocked", (name,), self.left(others_a + stall_a * share), float(place), share)
            for place, share in zip(places_deg, shares, strict=True)
        ]

    def sized(self, change: Change, from_s: float, to_s: float) -> Change:
        """A blocked servo with the stall that it draws between two times; others as they are."""
        if change.share is None:
            return change
        rows = self.usable & (self.series.time_s >= from_s) & (self.series.time_s <= to_s) & (change.share > PUSHES)
        if not rows.any():
            return change
        stall_a = max(float(np.median(self.drawn_a[rows] / change.share[rows])), self.still_a)
        return self.blocked(change.names[0], np.array([change.place_deg]), stall_a)[0]

    @property
    def series(self) -> CurrentSeries:
        """Its readings."""
        return next(iter(self.seen.values())).series

    @cached_property
    def usable(self) -> BoolArray:
        """Which readings count."""
        return np.all([one.usable for one in self.seen.values()], axis=0)

    def _columns(self, changes: Sequence[Change]) -> FloatArray:
        """A, each x and e."""
        return np.vstack([self.slopes, *(change.pattern for change in changes), self.error])

    def windows(self, at_s: FloatArray, from_s: float, looks_s: Sequence[float] = LOOKS_S) -> list[Fit]:
        """Windows of each length that end at some instants of a grid, and begin after a time."""
        time_s = self.series.time_s
        grid_s = np.append(np.arange(at_s[0], min(time_s[0], at_s[0]) - GRID_S, -GRID_S)[::-1], at_s[1:])
        begins = np.unique(np.searchsorted(time_s, grid_s, side="right"))
        begins = np.unique(np.append(0, begins[begins < time_s.size]))
        sums = Sums.of(self._columns(self.changes), self.usable, begins)
        edge = np.append(begins, time_s.size)
        ends = np.searchsorted(edge, np.searchsorted(time_s, at_s, side="right"))
        starts = (np.searchsorted(time_s, np.maximum(at_s - look_s, from_s), side="right") for look_s in looks_s)
        return [
            self._fit(self.changes, sums.between(np.minimum(np.searchsorted(edge, start), ends), ends))
            for start in starts
        ]

    def whole(self, from_s: float, to_s: float) -> Fit:
        """One window between two times, of the `fine` changes."""
        rows = slice(*np.searchsorted(self.series.time_s, (from_s, np.nextafter(to_s, np.inf))).tolist())
        return self._fit(self.fine, Sums.of(self._columns(self.fine)[:, rows], self.usable[rows]).between(0, -1))

    def _fit(self, changes: Sequence[Change], window: Sums) -> Fit:
        left = window.given(len(self.slopes), self.precision)
        count = np.maximum(window.samples * each_of(self.series), 1.0)
        found = [fitted(left, 1, columns=(k, len(changes))) for k in range(len(changes))]
        noise = np.maximum(np.fmin.reduce([one.left for one in found]) / count, 1.0)
        places = math.log(max(sum(change.share is not None for change in changes) / len(self.seen), 1.0))
        gains, fits, sizes, deviations = [], [], [], []
        for change, one in zip(changes, found, strict=True):
            kind, at = KINDS[change.kind], one.scaled(np.maximum(one.left / count, 1.0))
            away = distance(at.beyond(Sizes.nothing(np.zeros((1, 1))), np.array([[kind.healthy**2]])))
            off = np.zeros_like(away)
            if kind.size is not None:
                expected = Sizes(np.array([[kind.size]]), np.array([[[kind.deviation**2]]]))
                off = distance(at.beyond(expected, np.zeros((1, 1))), None)
            told = window.samples > 1
            gains.append(np.where(told, 0.5 * (away - off), 0.0))
            fits.append(
                np.where(
                    told,
                    0.5 * (np.where(at.value[0] > 0.0, one.explained / noise, 0.0) - off)
                    - places * (change.share is not None),
                    0.0,
                )
            )
            sizes.append(np.nan_to_num(at.value[0]))
            deviations.append(np.sqrt(np.nan_to_num(at.covariance[0, 0], nan=np.inf)))
        return Fit(np.array(gains), np.array(fits), np.array(sizes), np.array(deviations))

    def odds(self, change: Change, size: float) -> FloatArray:
        """Nats by which a change of a size is likelier than a healthy servo, for each reading (m,)."""
        x = change.pattern * size
        return np.where(self.usable, x * (self.error - 0.5 * x), 0.0)


def each_of(series: CurrentSeries) -> float:
    """How much each reading counts where those that are close say a thing once."""
    return min(1.0, series.period_s / ALIKE_S)


def least_stall(seen: Seen) -> float:
    """What a stalled servo draws at least beyond its idle current [A]."""
    return _STALL * max(seen.known.moving_a or largest_of([seen]), 3.0 * seen.known.noise.still_a)


def largest_of(good: Sequence[Seen]) -> float:
    """What a good servo draws at most for the motions of some flights, but for a reading in a hundred [A]."""
    healthy_a = np.concatenate([seen.healthy_a[seen.usable] for seen in good])
    return float(np.quantile(healthy_a, 0.99)) if healthy_a.size else 0.0
