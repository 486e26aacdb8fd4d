"""What a current tells of its servo: blocked, without power, binding; worn, where good flights or cycles are known.

A change is reported where the windows of its `Evidence` say that it is likelier than every healthy servo, by more than
its limit, for as long as its kind has to last. Its onset is the reading from which on it explains most; what it is, and
of whom on a wire, is what explains most of the readings between its onset and some seconds after the alarm.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Final

import numpy as np

from servofd.aircraft.current import CalibratedCurrent
from servofd.core.statistics import LEAST_DIVISOR, Estimate
from servofd.core.types import FloatArray
from servofd.core.windows import Sums, lasting, split
from servofd.current.evidence import GRID_S, KINDS, PUSHES, SLACK_DEG, Change, Evidence, least_stall
from servofd.current.model import Seen
from servofd.current.wear import worn
from servofd.detection.verdict import WORTH_TELLING, CurrentAudit, Fault, Status, accusation, describe

BY_CURRENT: Final = "by its current: "
"""With what the reason of a current begins that is not well."""
SURE_NATS: Final = 9.0
"""Nats by which one explanation must be likelier than another to exclude it: one in 8000 by chance."""
_STALL_SPREAD: Final = 0.35
"""A stalled motor draws what its duty lets it: so much, as a share, it differs from reading to reading."""
MARGIN: Final = 1.1
"""Times what windows of good flights reach, that a fault has to exceed."""
_LEAST_SIZE: Final = math.log(1.5)
"""Logarithm of how many times as much a binding servo draws, at least, where its onset is looked for."""
_MOST_TIMES: Final = 6.0
"""A servo that still moves draws less than so many times as much: of simulated motors at 10 Hz one with three times the
friction draws 2.9 times, and a stalled one seems to draw 20 to 30 times."""
_BEFORE_S: Final = 30.0
"""Time before an alarm in which its onset is looked for [s]."""
_BRIEF_S: Final = 10.0
"""What passes sooner is no fault where one part of a log is all that is known of its current: a gust, a landing [s]."""
_BINDS_S, _AGAIN_S = 20.0, 2.5
"""A servo that binds does so in one manoeuvre after the other, for as long at least: some seconds of hard work are the
air's; and time after which what was no fault may be one [s]."""
_MOST: Final = 6
"""Faults of one flight at most."""
_ENDS_S, _SIGMAS = 10.0, 3.0
"""Length of the window after a fault [s], and deviations by which it excludes it."""
_LARGEST: Final = 8.0
"""Nats that one reading counts for at most when an end is looked for."""
_NAMED_S: Final = 10.0
"""After the alarm, what it is has become clear: by what it draws in some movements [s]."""
_SUREST: Final = 0.99
"""Largest probability that is given."""
EXPLAINED, EXPLAINED_OWN = 0.15, 0.4
"""Share of the current that its motion must explain to be a witness: of good flights, and of a part of the log itself,
which may as well hold a fault."""
_HELD_S, _HELD_SHARE = 0.5, 0.95
"""For so long [s], but for moments, a servo must have been asked to be elsewhere before what it draws is a push:
several times the time in which hobby servos come where they are asked to be."""
_OF_MOTION: Final = 0.5
"""Share of what a healthy servo draws in motion, and its inverse, between which a current shows motion: where that is
hardly known, it explains any current better than a rest does. A jammed elevon drew 0.24 A for 2.74 A, another that
pushed against its stop 1.3 A for 0.15 A, and their sensors were accused."""


_NEARLY, _NEARLY_FOR = 0.5, 0.05
"""Share of its limit that a fault reaches, and of the windows in which it does, from which on the same log clears no
servo: servos blocked in gusts, which hardly push, reach it in 10 to 16 % of all windows, good ones in 3 % at most."""


def limit_of(known: CalibratedCurrent, kind: str) -> float:
    """Nats by which a kind of fault has to be likelier than a good servo; never, where one log is all that is known."""
    if known.fitted_between_s is not None and kind == "binding":
        return math.inf
    learnt: Mapping[str, float] = {str(name): limit for name, limit in known.limits_nats.items()}
    return max(KINDS[kind].limit, learnt.get(kind, 0.0))


def shares_of(evidence: Evidence, gains: FloatArray) -> FloatArray:
    """Gains of windows (changes, n) over the limit of each change."""
    limits = [limit_of(evidence.seen[change.names[0]].known, change.kind) for change in evidence.changes]
    return np.asarray(gains / np.array(limits)[:, None])


def held(shares: FloatArray, period_s: float) -> FloatArray:
    """The shares (..., n) that last for as long as two windows, or two readings."""
    return lasting(shares, max(math.ceil(period_s / GRID_S), 1) + 1)


