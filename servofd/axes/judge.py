"""Verdict on each axis of one flight: what it lost, since when, and what the flight could have shown.

A surface that lost the share lambda of its command's effect and stands beta away leaves in the residual of a form

    e = lambda x1 + beta x2,     x1 = -K F(g u),  x2 = K F(g)

theta = (lambda, beta) is estimated by least squares in every window that ends at a sample, with the covariance
Sigma_n of the noise, by cumulative sums. Healthy flights differ from each other by P_flight, and windows of one flight
by P_window. What a flight was like so far tells what to expect of it, theta0 with covariance P0 (Bayes' rule, prior
N(0, P_flight)), and what counts is

    J = (theta - theta0)^T (Sigma_n + P_window + P0)^-1 (theta - theta0)

one-sided in lambda: more effect than expected is no loss. An aircraft that has failed before its flight must not teach
what to expect, so theta0 is held within what flights differ by.

A servo that became slow leaves e = tau x3 with x3 = dx1/dt, to first order in the lag tau, which is judged beside any
loss and offset. Turbulence differs from flight to flight, so that Sigma_n is scaled by what each window itself leaves
unexplained (an inverse gamma prior, worth some seconds, keeps short windows from being too sure).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from servofd.aircraft.axes import MOST_OF_THE_FLIGHT, SURFACE_AXES
from servofd.axes.model import FORMS, Inputs, covered, flown_of, inputs_of
from servofd.axes.verdict import (
    KNOWN_WITHIN,
    AxisAudit,
    AxisDetectable,
    AxisEvent,
    AxisStatus,
    excludes_none,
    left_out,
    reason_of,
)
from servofd.axes.windows import LAG, SIZES, Windows, part
from servofd.core.errors import NoMeasurement
from servofd.core.statistics import LEAST_DIVISOR, Z_95, Estimate
from servofd.core.types import BoolArray, FloatArray
from servofd.core.windows import Sizes, fitted, split

if TYPE_CHECKING:
    from servofd.aircraft.axes import AxisModel, MotionModel, Spread
    from servofd.axes.motion import Motion

_NAMING_S = 1.0
"""As long after an alarm another axis may still show that it is the cause: a nose that drops late follows a rudder."""
_KIND_S = 20.0
"""As long after an alarm it is seen whether the axis acts late or too little."""
_LAGS_S = np.concatenate(([0.0], np.geomspace(0.02, 2.0, 47)))
"""Time constants that are tried, a tenth apart [s]."""
_UNKNOWNS = 3
"""Unknowns of an axis: lost share, offset, and what else moves it."""
_CLEAR_S = 5.0
"""Length of the windows that end an alarm [s]."""
_CLEAR_SHARE = 0.25
"""Share of the level of a suspicion below which an axis is well again."""
_ONSET_S = 60.0
"""Time before an alarm in which its onset is looked for [s]."""
_OWN_PAST_S = 15.0
"""A flight that was judged for less does not tell what it was like before a fault."""
_AT_ONCE_S = 10.0
"""What began within so many judged seconds is how this flight is, not what happened in it."""
_LEARNING_S = 20.0
"""Judged flight after an onset from which what the axis became is estimated [s]."""
_LEAST_EXPLAINED = 0.1
"""Least share of the motion that a model is taken to explain."""
_FAILED_LOSS, _FAILED_US = 0.25, 100.0
"""A single axis that differs by more from the beginning failed before take-off, or is of another aircraft."""


def judge_motion(model: MotionModel, motion: Motion) -> tuple[AxisAudit, ...]:
    """Judge the axes of one flight.

    Everything is causal: the statistic at a sample uses no later one, so that a monitor sees the same alarms.
    """
    lacking = [name for name, axis in model.axes.items() if FORMS[axis.form].command not in motion.asked]
    if lacking:
        raise NoMeasurement(
            f"{motion.name}: no output commands {' and '.join(lacking)}, as one did in the calibration flights: this "
            "is another aircraft, or SERVOn_FUNCTION changed; calibrate on flights of its own"
        )
    inside = covered(model.regime, flown_of(motion, model.reference_m_s))
    usable = motion.present & np.logical_and.reduce(list(inside.values()))
    flown = motion.present & (motion.airspeed_m_s > 0.5 * model.reference_m_s)
    drafts = {
        name: _draft(axis, motion, usable, flown, model, len(_members(name, axis, motion)))
        for name, axis in model.axes.items()
    }
    events = _with_causes(drafts, {name: axis.noise_var for name, axis in model.axes.items()}, motion.time_s)
    differing = [name for name, found in events.items() if any(event.from_start for event in found)]
    return tuple(
        _verdict(name, model, drafts[name], events[name], motion, inside, flown, differing) for name in model.axes
    )


@dataclass(frozen=True, slots=True)
class _Draft:
    inputs: Inputs
    score: FloatArray
    changes: FloatArray
    """Statistic beyond what the axis became with its latest event."""
    events: tuple[AxisEvent, ...]
    known: BoolArray
    """Where a member that stood still would be found, and lambda is known to less than +-0.3."""
    shows: FloatArray
    """Smallest loss, and offset [us], that would have been found at each sample; shape (2, n)."""
    whole: tuple[Estimate, Estimate] | None


@dataclass(slots=True)
class _Change:
    """An event while the flight is followed: samples, and by what it is judged."""

    start: int
    alarm: int
    learned: int
    """From here on what comes is judged beyond it."""
    last: int
    end: int
    before: Inputs
    """Of the flight before it and any event that still lasts."""
    past: Sizes
    rest: Inputs
    """Beyond what still lasts."""
    score: FloatArray
    from_start: bool


def _in_most(least: FloatArray) -> float:
    """What is found in most of a flight."""
    return float(np.quantile(least, MOST_OF_THE_FLIGHT, method="higher")) if least.size else math.inf


def _members(name: str, axis: AxisModel, motion: Motion) -> tuple[str, ...]:
    """Surfaces of an axis, in this flight or as calibrated."""
    return motion.members.get(name) or axis.members


def _draft(
    axis: AxisModel, motion: Motion, usable: BoolArray, flown: BoolArray, model: MotionModel, members: int
) -> _Draft:
    inputs = inputs_of(axis, motion, usable, model.reference_m_s)
    score, news, changes = _followed(axis, inputs)
    return _Draft(
        inputs,
        score,
        news,
        tuple(_event(axis, change, motion.time_s) for change in changes),
        *_known(axis, inputs, max(members, 1)),
        _whole(axis, inputs, flown),
    )


def _followed(axis: AxisModel, inputs: Inputs) -> tuple[FloatArray, FloatArray, list[_Change]]:
    """What happened to an axis, one event after the other.

    An alarm lasts until the axis answers as before. While it does, the axis is as its event left it, and what comes
    is judged beyond that, unless it is as before or as another event left it.
    """
    size = inputs.usable.size
    judged, learning = np.cumsum(inputs.usable), _LEARNING_S * inputs.rate_hz
    score, news = np.zeros((2, size))
    changes: list[_Change] = []
    standing: list[_Change] = []
    flight, now, states, begin = inputs, inputs, [inputs], 0
    while begin < size:
        back = standing[-1].end if standing else size
        rest = replace(now, usable=inputs.usable & (np.arange(size) >= begin)) if begin else now
        news[begin:back] = _beyond(axis, now, begin, back)
        if not standing:
            score[begin:] = news[begin:]
        above = np.flatnonzero(news[begin:back] > axis.suspect)
        if not above.size:
            begin, now, standing, states = back, flight, [], [flight]
            continue
        alarm = begin + int(above[0])
        past = _own_past(axis, rest, alarm, begin)
        start = _onset(axis, rest, alarm, begin, past)
        again = _known_state(axis, states, now, (start, alarm + 1))
        if again is not None:
            begin, now = start, again
            continue
        from_start = flight is inputs and not standing and bool(judged[start] <= _AT_ONCE_S * inputs.rate_hz)
        learned = int(np.searchsorted(judged, learning + (0.0 if from_start else judged[start])))
        learned = min(max(alarm + 1, learned), size)
        before = standing[0].before if standing else rest
        if from_start:
            end, last, past = size, learned, Sizes.nothing(axis.of_flights(axis.spreads[-1].covariance))
        else:
            recovered = _recovered(axis, before, alarm)
            end = size if recovered is None else recovered
            # It was well in a run of windows that each last as long as the run.
            last = size if recovered is None else max(alarm + 1, recovered - round(2.0 * _CLEAR_S * inputs.rate_hz))
        for change in standing:
            change.end = end
            change.last = min(change.last, max(start, change.alarm + 1))
        past = standing[0].past if standing else past
        change = _Change(start, alarm, learned, last, end, before, past, rest, news.copy(), from_start)
        changes.append(change)
        if not from_start and learned >= end:
            begin, now, standing, states = end, flight, [], [flight]
            continue
        now, begin = _became(axis, flight, start, learned), learned
        if from_start:
            flight, states = now, [now]
            score[: learned + 1] = 0.0
        else:
            states.append(now)
            standing.append(change)
    return score, news, changes


def _known_state(axis: AxisModel, states: list[Inputs], now: Inputs, part: tuple[int, int]) -> Inputs | None:
    """The state that an axis was in before, if a part of the flight is as usual in it; None if in none."""
    others = ((one, _beyond(axis, one, *part)) for one in states if one is not now)
    return next((one for one, away in others if away.max() <= axis.suspect), None)


def _beyond(axis: AxisModel, state: Inputs, first: int, last: int) -> FloatArray:
    """Statistic of a part of the flight, of which nothing else is known."""
    part = state if first == 0 and last == state.usable.size else state.part(first, last)
    return Windows.of(axis, part).statistic()


def _became(axis: AxisModel, flight: Inputs, start: int, learned: int) -> Inputs:
    """What is left beyond the loss, the offset and the lag of an axis since an event."""
    loss, offset = np.nan_to_num(part(flight, start, learned, axis.noise_var).value[:, 0]).tolist()
    lag_s = float(np.nan_to_num(part(flight, start, learned, axis.noise_var, LAG).value[0, 0]))
    return flight.less(loss, offset, lag_s)


def _event(axis: AxisModel, change: _Change, time_s: FloatArray) -> AxisEvent:
    """An event, as it is said: its sizes hold all that the axis has lost since the flight was as usual."""
    lost, offset = _estimate(axis, change.before, change.start, change.last, change.past)
    kind = slice(change.alarm, min(change.last, change.alarm + round(_KIND_S * change.before.rate_hz)))
    return AxisEvent(
        start_s=float(time_s[change.start]),
        alarm_s=float(time_s[change.alarm]),
        end_s=None if change.end >= time_s.size else float(time_s[change.end]),
        score=float(change.score[change.alarm : change.last].max()),
        lost_share=lost,
        offset_us=offset,
        lag_s=_late(axis, change.rest.less(*change.past.value[:, 0].tolist()), kind),
        from_start=change.from_start,
        known_s=float(time_s[change.learned]) if change.learned < time_s.size else math.inf,
    )


def _late(axis: AxisModel, inputs: Inputs, span: slice) -> Estimate | None:
    """Lag in a part of the flight, if a first-order lag of the command explains it better than a loss or an offset.

    The lag is simulated, because to first order it holds only while the filter passes nothing as fast as the lag.
    """
    if not axis.own_command:
        return None
    used = inputs.usable.copy()
    used[: span.start] = used[span.stop :] = False
    if used.sum() <= _UNKNOWNS:
        return None
    away = inputs.offset[used]
    away = away / math.sqrt(float(away @ away))

    def beside_offset(values: FloatArray) -> FloatArray:
        seen = values[used]
        return np.asarray(seen - away * float(away @ seen))

    left, lost = beside_offset(inputs.residual), beside_offset(inputs.loss)
    by_offset = float(away @ inputs.residual[used]) ** 2
    squares = np.array([np.sum((left - beside_offset(lagged(inputs, lag_s))) ** 2) for lag_s in _LAGS_S])
    share = max(float(lost @ left) / max(float(lost @ lost), LEAST_DIVISOR), 0.0)
    best = int(np.argmin(squares))
    if best == 0 or squares[best] >= np.sum((left - share * lost) ** 2) or left @ left - squares[best] < by_offset:
        return None
    noise_var = axis.noise_var * max(1.0, float(squares[best]) / (left.size * axis.noise_var))
    believed = _LAGS_S[squares <= squares[best] + Z_95**2 * noise_var]
    healthy_s = Z_95 * math.sqrt(axis.spreads[-1].lag_var_s2)
    value = float(_LAGS_S[best])
    low = value - math.hypot(value - float(believed[0]), healthy_s)
    high = value + math.hypot(float(believed[-1]) - value, healthy_s)
    return Estimate(value, low, high) if low > 0.0 else None


def lagged(inputs: Inputs, lag_s: float) -> FloatArray:
    """What a surface that follows its command through a first-order lag leaves in the residual, shape (n,)."""
    loss = inputs.loss
    if lag_s <= 0.0:
        return np.zeros_like(loss)
    from scipy import signal  # takes longer to load than a flight to judge

    keep = math.exp(-1.0 / (inputs.rate_hz * lag_s))
    followed = signal.lfilter([1.0 - keep], [1.0, -keep], loss, zi=[keep * loss[0]])[0]
    return np.asarray(loss - followed)


def _recovered(axis: AxisModel, inputs: Inputs, alarm: int) -> int | None:
    """First sample by which the axis has answered well for some seconds; windows begin anew there."""
    clear = round(_CLEAR_S * inputs.rate_hz)
    spread = min(axis.spreads, key=lambda s: abs(s.window_s - _CLEAR_S))
    only = axis.model_copy(update={"spreads": (spread,)})
    windows = Windows.of(only, inputs)
    well = windows.found[0].known & (windows.shares()[0] < _CLEAR_SHARE * axis.suspect)
    if axis.own_command:
        well &= _is_known_in(windows.found[0], spread)
    well[: alarm + clear] = False
    runs = np.convolve(well, np.ones(clear), mode="full")[: well.size]
    found = np.flatnonzero(runs >= clear)
    return int(found[0]) if found.size else None


def _onset(axis: AxisModel, inputs: Inputs, alarm: int, begin: int, past: Sizes) -> int:
    """Where a fault must have begun to explain most of the residual up to its alarm.

    Before it, if that was long enough to tell, the flight had a loss and an offset of its own, which flights differ by:
    what they explain as well is not the fault's.
    """
    inputs = inputs.less(*past.value[:, 0].tolist())
    precision = np.asarray(np.linalg.inv(past.covariance[..., 0] / axis.noise_var), dtype=np.float64)
    first = max(begin, alarm - round(_ONSET_S * inputs.rate_hz))
    begins = np.arange(first, alarm) + 1
    since, before = inputs.sums.between(begins, alarm + 1), inputs.sums.between(first + 1, begins)
    explained = fitted(since, SIZES.patterns, columns=SIZES.columns).explained
    of_flight = fitted(before, SIZES.patterns, precision, SIZES.columns).explained
    explained[since.samples <= _UNKNOWNS] = np.nan
    of_flight[before.samples <= _AT_ONCE_S * inputs.rate_hz] = 0.0
    return first + split(explained, of_flight) if begins.size else alarm


def _own_past(axis: AxisModel, inputs: Inputs, alarm: int, begin: int) -> Sizes:
    """What the flight was like before the longest window that ends with the alarm, if it was judged for long enough."""
    spread = axis.spreads[-1]
    before = alarm - spread.samples(inputs.rate_hz)
    is_long = int(inputs.usable[begin : max(before, begin)].sum()) >= _OWN_PAST_S * inputs.rate_hz
    found = part(inputs, 0, before + 1, axis.noise_var) if is_long else None
    if found is None or not found.known[0]:
        return Sizes.nothing(axis.of_flights(spread.covariance))
    return found._replace(covariance=found.covariance + spread.covariance[..., None])


def _estimate(axis: AxisModel, inputs: Inputs, start: int, last: int, past: Sizes) -> tuple[Estimate, Estimate]:
    """Loss and offset from an onset on, beyond what the flight was like before; healthy flights differ as well.

    The autopilot answers gusts, so that its command and what it cannot explain are correlated: a loss seems smaller
    than it is, the more so the less of the motion the command explains in healthy flights.
    """
    last = min(last, start + round(_ONSET_S * inputs.rate_hz))
    away = part(inputs, start, last, axis.noise_var).beyond(past, axis.spreads[-1].covariance)
    lost, offset = (_between(axis, away.value[k, 0], away.covariance[k, k, 0]) for k in range(2))
    explained = min(1.0, max(_LEAST_EXPLAINED, axis.explained)) if axis.own_command else 1.0
    hidden = max(lost.high, 0.0) * (1.0 / math.sqrt(explained) - 1.0)
    loss_offset, offset_offset = inputs.sums.between(start, last).table[1:3, 2, 0].tolist()
    away_us = hidden * abs(loss_offset) / offset_offset if offset_offset > 0.0 else 0.0
    return (
        lost._replace(high=float(lost.high + hidden)),
        offset._replace(low=float(offset.low - away_us), high=float(offset.high + away_us)),
    )


def _failed(event: AxisEvent) -> bool:
    offset = event.offset_us
    away_us = max(offset.low, -offset.high)
    return event.from_start and (event.lost_share.low > _FAILED_LOSS or away_us > _FAILED_US)


def _between(axis: AxisModel, value: float, variance: float) -> Estimate:
    return Estimate.of(value, axis.widening * math.sqrt(variance) if variance >= 0.0 else math.nan)


def _is_known_in(found: Sizes, spread: Spread) -> BoolArray:
    """Windows in which lambda is known to less than +-0.3."""
    variance = np.where(found.known, found.covariance[0, 0], np.inf) + spread.loss_var
    return Z_95 * np.sqrt(variance) < KNOWN_WITHIN


def _known(axis: AxisModel, inputs: Inputs, members: int) -> tuple[BoolArray, FloatArray]:
    """Where lambda is known to less than +-0.3, in windows in which a member that stood still would be found.

    And the smallest loss and offset that would be.
    """
    if not axis.own_command:
        return np.zeros(inputs.usable.size, dtype=bool), np.full((2, inputs.usable.size), np.inf)
    windows = Windows.of(axis, inputs)
    least = windows.smallest()
    known, shows = np.zeros((2, inputs.usable.size), dtype=bool)
    for found, spread, (loss, _) in zip(windows.found, axis.spreads, least, strict=True):
        known |= _is_known_in(found, spread)
        length = spread.samples(inputs.rate_hz)
        still = loss < 1.0 / members
        shows |= np.convolve(still, np.ones(length))[length - 1 :] > 0.5  # all of a window that tells
    return known & shows, least.min(axis=0)


def _whole(axis: AxisModel, inputs: Inputs, flown: BoolArray) -> tuple[Estimate, Estimate] | None:
    """Loss and offset of the whole flight, in which windows average out and the flight's own difference does not."""
    if not (inputs.usable & flown).any():
        return None
    found = part(inputs, 0, inputs.usable.size, axis.noise_var)
    if not found.known[0]:
        return None
    spread = axis.spreads[-1]
    windows = max(1.0, float(inputs.usable.sum()) / spread.samples(inputs.rate_hz))
    stray = axis.of_flights(spread.covariance) + spread.covariance / windows
    return (
        _between(axis, found.value[0, 0], found.covariance[0, 0, 0] + stray[0, 0]),
        _between(axis, found.value[1, 0], found.covariance[1, 1, 0] + stray[1, 1]),
    )


