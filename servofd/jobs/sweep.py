"""A sweep on the ground: what it shows of each servo in numbers, and go or no-go."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from logparsers.units import MS_PER_S
from servofd.aircraft.priors import NAMES
from servofd.aircraft.series import SLOWEST_RATE_HZ, cut
from servofd.core.errors import DesignError, NoMeasurement
from servofd.core.statistics import LEAST_DIVISOR, Estimate
from servofd.detection.named import judge
from servofd.detection.residual import ResidualGenerator
from servofd.detection.verdict import describe
from servofd.detection.wiring import wiring_problem

if TYPE_CHECKING:
    from logparsers.records import FlightLog
    from servofd.aircraft.schema import Aircraft, Surface
    from servofd.aircraft.series import Series
    from servofd.core.types import FloatArray
    from servofd.detection.named import Judgement
    from servofd.detection.residual import Residuals
    from servofd.servo.servo_model import ServoModel

_FITTED = ("gain", "delay_s", "ln_bandwidth", "bias_deg", "play_deg")
_WIDE = np.array([1.0, 0.1, 1.0, 30.0, 30.0])
"""Prior standard deviations of these: wide, a sweep is all motion."""


class SweepNumbers(NamedTuple):
    """Travel, and how the servo differs from its model."""

    asked_deg: tuple[float, float]
    """Lowest and highest command [deg]."""
    expected_deg: tuple[float, float]
    """Lowest and highest deflection of a healthy servo [deg]."""
    reached_deg: tuple[float, float]
    """Lowest and highest measured deflection [deg]."""
    gain: Estimate
    """Deflection per degree of command."""
    extra_delay_s: Estimate
    """Beyond that of the model [s]."""
    bandwidth_scale: Estimate
    """Over that of the model."""
    bias_deg: Estimate
    play_deg: Estimate
    """Full width of dead band or backlash, seen when the motion turns round [deg]."""
    fastest_deg_s: float
    """Speed of the surface, single samples left out [deg/s]."""
    residual_peak_deg: float
    threshold_deg: float
    """Median level [deg]."""


def measure(judgement: Judgement, segment: Series, residuals: Residuals) -> SweepNumbers:
    """Fit gain, delay, bandwidth, bias and play to a sweep, by the sensitivities of the healthy servo."""
    flight = judgement.flight
    judged = np.flatnonzero(residuals.settled)
    used = flight.judged
    time_s, measured_deg, healthy_deg = (
        values[used] for values in (residuals.time_s, residuals.measured_deg, flight.reading_deg)
    )
    slopes = flight.slopes[used][:, [NAMES.index(name) for name in _FITTED]]
    noise_deg = float(np.median(flight.noise_deg[used]))
    error_deg = measured_deg - healthy_deg
    inverse = np.linalg.inv(slopes.T @ slopes + np.diag((noise_deg / _WIDE) ** 2))
    change = inverse @ slopes.T @ error_deg
    deviation = _misfit_deviation(error_deg - slopes @ change, noise_deg) * np.sqrt(np.diag(inverse))
    gain, delay, bandwidth, bias, width = (
        Estimate.of(offset + float(value), float(sure))
        for offset, value, sure in zip((1.0, 0.0, 1.0, 0.0, 0.0), change, deviation, strict=True)
    )
    asked = segment.command_deg[
        (segment.command_s >= residuals.time_s[0]) & (segment.command_s <= residuals.time_s[-1])
    ]
    return SweepNumbers(
        _ends(asked if asked.size else segment.command_deg),
        _ends(healthy_deg),
        _ends(measured_deg),
        gain,
        delay,
        bandwidth,
        bias,
        width,
        _fastest_deg_s(time_s, measured_deg),
        float(np.max(np.abs(residuals.residual_deg[judged]))),
        judgement.threshold.typical_deg,
    )


def _misfit_deviation(misfit_deg: FloatArray, noise_deg: float) -> float:
    """Deviation of the misfit, enlarged for its colour: neighbours that agree tell less than strangers."""
    deviation = max(noise_deg, float(np.sqrt(np.mean(misfit_deg**2))))
    if misfit_deg.size < 3:
        return deviation
    power = float(misfit_deg @ misfit_deg)
    likeness = min(max(float(misfit_deg[1:] @ misfit_deg[:-1]) / max(power, LEAST_DIVISOR), 0.0), 0.98)
    return deviation * float(np.sqrt((1.0 + likeness) / (1.0 - likeness)))


def _ends(values_deg: FloatArray) -> tuple[float, float]:
    return float(np.min(values_deg)), float(np.max(values_deg))


def _fastest_deg_s(time_s: FloatArray, measured_deg: FloatArray) -> float:
    """Largest speed over 50 ms [deg/s]: over single samples it would be that of the noise."""
    ahead = np.minimum(np.searchsorted(time_s, time_s + 0.05), time_s.size - 1)
    step_s = time_s[ahead] - time_s
    speed = np.abs(measured_deg[ahead] - measured_deg)[step_s > 0.0] / step_s[step_s > 0.0]
    return float(np.max(speed, initial=0.0))


SweepStatus = Literal["go", "no_go", "unknown"]

_THRESHOLDS = 2.0
"""A stuck servo must show twice the threshold, on both sides."""
_LEAST_DEG = 3.0
"""Smallest travel to either side that a sweep needs [deg]."""
_FEWEST_SAMPLES = 30
"""Positions that a surface needs to be judged."""
_SHORT_SHARE = 0.05
"""Share of the expected travel that may be missing."""
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
    surfaces : tuple of str
        Which to judge; all if empty.

    Examples
    --------
    >>> import logparsers
    >>> from servofd.aircraft.schema import load_aircraft
    >>> log = logparsers.read("sample_logs/faser_stuck_chirp.mat")
    >>> check_sweep(log, load_aircraft("faser"), ("aileron_right",))[0].status
    'no_go'
    """
    found = []
    for name in surfaces or tuple(aircraft.surfaces):
        surface = aircraft.surfaces[name]
        try:
            segment = cut(log, name, aircraft)
        except NoMeasurement as reason:
            found.append(SurfaceSweep(name, "unknown", (str(reason),), expected=surface.measured is not None))
            continue
        found.append(check_segment(segment, surface, aircraft.model(name)))
    return tuple(found)