def limits_of(good: Sequence[Mapping[str, Seen]]) -> dict[str, float]:
    """Nats that each kind needs: `MARGIN` times what any window of good flights reaches."""
    limits = {kind: one.limit for kind, one in KINDS.items()}
    for seen in good:
        evidence = Evidence.of(seen)
        if evidence.series.time_s.size > 1:
            gains = held(evidence.all_gains, evidence.series.period_s).max(axis=1)
            for change, gain in zip(evidence.changes, gains.tolist(), strict=True):
                limits[change.kind] = max(limits[change.kind], float(f"{MARGIN * gain:.3g}"))
    return limits


def is_witness(known: CalibratedCurrent) -> bool:
    """Whether a current goes with what its servo is asked to do."""
    return known.explained_share >= (EXPLAINED_OWN if known.fitted_between_s else EXPLAINED)


def no_witness(known: CalibratedCurrent) -> str:
    """Why a current is none, in words."""
    return (
        f"its current goes with only {max(known.explained_share, 0.0):.0%} of what it was asked to do: check that it "
        "is the current of this servo, on the clock of its commands, or record a minute of fast movements"
    )


def faults_of(seen: Seen) -> list[Fault]:
    """The faults that the current of one servo shows."""
    return list(events_of(Evidence.of({seen.series.surface: seen})))


def events_of(evidence: Evidence) -> Iterator[Fault]:
    """What happens one after the other, until something lasts to the end."""
    time_s, known = evidence.series.time_s, [one.known for one in evidence.seen.values()]
    if time_s.size < 2 or not all(map(is_witness, known)):
        return
    from_s, at_s, gains, found = -math.inf, evidence.grid_s, evidence.all_gains, 0
    while at_s.size and found < _MOST:
        shares = shares_of(evidence, gains)
        raised = np.flatnonzero(held(shares.max(axis=0), evidence.series.period_s) >= 1.0)
        if not raised.size:
            return
        alarm_s = float(at_s[raised[0]])
        at_s, found = at_s[at_s > alarm_s], found + 1
        fault = _fault(evidence, int(np.argmax(shares[:, raised[0]])), alarm_s, from_s)
        if fault is None:
            at_s, found = at_s[at_s > alarm_s + _AGAIN_S], found - 1
            gains = evidence.gains(at_s, from_s) if at_s.size else gains
            continue
        if not evidence.is_own or fault.end_s is None or fault.end_s - fault.start_s > _BRIEF_S:
            yield fault
        if fault.end_s is None:
            return
        from_s = max(fault.end_s, alarm_s)
        at_s = at_s[at_s > from_s]
        gains = evidence.gains(at_s, from_s) if at_s.size else gains


def _fault(evidence: Evidence, raised: int, alarm_s: float, from_s: float) -> Fault | None:
    """What a change that was noticed at a time is, since when, and until when; None if it is none, or not yet."""
    time_s, change = evidence.series.time_s, evidence.changes[raised]
    begin, last = np.searchsorted(time_s, (max(alarm_s - _BEFORE_S, from_s), np.nextafter(alarm_s, np.inf))).tolist()
    odds = evidence.odds(change, KINDS[change.kind].size or _LEAST_SIZE)
    since = Sums.running([odds[begin:last]], evidence.usable[begin:last])
    start_s = float(time_s[begin + split(since.between(np.arange(last - begin), -1).products[0])])
    named_s = min(alarm_s + _NAMED_S, float(time_s[-1]))
    explained, parameters = named(evidence, start_s, named_s)
    if not explained or explained[0][1] < KINDS[explained[0][0].kind].limit:
        return None
    change, nats = explained[0]
    if change.kind == "binding" and alarm_s - start_s < _BINDS_S:
        return None
    rivals = ((one.kind, math.exp(each - nats)) for one, each in explained if one.kind != change.kind)
    rival, chance = next(rivals, ("", 0.0))
    end_s = _end_s(evidence, change, alarm_s)
    return Fault(
        change.kind, start_s, alarm_s, end_s, parameters, min(1.0 / (1.0 + chance), _SUREST),
        (rival,) if chance > WORTH_TELLING else (), "suspect" if evidence.is_own and end_s is not None else "fault",
        named_s=named_s, witness="current",
    )  # fmt: skip


