"""What threshold and bank cost: ``OPENBLAS_NUM_THREADS=1 python benchmarks/bank_cost.py``.

The peer is servofd's own healthy residual in the same run: an hour of six healthy surfaces at 100 Hz without any alarm,
with and without judgement, on one thread. And the time of one classification, over windows of 2 and 16 s of each kind
of fault.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from fleet import KINDS, flight
from servofd.aircraft.schema import plain_aircraft
from servofd.aircraft.series import Series
from servofd.core.tolerance import Tolerance
from servofd.detection.bank import Onset, Window
from servofd.detection.judge import judge, name_fault
from servofd.detection.residual import ResidualGenerator, commands_at_servo, noise_deg
from servofd.simulation.commands import COMMANDS
from trial import judged

__all__ = ["Cost", "measure"]

_SURFACES, _DURATION_S, _RATE_HZ, _NOISE_DEG = 6, 3600.0, 100.0, 0.1
_REPEATS = 3
_WINDOWS_S = (2.0, 16.0)
_SETTLING_S = 0.25


class Cost(NamedTuple):
    """Times of one run."""

    residual_s: float
    judged_s: float
    """Residual, threshold and bank."""
    samples: int
    alarms: int
    """Of what must be a healthy log: 0."""
    classification_ms: dict[float, tuple[float, ...]]
    """By length of the window [s], one for each kind of fault."""

    def __str__(self) -> str:
        lines = [
            f"\n  one naming of {length_s:2.0f} s: median {np.median(times_ms):.1f} ms, most {max(times_ms):.1f}"
            for length_s, times_ms in self.classification_ms.items()
        ]
        return (
            f"{_SURFACES} surfaces, {self.samples / _SURFACES / _RATE_HZ / 3600:g} h at {_RATE_HZ:g} Hz "
            f"({self.samples:,} samples), "
            f"{self.alarms} alarms\n"
            f"  healthy residual alone          {1e9 * self.residual_s / self.samples:6.0f} ns a sample\n"
            f"  with interval threshold, bank   {1e9 * self.judged_s / self.samples:6.0f} ns a sample: "
            f"{self.judged_s / self.residual_s:.2f} times as much (target 3)" + "".join(lines)
        )


def measure(duration_s: float = _DURATION_S) -> Cost:
    """Time residual, judgement and classification."""
    aircraft = plain_aircraft(["x"], "hs225bb-eq31")
    surface, model = aircraft.surfaces["x"].model_copy(update={"threshold": "interval"}), aircraft.model("x")
    time_s = np.arange(round(duration_s * _RATE_HZ)) / _RATE_HZ
    segments = []
    for seed in range(_SURFACES):
        rng = np.random.default_rng(seed)
        command_deg = COMMANDS["lively"](time_s, rng)
        measured_deg = model.simulate(time_s, command_deg, time_s) + _NOISE_DEG * rng.standard_normal(time_s.size)
        segments.append(Series("x", time_s, command_deg, time_s, measured_deg))
    generator = ResidualGenerator.fitting(model, segments[0])

    def alarms() -> int:
        found = [judge(generator, segment, generator.run(segment), surface) for segment in segments]
        return sum(len(one.faults) + len(one.suspicions) for one in found)

    count = alarms()  # compiles
    alone_s = min(_timed(lambda: [generator.run(segment) for segment in segments]) for _ in range(_REPEATS))
    judged_s = min(_timed(alarms) for _ in range(_REPEATS))
    times_ms = {length_s: tuple(_classification_ms(kind, length_s) for kind in KINDS) for length_s in _WINDOWS_S}
    return Cost(alone_s, judged_s, _SURFACES * time_s.size, count, times_ms)


def _classification_ms(kind: str, length_s: float) -> float:
    """Time of one decision between all hypotheses."""
    window = _window(kind, length_s)
    return 1e3 * min(_timed(lambda: name_fault(window)) for _ in range(_REPEATS))


def _window(kind: str, length_s: float) -> Window:
    log = judged(flight(0, "lively", kind, "large"))
    truth = log.flight.truth
    commands = commands_at_servo(log.segment, log.generator.model.delay_s, log.generator.longest_gap_s(log.segment))
    noise = noise_deg(log.residuals.error_deg[log.residuals.settled])
    start_s = truth.start_s if truth else 0.0
    at = int(np.searchsorted(log.residuals.time_s, start_s))
    position_deg = float(log.residuals.simulated_deg[at])
    onset = Onset(start_s, position_deg, position_deg, position_deg)
    span = slice(*np.searchsorted(log.residuals.time_s, start_s + _SETTLING_S + np.array([0.0, length_s])).tolist())
    return Window.of(log.generator.model, Tolerance(), noise, log.residuals, commands, span, onset)


def _timed(action: Callable[[], object]) -> float:
    """Processor time, on one thread: other work on the machine does not count."""
    begin = time.process_time()
    action()
    return time.process_time() - begin


if __name__ == "__main__":
    print(measure())
