"""A trend as one HTML page and its figures: what wears, since when, and when it will be too much."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from servofd.estimate.statistics import Z_95
from servofd.outputs.fleet_page import flight_name
from servofd.outputs.page import page
from servofd.outputs.palette import COLOURS
from servofd.outputs.picture import Picture, finish, new_figure
from servofd.outputs.sentence import minute_of, spoken
from servofd.wear.estimate import QUANTITIES
from servofd.wear.series import TOO_FEW

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes

_EVENT_STYLES = {"swap": "-", "adjusted": "--", "changed": ":"}
_WORST_FIRST = ("fault", "suspect", "healthy")
_WORST = {"reached": "fault", "crossing": "suspect", "none": "healthy"}


def trend_page(document: dict[str, Any]) -> str:
    """Text of the page."""
    flights = document["flights"]
    aircraft = document["aircraft"] or "aircraft"
    surfaces = [_surface(name, surface, flights) for name, surface in document["surfaces"].items()]
    axes = axes_of(document)
    surfaces.sort(key=lambda surface: _WORST_FIRST.index(surface["status"]))
    return page(
        "trend.html",
        aircraft=aircraft,
        status=surfaces[0]["status"] if surfaces else "unknown",
        sentence=verdict(document),
        facts=f"{aircraft}: {number_of_flights(document)}, {document['order']['reason']}",
        surfaces=surfaces,
        axes=axes,
        headings=("number", "log", "begun (UTC)", *(f"effect left of {axis} [%]" for axis in axes)),
        flights=[
            (
                str(one["number"]),
                flight_name(one),
                minute_of(one["start_utc"]),
                *effects_of(document, one),
            )
            for one in flights
        ],
        alarms=alarms_of(document),
        problems=document["problems"],
    )


def verdict(document: dict[str, Any]) -> str:
    """The whole trend in a sentence or two."""
    limits = [
        f"{spoken(name)}: {one['title']} {_when(one)}"
        for name, surface in document["surfaces"].items()
        for one in surface["quantities"].values()
        if one["forecast"]["kind"] != "none"
    ]
    alarms = alarms_of(document)
    said = f"{'; '.join(limits)}. " if limits else ""
    if alarms:
        more = f" (and {len(alarms) - 1} more)" if len(alarms) > 1 else ""
        return f"{said}{alarms[-1]}{more}."
    if limits:
        return said.rstrip()
    reasons = {
        one["forecast"]["reason"] for surface in document["surfaces"].values() for one in surface["quantities"].values()
    }
    if reasons == {TOO_FEW}:
        return f"No limit is exceeded. {number_of_flights(document).capitalize()}: too few for a trend."
    return "No limit is exceeded or in sight."


def axes_of(document: dict[str, Any]) -> list[str]:
    """Axes whose effect is followed by the motion of the aircraft."""
    return [name for name, surface in document["surfaces"].items() if "effect" in surface["quantities"]]


def effects_of(document: dict[str, Any], flight: dict[str, Any]) -> list[str]:
    """What was left of the effect of each axis in a flight, with its interval, in per cent.

    Examples
    --------
    >>> effect = {"flights": [1], "values": [0.5], "deviations": [0.05], "shown": {"scale": 100.0, "digits": 0}}
    >>> effects_of({"surfaces": {"roll": {"quantities": {"effect": effect}}}}, {"number": 1, "alarms": {"roll": ""}})
    ['50 [40, 60] alarm']
    """
    found = []
    for axis in axes_of(document):
        one = document["surfaces"][axis]["quantities"]["effect"]
        text = "not known"
        if flight["number"] in one["flights"]:
            at = one["flights"].index(flight["number"])
            value, half = one["values"][at], Z_95 * one["deviations"][at]
            shown = {"value": value, "low": value - half, "high": value + half}
            text = _interval(shown, one["shown"]["scale"], one["shown"]["digits"])
        found.append(f"{text} alarm" if axis in flight.get("alarms", {}) else text)
    return found


def alarms_of(document: dict[str, Any]) -> list[str]:
    """What did not answer as calibrated, in which flight."""
    return [
        f"Flight {one['number']} ({flight_name(one)}), {axis}: {reason}"
        for one in document.get("flights", ())
        for axis, reason in one.get("alarms", {}).items()
    ]


def number_of_flights(document: dict[str, Any]) -> str:
    """How many flights were followed."""
    count = len(document["flights"])
    return f"{count} {'flight' if count == 1 else 'flights'}"


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
    width = scale * (estimate["high"] - estimate["low"])
    if math.isfinite(width) and width > 0.0:
        digits = min(digits, max(1 - math.floor(math.log10(width)), 0))
    value, low, high = (f"{scale * estimate[key]:z.{digits}f}" for key in ("value", "low", "high"))
    return f"{value} [{low}, {high}]"


def _surface(name: str, surface: dict[str, Any], flights: Sequence[dict[str, Any]]) -> dict[str, Any]:
    alarms = [one["number"] for one in flights if name in one.get("alarms", {})]
    quantities = surface["quantities"]
    kinds = {one["forecast"]["kind"] for one in quantities.values()}
    serials = [f"{one['serial'] or 'number unknown'} since flight {one['from_flight']}" for one in surface["serials"]]
    status = next(status for kind, status in _WORST.items() if kind in kinds or kind == "none")
    is_axis = any(QUANTITIES[one].of_axis for one in (*quantities, *surface["missing"]))
    return {
        "name": spoken(name),
        "serials": "" if is_axis else ", ".join(serials),
        "status": "suspect" if alarms and status == "healthy" else status,
        "alarms": alarms,
        "rows": [quantity_row(one) for one in quantities.values()],
        "events": [event["reason"] for event in surface["events"]],
        "notes": surface["notes"],
        "missing": [(QUANTITIES[what].title, why) for what, why in surface["missing"].items()],
        "pictures": [trend_picture(name, surface)] if len(flights) > 1 and quantities else [],
    }


def trend_picture(name: str, surface: dict[str, Any]) -> Picture:
    """All quantities over the flights, one below the other."""
    from matplotlib.ticker import MaxNLocator

    quantities = surface["quantities"]
    figure, all_axes = new_figure(len(quantities), height=0.6 + 1.55 * len(quantities))
    for one, axes in zip(quantities.values(), all_axes, strict=True):
        _draw(one, axes)
        for event in surface["events"]:
            axes.axvline(event["flight"] - 0.5, color="0.3", linestyle=_EVENT_STYLES[event["kind"]], linewidth=1.0)
        axes.set_ylabel(f"{one['title'].replace(', ', chr(10))}\n[{one['shown']['unit']}]", fontsize=8)
    all_axes[-1].set_xlabel("flight")
    all_axes[-1].xaxis.set_major_locator(MaxNLocator(integer=True))
    finish(*all_axes)
    return Picture(
        f"trend-{name}",
        f"{spoken(name)} over its flights",
        "Dots are flights with their 95% intervals, blue lines what they follow since the last change, the dashed "
        "part what is expected; level lines are limits, vertical lines changes at once (solid: another servo).",
        figure,
    )


def _draw(one: dict[str, Any], axes: Axes) -> None:
    scale, forecast = one["shown"]["scale"], one["forecast"]
    values, spread = scale * np.array(one["values"]), scale * Z_95 * np.array(one["deviations"])
    axes.errorbar(one["flights"], values, spread, fmt="o", markersize=3, color=COLOURS["measured"], elinewidth=1.0)
    lines = [piece for piece in one["pieces"] if "begin" in piece]
    for piece in lines:
        ends = scale * np.array([piece["begin"]["value"], piece["end"]["value"]])
        axes.plot([piece["first"], piece["last"]], ends, color=COLOURS["simulated"], linewidth=1.5)
    if one["limit"] is None:
        return
    limit = scale * one["limit"] * (np.sign(one["now"]["value"]) if one["worse"] == "away" else 1.0)
    axes.axhline(limit, color=COLOURS["threshold"], linewidth=1.5)
    if forecast["kind"] == "crossing":
        begin, now = lines[-1]["last"], scale * one["now"]["value"]
        axes.plot([begin, forecast["flight"]], [now, limit], "--", color=COLOURS["simulated"], linewidth=1.5)
        axes.plot([forecast["low"], forecast["high"]], [limit, limit], color=COLOURS["fault"], linewidth=4.0, zorder=3)
