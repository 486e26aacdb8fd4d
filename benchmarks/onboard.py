"""What the script on board costs: instructions of Lua's machine in its longest call, and memory.

``python benchmarks/onboard.py [SOURCES]``: real Lua 5.3 runs scripts of one to twelve surfaces through eight seconds of
sticks at their ends, one servo jammed, in which glitches are sorted out. ArduPilot gives a call 10 000 instructions and
a script what is left of SCR_HEAP_SIZE. Its Lua has numbers and pointers of 32 bits: with the SOURCES of Lua 5.3, in a
folder, the least heap is told with which such a one starts the script (``onboard_heap.c``, built by ``gcc -m32``);
without, what lupa's Lua of 64 bits holds in flight.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from servofd.aircraft.schema import Aircraft
from servofd.onboard.plan import plan_onboard
from servofd.onboard.script import watch_script
from tests.onboard.autopilot import Flight, fly

LIMITED = 250.0
SERVOS: dict[str, dict[str, object]] = {
    "one pole": {"numerator": [20.0], "denominator": [1.0, 20.0]},
    "two poles": {"bandwidth_hz": 4.5, "damping": 0.7},
    "three poles": {"numerator": [122300.0], "denominator": [1.0, 94.88, 6660.7936, 122237.64]},
}


def aircraft(count: int, servo: dict[str, object], *, limited: bool) -> Aircraft:
    """So many surfaces, each with a servo of its own that hardly differs, calibrated."""
    surfaces = {
        f"surface_{k}": {
            "servo": f"it_{k}",
            "threshold": "interval",
            "tolerance": {"noise_deg": 0.1 + 0.01 * k},
            "command": {"channel": f"RCOU.C{k}", "unit": "us", "slope_deg_per_us": 0.09},
            "measured": {"channel": f"CSRV[{k - 1}].Pos", "unit": "deg"},
        }
        for k in range(1, count + 1)
    }
    known = {"title": "it", "delay_s": 0.02, "hold": "zoh", "source": "benchmark", **servo}
    if limited:
        known["rate_limit_deg_s"] = LIMITED
    servos = {f"it_{k}": known | {"delay_s": 0.02 + 1e-4 * k} for k in range(1, count + 1)}
    return Aircraft.model_validate({"surfaces": surfaces, "servos": servos})


def flight_of(plane: Aircraft, period_us: int) -> Flight:
    """Sticks at their ends; the first servo is jammed, and positions jump away and back now and then."""
    time_us = 5_000_000 + np.arange(0, 8_000_000, period_us)
    time_s, rng = time_us / 1e6, np.random.default_rng(1)
    pulses, positions = {}, {}
    for k, (name, surface) in enumerate(plane.surfaces.items(), 1):
        pulses[k] = np.round(1500.0 + 450.0 * np.sign(np.sin(5.0 * time_s)) * (time_s > time_s[0] + 1.0))
        moved_deg = plane.model(name).simulate(time_s, surface.command.to_deg(pulses[k]), time_s)
        moved_deg = moved_deg + 0.1 * rng.normal(size=time_s.size) + 60.0 * (rng.random(time_s.size) < 0.01)
        positions[k] = np.zeros(time_s.size) if k == 1 else moved_deg
    return Flight(time_us, pulses, positions, armed=True)


def built(sources: Path, folder: Path) -> Path:
    """Build the program that measures the heap, with Lua's sources."""
    parts = [part for part in sources.glob("*.c") if part.stem not in ("lua", "luac", "ltests", "onelua")]
    own, host = Path(__file__).with_name("onboard_heap.c"), folder / "heap"
    flags = ("-m32", "-DLUA_32BITS", "-w", "-I", sources)
    subprocess.run(["gcc", *flags, *parts, own, "-lm", "-o", host], check=True)  # noqa: S607 - whichever is there
    return host


def least_heap_kb(host: Path, script: str, folder: Path) -> float:
    """With which a script starts [kB]."""
    path = folder / "script.lua"
    path.write_text(script)
    return float(subprocess.run([host, path], capture_output=True, text=True, check=True).stdout) / 1e3


def main() -> None:
    print(f"heap with {'32 bits, to start' if len(sys.argv) > 1 else '64 bits, in flight'}")
    print("surfaces  servo        rate limit  calls a period  instructions  foreseen  heap [kB]  script [kB]")
    with tempfile.TemporaryDirectory() as folder:
        host = built(Path(sys.argv[1]), Path(folder)) if len(sys.argv) > 1 else None
        for count in (1, 3, 6, 12):
            for name, servo in SERVOS.items():
                for limited in (False, True):
                    plane = aircraft(count, servo, limited=limited)
                    plan = plan_onboard(plane)
                    script = watch_script(plan)
                    flight = flight_of(plane, 1000 * plan.period_ms // plan.turns)
                    flown = fly(script, flight, Path(folder), counted=True)
                    heap = least_heap_kb(host, script, Path(folder)) if host else flown.heap_kb
                    print(
                        f"{count:8}  {name:12} {'yes' if limited else 'no':10}  {plan.turns:14}"
                        f"  {flown.most_instructions:12}  {plan.instructions:8}  {heap:9.1f}"
                        f"  {len(script) / 1e3:11.1f}"
                    )


if __name__ == "__main__":
    main()
