"""Two flights beside each other, surface by surface."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from servofd.core.types import FloatArray
from servofd.detection.verdict import SurfaceAudit
from servofd.outputs.chart import Chart, Curve, Panel, extremes
from servofd.outputs.document import Cell, Document, Figures, Part, Table
from servofd.outputs.sentence import STATUSES, spoken

_RANKS = (*STATUSES, "")
_LEAST_DEG = 0.1
"""Room above and below curves that hardly move [deg]."""
_FEWEST = 2


def compare_report(
    names: Sequence[str],
    documents: Sequence[Mapping[str, Any]],
    links: Sequence[str] = ("", ""),
    parts: Sequence[Part] = (),
) -> Document:
    """One row for each surface and axis that either flight knows, the worst first.

    `names`: of both flights. `documents`: their audits, schema servofd.audit/1. `links`: to their pages. `parts`: what
    stands below the table.
    """
    both = [_worst_runs(document["logs"]) for document in documents]
    entries = {name: [one.get(name) for one in both] for one in both for name in one}
    ordered = sorted(entries, key=lambda name: min(_RANKS.index(_cell(one).status) for one in entries[name]))
    differ = [name for name in ordered if len({_cell(one).status for one in entries[name]}) > 1]
    said = "the same verdicts"
    if differ:
        said = f"{' and '.join(map(spoken, differ))} {'differs' if len(differ) == 1 else 'differ'}"
    head: list[str | Cell] = ["surface", *(Cell(name, link=link) for name, link in zip(names, links, strict=True))]
    rows: list[list[str | Cell]] = [[spoken(name), *map(_cell, entries[name])] for name in ordered]
    return Document(
        " and ".join(names),
        "no_data",
        f"{said[:1].upper()}{said[1:]}.",
        " and ".join(names),
        [Table("The same surfaces and axes in two flights, the worst first", head, rows), *parts],
        data={"schema": "servofd.compare/1", "flights": list(names), "surfaces": {n: entries[n] for n in ordered}},
    )


def _worst_runs(runs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Surfaces and axes of a flight by name, each from the run of the log in which it did worst."""
    found: dict[str, Any] = {}
    for run in runs:
        axes = {f"{name} axis": entry for name, entry in run.get("axes", {}).items()}
        for name, entry in (run["surfaces"] | axes).items():
            known = found.get(name)
            if known is None or _RANKS.index(entry["status"]) < _RANKS.index(known["status"]):
                found[name] = entry
    return found


def _cell(entry: Mapping[str, Any] | None) -> Cell:
    if entry is None:
        return Cell("not in this flight")
    residual, numbers = entry.get("residual"), ""  # of an axis its sentence tells all
    if residual is not None:
        numbers = (
            f"largest residual {residual['max_abs_deg']:.2f} deg, mean {residual['mean_deg']:+z.2f}, "
            f"standard deviation {residual['std_deg']:.2f}"
        )
    outline = (residual or entry).get("outline") or ()
    return Cell(entry["reason"], entry["status"], outline=outline, soft=numbers)


class Track(NamedTuple):
    """What a surface did in a flight."""

    time_s: FloatArray
    measured_deg: FloatArray
    residual_deg: FloatArray


def track_of(surface: SurfaceAudit, points: int = 0) -> Track | None:
    """What a surface did, in so many points if not all are wanted; None where it was not judged."""
    found = surface.residuals
    if found is None or found.time_s.size < _FEWEST:
        return None
    track = Track(found.time_s, found.measured_deg, found.residual_deg)
    if points:
        kept = np.union1d(*(extremes(track.time_s, values, points // 2) for values in track[1:]))
        track = Track(*(values[kept] for values in track))
    return track


def overlaid(name: str, tracks: Sequence[Track], names: Sequence[str], at_s: Sequence[float]) -> Chart:
    """What a surface did, and its residual, in two flights over each other.

    `at_s`: the moment of each flight that lies at 0 [s].

    Examples
    --------
    >>> one = Track(np.array([10.0, 11.0]), np.array([0.0, 1.0]), np.array([0.0, 0.0]))
    >>> other = one._replace(time_s=np.array([30.0, 32.0]))
    >>> chart = overlaid("rudder", (one, other), ("a.bin", "b.bin"), (10.0, 30.0))
    >>> chart.first, chart.last, chart.legend
    (0.0, 2.0, [('measured', 'a.bin'), ('simulated', 'b.bin')])
    """
    drawn: dict[str, list[Curve]] = {"deflection": [], "residual": []}
    for track, flight, moment_s, role in zip(tracks, names, at_s, ("measured", "simulated"), strict=True):
        time_s = track.time_s - moment_s
        drawn["deflection"].append(Curve(flight, role, time_s, track.measured_deg))
        drawn["residual"].append(Curve(flight, role, time_s, track.residual_deg))
    panels = [Panel.around(title, "deg", curves, _LEAST_DEG) for title, curves in drawn.items()]
    times_s = [curve.x for curve in drawn["deflection"]]
    text = f"What was measured of {spoken(name)}, and its residual, in both flights."
    first_s, last_s = min(float(t[0]) for t in times_s), max(float(t[-1]) for t in times_s)
    return Chart(spoken(name).capitalize(), text, first_s, last_s, tuple(panels))


def charts(pairs: Mapping[str, Sequence[Track]], names: Sequence[str], at_s: Sequence[float]) -> Figures:
    """Charts of the surfaces that were judged in both flights."""
    return Figures(lambda: [overlaid(name, both, names, at_s) for name, both in pairs.items()])
