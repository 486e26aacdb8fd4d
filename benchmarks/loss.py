"""Alarms of healthy and of faulty flights over links that lose 0 to 60 % of their frames, at random and in bursts.

Strangers' aircraft (`benchmarks/strangers.py`) fly with commands and positions at 5 to 40 Hz. Each is calibrated
on a clean log of its link and then replayed as a worse link would have brought it: frames are lost, late by up to
50 ms, and one in twenty changes places with its neighbour. A healthy flight may raise no alarm. A fault is found, or
the monitor has said that the link is too poor to judge that surface; how much later its alarm comes than over the
clean link is reported::

    python benchmarks/loss.py --seeds 1 3 --healthy

``--recorded LOG.tlog -c FILE --events EVENTS.csv`` does the same to a flight that was recorded; the events name each
fault's ``begin_s``, ``end_s`` and ``surface``.
"""

from __future__ import annotations

import argparse
import csv
import tempfile
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from strangers import SURFACES, Failure, Stranger, draw_failure, fly, stranger

import servofd
from logparsers.codec import Codec
from logparsers.replay import replayed
from servofd.aircraft.schema import load_aircraft
from servofd.live.session import Session

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servofd.aircraft.schema import Aircraft
    from servofd.detection.event import Event

    Frames = list[tuple[float, bytes]]
    """Arrival times [s] and frames."""

LOSSES: Final = tuple(round(0.05 * k, 2) for k in range(13))
PATTERNS: Final = ("random", "bursts")
RATES_HZ: Final = (5.0, 10.0, 20.0, 40.0)
_SLOWEST_HZ: Final = 10.0
"""Slower links are watched with the file of this one: calibration refuses their logs."""
KINDS: Final = ("stuck", "slow", "bias", "loss_of_effectiveness", "oscillation", "floating")
_BURST_S: Final = 0.3
"""Mean length of what a link loses in one piece."""
_JITTER_S, _SWAPPED = 0.05, 0.05
_GOOD_S, _FLIGHT_S = 240.0, 100.0
_STEP_S, _CALM_STEP_S = 0.1, 0.5
_BOOTED_S: Final = 5.0
"""Of a stranger's flight its autopilot was booted so long before the first command."""
NAMES: Final = ("aileron_1", "aileron_5", "elevator", "rudder")
"""What its parameters call the surfaces."""
_LATE_S: Final = 15.0
"""So long after its onset an alarm still tells a fault."""
_SOON_S: Final = 2.0
"""Alarms are to come no later than this after that of the clean link."""


def worse(frames: Frames, loss: float, pattern: str, seed: int) -> Frames:
    """The frames that a link brings which loses a share of them, delays the rest, and lets some overtake.

    Examples
    --------
    >>> sent = [(0.01 * k, bytes([k % 256])) for k in range(10_000)]
    >>> came = worse(sent, 0.3, "bursts", 1)
    >>> round(1.0 - len(came) / len(sent), 1), came == sorted(came, key=lambda each: each[0])
    (0.3, True)
    """
    rng = np.random.default_rng([91, seed])
    at_s = np.array([each_s for each_s, _ in frames])
    if pattern == "random":
        kept = rng.random(at_s.size) >= loss
    else:
        good_s = _BURST_S * (1.0 - loss) / max(loss, 1e-9)
        count = 2 + int(2.0 * (at_s[-1] - at_s[0]) / (_BURST_S + good_s))
        lengths_s = np.stack([rng.exponential(good_s, count), rng.exponential(_BURST_S, count)], axis=1)
        edges_s = at_s[0] + np.cumsum(lengths_s.ravel())
        kept = np.searchsorted(edges_s, at_s) % 2 == 0
    came = np.flatnonzero(kept)
    arrival_s = np.maximum.accumulate(at_s[came] + _JITTER_S * rng.random(came.size))
    for k in np.flatnonzero(rng.random(max(came.size - 1, 0)) < _SWAPPED).tolist():
        came[[k, k + 1]] = came[[k + 1, k]]
    return [(each_s, frames[k][1]) for each_s, k in zip(arrival_s.tolist(), came.tolist(), strict=True)]


def told(aircraft: Aircraft, frames: Frames) -> list[Event]:
    """What the monitor says of a link."""
    session, stepped_s, now_s = Session(Codec(0, 191), {0: aircraft}), -np.inf, 0.0
    events: list[Event] = []
    for now_s, frame in frames:
        events += session.take(now_s, frame)
        if now_s - stepped_s >= (_CALM_STEP_S if session.rests(_CALM_STEP_S) else _STEP_S):
            stepped_s = now_s
            events += session.step(now_s)
    return events + session.finish(now_s)


class Score(NamedTuple):
    """What became of the faults of a link."""

    counts: Counter[str]
    later_s: list[float]
    """How much later than without loss those that were found in both were [s]."""

    def add(self, other: Score) -> None:
        """Take another flight."""
        self.counts.update(other.counts)
        self.later_s.extend(other.later_s)


class Truth(NamedTuple):
    """A fault of a flight, on the vehicle's clock."""

    surface: str
    begin_s: float
    end_s: float


def alarms_of(events: Sequence[Event], fault: Truth) -> list[Event]:
    """Alarms that tell a fault."""
    until_s = min(fault.begin_s + _LATE_S, fault.end_s + _JITTER_S)
    return [
        event for event in events
        if event.event == "alarm" and event.surface == fault.surface and fault.begin_s - 0.5 <= event.time_s <= until_s
    ]  # fmt: skip


