"""One current of several servos: a bench, a hub or a battery that feeds more than one.

What each draws for its motion is fitted to good flights together, so that the reading less the motion of the others is
the current of one. A fault that is found in it may be of whoever explains the reading as well: servos that are asked
for the same, or the opposite, at once cannot be distinguished by what they draw together.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import replace
from typing import Final

import numpy as np

from servofd.aircraft.current import CalibratedCurrent
from servofd.core.types import FloatArray
from servofd.current.evidence import Change, Evidence
from servofd.current.judge import SURE_NATS, events_of, named, would_show
from servofd.current.model import CurrentSeries, Seen, fit_current, terms
from servofd.detection.kinds import KINDS
from servofd.detection.verdict import CommonCause, Fault, two_digits

_RIDGE: Final = 1e-3
"""Share of a column's square by which a joint fit prefers a small term: servos that move alike share what they draw."""
_WHOSE_S: Final = 60.0
"""For so long after an alarm it is compared whose motion it goes with: a minute holds manoeuvres of all."""
_EXPLAINS: Final = 0.5
"""Share of what explains an event best that the motion of a servo has to explain, whose position is at fault then."""
_ALIKE: Final = 0.1
"""Share of what explains an event best within which another explains it as well: stalls are not drawn so finely."""
_AT_ONCE_S: Final = 15.0
"""A fault that a position tells is that of a wire if it is noticed within so much of it: the longest window is 20 s."""


def own_currents(
    together: Mapping[str, CurrentSeries], known: Mapping[str, CalibratedCurrent]
) -> dict[str, CurrentSeries]:
    """Return what is read of a wire less what the others draw for their motion, for each servo on it."""
    own = {name: terms(series, known[name])[0][:, 1:] @ known[name].theta[1:] for name, series in together.items()}
    return _less_others(together, own)


def parted(flights: Sequence[Mapping[str, CurrentSeries]]) -> list[dict[str, CurrentSeries]]:
    """Return good flights with a current of its own for each of the servos on one wire.

    Raises `CalibrationError` if there is too little motion or current.
    """
    drafts = {name: fit_current([flight[name] for flight in flights]) for name in flights[0]}
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
    seen: Mapping[str, Seen], followed: Set[str], failed: Mapping[str, Sequence[Fault]]
) -> tuple[dict[str, list[Fault]], tuple[CommonCause, ...], float]:
    """Return the faults of each servo on a wire, each event that may be of several, and until when it is read [s].

    `followed` are servos whose position says that they do as asked: no event is of one of them if it may be of another,
    and none of them is blocked or without power. `failed` are the faults that positions tell: an event at the time of
    one is of that servo, where its motion explains most of it.
    """
    found: dict[str, list[Fault]] = {name: [] for name in seen}
    causes: list[CommonCause] = []
    evidence = Evidence.of(seen)
    end_s = float(evidence.series.time_s[-1]) if evidence.series.time_s.size else 0.0
    for first in events_of(evidence):
        last_s = end_s if first.end_s is None else first.end_s
        span_s = first.start_s, max(min(last_s, first.alarm_s + _WHOSE_S), first.alarm_s)
        likeliest = named(evidence, *span_s)[0]
        if not likeliest:
            continue
        if len(likeliest[0][0].names) > 1:  # all of them
            if any(_draws(seen[name], span_s) for name in followed & seen.keys()):
                return found, tuple(causes), first.start_s
            those: Set[str] = seen.keys() - followed or seen.keys()
        else:
            those = _whose(likeliest, followed, _failed_between(failed, span_s[0], first.alarm_s + _AT_ONCE_S))
        names = [name for name in seen if name in those]
        is_of_one = len(likeliest[0][0].names) == 1
        for name in names:
            own, parameters = named(evidence, *span_s, (name,) if is_of_one else tuple(seen))
            sure = first.probability / (len(names) if is_of_one else 1)
            fault = replace(first, kind=own[0][0].kind, parameters=parameters, alternatives=(), probability=sure)
            found[name].append(fault)
        if len(names) > 1 and is_of_one:
            causes.append(_one_of(seen, found, names))
    return found, tuple(causes), np.inf


def _whose(explained: Sequence[tuple[Change, float]], followed: Set[str], failed: Set[str]) -> Set[str]:
    """Of whom an event may be: of those that explain it about as well as the likeliest of them."""
    nats: dict[str, float] = {}
    for change, each in explained:
        if len(change.names) == 1:
            nats.setdefault(change.names[0], each)
    best = max(nats.values())
    shown = {name for name in failed & nats.keys() if nats[name] >= _EXPLAINS * best}
    free = shown or nats.keys() - (followed if explained[0][0].kind != "binding" else set())
    likeliest = max((nats[name] for name in free), default=0.0)
    least = likeliest - max(SURE_NATS, _ALIKE * likeliest)
    alike = {name for name in free if nats[name] >= least}
    return alike - followed or alike


def _draws(seen: Seen, span_s: tuple[float, float]) -> bool:
    """Whether what a servo draws for its motion shows between two times."""
    time_s = seen.series.time_s
    seen = seen._replace(usable=seen.usable & (time_s >= span_s[0]) & (time_s <= span_s[1]))
    return would_show(Evidence.of({seen.series.surface: seen}))


def _failed_between(failed: Mapping[str, Sequence[Fault]], from_s: float, to_s: float) -> set[str]:
    """Servos with a fault that lasts at some time between two."""
    lasts = [(name, one) for name, own in failed.items() for one in own if one.start_s <= to_s]
    return {name for name, one in lasts if one.end_s is None or one.end_s >= from_s}


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
