"""The faults of a flight: an alarm, the hypothesis that explains it best, and when it began and ended.

An alarm is raised where a statistic stays above its threshold twice in a row or passes it by far, or where the fast
test passes its own. Each fault is refitted to what the surface did since, the other parameters free as they are between
good servos; the tests begin anew where it ended.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from servofd.core.statistics import Estimate
from servofd.detection.changes import STATISTICS, Memory, first_over, follow
from servofd.detection.hypotheses import (
    LOUD,
    SHORTEST_WINDOW_S,
    SWINGS,
    WINDOW_S,
    Guess,
    Window,
    concluded,
    is_strange,
    ranked,
    unexplained_deg,
)
from servofd.detection.kinds import STANDS_STILL
from servofd.detection.lasting import WITHIN_S
from servofd.detection.moving import watched
from servofd.detection.outages import LONGEST_S
from servofd.detection.verdict import EVEN, Fault
from servofd.estimate.record import Record

if TYPE_CHECKING:
    from collections.abc import Callable

    from servofd.aircraft.calibrated import CalibratedServo
    from servofd.aircraft.series import Series
    from servofd.core.types import FloatArray
    from servofd.detection.lasting import Lasting
    from servofd.detection.moving import Moving, Watched

_SETTLING_S: Final = 0.5
"""Time after an alarm before which a window that explains it does not begin [s]."""
_BEFORE_S: Final = 62.0
"""Time before an alarm in which its onset is looked for [s]."""
_LATELY_S: Final = 1.5
"""Time before an alarm that its window holds [s]."""
_FEWEST: Final = 12
"""Samples of a window."""
_RAN_DEG = 2.0
"""What stays at an end of the travel ran there if it was further away, and else stopped there."""
_ENDED = 2.0
"""Seconds of one standard deviation by which the healthy servo must explain better what comes after an end: by 1 a slow
servo was cleared twice while it was slow, over a link that lost 20 % in bursts."""
_AFTER_END_S = 1.5
"""How long the healthy servo must explain what comes after an end better [s]."""
_ELSEWHERE: Final = 9.0
"""Misfit of a sample that neither the fault nor the healthy servo explains: the fault does what no hypothesis says."""
_SURELY_ENDED, _SOON_S = 5.0, 0.5
"""So much better it need do for no longer than this."""
_MUCH_LESS: Final = 2.0
"""Times the misfit that the moments before have: a tenth of a second that is not explained at all makes so much."""
_LOG_CLIP = 25.0
"""Largest squared error of a sample, in variances."""
_NO_NEWS = 0.01
"""By so little a fault may explain a sample better, and yet not have begun."""
_GROWN: Final = 1.3
"""Hypotheses fitted to a window are fitted again when it holds so many times as many samples since the alarm."""
_MOST_FAULTS: Final = 20
"""Alarms of one flight that are named at most, suspicions among them; what comes later is not looked at."""
_RESIDUALS: Final = STATISTICS.index("left_2s")
"""So many statistics are of the residual over its total sigma, not of what is left of it."""
AGAIN_S: Final = 1.0
"""After a fault has ended the tests begin anew."""
_SOON_AFTER_S: Final = 5.0
"""For so long after an alarm its size counts."""
_STILL_FAST: Final = 0.69
"""Share of the speed from which on a servo is a good one: speed goes with the supply, and friction with the
temperature, a fifth each, between good flights."""
_STILL_ALL: Final = 0.93
"""Share of the travel from which on none is lost."""
_LASTING: Final = ("slow", "loss_of_effectiveness", "bias", "deadband")
"""Kinds that come of wear, and are none if they barely pass and last for a moment only."""
_SHOWN_EARLY: Final = ("slow", "loss_of_effectiveness", "bias")
"""Kinds that begin before their alarm, or are none where only a test of what the residual may mean raised it."""
_NONE: Final = (("bias_deg", 0.0), ("gain", 1.0), ("bandwidth_scale", 1.0), ("width_deg", 0.0))
"""What a healthy servo has."""
_LEAST_DEG: Final = {"oscillation": ("amplitude_deg", 0.2), "deadband": ("width_deg", 0.2)}
"""What the narrow-band test counts as an oscillation, and less play than any servo has."""
_SHORTEST_WEAR_S: Final = 2.0
"""What is shorter is no wear."""
_OF_ONE_CONTACT: Final = 3
"""So many brief faults, each soon after the one before, have one cause."""
SAME_S: Final = 5.0
"""What is raised so soon after the end of a fault belongs to it."""


_NAMED_S: Final = 120.0
"""Time after a change by which it is named."""
LOOKS_S: Final = (0.0, 0.25, 0.5, 1.0, 1.75)
"""After how long a monitor looks whether what windows raise is a fault,"""
LOOKS_BACK_S: Final = 65.0
"""and how far back: past the longest window, and past the earliest onset."""


class Named(NamedTuple):
    """Hypotheses fitted to a window, the best one first; nothing to do with a servo that the user named."""

    known: int
    """How many samples there were since the alarm when they were fitted."""
    window: Window
    guesses: list[Guess]


def named(
    watched: Watched, alarm_s: float, ratio: float, *, earliest_s: float, names: dict[float, Named]
) -> tuple[Fault, Guess | None]:
    """Name what an alarm stands for, `healthy` if a working servo explains it after all; and the hypothesis behind it.

    `ratio` is the largest statistic over its threshold at or after the alarm; `names` holds what was fitted to alarms
    when less was known of them, and is kept up to date.
    """
    window = Window(watched, alarm_s + _SETTLING_S, alarm_s + WINDOW_S)
    if window.count < max(_FEWEST, 1.5 / watched.record.period_s):
        # An alarm of a moment ago: since the healthy servo was last right, if that is enough.
        from_s = max(alarm_s - _LATELY_S, earliest_s)
        lately = slice(*np.searchsorted(watched.record.time_s, (from_s, alarm_s)).tolist())
        window = Window(watched, from_s, alarm_s + WINDOW_S)
        right = np.flatnonzero(np.abs(watched.error_deg[lately]) < watched.sigma_deg[lately])
        if right.size:
            since = Window(watched, float(watched.record.time_s[lately][right[-1]]) + 1e-9, alarm_s + WINDOW_S)
            window = since if since.count >= _FEWEST else window
    if window.count < _FEWEST:
        return Fault("unknown", alarm_s, alarm_s, None, {}, 0.5, ()), None
    before, count = names.get(alarm_s), int(np.sum(window.time_s[window.used] >= alarm_s))
    if before is not None and (
        count < _GROWN * before.known or _end_s(watched, before.guesses[0], alarm_s) is not None
    ):
        _, window, guesses = before
    else:
        window, guesses = _explained(watched, window, alarm_s)
        if before is not None and guesses[0].kind == "floating" and _changes(watched, before.guesses[0], alarm_s):
            _, window, guesses = before  # a jam, and the way back from it, look like a surface that moves by itself
        else:
            names[alarm_s] = Named(count, window, guesses)
    end_s = _end_s(watched, guesses[0], alarm_s)
    if end_s is not None and not guesses[0].outages and alarm_s + 1.5 < end_s < alarm_s + WINDOW_S - 2.0:
        settling_s = min(_SETTLING_S, 0.2 * (end_s - alarm_s))
        shorter = Window(watched, alarm_s + settling_s, end_s - settling_s)
        if shorter.count >= _FEWEST:
            window, guesses = shorter, ranked(shorter)
            end_s = _end_s(watched, guesses[0], alarm_s)
    kind, probability, alternatives, parameters = concluded(window, guesses, ratio)
    # It began when the fault became the better explanation.
    time_s, healthy, other = _misfits(watched, guesses[0], max(alarm_s - _BEFORE_S, earliest_s), alarm_s + 1.0)
    better = np.cumsum((healthy - other - _NO_NEWS)[::-1])[::-1]
    began = time_s.size > 0 and better.max() > 0.0
    start_s = float(min(time_s[int(np.argmax(better))], alarm_s)) if began else alarm_s
    if kind == "hardover":
        there = min(int(np.searchsorted(watched.record.time_s, start_s)), watched.reading_deg.size - 1)
        if abs(watched.reading_deg[there] - parameters["position_deg"].value) < _RAN_DEG:  # it stopped where it was
            kind, alternatives = "stuck", ("hardover", *(other for other in alternatives if other != "stuck"))
    fault = Fault(
        kind, start_s, alarm_s, end_s, parameters, probability, alternatives,
        named_s=float(min(window.time_s[-1], alarm_s + WINDOW_S)),
    )  # fmt: skip
    return fault, guesses[0]


def _explained(watched: Watched, window: Window, alarm_s: float) -> tuple[Window, list[Guess]]:
    """The window, shorter by halves where it holds the end of a fault, so that no hypothesis explains it."""
    guesses = ranked(window)
    length_s = WINDOW_S
    while is_strange(window, guesses) and length_s > SHORTEST_WINDOW_S:
        length_s *= 0.5
        shorter = Window(watched, alarm_s + _SETTLING_S, alarm_s + length_s)
        if shorter.count < _FEWEST:
            break
        tried = ranked(shorter)
        if not is_strange(shorter, tried):
            return shorter, tried
    return window, guesses


def _misfits(watched: Watched, guess: Guess, from_s: float, to_s: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Sample times, and the squares of what the healthy servo and the guess leave of each, over its variance."""
    stretch = Window(watched, from_s, to_s)
    used, total_deg = stretch.used, stretch.total_deg
    healthy, other = (
        np.minimum((error_deg / total_deg) ** 2, _LOG_CLIP)[used]
        for error_deg in (watched.error_deg[stretch.rows], unexplained_deg(stretch, guess))
    )
    return stretch.time_s[used], healthy, other


