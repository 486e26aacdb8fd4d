"""What threshold and bank cost: ``OPENBLAS_NUM_THREADS=1 python benchmarks/bank_cost.py``.

The peer is servofd's own healthy residual in the same run: an hour of six healthy surfaces at 100 Hz without any alarm,
with and without judgement, on one thread. And the time of one naming of each kind of fault.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from fleet import KINDS, flight
from servofd.aircraft.schema import plain_aircraft
from servofd.aircraft.series import Series
from servofd.detection.faults import named
from servofd.detection.residual import ResidualGenerator
from servofd.detection.seen import Healthy
from servofd.simulation.commands import COMMANDS
from trial import judged

__all__ = ["Cost", "measure"]

_SURFACES, _DURATION_S, _RATE_HZ, _NOISE_DEG = 6, 3600.0, 100.0, 0.1
_REPEATS = 3


class Cost(NamedTuple):
    """Times of one run."""

    residual_s: float
    judged_s: float
    """Residual, threshold and bank."""
    samples: int
    alarms: int
    """Of what must be a healthy log: 0."""
    naming_ms: tuple[float, ...]
    """One for each kind of fault."""

    def __str__(self) -> str:
        return (
            f"{_SURFACES} surfaces, {self.samples / _SURFACES / _RATE_HZ / 3600:g} h at {_RATE_HZ:g} Hz "
            f"({self.samples:,} samples), "
            f"{self.alarms} alarms\n"
            f"  healthy residual alone          {1e9 * self.residual_s / self.samples:6.0f} ns a sample\n"
            f"  with interval threshold, bank   {1e9 * self.judged_s / self.samples:6.0f} ns a sample: "
            f"{self.judged_s / self.residual_s:.2f} times as much (target 3)"
            f"\n  one naming: median {np.median(self.naming_ms):.1f} ms, most {max(self.naming_ms):.1f}"
        )


def measure(duration_s: float = _DURATION_S) -> Cost:
    """Time residual, judgement and classification."""
    aircraft = plain_aircraft(["x"], "hs225bb-eq31")
    surface, model = aircraft.surfaces["x"].model_copy(update={"threshold": "interval"}), aircraft.model("x")
    time_s = np.arange(round(duration_s * _RATE_HZ)) / _RATE_HZ
    segments = []
    for seed in range(_SURFACES):
        rng = np.random.default_rng(seed)
        command_deg = COMMANDS["gusty"](time_s, rng)
        measured_deg = model.simulate(time_s, command_deg, time_s) + _NOISE_DEG * rng.standard_normal(time_s.size)
        segments.append(Series("x", time_s, command_deg, time_s, measured_deg))
    generator = ResidualGenerator.fitting(model, segments[0].period_s)

    def alarms() -> int:
        found = [Healthy(surface, model).beside(segment).found for segment in segments]
        return sum(len(one.faults) + len(one.suspicions) for one in found)

    count = alarms()  # compiles
    alone_s = min(_timed(lambda: [generator.run(segment) for segment in segments]) for _ in range(_REPEATS))
    judged_s = min(_timed(alarms) for _ in range(_REPEATS))
    return Cost(alone_s, judged_s, _SURFACES * time_s.size, count, tuple(_naming_ms(kind) for kind in KINDS))


def _naming_ms(kind: str) -> float:
    """Time of one decision between all hypotheses."""
    log = judged(flight(0, "gusty", kind, "large"))
    alarm_s = log.seen.found.faults[0].alarm_s
    return 1e3 * min(
        _timed(lambda: named(log.seen.flight, alarm_s, 2.0, earliest_s=0.0, names={})) for _ in range(_REPEATS)
    )


def _timed(action: Callable[[], object]) -> float:
    """Processor time, on one thread: other work on the machine does not count."""
    begin = time.process_time()
    action()
    return time.process_time() - begin


if __name__ == "__main__":
    print(measure())
