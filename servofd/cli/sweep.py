"""``servofd audit --sweep``: pre-flight check of each surface from a commanded sweep on the ground."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from logparsers.units import MS_PER_S
from servofd.cli.terminal import give_json, print_table
from servofd.core.statistics import Estimate
from servofd.feedback.flown import flown_aircraft, known_aircraft, one_log
from servofd.jobs.sweep import check_sweep

if TYPE_CHECKING:
    from collections.abc import Sequence

    from logparsers.records import FlightLog
    from servofd.cli.options import Options
    from servofd.jobs.sweep import SurfaceSweep


def run(options: Options) -> int:
    """Check, then write or print."""
    known = known_aircraft(options.config)
    sweeps = []
    for log in one_log(options.log, known).by_boots():
        aircraft = flown_aircraft(log, known)
        aircraft.check_names(options.surface, log.label)
        sweeps.append((log, check_sweep(log, aircraft, tuple(options.surface))))
    *earlier, last = (sweep_document(log, found) for log, found in sweeps)
    if not give_json(options.json, last | {"earlier_boots": earlier} if earlier else last):
        for log, found in sweeps:
            _print(found, f"{log.label}   {log.format}, {log.duration_s:.1f} s")
    return _exit_code([one for _, found in sweeps for one in found])


def _exit_code(found: Sequence[SurfaceSweep]) -> int:
    statuses = {one.status for one in found if one.expected}
    if "no_go" in statuses:
        return 1
    return 0 if statuses == {"go"} else 2


def _print(found: tuple[SurfaceSweep, ...], title: str) -> None:
    words = {"go": "go", "no_go": "NO-GO", "unknown": "cannot tell"}
    headings = ["surface", "verdict", "travel", "gain", "extra lag (ms)", "bias", "play", "fastest", "residual", "why"]
    rows = []
    for one in found:
        cells = [""] * 7
        if one.numbers is not None:
            n = one.numbers
            cells = [
                f"{n.reached_deg[0]:+.1f} to {n.reached_deg[1]:+.1f} deg",
                f"{n.gain.value:.3f}",
                f"{MS_PER_S * n.extra_delay_s.value:+.1f}",
                f"{n.bias_deg.value:+.2f} deg",
                f"{max(n.play_deg.value, 0.0):.2f} deg",
                f"{n.fastest_deg_s:.0f} deg/s",
                f"{n.residual_peak_deg:.2f} of {n.threshold_deg:.2f} deg",
            ]
        rows.append([one.surface, words[one.status], *cells, "; ".join(one.reasons)])
    print_table(headings, rows, title)


def sweep_document(log: FlightLog, surfaces: Sequence[SurfaceSweep]) -> dict[str, Any]:
    """All numbers of one sweep."""
    found = {
        one.surface: {
            "status": one.status,
            "reasons": list(one.reasons),
            "numbers": one.numbers and {name: _plain(value) for name, value in one.numbers._asdict().items()},
        }
        for one in surfaces
    }
    about = {"path": str(log.source), "duration_s": log.duration_s}
    return {"schema": "servofd.sweep/1", **about, "surfaces": found}


def _plain(value: float | tuple[float, ...]) -> Any:  # noqa: ANN401 - as JSON has it
    if isinstance(value, Estimate):
        return value._asdict()
    return list(value) if isinstance(value, tuple) else value
