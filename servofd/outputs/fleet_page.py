"""Many logs as one HTML page: how many are well, which are not, and what could not be judged."""

from __future__ import annotations

from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Any

from servofd.outputs.page import page
from servofd.outputs.palette import STATUS_COLOURS
from servofd.outputs.picture import Picture, finish, new_figure

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["fleet_page"]

_MOST_ROWS = 200
_STATUSES = ("healthy", "suspect", "fault")
_MARKERS = {"healthy": "o", "suspect": "s", "fault": "X", "unknown": "d", "no_data": "d"}


def fleet_page(document: dict[str, Any]) -> str:
    """Text of the page.

    It names files without their folders, and tells nothing else of the machine or its user.

    Parameters
    ----------
    document : dict
        Overview of a fleet, schema servofd.fleet/1.

    Examples
    --------
    >>> from servofd.fleet.overview import overview
    >>> "No log was judged." in fleet_page(overview([]).document())
    True
    """
    faults, untold = document["faults"], document["untold"]
    return page(
        "fleet.html",
        sentence=_sentence(document),
        facts=f"{document['logs']} logs, {document['hours']:.1f} h of flight",
        surfaces=[_surface(surface) for surface in document["surfaces"]],
        faults=[_fault(fault) for fault in faults[:_MOST_ROWS]],
        more_faults=max(0, len(faults) - _MOST_ROWS),
        untold=[(_name(one), one["reason"].replace(one["path"], _name(one))) for one in untold[:_MOST_ROWS]],
        more_untold=max(0, len(untold) - _MOST_ROWS),
        pictures=[_picture(document)] if any(one["share"] for one in document["residuals"]) else [],
    )


def _sentence(document: dict[str, Any]) -> str:
    statuses = document["statuses"]
    told = document["logs"] - statuses.get("untold", 0)
    if not told:
        return "No log was judged."
    parts = [f"{statuses.get('fault', 0) or 'None'} of {told} judged logs show{'s' * (told == 1)} a fault"]
    if statuses.get("suspect"):
        parts.append(f"{statuses['suspect']} are suspect")
    if statuses.get("untold"):
        parts.append(f"{statuses['untold']} more could not be judged")
    return ", ".join(parts) + "."


def _name(one: dict[str, Any]) -> str:
    return PurePosixPath(one["path"].replace("\\", "/")).name + (f" (run {one['run']})" if one.get("run") else "")


def _surface(surface: dict[str, Any]) -> tuple[str, ...]:
    logs, share = surface["logs"], surface["largest_share"]
    return (
        surface["surface"],
        ", ".join(surface["servos"]),
        *(str(logs.get(status, 0)) for status in _STATUSES),
        str(logs.get("unknown", 0) + logs.get("no_data", 0)),
        ", ".join(f"{kind.replace('_', ' ')} {number}" for kind, number in surface["kinds"].items()) or "none",
        "" if share is None else f"{share:.0%}",
    )


def _fault(fault: dict[str, Any]) -> tuple[str, ...]:
    end_s = fault["end_s"]
    return (
        _name(fault),
        (fault["start_utc"] or "")[:16].replace("T", " "),
        fault["surface"],
        fault["kind"].replace("_", " "),
        f"{fault['start_s']:.1f}",
        "lasts" if end_s is None else f"{end_s:.1f}",
        ", ".join(f"{name} {value:.3g}" for name, value in fault["parameters"].items()),
        f"{fault['probability']:.0%}",
    )


def _picture(document: dict[str, Any]) -> Picture:
    """Largest residual over threshold of every log, one row of dots per surface."""
    shown = [one for one in document["residuals"] if one["share"]]
    names = list(dict.fromkeys(one["surface"] for one in shown))
    logs = {key: k for k, key in enumerate(dict.fromkeys((one["path"], one["run"]) for one in shown), start=1)}
    figure, all_axes = new_figure(len(names), height=0.6 + 1.4 * len(names))
    for name, axes in zip(names, all_axes, strict=True):
        for status, colour in STATUS_COLOURS.items():
            mine = [one for one in shown if one["surface"] == name and one["status"] == status]
            axes.plot(
                [logs[one["path"], one["run"]] for one in mine],
                [one["share"] for one in mine],
                _MARKERS[status],
                color=colour,
                markersize=4,
                label=status.replace("_", " ") if mine else None,
                rasterized=len(shown) > 10 * _MOST_ROWS,
            )
        axes.axhline(1.0, color="0.5", linewidth=1.0)
        axes.set_yscale("log")
        axes.set_ylabel(f"{name}\n|r| / threshold")
    all_axes[-1].set_xlabel(_order(document["residuals"]))
    finish(*all_axes)
    return Picture(
        "residuals",
        "Largest residual of every log",
        "For each surface the largest residual over its threshold, which is the grey line at 1.",
        figure,
    )


def _order(residuals: Sequence[dict[str, Any]]) -> str:
    return "log, by time of flight" if all(one["start_utc"] for one in residuals) else "log, by name"