def named(
    evidence: Evidence, from_s: float, to_s: float, names: Collection[str] = ()
) -> tuple[tuple[tuple[Change, float], ...], Mapping[str, Estimate]]:
    """Changes in the order in which they explain what was read between two times, and the sizes of the first."""
    found = evidence.whole(from_s, to_s, evidence.fine)

    def may_be(k: int) -> bool:
        change, size = evidence.fine[k], float(found.size[k, 0])
        expected = KINDS[change.kind].size
        sizes = size < math.log(_MOST_TIMES) if expected is None else size > 0.5 * expected
        known = evidence.seen[change.names[0]].known
        is_judged = math.isfinite(limit_of(known, change.kind))
        return is_judged and (set(change.names) == set(names) if names else sizes)

    order = [k for k in np.argsort(-found.fit[:, 0]).tolist() if may_be(k)]
    if not order:
        return (), {}
    best, changes = order[0], [(evidence.fine[k], float(found.fit[k, 0])) for k in order]
    changes[0] = evidence.sized(changes[0][0], from_s, to_s), changes[0][1]
    sizes = _parameters(evidence, changes[0][0], float(found.deviation[best, 0]), from_s, to_s)
    return tuple(changes), sizes


def _parameters(
    evidence: Evidence, change: Change, deviation: float, from_s: float, to_s: float
) -> dict[str, Estimate]:
    """Sizes of a change between two times, in amperes."""
    time_s = evidence.series.time_s
    rows = evidence.usable & (time_s >= from_s) & (time_s <= to_s)
    known = evidence.seen[change.names[0]].known
    idle_a = max(float(known.theta[0]), 0.0)
    if change.kind == "binding":
        own_a = evidence.motion_a[change.names[0]][rows]
        drawn_a = evidence.drawn_a[rows] - evidence.good_a[rows] + own_a
        times = float(drawn_a @ own_a) / max(float(own_a @ own_a), LEAST_DIVISOR)
        return {"times": Estimate.of(times, times * deviation)}
    if change.kind == "unpowered":
        rest_a = idle_a + float(np.median(evidence.drawn_a[rows])) if rows.any() else 0.0
        return {"current_a": Estimate.of(min(max(rest_a, 0.0), idle_a), known.noise.still_a)}
    share = np.zeros(time_s.size) if change.share is None else change.share
    rows &= share > PUSHES
    stall_a = float(np.median(evidence.drawn_a[rows] / share[rows])) if rows.any() else 0.0
    spread_a = _STALL_SPREAD * abs(stall_a) / math.sqrt(max(int(np.count_nonzero(rows)), 1))
    return {"current_a": Estimate.of(stall_a, spread_a), "position_deg": Estimate.of(change.place_deg, SLACK_DEG)}


def _end_s(evidence: Evidence, change: Change, alarm_s: float) -> float | None:
    """Until when a change lasts: a window after it excludes half of its size; None if none does."""
    at_s, size = evidence.grid_s, KINDS[change.kind].size or _LEAST_SIZE
    at_s = at_s[at_s >= alarm_s + _ENDS_S]
    if not at_s.size:
        return None
    alike = [k for k, one in enumerate(evidence.changes) if (one.kind, one.names) == (change.kind, change.names)]
    (window,) = evidence.windows(at_s, alarm_s, (_ENDS_S,))
    most = np.max(window.size[alike] + _SIGMAS * window.deviation[alike], axis=0)
    ended = at_s[most < 0.5 * size]
    if not ended.size:
        return None
    time_s = evidence.series.time_s
    rows = slice(*np.searchsorted(time_s, (alarm_s, ended[0]), side="right").tolist())
    later = np.cumsum(np.clip(evidence.odds(change, size)[rows], -_LARGEST, _LARGEST))
    return float(time_s[rows][np.argmax(later)]) if later.max(initial=0.0) > 0.0 else alarm_s


def judged(seen: Seen, before: Sequence[FloatArray] = ()) -> CurrentAudit:
    """What is said of one surface by its current alone; arguments as of `verdict_of`."""
    evidence = Evidence.of({seen.series.surface: seen})
    return verdict_of(seen, list(events_of(evidence)), before, evidence=evidence)


