"""Calibration of one surface."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servofd.calibrating.fit import ServoFit, fit_servo
from servofd.calibrating.flights import asked_deg
from servofd.calibrating.levels import MARGIN, levels_for, sigmas_for, terms_of, widened, with_tail
from servofd.calibrating.order import runs_ahead
from servofd.calibrating.result import Before, CalibratedSurface, FlightRecord
from servofd.calibrating.servo import FlownServo
from servofd.calibrating.sound import problem
from servofd.calibrating.spread import tolerance_from
from servofd.calibrating.still import stands_still
from servofd.calibrating.stretches import Flown, flown, stretches_of, telling
from servofd.detection.bank.explanation import Estimate
from servofd.detection.bank.window import noise_deg
from servofd.detection.judge import judge
from servofd.detection.pulse import fastest_pole_rad_s
from servofd.errors import CalibrationError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servofd.aircraft import Aircraft, Surface
    from servofd.calibrating.flights import Flight
    from servofd.models.servo_model import ServoModel
    from servofd.tolerance import Tolerance

__all__ = ["calibrate_surface", "hardly_moved"]

_ENOUGH_MOTION_DEG = 1.0
_SHORTEST_S = 2.5
"""A bench test that is all motion; a flight says more."""
_SLOWEST_HZ = 15.0
"""Healthy residuals pass 0.4 deg at 10 Hz and 0.13 deg at 25 Hz for lack of samples: no base for a threshold."""
_GAINS = (0.5, 2.0)
_USUAL_GAINS = (0.8, 1.25)
_LARGE_SHARE = 2.0
_POOR = 0.1
_TRIALS = 6
_ADVICE = "leave that part out (--until, --between), or the surface (-s)"


def hardly_moved(flights: Sequence[Flight]) -> str:
    """Say what these flights lack for a calibration; nothing if they may do.

    Examples
    --------
    >>> from servofd.calibrating.flights import Flight
    >>> from servofd.segment import Segment
    >>> t = np.arange(2000) / 100.0
    >>> hardly_moved([Flight("a.csv", Segment("x", t, 0.0 * t, t, 0.0 * t))])
    'the command moves by 0 deg only; a calibration needs 1 deg or more'
    """
    for flight in flights:
        rate_hz = 1.0 / flight.segment.period_s if flight.segment.period_s > 0.0 else 0.0
        if rate_hz < _SLOWEST_HZ:
            return f"{flight.label}: position comes at {rate_hz:.2g} Hz; a calibration needs {_SLOWEST_HZ:g} Hz or more"
    seconds = sum(flight.segment.duration_s for flight in flights)
    if seconds < _SHORTEST_S:
        return f"only {seconds:.1f} s of flight; a calibration needs {_SHORTEST_S:g} s or more"
    motion_deg = max(float(np.ptp(asked_deg(flight.segment))) for flight in flights)
    if motion_deg < _ENOUGH_MOTION_DEG:
        return f"the command moves by {motion_deg:.2g} deg only; a calibration needs {_ENOUGH_MOTION_DEG:g} deg or more"
    return ""


def calibrate_surface(flights: Sequence[Flight], aircraft: Aircraft, rate_per_hour: float) -> CalibratedSurface:
    """Fit the servo of one surface, then its tolerances and thresholds.

    Parameters
    ----------
    flights : sequence of Flight
        Of one surface; long enough and with motion (`hardly_moved` says nothing).
    aircraft : Aircraft
        What is known of it.
    rate_per_hour : float
        Wanted false alarms of this surface.

    Raises
    ------
    CalibrationError
        If the flights cannot all be good.
    """
    name = flights[0].segment.surface
    surface = aircraft.surfaces[name]
    prior = FlownServo.on(aircraft, name)
    _check_moves(name, flights)
    fit = _as_known(flights, aircraft, prior) if surface.effects else fit_servo(flights, prior, surface.tolerances)
    model = aircraft.model(name) if surface.effects else fit.servo.model
    _check_fit(name, fit, flights)
    _check_scale(name, fit)
    scaled = [flight.with_scale(fit.gain.value, fit.offset_deg.value) for flight in flights]
    pole_rad_s = surface.filter_pole_rad_s or _pole_rad_s(model, flights)
    runs = [flown(flight, model, pole_rad_s) for flight in scaled]
    stretches = [s for run in runs for s in stretches_of(run, surface.tolerances, fit.noise_deg)]
    if not stretches:
        raise CalibrationError(
            f"{name}: no stretch of a second in which the surface moves: fly, or move the sticks, for longer"
        )
    tolerance = tolerance_from(telling(stretches), _half_widths(fit), surface.tolerances, fit.noise_deg)
    sigmas = sigmas_for(rate_per_hour, runs[0])
    terms = terms_of(runs, tolerance)
    wrong = problem(runs, stretches, terms, tolerance, sigmas, surface)
    if wrong:
        raise CalibrationError(f"{name}: not a good flight: {wrong}; {_ADVICE}")
    tolerance = widened(terms, tolerance, sigmas)
    tolerance = with_tail(terms, tolerance, sigmas, rate_per_hour, scaled[0].segment.period_s)
    tolerance, suspicions = _verified(runs, surface, tolerance, sigmas)
    levels = levels_for(terms, tolerance, rate_per_hour, sigmas, scaled[0].segment.period_s)
    return CalibratedSurface(
        name,
        fit,
        levels,
        pole_rad_s,
        _before(flights, aircraft),
        tuple(FlightRecord(flight.label, flight.segment.duration_s) for flight in flights),
        len(telling(stretches)),
        suspicions,
        _notes(fit, prior),
    )


def _verified(runs: Sequence[Flown], surface: Surface, tolerance: Tolerance, sigmas: float) -> tuple[Tolerance, bool]:
    """Tolerances under which an audit of these flights finds nothing, and whether it may look for small faults."""
    for suspicions in (True, False):
        for _ in range(_TRIALS):
            judged = surface.model_copy(
                update={
                    "threshold": "interval",
                    "threshold_sigmas": sigmas,
                    "tolerance": tolerance,
                    "suspicions": suspicions,
                }
            )
            found = [judge(run.generator, run.flight.segment, run.residuals, judged) for run in runs]
            if not any(judgement.faults or judgement.suspicions for judgement in found):
                return tolerance, suspicions
            if suspicions:
                break
            tolerance = tolerance.scaled(MARGIN)
    raise CalibrationError(
        f"{runs[0].flight.segment.surface}: no tolerances keep these flights free of alarms: not one servo, or a fault"
    )


def _check_moves(name: str, flights: Sequence[Flight]) -> None:
    for flight in flights:
        ahead = runs_ahead(flight)
        if ahead:
            raise CalibrationError(f"{name}: {ahead}")
        where = stands_still(flight)
        if where:
            raise CalibrationError(f"{name}: not a good flight: {where}; {_ADVICE}")


def _check_scale(name: str, fit: ServoFit) -> None:
    gain = abs(fit.gain.value)
    if not _GAINS[0] <= gain <= _GAINS[1]:
        raise CalibrationError(
            f"{name}: the position moves {gain:.3g} times as far as the command: check units and channels of the "
            "aircraft file; a calibration corrects factors between 0.5 and 2"
        )


def _as_known(flights: Sequence[Flight], aircraft: Aircraft, prior: FlownServo) -> ServoFit:
    """A servo with effects: they were fitted together with what they act on, and no part of it is fitted anew."""
    name = flights[0].segment.surface
    runs = [flown(flight, aircraft.model(name), aircraft.surfaces[name].filter_pole_rad_s) for flight in flights]
    error_deg = np.concatenate([run.residuals.error_deg[run.residuals.settled] for run in runs])
    return ServoFit(
        prior,
        Estimate(1.0, 1.0, 1.0),
        Estimate(0.0, 0.0, 0.0),
        {},
        dict.fromkeys(prior.numbers, "the effects of this surface were found around it"),
        noise_deg(error_deg),
        float(np.sqrt(np.mean(error_deg**2))) if error_deg.size else 0.0,
    )


def _pole_rad_s(model: ServoModel, flights: Sequence[Flight]) -> float:
    """Fastest filter pole that suits all these flights; thresholds hold for the filter that they were found with."""
    return min(fastest_pole_rad_s(model.transfer, flight.segment.period_s) for flight in flights)


def _check_fit(name: str, fit: ServoFit, flights: Sequence[Flight]) -> None:
    """Refuse a servo that no linear model with a rate limit comes near."""
    positions = np.concatenate([flight.segment.measured_deg for flight in flights]) / abs(fit.gain.value)
    low_deg, high_deg = np.nanpercentile(positions, [2.0, 98.0])
    beyond_noise_deg = float(np.sqrt(max(fit.error_rms_deg**2 - fit.noise_deg**2, 0.0)))
    if beyond_noise_deg > _POOR * (high_deg - low_deg):
        raise CalibrationError(
            f"{name}: the best servo leaves {fit.error_rms_deg:.2g} deg rms of a motion of {high_deg - low_deg:.3g} deg"
            ": a fault in large parts of these flights, or friction or load beyond the model; `servofd audit` and "
            "`servofd explain` tell more"
        )


def _half_widths(fit: ServoFit) -> dict[str, float]:
    """Half the 95 % interval of each number that was fitted, in the units of `Tolerance`."""
    gain = abs(fit.gain.value)
    half = {"gain": (fit.gain.high - fit.gain.low) / 2.0 / gain}
    half["bias_deg"] = (fit.offset_deg.high - fit.offset_deg.low) / 2.0 / gain
    for name, key in (("bandwidth_hz", "bandwidth"), ("rate_limit_deg_s", "rate")):
        if name in fit.numbers:
            value, low, high = fit.numbers[name]
            half[key] = (high - low) / 2.0 / value
    if "delay_s" in fit.numbers:
        half["delay_s"] = (fit.numbers["delay_s"].high - fit.numbers["delay_s"].low) / 2.0
    return half


def _before(flights: Sequence[Flight], aircraft: Aircraft) -> Before:
    """Residual of the aircraft file as it was."""
    name = flights[0].segment.surface
    surface: Surface = aircraft.surfaces[name]
    runs = [flown(flight, aircraft.model(name), surface.filter_pole_rad_s) for flight in flights]
    residual = np.concatenate([run.residuals.residual_deg[run.residuals.settled] for run in runs])
    return Before(float(np.std(residual)), surface.threshold_deg)


def _notes(fit: ServoFit, prior: FlownServo) -> tuple[str, ...]:
    """What is unusual: it may be the nature of this servo, or a fault as old as the flights."""
    notes = []
    gain = fit.gain.value
    if gain < 0.0:
        notes.append("the position runs against the command: the sign of the file was wrong, or a linkage is reversed")
    if not _USUAL_GAINS[0] <= abs(gain) <= _USUAL_GAINS[1]:
        notes.append(f"the position moves {abs(gain):.2f} times as far as the command: check unit and linkage")
    share = fit.servo.bandwidth_hz / prior.bandwidth_hz
    if not 1.0 / _LARGE_SHARE < share < _LARGE_SHARE:
        notes.append(f"{share:.2g} times the bandwidth of {prior.prior.title}: is this the right servo?")
    if fit.error_rms_deg > 5.0 * max(fit.noise_deg, 1e-3):
        notes.append(
            f"the model leaves {fit.error_rms_deg:.2g} deg rms, the noise is {fit.noise_deg:.2g} deg: something else "
            "is in this servo; thresholds are wide for it"
        )
    return tuple(notes)
