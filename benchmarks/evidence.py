"""What servos that nobody named are accused of: flights of `strangers`, each servo fitted to the very log.

``python benchmarks/evidence.py [--seeds FIRST LAST] [--seconds S]`` prints counts of verdicts on healthy flights, whole
and cut short, and on flights with a stuck, hard-over, floating or oscillating surface. Constants were chosen on
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
from servofd.aircraft import plain_aircraft
from servofd.detection.audit import audit_log
from servofd.detection.verdict import SurfaceAudit
from servofd.feedback.fitted import fitted_aircraft

_CUTS_S = (None, 15.0, 20.0, 30.0, 45.0, 60.0)
_FLIGHT_S = 120.0
_KINDS = ("stuck", "hardover", "floating", "oscillation")
_MOVES_DEG = 5.0


def verdict_on(flight: Flight, index: int, until_s: float = np.inf) -> SurfaceAudit:
    name = SURFACES[index]
    commands = flight.command_s < until_s
    positions = (flight.position_s < until_s) & np.isfinite(flight.position_deg[:, index])
    asked = Channel(f"{name}_cmd_deg", flight.command_s[commands], flight.command_deg[commands, index], "deg", "")
    moved = Channel(f"{name}_pos_deg", flight.position_s[positions], flight.position_deg[positions, index], "deg", "")
    log = FlightLog(Path(f"{flight.aircraft.seed}.csv"), "table", {asked.name: asked, moved.name: moved})
    return audit_log(log, fitted_aircraft(log, plain_aircraft([name])), threads=1).surfaces[0]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", nargs=2, type=int, default=[1, 201], metavar=("FIRST", "LAST"))
    parser.add_argument("--seconds", type=float, default=240.0, help="end after so long")
    options = parser.parse_args()
    healthy: Counter[str] = Counter()
    faulty: Counter[tuple[str, str]] = Counter()
    started_s = time.monotonic()
    seed = options.seeds[0]
    for seed in range(options.seeds[0], options.seeds[1], 2):
        if time.monotonic() - started_s > options.seconds:
            break
        draw = seed // 2
        until_s = _CUTS_S[(draw // 2) % len(_CUTS_S)]
        flown_s = _FLIGHT_S if until_s is None else until_s + 1.0
        good = fly(stranger(seed), 1, STYLES[draw % len(STYLES)], duration_s=flown_s)
        healthy[verdict_on(good, draw % len(SURFACES), until_s or np.inf).status] += 1
        failure = draw_failure(seed, _FLIGHT_S, _KINDS[draw % len(_KINDS)], "large")
        bad = fly(stranger(seed), 1, STYLES[draw % len(STYLES)], duration_s=_FLIGHT_S, failure=failure)
        index = SURFACES.index(failure.surface)
        moved_deg = float(np.ptp(bad.command_deg[bad.command_s > failure.start_s, index]))
        if moved_deg >= _MOVES_DEG:
            faulty[failure.kind, verdict_on(bad, index).status] += 1
    print(f"aircraft {options.seeds[0]} to {seed}")
    print("healthy flights:", dict(healthy))
    for kind in _KINDS:
        print(f"{kind}:", {status: count for (of, status), count in sorted(faulty.items()) if of == kind})


if __name__ == "__main__":
    main()
