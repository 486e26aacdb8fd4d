r"""What one flight tells of one servo: one output-error fit, and the residual of the model as it stands.

The model is the aircraft file's servo with a zone of width :math:`w` in which the surface rests: before the servo (dead
band, thesis 4.2.1) or behind it (backlash of the linkage). A single flight may not tell which; all flights of a surface
together do, so both are fitted. Taken for a dead band, a backlash seems wider by a fifth.

For a width near zero the fit must be free to go to the other side, or noise would bias it upwards: where :math:`P_w u`
is the command :math:`u` after a play of width :math:`w`, the command for :math:`-w` is :math:`2u - P_w u` (of a
backlash the same with the servo's deflection), which continues :math:`P_w u` smoothly through :math:`w = 0`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from servofd.calibrating.flights import Flight, busiest
from servofd.core.errors import NoMeasurement
from servofd.detection.bank.window import noise_deg
from servofd.detection.glitches import prepared
from servofd.detection.residual import ResidualGenerator
from servofd.detection.threshold import constant_threshold, interval_threshold
from servofd.estimate.statistics import Estimate, descended, deviations, line, mean_loss, ordinary_deg
from servofd.servo.play import play
from servofd.wear.motion import Motion, noise_of
from servofd.wear.records import QUANTITIES
from servofd.wear.servo import FlownServo

if TYPE_CHECKING:
    from servofd.aircraft.schema import Aircraft
    from servofd.aircraft.segment import Segment
    from servofd.core.types import FloatArray
    from servofd.detection.residual import Residuals

_MOST_SAMPLES = 12_000
"""Two minutes at 100 Hz tell the width to 0.01 deg, which is less than it varies from flight to flight."""
_LEAST_SAMPLES = 300
_LEAST_MOTION_NOISES = 10.0
"""Less motion than ten times the noise tells nothing of delay and bandwidth."""
_WIDTHS_DEG = (0.0, 0.5, 1.0, 2.0, 4.0)
_EVALUATIONS = 25
_WIDTH_STEP_DEG, _STEP = 0.02, 0.01
"""For slopes, in degrees and in the units of `FlownServo.vector`."""
_LIMIT_REACHED = 0.5
"""Motion that would take the linear servo to half of its limit may show a limit that has fallen."""
_LEAST_RATE_SURENESS = 0.1
"""Deviation of the logarithm of a rate limit: more, and the flight hardly shows it."""
_SURE_SHARE, _BLOCKS = 0.999, 10


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    servo: FlownServo
    names: tuple[str, ...]
    vector: FloatArray
    """Width, the numbers of the servo, gain and offset."""
    deviation: FloatArray
    error_deg: FloatArray
    scale_deg: float
    """Errors beyond it count by their size."""


class ServoEstimate(NamedTuple):
    """What a flight tells of a servo, with 95 % intervals."""

    values: dict[str, Estimate]
    """Of `servofd.wear.records.QUANTITIES`, if the zone of rest is a dead band."""
    missing: dict[str, str]
    """Why others are not among them."""
    linkage: dict[str, Estimate]
    """What differs if it is backlash of the linkage."""
    evidence: float
    """Logarithm of how much better backlash explains the flight."""


def estimate_flight(segment: Segment, aircraft: Aircraft, voltage_v: float | None = None) -> ServoEstimate:
    """Estimate what `servofd.wear.records.QUANTITIES` lists, as far as the flight shows it.

    Parameters
    ----------
    voltage_v : float, optional
        Mean supply voltage of the servos [V], if it was logged.

    Returns
    -------
    ServoEstimate
        What the flight shows, and why it does not show the rest.

    Examples
    --------
    >>> from servofd.aircraft.schema import plain_aircraft
    >>> from servofd.servo.faults import DeadBand
    >>> from servofd.aircraft.segment import Segment
    >>> from servofd.simulation.flight import simulate_flight
    >>> plane = plain_aircraft(["rudder"], "hs225bb-eq31")
    >>> flown = simulate_flight(plane, seed=1, faults={"rudder": DeadBand(0.0, width_deg=0.8)})
    >>> segment = Segment("rudder", flown.time_s, flown.command_deg[:, 0], flown.time_s, flown.measured_deg[:, 0])
    >>> values = estimate_flight(segment, plane).values
    >>> values["dead_band_deg"].low < 0.8 < values["dead_band_deg"].high
    True
    """
    surface = aircraft.surfaces[segment.surface]
    generator = ResidualGenerator.fitting(aircraft.model(segment.surface), segment, surface.filter_pole_rad_s)
    segment, residuals, _ = prepared(generator, segment)
    if np.count_nonzero(residuals.settled) < _LEAST_SAMPLES:
        raise NoMeasurement(
            f"only {np.count_nonzero(residuals.settled)} samples that can be judged; too short a flight"
        )
    threshold = interval_threshold(generator, segment, residuals, surface.tolerances, surface.threshold_sigmas)
    if surface.threshold == "constant":
        threshold = constant_threshold(threshold, surface.threshold_deg)
    values = _of_residual(residuals, threshold.level_deg)
    prior = FlownServo.on(aircraft, segment.surface)
    motion = Motion.of(busiest(Flight("", segment), _MOST_SAMPLES), prior)
    problem = _too_calm(motion)
    if problem:
        return ServoEstimate(values, {name: problem for name in QUANTITIES if name not in values}, {}, 0.0)
    dead_band = _fitted(motion, prior)
    backlash = _descended(motion, prior, dead_band.names, dead_band.vector, dead_band.scale_deg, behind=True)
    values |= _of_fit(dead_band, motion, voltage_v)
    missing = {}
    if "rate_limit_deg_s" not in values:
        missing["rate_limit_deg_s"] = "never moved fast enough to show it"
    if "rate_per_volt_deg_s_v" not in values:
        missing["rate_per_volt_deg_s_v"] = missing.get("rate_limit_deg_s", "no supply voltage in the log")
    return ServoEstimate(values, missing, _of_fit(backlash, motion, voltage_v), _evidence(motion, dead_band, backlash))


def _evidence(motion: Motion, dead_band: _Fit, backlash: _Fit) -> float:
    """Logarithm of the odds for backlash, the memory of the errors taken into account."""
    losses = [mean_loss(fit.error_deg, dead_band.scale_deg) + 1e-12 for fit in (dead_band, backlash)]
    return 0.5 * motion.measured_deg.size / motion.memory(backlash.error_deg) * float(np.log(losses[0] / losses[1]))


def _of_residual(residuals: Residuals, level_deg: FloatArray) -> dict[str, Estimate]:
    """Size of the residual, and how much of the threshold is left."""
    judged = residuals.settled & np.isfinite(residuals.residual_deg)
    size_deg = np.abs(residuals.residual_deg[judged])
    value, low, high = _quantile(size_deg / level_deg[judged], _SURE_SHARE)
    return {"residual_p95_deg": _quantile(size_deg, 0.95), "margin": Estimate(1.0 - value, 1.0 - high, 1.0 - low)}


def _quantile(values: FloatArray, share: float) -> Estimate:
    """Quantile; its deviation comes from those of ten parts of the flight."""
    parts = [float(np.quantile(part, share)) for part in np.array_split(values, _BLOCKS)]
    return Estimate.of(float(np.quantile(values, share)), float(np.std(parts, ddof=1)) / np.sqrt(_BLOCKS))


def _too_calm(motion: Motion) -> str:
    """Why this flight tells nothing of the servo's dynamics, or nothing."""
    measured_deg = motion.measured_deg
    if measured_deg.size < _LEAST_SAMPLES:
        return "too few samples with command and position"
    low_deg, high_deg = np.percentile(measured_deg, [5.0, 95.0])
    if high_deg - low_deg < _LEAST_MOTION_NOISES * noise_deg(measured_deg):
        return "too little motion"
    return ""


