"""Processor time to judge an hour of flight of six channels at 25 Hz by its motion.

``python benchmarks/motion_hour.py``: in seconds, and as a multiple of summing six such channels up once, which hardly
depends on the machine.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np
from motion_simulated import calibrated, motion_of_flight

from servofd.axes.judge import judge_motion
from servofd.simulation.airframe import fly_airframe

if TYPE_CHECKING:
    from collections.abc import Callable

HOUR_S = 3600.0
REPEATS = 5


def least_s(work: Callable[[], object]) -> float:
    """Shortest processor time of some runs [s]."""
    used_s = []
    for _ in range(REPEATS):
        began_s = time.process_time()
        work()
        used_s.append(time.process_time() - began_s)
    return min(used_s)


def main() -> None:
    model = calibrated(days=2)
    motion = motion_of_flight(fly_airframe(7000, turbulence=0.8, duration_s=HOUR_S), "an hour")
    channels = np.random.default_rng(0).normal(size=(6, motion.time_s.size))
    judged_s, summed_s = least_s(lambda: judge_motion(model, motion)), least_s(lambda: np.cumsum(channels, axis=1))
    windows = {name: len(axis.spreads) for name, axis in model.axes.items()}
    print(f"{motion.time_s.size} samples, windows of each axis: {windows}")
    print(f"judged in {judged_s:.2f} s, {judged_s / summed_s:.0f} times a sum over six channels")


if __name__ == "__main__":
    main()