def verdict_of(
    seen: Seen, found: Sequence[Fault], before: Sequence[FloatArray] = (), others: Sequence[Fault] = (),
    evidence: Evidence | None = None,
) -> CurrentAudit:  # fmt: skip
    """What is said of one surface by its current and its faults; of wear, with `features_of` cycles `before` it.

    While `others` on its wire are at fault the reading tells nothing of how much it draws. `evidence` is that of the
    reading, where there is one at hand.
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
    if evidence is None:
        evidence = Evidence.of({series.surface: seen})
    asked = would_show(evidence)
    status, reason = _status(known, asked, faults, suspicions, ratio, when)
    if status == "healthy" and known.fitted_between_s is not None and (alike := _alike(evidence)):
        status, reason = "unknown", alike
    return CurrentAudit(
        status, "; ".join((reason, *series.notes)), known.explained_share, ratio, faults, suspicions, series.time_s,
        series.current_a, seen.healthy_a, seen.sigma_a, (series.motion.time_s, series.motion.asked_deg), whole_share,
        asked=asked,
    )  # fmt: skip


def _status(
    known: CalibratedCurrent, asked: bool, faults: Sequence[Fault], suspicions: Sequence[Fault], ratio: float | None,
    when: str,
) -> tuple[Status, str]:  # fmt: skip
    if faults:
        return "fault", accusation(faults, BY_CURRENT)
    if not is_witness(known):
        return "unknown", no_witness(known)
    if suspicions:
        return "suspect", f"{BY_CURRENT}{'; '.join(map(describe, suspicions))}"
    if not asked:
        return "unknown", f"too little motion{when} for its current to tell a servo without power from one at rest"
    if known.fitted_between_s is None:
        times = "" if ratio is None else f" ({ratio:.2f} times theirs in motion)"
        return "healthy", f"its current is as in its good flights{times}"
    from_s, to_s = known.fitted_between_s
    return "healthy", (
        f"its current is as it was from {from_s:.0f} to {to_s:.0f} s: would have shown a servo that becomes "
        "blocked or loses its power, and not one that was so from the beginning, or wears"
    )


def _alike(evidence: Evidence) -> str:
    """Which fault explains the current nearly as well as it would have to, in words; nothing if none does for long.

    What a good servo draws is known from the same log alone, and a fault may be in it.
    """
    near = held(shares_of(evidence, evidence.all_gains), evidence.series.period_s) >= _NEARLY
    for kind in KINDS:
        alike = near[[change.kind == kind for change in evidence.changes]].any(axis=0)
        if alike.mean() >= _NEARLY_FOR:
            return (
                f"its current does not clear it: for {alike.mean():.0%} of the time it is nearly that of a servo that "
                f"is {kind}; calibrate what it draws on a good flight"
            )
    return ""


def would_show(evidence: Evidence) -> bool:
    """Whether a servo without power would have shown in these readings, taken together."""
    if evidence.series.time_s.size < 2 or not evidence.usable.any():
        return False
    deviation = float(evidence.whole(-math.inf, math.inf, evidence.changes[:1]).deviation[0, 0])
    kind = KINDS["unpowered"]
    return 0.5 / (deviation**2 + kind.healthy**2) > kind.limit


def tells_motion(seen: Seen, from_s: float, to_s: float) -> bool:
    """Whether between two times a servo that follows is likelier than one that stands still, with power or without."""
    if seen.series.time_s.size < 2:
        return False
    evidence = Evidence.of({seen.series.surface: seen})
    time_s = evidence.series.time_s
    rows = evidence.usable & (time_s >= from_s) & (time_s <= to_s)
    drawn_a, moving_a = (float(each[rows].sum()) for each in (evidence.drawn_a, evidence.good_a))
    if np.count_nonzero(rows) < 2 or not _OF_MOTION * moving_a <= drawn_a <= moving_a / _OF_MOTION:
        return False
    still = [one for one in evidence.changes if one.kind != "binding"]
    return max(float(evidence.odds(one, 1.0)[rows].sum()) for one in still) < -SURE_NATS


def pushed(seen: Seen, still: Fault, position: tuple[FloatArray, FloatArray]) -> Fault | None:
    """What tells that a servo which its position (times [s], [deg]) shows at rest pushes with all it has; else None.

    It does where it draws more than motion ever takes while it has long been asked to be elsewhere.
    """
    series, known = seen.series, seen.known
    motion, (time_s, read_deg) = series.motion, position
    given = np.isfinite(read_deg)
    stands_deg = np.interp(motion.time_s, time_s[given], read_deg[given])
    away = (np.abs(motion.asked_deg - stands_deg) > SLACK_DEG).astype(np.float64)
    (share,) = motion.rows(series.time_s, known.lag_s, known.width_s + _HELD_S, away[:, None]).T
    to_s = np.inf if still.end_s is None else still.end_s
    rows = (share > _HELD_SHARE) & (series.time_s >= still.start_s) & (series.time_s <= to_s)
    drawn_a = series.current_a[rows] - max(float(known.theta[0]), 0.0)
    if drawn_a.size < 2 or float(np.quantile(drawn_a, 0.1)) < least_stall(seen):
        return None
    stall_a, at_s = float(np.median(drawn_a)), float(series.time_s[rows][0])
    deviation_a = float(np.std(drawn_a)) / float(np.sqrt(drawn_a.size))
    parameters = {"current_a": Estimate.of(stall_a, max(deviation_a, known.noise.still_a))}
    return Fault("blocked", still.start_s, at_s, still.end_s, parameters, _SUREST, (), named_s=at_s, witness="current")