def _fitted(motion: Motion, prior: FlownServo) -> _Fit:
    """Downhill from the width that fits best with the servo as it is known."""
    names = tuple(name for name in prior.numbers if name != "rate_limit_deg_s")
    if prior.rate_limit_deg_s is not None and motion.top_speed_deg_s(prior) > _LIMIT_REACHED * prior.rate_limit_deg_s:
        names = (*names, "rate_limit_deg_s")
    measured_deg = motion.measured_deg
    starts = []
    for width_deg in _WIDTHS_DEG:
        simulated_deg = _simulated(motion, prior, width_deg, behind=False)
        gain, offset_deg = line(simulated_deg, measured_deg)
        left_deg = float(np.median(np.abs(measured_deg - gain * simulated_deg - offset_deg)))
        starts.append((left_deg, width_deg, gain, offset_deg))
    left_deg, width_deg, gain, offset_deg = min(starts)
    begin = np.array([width_deg, *prior.vector(names), gain, offset_deg])
    return _descended(motion, prior, names, begin, ordinary_deg(max(left_deg, 1e-6)), behind=False)


def _descended(
    motion: Motion, prior: FlownServo, names: tuple[str, ...], begin: FloatArray, scale_deg: float, *, behind: bool
) -> _Fit:
    """Least squares from one starting point, of the zone of rest before or behind the servo."""
    measured_deg = motion.measured_deg
    steps = np.array([_WIDTH_STEP_DEG, *(_STEP for _ in names)])

    def shape(x: FloatArray) -> FloatArray:
        return _simulated(motion, prior.with_vector(names, x[1:-2]), float(x[0]), behind=behind)

    def error(x: FloatArray) -> FloatArray:
        left_deg: FloatArray = measured_deg - x[-2] * shape(x) - x[-1]
        return left_deg

    def slopes(x: FloatArray) -> FloatArray:
        shifted = np.vstack([np.diag(steps), np.zeros((2, steps.size))]).T
        here = shape(x)
        columns = [-x[-2] * (shape(x + d) - here) / h for d, h in zip(shifted, steps, strict=True)]
        all_slopes: FloatArray = np.column_stack([*columns, -here, -np.ones(measured_deg.size)])
        return all_slopes

    # A delay cannot be negative, but a start at zero must lie within.
    least = np.array([-np.inf, *(-1e-9 if name == "delay_s" else -np.inf for name in names), -np.inf, -np.inf])
    bounds = (least, np.full(begin.size, np.inf))
    found, _ = descended(error, slopes, begin, bounds, evaluations=_EVALUATIONS, scale_deg=scale_deg)
    left_deg = error(found)
    deviation = deviations(slopes(found), left_deg, motion.memory(left_deg))
    return _Fit(prior.with_vector(names, found[1:-2]), names, found, deviation, left_deg, scale_deg)