def _changes(watched: Watched, guess: Guess, alarm_s: float) -> bool:
    """Whether a hypothesis explains the latest moments much less well than those before: it may end."""
    last_s = float(watched.record.time_s[-1])
    time_s, _, other = _misfits(watched, guess, max(alarm_s, last_s - 2.0 * _AFTER_END_S), last_s + 1.0)
    late = time_s > last_s - _AFTER_END_S
    return bool(late.any() and not late.all() and other[late].mean() > _MUCH_LESS * max(other[~late].mean(), 1.0))


def _end_s(watched: Watched, guess: Guess, alarm_s: float) -> float | None:
    """When the healthy servo became the better explanation again; None if it never did."""
    last_s = float(watched.record.time_s[-1])
    if guess.outages:
        ended_s = guess.outages[-1].to_s
        return ended_s if last_s - ended_s > WINDOW_S else None
    time_s, healthy, other = _misfits(watched, guess, alarm_s, last_s + 1.0)
    if time_s.size < _FEWEST:
        return None
    so_far = np.cumsum(healthy - np.minimum(other, _ELSEWHERE)) * watched.record.period_s
    best = np.maximum.accumulate(so_far)
    top_s = time_s[np.searchsorted(best, best)]  # when it was best so far
    fell, after_s = best - so_far, time_s - top_s
    ended = ((fell > _ENDED) & (after_s > _AFTER_END_S)) | ((fell > _SURELY_ENDED) & (after_s > _SOON_S))
    return float(top_s[np.argmax(ended)]) if ended.any() else None


