"""Trends of servos with known truth: wear found and forecast, healthy fleets left in peace, swaps recognised.

Servos, jitter, losses and converters are those of ``fleet``, whose simulator has nothing in common with servofd's. From
flight to flight a servo's bandwidth, delay and bias vary as supply and temperature do, and the style of flying changes.

    python benchmarks/trend_fleets.py --fleets 100 --servos 3 --flights 20
"""

from __future__ import annotations

import argparse
import functools
import time
from typing import TYPE_CHECKING

import numpy as np

from fleet import FleetServo, Truth, deflection
from servofd.aircraft.schema import plain_aircraft
from servofd.aircraft.series import Series
from servofd.simulation.commands import COMMANDS
from servofd.wear.estimate import estimate_flight
from servofd.wear.trend import FlownLog, trend_of

if TYPE_CHECKING:
    from servofd.wear.estimate import ServoEstimate
    from servofd.wear.trend import AircraftTrend

__all__ = ["crossing_at", "drawn_servo", "followed", "widths_trend"]

_RATE_HZ = 100.0
_STYLES = ("flight", "gusty", "hand_flown")
_BANDWIDTH, _DELAY_S, _BIAS_DEG = 0.005, 0.0002, 0.01
"""Standard deviations from flight to flight: half a per cent, 0.2 ms, a hundredth of a degree."""


def drawn_servo(rng: np.random.Generator) -> FleetServo:
    """A servo with production scatter and cheap telemetry."""
    return FleetServo(
        gain=rng.uniform(0.97, 1.03),
        delay_s=0.004 + rng.uniform(-0.003, 0.003),
        bandwidth_scale=rng.uniform(0.9, 1.1),
        bias_deg=rng.uniform(-0.3, 0.3),
        noise_deg=rng.uniform(0.05, 0.2),
        step_deg=180.0 / float(rng.choice([4096, 1024])),
        jitter_s=0.002,
        loss=rng.uniform(0.02, 0.05),
    )


def segment(surface: str, servo: FleetServo, rng: np.random.Generator, width_deg: float, duration_s: float) -> Series:
    """One flight of a servo with a dead band from its first second on."""
    flown = servo._replace(
        delay_s=max(servo.delay_s + _DELAY_S * rng.standard_normal(), 0.0),
        bandwidth_scale=servo.bandwidth_scale * (1.0 + _BANDWIDTH * rng.standard_normal()),
        bias_deg=servo.bias_deg + _BIAS_DEG * rng.standard_normal(),
    )
    grid_s = np.arange(round(duration_s * _RATE_HZ)) / _RATE_HZ
    command_deg = COMMANDS[str(rng.choice(_STYLES))](grid_s, rng)
    time_s = np.maximum(grid_s + rng.uniform(-flown.jitter_s, flown.jitter_s, grid_s.size), 0.0)
    truth = Truth("deadband", "", 0.5, {"width_deg": width_deg}, 0.0) if width_deg > 0.0 else None
    read_deg = deflection(flown, time_s, command_deg, truth) + flown.bias_deg
    read_deg = read_deg + flown.noise_deg * rng.standard_normal(grid_s.size)
    read_deg = flown.step_deg * np.round(read_deg / flown.step_deg)
    kept = (rng.random(grid_s.size) >= flown.loss) & (np.diff(time_s, prepend=-1.0) > 0.0)
    return Series(surface, time_s[kept], command_deg[kept], time_s[kept], read_deg[kept])


@functools.cache
def _told(
    surface: str, servo: FleetServo, seed: tuple[int, int, int], width_deg: float, duration_s: float
) -> ServoEstimate:
    """What one flight shows; a trend cut short shares its flights with the whole one."""
    flown = segment(surface, servo, np.random.default_rng(seed), width_deg, duration_s)
    return estimate_flight(flown, plain_aircraft([surface], "hs225bb-eq31"))


