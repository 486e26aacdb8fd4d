"""From known-good flights to a calibrated aircraft: effects of each surface, and how well they predict unseen data."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Final

import numpy as np

from servofd.aircraft.calibrated import CalibratedServo
from servofd.aircraft.calibration import DegreeCalibration
from servofd.aircraft.priors import NAMES, PRIORS
from servofd.aircraft.schema import Aircraft, Surface
from servofd.calibrating.result import CalibratedSurface, Calibration
from servofd.core.errors import CalibrationError
from servofd.core.evidence import USUAL_GAINS, Detectable, ModelOrigin, what_is_unknown
from servofd.core.statistics import Z_95, Estimate
from servofd.core.types import FloatArray
from servofd.detection.changes import detectable
from servofd.detection.evidence import is_blind
from servofd.detection.flights import Flight
from servofd.detection.known import (
    SPOKEN,
    after_more_flights,
    constant_deg,
    hardly_moved,
    known_servo,
    linear_servo,
    refuse_broken,
    refuse_mixed,
    refuse_unlike,
    thresholds_above,
    tolerance_of,
)
from servofd.detection.moving import watched
from servofd.estimate.fit import EACH_WIDTH, WIDTHS, Fit, fit
from servofd.estimate.record import Record, fastest_m_s, load_at, usual_airspeed_m_s, usual_supply_v

_FAST_M_S: Final = 25.0
"""Airspeed for which the deflection under air load is given [m/s]."""

_WORTH_FLYING: Final = 0.1
"""Share by which more flights must shrink a smallest fault to be worth a note."""
_SLOWER_THAN_FLIGHT_M_S: Final = 8.0
"""An airspeed that never exceeds this was not measured in flight [m/s]."""
_VAGUE: Final = 4.0
"""A parameter is vague if its variance is so many times the usual one between flights."""

_RESTING: Final = {"friction_deg": "friction", "deadband_deg": "dead band", "play_deg": "play"}
_FLYING: Final = 0.1
"""Median dynamic pressure, over its unit in the model, above which the calibration flew."""
_SOME_S: Final = 0.02
"""Time between the measurements that servos are compared with [s]."""
_LEAST_SHOWN_DEG: Final = 0.02
"""Smallest width of play, friction or dead band that is given as a lower bound [deg]."""


def calibrate_surface(flights: Sequence[Flight], aircraft: Aircraft) -> CalibratedSurface:
    """Fit the servo of one surface, what it may differ by between flights, and its thresholds."""
    name = flights[0].segment.surface
    surface = aircraft.surfaces[name]
    if surface.measured is None:
        raise CalibrationError(f"{name}: the aircraft file names no measured channel for it")
    flights = [replace(flight, segment=flight.segment.coarser()) for flight in flights]
    supply_v = float(np.median([usual_supply_v(flight.segment.context) for flight in flights]))
    airspeed_m_s = usual_airspeed_m_s([flight.segment.context for flight in flights])
    some = [replace(flight, segment=flight.segment.coarser(_SOME_S)) for flight in flights]
    records = [Record.of(flight.segment, supply_v, airspeed_m_s) for flight in some]
    first = fit(records)
    gain, offset_deg = first.theta[0], first.offset_deg
    refuse_unlike(name, first, records, some, (supply_v, airspeed_m_s))
    refuse_mixed(name, first, records, some)
    measured = surface.measured.corrected(1.0 / gain, -offset_deg / gain)
    scale, shift_deg = float(f"{measured.correction[0]:.6g}"), round(measured.correction[1], 4)
    measured = measured.model_copy(update={"correction": (scale, shift_deg)})
    scaled = [flight.with_scale(gain, offset_deg) for flight in flights]
    records = [Record.of(flight.segment, supply_v, airspeed_m_s) for flight in scaled]
    fitted = fit(records, start=_scaled(first.theta))
    fastest = fastest_m_s([flight.segment.context for flight in flights])
    known = known_servo(fitted, records, supply_v, airspeed_m_s, fastest_m_s=fastest)
    refuse_broken(name, known, records, scaled)
    known = known.model_copy(update={"thresholds": thresholds_above(known, fitted, records)})
    sizes = detectable(watched(known, record).looked for record in records)
    logs = ", ".join(f"{flight.label} ({flight.segment.duration_s:.0f} s)" for flight in flights)
    servo = linear_servo(fitted.theta, f"fitted to {logs}")
    # The first fit knows what other servos would have done as well.
    deviations = np.maximum(fitted.estimates[:, 1], first.estimates[:, 1])
    estimates = {key: Estimate.of(*each) for key, *each in zip(NAMES, fitted.estimates[:, 0], deviations, strict=True)}
    estimates["delay_s"] = fitted.delay_s
    return CalibratedSurface(
        name,
        known,
        estimates,
        fitted.bandwidth_rad_s,
        _effects(fitted, records, estimates),
        measured,
        servo,
        tolerance_of(known),
        constant_deg(fitted),
        fitted.held_out_rms_deg,
        fitted.explained_share,
        tuple(flight.label for flight in flights),
        sizes,
        _sharper(known, fitted, records, sizes),
        _notes(gain, known, surface, fitted.bandwidth_rad_s),
    )


def _scaled(theta: FloatArray) -> FloatArray:
    """The same servo with a reading in degrees of the command."""
    gain, out = theta[0], theta.copy()
    out[[NAMES.index(name) for name in ("gain", "bias_deg")]] = 1.0, 0.0
    out[NAMES.index("ln_rate")] -= np.log(gain)
    out[[name.endswith("_deg") for name in NAMES]] /= gain
    return out


_LINEAR: Final = ("gain", "bias_deg", "delay_s", "ln_bandwidth", "ln_damping", "ln_rate")
"""Parameters that every servo has, and that the first table shows."""
_IN_WORDS: Final = (*_LINEAR, *_RESTING, "hinge", "hinge_deg", "bend2_deg", "bend3_deg")
"""Parameters with a sentence of their own beside these; what else is calibrated is shown by its name."""


def _effects(fitted: Fit, records: Sequence[Record], estimates: Mapping[str, Estimate]) -> tuple[str, ...]:
    """Effects that the flights show: those whose interval does not hold zero, the surest first."""
    flown = float(np.median(np.concatenate([record.load for record in records]))) > _FLYING

    def resting(key: str) -> str:
        return f"{_RESTING[key]} {_shown(estimates[key], least=flown and key == 'play_deg')}"

    def sure(*keys: str) -> float:
        return max(abs(estimates[key].value) / (Z_95 * estimates[key].deviation) for key in keys)

    found = {resting(key): sure(key) for key in _RESTING if estimates[key].value > _LEAST_SHOWN_DEG}
    if found and max(found.values()) < 1.0:  # they may stand for each other
        widest = max(_RESTING, key=lambda key: estimates[key].value * WIDTHS[key])
        least_deg = 0.5 * estimates[widest].value * WIDTHS[widest]
        may_be = (key for key in _RESTING if key != widest and estimates[key].high * WIDTHS[key] > least_deg)
        others = " or ".join(_RESTING[key] for key in may_be)
        # Width of all three together over the half of its interval.
        together = float(EACH_WIDTH @ fitted.theta / (Z_95 * np.sqrt(EACH_WIDTH @ fitted.scatter @ EACH_WIDTH)))
        found = {resting(widest) + (f", which may be {others}" if others else ""): together}
    reach = max(abs(fitted.reach_deg[0]), abs(fitted.reach_deg[1]))
    gives = load_at(_FAST_M_S) * (abs(estimates["hinge"].value) * reach + abs(estimates["hinge_deg"].value))
    found[f"gives way {gives:.2g} deg at {reach:.0f} deg and {_FAST_M_S:g} m/s"] = sure("hinge", "hinge_deg")
    bend = max(abs(estimates[each].value) for each in ("bend2_deg", "bend3_deg"))
    found[f"reading bent by {bend:.2g} deg"] = sure("bend2_deg", "bend3_deg")
    for key in set(estimates) - set(_IN_WORDS):
        found[f"{key.replace('_', ' ')} {estimates[key].value:.2g}"] = sure(key)
    return tuple(text for text, ratio in sorted(found.items(), key=lambda each: -each[1]) if ratio > 1.0)


def _shown(estimate: Estimate, *, least: bool) -> str:
    """Size with its interval; play that the air pushes to one side may be wider than it shows."""
    value, low, high = (max(each, 0.0) for each in estimate)
    if least:
        return f"of at least {low:.2g} deg" if low >= _LEAST_SHOWN_DEG else f"of {value:.2g} deg or more"
    return f"{value:.2g} deg [{low:.2g}, {high:.2g}]"


def _sharper(known: CalibratedServo, fitted: Fit, records: Sequence[Record], now: Detectable) -> str:
    """What three more flights for each of these would show, if good flights differ by as little as they may."""
    surer = after_more_flights(known, fitted)
    then = detectable(watched(surer, record).looked for record in records)
    shown = [
        f"{words.format(after)} ({'none' if before is None else format(before, form)} now)"
        for words, form, before, after in (
            ("an offset of {:.2g} deg", ".2g", now.bias_deg, then.bias_deg),
            ("a servo that keeps {:.0%} of its speed", ".0%", now.slow_share, then.slow_share),
            ("the loss of {:.0%} of its travel", ".0%", now.loss_share, then.loss_share),
            ("play of {:.2g} deg", ".2g", now.deadband_deg, then.deadband_deg),
            ("an oscillation of {:.2g} deg", ".2g", now.oscillation_deg, then.oscillation_deg),
        )
        if after is not None and (before is None or abs(after - before) > _WORTH_FLYING * before)
    ]
    more = 3 * len(records)
    text = f"{more} more flights like {'this one' if more == 3 else 'these'} would show "
    text += f"{', '.join(shown)} at best" if shown else "hardly less"
    ratio = np.diag(known.covariance) / np.array([prior.between for prior in PRIORS]) ** 2
    unsure = [SPOKEN[key] for key, value in zip(NAMES, ratio.tolist(), strict=True) if value > _VAGUE]
    return (
        f"{text}; flights with more manoeuvring would measure {', '.join(dict.fromkeys(unsure))} better"
        if unsure
        else text
    )


def _notes(gain: float, known: CalibratedServo, surface: Surface, bandwidth_rad_s: Estimate) -> tuple[str, ...]:
    what = what_is_unknown(None, bandwidth_rad_s)
    notes = [f"these flights do not tell {what}"] if what else []
    scale = surface.command.correction[0] if isinstance(surface.command, DegreeCalibration) else 1.0
    if scale < 0.0:
        notes.append(
            "its position moves against its command, and this file takes that to be right: check the sign of both"
        )
    if not USUAL_GAINS[0] <= abs(scale) <= USUAL_GAINS[1]:
        notes.append(
            f"its position moves by {abs(scale):.3g} times its command, and this file takes that to be right: check "
            "the units of both"
        )
    if not USUAL_GAINS[0] <= gain <= USUAL_GAINS[1]:
        notes.append(f"the position moves by {gain:.2f} times the command: check the scale in the aircraft file")
    if 0.0 < known.fastest_m_s < _SLOWER_THAN_FLIGHT_M_S:
        notes.append(
            f"these flights stayed below {known.fastest_m_s:.0f} m/s: what is flown at more than "
            f"{known.last_judged_m_s:.0f} m/s is not judged"
        )
    if known.noise.period_s > 0.06:
        notes.append(f"positions at {1.0 / known.noise.period_s:.0f} Hz: slow servos show less")
    return tuple(notes)


def calibrate_aircraft(
    aircraft: Aircraft,
    flights: Mapping[str, Sequence[Flight]],
    *,
    force: bool = False,
    progress: Callable[[str], None] = lambda _surface: None,
) -> Calibration:
    """Fit every surface of an aircraft to flights that are known to be good.

    `aircraft`: what is known so far; its servos may be rough drafts. `flights`: surfaces without any stay as they are.
    `force`: calibrate also where the loss of a third of travel and of two thirds of speed would not show.
    """
    kept = {name: "not asked for" for name in aircraft.surfaces if name not in flights}
    for name, those in flights.items():
        reason = hardly_moved([flight.segment for flight in those]) if those else "no measured deflection"
        if reason:
            kept[name] = reason
    wanted = [name for name in aircraft.surfaces if name not in kept]

    def one(name: str) -> CalibratedSurface | CalibrationError:
        try:
            return calibrate_surface(flights[name], aircraft)
        except CalibrationError as error:
            return error
        finally:
            progress(name)

    # The kernel runs without the interpreter's lock.
    with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
        results = list(pool.map(one, wanted))
    wrong = [str(result) for result in results if isinstance(result, CalibrationError)]
    if wrong:
        raise CalibrationError("; ".join(wrong))
    found = [result for result in results if not isinstance(result, CalibrationError)]
    blind = {one.surface: reason for one in found if not force and (reason := _refusal(one))}
    kept |= blind
    found = [one for one in found if one.surface not in blind]
    if not found:
        raise CalibrationError("; ".join(f"{name}: {reason}" for name, reason in kept.items()))
    return Calibration(_with(aircraft, found), tuple(found), kept)


def _refusal(one: CalibratedSurface) -> str:
    """Why these flights are not enough for a surface, and what to fly; nothing if they are."""
    if not is_blind(one.detectable):
        what = what_is_unknown(one.estimates["gain"], None)
        return f"these flights do not tell {what}; --force calibrates it all the same" if what else ""
    lost = one.detectable.loss_share
    least = "no loss of travel" if lost is None else f"no less than the loss of {lost:.0%} of its travel"
    return (
        f"would show {least}, and no servo at a third of its speed (threshold {one.threshold_deg:.2g} deg): move it "
        f"several times by ±{3.0 * one.threshold_deg:.0f} deg or more, fast, or mend its play or friction; --force "
        "calibrates it all the same"
    )


def _with(aircraft: Aircraft, found: Sequence[CalibratedSurface]) -> Aircraft:
    """The aircraft with new entries for what was calibrated."""
    surfaces = dict(aircraft.surfaces)
    servos = {}
    for one in found:
        name = f"{one.surface}-calibrated"
        surfaces[one.surface] = _entry(surfaces[one.surface], one, name)
        servos[name] = one.servo
    used = {surface.servo for surface in surfaces.values()}
    servos |= {name: servo for name, servo in aircraft.servos.items() if name in used and name not in servos}
    return Aircraft.model_validate(
        {"name": aircraft.name, "table": aircraft.table, "surfaces": surfaces, "servos": servos}
    ).of_no_log()


def _entry(surface: Surface, one: CalibratedSurface, servo: str) -> Surface:
    return surface.model_copy(
        update={
            "servo": servo,
            "measured": one.measured,
            "threshold": "interval",
            "threshold_deg": one.threshold_deg,
            "tolerance": one.tolerance,
            "suspicions": True,
            "effects": {},
            "filter_pole_rad_s": None,
            "model": ModelOrigin(
                origin="calibrated",
                held_out_rms_deg=float(f"{one.held_out_rms_deg:.3g}"),
                explained_share=round(one.explained_share, 4),
            ),
            "calibrated": one.known,
        }
    )
