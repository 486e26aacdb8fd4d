"""Two flights beside each other, surface by surface."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from servofd.outputs.chart import Chart, Curve, Panel
from servofd.outputs.document import Cell, Document, Figures, Table
from servofd.outputs.sentence import spoken

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from servofd.detection.verdict import SurfaceAudit
    from servofd.outputs.document import Part

_RANKS = ("fault", "suspect", "healthy", "unknown", "no_data", "")
_ROOM = 1.15


def compare_report(
    names: Sequence[str],
    documents: Sequence[Mapping[str, Any]],
    links: Sequence[str] = ("", ""),
    parts: Sequence[Part] = (),
) -> Document:
    """One row for each surface and axis that either flight knows, the worst first.

    Parameters
    ----------
    names : sequence of str
        Of both flights.
    documents : sequence of mapping
        Their audits, schema servofd.audit/1.
    links : sequence of str
        To their pages.
    parts : sequence of Part
        What stands below the table.
    """
    both = [worst_runs(document["logs"]) for document in documents]
    known = list(dict.fromkeys(name for one in both for name in one))
    entries = {name: [one.get(name) for one in both] for name in known}
    ordered = sorted(known, key=lambda name: min(_RANKS.index(_cell(one).status) for one in entries[name]))
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
        data={
            "schema": "servofd.compare/1",
            "flights": list(names),
            "surfaces": {name: entries[name] for name in ordered},
        },
    )


def worst_runs(runs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
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


def overlaid(name: str, flights: Sequence[SurfaceAudit], names: Sequence[str], at_s: Sequence[float]) -> Chart | None:
    """What a surface did, and its residual, in two flights over each other; None where one was not judged.

    `at_s`: the moment of each flight that lies at 0 [s].
    """
    drawn, left, last_s = [], [], 0.0
    for one, flight, begin_s, role in zip(flights, names, at_s, ("measured", "simulated"), strict=True):
        if one.residuals is None:
            return None
        time_s = one.residuals.time_s - begin_s
        last_s = max(last_s, float(time_s[-1]))
        drawn.append(Curve(flight, role, time_s, one.residuals.measured_deg))
        left.append(Curve(flight, role, time_s, one.residuals.residual_deg))
    panels = []
    for title, curves in (("deflection", drawn), ("residual", left)):
        high = _ROOM * max((float(abs(c.values[c.values == c.values]).max(initial=0.1)) for c in curves), default=1.0)
        panels.append(Panel(title, "deg", tuple(curves), -high, high))
    first_s = min(float(c.time_s[0]) for c in drawn)
    text = f"What was measured of {spoken(name)}, and its residual, in both flights."
    return Chart(spoken(name).capitalize(), text, first_s, last_s, tuple(panels))


def charts(pairs: Mapping[str, Sequence[SurfaceAudit]], names: Sequence[str], at_s: Sequence[float]) -> Figures:
    """Charts of the surfaces that both flights have."""
    return Figures(
        lambda: [chart for name, both in pairs.items() if (chart := overlaid(name, both, names, at_s)) is not None]
    )
