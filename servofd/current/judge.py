"""What a current tells of its servo: blocked, without power, binding; worn, where good flights or cycles are known.

Each account of the last seconds says how likely every reading is. A fault is reported as soon as its account beats that
of every healthy servo, whose terms are free as far as the covariance between good flights lets them:

- *blocked*: the controller pushes with all it has wherever the command is away from where the surface stands,
- *unpowered*: no current of motion, and no more than the electronics take,
- *binding*: the same motion for more current than good flights differ by.

Accounts of given sizes are followed through all windows by running sums; where one of them beats the good servo as it
was fitted, sizes and the healthy terms are fitted to the window.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from servofd.aircraft.current import NAMES
from servofd.core.statistics import Estimate
from servofd.core.windows import Sums, split
from servofd.current.model import Seen, see
from servofd.current.wear import worn
from servofd.detection.verdict import WORTH_TELLING, CurrentAudit, Fault, describe

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence

    from servofd.aircraft.current import CalibratedCurrent
    from servofd.core.types import BoolArray, FloatArray, IntArray
    from servofd.current.model import CurrentSeries
    from servofd.detection.verdict import Status

LOOKS_S: Final = (2.5, 5.0, 10.0, 20.0)
"""How far a look at what raised an alarm reaches back: from two samples at 1 Hz to several manoeuvres."""
_OFTEN_S, _SELDOM_S, _OFTEN = 0.5, 2.5, 30
"""While an alarm stands it is looked into so often, the first so many times, and more seldom after that."""
_ALIKE_S: Final = 0.1
"""What a model lacks lasts as long as a movement: readings that are closer say it once."""
SURE_NATS: Final = 9.0
"""Nats by which a fault must be likelier than every healthy servo: one look in 8000 by chance."""
_FREEDOM: Final = 4.0
"""Of Student's law, which readings of current follow: starts and gusts are spikes."""
_STALL_SPREAD: Final = 0.35
"""A stalled motor draws what its duty lets it: so much, as a share, it differs from reading to reading."""
_STALL: Final = 1.5
"""Times what motion draws at most that a stalled servo draws at least."""
_SLACK_DEG: Final = (1.5, 4.0, 9.0)
"""Distance of a command from the surface at which the motor pushes with all it has."""
_BEFORE_S: Final = 30.0
"""Time before an alarm in which its onset is looked for [s]."""
_BRIEF_S: Final = 10.0
"""What passes sooner is no fault where one part of a log is all that is known of its current: a gust, a landing."""
_BINDS_S: Final = LOOKS_S[-1]
"""A servo that binds does so in one manoeuvre after the other; some seconds of hard work are the air's."""
_MOST: Final = 6
"""Faults of one flight at most."""
_ROUNDS: Final = 3
"""Of weighted least squares, after which the weights of Student's law hardly change any more."""
_FLAT: Final = 1e-6
"""Information about an unknown size before the data [1/A2]: hardly any."""
_ENDED: Final = 25.0
"""Nats by which the good servo must have become the better account again."""
_NAMED_S: Final = 10.0
"""After the alarm, what it is has become clear: by what it draws in some movements."""
_SUREST: Final = 0.99
"""Largest probability that is given."""
EXPLAINED, EXPLAINED_OWN = 0.15, 0.4
"""Share of the current that its motion must explain to be a witness: of good flights, and of a part of the log itself,
which may as well hold a fault."""
_LARGEST: Final = 8.0
"""Nats that one reading counts for at most."""
_WORTH: Final = 0.5
"""Share of its limit from which on an account of a given size is fitted."""
GRID_S: Final = 0.5
FOLLOWED: Final = ("unpowered", "binding", "blocked")
"""Kinds of faults whose accounts are followed."""
_PLACES: Final = 9
"""Places of the command's range at which a blocked servo may stand."""
_TIMES: Final = (1.6, 2.5, 4.0)
"""How many times as much a binding servo draws, of the sizes that are followed."""
_MOST_TIMES: Final = 6.0
"""A servo that still moves draws less than so many times as much: of simulated motors at 10 Hz one with three times the
friction draws 2.9 times, and a stalled one seems to draw 20 to 30 times."""
_STALLS: Final = (1.0, 2.0, 4.0, 8.0)
"""How many times the least current of a stalled servo it draws, of the sizes that are followed."""
_SOON_S, _LASTS_S = 0.25, 4.0
"""For so long in all a stalled servo pushes; longer, if it draws no more than a start of a good one."""
_ALWAYS: Final = 0.35
"""Share of its stall that a blocked servo draws in nine of ten readings at which it is asked to be elsewhere."""


