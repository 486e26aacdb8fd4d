"""The answer that one flight gives by itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from logparsers.records import FlightLog
from servofd.axes.motion import Motion
from servofd.flight import checks
from servofd.flight.change import WINDOWS_S, AxisChange, judge_motion_alone
from servofd.flight.checks import Check
from servofd.flight.columns import Flight, flight_of


@dataclass(frozen=True, slots=True, eq=False)
class FlightAlone:
    """Checks and axes of one flight, and the sentence that answers; of several in one log, those of all."""

    checks: tuple[Check, ...]
    axes: Mapping[str, AxisChange]
    sentence: str
    motion: Motion | None


def judge_flight(log: FlightLog) -> FlightAlone | None:
    """Judge a flight without feedback, aircraft file or other flights; None if its log holds nothing to judge.

    Of several flights in a log each is judged by itself. Never a fault: one flight alone is no more than a reason to
    look.
    """
    whole = flight_of(log)
    if whole.motion is None and not whole.outputs:
        return None
    flights = whole.each()
    judged = [_judged(flight) for flight in flights]
    names = [f"flight {k} of {len(flights)}" for k in range(1, len(flights) + 1)]
    found = tuple(_together(names, each) for each in zip(*(one for one, _ in judged), strict=True))
    axes = {axis: _together(names, [one[axis] for _, one in judged]) for axis in judged[0][1]}
    said = [_sentence(*one) for one in judged]
    if len(flights) > 1:
        spans = [f"in the air from {flight.span_s[0]:.0f} to {flight.span_s[1]:.0f} s" for flight in flights]
        looks = [any(check.status == "look" for check in one) for one, _ in judged]
        each = [f"{name} ({span}): {text}" for name, span, text in zip(names, spans, said, strict=True)]
        said = [each[k] for k in np.argsort(~np.array(looks), kind="stable")]  # what to look at comes first
    hidden = _WOULD_NOT_SHOW if any(axis.status != "unknown" for _, one in judged for axis in one.values()) else ""
    return FlightAlone(found, axes, "; ".join(filter(None, [*said, hidden, flights[0].left_out])), whole.motion)


_SEVERITIES = ("ok", "unknown", "look")
_Answer = TypeVar("_Answer", Check, AxisChange)


def _together(names: Sequence[str], answers: Sequence[_Answer]) -> _Answer:
    """One answer for several flights: the gravest, with the words and scores of all."""
    worst = max(answers, key=lambda one: _SEVERITIES.index(one.status))
    if len({one.text for one in answers}) > 1:
        said = "; ".join(f"{name}: {one.text}" for name, one in zip(names, answers, strict=True))
        worst = replace(worst, text=said)
    scored = [one for one in answers if isinstance(one, AxisChange) and one.score]
    if isinstance(worst, AxisChange) and scored:
        scores = np.fmax.reduce([one.score for one in scored]).tolist()
        worst = replace(worst, time_s=scored[0].time_s, score=tuple(scores))
    return worst


def _judged(flight: Flight) -> tuple[tuple[Check, ...], dict[str, AxisChange]]:
    """Checks and axes of one flight."""
    axes = {} if flight.motion is None else judge_motion_alone(flight.motion)
    change = checks.axis_change(axes) if axes else Check("unknown", flight.lacking)
    asked = (
        *(checks.surface_check, checks.saturation, checks.trim, checks.travel),
        *(checks.limit_cycle, checks.asymmetry, checks.supply),
    )
    found = [replace(check(flight), name=check.__name__) for check in asked]
    return (*found, replace(change, name="axis_change")), axes


_SPOKEN = {"side": "the rudder"}
_WOULD_NOT_SHOW = (
    "a servo that failed earlier, sticks near its trim, stands a few degrees off or is slow would not show"
)
_MOST = 0.9
"""Share of its time from which on a flight counts as judged throughout."""


def _sentence(found: Sequence[Check], axes: Mapping[str, AxisChange]) -> str:
    """What looks wrong, or that nothing does; what was judged, and until when."""
    looks = [check for check in found if check.status == "look"]
    looks.sort(key=lambda check: check.name != "axis_change")  # what stopped answering comes first
    said = [check.text for check in looks]
    judged = [axis for axis in axes.values() if axis.status != "unknown"]
    fine = [axis.axis for axis in judged if axis.status == "ok"]
    unjudged = [_SPOKEN.get(axis.axis, axis.axis) for axis in axes.values() if axis.status == "unknown"]
    if not said and not fine:
        return next(check.text for check in found if check.name == "axis_change")
    begins_s = [axis.judged_from_s for axis in judged if axis.judged_from_s is not None]
    ends_s = [axis.judged_until_s for axis in judged if axis.judged_until_s is not None]
    parts = ["; ".join(said)] if said else []
    if fine:
        which = " and ".join(fine)
        parts.append(f"{which} answered as before" if said else f"nothing looks wrong in {which}")
    if unjudged:
        parts.append(f"{' and '.join(unjudged)} cannot be judged")
    if begins_s and ends_s:
        begin_s, end_s = max(begins_s), min(ends_s)
        seen_s = WINDOWS_S[0] + min(np.count_nonzero(np.isfinite(axis.score)) for axis in judged)
        share = seen_s / (end_s - begin_s)
        cut = f", {share:.0%} of that time (the rest with less speed or throttle than before, or with gaps)"
        parts.append(
            f"judged from {begin_s:.0f} to {end_s:.0f} s by what was flown before{cut if share < _MOST else ''}"
        )
    return "; ".join(parts)
