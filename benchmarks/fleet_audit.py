"""The audit of many logs: how much of each core it uses, with the same logs one after the other as its peer.

Parallel efficiency is the time of the serial run over the number of processes times that of the parallel run. On a
machine that others use as well, wall-clock time tells about them; processor time tells what the parallel run does in
addition (starting processes, sending results), and is what efficiency comes to on a machine of one's own.

    python benchmarks/fleet_audit.py --logs 60 --minutes 10
"""

from __future__ import annotations

import argparse
import os
import resource
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

from servofd.aircraft.schema import plain_aircraft
from servofd.batch.find import find_logs
from servofd.batch.key import Job
from servofd.batch.local import cores
from servofd.fleets.run import audit_fleet, judge_log
from servofd.servo.faults import Stuck
from servofd.simulation.flight import simulate_flight
from servofd.simulation.pulses import outputs_of
from servofd.simulation.writers import write_flight

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from servofd.fleets.run import JudgedLog

_SURFACES = ("elevator", "rudder", "aileron_left", "aileron_right", "flap_left", "flap_right")
_EVERY = 20
"""One log in so many has a jam."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--logs", type=int, default=60)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--rate-hz", type=float, default=50.0)
    parser.add_argument("--format", choices=["bin", "csv"], default="bin")
    parser.add_argument("--folder", type=Path, help="keep the logs here, and use those that are there")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary)
        _write(folder, options)
        logs = find_logs([str(folder)]).logs[: options.logs]
        job = Job(plain_aircraft(_SURFACES, "hs225bb-eq31")) if options.format == "csv" else Job()
        judge_log(logs[0], job)  # compiled code is loaded once
        serial = _timed(lambda: (judge_log(log, job) for log in logs))
        parallel = _timed(lambda: audit_fleet(logs, job))
    wall_s, processor_s, _ = serial
    together_s, of_all_s, first_s = parallel
    kind = f"{options.minutes:g} min, {len(_SURFACES)} surfaces, {options.rate_hz:g} Hz, .{options.format}"
    print(f"{len(logs)} logs of {kind}")
    print(f"one by one: {wall_s:.1f} s, processor {processor_s:.1f} s")
    print(f"{cores()} processes: {together_s:.1f} s, processor {of_all_s:.1f} s, first result after {first_s:.1f} s")
    print(f"efficiency by wall clock {wall_s / together_s / cores():.2f}, by processor {processor_s / of_all_s:.2f}")
    print(f"load of the machine: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")


def _write(folder: Path, options: argparse.Namespace) -> None:
    plane = plain_aircraft(_SURFACES, "hs225bb-eq31")
    folder.mkdir(parents=True, exist_ok=True)
    for seed in range(options.logs):
        target = folder / f"flight{seed:04d}.{options.format}"
        if target.exists():
            continue
        faults = {"rudder": Stuck(30.0 * options.minutes)} if seed % _EVERY == 0 else {}
        flown = simulate_flight(
            plane,
            duration_s=60.0 * options.minutes,
            rate_hz=options.rate_hz,
            seed=seed,
            faults=faults,
            outputs=outputs_of(plane) if options.format == "bin" else (),
        )
        write_flight(target, flown, plane)


def _timed(work: Callable[[], Iterable[JudgedLog]]) -> tuple[float, float, float]:
    """Wall-clock time, processor time of this process and its children, and time to the first result [s]."""
    begin_s, used_s, first_s = time.perf_counter(), _processor_s(), 0.0
    for _ in work():
        first_s = first_s or time.perf_counter() - begin_s
    return time.perf_counter() - begin_s, _processor_s() - used_s, first_s


def _processor_s() -> float:
    whole = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(usage.ru_utime + usage.ru_stime for usage in whole)


if __name__ == "__main__":
    main()