def verdict_of(
    seen: Seen, found: Sequence[Fault], before: Sequence[FloatArray] = (), others: Sequence[Fault] = ()
) -> CurrentAudit:
    """What is said of one surface by its current and its faults; of wear, with `features_of` cycles `before` it.

    While `others` on its wire are at fault the reading tells nothing of how much it draws.
    """
    series, known = seen.series, seen.known
    whole_share = float(np.mean(seen.usable)) if seen.usable.size else 0.0
    for other in others if not found else ():
        to_s = np.inf if other.end_s is None else other.end_s
        seen = seen._replace(usable=seen.usable & ~((series.time_s >= other.start_s) & (series.time_s <= to_s)))
    faults = tuple(fault for fault in found if fault.level == "fault")
    suspicions = tuple(fault for fault in found if fault.level == "suspect") or (() if faults else worn(seen, before))
    rows = seen.usable & (seen.moving > 0.5)
    if faults:
        rows &= series.time_s >= faults[0].start_s
    good_a = float(np.mean(seen.healthy_a[rows])) if rows.any() else 0.0
    ratio = round(float(np.mean(series.current_a[rows])) / good_a, 3) if good_a > 0.0 else None
    when = " while all others on its wire were well" if others else ""
    status, reason = _status(seen, faults, suspicions, ratio, when)
    return CurrentAudit(
        status,
        "; ".join((reason, *series.notes)),
        known.explained_share,
        ratio,
        faults,
        suspicions,
        series.time_s,
        series.current_a,
        seen.healthy_a,
        seen.sigma_a,
        (series.motion.time_s, series.motion.asked_deg),
        whole_share,
        asked=would_show(seen),
    )


_HELD_S, _HELD_SHARE = 0.5, 0.95
"""For so long, but for moments, a servo must have been asked to be elsewhere before what it draws is a push: several
times the time in which hobby servos come where they are asked to be."""
_OF_MOTION: Final = 0.5
"""Share of what a healthy servo draws in motion, and its inverse, between which a current shows motion: where that is
hardly known, it explains any current better than a rest does. A jammed elevon drew 0.24 A for 2.74 A, another that
pushed against its stop 1.3 A for 0.15 A, and their sensors were accused."""


def tells_motion(series: CurrentSeries, known: CalibratedCurrent, from_s: float, to_s: float) -> bool:
    """Whether between two times a servo that follows is likelier than one that stands still, with power or without."""
    seen = see(series, known)
    rows = slice(*np.searchsorted(series.time_s, (from_s, to_s)).tolist())
    if np.count_nonzero(seen.usable[rows]) < 2:
        return False
    healthy, *others = _accounts(seen, rows)
    use = np.flatnonzero(seen.usable[rows]) + rows.start
    rest_a = max(float(known.theta[0]), 0.0)
    idle_a = series.current_a[use] - rest_a
    moving_a = float((seen.healthy_a[use] - rest_a).sum())
    if not _OF_MOTION * moving_a <= idle_a.sum() <= moving_a / _OF_MOTION:
        return False
    resting = each_of(series) * float(_nats(idle_a, np.full(use.size, known.noise.still_a)).sum())
    return min(resting, *(one.total for one in others if one.kind != "binding"), np.inf) - healthy.total > SURE_NATS


