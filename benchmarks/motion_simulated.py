"""False alarms, faults and intervals of axes on simulated aeroplanes of another structure than their models.

``python benchmarks/motion_simulated.py [FLIGHTS [CALIBRATIONS]]``: calibrated on eight flights of four days, then
judged on healthy flights of other days, each with its own load, trim and turbulence, and on flights with a fault from
60 s on. With CALIBRATIONS on other flights, the false alarms after each are counted: what one foretells is a matter of
chance.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from logparsers.records import Channel, FlightLog
from servofd.aircraft.axes import SURFACE_AXES
from servofd.axes.calibrate import calibrate_motion
from servofd.axes.judge import judge_motion
from servofd.axes.motion import motion_of_autopilot
from servofd.simulation.airframe import AirframeFault, AirframeFlight, airframe_parameters, fly_airframe

if TYPE_CHECKING:
    from servofd.aircraft.axes import MotionModel
    from servofd.axes.motion import Motion
    from servofd.axes.verdict import AxisEvent

ONSET_S, WITHIN_S = 60.0, 30.0
DEG_PER_US = 0.05
BOTH = ("aileron_left", "aileron_right")
CASES: dict[str, tuple[str, tuple[str, ...], str, float]] = {
    "one aileron at 0": ("roll", ("aileron_left",), "stuck", 0.0),
    "one aileron at +10 deg": ("roll", ("aileron_left",), "stuck", 10.0),
    "elevator at -1 deg": ("pitch", ("elevator",), "stuck", -1.0),
    "rudder at +5 deg": ("side", ("rudder",), "stuck", 5.0),
    "ailerons -25 %": ("roll", BOTH, "loss_of_effectiveness", 0.75),
    "ailerons -50 %": ("roll", BOTH, "loss_of_effectiveness", 0.5),
    "ailerons -75 %": ("roll", BOTH, "loss_of_effectiveness", 0.25),
    "ailerons -100 %": ("roll", BOTH, "loss_of_effectiveness", 0.0),
    "ailerons off by 15 us": ("roll", BOTH, "bias", 0.75),
    "ailerons off by 30 us": ("roll", BOTH, "bias", 1.5),
    "ailerons off by 60 us": ("roll", BOTH, "bias", 3.0),
    "ailerons slow by 0.2 s": ("roll", BOTH, "slow", 0.2),
    "ailerons slow by 0.5 s": ("roll", BOTH, "slow", 0.5),
    "elevator slow by 0.2 s": ("pitch", ("elevator",), "slow", 0.2),
}
"""Axis, surfaces, kind and value."""


def motion_of_flight(flight: AirframeFlight, name: str) -> Motion:
    """A flight as its log would be read."""
    p, q, r = np.radians(flight.rates_deg_s)
    ax, ay, az = flight.accelerations_m_s2
    series = {f"RCOU.C{number}": flight.pulses_us[:, k] for k, number in enumerate(flight.surfaces)}
    series |= {"RCOU.C3": 1000.0 + 1000.0 * flight.throttle, "ARSP.Airspeed": flight.airspeed_m_s}
    series |= {"IMU.GyrX": p, "IMU.GyrY": q, "IMU.GyrZ": r, "IMU.AccX": ax, "IMU.AccY": ay, "IMU.AccZ": az}
    series |= {"ATT.Roll": flight.roll_deg, "ATT.Pitch": flight.pitch_deg}
    channels = {one: Channel(one, flight.time_s, values, "", one) for one, values in series.items()}
    return motion_of_autopilot(FlightLog(Path(name), "dataflash", channels, parameters=airframe_parameters(flight)))


def turbulence_of(seed: int) -> float:
    """Calm to rough, drawn for each flight."""
    return float(np.random.default_rng([seed, 25]).uniform(0.3, 1.5))


def calibrated(first: int = 1000, days: int = 4, each: int = 2) -> MotionModel:
    """Model of healthy flights, of every other seed from the first on."""
    flights = []
    for day in range(days):
        for k in range(each):
            seed = first + 2 * (day * each + k)
            flight = fly_airframe(seed, day=first + 2 * day, turbulence=turbulence_of(seed))
            flights.append(motion_of_flight(flight, f"2026-04-{day + 1:02d}"))
    return calibrate_motion(flights)


def own_events(model: MotionModel, motion: Motion) -> list[tuple[str, AxisEvent]]:
    """Events of surfaces, without what another axis explains."""
    audits = judge_motion(model, motion)
    return [(audit.axis, e) for audit in audits if audit.axis in SURFACE_AXES for e in audit.events if e.is_own]


@dataclass
class Seen:
    """Of one case."""

    flights: int = 0
    found: int = 0
    right: int = 0
    slow: int = 0
    lost_held: int = 0
    offset_held: int = 0


def faulty(model: MotionModel, case: str, flights: int) -> Seen:
    """How often a fault was seen within half a minute, and whether the intervals hold the truth."""
    axis, surfaces, kind, value = CASES[case]
    seen = Seen()
    for k in range(flights):
        seed = 5001 + 2 * k
        faults = tuple(AirframeFault(surface, kind, ONSET_S, value) for surface in surfaces)
        flight = fly_airframe(seed, turbulence=turbulence_of(seed), faults=faults, duration_s=120.0)
        events = own_events(model, motion_of_flight(flight, f"flight {seed}"))
        after = [(name, e) for name, e in events if ONSET_S <= e.alarm_s <= ONSET_S + WITHIN_S]
        seen.flights += 1
        if not after:
            continue
        seen.found += 1
        name, event = after[0]
        seen.right += name == axis
        seen.slow += event.lag_s is not None
        share = len(surfaces) / (2.0 if axis == "roll" else 1.0)
        lost = share if kind == "stuck" else share * (1.0 - value) if kind == "loss_of_effectiveness" else 0.0
        offset_us = share * value / DEG_PER_US if kind in ("stuck", "bias") else 0.0
        seen.lost_held += event.lost_share.low <= lost <= event.lost_share.high
        seen.offset_held += event.offset_us.low <= offset_us <= event.offset_us.high
    return seen


def false_alarms(model: MotionModel, flights: int, first: int) -> tuple[int, int, float]:
    """Alarms of healthy flights, how many of them had one, and hours."""
    alarms, alarmed, hours = 0, 0, 0.0
    for seed in range(first, first + 2 * flights, 2):
        motion = motion_of_flight(fly_airframe(seed, turbulence=turbulence_of(seed)), f"flight {seed}")
        events = own_events(model, motion)
        alarms, alarmed = alarms + len(events), alarmed + bool(events)
        hours += float(motion.time_s[-1]) / 3600.0
    return alarms, alarmed, hours


def foretold(model: MotionModel) -> float:
    """False alarms an hour that a calibration predicts."""
    return sum(axis.false_alarms_per_hour for name, axis in model.axes.items() if name in SURFACE_AXES)


def main() -> None:
    flights = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    for first in range(20_001, 20_001 + 10_000 * (int(sys.argv[2]) if len(sys.argv) > 2 else 0), 10_000):
        model = calibrated(first)
        alarms, _, hours = false_alarms(model, flights, first + 500)
        print(f"calibration {first}: {alarms} false alarms in {hours:.1f} h, predicted {foretold(model):.2f} an hour")
    began_s = time.process_time()
    model = calibrated()
    print(f"calibrated in {time.process_time() - began_s:.0f} s of processor time")
    for name, axis in model.axes.items():
        print(f"  {name}: {axis.form}, {axis.explained:.0%} explained, suspect at {axis.suspect:.2g}")
    began_s = time.process_time()
    alarms, alarmed, hours = false_alarms(model, flights, 3001)
    used_s = time.process_time() - began_s
    print(f"{flights} healthy flights, {hours:.1f} h, {used_s / hours:.2f} s of processor time an hour with simulation")
    print(f"false alarms: {alarms / hours:.2f} an hour ({alarmed} flights), predicted {foretold(model):.2f}")
    for case in CASES:
        seen = faulty(model, case, max(4, flights // 10))
        print(
            f"{case:24s} seen {seen.found:2d} of {seen.flights}, right axis {seen.right}, said slow {seen.slow}, "
            f"interval of lost share holds {seen.lost_held}, of offset {seen.offset_held}"
        )


if __name__ == "__main__":
    main()
