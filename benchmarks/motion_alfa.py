"""Surface faults of a real aeroplane without feedback: every day judged by a model of the other days.

``python benchmarks/motion_alfa.py FOLDER`` with the ALFA flights as 10 Hz tables and their ``index.csv``. Calibration
sees what comes before the faults of other days. Commands alone are read, never what the servos received.
"""

from __future__ import annotations

import csv
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy import stats

import logparsers
from servofd.axes.calibrate import calibrate_motion
from servofd.axes.judge import judge_motion
from servofd.axes.motion import motion_of_table

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servofd.axes.motion import Motion

AXIS = {"elevator": "pitch", "rudder": "side", "ail_one": "roll", "ail_both": "roll", "rud+ail": "roll"}


@dataclass(frozen=True)
class Told:
    """One flight: its axes' alarms, cause and time after the onset."""

    flight: str
    kind: str
    hours: float
    before: tuple[str, ...]
    after: tuple[tuple[str, float], ...]
    delay_s: float | None


def flights_of(folder: Path) -> list[tuple[Motion, str, float]]:
    """Flight, kind of failure, and its onset (infinite without one)."""
    rows = list(csv.DictReader((folder / "index.csv").read_text().splitlines()))
    return [
        (
            motion_of_table(logparsers.read(folder / f"{row['flight']}.csv")),
            row["kind"],
            float(row["onset_s"] or "inf"),
        )
        for row in rows
        if row["kind"] != "unknown"
    ]


def told(flights: Sequence[tuple[Motion, str, float]]) -> list[Told]:
    """Each flight judged by a model that has not seen its day."""
    found = []
    for day in sorted({motion.day for motion, _, _ in flights}):
        model = calibrate_motion([motion.until(onset_s - 1.0) for motion, _, onset_s in flights if motion.day != day])
        for motion, kind, onset_s in flights:
            if motion.day != day:
                continue
            events = [(axis, event) for axis in judge_motion(model, motion) for event in axis.events]
            surfaces = [(axis.axis, event) for axis, event in events if axis.axis != "thrust"]
            after = sorted((e.alarm_s - onset_s, axis, e.cause) for axis, e in surfaces if e.alarm_s >= onset_s)
            found.append(
                Told(
                    motion.name,
                    kind,
                    min(onset_s, float(motion.time_s[-1])) / 3600.0,
                    tuple(axis for axis, e in surfaces if e.alarm_s < onset_s),
                    tuple((axis, delay) for delay, axis, cause in after if not cause),
                    after[0][0] if after else None,
                )
            )
    return found


def main() -> None:
    flights = flights_of(Path(sys.argv[1]))
    began_s = time.process_time()
    results = told(flights)
    print(f"{len(flights)} flights, {time.process_time() - began_s:.0f} s of processor time")
    alarms, hours = sum(len(one.before) for one in results), sum(one.hours for one in results)
    high = stats.chi2.ppf(0.975, 2 * alarms + 2) / 2.0 / hours
    print(f"false alarms: {alarms} in {hours:.2f} h (at most {high:.1f} an hour, 95 %)")
    for kind in ("rudder", "ail_both", "elevator", "ail_one", "rud+ail"):
        of_kind = [one for one in results if one.kind == kind]
        seen = [one for one in of_kind if one.after]
        right = sum(one.after[0][0] == AXIS[kind] for one in seen)
        delays = ", ".join(f"{one.delay_s:.1f}" for one in seen)
        print(f"{kind:9s} found {len(seen)} of {len(of_kind)}, right axis {right} of {len(seen)}, after {delays} s")
    engines = [one for one in results if one.kind == "engine"]
    print(f"engine failures called a surface: {sum(bool(one.after) for one in engines)} of {len(engines)}")
    delays_s = [one.delay_s for one in results if one.kind in AXIS and one.delay_s is not None]
    print(f"delay: median {np.median(delays_s):.1f} s, 90 % {np.quantile(delays_s, 0.9):.1f} s")


if __name__ == "__main__":
    main()