def check_segment(segment: Series, surface: Surface, model: ServoModel) -> SurfaceSweep:
    """Judge one surface: what a live check calls with the last seconds of its stream."""
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
    numbers = measure(judgement, segment, residuals)
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
            f"lags by {MS_PER_S * numbers.extra_delay_s.value:+.0f} ms more than its model "
            f"(tolerance ±{MS_PER_S * tolerance.delay_s:.1f} ms)"
        )
    if _beyond(numbers.bandwidth_scale, 1.0, tolerance.bandwidth):
        found.append(f"has {numbers.bandwidth_scale.value:.0%} of its bandwidth (tolerance ±{tolerance.bandwidth:.0%})")
    if _beyond(numbers.bias_deg, 0.0, tolerance.bias_deg):
        found.append(f"is off by {numbers.bias_deg.value:+.2f} deg (tolerance ±{tolerance.bias_deg:.2g} deg)")
    if numbers.play_deg.low > max(2.0 * tolerance.bias_deg, _SMALL_PLAY_DEG):
        found.append(f"has a dead band or play of {numbers.play_deg.value:.1f} deg")
    return found + _short_of_travel(numbers, model)


def _beyond(estimate: Estimate, healthy: float, tolerance: float) -> bool:
    return estimate.low > healthy + tolerance or estimate.high < healthy - tolerance


def _short_of_travel(numbers: SweepNumbers, model: ServoModel) -> list[str]:
    """Ends that a healthy servo would have reached and this one did not."""
    physics = model.physics
    margin_deg = max(numbers.threshold_deg, _SHORT_SHARE * (numbers.expected_deg[1] - numbers.expected_deg[0]))
    low, high = max(numbers.expected_deg[0], physics.lower_deg), min(numbers.expected_deg[1], physics.upper_deg)
    found = []
    if numbers.reached_deg[0] > low + margin_deg:
        found.append(f"reaches {numbers.reached_deg[0]:+.1f} deg instead of {low:+.1f} deg")
    if numbers.reached_deg[1] < high - margin_deg:
        found.append(f"reaches {numbers.reached_deg[1]:+.1f} deg instead of {high:+.1f} deg")
    return found
