"""One flight alone: what healthy flights reach, and what faults show, each flight against its own past.

``python benchmarks/one_flight.py FOLDER`` with the folders ``alfa`` (10 Hz tables, ``index.csv``) and ``logs/wind``.
The spreads and limits of `servofd.flight.change.LOOKS` are made from the healthy time of flights without a surface
fault; beside each limit stand, for each day, that of the other days and the largest J of its own.
"""

from __future__ import annotations

import csv
import sys
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

import logparsers
from servofd.axes.calibrate import spread_between
from servofd.axes.model import FORMS
from servofd.axes.read import motion_of
from servofd.flight.change import LOOKS, WINDOWS_S, Compared, airborne, as_flown_before, judge_motion_alone, regressed

if TYPE_CHECKING:
    from servofd.axes.motion import Motion

HEALTHY = ("none", "engine", "unknown")


class Flown(NamedTuple):
    """A flight, its fault, and since when [s]; infinite without one."""

    motion: Motion
    kind: str
    onset_s: float


def flights_of(folder: Path) -> list[Flown]:
    """ALFA, and ArduPlane in wind."""
    found = [
        Flown(
            motion_of(logparsers.read(folder / "alfa" / f"{row['flight']}.csv")),
            row["kind"],
            float(row["onset_s"] or "inf"),
        )
        for row in csv.DictReader((folder / "alfa" / "index.csv").open())
    ]
    first: dict[str, tuple[str, float]] = {}
    for row in csv.DictReader((folder / "logs" / "wind" / "index.csv").open()):
        kind = (
            "engine" if row["fault"] == "engine_cut" else f"{row['fault']} {row['surface']}" if row["fault"] else "none"
        )
        first.setdefault(row["name"], (kind, float(row["onset_s"] or "inf")))
    found += [
        Flown(motion_of(logparsers.read(folder / "logs" / "wind" / f"{name}.bin.gz")), *what)
        for name, what in first.items()
    ]
    return found


def compared_of(name: str, motion: Motion) -> Compared:
    """An axis of a flight against its own past."""
    look = LOOKS[name]
    flies, reference_m_s = airborne(motion)
    form, corner_hz = look.slow if motion.rate_hz < 15.0 else look.fast
    usable = as_flown_before(motion, flies)
    return Compared.of(regressed(FORMS[form], motion, usable, corner_hz, reference_m_s), look)


def main(folder: Path) -> None:
    """Print what spreads and limits come from, then each flight."""
    flights = flights_of(folder)
    for name, look in LOOKS.items():
        tops: list[tuple[float, str, str]] = []
        spreads = []
        for rate in ("slow", "fast"):
            healthy = [f for f in flights if f.kind in HEALTHY and (f.motion.rate_hz < 15.0) == (rate == "slow")]
            all_windows = []
            for flight in healthy:
                compared = compared_of(name, flight.motion)
                before = np.arange(compared.judged.size) + flight.motion.time_s[0] + 2.0 < flight.onset_s
                tops.append((float(compared.held.max(axis=0)[before].max()) * look.limit, flight.motion.day, rate))
                all_windows.append((compared.found, before))
            spreads.append(
                [
                    spread_between(
                        [
                            found[k].at(np.flatnonzero(found[k].known & before)[:: max(1, length_s // 2)])
                            for found, before in all_windows
                        ],
                        np.diag([0.05**2, 10.0**2]),
                    )
                    for k, length_s in enumerate(WINDOWS_S)
                ]
            )
        for length_s, (slow, fast) in zip(WINDOWS_S, zip(*spreads, strict=True), strict=True):
            mean = (slow + fast) / 2.0
            print(f"{name} {length_s} s: sd {mean[0, 0] ** 0.5:.3f}, {mean[1, 1] ** 0.5:.1f} us, {mean[0, 1]:+.3f}")
        days = sorted({day for _, day, _ in tops})
        print(f"{name}: limit {1.25 * max(tops)[0]:.1f}; without a day, and the largest J of that day:")
        for day in days:
            others = 1.25 * max(top for top, d, _ in tops if d != day)
            own = [top for top, d, _ in tops if d == day]
            print(f"    {day}: {others:.1f}, {max(own):.1f}, {sum(top > others for top in own)} of {len(own)} over it")
    healthy_s, false = 0.0, 0
    for flight in flights:
        axes = judge_motion_alone(flight.motion)
        told = [axis for axis in axes.values() if axis.alarm_s is not None]
        early = [axis for axis in told if (axis.alarm_s or 0.0) < flight.onset_s]
        until_s = min(flight.onset_s, axes["roll"].judged_until_s or 0.0)
        healthy_s += max(until_s - float(flight.motion.time_s[0]), 0.0) * axes["roll"].judged_share
        false += len(early)
        words = ", ".join(
            f"{axis.axis} {(axis.alarm_s or 0.0) - flight.onset_s:+.1f} s, lost {axis.lost_share.value:.2f}"
            for axis in told
            if axis.lost_share is not None
        )
        print(f"{flight.motion.name[:50]:50} {flight.kind:24} {words}")
    print(f"{false} wrong in {healthy_s / 3600.0:.2f} h")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