def pushed(
    series: CurrentSeries, known: CalibratedCurrent, still: Fault, position: tuple[FloatArray, FloatArray]
) -> Fault | None:
    """What tells that a servo which its position (times [s], [deg]) shows at rest pushes with all it has; else None.

    It does where it draws more than motion ever takes while it has long been asked to be elsewhere.
    """
    seen = see(series, known)
    motion, (time_s, read_deg) = series.motion, position
    given = np.isfinite(read_deg)
    stands_deg = np.interp(motion.time_s, time_s[given], read_deg[given])
    away = (np.abs(motion.asked_deg - stands_deg) > _SLACK_DEG[1]).astype(np.float64)
    (share,) = motion.rows(series.time_s, known.lag_s, known.width_s + _HELD_S, away[:, None]).T
    to_s = np.inf if still.end_s is None else still.end_s
    held = (share > _HELD_SHARE) & (series.time_s >= still.start_s) & (series.time_s <= to_s)
    drawn_a = series.current_a[held] - max(float(known.theta[0]), 0.0)
    if drawn_a.size < 2 or float(np.quantile(drawn_a, 0.1)) < _least_stall(seen):
        return None
    stall_a, at_s = float(np.median(drawn_a)), float(series.time_s[held][0])
    deviation_a = float(np.std(drawn_a)) / float(np.sqrt(drawn_a.size))
    parameters = {"current_a": Estimate.of(stall_a, max(deviation_a, known.noise.still_a))}
    return Fault("blocked", still.start_s, at_s, still.end_s, parameters, _SUREST, (), named_s=at_s, witness="current")


def each_of(series: CurrentSeries) -> float:
    """How much each reading counts where those that are close say a thing once."""
    return min(1.0, series.period_s / _ALIKE_S)


def _nats(left: FloatArray, sigma: FloatArray) -> FloatArray:
    """Minus the logarithm of the likelihood of each reading, by Student's law, shape (k,)."""
    return np.asarray(0.5 * (_FREEDOM + 1.0) * np.log1p((left / sigma) ** 2 / _FREEDOM) + np.log(sigma))


def _status(
    seen: Seen, faults: Sequence[Fault], suspicions: Sequence[Fault], ratio: float | None, when: str
) -> tuple[Status, str]:
    known = seen.known
    if faults:
        return "fault", f"by its current: {'; then '.join(describe(fault) for fault in faults)}"
    if not is_witness(known):
        return "unknown", no_witness(known)
    if suspicions:
        return "suspect", f"by its current: {'; '.join(describe(fault) for fault in suspicions)}"
    if not would_show(seen):
        return "unknown", f"too little motion{when} for its current to tell a servo without power from one at rest"
    if known.fitted_between_s is None:
        times = "" if ratio is None else f" ({ratio:.2f} times theirs in motion)"
        return "healthy", f"its current is as in its good flights{times}"
    from_s, to_s = known.fitted_between_s
    return "healthy", (
        f"its current is as from {from_s:.0f} to {to_s:.0f} s of this log: would have shown a servo that becomes "
        "blocked or loses its power, and not one that was so from the beginning, or wears"
    )


def would_show(seen: Seen) -> bool:
    """Whether a servo without power would have shown in these readings."""
    missing = np.maximum(seen.healthy_a - seen.known.theta[0], 0.0) / seen.known.noise.still_a
    each = each_of(seen.series)
    gain = each * 0.5 * (_FREEDOM + 1.0) * np.log1p(missing[seen.usable] ** 2 / _FREEDOM)
    return float(gain.sum()) > 2.0 * SURE_NATS


class Account(NamedTuple):
    """One account of some readings."""

    kind: str
    misfit: FloatArray
    """Nats of each reading, shape (k,)."""
    cost: float
    """Of its parameters."""
    parameters: dict[str, Estimate]
    slack_deg: float = _SLACK_DEG[1]
    """Of a blocked one: how far from it a command is that it pushes after with all it has."""

    @property
    def total(self) -> float:
        """Nats of all readings and of the parameters."""
        return float(self.misfit.sum()) + self.cost


def is_witness(known: CalibratedCurrent) -> bool:
    """Whether a current goes with what its servo is asked to do."""
    return known.explained_share >= (EXPLAINED_OWN if known.fitted_between_s else EXPLAINED)


def no_witness(known: CalibratedCurrent) -> str:
    """Why a current is none, in words."""
    return (
        f"its current goes with only {max(known.explained_share, 0.0):.0%} of what it was asked to do: check that it "
        "is the current of this servo, on the clock of its commands, or record a minute of fast movements"
    )