def followed(fleet: dict[str, list[tuple[FleetServo, float]]], seed: int, duration_s: float) -> AircraftTrend:
    """Trend of an aircraft: for each surface a servo and a width per flight."""
    plane = plain_aircraft(fleet, "hs225bb-eq31")
    logs = []
    for number, row in enumerate(zip(*fleet.values(), strict=True), start=1):
        flights = {}
        for index, (surface, (servo, width_deg)) in enumerate(zip(fleet, row, strict=True)):
            flights[surface] = _told(surface, servo, (seed, number, index), width_deg, duration_s)
        logs.append(FlownLog(f"flight{number}.csv", "", None, "", flights, ()))
    return trend_of(logs, plane)


def widths_trend(
    seed: int, widths_deg: list[float], swap: int | None = None, duration_s: float = 60.0
) -> AircraftTrend:
    """Trend of one servo with these dead bands; from flight `swap` on it is another one."""
    rng = np.random.default_rng([seed, 7])
    servos = [drawn_servo(rng), drawn_servo(rng)]
    flights = [
        (servos[swap is not None and number >= swap], width_deg) for number, width_deg in enumerate(widths_deg, start=1)
    ]
    return followed({"rudder": flights}, seed, duration_s)


def crossing_at(seen: AircraftTrend) -> float | None:
    """Flight at which the dead band is forecast to cross its limit."""
    return seen.surfaces[0].quantities["dead_band_deg"].forecast.flight


def healthy_fleet(seed: int, servos: int, flights: int, duration_s: float) -> AircraftTrend:
    """Trend of an aircraft on which nothing changes."""
    rng = np.random.default_rng([seed, 11])
    fleet = {f"surface_{k}": [(drawn_servo(rng), 0.0)] * flights for k in range(servos)}
    return followed(fleet, seed, duration_s)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--fleets", type=int, default=100)
    parser.add_argument("--servos", type=int, default=3)
    parser.add_argument("--flights", type=int, default=20)
    parser.add_argument("--duration", type=float, default=20.0)
    parser.add_argument("--worn", type=int, default=10, help="servos whose dead band grows by 0.02 deg per flight")
    options = parser.parse_args()
    start_s = time.process_time()
    if options.worn:
        _measure_wear(options.worn)
    if options.fleets:
        _count_alarms(options)
    print(f"{time.process_time() - start_s:.0f} s of processor time")


def _measure_wear(servos: int) -> None:
    slopes, crossings, covered, swaps = [], [], 0, 0
    for seed in range(servos):
        grown = [0.02 * number for number in range(1, 41)]
        slope = widths_trend(seed, grown).surfaces[0].quantities["dead_band_deg"].slope
        slopes.append(slope.value if slope else np.nan)
        early = widths_trend(seed, grown[:25]).surfaces[0].quantities["dead_band_deg"].forecast
        crossings.append(np.nan if early.flight is None else early.flight)
        covered += early.low is not None and early.high is not None and early.low <= 100.0 <= early.high
        events = widths_trend(seed, [*grown[:25], *grown[:15]], swap=26).surfaces[0].events
        swaps += [(event.kind, event.first) for event in events] == [("swap", 26)]
    print(f"slope of 0.02 deg per flight, 40 flights: worst {np.max(np.abs(np.array(slopes) / 0.02 - 1.0)):.1%}")
    print(f"crossing at flight 100, told at flight 25: worst {np.max(np.abs(np.array(crossings) - 100.0)):.1f} flights")
    print(f"interval holds it: {covered} of {servos}; swaps recognised, none invented: {swaps} of {servos}")


def _count_alarms(options: argparse.Namespace) -> None:
    alarms, told = 0, 0
    for seed in range(options.fleets):
        seen = healthy_fleet(seed, options.servos, options.flights, options.duration)
        alarms += seen.has_alarm
        told += sum(len(surface.events) for surface in seen.surfaces)
    print(
        f"{options.fleets} healthy fleets of {options.servos} servos, {options.flights} flights of "
        f"{options.duration:g} s: {alarms} alarms, {told} changes told"
    )


if __name__ == "__main__":
    main()
