"""A trend as one HTML page and its figures: what wears, since when, and when it will be too much."""

from __future__ import annotations

import math
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Any

import numpy as np

from servofd.estimate.statistics import Z_95
from servofd.outputs.page import page
from servofd.outputs.palette import COLOURS
from servofd.outputs.picture import Picture, finish, new_figure
from servofd.wear.forecast import TOO_FEW
from servofd.wear.records import QUANTITIES

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_EVENT_STYLES = {"swap": "-", "adjusted": "--", "changed": ":"}
_WORST_FIRST = ("fault", "suspect", "healthy")
_WORST = {"reached": "fault", "crossing": "suspect", "none": "healthy"}


def trend_page(document: dict[str, Any]) -> str:
    """Text of the page.

    Parameters
    ----------
    document : dict
        Schema servofd.trend/1.

    Examples
    --------
    >>> empty = {"aircraft": None, "order": {"reason": ""}, "flights": [], "surfaces": {}, "problems": []}
    >>> "No limit is exceeded or in sight" in trend_page(empty)
    True
    """
    flights = document["flights"]
    aircraft = document["aircraft"] or "aircraft"
    surfaces = [_surface(name, surface, len(flights)) for name, surface in document["surfaces"].items()]
    surfaces.sort(key=lambda surface: _WORST_FIRST.index(surface["status"]))
    return page(
        "trend.html",
        aircraft=aircraft,
        status=surfaces[0]["status"] if surfaces else "unknown",
        sentence=verdict(document),
        facts=f"{aircraft}: {number_of_flights(document)}, {document['order']['reason']}",
        surfaces=surfaces,
        flights=[(str(one["number"]), _name(one), (one["start_utc"] or "")[:16].replace("T", " ")) for one in flights],
        problems=document["problems"],
    )


def verdict(document: dict[str, Any]) -> str:
    """The whole trend in a sentence or two.

    Examples
    --------
    >>> verdict({"surfaces": {}})
    'No limit is exceeded or in sight.'
    """
    limits = [
        f"{name}: {one['title']} {_when(one)}"
        for name, surface in document["surfaces"].items()
        for one in surface["quantities"].values()
        if one["forecast"]["kind"] != "none"
    ]
    if limits:
        return "; ".join(limits) + "."
    reasons = {
        one["forecast"]["reason"] for surface in document["surfaces"].values() for one in surface["quantities"].values()
    }
    if reasons == {TOO_FEW}:
        return f"No limit is exceeded. {number_of_flights(document).capitalize()}: too few for a trend."
    return "No limit is exceeded or in sight."


def number_of_flights(document: dict[str, Any]) -> str:
    """How many flights were followed.

    Examples
    --------
    >>> number_of_flights({"flights": [{}]})
    '1 flight'
    """
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


def _name(flight: dict[str, Any]) -> str:
    return PurePosixPath(flight["path"].replace("\\", "/")).name + (f" (run {flight['run']})" if flight["run"] else "")


def _surface(name: str, surface: dict[str, Any], flights: int) -> dict[str, Any]:
    quantities = surface["quantities"]
    kinds = {one["forecast"]["kind"] for one in quantities.values()}
    serials = [f"{one['serial'] or 'number unknown'} since flight {one['from_flight']}" for one in surface["serials"]]
    return {
        "name": name,
        "serials": ", ".join(serials),
        "status": next(status for kind, status in _WORST.items() if kind in kinds or kind == "none"),
        "rows": [quantity_row(one) for one in quantities.values()],
        "events": [event["reason"] for event in surface["events"]],
        "notes": surface["notes"],
        "missing": [(QUANTITIES[what].title, why) for what, why in surface["missing"].items()],
        "pictures": [_picture(name, surface)] if flights > 1 else [],
    }


def _picture(name: str, surface: dict[str, Any]) -> Picture:
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
        f"{name} over its flights",
        "Dots are flights with their 95 % intervals, blue lines what they follow since the last change, the dashed "
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