def faults_of(seen: Seen) -> Iterator[Fault]:
    """Look where an account of some size beats the good servo as it was fitted, until a fault lasts to the end."""
    if seen.series.time_s.size < 2 or not is_witness(seen.known):
        return
    earliest_s, looked_s, looks, found = float(seen.series.time_s[0]), -np.inf, 0, 0
    grid_s = _grid_s(seen)
    worth = _worth(seen, grid_s)
    for place in np.flatnonzero(np.any(list(worth.values()), axis=(0, 1))).tolist():
        at_s = float(grid_s[place])
        looks = looks if at_s - looked_s < 2.0 * _SELDOM_S else 0
        if at_s <= earliest_s or at_s - looked_s < (_OFTEN_S if looks < _OFTEN else _SELDOM_S):
            continue
        looked_s, looks = at_s, looks + 1
        best = _best(seen, at_s, earliest_s, {kind: each[:, place] for kind, each in worth.items()})
        if best is None:
            continue
        so_far = _timed(seen, best, at_s, earliest_s, named_s=at_s)
        if seen.known.fitted_between_s is None and so_far.kind == "binding" and at_s - so_far.start_s < _BINDS_S:
            continue
        named_s = min(at_s + _NAMED_S, float(seen.series.time_s[-1]))
        fault = _timed(seen, best, at_s, earliest_s, named_s=named_s)
        if fault.kind == "binding" and named_s - fault.start_s < _BINDS_S:
            fault = replace(so_far, end_s=fault.end_s)
        lasted_s = np.inf if fault.end_s is None else fault.end_s - fault.start_s
        if lasted_s > _BRIEF_S or seen.known.fitted_between_s is None:
            yield fault
            found += 1
        if fault.end_s is None or found >= _MOST:
            return
        earliest_s = max(fault.end_s, at_s)


def _grid_s(seen: Seen) -> FloatArray:
    """When it is asked whether a current is worth a look [s]."""
    first_s, last_s = (float(seen.series.time_s[k]) for k in (0, -1))
    grid_s: FloatArray = np.arange(first_s + GRID_S, last_s + GRID_S, GRID_S)
    return np.minimum(grid_s, last_s)


def worth_a_look(seen: Seen, at_s: FloatArray) -> FloatArray:
    """Which of these instants an account of a given size beats the good servo at, in one of the windows [s]."""
    return at_s[np.any(list(_worth(seen, at_s).values()), axis=(0, 1))]


def _worth(seen: Seen, at_s: FloatArray) -> dict[str, BoolArray]:
    """The same for each kind, in each of the windows, shape (w, g)."""
    return {kind: gain > _WORTH * _limit(seen.known, kind) for kind, gain in _followed(seen, at_s).items()}


def limits_of(good: Iterable[Seen], margin: float) -> dict[str, float]:
    """Nats that each account needs: `margin` times what any stretch of good flights reaches."""
    limits = dict.fromkeys(FOLLOWED, SURE_NATS)
    for seen in good:
        for kind, gain in _followed(seen, _grid_s(seen)).items():
            limits[kind] = max(limits[kind], float(f"{margin * gain.max(initial=0.0):.3g}"))
    return limits


def _limit(known: CalibratedCurrent, kind: str) -> float:
    return float(dict(known.limits).get(kind, SURE_NATS))  # type: ignore[call-overload]


def _followed(seen: Seen, at_s: FloatArray) -> dict[str, FloatArray]:
    """Nats by which each kind of fault beats the good servo in the windows that end at some instants, shape (w, g)."""
    time_s, everything = seen.series.time_s, slice(None)
    idle, motion = max(float(seen.known.theta[0]), 0.0), seen.series.motion
    good = _nats(seen.series.current_a - seen.healthy_a, seen.noise_a)
    gains = {
        "unpowered": [good - _misfit(seen, everything, "unpowered", rest) for rest in (0.0, idle)],
        "binding": [good - _misfit(seen, everything, "binding", times) for times in _TIMES],
        "blocked": [],
    }
    pushed_a, least = seen.series.current_a - idle, _least_stall(seen)
    stalls = [least * n for n in _STALLS if np.count_nonzero(pushed_a > _ALWAYS * least * n) > 1]
    if stalls and motion.known.any():
        places = np.quantile(motion.asked_deg[motion.known], np.linspace(0.0, 1.0, _PLACES))
        for share in _shares(seen, time_s, places, _SLACK_DEG[1]).T:
            gains["blocked"] += [good - _misfit(seen, everything, "blocked", stall, share) for stall in stalls]
    last = np.searchsorted(time_s, at_s, side="right")
    begins = [np.searchsorted(time_s, at_s - look_s) for look_s in LOOKS_S]
    largest = {}
    for kind, accounts in gains.items():
        if accounts:
            sums = Sums.running((np.clip(one, -_LARGEST, _LARGEST) for one in accounts), seen.usable)
            best = np.array([sums.between(first, last).products.max(axis=0) for first in begins])
            largest[kind] = each_of(seen.series) * best
    return largest


