"""The answer that one flight gives by itself."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from logparsers.records import FlightLog
from servofd.axes.motion import Motion
from servofd.flight import checks
from servofd.flight.change import AxisChange, judge_motion_alone
from servofd.flight.checks import Check
from servofd.flight.columns import flight_of


@dataclass(frozen=True, slots=True, eq=False)
class FlightAlone:
    """Checks and axes of one flight, and the sentence that answers."""

    checks: tuple[Check, ...]
    axes: Mapping[str, AxisChange]
    sentence: str
    motion: Motion | None


def judge_flight(log: FlightLog) -> FlightAlone | None:
    """Judge a flight without feedback, aircraft file or other flights; None if its log holds nothing to judge.

    Never a fault: one flight alone is no more than a reason to look.
    """
    flight = flight_of(log)
    if flight.motion is None and not flight.outputs:
        return None
    axes = {} if flight.motion is None else judge_motion_alone(flight.motion)
    change = checks.axis_change(axes)
    if not axes:
        change = checks.Check("axis_change", "unknown", flight.lacking)
    found = (
        checks.surface_check(flight),
        checks.saturation(flight),
        checks.trim(flight),
        checks.travel(flight),
        checks.limit_cycle(flight),
        checks.asymmetry(flight),
        checks.supply(flight),
        change,
    )
    sentence = "; ".join(filter(None, [_sentence(found, axes), flight.left_out]))
    return FlightAlone(found, axes, sentence, flight.motion)


_SPOKEN = {"side": "the rudder"}


def _sentence(found: tuple[Check, ...], axes: Mapping[str, AxisChange]) -> str:
    """What looks wrong, or that nothing does; what was judged, and until when; and what would not have shown."""
    said = [check.text for check in found if check.status == "look"]
    said.sort(key=lambda text: text not in {axis.text for axis in axes.values()})  # what stopped answering comes first
    judged = [axis for axis in axes.values() if axis.status != "unknown"]
    fine = [axis.axis for axis in judged if axis.status == "ok"]
    unjudged = [_SPOKEN.get(axis.axis, axis.axis) for axis in axes.values() if axis.status == "unknown"]
    if not said and not fine:
        return next(check.text for check in found if check.name == "axis_change")
    begins_s = [axis.judged_from_s for axis in judged if axis.judged_from_s is not None]
    ends_s = [axis.judged_until_s for axis in judged if axis.judged_until_s is not None]
    parts = []
    if said:
        parts.append("; ".join(said))
    if fine:
        which = " and ".join(fine)
        parts.append(f"{which} answered as before" if said else f"nothing looks wrong in {which}")
    if unjudged:
        parts.append(f"{' and '.join(unjudged)} cannot be judged")
    if begins_s and ends_s:
        parts.append(
            f"judged from {max(begins_s):.0f} to {min(ends_s):.0f} s by what was flown before; a servo that failed "
            "earlier, sticks near its trim, stands a few degrees off or is slow would not show"
        )
    return "; ".join(parts)
