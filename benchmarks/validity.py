"""Runs of a servo that nobody knows, in one of which torque or power is lost: whether that is found, and when.

A loop of second order with a rate limit, friction and a weight on the horn is integrated in steps of 0.5 ms. From one
instant of one run on (to its end, or for some seconds) the motor does nothing: gear and motor hold what friction can,
or the weight pulls the horn down. It shares no code with servofd. **Even seeds choose constants, odd ones report.**

Run it for a table: ``python benchmarks/validity.py 1 99`` loses the torque in a run of each odd seed from 1 to 99;
with ``healthy`` behind, it is never lost.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass

import numpy as np
from numba import njit

from servofd.aircraft.series import Series
from servofd.core.types import FloatArray as Floats
from servofd.discrepancy.explanation import driven_part
from servofd.discrepancy.known import NOTHING
from servofd.discrepancy.record import record_of
from servofd.discrepancy.validity import Undriven
from servofd.jobs.explaining import UNKNOWN_SERVO
from servofd.servo.servo_model import ServoModel

__all__ = ["Lot", "found_in", "lot", "moved"]

_STEP_S = 5e-4
_LATE_S = 0.3
"""By how much the beginning may be wrong."""


@dataclass(frozen=True, slots=True, eq=False)
class Lot:
    """Runs of one servo, and where one of them is not driven."""

    runs: tuple[Series, ...]
    run: int
    start_s: float
    """When its torque is lost; infinite if it is not, or nothing shows it."""
    shows_s: float
    """When it is first far from where it would have been."""
    end_s: float
    kind: str

    def is_found(self, found: list[Undriven]) -> bool:
        """Whether the beginning that is told lies within 0.3 s of what happened: of the loss, or of what shows it."""
        first, last = self.start_s - _LATE_S, self.shows_s + _LATE_S
        return any(each.run == self.run and first <= each.start_s <= last for each in found)


def lot(seed: int, *, healthy: bool = False) -> Lot:
    """Draw a servo and its runs.

    Examples
    --------
    >>> drawn = lot(2)
    >>> 3 <= len(drawn.runs) <= 8, drawn.kind in ("holds", "falls", "limp")
    (True, True)
    """
    rng = np.random.default_rng([92, seed])
    rate_hz = float(rng.choice([50.0, 100.0, 200.0]))
    count, length_s = int(rng.integers(3, 9)), float(rng.uniform(6.0, 15.0))
    size_deg = float(np.exp(rng.uniform(np.log(5.0), np.log(50.0))))
    noise_deg = size_deg * float(np.exp(rng.uniform(np.log(0.002), np.log(0.02))))
    natural = 2.0 * np.pi * float(rng.uniform(3.0, 9.0))
    damping = float(rng.uniform(0.6, 1.1))
    slew = float(rng.uniform(120.0, 500.0))
    grip, weight = size_deg * float(rng.uniform(0.005, 0.04)), size_deg * float(rng.uniform(0.0, 0.15))
    kind = str(rng.choice(["holds", "falls", "limp"]))
    run = int(rng.integers(count))
    begin_s = float(rng.uniform(0.15, 0.75)) * length_s
    lasts_s = length_s if rng.uniform() < 0.5 else float(rng.uniform(2.0, 4.0))
    time_s = np.arange(round(length_s * rate_hz)) / rate_hz
    style = str(rng.choice(["steps", "sines", "sweep"]))
    runs, start_s, shows_s, end_s = [], np.inf, np.inf, np.inf
    for number in range(count):
        command = _command(rng, style, time_s, size_deg)
        first = last = np.inf
        if number == run and not healthy:
            first, last = begin_s, begin_s + lasts_s
            start_s, end_s = first, min(last, float(time_s[-1]))
        numbers = np.array([natural, damping, slew, grip, weight, first, last, ("holds", "falls", "limp").index(kind)])
        turned = moved(numbers, command, rate_hz)
        runs.append(Series("servo", time_s, command, time_s, turned + noise_deg * rng.standard_normal(time_s.size)))
        if number == run and not healthy:  # it shows once the servo should have moved
            gap = np.abs(turned - moved(np.array([*numbers[:5], np.inf, np.inf, 0.0]), command, rate_hz))
            apart = np.flatnonzero(gap > max(6.0 * noise_deg, 0.06 * size_deg))
            shows_s = max(first, float(time_s[apart[0]])) if apart.size else np.inf
            start_s = first if apart.size else np.inf
    return Lot(tuple(runs), run, start_s, shows_s, end_s, kind)


def _command(rng: np.random.Generator, style: str, time_s: Floats, size_deg: float) -> Floats:
    if style == "steps":
        levels = rng.uniform(-size_deg, size_deg, time_s.size)
        held: Floats = levels[(time_s / rng.uniform(0.5, 1.2)).astype(int)]
        return held
    if style == "sines":
        tones = rng.uniform(0.2, 1.5, 5)
        total = np.sum([np.sin(2.0 * np.pi * f * time_s + rng.uniform(0.0, 6.3)) for f in tones], axis=0)
        return np.asarray(size_deg * total / np.max(np.abs(total)))
    rate = (rng.uniform(1.5, 3.0) - 0.2) / time_s[-1]
    return np.asarray(size_deg * np.sin(2.0 * np.pi * (0.2 * time_s + 0.5 * rate * time_s**2) + rng.uniform(0.0, 6.3)))


@njit(cache=True)  # type: ignore[untyped-decorator]
def moved(numbers: Floats, command: Floats, rate_hz: float) -> Floats:
    """Position [deg] of a servo of these numbers: see where it is used."""
    natural, damping, slew, grip, weight, first, last, kind = numbers
    inner = round(1.0 / rate_hz / _STEP_S)
    out = np.zeros(command.size)
    y, v = command[0], 0.0
    for n in range(command.size):
        out[n] = y
        for k in range(inner):
            at = n / rate_hz + k * _STEP_S
            off = first <= at < last
            error = command[n] - y - weight * np.sin(np.radians(y))
            reach = slew * 2.0 * damping / natural
            pull = natural**2 * min(max(error, -reach), reach)
            rub = grip
            if off:
                pull = 0.0
                rub = 3.0 * grip
                if kind == 1.0:  # the weight turns the gear back, slowly
                    pull = -(natural**2) * (weight + 4.0 * grip) * np.sign(y + 1e-9) * min(abs(y), 1.0)
                elif kind == 2.0:  # nearly free, it swings down
                    pull = -(natural**2) * 0.2 * y
                    rub = 0.5 * grip
            free = v + _STEP_S * (pull - 2.0 * damping * natural * v)
            hold = _STEP_S * natural**2 * rub
            v = free - min(max(free, -hold), hold)
            y += _STEP_S * v
    return out


def found_in(drawn: Lot) -> list[Undriven]:
    """Where `servofd explain --servo unknown` says that the servo was not driven."""
    model = ServoModel.of(UNKNOWN_SERVO)
    return driven_part([record_of(each, model, at_rest=True, known=NOTHING) for each in drawn.runs])[1]


def main(words: list[str]) -> int:
    """Score a range of seeds."""
    first, last, healthy = int(words[0]), int(words[1]), "healthy" in words
    right = wrong = shown = 0
    seconds = []
    for seed in range(first, last + 1, 2):
        drawn = lot(seed, healthy=healthy)
        begin = time.process_time()
        found = found_in(drawn)
        seconds.append(time.process_time() - begin)
        there = np.isfinite(drawn.start_s)
        shown += there
        hit = bool(there) and drawn.is_found(found)
        right += hit
        wrong += any(f.run != drawn.run or not there for f in found)
        if "-v" in words and (hit != bool(there) or any(f.run != drawn.run for f in found)):
            print(
                seed,
                drawn.kind,
                f"run {drawn.run} from {drawn.start_s:.2f} ({drawn.shows_s:.2f}) to {drawn.end_s:.2f} s",
                found,
                flush=True,
            )
    total = len(seconds)
    print(
        f"{total} sets of runs: lost torque that shows in {shown}, found within {_LATE_S} s in {right}; a healthy run "
        f"called undriven in {wrong} sets; processor time {np.median(seconds):.2f} s median, {max(seconds):.1f} s most"
    )
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