def _misfit(seen: Seen, rows: slice | IntArray, kind: str, size: float, share: FloatArray | float = 0.0) -> FloatArray:
    """Nats of some readings by an account of a size, shape (k,).

    The size is what is drawn at rest, how many times as much as a good servo, or a stall, of which `share` is drawn.
    """
    drawn, still, idle_a = seen.series.current_a[rows], seen.known.noise.still_a, max(float(seen.known.theta[0]), 0.0)
    if kind == "unpowered":
        return _nats(drawn - size, np.full(drawn.size, still))
    if kind == "binding":
        return _nats(drawn - idle_a - size * (seen.healthy_a[rows] - idle_a), size * seen.noise_a[rows])
    return _nats(drawn - idle_a - size * share, np.hypot(still, _STALL_SPREAD * size * np.maximum(share, 0.1)))


def _shares(seen: Seen, time_s: FloatArray, places_deg: FloatArray, slack_deg: float) -> FloatArray:
    """Share of its stall that a servo draws at some times if it stands at each of some places, shape (k, p)."""
    known, motion = seen.known, seen.series.motion
    if not time_s.size:
        return np.zeros((0, places_deg.size))
    motion = motion.within(time_s[0] - known.lag_s - known.width_s - 1.0, time_s[-1])
    away = np.clip(np.abs(motion.asked_deg[:, None] - places_deg) / slack_deg, 0.0, 1.0) ** 2
    return motion.rows(time_s, known.lag_s, known.width_s, away)


def _least_stall(seen: Seen) -> float:
    """What a stalled servo draws at least beyond its idle current [A]."""
    return _STALL * max(seen.known.moving_a or largest_of([seen]), 3.0 * seen.known.noise.still_a)


def largest_of(good: Sequence[Seen]) -> float:
    """What a good servo draws at most for the motions of some flights, but for a reading in a hundred [A]."""
    healthy_a = np.concatenate([seen.healthy_a[seen.usable] for seen in good])
    return float(np.quantile(healthy_a, 0.99)) if healthy_a.size else 0.0


def _best(seen: Seen, at_s: float, earliest_s: float, worth: Mapping[str, BoolArray]) -> Account | None:
    """The fault that beats every healthy servo of the last seconds by its limit; None if none does.

    `worth` are the windows in which each kind may, shape (w,).
    """
    time_s = seen.series.time_s
    surest, least = None, 1.0
    last = int(np.searchsorted(time_s, at_s, side="right"))
    for place, look_s in enumerate(LOOKS_S):
        kinds = [kind for kind, each in worth.items() if each[place]]
        rows = slice(int(np.searchsorted(time_s, max(at_s - look_s, earliest_s))), last)
        if not kinds or np.count_nonzero(seen.usable[rows]) < 2:
            continue
        healthy, *others = _accounts(seen, rows, kinds)
        for other in others:
            rest = [each for each in others if each.kind == "binding" and each is not other]
            gain = min(healthy.total, *(each.total for each in rest), np.inf) - other.total
            gain /= _limit(seen.known, other.kind)
            if gain > least and (other.kind != "binding" or seen.known.fitted_between_s is None):
                surest, least = other, gain
    return surest


def account_of(seen: Seen, from_s: float, to_s: float, kind: str = "") -> Account | None:
    """The likeliest fault between two times, or the account of a kind; None if there is none, or nothing was read."""
    rows = _between(seen, from_s, to_s)
    if np.count_nonzero(seen.usable[rows]) < 2:
        return None
    asked = {kind} if kind else set(FOLLOWED)
    return min((one for one in _accounts(seen, rows) if one.kind in asked), key=lambda one: one.total, default=None)


