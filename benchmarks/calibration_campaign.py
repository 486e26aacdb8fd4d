"""Strangers' aircraft, each calibrated on one mixed flight of four minutes, then healthy and faulty flights of it.

    python benchmarks/calibration_campaign.py FIRST:LAST:STEP [FILE]     # seeds of aircraft; results are added to FILE
    python benchmarks/calibration_campaign.py --table FILE               # the table of docs/calibration-campaign.md

Aircraft of even seed chose the constants of servofd, those of odd seed are reported. Flights last two minutes; the
style of faulty ones goes round with the aircraft, so that each fault is met in each style.
"""

from __future__ import annotations

import json
import sys
import time
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from strangers import SIZES, SURFACES, draw_failure, fly, stranger

from servofd.aircraft.schema import plain_aircraft
from servofd.aircraft.series import Series
from servofd.calibrating.calibrate import calibrate_aircraft
from servofd.core.errors import CalibrationError
from servofd.detection.audit import audit_segment
from servofd.detection.flights import Flight
from servofd.servo.context import Context

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from strangers import Flight as Flown

    from servofd.aircraft.schema import Aircraft
    from servofd.detection.verdict import SurfaceAudit

STYLES: Final = ("taxi", "cruise", "loiter", "turbulence", "aerobatics")
_HEALTHY: Final = 10
_FLIGHT_S: Final = 120.0
_MOVED_DEG: Final = 5.0
_GRADES: Final = ("small", "medium", "large")
_SIZELESS: Final = ("stuck", "hardover", "floating")
_TWINS: Final = {
    "stuck": {"stuck", "floating", "hardover"},
    "floating": {"floating", "stuck"},
    "hardover": {"hardover", "stuck"},
}
"""What is physically the same, or may be called so: a geared servo without power stays where it is."""
Row = dict[str, Any]
_PAGE: Final = """# Calibrated, on strangers' aircraft

Made by `benchmarks/calibration_campaign.py --table` (seeds 9001:9081:2). Aircraft of odd seed of
`benchmarks/strangers.py` (motor-level servos, good and cheap; friction, play, supply, frames, sensors, rates drawn; an
autopilot in the loop), each calibrated on one mixed flight of four minutes; then ten healthy and 21 faulty flights of
two minutes each. None of them had been seen before; the constants of servofd were chosen on aircraft of even seed.
Intervals are of 95 %. *Found* is an alarm after the onset, whatever the flight showed: in cruise and loiter some faults
cannot show, and the verdict is then `unknown` or says what was not judgeable. A servo without power that stays where it
is may be called stuck, and play that the air pushes to one side an offset, if the other name stands beside it.

"""


def segment_of(flown: Flown, surface: str) -> Series:
    """One surface of a flight."""
    place = flown.surfaces.index(surface)
    context = Context(flown.command_s, flown.airspeed_m_s, flown.command_s, flown.supply_v)
    return Series(
        surface, flown.command_s, flown.command_deg[:, place], flown.position_s, flown.position_deg[:, place],
        context=context,
    )  # fmt: skip


def calibrated(seed: int) -> tuple[Aircraft | None, str, float]:
    """The aircraft file from one flight, why there is none, and the processor time for each surface [s]."""
    good = fly(stranger(seed), 1, "mixed")
    flights = {name: [Flight("good.csv", segment_of(good, name))] for name in SURFACES}
    begun_s = time.process_time()
    try:
        found = calibrate_aircraft(plain_aircraft(SURFACES, "hs225bb-eq31"), flights)
    except CalibrationError as error:
        return None, str(error), 0.0
    return found.aircraft, "; ".join(found.kept.values()), (time.process_time() - begun_s) / len(SURFACES)


def verdicts(aircraft: Aircraft, flown: Flown) -> dict[str, SurfaceAudit]:
    """What an audit says of each surface."""
    found = {}
    for name, surface in aircraft.surfaces.items():
        segment = segment_of(flown, name)
        if surface.measured is None:
            continue
        read = Series(
            name, segment.command_s, segment.command_deg, segment.measured_s,
            surface.measured.to_deg(segment.measured_deg), context=segment.context,
        )  # fmt: skip
        found[name] = audit_segment(read, aircraft, duration_s=_FLIGHT_S)
    return found


