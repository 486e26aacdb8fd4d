"""Faults of simulated aeroplanes in wind, judged by their motion alone, by a model of healthy aeroplanes.

``python benchmarks/motion_wind.py FOLDER`` with ArduPlane's logs (``*.bin.gz``) and their ``index.csv``. Every flight
is of another aeroplane (centre of gravity, trim, drag, wing) and counts as a day of its own; each healthy one is judged
by a model of the other healthy ones. Servos report positions in these logs, which are not read.
"""

from __future__ import annotations

import csv
import re
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

import logparsers
from servofd.aircraft.outputs import outputs_of, pulse_channel
from servofd.axes.calibrate import calibrate_motion
from servofd.axes.judge import judge_motion
from servofd.axes.motion import airframe_of, motion_of_autopilot

if TYPE_CHECKING:
    from servofd.axes.motion import Motion
    from servofd.axes.verdict import AxisAudit, AxisEvent

AXES = {"aileron": "roll", "elevator": "pitch", "rudder": "side"}
DEG_PER_US = 0.2
SHOWS_DEG = 10.0
"""A surface that stands so far from where it was asked, for a quarter of a second, moves the aircraft visibly."""
SHOWS_S = 0.25
NAMED_WITHIN_S = 60.0


@dataclass(frozen=True)
class Fault:
    """What was injected, from the index."""

    kind: str
    axis: str
    outputs: tuple[int, ...]
    angle_deg: float | None
    onset_s: float
    end_s: float


@dataclass(frozen=True)
class Wind:
    """One flight with its truth."""

    name: str
    motion: Motion
    faults: tuple[Fault, ...]
    shows_s: tuple[float, ...]
    """When each fault could first be seen."""
    offset_us: tuple[float | None, ...]
    """Where each stuck surface holds its axis."""


def flights_of(folder: Path) -> list[Wind]:
    """Every flight of the index."""
    rows = list(csv.DictReader((folder / "index.csv").read_text().splitlines()))
    found = []
    for name in dict.fromkeys(row["name"] for row in rows):
        log = logparsers.read(folder / f"{name}.bin.gz")
        motion = replace(motion_of_autopilot(log), day=name)
        faults = tuple(_fault(row) for row in rows if row["name"] == name and row["surface"])
        shares = {
            output.number: (output, weight)
            for parts in airframe_of(outputs_of(log.parameters)).commands.values()
            for output, weight in parts
        }
        shows: list[float] = []
        offsets: list[float | None] = []
        for fault in faults:
            shows.append(fault.onset_s)
            offsets.append(None)
            if fault.angle_deg is None or fault.kind != "stuck":
                continue
            output, weight = shares[fault.outputs[0]]
            pulses = log[pulse_channel(log.channels, fault.outputs[0])]
            asked_deg = DEG_PER_US * (pulses.values - 1500.0)
            stands_us = fault.angle_deg / DEG_PER_US + 1500.0 - output.trim_us
            offsets[-1] = weight * output.sign * stands_us
            away = (np.abs(asked_deg - fault.angle_deg) > SHOWS_DEG) & (pulses.time_s > fault.onset_s)
            length = round(SHOWS_S / float(np.median(np.diff(pulses.time_s))))
            steady = np.flatnonzero(np.convolve(away, np.ones(length), "full")[: away.size] >= length)
            shows[-1] = float(pulses.time_s[steady[0] - length + 1]) if steady.size else np.inf
        found.append(Wind(name, motion, faults, tuple(shows), tuple(offsets)))
    return found


def _fault(row: dict[str, str]) -> Fault:
    surface = row["surface"].partition("_")[0]
    proof = re.search(r"Pos (-?[\d.]+)", row["proof"])
    return Fault(
        row["fault"],
        AXES.get(surface, "thrust"),
        tuple(int(number) for number in re.findall(r"_(\d+)", row["surface"])),
        float(proof[1]) if proof else None,
        float(row["onset_s"]),
        np.inf if row["end_s"] == "end" else float(row["end_s"]),
    )


@dataclass(frozen=True)
class Found:
    """What was told of one fault."""

    flight: str
    fault: Fault
    event: AxisEvent | None
    delay_s: float | None
    """After it could first be seen."""
    holds_offset: bool | None
    """Whether the interval of the stuck angle holds the truth."""


def told(flights: list[Wind]) -> tuple[list[Found], list[tuple[str, AxisAudit, AxisEvent]], float]:
    """What was told of each fault, alarms without one, and healthy hours."""
    healthy = [flight for flight in flights if not flight.faults]
    whole = calibrate_motion([flight.motion for flight in healthy])
    faults, alarms, hours = [], [], 0.0
    for flight in flights:
        others = [one.motion for one in healthy if one is not flight]
        model = whole if flight.faults else calibrate_motion(others)
        audits = judge_motion(model, flight.motion)
        bad_s = sum(min(f.end_s, flight.motion.time_s[-1]) - f.onset_s for f in flight.faults)
        hours += (float(flight.motion.time_s[-1]) - bad_s) / 3600.0
        told_of = set()
        for fault, shows_s, offset_us in zip(flight.faults, flight.shows_s, flight.offset_us, strict=True):
            (audit,) = (one for one in audits if one.axis == fault.axis)
            last_s = min(fault.end_s, fault.onset_s + NAMED_WITHIN_S)
            event = next((e for e in audit.events if e.is_own and fault.onset_s <= e.alarm_s < last_s), None)
            told_of.add(id(event))
            holds = (
                None if event is None or offset_us is None else event.offset_us.low <= offset_us <= event.offset_us.high
            )
            delay_s = None if event is None else max(0.0, event.alarm_s - shows_s)
            faults.append(Found(flight.name, fault, event, delay_s, holds))
        alarms += [
            (flight.name, audit, event)
            for audit in audits
            for event in audit.events
            if audit.axis != "thrust" and event.is_own and id(event) not in told_of and not _after(event, flight)
        ]
    return faults, alarms, hours


def _after(event: AxisEvent, flight: Wind) -> bool:
    """Whether another fault was there at that time: what it moves may be told, on its own axis or another."""
    return any(f.onset_s <= event.alarm_s <= f.end_s + NAMED_WITHIN_S for f in flight.faults if f.kind != "engine_cut")


def main() -> None:
    flights = flights_of(Path(sys.argv[1]))
    began_s = time.process_time()
    faults, alarms, hours = told(flights)
    print(f"{len(flights)} flights, {time.process_time() - began_s:.0f} s of processor time")
    for one in faults:
        what = f"{one.flight} {one.fault.kind} of {one.fault.axis}"
        if one.event is None:
            print(f"{what}: not found")
            continue
        lost, offset, lag = one.event.lost_share, one.event.offset_us, one.event.lag_s
        slow = "" if lag is None else f", slow by {lag.value:.2f} s"
        sizes = f"lost {lost.value:.2f} [{lost.low:.2f}, {lost.high:.2f}]"
        where = f"offset {offset.value:.0f} us [{offset.low:.0f}, {offset.high:.0f}], holds truth: {one.holds_offset}"
        print(f"{what}: {one.delay_s:.1f} s after it could be seen, {sizes}, {where}{slow}")
    print(f"alarms without a fault: {len(alarms)} in {hours:.2f} h")
    for name, audit, event in alarms:
        print(f"  {name} {audit.axis} at {event.alarm_s:.1f} s: {audit.reason}")


if __name__ == "__main__":
    main()
