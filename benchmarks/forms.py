"""Healthy flights of `strangers` without any aircraft file, the same one as table, DataFlash log and telemetry.

``python benchmarks/forms.py ROWS.jsonl [--seeds FIRST LAST] [--seconds S]`` flies each aircraft once, in five styles by
turns, and judges the whole flight and one beginning of it (15, 20, 30, 45, 60 s by turns) in every form. Each aircraft
is one row of the file when it is done, so that a stop loses nothing and the next call goes on; the counts of all rows
are printed at the end. Constants were chosen on aircraft of even seed; odd ones, the default, are reported.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from strangers import SURFACES, fly, stranger

import servofd

if TYPE_CHECKING:
    from collections.abc import Iterable

    from strangers import Flight

_STYLES = ("mixed", "taxi", "cruise", "turbulence", "aerobatics")
_CUTS_S = (15.0, 20.0, 30.0, 45.0, 60.0)
_FLIGHT_S = 90.0
_FORMS = ("csv", "bin", "tlog")
_NAMED_BY_OUTPUT = {"aileron_1": "aileron_left", "aileron_5": "aileron_right"}


def statuses(flight: Flight, form: str, folder: Path) -> dict[str, str]:
    """Status of each surface; a log that cannot be judged has the same for all of them."""
    judged = servofd.audit(flight.write(folder / f"flight.{form}"))[0]
    if not judged.surfaces:
        return dict.fromkeys(SURFACES, "refused")
    return {_NAMED_BY_OUTPUT.get(each.surface, each.surface): each.status for each in judged.surfaces}


def row(seed: int, folder: Path) -> dict[str, Any]:
    """Verdicts on one flight of one aircraft, whole and cut short."""
    draw = seed // 2
    style, cut_s = _STYLES[draw % len(_STYLES)], _CUTS_S[draw // len(_STYLES) % len(_CUTS_S)]
    flight = fly(stranger(seed), 1, style, duration_s=_FLIGHT_S)
    lengths = {_FLIGHT_S: flight, cut_s: flight.until(cut_s)}
    verdicts = {f"{s:.0f}": {form: statuses(one, form, folder) for form in _FORMS} for s, one in lengths.items()}
    return {"seed": seed, "style": style, "verdicts": verdicts}


def table(rows: Iterable[dict[str, Any]]) -> str:
    """Counts of logs at fault and of verdicts, by length and form, and how often all forms agree."""
    logs: Counter[tuple[str, str]] = Counter()
    at_fault: Counter[tuple[str, str]] = Counter()
    found: Counter[tuple[str, str, str]] = Counter()
    same: Counter[str] = Counter()
    of: Counter[str] = Counter()
    for one in rows:
        for length, by_form in one["verdicts"].items():
            for form, verdicts in by_form.items():
                logs[length, form] += 1
                at_fault[length, form] += "fault" in verdicts.values()
                found.update((length, form, status) for status in verdicts.values())
            for surface in SURFACES:
                of[length] += 1
                same[length] += len({by_form[form].get(surface) for form in _FORMS}) == 1
    names = ("fault", "suspect", "healthy", "unknown", "refused")
    lines = ["| first s | form | logs | with a fault | " + " | ".join(names) + " | same in every form |"]
    lines.append("|---" * (5 + len(names)) + "|")
    for length, form in sorted(logs, key=lambda key: (float(key[0]), _FORMS.index(key[1]))):
        counts = " | ".join(str(found[length, form, name]) for name in names)
        agree = f"{same[length]} of {of[length]}" if form == _FORMS[0] else ""
        lines.append(f"| {length} | {form} | {logs[length, form]} | {at_fault[length, form]} | {counts} | {agree} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("rows", type=Path, help="file of rows, appended to")
    parser.add_argument("--seeds", nargs=2, type=int, default=[2001, 3001], metavar=("FIRST", "LAST"))
    parser.add_argument("--seconds", type=float, default=240.0, help="end after so long")
    options = parser.parse_args()
    options.rows.touch()
    rows = [json.loads(line) for line in options.rows.read_text().splitlines()]
    done = {one["seed"] for one in rows}
    started_s = time.monotonic()
    with tempfile.TemporaryDirectory() as folder, options.rows.open("a") as sink:
        for seed in range(options.seeds[0], options.seeds[1], 2):
            if time.monotonic() - started_s > options.seconds:
                break
            if seed not in done:
                rows.append(row(seed, Path(folder)))
                sink.write(json.dumps(rows[-1]) + "\n")
                sink.flush()
    print(f"{len(rows)} aircraft, {sum(len(v) for one in rows for v in one['verdicts'].values())} logs")
    print(table(rows))


if __name__ == "__main__":
    main()
