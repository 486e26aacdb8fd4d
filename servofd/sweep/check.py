"""Go or no-go for each surface, from a commanded sweep on the ground."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from servofd.detection.judge import judge
from servofd.detection.plausible import wiring_problem
from servofd.detection.residual import ResidualGenerator
from servofd.detection.words import describe
from servofd.errors import DesignError, NoMeasurement
from servofd.segment import SLOWEST_RATE_HZ, cut
from servofd.sweep.numbers import measure

if TYPE_CHECKING:
    from logparsers.records import FlightLog
    from servofd.aircraft import Aircraft, Surface
    from servofd.detection.bank.explanation import Estimate
    from servofd.models.servo_model import ServoModel
    from servofd.segment import Segment
    from servofd.sweep.numbers import SweepNumbers

SweepStatus = Literal["go", "no_go", "unknown"]

_THRESHOLDS = 2.0
"""A stuck servo must show twice the threshold, on both sides."""
_LEAST_DEG = 3.0
_FEWEST_SAMPLES = 30
_SHORT_SHARE = 0.05
_SMALL_PLAY_DEG = 0.6
"""Twice the bias that a fleet of healthy servos may have: play of that width shifts no position by more."""


@dataclass(frozen=True, slots=True)
class SurfaceSweep:
    """Whether a surface may fly."""

    surface: str
    status: SweepStatus
    reasons: tuple[str, ...]
    """Why not; or one sentence that says what was seen."""
    expected: bool = True
    """False if the aircraft does not measure this surface."""
    numbers: SweepNumbers | None = None


def check_sweep(log: FlightLog, aircraft: Aircraft, surfaces: tuple[str, ...] = ()) -> tuple[SurfaceSweep, ...]:
    """Judge the surfaces of a log in which each was moved to both sides on the ground.

    Parameters
    ----------
    log : FlightLog
        What was recorded.
    aircraft : Aircraft
        Surfaces, calibrations, servos and tolerances.
    surfaces : tuple of str
        Which to judge; all if empty.

    Examples
    --------
    >>> import logparsers
    >>> from servofd.aircraft import load_aircraft
    >>> log = logparsers.read("sample_logs/faser_stuck_chirp.mat")
    >>> check_sweep(log, load_aircraft("faser"), ("aileron_right",))[0].status
    'no_go'
    """
    found = []
    for name in surfaces or tuple(aircraft.surfaces):
        surface = aircraft.surfaces[name]
        try:
            segment = cut(log, name, surface)
        except NoMeasurement as reason:
            found.append(SurfaceSweep(name, "unknown", (str(reason),), expected=surface.measured is not None))
            continue
        found.append(check_segment(segment, surface, aircraft.model(name)))
    return tuple(found)


def check_segment(segment: Segment, surface: Surface, model: ServoModel) -> SurfaceSweep:
    """Judge one surface: what a live check calls with the last seconds of its stream.

    Returns
    -------
    SurfaceSweep
        ``go`` only if the surface was moved enough, to both sides, for a stuck one to have shown.
    """
    name = segment.surface
    rate_hz = 1.0 / segment.period_s if segment.period_s > 0.0 else 0.0
    if rate_hz < SLOWEST_RATE_HZ:
        slow = f"position comes at {rate_hz:.2g} Hz; a sweep needs {SLOWEST_RATE_HZ:g} Hz or more"
        return SurfaceSweep(name, "unknown", (slow,))
    try:
        generator = ResidualGenerator.fitting(model, segment, surface.filter_pole_rad_s)
    except DesignError as error:
        return SurfaceSweep(name, "unknown", (str(error),))
    residuals = generator.run(segment)
    if np.count_nonzero(residuals.settled) < _FEWEST_SAMPLES:
        few = f"fewer than {_FEWEST_SAMPLES} positions while commands came"
        return SurfaceSweep(name, "unknown", (few,))
    judgement = judge(generator, segment, residuals, surface)
    numbers = measure(generator, segment, residuals, judgement.threshold, surface.tolerances)
    # What is named explains all numbers that are wrong, and a wrong sign explains any name.
    wrong = [describe(fault) for fault in judgement.faults] or _out_of_tolerance(numbers, surface, model)
    if wrong and wiring_problem(residuals):
        wrong = [wiring_problem(residuals)]
    return _concluded(name, numbers, wrong, _not_enough(numbers, float(segment.command_deg[0])))


def _concluded(name: str, numbers: SweepNumbers, wrong: list[str], missing: str) -> SurfaceSweep:
    if wrong:
        return SurfaceSweep(name, "no_go", tuple(wrong), numbers=numbers)
    if missing:
        return SurfaceSweep(name, "unknown", (missing,), numbers=numbers)
    low, high = numbers.reached_deg
    seen = f"reached {low:+.1f} to {high:+.1f} deg, largest residual {numbers.residual_peak_deg:.2f} deg"
    return SurfaceSweep(name, "go", (seen,), numbers=numbers)


def _not_enough(numbers: SweepNumbers, rest_deg: float) -> str:
    """Which motion is missing; nothing if a stuck servo would have shown on both sides."""
    needed_deg = max(_LEAST_DEG, _THRESHOLDS * numbers.threshold_deg)
    low, high = (end - rest_deg for end in numbers.asked_deg)
    if low <= -needed_deg and high >= needed_deg:
        return ""
    return f"not moved enough ({low:+.1f} to {high:+.1f} deg): move it at least ±{np.ceil(needed_deg):.0f} deg"


def _out_of_tolerance(numbers: SweepNumbers, surface: Surface, model: ServoModel) -> list[str]:
    """What is certainly beyond the tolerances: the whole interval of an estimate, or travel that was not reached."""
    tolerance = surface.tolerances
    found = []
    if _beyond(numbers.gain, 1.0, tolerance.gain):
        found.append(f"moves by {numbers.gain.value:.0%} of its command (tolerance ±{tolerance.gain:.1%})")
    if _beyond(numbers.extra_delay_s, 0.0, tolerance.delay_s):
        found.append(
            f"lags by {1e3 * numbers.extra_delay_s.value:+.0f} ms more than its model "
            f"(tolerance ±{1e3 * tolerance.delay_s:.1f} ms)"
        )
    if _beyond(numbers.bandwidth, 1.0, tolerance.bandwidth):
        found.append(f"has {numbers.bandwidth.value:.0%} of its bandwidth (tolerance ±{tolerance.bandwidth:.0%})")
    if _beyond(numbers.bias_deg, 0.0, tolerance.bias_deg):
        found.append(f"is off by {numbers.bias_deg.value:+.2f} deg (tolerance ±{tolerance.bias_deg:.2g} deg)")
    if numbers.play_deg.low > max(2.0 * tolerance.bias_deg, _SMALL_PLAY_DEG):
        found.append(f"has a dead band or play of {numbers.play_deg.value:.1f} deg")
    return found + _short_of_travel(numbers, model)


def _beyond(estimate: Estimate, healthy: float, tolerance: float) -> bool:
    return estimate.low > healthy + tolerance or estimate.high < healthy - tolerance


def _short_of_travel(numbers: SweepNumbers, model: ServoModel) -> list[str]:
    """Ends that a healthy servo would have reached and this one did not."""
    plan = model.plan
    margin_deg = max(numbers.threshold_deg, _SHORT_SHARE * (numbers.expected_deg[1] - numbers.expected_deg[0]))
    low, high = max(numbers.expected_deg[0], plan.lower_deg), min(numbers.expected_deg[1], plan.upper_deg)
    found = []
    if numbers.reached_deg[0] > low + margin_deg:
        found.append(f"reaches {numbers.reached_deg[0]:+.1f} deg instead of {low:+.1f} deg")
    if numbers.reached_deg[1] < high - margin_deg:
        found.append(f"reaches {numbers.reached_deg[1]:+.1f} deg instead of {high:+.1f} deg")
    return found
