"""A trend in tables and figures: what wears, since when, and when it will be too much."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np

from servofd.core.statistics import Z_95, Estimate
from servofd.outputs.chart import Chart, Curve, Mark, Panel
from servofd.outputs.document import Bullets, Cell, Document, Figures, Part, Section, Table, Words
from servofd.outputs.fleet_report import flight_name
from servofd.outputs.sentence import known_digits, minute_of, spoken
from servofd.wear.estimate import QUANTITIES
from servofd.wear.series import TOO_FEW

_STATUSES = {"reached": "fault", "crossing": "suspect", "none": "healthy"}
"""By the forecast, the worst first."""
_BADGES = {"fault": "beyond its limit", "suspect": "wears"}
_HEAD = ("quantity", "now", "change per flight", "limit", "forecast")
_MOTION = """Of each flight the motion tells how much effect its commands had, beside that of the calibration flights,
and how far from its usual place each axis stood. Of a flight with an alarm it is the effect after its onset."""
_FITTED = """Each flight is fitted once, by the servo of the aircraft file: what good servos differ by is what is known
before the flight, and no interval is wider than that."""
_LINES = """A line is drawn through the flights since the last change, by least squares that single flights cannot
mislead; another line is begun only where chance would do so less than once in a million. A change at once is no wear.
A forecast is made from eight flights on, if the trend is no chance, and for no more than four times as many flights as
were seen."""


def trend_report(document: dict[str, Any], pages: Mapping[str, str] = MappingProxyType({})) -> Document:
    """What wears, since when, and when it will be too much; the worst surface first; flights are linked to `pages`."""
    flights, aircraft = document["flights"], document["aircraft"] or "aircraft"
    surfaces = [_surface(name, surface, flights) for name, surface in document["surfaces"].items()]
    surfaces.sort(key=lambda surface: [*_STATUSES.values()].index(surface.status))
    axes = [name for name, surface in document["surfaces"].items() if "effect" in surface["quantities"]]
    alarms = [
        f"Flight {one['number']} ({flight_name(one)}), {spoken(name)}: {reason}"
        for one in flights
        for name, reason in one["alarms"].items()
    ]
    method = [*[Words(_MOTION)] * bool(axes), *[Words(_FITTED)] * (len(surfaces) > len(axes)), Words(_LINES)]
    rows: list[tuple[str | Cell, ...]] = []
    for one in flights:
        name = Cell(flight_name(one), link=pages.get(flight_name(one), ""))
        left = (_effect(document["surfaces"][axis]["quantities"]["effect"], one, axis) for axis in axes)
        rows.append((str(one["number"]), name, minute_of(one["start_utc"]), *left))
    heading = ("number", "log", "begun (UTC)", *(f"effect left of {axis} [%]" for axis in axes))
    warnings = [Words(f"{alarm}.", status="suspect") for alarm in alarms]
    flown = Section("Flights", [*warnings, Table("In the order in which they were taken", heading, rows)])
    count = f"{len(flights)} {'flight' if len(flights) == 1 else 'flights'}"
    return Document(
        title=f"Trend of {aircraft}",
        status=surfaces[0].status if surfaces else "unknown",
        sentence=_verdict(document, alarms, count),
        facts=f"{aircraft}: {count}, {document['order']['reason']}",
        parts=[*surfaces, *[flown] * bool(axes)],
        evidence=[
            *[flown] * (not axes),
            *[Section("Not used", [Bullets(document["problems"])])] * bool(document["problems"]),
            Section("How this was found", method, folded=True),
        ],
        data=document,
    )


def _verdict(document: dict[str, Any], alarms: list[str], count: str) -> str:
    """The whole trend in a sentence or two."""
    found = [(name, one) for name, all_of in document["surfaces"].items() for one in all_of["quantities"].values()]
    limits: dict[str, dict[str, list[str]]] = {}
    for name, one in found:
        if one["forecast"]["kind"] != "none":
            limits.setdefault(_when(one), {}).setdefault(spoken(name), []).append(one["title"])
    lines = [_beyond(when, all_of) for when, all_of in limits.items()]
    said = [f"{'; '.join(lines)}."] if lines else []
    if alarms:
        more = f" (and {len(alarms) - 1} more)" if len(alarms) > 1 else ""
        said.append(f"{alarms[-1]}{more}.")
    if said:
        return " ".join(said)
    if {one["forecast"]["reason"] for _, one in found} == {TOO_FEW}:
        return f"No limit is exceeded. {count.capitalize()}: too few for a trend."
    return "No limit is exceeded or in sight."


def _beyond(when: str, quantities: dict[str, list[str]]) -> str:
    """What is, or will be, beyond its limit, by surface, once for all of which the same is true."""
    (name, titles), *others = quantities.items()
    if not others and len(titles) == 1:
        return f"{name}: {titles[0]} {when}"
    members = [f"{name} ({', '.join(titles)})" for name, titles in quantities.items()]
    return f"{', '.join(members)}: each {when}"


def _effect(effect: dict[str, Any], flight: dict[str, Any], axis: str) -> str:
    """What was left of the effect of an axis in a flight, with its interval, in per cent."""
    text = "not known"
    if flight["number"] in effect["flights"]:
        at = effect["flights"].index(flight["number"])
        shown = Estimate.of(effect["values"][at], effect["deviations"][at])._asdict()
        text = _interval(shown, effect["shown"]["scale"], effect["shown"]["digits"])
    return f"{text} alarm" if axis in flight["alarms"] else text


def quantity_row(one: dict[str, Any]) -> tuple[str, str, str, str, str]:
    """Title with unit, value now, change per flight, limit, and what is to be expected."""
    scale, digits = one["shown"]["scale"], one["shown"]["digits"]
    slope = one["per_flight"]
    return (
        f"{one['title']} [{one['shown']['unit']}]",
        _interval(one["now"], scale, digits),
        "" if slope is None else _interval(slope, scale, digits + 2),
        "" if one["limit"] is None else f"{scale * one['limit']:.{digits}f}",
        _when(one),
    )


def _when(one: dict[str, Any]) -> str:
    forecast = one["forecast"]
    if forecast["kind"] == "crossing":
        return f"crosses its limit at flight {forecast['flight']:.0f} [{forecast['low']:.0f}, {forecast['high']:.0f}]"
    return str(forecast["reason"])


def _interval(estimate: dict[str, float], scale: float, digits: int) -> str:
    """As many decimals as are known: two of the width of the interval, at most."""
    value, low, high = (scale * estimate[end] for end in ("value", "low", "high"))
    return "{} [{}, {}]".format(*known_digits(value, low, high, digits))


def _surface(name: str, surface: dict[str, Any], flights: Sequence[dict[str, Any]]) -> Section:
    alarms = [str(one["number"]) for one in flights if name in one["alarms"]]
    quantities = surface["quantities"]
    kinds = {one["forecast"]["kind"] for one in quantities.values()}
    status = next(status for kind, status in _STATUSES.items() if kind in kinds or kind == "none")
    badge = _BADGES.get(status, "")
    if alarms and status == "healthy":
        status, badge = "suspect", f"alarm in flight {', '.join(alarms)}"
    parts: list[Part] = []
    if not any(QUANTITIES[one].of == "motion" for one in (*quantities, *surface["missing"])):
        serials = ((one["serial"] or "number unknown", one["from_flight"]) for one in surface["serials"])
        since = ", ".join(f"{serial} since flight {flight}" for serial, flight in serials)
        parts.append(Words(f"Servo: {since}.", style="soft"))
    parts += [Words(f"{event['reason']}.", status="suspect") for event in surface["events"]]
    parts += [Words(f"{note}.") for note in surface["notes"]]
    parts.append(Table("Now, with 95% intervals", _HEAD, [quantity_row(one) for one in quantities.values()]))
    if len(flights) > 1 and quantities:
        parts.append(Figures(lambda: [trend_chart(name, surface)]))
    parts.append(Bullets([f"{QUANTITIES[what].title} not followed: {why}" for what, why in surface["missing"].items()]))
    return Section(spoken(name), parts, status, badge)


def trend_chart(name: str, surface: dict[str, Any]) -> Chart:
    """All quantities over the flights, one below the other."""
    quantities = surface["quantities"]
    ends = [flight for one in quantities.values() for flight in one["flights"]]
    coming = [one["forecast"]["high"] for one in quantities.values() if one["forecast"]["kind"] == "crossing"]
    last = min(max([*ends, *coming]), 2.0 * max(ends))
    marks = tuple(Mark("command", event["flight"] - 0.5, spoken(event["kind"])) for event in surface["events"])
    text = (
        "Dots are flights with their 95% intervals; lines what they follow since the last change, dashed what is "
        "expected; level lines are limits, vertical lines changes at once."
    )
    panels, title = tuple(_panel(one, last) for one in quantities.values()), f"{spoken(name)} over its flights"
    return Chart(title, text, min(ends) - 0.5, last + 0.5, panels, (), marks, axis="flight")


def _panel(one: dict[str, Any], last: float) -> Panel:
    scale, forecast = one["shown"]["scale"], one["forecast"]
    flights = np.array(one["flights"], dtype=float)
    values, spread = scale * np.array(one["values"]), scale * Z_95 * np.array(one["deviations"])
    curves = [Curve("", "measured", flights, values - spread, "bars", values + spread)]
    lines = [piece for piece in one["pieces"] if "begin" in piece]
    for k, piece in enumerate(lines):
        ends = scale * np.array([piece["begin"]["value"], piece["end"]["value"]])
        curves.append(Curve("" if k else "what they follow", "likely", np.array([piece["first"], piece["last"]]), ends))
    if one["limit"] is not None:
        limit = scale * one["limit"] * (np.sign(one["now"]["value"]) if one["worse"] == "away" else 1.0)
        curves.append(Curve("limit", "threshold", np.array([flights[0] - 0.5, last + 0.5]), np.full(2, limit)))
        if forecast["kind"] == "crossing":
            ahead = np.array([lines[-1]["last"], forecast["flight"]])
            curves.append(Curve("expected", "before", ahead, np.array([scale * one["now"]["value"], limit])))
    curves.append(Curve("each flight", "measured", flights, values, "dots"))
    return Panel.around(one["title"], one["shown"]["unit"], curves)