def more_of(seen: Seen, noise_a: FloatArray, from_s: float, to_s: float) -> float:
    """Nats of what is read between two times by the best multiple of the current of motion, for a given noise (m,)."""
    rows = _between(seen, from_s, to_s)
    use = np.flatnonzero(seen.usable[rows]) + rows.start
    error, sigma = seen.series.current_a[use] - seen.healthy_a[use], noise_a[use]
    motion, left = np.maximum(seen.healthy_a[use] - seen.known.theta[0], 0.0), error
    for _ in range(_ROUNDS):
        weight = motion / sigma**2 / (1.0 + (left / sigma) ** 2 / _FREEDOM)
        left = error - motion * max(float(weight @ error) / max(float(weight @ motion), _FLAT), 0.0)
    return each_of(seen.series) * float(_nats(left, sigma).sum())


def _between(seen: Seen, from_s: float, to_s: float) -> slice:
    return slice(*np.searchsorted(seen.series.time_s, (from_s, np.nextafter(to_s, np.inf))).tolist())


def _accounts(seen: Seen, rows: slice, kinds: Collection[str] = FOLLOWED) -> Iterator[Account]:
    """The healthy account of some readings first, then those of faults; one that binds may be what others look like."""
    use = np.flatnonzero(seen.usable[rows]) + (rows.start or 0)
    table, drawn = seen.slopes[use], seen.series.current_a[use]
    noise, count = seen.noise_a[use], len(NAMES)
    error = drawn - seen.healthy_a[use]
    each = each_of(seen.series)
    precision: FloatArray = np.asarray(np.linalg.inv(seen.known.covariance), dtype=np.float64)

    def nats(left: FloatArray, sigma: FloatArray) -> FloatArray:
        misfit: FloatArray = each * _nats(left, sigma)
        return misfit

    def fitted(columns: FloatArray, prior: FloatArray) -> tuple[FloatArray, FloatArray, float]:
        weight = each / noise**2
        left: FloatArray = error
        best: FloatArray = np.zeros(columns.shape[1])
        block: FloatArray = prior
        for _ in range(_ROUNDS):
            block = (columns * weight[:, None]).T @ columns + prior
            best = np.asarray(np.linalg.solve(block, columns.T @ (weight * error)), dtype=np.float64)
            left = error - columns @ best
            weight = each / noise**2 / (1.0 + (left / noise) ** 2 / _FREEDOM)
        return left, best, float(np.sqrt(np.linalg.inv(block)[-1, -1]))

    left, best, _ = fitted(table, precision)
    yield Account("healthy", nats(left, noise), 0.5 * float(best @ precision @ best), {})
    still, idle = seen.known.noise.still_a, max(float(seen.known.theta[0]), 0.0)
    if "unpowered" in kinds:
        rest = min(max(float(np.median(drawn)), 0.0), idle)
        unpowered = each * _misfit(seen, use, "unpowered", rest)
        yield Account("unpowered", unpowered, 1.0, {"current_a": Estimate.of(rest, still)})
    if "blocked" in kinds:
        yield from _blocked(seen, use, drawn - idle)
    wider = np.zeros((count + 1, count + 1))
    wider[:count, :count] = precision
    wider[-1, -1] = _FLAT
    heavier = np.column_stack([table, seen.healthy_a[use] - idle])
    left, best, deviation = fitted(heavier, wider)
    if 0.0 < best[-1] < _MOST_TIMES - 1.0:
        apart = best[:count]
        cost = 0.5 * (float(apart @ precision @ apart) + np.log(max(use.size, 2)))
        more = noise * (1.0 + float(best[-1]))
        yield Account("binding", nats(left, more), cost, {"times": Estimate.of(1.0 + float(best[-1]), deviation)})


