"""False faults of healthy flights whose telemetry repeats, holds, echoes or spikes; audited, calibrated, and live.

Strangers' aircraft (`benchmarks/strangers.py`) fly healthily; `injected` spoils what their telemetry says, one reason
at a time. Each flight is audited without an aircraft file, audited with a file that was calibrated on a clean flight of
the same aircraft, and replayed through the monitor with that file. Not one surface may be at fault::

    python benchmarks/telemetry.py --flights 100 --jobs 2
"""

from __future__ import annotations

import argparse
import tempfile
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from itertools import repeat
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from strangers import Failure, Flight, fly, stranger

import servofd
from logparsers.codec import Codec
from servofd.core.errors import CalibrationError, ServofdError
from servofd.core.series import latest
from servofd.feedback.flown import one_log
from servofd.live.run import Pace, replay_log
from servofd.live.session import Session

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servofd.aircraft.schema import Aircraft
    from servofd.core.types import FloatArray
    from servofd.detection.event import Event

REASONS: Final = ("clean", "frozen", "held", "echo", "spike")
WAYS: Final = ("audit, no file", "audit, calibrated", "monitor, calibrated")
_STYLES: Final = ("mixed", "aerobatics", "turbulence", "loiter")
_EVERY_S: Final = 9.0
"""Between two injections, on average: seven in a flight of a minute."""
_LONGEST_S: Final = 3.0
"""For so long a logger holds now and then."""
_GOOD_S: Final = 120.0
"""Length of the flight that is calibrated on [s]."""
_HELD: Final = 0.3
"""Share of the rows that begin a hold, while a logger holds."""
_EACH_CALIBRATES: Final = 4
"""Flights of one aircraft."""


def injected(flight: Flight, reason: str, seed: int) -> Flight:
    """The same flight with telemetry that is spoilt for one reason, one of `REASONS`.

    Examples
    --------
    >>> flight = fly(stranger(2), 1, "mixed", duration_s=20.0)
    >>> spoilt = injected(flight, "frozen", 1)
    >>> bool(np.any(spoilt.position_deg != flight.position_deg))
    True
    """
    if reason == "clean":
        return flight
    rng = np.random.default_rng([75, seed, REASONS.index(reason)])
    time_s, deg = flight.position_s, flight.position_deg.copy()
    apart_s = _LONGEST_S if reason == "held" else 0.0  # what is held already is not held again, and so for longer
    begins_s = np.cumsum(apart_s + rng.exponential(_EVERY_S - apart_s, 200)) + 2.0
    for begin_s in begins_s[begins_s < time_s[-1] - 2.0].tolist():
        first = int(np.searchsorted(time_s, begin_s))
        if reason == "frozen":
            last = int(np.searchsorted(time_s, begin_s + rng.uniform(0.5, 0.8)))
            deg[first:last] = deg[first - 1]
        elif reason == "held":
            _hold(rng, deg[first : int(np.searchsorted(time_s, begin_s + _LONGEST_S))])
        elif reason == "echo":
            last = int(np.searchsorted(time_s, begin_s + rng.uniform(0.5, 1.5)))
            which = rng.integers(deg.shape[1])
            deg[first:last, which] = latest(flight.command_s, flight.command_deg[:, which], time_s[first:last])
        else:
            deg[first, rng.integers(deg.shape[1])] += rng.choice([-1.0, 1.0]) * rng.uniform(8.0, 40.0)
    return replace(flight, position_deg=deg)


def _hold(rng: np.random.Generator, deg: FloatArray) -> None:
    """Repeat the last value of one surface or the other for one to four rows, every now and then."""
    for which in range(deg.shape[1]):
        row = 1
        while row < deg.shape[0]:
            rows = int(rng.integers(1, 5))
            if rng.uniform() < _HELD:
                deg[row : row + rows, which] = deg[row - 1, which]
            row += rows + 1  # at least one fresh row in between: 0.16 s at 25 Hz at most


class _Silent:
    """Takes the events of a replay."""

    def __init__(self) -> None:
        self.found: list[Event] = []

    def events(self, events: list[Event]) -> None:
        """Keep them."""
        self.found += events

    def tick(self, now_s: float) -> None:
        """Nothing is drawn."""


