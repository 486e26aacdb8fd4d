"""One current of several servos: a bench, a hub or a battery that feeds more than one.

What each draws for its motion is fitted to good flights together, so that the reading less the motion of the others is
the current of one. A fault that is found in it may be of whoever explains the reading as well: servos that are asked
for the same, or the opposite, at once cannot be distinguished by what they draw together.
"""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

import numpy as np

from servofd.current.judge import SURE_NATS, account_of, faults_of, more_of, would_show
from servofd.current.model import fit_current, terms
from servofd.detection.kinds import KINDS
from servofd.detection.verdict import CommonCause, Fault, two_digits

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence, Set

    from servofd.aircraft.current import CalibratedCurrent
    from servofd.core.types import FloatArray
    from servofd.current.judge import Account
    from servofd.current.model import CurrentSeries, Seen

_RIDGE: Final = 1e-3
"""Share of a column's square by which a joint fit prefers a small term: servos that move alike share what they draw."""
_WHOSE_S: Final = 60.0
"""For so long after an alarm it is compared whose motion it goes with: a minute holds manoeuvres of all."""
_EXPLAINS: Final = 0.5
"""Share of what explains an event best that the motion of a servo has to explain, whose position is at fault then."""
_ONE_EVENT_S: Final = 15.0
"""Faults of one wire that are noticed within so much of each other are one event: the longest window is 20 s."""


def own_currents(
    together: Mapping[str, CurrentSeries], known: Mapping[str, CalibratedCurrent]
) -> dict[str, CurrentSeries]:
    """Return what is read of a wire less what the others draw for their motion, for each servo on it."""
    return _less_others(together, {name: _motion_a(series, known[name]) for name, series in together.items()})


def parted(flights: Sequence[Mapping[str, CurrentSeries]]) -> list[dict[str, CurrentSeries]]:
    """Return good flights with a current of its own for each of the servos on one wire.

    Raises
    ------
    CalibrationError
        If there is too little motion or current.
    """
    drafts = {name: fit_current([flight[name] for flight in flights]).known for name in flights[0]}
    blocks = [
        np.column_stack([terms(series, drafts[name])[0][:, 1:] for name, series in flight.items()])
        for flight in flights
    ]
    drawn = np.concatenate([next(iter(flight.values())).current_a for flight in flights])
    table = np.column_stack([np.concatenate(blocks), np.ones(drawn.size)])
    squares = np.maximum(np.mean(table**2, axis=0), 1e-12)
    squares[-1] = 0.0  # what the electronics take is one number, and of no servo
    theta = np.linalg.solve(table.T @ table + _RIDGE * drawn.size * np.diag(squares) + 1e-9 * np.eye(len(squares)),
                            table.T @ drawn)  # fmt: skip
    shares = np.split(theta[:-1], len(drafts))
    found = []
    for flight, block in zip(flights, blocks, strict=True):
        columns = np.split(block, len(drafts), axis=1)
        motion_a = {name: each @ share for name, each, share in zip(flight, columns, shares, strict=True)}
        found.append(_less_others(flight, motion_a))
    return found


def _motion_a(series: CurrentSeries, known: CalibratedCurrent) -> FloatArray:
    """What a good servo draws for its motion [A], shape (m,)."""
    return terms(series, known)[0][:, 1:] @ known.theta[1:]


def _less_others(together: Mapping[str, CurrentSeries], motion_a: Mapping[str, FloatArray]) -> dict[str, CurrentSeries]:
    """The current of each, at readings for which the commands of all are known."""
    whole_a = np.sum(list(motion_a.values()), axis=0)
    rows = np.all([series.motion.is_known(series.time_s) for series in together.values()], axis=0)
    return {
        name: replace(
            series,
            time_s=series.time_s[rows],
            current_a=(series.current_a - (whole_a - motion_a[name]))[rows],
            notes=(*series.notes, f"its current is read together with that of {_spoken(set(together) - {name})}"),
        )
        for name, series in together.items()
    }


def _spoken(names: Sequence[str] | set[str]) -> str:
    return ", ".join(sorted(name.replace("_", " ") for name in names))


