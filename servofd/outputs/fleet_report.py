"""Many logs: how many are well, which are not, and what could not be judged."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import PurePosixPath
from typing import Any

import numpy as np

from servofd.detection.kinds import KINDS
from servofd.outputs.audit_report import quantity
from servofd.outputs.chart import Chart, Curve, Panel
from servofd.outputs.document import Cell, Document, Figures, Part, Section, Table, Words
from servofd.outputs.sentence import clock, gravity_of, minute_of, spoken

_HIGHEST_SHARE = 3.0
"""Top of the chart of flights, in thresholds; what is higher is drawn there."""
_DOTS = (
    ("fault", "before", ("fault",)),
    ("suspect", "other2", ("suspect",)),
    ("others", "after", ("healthy", "unknown", "no_data", "not_judged")),
)
"""Name in the legend, role, and statuses of the dots of a kind."""
_FEWEST_DRAWN = 3
"""Flights from which on they are drawn."""
_MOST_ROWS = 200
"""Rows of a table on the page at most: logs that were not judged, and faults."""
_MOST_FLIGHTS = 2000
"""Flights on the page at most."""
FLIGHTS_HEAD = ("flight", "verdict", "begun (UTC)", "length", "residual", "what")
_FAULTS_HEAD = ("log", "begun (UTC)", "surface", "kind", "onset [s]", "end [s]", "parameters", "probability")
_SURFACES_HEAD = ("surface", "flights", "faults", "residual / threshold", "servo")
_AXES_HEAD = ("axis", "flights", "effect left", "surfaces")
_LINE = (
    "The small pictures show the residual of the worst surface (what its motion shows of the worst axis) over the "
    "flight; the line is its threshold."
)
_NEXT = (
    "Look at one flight: its name leads to its page. Follow one aircraft over its flights: `servofd trend FOLDER -c "
    "AIRCRAFT.toml`. Tables for pandas, DuckDB and Rerun: `servofd audit FOLDER -o results`."
)


def fleet_report(document: dict[str, Any], pages: frozenset[str] = frozenset()) -> Document:
    """Flights, the worst first, those with one of the `pages` linked to it; then surfaces, axes and faults.

    It names files without their folders, and tells nothing else of the machine or its user.
    """
    flights, faults, not_judged = document["flights"], document["faults"], document["not_judged"]
    known, statuses, hours = {flight["status"] for flight in flights}, document["statuses"], document["hours"]
    judged = document["logs"] - statuses.get("not_judged", 0)
    faulty, suspect = statuses.get("fault", 0), statuses.get("suspect", 0)
    said = [f"{faulty or 'None'} of {judged} judged logs show{'s' * (faulty <= 1)} a fault"]
    said += [f"{suspect} {'is' if suspect == 1 else 'are'} suspect"] if suspect else []
    said += [f"{statuses['not_judged']} more could not be judged"] if statuses.get("not_judged") else []
    flown = f"{hours:.1f} h" if hours >= 1.0 else f"{60.0 * hours:.{0 if hours >= 0.1 else 1}f} min"
    rows = []
    for rank, flight in enumerate(flights[:_MOST_FLIGHTS]):
        name, status = flight_name(flight), flight["status"].replace("not_judged", "unknown")
        page = flight["page"] if flight["page"] in pages else ""
        said_of_it = flight["sentence"].replace(flight["path"], name) + _also(flight, faults)
        rows.append(flight_row(name, status, flight | {"sentence": said_of_it}, page, rank))
    lost = [(flight_name(one), one["reason"].replace(one["path"], flight_name(one))) for one in not_judged[:_MOST_ROWS]]
    each_fault = Table("Each fault, in s after the beginning", _FAULTS_HEAD, list(map(_fault, faults[:_MOST_ROWS])))
    every_fault = [each_fault, *_more(faults, _MOST_ROWS, "faults")]
    worst = next((s for s in ("fault", "suspect", "not_judged", "unknown", "healthy") if s in known), "unknown")
    return Document(
        title="Many flights",
        status=worst.replace("not_judged", "unknown"),
        sentence=", ".join(said) + "." if judged else "No log was judged.",
        facts=f"{document['logs']} logs, {flown} of flight",
        parts=[
            Table("Flights, the worst first", FLIGHTS_HEAD, rows, long=True),
            *[Figures(lambda: [_chart(flights)])] * (len(flights) >= _FEWEST_DRAWN),
            _surfaces(document["surfaces"]),
            Table("Axes, judged by the motion of the aircraft", _AXES_HEAD, list(map(_axis, document["axes"]))),
        ],
        evidence=[
            *_more(flights, _MOST_FLIGHTS, "logs"),
            Words(_LINE, style="soft"),
            *[Section("All faults, with onset and parameters", every_fault, folded=True)] * bool(faults),
            Table("Not judged, and why", ("log", "why"), lost),
            *_more(not_judged, _MOST_ROWS, "logs"),
            Section("What to do next", [Words(_NEXT)], folded=True),
        ],
        data=document,
    )


def _also(flight: Mapping[str, Any], faults: Sequence[Mapping[str, Any]]) -> str:
    """What surfaces of a flight did beside the gravest, which its sentence names.

    Examples
    --------
    >>> flight = {"path": "a.bin", "run": None}
    >>> found = [flight | {"surface": "aileron", "kind": kind} for kind in ("binding", "stuck", "stuck")]
    >>> _also(flight, found), _also({"path": "b.bin", "run": None}, found)
    (' Also: aileron binding.', '')
    """
    of_surface: dict[str, list[str]] = {}
    for one in faults:
        if (one["path"], one["run"]) == (flight["path"], flight["run"]):
            of_surface.setdefault(one["surface"], []).append(one["kind"])
    others = []
    for name, kinds in of_surface.items():
        _, *more = dict.fromkeys(sorted(kinds, key=lambda kind: gravity_of([kind])))
        others += [f"{spoken(name)} {', '.join(KINDS[kind].perhaps for kind in more)}"] if more else []
    return f" Also: {'; '.join(others)}." if others else ""


def _chart(flights: Sequence[Mapping[str, Any]]) -> Chart:
    """How far the worst surface of each flight was from its threshold, in the order in which they were flown."""
    flown = sorted(flights, key=lambda one: (one["start_utc"] is None, one["start_utc"] or "", one["path"]))
    shares = np.array([max((share or 0.0 for share in one["outline"]), default=np.nan) for one in flown])
    number, high = np.arange(1.0, len(flown) + 1.0), _HIGHEST_SHARE
    curves = []
    for words, role, those in _DOTS:
        is_of = np.array([one["status"] in those for one in flown])
        if is_of.any():
            curves.append(Curve(words, role, number, np.where(is_of, np.minimum(shares, high), np.nan), "dots"))
    limit = Curve("threshold", "threshold", np.array([0.5, len(flown) + 0.5]), np.ones(2))
    panel = Panel("residual of the worst surface over its threshold", "", (*curves, limit), 0.0, 1.05 * high)
    text = (
        f"One dot a flight, in the order of their dates; what is {high:g} times the threshold or more is drawn there."
    )
    return Chart("All flights", text, 0.5, len(flown) + 0.5, (panel,), axis="flight")


def flight_row(
    name: str, status: str, flight: Mapping[str, Any], page: str, rank: int | None = None
) -> tuple[str | Cell, ...]:
    """Cells under `FLIGHTS_HEAD`."""
    duration_s = flight["duration_s"]
    return (
        Cell(name, link=page),
        Cell(status=status, order=rank),
        minute_of(flight["start_utc"]),
        Cell(clock(duration_s) if duration_s else "", order=duration_s),
        Cell(outline=flight["outline"], soft=spoken(flight["surface"]), order=rank),
        flight["sentence"],
    )


def _more(every: Sequence[object], shown: int, table: str) -> list[Part]:
    rest = len(every) - shown
    return [Words(f"And {rest} more, in the table `{table}`.", style="soft")] if rest > 0 else []


def flight_name(one: Mapping[str, Any]) -> str:
    """Name of a log without its folders, and of its run."""
    return PurePosixPath(one["path"].replace("\\", "/")).name + (f" (run {one['run']})" if one.get("run") else "")


def _by_status(logs: Mapping[str, int]) -> Cell:
    """How many logs were at fault, suspect, not judged and healthy; sorted by the first two."""
    counts = {status: logs.get(status, 0) for status in ("fault", "suspect", "healthy")}
    counts["not judged"] = logs.get("unknown", 0) + logs.get("no_data", 0)
    words = ", ".join(f"{number} {status}" for status, number in counts.items() if number)
    return Cell(words, order=-(counts["fault"] + counts["suspect"] / (1.0 + sum(counts.values()))))


def _axis(axis: dict[str, Any]) -> tuple[str | Cell, ...]:
    """With the smallest and largest effect in the flights in which it was healthy."""
    members, left = ", ".join(spoken(member) for member in axis["members"]), axis["effect_left"]
    effect = "" if left is None else f"{100.0 * left[0]:.0f} to {100.0 * left[1]:.0f}%"
    return axis["axis"], _by_status(axis["logs"]), effect, members


def _surfaces(surfaces: Sequence[Mapping[str, Any]]) -> Table:
    """Each with its largest share of the threshold, and its currents, in the flights without a fault of it."""
    rows, ratios = [], []
    for one in surfaces:
        share, kinds = one["largest_share"], ", ".join(f"{spoken(kind)} {n}" for kind, n in one["kinds"].items())
        nearest, servos = "" if share is None else f"{share:.0%}", ", ".join(one["servos"])
        rows.append((one["surface"], _by_status(one["logs"]), kinds or "none", nearest, servos))
        drawn = one.get("current_ratio")
        ratios.append("" if drawn is None else f"{drawn[0]:.0%} to {drawn[1]:.0%}")
    if not any(ratios):
        return Table("Surfaces", _SURFACES_HEAD, rows)
    head = (*_SURFACES_HEAD, "current / good flights")
    return Table("Surfaces", head, [(*row, ratio) for row, ratio in zip(rows, ratios, strict=True)])


def _fault(fault: dict[str, Any]) -> tuple[str, ...]:
    end = "lasts" if fault["end_s"] is None else f"{fault['end_s']:.1f}"
    which = (flight_name(fault), minute_of(fault["start_utc"]), spoken(fault["surface"]), spoken(fault["kind"]))
    sizes = ", ".join(f"{quantity(name)} {value:.3g}" for name, value in fault["parameters"].items())
    return (*which, f"{fault['start_s']:.1f}", end, sizes, f"{fault['probability']:.0%}")
