"""Many logs as one HTML page: how many are well, which are not, and what could not be judged."""

from __future__ import annotations

from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Any

from servofd.outputs.audit_report import quantity
from servofd.outputs.page import page
from servofd.outputs.sentence import clock, minute_of, spoken

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

_MOST_ROWS = 200
_MOST_FLIGHTS = 2000
_TALLEST, _AT_THRESHOLD = 24, 12
"""Of a thumbnail: units of its height, and how high the threshold stands; what is twice as large is cut."""
_STATUSES = ("healthy", "suspect", "fault")
_OF_PAGE = {"not_judged": "unknown"}


def fleet_page(document: dict[str, Any], pages: frozenset[str] = frozenset()) -> str:
    """Text of the page.

    It names files without their folders, and tells nothing else of the machine or its user.
    """
    faults, not_judged, flights = document["faults"], document["not_judged"], document["flights"]
    known = {flight["status"] for flight in flights}
    return page(
        "fleet.html",
        status=next((s for s in ("fault", "suspect", "healthy") if s in known), "unknown"),
        sentence=fleet_sentence(document),
        facts=f"{document['logs']} logs, {_flown(document['hours'])} of flight",
        flights=[_flight(rank, flight, pages) for rank, flight in enumerate(flights[:_MOST_FLIGHTS])],
        more_flights=max(0, len(flights) - _MOST_FLIGHTS),
        surfaces=[_surface(surface) for surface in document["surfaces"]],
        axes=[_axis(axis) for axis in document["axes"]],
        faults=[_fault(fault) for fault in faults[:_MOST_ROWS]],
        more_faults=max(0, len(faults) - _MOST_ROWS),
        not_judged=[
            (flight_name(one), one["reason"].replace(one["path"], flight_name(one))) for one in not_judged[:_MOST_ROWS]
        ],
        more_not_judged=max(0, len(not_judged) - _MOST_ROWS),
    )


def _flown(hours: float) -> str:
    return (
        f"{hours:.1f} h" if hours >= 1.0 else f"{60.0 * hours:.0f} min" if hours >= 0.1 else f"{60.0 * hours:.1f} min"
    )


def fleet_sentence(document: dict[str, Any]) -> str:
    """What many logs come to."""
    statuses = document["statuses"]
    told = document["logs"] - statuses.get("not_judged", 0)
    if not told:
        return "No log was judged."
    faulty, suspect = statuses.get("fault", 0), statuses.get("suspect", 0)
    parts = [f"{faulty or 'None'} of {told} judged logs show{'s' * (faulty <= 1)} a fault"]
    if suspect:
        parts.append(f"{suspect} {'is' if suspect == 1 else 'are'} suspect")
    if statuses.get("not_judged"):
        parts.append(f"{statuses['not_judged']} more could not be judged")
    return ", ".join(parts) + "."


def _flight(rank: int, flight: dict[str, Any], pages: frozenset[str]) -> dict[str, Any]:
    name = flight_name(flight)
    return {
        "rank": rank,
        "status": _OF_PAGE.get(flight["status"], flight["status"]),
        "name": name,
        "page": flight["page"] if flight["page"] in pages else "",
        "begun": minute_of(flight["start_utc"]),
        "duration_s": flight["duration_s"] or 0.0,
        "duration": clock(flight["duration_s"] or 0.0),
        "sentence": flight["sentence"].replace(flight["path"], name),
        "surface": spoken(flight["surface"]),
        "thumbnail": thumbnail(flight["outline"]),
    }


def thumbnail(outline: Sequence[float | None]) -> tuple[int, str, str]:
    """How many columns a small picture of a flight has, the outline of those below the threshold, and of the others.

    Examples
    --------
    >>> thumbnail([0.5, None, 1.5])
    (3, 'M0 24v-6', 'M2 24v-18')
    """
    below: list[str] = []
    above: list[str] = []
    for k, share in enumerate(outline):
        if share is not None:
            height = round(min(max(share * _AT_THRESHOLD, 1), _TALLEST))
            (above if share >= 1.0 else below).append(f"M{k} {_TALLEST}v-{height}")
    return len(outline), "".join(below), "".join(above)


def flight_name(one: dict[str, Any]) -> str:
    """Name of a log without its folders, and of its run."""
    return PurePosixPath(one["path"].replace("\\", "/")).name + (f" (run {one['run']})" if one.get("run") else "")


def logs_by_status(logs: Mapping[str, int]) -> list[str]:
    """How many logs were healthy, suspect, at fault and not judged."""
    return [*(str(logs.get(status, 0)) for status in _STATUSES), str(logs.get("unknown", 0) + logs.get("no_data", 0))]


def effect_left(axis: Mapping[str, Any]) -> str:
    """Smallest and largest effect of an axis in the flights in which it was healthy."""
    left = axis["effect_left"]
    return "" if left is None else f"{100.0 * left[0]:.0f} to {100.0 * left[1]:.0f}%"


def _axis(axis: dict[str, Any]) -> tuple[str, ...]:
    members = ", ".join(spoken(member) for member in axis["members"])
    return axis["axis"], members, *logs_by_status(axis["logs"]), effect_left(axis)


def _surface(surface: dict[str, Any]) -> tuple[str, ...]:
    share = surface["largest_share"]
    return (
        spoken(surface["surface"]),
        ", ".join(surface["servos"]),
        *logs_by_status(surface["logs"]),
        ", ".join(f"{kind.replace('_', ' ')} {number}" for kind, number in surface["kinds"].items()) or "none",
        "" if share is None else f"{share:.0%}",
    )


def _fault(fault: dict[str, Any]) -> tuple[str, ...]:
    end_s = fault["end_s"]
    return (
        flight_name(fault),
        minute_of(fault["start_utc"]),
        spoken(fault["surface"]),
        fault["kind"].replace("_", " "),
        f"{fault['start_s']:.1f}",
        "lasts" if end_s is None else f"{end_s:.1f}",
        ", ".join(f"{quantity(name)} {value:.3g}" for name, value in fault["parameters"].items()),
        f"{fault['probability']:.0%}",
    )