class Found(NamedTuple):
    """What became of a flight."""

    faults: tuple[Fault, ...]
    suspicions: tuple[Fault, ...]
    left_deg: FloatArray
    """What the healthy servo, or a fault, leaves of each position [deg], (m,); NaN where none is judged."""
    against: str = ""
    """Why nothing should be concluded from them."""
    looked_to_s: float = np.inf
    """Until when it was looked at, where there were more alarms than are named [s]."""


def judged(flight: Watched, names: dict[float, Named] | None = None) -> Found:
    """Find and name the faults of a flight; `names` are those of earlier looks at it, see `named`."""
    names = {} if names is None else names
    limits = flight.tests.limits
    time_s, error_deg = flight.record.time_s, flight.error_deg
    faults: list[Fault] = []
    suspicions: list[Fault] = []
    left_deg = error_deg.copy()
    begin, earliest_s, looked_to_s = 0, float(time_s[0]) if time_s.size else 0.0, np.inf
    for _ in range(_MOST_FAULTS):
        rows = (time_s, error_deg, flight.slopes, flight.noise_deg, flight.lost_deg)
        rest = [each[begin:] for each in rows]
        tested = follow(flight.tests, Memory(flight.tests), *rest) if begin else flight.tested
        grid_s, statistics = tested.grid_s, tested.statistics
        passed = flight.shown.passed[begin:]
        if flight.alone:
            grid_s, statistics = grid_s[:0], statistics[:0]
        raised_s, ratio, is_far = _alarm(limits, time_s[begin:], passed, grid_s, statistics[:, : len(STATISTICS)])
        if not np.isfinite(raised_s):
            break
        fault, guess = named(flight, raised_s, ratio, earliest_s=earliest_s, names=names)
        fault = _weighed(fault, ratio, is_far=is_far)
        if guess is not None and fault.kind != "healthy" and (fault.kind == guess.kind or guess.kind != "oscillation"):
            there = Window(flight, fault.start_s, float(time_s[-1]) if fault.end_s is None else fault.end_s)
            explained = 1.0 / SWINGS if guess.kind == "oscillation" else 1.0
            left_deg[there.rows][there.used] = explained * unexplained_deg(there, guess)[there.used]
        if fault.kind == "healthy":
            suspicions.append(fault)
        else:
            faults, fault = _added(faults, fault, raised_s)
        if fault.end_s is None:
            if fault.kind != "healthy":
                break
            earliest_s = raised_s + 20.0
        else:
            earliest_s = max(fault.end_s, raised_s)
        begin = int(np.searchsorted(time_s, earliest_s + AGAIN_S))
        if begin >= time_s.size - 2:
            break
    else:
        looked_to_s = earliest_s
    return Found(tuple(faults), tuple(suspicions), left_deg, looked_to_s=looked_to_s)