def lost_between(audit: AxisAudit, start_s: float, end_s: float) -> Estimate | None:
    """Lost share of an axis in a part of the flight, beyond what it was before; None if it is not known."""
    axis, inputs = audit.model, audit.inputs
    start, end = np.searchsorted(audit.time_s, (start_s, end_s))
    if not axis.own_command or end <= start:
        return None
    part = replace(inputs, usable=inputs.usable & (np.arange(inputs.usable.size) < end))
    past = _own_past(axis, part, int(start), 0)
    lost, _ = _estimate(axis, part, int(start), int(end), past)
    return None if math.isnan(lost.value) else lost


def _with_causes(
    drafts: dict[str, _Draft], noise_vars: dict[str, float], time_s: FloatArray
) -> dict[str, tuple[AxisEvent, ...]]:
    """Of events that overlap one axis is the cause: whose loss and offset explain most, soon after the first alarm.

    They explain it in units of the noise. Healthy flights may differ less in pitch than in roll, and the bank that an
    aileron hard over makes moves pitch as well: beyond what they differ by, pitch would be the stronger.
    """

    def strength(axis: str, event: AxisEvent, first_s: float) -> float:
        inputs, noise_var = drafts[axis].inputs, noise_vars[axis]
        span = np.searchsorted(time_s, (event.start_s, first_s + _NAMING_S), side="right")
        window = inputs.sums.between(span[:1] - 1, np.minimum(span[1:], time_s.size))
        found = fitted(window, SIZES.patterns, columns=SIZES.columns)
        return float(np.nan_to_num(found.explained)[0]) / noise_var

    found = {}
    for axis, draft in drafts.items():
        judged = []
        for event in draft.events:
            strengths = {axis: 0.0}
            for other, rivals in drafts.items():
                for rival in rivals.events if other != axis else ():
                    # One was still going on when the other was reported.
                    meet = rival.alarm_s <= (event.end_s or math.inf) and event.alarm_s <= (rival.end_s or math.inf)
                    if meet and not rival.from_start and rival.known_s > event.start_s:
                        first_s = min(rival.alarm_s, event.alarm_s)
                        strengths[axis] = max(strengths[axis], strength(axis, event, first_s))
                        strengths[other] = max(strengths.get(other, 0.0), strength(other, rival, first_s))
            strongest = max(strengths, key=lambda name: strengths[name])
            judged.append(event if event.from_start or strongest == axis else replace(event, cause=strongest))
        found[axis] = tuple(judged)
    return found


