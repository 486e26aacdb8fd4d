"""How often the 95 % intervals of identify, calibrate and trend hold the truth, on servos with more physics.

Logs are those of ``hidden_physics``: motor, loop and linkage in steps of 0.1 ms, poles, delay, gain and offset drawn,
and in most of them something that the model lacks. Of a servo whose sensor lags the bandwidth is that of both, and its
delay is not counted. Trend follows a servo that was calibrated, and the truth is how it changed since.
Even seeds choose constants, odd ones report.

    python benchmarks/intervals.py identify 3001:3209:2        # FIRST:LAST:STEP, of `identify` or `calibrate`

Printed per number: intervals that hold the truth, and half of their median width.
"""

from __future__ import annotations

import sys
import time
from collections import defaultdict
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from hidden_physics import Effects, draw, hidden
from servofd.aircraft.schema import plain_aircraft
from servofd.aircraft.series import Series
from servofd.calibrating.calibrate import calibrate_aircraft
from servofd.core.errors import ServofdError
from servofd.detection.flights import Flight
from servofd.identification.identify import identify
from servofd.servo.library import servo_named
from servofd.wear.estimate import estimate_flight

if TYPE_CHECKING:
    from collections.abc import Iterator

    from servofd.core.statistics import Estimate

KINDS = (
    "none", "friction", "lugre_friction", "backlash", "deadband", "hard_deadband", "rate_limit", "cyclic_error",
    "coloured_noise", "stamp_jitter", "sensor_lag", "bearing_load", "set_point_speed",
)  # fmt: skip
_TYPE = "hs225bb-eq31"
_Said = tuple[str, "Estimate", float]


def bandwidth_rad_s(scale: float, lag_s: float) -> float:
    """-3 dB of Eq. 3.1 with its poles scaled, and of a sensor behind it."""
    frequency = np.linspace(1.0, 200.0, 40_000)
    poles = scale * servo_named(_TYPE).transfer.poles_rad_s
    gain = np.abs(np.prod(-poles) / np.prod(1j * frequency[:, None] - poles, axis=1) / (1.0 + 1j * frequency * lag_s))
    return float(frequency[np.argmax(gain < np.sqrt(0.5))])


def said(verb: str, seed: int) -> Iterator[_Said]:
    """Name of a number, its estimate, and the truth."""
    rng = np.random.default_rng([seed, 77])
    kind, level = KINDS[seed // 2 % len(KINDS)], str(rng.choice(["small", "medium"]))
    lacks: Effects = {} if kind == "none" else {kind: draw(rng, kind, level)}
    lag_s = lacks.get("sensor_lag", {}).get("time_constant_s", 0.0)
    scale, delay_s, gain, bias_deg = rng.uniform(0.7, 1.4), rng.uniform(0.002, 0.03), rng.uniform(0.9, 1.1), 0.0
    noise_deg = float(rng.choice([0.03, 0.1, 0.2]))

    def log(seed: int, excitation: str, duration_s: float) -> Series:
        own = {
            "slow_dynamics": {"bandwidth_scale": scale}, "delay": {"delay_s": delay_s}, "gain": {"gain": gain},
            "bias": {"bias_deg": bias_deg},
        }  # fmt: skip
        it = hidden(seed, {**lacks, **own}, excitation, noise_deg, duration_s)
        return Series("x", it.time_s, it.command_deg, it.time_s, it.measured_deg)

    if verb == "identify":
        found = identify(log(seed, "chirp", 60.0)).intervals
        yield "bandwidth", found["bandwidth_rad_s"], bandwidth_rad_s(scale, lag_s)
        yield "gain", found["dc_gain"], gain
        if not lag_s:
            yield "delay", found["delay_s"], delay_s
        return
    flight = Flight("good.csv", log(seed, "flight", 120.0))
    plane = calibrate_aircraft(plain_aircraft(["x"], _TYPE), {"x": [flight]}, force=True)
    (one,) = plane.surfaces
    known = bandwidth_rad_s(scale, lag_s), delay_s, gain
    yield "bandwidth", one.bandwidth_rad_s, known[0]
    if not lag_s:
        yield "delay", one.estimates["delay_s"], delay_s
    scale, delay_s = scale * rng.normal(1.0, 0.08), max(rng.normal(delay_s, 0.004), 0.0)
    gain, bias_deg = gain * rng.normal(1.0, 0.02), rng.normal(0.0, 0.3)
    later = log(seed + 5000, "flight", 60.0)
    by, shift_deg = one.measured.correction
    later = replace(later, measured_deg=by * later.measured_deg + shift_deg)
    values, *_ = estimate_flight(later, plane.aircraft)
    truths = {
        "bandwidth_hz": one.bandwidth_rad_s.value / (2.0 * np.pi) * bandwidth_rad_s(scale, lag_s) / known[0],
        "delay_s": one.estimates["delay_s"].value + delay_s - known[1],
        "gain": gain / known[2],
        "bias_deg": bias_deg / known[2],
    }
    for name in set(truths) & set(values):
        yield f"trend {name}", values[name], truths[name]


def main() -> None:
    """Print a table of one verb."""
    verb, seeds = sys.argv[1], range(*(int(part) for part in sys.argv[2].split(":")))
    held: dict[str, list[tuple[bool, float]]] = defaultdict(list)
    begun, refused = time.process_time(), 0
    for seed in seeds:
        try:
            for name, estimate, truth in said(verb, seed):
                held[name].append((estimate.low <= truth <= estimate.high, 0.5 * (estimate.high - estimate.low)))
        except ServofdError:
            refused += 1
    print(f"{verb}, {len(seeds)} logs, {refused} refused, {time.process_time() - begun:.0f} s of processor time")
    for name, each in sorted(held.items()):
        inside, wide = zip(*each, strict=True)
        print(f"{name:18} {sum(inside):3} of {len(each):3}   ± {np.median(wide):.3g}")


if __name__ == "__main__":
    main()
