"""How often the 95 % intervals of calibrate, identify and trend hold the truth, per parameter.

Servos are those of ``fleet``, simulated in small steps with a rate limiter of their own: gains, delays, poles and
offsets as servos of one make differ, noise, converters, jitter and losses. Even seeds choose constants, odd ones
report.

    python benchmarks/intervals.py trend 0:60:2        # FIRST:LAST:STEP, of `trend`, `identify` or `calibrate`

Printed per parameter: intervals that hold the truth, and the root mean square of (value - truth) over the deviation,
which is 1 where intervals are as wide as they should be.
"""

from __future__ import annotations

import sys
import time
from collections import defaultdict
from typing import TYPE_CHECKING

import numpy as np

from fleet import FleetServo, Truth, deflection
from servofd.aircraft.schema import plain_aircraft
from servofd.aircraft.series import Series
from servofd.calibrating.calibrate import calibrate_surface
from servofd.core.errors import ServofdError
from servofd.detection.flights import Flight
from servofd.identification.identify import identify
from servofd.simulation.commands import COMMANDS
from servofd.wear.estimate import estimate_flight
from trend_fleets import drawn_servo

if TYPE_CHECKING:
    from collections.abc import Iterator

    from servofd.core.statistics import Estimate

_RATE_HZ, _STYLES = 100.0, ("flight", "gusty", "hand_flown")
_NAMED = "hs225bb-eq31"
_POLES = np.array([-24.84, -35.02 + 60.78j, -35.02 - 60.78j])


def bandwidth_rad_s(scale: float) -> float:
    """-3 dB of thesis Eq. 3.1 with its poles scaled."""
    frequency = np.linspace(1.0, 200.0, 200_000)
    gain = np.abs(np.prod(_POLES) / np.prod(1j * frequency[:, None] - _POLES, axis=1))
    return scale * float(frequency[np.argmax(gain < np.sqrt(0.5))])


def flown(servo: FleetServo, style: str, rng: np.random.Generator, width_deg: float, duration_s: float) -> Series:
    """A record of one servo."""
    grid_s = np.arange(round(duration_s * _RATE_HZ)) / _RATE_HZ
    command_deg = COMMANDS[style](grid_s, rng)
    time_s = np.maximum(grid_s + rng.uniform(-servo.jitter_s, servo.jitter_s, grid_s.size), 0.0)
    truth = Truth("deadband", "", 0.0, {"width_deg": width_deg}, 0.0) if width_deg > 0.0 else None
    read_deg = deflection(servo, time_s, command_deg, truth) + servo.bias_deg
    read_deg = read_deg + servo.noise_deg * rng.standard_normal(grid_s.size)
    read_deg = servo.step_deg * np.round(read_deg / servo.step_deg)
    kept = (rng.random(grid_s.size) >= servo.loss) & (np.diff(time_s, prepend=-1.0) > 0.0)
    return Series("rudder", time_s[kept], command_deg[kept], time_s[kept], read_deg[kept])


def rows(verb: str, seed: int) -> Iterator[tuple[str, Estimate, float]]:
    """Parameter, what was said of it, and the truth."""
    rng = np.random.default_rng([seed, 41])
    servo = drawn_servo(rng)
    width_deg = float(rng.choice([0.0, rng.uniform(0.2, 1.5)]))
    noise_deg = float(np.hypot(servo.noise_deg, servo.step_deg / np.sqrt(12.0)))
    bandwidth = bandwidth_rad_s(servo.bandwidth_scale)
    lag_s = servo.delay_s + float(np.sum(-1.0 / _POLES).real) / servo.bandwidth_scale
    plane = plain_aircraft(["rudder"], _NAMED)
    if verb == "identify":
        servo = servo._replace(loss=0.0)  # the recorder of a bench loses nothing
        found = identify(flown(servo, "chirp", rng, 0.0, 120.0)).intervals
        truths = {"dc_gain": servo.gain, "bandwidth_rad_s": bandwidth, "delay_s": servo.delay_s, "lag_s": lag_s}
    elif verb == "trend":
        series = flown(servo, str(rng.choice(_STYLES)), rng, width_deg, 90.0)
        found = estimate_flight(series, plane).values
        truths = {
            "dead_band_deg": width_deg,
            "bias_deg": servo.bias_deg,
            "gain": servo.gain,
            "delay_s": servo.delay_s,
            "bandwidth_hz": bandwidth / (2.0 * np.pi),
            "noise_deg": noise_deg,
        }
    else:
        flights = [Flight(f"{k}.csv", flown(servo, style, rng, width_deg, 120.0)) for k, style in enumerate(_STYLES)]
        one = calibrate_surface(flights, plane)
        found = {**one.estimates, "bandwidth_rad_s": one.bandwidth_rad_s}
        truths = {"bandwidth_rad_s": bandwidth}  # gain and offset are in the calibration of the position by then
        if width_deg:
            truths["deadband_deg"] = width_deg
    for name, truth in truths.items():
        if name in found:
            yield name, found[name], truth


def main() -> None:
    """Print a table of one verb."""
    verb, seeds = sys.argv[1], range(*(int(part) for part in sys.argv[2].split(":")))
    held: dict[str, list[tuple[bool, float]]] = defaultdict(list)
    begun = time.process_time()
    for seed in seeds:
        try:
            for name, said, truth in rows(verb, seed):
                deviation = max(said.high - said.low, 1e-12) / 3.92
                held[name].append((said.low <= truth <= said.high, (said.value - truth) / deviation))
                if "-v" in sys.argv:
                    print(seed, name, f"{said.value:.5g} [{said.low:.5g}, {said.high:.5g}]  {truth:.5g}")
        except ServofdError as error:
            print(f"seed {seed}: {error}")
    print(f"{verb}, {len(seeds)} seeds, {time.process_time() - begun:.0f} s of processor time")
    for name, each in held.items():
        inside, far = zip(*each, strict=True)
        print(f"{name:18} {sum(inside):3} of {len(each):3}  rms {np.sqrt(np.mean(np.square(far))):.2f}")


if __name__ == "__main__":
    main()
