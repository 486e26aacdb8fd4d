"""Whether `detectable` is true: faults of the stated size, and of half of it, put into the very logs that stated it.

``python benchmarks/detectable.py [--seeds FIRST LAST] [--seconds S] [--model fitted|named]`` prints, for each kind, the
share of the logs in which the fault was seen: it should be 90 to 99 % at the stated size and below 60 % at half of it.
``fitted``: flights of `strangers`, the servo fitted to the log with the fault in it; ``named``: servos of the library.
Faults are put into the measured position, by formulas of this file; those of a fitted servo set in during the second
quarter. Constants were chosen on even seeds; odd ones, the default, are reported.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from strangers import STYLES, SURFACES, fly, stranger

from logparsers.records import Channel, FlightLog
from servofd.aircraft.schema import plain_aircraft
from servofd.detection.audit import audit_log
from servofd.feedback.fitted import fitted_aircraft
from servofd.servo.library import library
from servofd.simulation.flight import simulate_flight

if TYPE_CHECKING:
    from servofd.core.types import FloatArray
    from servofd.detection.verdict import SurfaceAudit

_FLIGHT_S = 90.0
_KINDS = ("bias_deg", "loss_share", "oscillation_deg", "deadband_deg", "slow_share")
_OSCILLATES_HZ = 3.0


def healthy_log(seed: int, model: str) -> FlightLog:
    """One surface of one flight; by turns all styles, surfaces and servos."""
    draw = seed // 2
    if model == "fitted":
        flown = fly(stranger(seed), 1, STYLES[draw % len(STYLES)], duration_s=_FLIGHT_S)
        index = draw % len(SURFACES)
        known = np.isfinite(flown.position_deg[:, index])
        series = (
            flown.command_s,
            flown.command_deg[:, index],
            flown.position_s[known],
            flown.position_deg[known, index],
        )
    else:
        names = tuple(library())
        plane = plain_aircraft(["x"], names[draw % len(names)])
        asked = ("flight", "gusty", "hand_flown")[draw % 3]
        simulated = simulate_flight(plane, command=asked, duration_s=_FLIGHT_S, rate_hz=50.0, seed=seed, noise_deg=0.1)
        series = (simulated.time_s, simulated.command_deg[:, 0], simulated.time_s, simulated.measured_deg[:, 0])
    command_s, command_deg, position_s, position_deg = series
    channels = {
        "x_cmd_deg": Channel("x_cmd_deg", command_s, command_deg, "deg", ""),
        "x_pos_deg": Channel("x_pos_deg", position_s, position_deg, "deg", ""),
    }
    return FlightLog(Path(f"{seed}.csv"), "table", channels)


def verdict_on(log: FlightLog, seed: int, model: str) -> tuple[SurfaceAudit, float]:
    """The verdict, and the lag of the model [s]."""
    if model == "fitted":
        plane = fitted_aircraft(log, plain_aircraft(["x"]))
    else:
        names = tuple(library())
        plain = plain_aircraft(["x"], names[(seed // 2) % len(names)])
        surface = plain.surfaces["x"].model_copy(update={"threshold": "interval"})
        plane = plain.model_copy(update={"surfaces": {"x": surface}})
    lag_s = float(np.sum(-1.0 / plane.model("x").transfer.poles_rad_s).real)
    return audit_log(log, plane, threads=1).surfaces[0], lag_s


def with_fault(
    log: FlightLog, kind: str, size: float, found: SurfaceAudit, lag_s: float, seed: int, earliest: float
) -> FlightLog:
    """The log with a fault of a size that sets in between this share of it and its half."""
    rng = np.random.default_rng([75, seed])
    position = log["x_pos_deg"]
    time_s, measured = position.time_s, position.values
    onset_s = float(time_s[0] + rng.uniform(earliest, 0.5) * (time_s[-1] - time_s[0]))
    sign = float(rng.choice([-1.0, 1.0]))
    if kind == "bias_deg":
        broken = measured + sign * size
    elif kind == "loss_share":
        broken = (1.0 - size) * measured
    elif kind == "oscillation_deg":
        broken = measured + size * np.sin(2.0 * np.pi * _OSCILLATES_HZ * time_s)
    else:
        residuals = found.residuals
        ideal = measured if residuals is None else np.interp(time_s, residuals.time_s, residuals.simulated_deg)
        moved = _loose(ideal, size) if kind == "deadband_deg" else _slow(time_s, ideal, lag_s * (1.0 / size - 1.0))
        broken = measured + moved - ideal
    values = np.where(time_s >= onset_s, broken, measured)
    return replace(log, channels={**log.channels, position.name: replace(position, values=values)})


def _loose(ideal: FloatArray, width: float) -> FloatArray:
    moved, at = np.empty_like(ideal), float(ideal[0])
    for k, value in enumerate(ideal.tolist()):
        at = min(value + 0.5 * width, max(value - 0.5 * width, at))
        moved[k] = at
    return moved


def _slow(time_s: FloatArray, ideal: FloatArray, lag_s: float) -> FloatArray:
    moved, at = np.empty_like(ideal), float(ideal[0])
    for k in range(ideal.size):
        at += (1.0 - np.exp(-(time_s[k] - time_s[max(k - 1, 0)]) / lag_s)) * (ideal[k] - at)
        moved[k] = at
    return moved


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", nargs=2, type=int, default=[1, 401], metavar=("FIRST", "LAST"))
    parser.add_argument("--seconds", type=float, default=240.0, help="end after so long")
    parser.add_argument("--model", choices=["fitted", "named"], default="named")
    options = parser.parse_args()
    tried: Counter[tuple[str, str, float]] = Counter()
    seen: Counter[tuple[str, str, float]] = Counter()
    started_s = time.monotonic()
    seed, earliest = options.seeds[0], 0.25 if options.model == "fitted" else 0.0
    for seed in range(options.seeds[0], options.seeds[1], 2):
        if time.monotonic() - started_s > options.seconds:
            break
        log = healthy_log(seed, options.model)
        good, lag_s = verdict_on(log, seed, options.model)
        if good.status not in ("healthy", "unknown"):
            continue
        for kind, size in good.detectable.document().items():
            if size is None:
                continue
            for share in (1.0, 0.5):
                part = 1.0 - share * (1.0 - size) if kind == "slow_share" else share * size
                verdict, _ = verdict_on(with_fault(log, kind, part, good, lag_s, seed, earliest), seed, options.model)
                tried[good.status, kind, share] += 1
                seen[good.status, kind, share] += verdict.status in ("fault", "suspect")
                print(f"{seed}, {good.status}, {kind} {part:.2g}: {verdict.status}", flush=True)
    print(f"{options.model}: seeds {options.seeds[0]} to {seed}")
    for status in ("healthy", "unknown"):
        for kind in _KINDS:
            found = (f"at {k} of it {seen[status, kind, k]}/{tried[status, kind, k]}" for k in (1.0, 0.5))
            print(f"{status}, {kind}:", ", ".join(found))


if __name__ == "__main__":
    main()
