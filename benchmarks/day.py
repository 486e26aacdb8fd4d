"""A day through audit and monitor: processor time, memory, open files, false alarms, and clocks that overflow.

``python benchmarks/day.py [HOURS] [AUDIT_HZ] [MONITOR_HZ]`` (24, 50, 10). A healthy flight of that length is audited as
a table (two surfaces) and as telemetry (one), and the telemetry is replayed through the monitor as fast as it goes. Its
32-bit clocks overflow: microseconds every 71.6 minutes, milliseconds in the middle of the day. Each part runs in a
process of its own.
"""

from __future__ import annotations

import gc
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

import logparsers
from logparsers.codec import Codec
from logparsers.telemetry.encode import encode
from servofd import audit
from servofd.aircraft.schema import plain_aircraft
from servofd.feedback.draft import draft_aircraft
from servofd.live.run import Pace, replay_telemetry
from servofd.live.session import Session
from servofd.simulation.flight import simulate_flight
from servofd.simulation.pulses import outputs_of
from servofd.simulation.telemetry_writer import telemetry_messages
from servofd.simulation.writers import write_flight

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from servofd.detection.event import Event

NOISE_DEG = 0.1
_WRAP = 2**32


def resident_mb() -> float:
    """Memory that the process holds [MB]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


def open_files() -> int:
    return len(os.listdir("/proc/self/fd")) - 1  # noqa: PTH208 - without the one that this opens


def telemetry(hours: float, rate_hz: float) -> bytes:
    """A day on the link of an autopilot that was booted so long ago that its milliseconds overflow at half time."""
    plane = plain_aircraft(["elevator"], "hs225bb-eq31")
    flown = simulate_flight(
        plane, duration_s=3600.0 * hours, rate_hz=rate_hz, seed=7, noise_deg=NOISE_DEG, outputs=outputs_of(plane)
    )
    ahead_ms = _WRAP - round(1.8e6 * hours)
    shifts = {"time_boot_ms": ahead_ms, "time_usec": 1000 * ahead_ms}
    shifted = []
    for message in telemetry_messages(flown, plane):
        columns = {
            name: (np.asarray(values, np.int64) + shifts[name]) % _WRAP if name in shifts else values
            for name, values in message.columns.items()
        }
        shifted.append(replace(message, columns=columns))
    return encode(shifted)


class Hours:
    """Notes what the monitor tells, and looks at the process once an hour of the log."""

    def __init__(self) -> None:
        self.told: list[str] = []
        self.resident_mb: list[int] = []
        self._next_s = float("-inf")

    def events(self, events: list[Event]) -> None:
        """Note them."""
        self.told += [f"{e.time_s:.1f} s: {e.event} {e.kind} {e.text}".strip() for e in events]

    def tick(self, now_s: float) -> None:
        """Look, if it is time."""
        if now_s >= self._next_s:
            self._next_s = now_s + 3600.0
            gc.collect()
            self.resident_mb.append(round(resident_mb()))


def table_audit(folder: Path) -> dict[str, Any]:
    return _audited(folder / "day.csv")


def telemetry_audit(folder: Path) -> dict[str, Any]:
    return _audited(folder / "day.tlog")


def _audited(path: Path) -> dict[str, Any]:
    before_mb = resident_mb()
    (found,) = audit(path)
    log = logparsers.read(path)
    return {
        "log_h": log.duration_s / 3600.0,
        "damage": [damage.note for damage in log.damage],
        "status": {surface.surface: surface.status for surface in found.surfaces},
        "faults": sum(len(surface.faults) for surface in found.surfaces),
        "grown_mb": round(resident_mb() - before_mb),
    }


def telemetry_monitor(folder: Path) -> dict[str, Any]:
    """Replay as fast as it goes; the last position must come a day after the first."""
    path = folder / "day.tlog"
    log = logparsers.read(path)
    aircraft = draft_aircraft(log)
    begun_s, ended_s = log.span_s or (0.0, 0.0)
    del log
    gc.collect()
    session, watcher, before = Session(Codec(0, 191), {0: aircraft}), Hours(), open_files()
    now_s = replay_telemetry(session, path, watcher, Pace(0.0), float("inf"))
    watcher.events(session.finish(now_s))
    ((vehicle, monitor),) = session.watched
    return {
        "frames": session.frames,
        "log_h": (ended_s - begun_s) / 3600.0,
        "clock_off_ms": round(1e3 * (vehicle.now_s - ended_s), 3),
        "judged": monitor.was_judged,
        "alarms": sum(": alarm" in line for line in watcher.told),
        "told": watcher.told[:8],
        "resident_mb": watcher.resident_mb,
        "files": open_files() - before,
    }


PARTS: Mapping[str, Callable[[Path], dict[str, Any]]] = MappingProxyType(
    {part.__name__: part for part in (table_audit, telemetry_audit, telemetry_monitor)}
)


def part(name: str, folder: str) -> None:
    """Do one part in this process, and print what it took."""
    begun_s = time.process_time()
    result = PARTS[name](Path(folder))
    result["cpu_s"] = round(time.process_time() - begun_s, 1)
    result["peak_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
    print(json.dumps(result))


def main() -> None:
    if sys.argv[1:2] == ["--part"]:
        part(*sys.argv[2:])
        return
    hours, audit_hz, monitor_hz = (*map(float, sys.argv[1:]), *(24.0, 50.0, 10.0)[len(sys.argv) - 1 :])
    with tempfile.TemporaryDirectory() as folder:
        plane = plain_aircraft(["elevator", "rudder"], "hs225bb-eq31")
        flown = simulate_flight(plane, duration_s=3600.0 * hours, rate_hz=audit_hz, seed=7, noise_deg=NOISE_DEG)
        write_flight(Path(folder) / "day.csv", flown, plane)
        del flown
        Path(folder, "day.tlog").write_bytes(telemetry(hours, monitor_hz))
        for file in sorted(Path(folder).iterdir()):
            print(f"{file.name}: {file.stat().st_size / 1e6:.0f} MB", flush=True)
        for name in PARTS:
            command = [sys.executable, __file__, "--part", name, folder]
            done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
            print(f"{name}: {done.stdout.strip() or f'exit code {done.returncode}'}", flush=True)


if __name__ == "__main__":
    main()