def faults_of_wire(
    seen: Mapping[str, Seen], followed: Set[str], failed: Mapping[str, Sequence[Fault]] = MappingProxyType({})
) -> tuple[dict[str, list[Fault]], tuple[CommonCause, ...], float]:
    """Return the faults of each servo on a wire, each event that may be of several, and until when it is read [s].

    `followed` are servos whose position says that they do as asked: no event is of one of them if it may be of another,
    and none of them is blocked or without power. `failed` are the faults that positions tell: an event at the time of
    one is of that servo, where its motion explains most of it.
    """
    found: dict[str, list[Fault]] = {name: [] for name in seen}
    causes: list[CommonCause] = []
    whole, end_s = _whole(seen), max(float(one.series.time_s[-1]) for one in seen.values())
    events = [one for each in seen.values() for one in faults_of(each)]
    events += [one for one in faults_of(whole) if one.kind == "unpowered"]
    events.sort(key=lambda one: one.alarm_s)
    while events:
        first = events[0]
        event = [one for one in events if one.alarm_s <= first.alarm_s + _ONE_EVENT_S]
        events = events[len(event) :]
        last_s = max(np.inf if one.end_s is None else one.end_s for one in event)
        span_s = min(one.start_s for one in event), min(last_s, first.alarm_s + _WHOSE_S, end_s)
        at_once = _failed_between(failed, span_s[0], first.alarm_s + _ONE_EVENT_S)
        accounts = _may_be(seen, whole, span_s, followed, at_once)
        if accounts is None:
            return found, tuple(causes), span_s[0]
        known = [one for name in accounts for one in found[name]]
        if not accounts or any(one.end_s is None or one.end_s >= first.alarm_s for one in known):
            continue  # it is of nobody, or what was reported of them lasts
        before = {name: found[name][-1] for name in accounts if found[name]}
        if len(before) == len(accounts) and all(one.kind == accounts[name].kind for name, one in before.items()):
            for name, one in before.items():  # it was hard to see for a while
                found[name][-1] = replace(one, end_s=first.end_s)
            if causes and causes[-1].surfaces == tuple(accounts):
                causes[-1] = replace(causes[-1], end_s=first.end_s)
            continue
        is_of_one = len(accounts) < len(seen) or any(one.kind != "unpowered" for one in accounts.values())
        for name, account in accounts.items():
            sure = first.probability / (len(accounts) if is_of_one else 1)
            own = replace(first, kind=account.kind, parameters=account.parameters, alternatives=(), probability=sure)
            found[name].append(own)
        if len(accounts) > 1 and is_of_one:
            causes.append(_one_of(seen, found, list(accounts)))
    return found, tuple(causes), np.inf


def _may_be(
    seen: Mapping[str, Seen], whole: Seen, span_s: tuple[float, float], followed: Set[str], failed: Set[str]
) -> dict[str, Account] | None:
    """What each servo does that an event between two times may be of: one, several alike, or all without power.

    None if positions say that servos move while nothing flows: then it is the sensor of the current that failed.
    """
    accounts = {name: one for name, each in seen.items() if (one := account_of(each, *span_s)) is not None}
    least = min(accounts.values(), key=lambda one: one.total)
    rest = account_of(whole, *span_s, "unpowered")
    if rest is not None and rest.total < least.total:
        moves = any(_draws(seen[name], span_s) for name in followed & seen.keys())
        return None if moves else dict.fromkeys(seen.keys() - followed or seen, rest)
    totals = {name: one.total for name, one in accounts.items()}
    if least.kind == "binding":  # whose motion it goes with: readings are as uncertain whoever it is
        totals = {name: more_of(each, whole.noise_a, *span_s) for name, each in seen.items()}
        bound = {name: account_of(each, *span_s, "binding") for name, each in seen.items()}
        accounts = {name: one for name, one in bound.items() if one is not None}

    def likeliest(names: Set[str]) -> dict[str, Account]:
        alike = min((totals[name] for name in names), default=0.0) + SURE_NATS
        return {name: one for name, one in accounts.items() if name in names and totals[name] <= alike}

    well, best = account_of(whole, *span_s, "healthy"), min(totals.values())
    enough = best if well is None else well.total + _EXPLAINS * (best - well.total)
    shown = {name for name in failed & accounts.keys() if totals[name] <= enough}
    found = likeliest(shown or accounts.keys())
    free = {name: one for name, one in found.items() if name not in followed}
    return free or (found if least.kind == "binding" and not failed else likeliest(accounts.keys() - followed))


def _draws(seen: Seen, span_s: tuple[float, float]) -> bool:
    """Whether what a servo draws for its motion shows between two times."""
    time_s = seen.series.time_s
    return would_show(seen._replace(usable=seen.usable & (time_s >= span_s[0]) & (time_s <= span_s[1])))


def _failed_between(failed: Mapping[str, Sequence[Fault]], from_s: float, to_s: float) -> set[str]:
    """Servos with a fault that lasts at some time between two."""
    lasts = [(name, one) for name, own in failed.items() for one in own if one.start_s <= to_s]
    return {name for name, one in lasts if one.end_s is None or one.end_s >= from_s}


def _whole(seen: Mapping[str, Seen]) -> Seen:
    """All servos on the wire as if they were one, as far as rest and motion are concerned."""
    first, *others = seen.values()
    others_a = np.sum([one.healthy_a - one.known.theta[0] for one in others], axis=0)
    moving_a2 = np.sum([one.noise_a**2 - one.known.noise.still_a**2 for one in others], axis=0)
    series = replace(first.series, current_a=first.series.current_a + others_a)
    return first._replace(
        series=series, healthy_a=first.healthy_a + others_a, noise_a=np.sqrt(first.noise_a**2 + moving_a2)
    )


def _one_of(seen: Mapping[str, Seen], found: Mapping[str, Sequence[Fault]], names: Sequence[str]) -> CommonCause:
    """What is said of the latest event, which may be of several servos."""
    one, fault = seen[names[0]], found[names[0]][-1]
    to_s = np.inf if fault.end_s is None else fault.end_s
    rows = one.usable & (one.series.time_s >= fault.start_s) & (one.series.time_s <= to_s)
    more_a = float(np.mean(one.error_a[rows])) if rows.any() else 0.0
    way = "more" if more_a > 0.0 else "less"
    kinds = dict.fromkeys(KINDS[found[name][-1].kind].perhaps for name in names)
    what = f"one of {_spoken(names)} draws {two_digits(abs(more_a))} A {way}: {' or '.join(kinds)}"
    return CommonCause("unknown", fault.start_s, fault.end_s, tuple(names), what)
