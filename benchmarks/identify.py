"""Identification of a servo from the chirp of thesis 3.2.3, against a subspace method.

Run it from anywhere: ``python benchmarks/identify.py``. 120 s at 100 Hz, 0.1 deg of noise, 12 bit. The peer sees the
same data: python-control's Markov parameters with the eigensystem realisation, which know neither a delay nor noise.
Times are processor time, so that other work on the machine does not count; without OMP_NUM_THREADS=1 idle threads of
the linear algebra do.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import control
import numpy as np

from servofd.aircraft.series import Series
from servofd.core.types import ComplexArray
from servofd.identification.identify import identify
from servofd.servo.library import servo_named
from servofd.servo.servo_model import ServoModel
from servofd.simulation.commands import chirp

SERVOS = ("hs225bb-eq31", "s9254", "s9256", "s3151", "9360th")
NOISE_DEG, BITS, SEEDS = 0.1, 12, 3
MARKOV_PARAMETERS = 100


def main() -> None:
    identify(record("hs225bb-eq31", 0))  # compile
    print(f"120 s chirp at 100 Hz, {NOISE_DEG} deg noise, {BITS} bit; worst of {SEEDS} seeds")
    for name in SERVOS:
        servo = servo_named(name)
        rows = []
        for seed in range(SEEDS):
            seconds, found = timed(partial(identify, record(name, seed)))
            linear = found.servo.linear
            rows.append(
                (
                    seconds,
                    dominant_error(linear.poles_rad_s, servo.transfer.poles_rad_s),
                    100.0 * abs(linear.transfer.bandwidth_rad_s / servo.transfer.bandwidth_rad_s - 1.0),
                )
            )
        seconds, pole, bandwidth = np.max(rows, axis=0)
        print(
            f"  servofd    {name:14} {seconds:6.2f} s CPU   dominant pole {pole:5.2f} %   bandwidth {bandwidth:5.2f} %"
        )
    servo = servo_named("hs225bb-eq31")
    seconds, poles = timed(realisation)
    pole = dominant_error(poles, servo.transfer.poles_rad_s)
    print(f"  Markov+ERA hs225bb-eq31   {seconds:6.2f} s CPU   dominant pole {pole:5.2f} %")


def record(name: str, seed: int) -> Series:
    rng = np.random.default_rng(seed)
    time_s = np.round(np.arange(12000) / 100.0, 9)
    command_deg = chirp(time_s, rng)
    measured_deg = ServoModel.of(servo_named(name)).simulate(time_s, command_deg, time_s)
    measured_deg += NOISE_DEG * rng.standard_normal(time_s.size)
    step_deg = 180.0 / 2**BITS
    return Series(name, time_s, command_deg, time_s, np.round(measured_deg / step_deg) * step_deg)


def realisation() -> ComplexArray:
    """Poles of python-control's realisation of order 4 (three and the delay), in continuous time."""
    segment = record("hs225bb-eq31", 0)
    parameters = control.markov(segment.measured_deg, segment.command_deg, MARKOV_PARAMETERS, dt=0.01)
    system, _ = control.eigensys_realization(parameters, 4, dt=0.01)
    eigenvalues = np.asarray(np.linalg.eigvals(system.A), dtype=np.complex128)
    return np.asarray(np.log(eigenvalues) / 0.01, dtype=np.complex128)


def dominant_error(poles: ComplexArray, truth: ComplexArray) -> float:
    dominant = truth[np.argmin(np.abs(truth))]
    return float(100.0 * np.min(np.abs(poles - dominant)) / abs(dominant))


def timed(action: Callable[[], Any]) -> tuple[float, Any]:
    begin = time.process_time()
    result = action()
    return time.process_time() - begin, result


if __name__ == "__main__":
    main()