def _weighed(fault: Fault, ratio: float, *, is_far: bool) -> Fault:
    """The same fault, or none: what barely passes its threshold has to be one that servos have.

    A servo that is a little slow is still a good one, on a cold day or a low supply; and none is worn, weak or bent for
    a moment only, nor is an offset or play one that may as well be none. What explains no moment better is none. Where
    the residual itself stays within what good flights do, what has no name is none, and what raised the alarm has to
    tell of wear before.
    """
    still_fast = fault.kind == "slow" and _size(fault, "bandwidth_scale") >= _STILL_FAST
    lasted_s = np.inf if fault.end_s is None else fault.end_s - fault.start_s
    never = lasted_s <= 0.0  # better than health at no time
    short = fault.kind in _LASTING and lasted_s < _SHORTEST_WEAR_S
    little = fault.kind == "loss_of_effectiveness" and _size(fault, "gain") >= _STILL_ALL
    barely = ratio < LOUD and (short or little or _may_be_none(fault) or _has_no_name(fault))
    size, least = _LEAST_DEG.get(fault.kind, ("", 0.0))
    tiny = _size(fault, size) < least
    is_early = fault.kind in _SHOWN_EARLY and fault.start_s >= fault.alarm_s
    if still_fast or tiny or never or (not is_far and is_early) or barely or (fault.kind == "unknown" and not is_far):
        own = () if fault.kind == "unknown" else (fault.kind,)
        return replace(fault, kind="healthy", parameters={}, alternatives=(*own, *fault.alternatives)[:3])
    return fault


def _size(fault: Fault, name: str) -> float:
    """A size of it; NaN where it has none of this name."""
    return fault.parameters[name].value if name in fault.parameters else np.nan


def _has_no_name(fault: Fault) -> bool:
    """Whether it is not more probable than all other kinds; that a surface stands still has a name, if not why."""
    stands = fault.kind in STANDS_STILL and any(other in STANDS_STILL for other in fault.alternatives[:1])
    return fault.kind == "unknown" or (fault.probability < EVEN and not stands)