def monitored(path: Path, aircraft: Aircraft) -> dict[str, str]:
    """Replay a table through the monitor; of each surface ``fault`` or ``healthy``."""
    session, watcher = Session(Codec(0, 191), {0: aircraft}, is_stream=False), _Silent()
    now_s = replay_log(session, one_log(path), watcher, Pace(0.0), float("inf"))
    watcher.events(session.finish(now_s))
    monitors = session.vehicles[0].monitors
    return {name: "fault" if monitor.has_fault else "healthy" for name, monitor in monitors.items()}


@dataclass(frozen=True, slots=True)
class Outcome:
    """What one flight, spoilt in one way, was taken for, by each way of judging; of each surface its status."""

    reason: str
    seed: int
    number: int
    statuses: dict[str, dict[str, str]]


def judged(
    seed: int, numbers: Sequence[int], reasons: Sequence[str], duration_s: float, *, calibrates: bool
) -> list[Outcome]:
    """Every flight of one aircraft; `calibrates`: also with a calibrated file."""
    aircraft, found = stranger(2 * seed + 1), []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "flight.csv"
        known: Aircraft | None = None
        try:
            if not calibrates:
                raise CalibrationError("was not asked for")
            fly(aircraft, 100, "mixed", duration_s=_GOOD_S).write(path)
            known = servofd.calibrate(path, force=True).aircraft
        except ServofdError as error:
            print(f"aircraft {seed}: not calibrated: {error}", flush=True)
        for number in numbers:
            flight = fly(aircraft, number, _STYLES[number % len(_STYLES)], duration_s=duration_s)
            for reason in reasons:
                injected(flight, reason, 1000 * seed + number).write(path)
                statuses = {WAYS[0]: _audited(path, None)}
                if known is not None:
                    statuses |= {WAYS[1]: _audited(path, known), WAYS[2]: monitored(path, known)}
                found.append(Outcome(reason, seed, number, statuses))
    return found


def jam_found(seed: int, duration_s: float) -> bool:
    """Whether a jam of the elevator is a fault without a file although the bus freezes now and then."""
    flight = fly(
        stranger(2 * seed + 1), 1, "aerobatics", duration_s=duration_s, failure=Failure("stuck", "elevator", 20.0)
    )
    with tempfile.TemporaryDirectory() as folder:
        path = injected(flight, "frozen", seed).write(Path(folder) / "flight.csv")
        return _audited(path, None)["elevator"] == "fault"


def _audited(path: Path, aircraft: Aircraft | None) -> dict[str, str]:
    (result,) = servofd.audit(path, aircraft)
    return {surface.surface: surface.status for surface in result.surfaces}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--flights", type=int, default=8)
    parser.add_argument("--first", type=int, default=0, help="first aircraft, for a part of a campaign")
    parser.add_argument("--duration", type=float, default=60.0)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--reasons", nargs="+", choices=REASONS, default=REASONS)
    parser.add_argument("--no-file", action="store_true", help="audit without a file only")
    options = parser.parse_args()
    seeds = range(options.first, options.first + -(-options.flights // _EACH_CALIBRATES))
    numbers = range(1, 1 + min(_EACH_CALIBRATES, options.flights))
    tally: dict[tuple[str, str], Counter[str]] = {(r, way): Counter() for r in options.reasons for way in WAYS}
    done: dict[tuple[str, str], str] = {}
    with ProcessPoolExecutor(options.jobs) as pool:
        one = partial(
            judged,
            numbers=numbers,
            reasons=options.reasons,
            duration_s=options.duration,
            calibrates=not options.no_file,
        )
        for outcomes in pool.map(one, seeds):
            for each in outcomes:
                for way, statuses in each.statuses.items():
                    counts = tally[each.reason, way]
                    counts["flights"] += 1
                    counts["flights at fault"] += "fault" in statuses.values()
                    counts.update(statuses.values())
                    done[each.reason, way] = f"{counts['flights at fault']}/{counts['flights']}"
                    bad = [name for name, status in statuses.items() if status == "fault"]
                    if bad:
                        print(f"{each.reason}, {way}: aircraft {each.seed}, flight {each.number}: {bad}", flush=True)
            print(done, flush=True)
        jams = list(pool.map(jam_found, seeds, repeat(options.duration)))
    columns = ("flights", "flights at fault", "fault", "suspect", "unknown", "no_data", "healthy")
    print("".join(f"{name:>18}" for name in ("reason", *columns)))
    for (reason, way), counts in tally.items():
        print(f"{reason:>8}: {way:20}" + "".join(f"{counts[name]:>14}" for name in columns))
    print(f"jams found without a file beside a bus that freezes: {sum(jams)} of {len(jams)}")


if __name__ == "__main__":
    main()