def _blocked(seen: Seen, use: IntArray, pushed: FloatArray) -> Iterator[Account]:
    """Stalled wherever the command is away from some place: where it stands, and what it draws, are free."""
    motion, known = seen.series.motion, seen.known
    time_s = seen.series.time_s[use]
    motion = motion.within(time_s[0] - known.lag_s - known.width_s - 1.0, time_s[-1])
    least = _least_stall(seen)
    if not motion.time_s.size or np.count_nonzero(pushed > _STALL_SPREAD * least) < 2:
        return
    asked = np.quantile(motion.asked_deg, np.linspace(0.0, 1.0, _PLACES))
    places = np.unique(np.append(asked, motion.deflection_deg[0]))
    for slack_deg in _SLACK_DEG:
        shares = _shares(seen, time_s, places, slack_deg)
        far = shares > 0.5
        count = far.sum(axis=0)
        full = np.sort(np.where(far, pushed[:, None] / np.maximum(shares, 0.5), np.inf), axis=0)
        least_of_ten, middle = (full[np.maximum(count - 1, 0) * tenths // 10, range(places.size)] for tenths in (1, 5))
        needed_s = np.where(middle > _STALL * known.most_a, _SOON_S, _LASTS_S)
        stalls = (count > 1) & (middle >= least) & (least_of_ten >= _ALWAYS * middle)
        stalls &= count * seen.series.period_s >= needed_s
        for place in np.flatnonzero(stalls).tolist():
            stall = float(middle[place])
            yield Account(
                "blocked",
                each_of(seen.series) * _misfit(seen, use, "blocked", stall, shares[:, place]),
                float(np.log(places.size * len(_SLACK_DEG))),
                {
                    "current_a": Estimate.of(stall, _STALL_SPREAD * stall / float(np.sqrt(count[place]))),
                    "position_deg": Estimate.of(float(places[place]), slack_deg),
                },
                slack_deg,
            )


def _timed(seen: Seen, account: Account, alarm_s: float, earliest_s: float, *, named_s: float) -> Fault:
    """The fault with its name, as known at a time [s], its onset, from when it was the better account, and its end."""
    time_s = seen.series.time_s
    each = each_of(seen.series)
    rows = slice(*np.searchsorted(time_s, (max(alarm_s - _BEFORE_S, earliest_s), np.nextafter(alarm_s, np.inf))))
    gained = Sums.running([_gains(seen, account, rows)], seen.usable[rows])
    since = gained.between(np.arange(time_s[rows].size), -1).products[0]
    start_s = float(min(time_s[rows][split(since)], alarm_s)) if since.size else alarm_s
    span = slice(*np.searchsorted(time_s, (start_s, np.nextafter(named_s, np.inf))).tolist())
    healthy, *others = _accounts(seen, span) if seen.usable[span].any() else (account,)
    others = sorted(others, key=lambda one: one.total)
    rivals: list[Account] = []
    if others and others[0].total < healthy.total:
        account, rivals = others[0], [one for one in others if one.kind != others[0].kind]
    odds = float(np.exp(min(account.total - rivals[0].total, 0.0))) if rivals else 0.0
    first = int(np.searchsorted(time_s, alarm_s, side="right"))
    later = np.cumsum(each * np.clip(_gains(seen, account, slice(first, time_s.size)), -_LARGEST, _LARGEST))
    below = np.maximum.accumulate(np.maximum(later, 0.0)) - later
    ended = np.flatnonzero(below > _ENDED)
    end_s = None
    if ended.size:
        before = later[: ended[0]]
        end_s = float(time_s[first + int(np.argmax(before))]) if before.max(initial=0.0) > 0.0 else alarm_s
    return Fault(
        account.kind,
        start_s,
        alarm_s,
        end_s,
        account.parameters,
        min(1.0 / (1.0 + odds), _SUREST),
        (rivals[0].kind,) if odds > WORTH_TELLING else (),
        level="suspect"
        if seen.known.fitted_between_s and (account.kind == "binding" or end_s is not None)
        else "fault",
        named_s=named_s,
        witness="current",
    )


def _gains(seen: Seen, account: Account, rows: slice) -> FloatArray:
    """Nats by which a fault is the better account of each reading than the healthy servo, shape (k,).

    As if each said something of its own.
    """
    size, *_ = (estimate.value for estimate in account.parameters.values())  # before the place of a blocked one
    share: FloatArray | float = 0.0
    if account.kind == "blocked":
        place_deg = np.array([account.parameters["position_deg"].value])
        share = _shares(seen, seen.series.time_s[rows], place_deg, account.slack_deg)[:, 0]
    good = _nats(seen.series.current_a[rows] - seen.healthy_a[rows], seen.noise_a[rows])
    return np.where(seen.usable[rows], good - _misfit(seen, rows, account.kind, size, share), 0.0)
