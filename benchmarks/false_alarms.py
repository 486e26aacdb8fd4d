"""Predicted against observed false alarms: ``python benchmarks/false_alarms.py [HOURS] [TARGET_PER_HOUR] [FIT_HOURS]``.

White noise goes through the residual filter of the HS-225BB (100 Hz, 50 rad/s). Thresholds are predicted for the target
rate, then alarms are counted in flight hours that the prediction has not seen. Gaussian noise: thresholds from the
up-crossing integral, for one sample and for three in a row. Student's t with six degrees of freedom: from a Pareto
fit to FIT_HOURS of healthy residual; and, for comparison, what the Gaussian formula makes of the same record.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

from servofd.core.types import FloatArray
from servofd.detection.probability import Noise, TailFit, fit_tail, persistent_threshold_deg, threshold_for_rate_deg
from servofd.detection.pulse import PulseFilter, design_pulse_filter
from servofd.servo.library import servo_named

RATE_HZ, POLE_RAD_S, NOISE_DEG = 100.0, 50.0, 0.1
SAMPLES_PER_HOUR = round(3600 * RATE_HZ)
APART_SAMPLES = 15
DEGREES_OF_FREEDOM = 6
SETTLED_SAMPLES = 100
THREADS = 2


class Outcome(NamedTuple):
    """One threshold, what was predicted for it, and what happened."""

    what: str
    threshold_deg: float
    predicted_per_hour: float
    alarms: int
    hours: int

    @property
    def observed_per_hour(self) -> float:
        """Alarms per simulated hour."""
        return self.alarms / self.hours

    @property
    def standard_error_per_hour(self) -> float:
        """Of the observed rate: alarms are rare and independent."""
        return float(np.sqrt(max(self.alarms, 1))) / self.hours

    @property
    def ratio(self) -> float:
        """Observed over predicted."""
        return self.observed_per_hour / self.predicted_per_hour


def gaussian(rng: np.random.Generator, size: int) -> FloatArray:
    return NOISE_DEG * rng.standard_normal(size)


def student(rng: np.random.Generator, size: int) -> FloatArray:
    """Heavy-tailed noise of the same standard deviation."""
    unit = rng.standard_normal(size) / np.sqrt(rng.standard_gamma(DEGREES_OF_FREEDOM / 2.0, size))
    scaled: FloatArray = NOISE_DEG * np.sqrt((DEGREES_OF_FREEDOM - 2.0) / 2.0) * unit
    return scaled


def hour_of_residual(
    design: PulseFilter, noise: Callable[[np.random.Generator, int], FloatArray], seed: tuple[int, int]
) -> FloatArray:
    white = noise(np.random.default_rng(seed), SAMPLES_PER_HOUR + SETTLED_SAMPLES)
    residual: FloatArray = lfilter(design.g * design.a, design.md, white)[SETTLED_SAMPLES:]
    return residual


def alarms_in(residual_deg: FloatArray, threshold_deg: float, in_a_row: int = 1) -> int:
    """Alarms at least 15 samples apart: nearer ones are one alarm to whoever hears them."""
    over = np.sign(residual_deg) * (np.abs(residual_deg) >= threshold_deg)
    candidates = np.flatnonzero(over)
    if in_a_row > 1:
        candidates = candidates[candidates >= in_a_row - 1]
        for back in range(1, in_a_row):
            candidates = candidates[over[candidates] == over[candidates - back]]
    return int(np.count_nonzero(np.diff(candidates, prepend=-APART_SAMPLES - 1) >= APART_SAMPLES))


def observed(
    design: PulseFilter,
    noise: Callable[[np.random.Generator, int], FloatArray],
    watches: list[tuple[float, int]],
    hours: int,
    seed: int,
) -> list[int]:
    """Alarms of each watch, a threshold and a number of samples in a row, over fresh hours."""

    def one(hour: int) -> list[int]:
        residual_deg = hour_of_residual(design, noise, (seed, hour))
        return [alarms_in(residual_deg, *watch) for watch in watches]

    with ThreadPoolExecutor(THREADS) as pool:
        return [int(total) for total in np.sum(list(pool.map(one, range(hours))), axis=0)]


def fitted(design: PulseFilter, hours: int, seed: int) -> tuple[TailFit, Noise]:
    """Tail and colour of a healthy record of heavy-tailed noise."""
    record = np.concatenate([hour_of_residual(design, student, (seed, hour)) for hour in range(hours)])
    lags = design.impulse_response().size // 2
    return fit_tail(record, design.sample_time_s, APART_SAMPLES), Noise.measured(record, design.sample_time_s, lags)


def compare(hours: int, target_per_hour: float, fit_hours: int, seed: int = 1) -> Iterator[Outcome]:
    design = design_pulse_filter(servo_named("hs225bb-eq31").transfer, 0.004, 1.0 / RATE_HZ, POLE_RAD_S)
    noise = Noise.designed(design, NOISE_DEG)
    outcome = partial(Outcome, predicted_per_hour=target_per_hour, hours=hours)
    single = threshold_for_rate_deg(target_per_hour, noise.sigma_deg, noise.correlation, noise.sample_time_s)
    triple = persistent_threshold_deg(target_per_hour, noise, 3)
    counts = observed(design, gaussian, [(single, 1), (triple, 3)], hours, seed)
    yield outcome("Gaussian noise, up-crossing", single, alarms=counts[0])
    yield outcome("Gaussian noise, 3 in a row", triple, alarms=counts[1])
    tail, rough = fitted(design, fit_hours, seed + 1)
    heavy, _ = tail.threshold_deg(target_per_hour)
    naive = threshold_for_rate_deg(target_per_hour, rough.sigma_deg, rough.correlation, rough.sample_time_s)
    counts = observed(design, student, [(heavy, 1), (naive, 1)], hours, seed + 2)
    factor = np.exp(tail.log_rate_error(heavy))
    what = f"t6 noise, tail of {fit_hours} h (xi {tail.index:.3f} ± {tail.index_error:.3f}, factor {factor:.2f})"
    yield outcome(what, heavy, alarms=counts[0])
    yield outcome("t6 noise, Gaussian formula", naive, alarms=counts[1])


def main(hours: int = 1000, target_per_hour: float = 0.1, fit_hours: int = 100) -> list[Outcome]:
    outcomes = []
    for outcome in compare(hours, target_per_hour, fit_hours):
        print(
            f"{outcome.what}: threshold {outcome.threshold_deg:.4f} deg, predicted {target_per_hour:g}/h, observed "
            f"{outcome.observed_per_hour:.4g} ± {outcome.standard_error_per_hour:.2g} /h over {hours} h, "
            f"ratio {outcome.ratio:.3g}",
            flush=True,
        )
        outcomes.append(outcome)
    return outcomes


if __name__ == "__main__":
    words = sys.argv[1:]
    main(
        int(words[0]) if words else 1000,
        float(words[1]) if len(words) > 1 else 0.1,
        int(words[2]) if len(words) > 2 else 100,
    )