def _may_be_none(fault: Fault) -> bool:
    """Whether a size of it may be that of a healthy servo."""
    sizes = fault.parameters
    return any(sizes[key].low <= none <= sizes[key].high for key, none in _NONE if key in sizes)


def _comes_and_goes(fault: Fault) -> bool:
    """Whether a fault may be one more moment of a contact that does."""
    return fault.kind == "intermittent" or (fault.end_s is not None and fault.end_s - fault.start_s < LONGEST_S)


def _added(faults: list[Fault], fault: Fault, raised_s: float) -> tuple[list[Fault], Fault]:
    """The faults of a flight with one more, which may belong to the last of them; and that one as it is now."""
    since_s = raised_s - (faults[-1].end_s or raised_s) if faults else np.inf
    before = faults
    if since_s < WINDOW_S and _are_one_contact(faults[-1], fault):
        *before, first = faults
        longer = first if first.kind == "intermittent" else fault
        fault = replace(longer, start_s=first.start_s, alarm_s=first.alarm_s, end_s=fault.end_s)
    elif since_s < SAME_S:
        *before, first = faults
        fault = _joined(first, fault)
    gathered = _gathered([*before, fault])
    return gathered, gathered[-1]


def _are_one_contact(first: Fault, then: Fault) -> bool:
    """Whether one of two faults is a contact that comes and goes, and the other one more moment of it."""
    return "intermittent" in (first.kind, then.kind) and _comes_and_goes(first) and _comes_and_goes(then)


def _gathered(faults: list[Fault]) -> list[Fault]:
    """The same faults; the last three are one contact that comes and goes, if they are brief and soon after another."""
    last = faults[-_OF_ONE_CONTACT:]
    lengths_s = [_moment_s(fault) for fault in last if fault.end_s is not None and _comes_and_goes(fault)]
    apart_s = [two.start_s - (one.end_s or two.start_s) for one, two in pairwise(last)]
    if len(lengths_s) < _OF_ONE_CONTACT or max(apart_s) > WINDOW_S:
        return faults
    size = {"outage_s": Estimate.of(float(np.median(lengths_s)), float(np.std(lengths_s)))}
    first = last[0]
    others = first.alternatives if first.kind == "intermittent" else (first.kind,)
    one = replace(first, kind="intermittent", parameters=size, end_s=last[-1].end_s, alternatives=others)
    return [*faults[:-_OF_ONE_CONTACT], one]


def _moment_s(fault: Fault) -> float:
    """How long a brief fault lasts, or one moment of a contact that comes and goes [s]."""
    if "outage_s" in fault.parameters:
        return fault.parameters["outage_s"].value
    return (np.inf if fault.end_s is None else fault.end_s) - fault.start_s


def _joined(first: Fault, then: Fault) -> Fault:
    """One fault of two that follow each other at once; named as the longer one is."""
    end_s, begun_s = first.end_s or first.alarm_s, then.alarm_s
    lasted_s = (np.inf if then.end_s is None else then.end_s) - begun_s
    longer = then if lasted_s >= end_s - first.alarm_s else first
    return replace(longer, start_s=first.start_s, alarm_s=first.alarm_s, end_s=then.end_s)


def _alarm(
    limits: FloatArray, time_s: FloatArray, passed: FloatArray, grid_s: FloatArray, statistics: FloatArray
) -> tuple[float, float, bool]:
    """When the first alarm is raised [s], infinite if never, and the largest statistic over its threshold then.

    `passed` is the fast test over its threshold. Last whether the residual itself passes a threshold, not only a test
    of what it may mean.
    """
    at_s = min(first_over(limits, np.zeros(limits.size), (time_s, passed), (grid_s, statistics)))
    if not np.isfinite(at_s):
        return np.inf, 0.0, False
    soon = statistics[(grid_s >= at_s) & (grid_s <= at_s + _SOON_AFTER_S)] / limits
    fast = float(passed[(time_s >= at_s) & (time_s <= at_s + _SOON_AFTER_S)].max(initial=1.0))
    is_far = fast > 1.0 or soon[:, :_RESIDUALS].max(initial=0.0) >= 1.0
    return at_s, float(soon.max(initial=fast)), bool(is_far)