def _simulated(motion: Motion, servo: FlownServo, width_deg: float, *, behind: bool) -> FloatArray:
    """Deflection of a servo with a zone of rest, in all used rows [deg], shape (n,)."""
    if behind:
        return np.concatenate([_rested(part, width_deg) for part in motion.split(motion.simulated_deg(servo))])
    return motion.with_commands(lambda command_deg: _rested(command_deg, width_deg)).simulated_deg(servo)


def _rested(values_deg: FloatArray, width_deg: float) -> FloatArray:
    """What is left of a motion behind a play, of a width that may be negative."""
    if values_deg.size == 0:
        return values_deg
    followed_deg = play(values_deg, abs(width_deg), float(values_deg[0]))
    return followed_deg if width_deg >= 0.0 else 2.0 * values_deg - followed_deg


def _of_fit(fit: _Fit, motion: Motion, voltage_v: float | None) -> dict[str, Estimate]:
    """What was fitted, in the units of `QUANTITIES`."""
    width, *numbers, _, offset = (Estimate.of(*pair) for pair in zip(fit.vector, fit.deviation, strict=True))
    noise = noise_of(motion.measured_deg, fit.error_deg)
    values = {
        "dead_band_deg": width,
        "bias_deg": offset,
        "noise_deg": Estimate.of(noise, noise / np.sqrt(fit.error_deg.size)),
    }
    for name, estimate in zip(fit.names, numbers, strict=True):
        if name == "delay_s":
            values[name] = Estimate(*(1e-3 * end for end in estimate))
        elif name == "bandwidth_hz" or (name == "rate_limit_deg_s" and estimate.deviation < _LEAST_RATE_SURENESS):
            values[name] = Estimate(*np.exp(np.clip(estimate, -50.0, 50.0)).tolist())
    if voltage_v is not None and "rate_limit_deg_s" in values:
        values["rate_per_volt_deg_s_v"] = Estimate(*(end / voltage_v for end in values["rate_limit_deg_s"]))
    return values