def scored(events: Sequence[Event], truth: Sequence[Truth], clean: Sequence[Event]) -> Score:
    """Faults that were found, those of a surface that was said not to be judged, those missed, and other alarms.

    `clean`: what the monitor says of the link that loses nothing.
    """
    score: Counter[str] = Counter()
    alarms = [event for event in events if event.event == "alarm"]
    mine: list[Event] = []
    later_s: list[float] = []
    for fault in truth:
        until_s = min(fault.begin_s + _LATE_S, fault.end_s + _JITTER_S)
        found, before = alarms_of(events, fault), alarms_of(clean, fault)
        later_s += [found[0].time_s - before[0].time_s] if found and before else []
        poor = [
            event for event in events
            if event.event == "no_data" and event.surface == fault.surface and event.time_s <= until_s
        ]  # fmt: skip
        score["found" if found else "said" if poor else "missed"] += 1
        within = (fault.begin_s - 0.5, fault.end_s + 2.0)
        mine += [a for a in alarms if a.surface == fault.surface and within[0] <= a.time_s <= within[1]]
    score["false"] = len(alarms) - len(mine)
    return Score(score, later_s)


def calibrated(seed: int, rate_hz: float) -> Aircraft:
    """An aircraft file of the link at a rate, from a clean flight."""
    with tempfile.TemporaryDirectory() as folder:
        path = fly(_craft(seed, rate_hz), 100, "mixed", duration_s=_GOOD_S).write(Path(folder) / "good.tlog")
        known: Aircraft = servofd.calibrate(path).aircraft
        return known


def flown(seed: int, rate_hz: float, number: int, failure: Failure | None) -> tuple[Frames, list[Truth]]:
    """A flight over a clean link, and its faults."""
    flight = fly(_craft(seed, rate_hz), number, "mixed", duration_s=_FLIGHT_S, failure=failure)
    with tempfile.TemporaryDirectory() as folder:
        frames = list(replayed(flight.write(Path(folder) / "flight.tlog")))
    if failure is None:
        return frames, []
    name = NAMES[SURFACES.index(failure.surface)]
    return frames, [Truth(name, failure.start_s + _BOOTED_S, failure.end_s + _BOOTED_S)]


def recorded_events(path: Path) -> list[Truth]:
    """The faults of a flight that was recorded."""
    with path.open(newline="") as file:
        return [Truth(row["surface"], float(row["begin_s"]), float(row["end_s"])) for row in csv.DictReader(file)]


def _craft(seed: int, rate_hz: float) -> Stranger:
    return replace(stranger(2 * seed + 1), position_hz=rate_hz, command_hz=rate_hz)


def _row(loss: float, pattern: str, where: str, score: Score) -> str:
    counts, later = score.counts, sum(each_s > _SOON_S for each_s in score.later_s)
    faults = counts["found"] + counts["said"] + counts["missed"]
    most = f"{later} of them > {_SOON_S:g} s later than without loss, at most {max(score.later_s, default=0.0):.1f} s"
    return (
        f"{where:>10} {loss:5.0%} {pattern:>7}: {counts['false']} false alarms; of {faults} faults "
        f"{counts['found']} found ({most}), {counts['said']} of a link said to be too poor, {counts['missed']} missed"
    )


def _recorded(options: argparse.Namespace) -> None:
    frames, aircraft = list(replayed(options.recorded)), load_aircraft(options.config)
    truth = recorded_events(options.events) if options.events else []
    clean = told(aircraft, frames)
    for loss in options.losses:
        for pattern in PATTERNS:
            score = Score(Counter(), [])
            for seed in options.seeds:
                score.add(scored(told(aircraft, worse(frames, loss, pattern, seed)), truth, clean))
            print(_row(loss, pattern, "recorded", score), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=(0, 2), help="of aircraft, and of recorded links")
    parser.add_argument("--healthy", action="store_true", help="fly no faults")
    parser.add_argument("--rates", type=float, nargs="+", default=RATES_HZ)
    parser.add_argument("--losses", type=float, nargs="+", default=LOSSES)
    parser.add_argument("--recorded", type=Path)
    parser.add_argument("-c", "--config", type=Path)
    parser.add_argument("--events", type=Path)
    options = parser.parse_args()
    if options.recorded is not None:
        _recorded(options)
        return
    for rate_hz in options.rates:
        known = {seed: calibrated(seed, max(rate_hz, _SLOWEST_HZ)) for seed in options.seeds}
        flights = []
        for seed in options.seeds:
            kinds = (None, *(KINDS[(2 * seed + k) % len(KINDS)] for k in range(0 if options.healthy else 2)))
            broken = [
                None if kind is None else draw_failure(10 * seed + k, _FLIGHT_S, kind, "large")
                for k, kind in enumerate(kinds)
            ]
            for k, failure in enumerate(broken):
                frames, truth = flown(seed, rate_hz, 1 + k, failure)
                flights.append((seed, frames, truth, told(known[seed], frames) if truth else []))
        for loss in options.losses:
            for pattern in PATTERNS:
                score = Score(Counter(), [])
                for k, (seed, frames, truth, clean) in enumerate(flights):
                    each = scored(told(known[seed], worse(frames, loss, pattern, k)), truth, clean)
                    if each.counts["false"] or each.counts["missed"]:
                        print(f"  flight {k}: {dict(each.counts)} {truth}", flush=True)
                    score.add(each)
                print(_row(loss, pattern, f"{rate_hz:g} Hz", score), flush=True)


if __name__ == "__main__":
    main()