def as_raised(flight: Watched, found: Found, look: Callable[[float, float], Found]) -> Found:
    """What was found, each fault with the time at which the monitor raises its alarm.

    A residual over its threshold raises one at once, windows with the first look that finds a fault; `look` tells what
    one between two times [s] finds.
    """
    time_s, passed, raised, over_s = flight.record.time_s, flight.shown.passed, [], -np.inf
    for fault in found.faults:
        crossed_s = time_s[(passed >= 1.0) & (time_s >= fault.alarm_s)]
        alarm_s = float(crossed_s[0]) if crossed_s.size else np.inf
        places = np.searchsorted(time_s, fault.alarm_s + np.array(LOOKS_S))
        for at_s in time_s[np.minimum(places, time_s.size - 1)].tolist():
            if at_s >= alarm_s:
                break
            if any(each.alarm_s > over_s for each in look(at_s - LOOKS_BACK_S, at_s).faults):
                alarm_s = at_s
                break
        raised.append(replace(fault, alarm_s=alarm_s) if np.isfinite(alarm_s) else fault)
        over_s = raised[-1].alarm_s if fault.end_s is None else fault.end_s
    return found._replace(faults=tuple(raised))


def watched_segment(
    known: CalibratedServo, segment: Series, moving: Moving | None = None, noise_deg: FloatArray | None = None
) -> Watched:
    """What the detector needs of a flight; see `servofd.detection.moving.watched`."""
    has_airspeed = segment.context.airspeed_s.size > 0
    at_once = moving is not None and moving.at_once
    record = Record.of(segment, known.supply_v, known.airspeed_m_s, at_once=at_once)
    return watched(known if has_airspeed else known.without_airspeed(), record, moving, noise_deg)


def changed(faults: tuple[Fault, ...], seen: Lasting, flight: Watched, slow_s: float) -> tuple[Fault, ...]:
    """The faults of a flight, with the change that only the whole of it shows.

    Servos that are slower together, since `slow_s`, are at fault of that in place of all slowness that was seen since;
    a change of one alone counts if it is beyond doubt and nothing else is at fault.
    """
    is_common = seen.is_slower_near(slow_s)
    since_s = slow_s if is_common else seen.beyond_doubt_s()
    if not np.isfinite(since_s) or (faults and not is_common):
        return faults
    end_s = float(flight.record.time_s[-1])
    window = Window(flight, since_s, since_s + _NAMED_S)
    if window.count < _FEWEST:  # it set in where nothing was judged
        judged_s = flight.record.time_s[flight.judged]
        shown_s = float(judged_s[judged_s >= since_s].min(initial=end_s))
        window = Window(flight, shown_s, shown_s + _NAMED_S)
    if window.count < _FEWEST:
        return faults
    guesses = ranked(window)
    kind, probability, others, sizes = concluded(window, guesses, LOUD)
    if is_common and kind != "slow":
        slow = next(guess for guess in guesses if guess.kind == "slow")
        kind, others, sizes = "slow", tuple(other for other in (kind, *others) if other != "slow")[:3], slow.parameters
    same = [each for each in faults if abs(each.start_s - since_s) < WITHIN_S or _is_part(each, kind, since_s)]
    alarm_s = min((each.alarm_s for each in same), default=end_s)
    one = Fault(kind, since_s, alarm_s, None, dict(sizes), probability, others, named_s=float(window.time_s[-1]))
    if not is_common and _weighed(one, LOUD, is_far=True).kind == "healthy":
        return faults
    kept = [each for each in faults if each not in same]
    return tuple(sorted((*kept, one), key=lambda each: each.start_s))


def _is_part(fault: Fault, kind: str, since_s: float) -> bool:
    """Whether a fault is a moment of one of a kind that lasts since some time [s]."""
    return fault.kind == kind and fault.start_s > since_s
