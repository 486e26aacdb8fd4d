"""What servos that nobody named are accused of: flights of `strangers`, each servo fitted to the very log.

``python benchmarks/evidence.py [--seeds FIRST LAST] [--seconds S]`` prints counts of verdicts on healthy flights, whole
and cut short, on flights with a stuck, hard-over, floating or oscillating surface whose command moves by 5 deg
afterwards, and with a servo at a third of its speed; styles and kinds are drawn in all pairs. Constants were chosen on
aircraft of even seed; odd ones, the default, are reported.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from pathlib import Path

import numpy as np
from strangers import STYLES, SURFACES, Flight, draw_failure, fly, stranger

from logparsers.records import Channel, FlightLog
from servofd.aircraft.schema import plain_aircraft
from servofd.detection.audit import audit_log
from servofd.detection.verdict import SurfaceAudit
from servofd.feedback.fitted import fitted_aircraft

_CUTS_S = (None, 15.0, 20.0, 30.0, 45.0, 60.0)
_FLIGHT_S = 120.0
_KINDS = ("stuck", "hardover", "floating", "oscillation", "slow")
_MOVES_DEG = 5.0
_BRISK_DEG_S, _WINDOW_S, _FEWEST_WINDOWS = 30.0, 3.0, 3
"""A command is brisk if its speed (rms) is so large in so many windows: then a lag of 30 ms moves it by a degree."""


def verdict_on(flight: Flight, index: int, until_s: float = np.inf) -> SurfaceAudit:
    name = SURFACES[index]
    commands = flight.command_s < until_s
    positions = (flight.position_s < until_s) & np.isfinite(flight.position_deg[:, index])
    asked = Channel(f"{name}_cmd_deg", flight.command_s[commands], flight.command_deg[commands, index], "deg", "")
    moved = Channel(f"{name}_pos_deg", flight.position_s[positions], flight.position_deg[positions, index], "deg", "")
    log = FlightLog(Path(f"{flight.aircraft.seed}.csv"), "table", {asked.name: asked, moved.name: moved})
    return audit_log(log, fitted_aircraft(log, plain_aircraft([name])), threads=1).surfaces[0]


def is_brisk(flight: Flight, index: int, from_s: float) -> bool:
    """Whether a command is brisk enough to tell a servo at a third of its speed."""
    after = flight.command_s > from_s
    time_s, command_deg = flight.command_s[after], flight.command_deg[after, index]
    power = np.gradient(command_deg, time_s) ** 2
    window = ((time_s - from_s) / _WINDOW_S).astype(np.intp)
    samples = np.bincount(window)
    speed = np.sqrt(np.bincount(window, power) / np.maximum(samples, 1))
    return int(np.count_nonzero(speed >= _BRISK_DEG_S)) >= _FEWEST_WINDOWS


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", nargs=2, type=int, default=[1, 401], metavar=("FIRST", "LAST"))
    parser.add_argument("--seconds", type=float, default=240.0, help="end after so long")
    options = parser.parse_args()
    healthy: Counter[str] = Counter()
    faulty: Counter[tuple[str, str]] = Counter()
    acquitted = 0
    started_s = time.monotonic()
    seed = options.seeds[0]
    for seed in range(options.seeds[0], options.seeds[1], 2):
        if time.monotonic() - started_s > options.seconds:
            break
        draw = seed // 2
        style, turn = STYLES[draw % len(STYLES)], draw // len(STYLES)
        until_s = _CUTS_S[turn % len(_CUTS_S)]
        flown_s = _FLIGHT_S if until_s is None else until_s + 1.0
        good = fly(stranger(seed), 1, style, duration_s=flown_s)
        healthy[verdict_on(good, turn % len(SURFACES), until_s or np.inf).status] += 1
        failure = draw_failure(seed, _FLIGHT_S, _KINDS[turn % len(_KINDS)], "large")
        bad = fly(stranger(seed), 1, style, duration_s=_FLIGHT_S, failure=failure)
        index = SURFACES.index(failure.surface)
        if float(np.ptp(bad.command_deg[bad.command_s > failure.start_s, index])) < _MOVES_DEG:
            continue
        found = verdict_on(bad, index)
        brisk = failure.kind != "slow" or is_brisk(bad, index, failure.start_s)
        faulty[failure.kind if brisk else "slow, not brisk", found.status] += 1
        if failure.kind == "slow" and found.status == "healthy" and found.detectable.slow_share is not None:
            acquitted += 1
            print(f"healthy at a third of its speed: {seed} ({style}), would have seen {found.detectable.slow_share}")
    print(f"aircraft {options.seeds[0]} to {seed}")
    print("healthy flights:", dict(healthy))
    for kind in (*_KINDS, "slow, not brisk"):
        print(f"{kind}:", {status: count for (of, status), count in sorted(faulty.items()) if of == kind})
    print("slow, healthy, and speed said to be judgeable:", acquitted)


if __name__ == "__main__":
    main()