def _accused(name: str, axis: AxisModel, worst: AxisEvent, differing: list[str]) -> AxisStatus:
    """How sure it is that an axis was another one than on its good flights."""
    certain = axis.fault is not None and worst.score > max(axis.fault, axis.suspect) and name in SURFACE_AXES
    # Levels are those of the calibrated aircraft: this may be another.
    return "fault" if certain and not any(other in SURFACE_AXES for other in differing) else "suspect"


def _cleared(draft: _Draft) -> AxisStatus:
    """Healthy, if the flight as a whole says what the axis has lost, and that it may be nothing."""
    if draft.whole is None:
        return "unknown"
    lost, _ = draft.whole
    is_known = lost.high - lost.low <= 2.0 * KNOWN_WITHIN
    return "healthy" if is_known and not excludes_none(lost) else "unknown"


def _verdict(
    name: str,
    model: MotionModel,
    draft: _Draft,
    events: tuple[AxisEvent, ...],
    motion: Motion,
    inside: dict[str, BoolArray],
    flown: BoolArray,
    differing: list[str],
) -> AxisAudit:
    """Verdict on an axis of a flight, some axes of which were different from its beginning on (`differing`)."""
    axis = model.axes[name]
    own = [event for event in events if event.is_own or (differing == [name] and _failed(event))]
    if axis.own_command:  # the sizes of one that copies another mean nothing
        own = [event for event in own if event.model_holds and not event.is_nothing]
    worst = max(own, key=lambda event: event.score, default=None)
    seconds = max(int(flown.sum()), 1)
    identifiable = float((draft.known & flown).sum()) / seconds
    judged = float((draft.inputs.usable & flown).sum()) / seconds
    if worst is not None:
        status = _accused(name, axis, worst, differing)
    else:
        is_seen = not events and min(identifiable, judged) >= MOST_OF_THE_FLIGHT
        status = _cleared(draft) if is_seen else "unknown"
    lost, offset = (worst.lost_share, worst.offset_us) if worst is not None else draft.whole or (None, None)
    if not axis.own_command:  # which tells nothing of the effect of a microsecond
        lost, offset = None, None
    first_s = min((event.alarm_s for event in events), default=math.inf)  # what came later stood against an alarm
    shows = [_in_most(least[flown & (motion.time_s < first_s)]) for least in draft.shows]
    detectable = AxisDetectable(shows[0] if shows[0] <= 1.0 else math.inf, shows[1])
    outside = {reason: float((~good & flown).sum()) / seconds for reason, good in inside.items() if flown.any()}
    audit = AxisAudit(
        axis=name,
        status=status,
        reason="",
        members=_members(name, axis, motion),
        lost_share=lost,
        offset_us=offset,
        events=events,
        identifiable=identifiable,
        detectable=detectable,
        judged_share=judged,
        false_alarms_per_hour=axis.false_alarms_per_hour,
        time_s=motion.time_s,
        score=draft.score / axis.suspect,
        inputs=draft.inputs,
        model=axis,
    )
    reason = reason_of(audit, model, worst, outside)
    return replace(audit, reason=f"{reason}{left_out(motion.lifted_share)}")