def trials(seed: int) -> Iterable[Row]:
    """All flights of one aircraft."""
    origin = stranger(seed)
    aircraft, refused, cpu_s = calibrated(seed)
    known = {"seed": seed, "grade": origin.grade, "hz": origin.position_hz}
    yield known | {"what": "calibration", "refused": refused, "cpu_s": cpu_s}
    if aircraft is None:
        return
    for number in range(_HEALTHY):
        style = STYLES[number % len(STYLES)]
        found = verdicts(aircraft, fly(origin, 100 + number, style, duration_s=_FLIGHT_S))
        yield known | {"what": "healthy", "style": style, "found": [_told(v) for v in found.values()]}
    for number, (kind, grade) in enumerate(
        (k, g) for k in SIZES for g in _GRADES if k not in _SIZELESS or g == "large"
    ):
        style = STYLES[1 + (number + seed // 2 + seed // 8) % 4]
        failure = draw_failure(1000 * seed + number, _FLIGHT_S, kind, grade)
        flown = fly(origin, 200 + number, style, duration_s=_FLIGHT_S, failure=failure)
        asked_deg = flown.command_deg[flown.command_s > failure.start_s, flown.surfaces.index(failure.surface)]
        found = verdicts(aircraft, flown)
        yield known | {
            "what": "faulty", "style": style, "kind": kind, "grade": grade, "start_s": failure.start_s,
            "asked_deg": float(np.ptp(asked_deg)),
            "own": _told(found.pop(failure.surface)), "found": [_told(v) for v in found.values()],
        }  # fmt: skip


def _told(verdict: SurfaceAudit) -> Row:
    return {
        "status": verdict.status,
        "reason": verdict.reason,
        "slow": verdict.detectable.slow_share,
        "faults": [
            {
                "kind": f.kind,
                "also": list(f.alternatives),
                "p": f.probability,
                "start_s": f.start_s,
                "alarm_s": f.alarm_s,
            }
            for f in verdict.faults
        ],
    }


def wilson(hits: int, of: int) -> str:
    """A share with its 95 % interval, in percent.

    >>> wilson(2, 370)
    '0.5 % [0.1, 1.9] of 370'
    """
    if not of:
        return "none"
    z2, p = 1.96**2, hits / of
    middle, half = p + z2 / (2 * of), 1.96 * np.sqrt(p * (1 - p) / of + z2 / (4 * of * of))
    low, high = (100.0 * (middle + side * half) / (1.0 + z2 / of) for side in (-1.0, 1.0))
    digits = 0 if p > 0.1 else 1
    return f"{100 * p:.{digits}f} % [{max(low, 0.0):.{digits}f}, {high:.{digits}f}] of {of}"


def _first(row: Row) -> Row | None:
    """The first fault told of the faulty surface that was not there before the onset."""
    return next((f for f in row["own"]["faults"] if f["alarm_s"] >= row["start_s"]), None)


def _is_right(row: Row, fault: Row) -> bool:
    wanted = _TWINS.get(row["kind"], {row["kind"]})
    return fault["kind"] in wanted or (fault["kind"] != "unknown" and row["kind"] in fault["also"])


def table(rows: Sequence[Row]) -> str:
    """Everything as Markdown."""
    healthy = [r for r in rows if r["what"] == "healthy"]
    faulty = [r for r in rows if r["what"] == "faulty"]
    start = [r for r in rows if r["what"] == "calibration"]
    alarms = sum(len(v["faults"]) for r in healthy for v in r["found"])
    hours = len(healthy) * _FLIGHT_S / 3600.0
    cpu_s = np.median([r["cpu_s"] for r in start])
    others = [v for r in faulty for v in r["found"]]
    false = sum(any(v["faults"] for v in r["found"]) for r in healthy)
    doubted = sum(any(v["status"] == "suspect" for v in r["found"]) for r in healthy)
    accused = sum(bool(v["faults"]) for v in others)
    lines = [
        "| | measured |",
        "|---|---|",
        f"| aircraft; refused by `calibrate` | {len(start)}; {sum(bool(r['refused']) for r in start)} |",
        f"| processor time of the calibration, a surface | {cpu_s:.1f} s |",
        f"| healthy flights with a fault | {wilson(false, len(healthy))} |",
        f"| false alarms an hour of flight (four surfaces) | {alarms / hours:.2f} in {hours:.1f} h |",
        f"| healthy flights with a `suspect` | {wilson(doubted, len(healthy))} |",
        f"| other surfaces of faulty flights called faulty | {wilson(accused, len(others))} |",
    ]
    for grade in _GRADES[::-1]:
        some = [r for r in faulty if r["grade"] == grade]
        seen = [(r, f) for r in some if (f := _first(r)) is not None]
        right = wilson(sum(_is_right(r, f) for r, f in seen), len(seen))
        moved = [r for r in some if r["asked_deg"] >= _MOVED_DEG]
        seen_moving = sum(_first(r) is not None for r in moved)
        verdict = Counter(r["own"]["status"] for r in some if _first(r) is None)
        told = ", ".join(f"{verdict[status]} `{status}`" for status in ("suspect", "unknown", "healthy"))
        lines.append(f"| {grade} faults found | {wilson(len(seen), len(some))} |")
        lines.append(
            f"| {grade}: where the command moves {_MOVED_DEG:g} deg after it | {wilson(seen_moving, len(moved))} |"
        )
        lines.append(f"| {grade}: verdict on those not found | {told} |")
        lines.append(f"| {grade}: right name, or its physical twin | {right} |")
    sure = [(r, f) for r in faulty if (f := _first(r)) is not None and f["p"] >= 0.95 and f["kind"] != "unknown"]
    lines.append(
        f"| right of names given with P >= 0.95 | {wilson(sum(_is_right(r, f) for r, f in sure), len(sure))} |"
    )
    lines += ["", "| fault | small | medium | large |", "|---|---|---|---|"]
    for kind in SIZES:
        cells = []
        for grade in _GRADES:
            some = [r for r in faulty if (r["kind"], r["grade"]) == (kind, grade)]
            seen = [(r, f) for r in some if (f := _first(r)) is not None]
            delay = np.median([f["alarm_s"] - r["start_s"] for r, f in seen]) if seen else np.nan
            count = sum(_is_right(r, f) for r, f in seen)
            cells.append(f"{len(seen)} of {len(some)}, {delay:.1f} s, {count} named" if some else "")
        lines.append(f"| {kind} {SIZES[kind] if kind not in _SIZELESS else ''} | {' | '.join(cells)} |")
    half = [r for r in faulty if (r["kind"], r["grade"]) == ("slow", "medium")]
    for names in (("aerobatics", "turbulence"), ("cruise", "loiter")):
        some = [r for r in half if r["style"] in names]
        missed = [r for r in some if _first(r) is None]
        said = sum(r["own"]["slow"] is None or r["own"]["slow"] < 0.5 for r in missed)
        found = wilson(len(some) - len(missed), len(some))
        told = f"of those not found, {said} of {len(missed)} flights said so"
        lines += ["", f"Slow to half in {' and '.join(names)}: {found}; {told}."]
    return "\n".join(lines) + "\n"


def main() -> None:
    if sys.argv[1] == "--table":
        rows = [json.loads(line) for line in Path(sys.argv[2]).read_text().splitlines()]
        print(_PAGE + table(rows), end="")
        return
    rows = []
    for seed in range(*(int(part) for part in sys.argv[1].split(":"))):
        some = list(trials(seed))
        rows += some
        if len(sys.argv) > 2:
            with Path(sys.argv[2]).open("a") as sink:
                sink.writelines(json.dumps(row) + "\n" for row in some)
    print(table(rows))


if __name__ == "__main__":
    main()
