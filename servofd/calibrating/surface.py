"""Calibration of one surface: effects fitted to good flights, and how well they predict what the fit had not seen."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Final

import numpy as np

from servofd.aircraft.calibrated import CalibratedNoise, CalibratedServo, lower_triangle
from servofd.aircraft.priors import NAMES, PRIORS
from servofd.calibrating.flights import asked_deg
from servofd.calibrating.result import CalibratedSurface, FlightRecord
from servofd.core.errors import CalibrationError
from servofd.core.tolerance import Tolerance
from servofd.detection.bank.window import noise_deg
from servofd.detection.calibrated import judged
from servofd.detection.changes import STATISTICS
from servofd.detection.watch import FLOORS, MARGIN, detectable, statistics_of, watched
from servofd.estimate.family import PRESSURE_PA
from servofd.estimate.fit import fit, worse_without
from servofd.estimate.record import Record, usual_airspeed_m_s, usual_supply_v
from servofd.estimate.statistics import Estimate
from servofd.servo.context import AIR_KG_M3
from servofd.servo.library import Servo

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from servofd.aircraft.schema import Aircraft
    from servofd.calibrating.flights import Flight
    from servofd.core.evidence import Detectable
    from servofd.core.types import FloatArray
    from servofd.estimate.fit import Fit

_ENOUGH_MOTION_DEG: Final = 1.0
_SHORTEST_S: Final = 2.5
"""A bench test that is all motion; a flight says more."""
_FAR_GAINS: Final = (0.5, 2.0)
_USUAL_GAINS: Final = (0.8, 1.25)
_POOR, _DOUBTFUL = 0.6, 0.9
_FEWEST: Final = 60
_LONGEST_LEAD_S: Final = 0.5
_IN_COMMON: Final = 0.9
"""Correlation from which the slope of the position over the command means something."""
_ALIKE: Final = 0.15
"""Correlation of the two rates from which one is taken to lead the other."""
_LEAST_REACH: Final = 0.5
_STILL_S: Final = 2.0
_STILL_NOISES, _STILL_DEG = 5.0, 0.1
"""A position that stays within so many sigma of its noise, and so much, stands still;"""
_ASKED, _ASKED_SHARE, _JAMMED_S = 4.0, 0.2, 5.0
"""it is stuck where the command moves meanwhile by so many times that, by such a share of all it does, and so long."""
_ALWAYS: Final = 0.95
"""What never moved may be no position at all."""
_STRANGE: Final = 6.0
"""A flight that differs from the others by so many standard deviations between flights is of another aircraft."""
_OWN_MARGIN: Final = 1.3
_ENOUGH_S: Final = 120.0
"""Flights of less in all leave more unknown: of six aircraft of even seed that were calibrated on 15, 30, 60 and 120 s,
good flights reached 3.6, 1.2, 1.2 and 1.04 times the thresholds. They widen with the third root of what is missing."""
_REFUSED: Final = 1.5
"""A good flight over so many times its thresholds is none."""
_PAYS: Final = 1.01
_UNCERTAINTIES: Final = 4.0
_KNOWN_FLIGHTS: Final = 4.0
"""A stated prior counts as so many differences between flights."""
_LEAST_SHARE: Final = 0.25
_WARMTH: Final = 0.2
"""Share by which grease on a cold day and wear change friction and play."""
_PUSHED: Final = {"gain": 0.031, "bias_deg": 0.059}
"""What the usual air does to a servo (rms of 20 aircraft of even seed, calibrated with airspeed); where nobody knows
the airspeed, a share of it is part of what differs between flights."""
_NEVER_LOGGED: Final = 0.3
"""0.3 and 0.6 leave 2 of 240 good flights of even seed at fault, 0 leaves 6; 0.6 hides twice as large losses."""
_ADVICE: Final = "leave that part out (--until, --between), or the surface (-s)"
_FAST_M_S: Final = 25.0

_WORTH_FLYING: Final = 0.1
_VAGUE: Final = 4.0
"""A parameter is vague if its variance is so many times the usual one between flights."""
_SPOKEN: Final = dict(
    zip(
        NAMES,
        ("the scale", "the offset", "the delay", "the bandwidth", "the damping", "the largest speed", "the dead band",
         "the friction", "the play", "the load of the air", "the load of the air", "the bend of the reading",
         "the bend of the reading"),
        strict=True,
    )
)  # fmt: skip

_RESTING: Final = {"friction_deg": "friction", "deadband_deg": "dead band", "play_deg": "play"}
_WIDTHS: Final = {"friction_deg": 0.5, "deadband_deg": 1.0, "play_deg": 1.0}
"""Friction holds the surface on both sides."""
_NOTHING: Final = 1e-3
_FLYING: Final = 0.1
_LEAST_SHOWN_DEG: Final = 0.02


def hardly_moved(flights: Sequence[Flight]) -> str:
    """Say what these flights lack for a calibration; nothing if they may do.

    Examples
    --------
    >>> from servofd.calibrating.flights import Flight
    >>> from servofd.aircraft.segment import Segment
    >>> t = np.arange(2000) / 100.0
    >>> hardly_moved([Flight("a.csv", Segment("x", t, 0.0 * t, t, 0.0 * t))])
    'the command moves by 0 deg only; a calibration needs 1 deg or more'
    """
    seconds = sum(flight.segment.duration_s for flight in flights)
    if seconds < _SHORTEST_S:
        return f"only {seconds:.1f} s of flight; a calibration needs {_SHORTEST_S:g} s or more"
    motion_deg = max(float(np.ptp(asked_deg(flight.segment))) for flight in flights)
    if motion_deg < _ENOUGH_MOTION_DEG:
        return f"the command moves by {motion_deg:.2g} deg only; a calibration needs {_ENOUGH_MOTION_DEG:g} deg or more"
    count = sum(int(np.count_nonzero(Record.of(flight.segment).usable)) for flight in flights)
    if count < _FEWEST:
        return f"only {count} positions with commands around them; a calibration needs {_FEWEST}"
    return ""


def calibrate_surface(flights: Sequence[Flight], aircraft: Aircraft) -> CalibratedSurface:
    """Fit the servo of one surface, what it may differ by between flights, and its thresholds.

    Parameters
    ----------
    flights : sequence of Flight
        Of one surface; long enough and with motion (`hardly_moved` says nothing).
    aircraft : Aircraft
        What is known of it.
    """
    name = flights[0].segment.surface
    surface = aircraft.surfaces[name]
    if surface.measured is None:
        raise CalibrationError(f"{name}: the aircraft file names no measured channel for it")
    supply_v = float(np.median([usual_supply_v(flight.segment.context) for flight in flights]))
    airspeed_m_s = usual_airspeed_m_s([flight.segment.context for flight in flights])
    records = [Record.of(flight.segment, supply_v, airspeed_m_s) for flight in flights]
    first = fit(records)
    gain, offset_deg = first.theta[0], first.theta[1]
    _check(name, first, records, flights)
    measured = surface.measured.corrected(1.0 / gain, -offset_deg / gain)
    scale, shift_deg = float(f"{measured.correction[0]:.6g}"), round(measured.correction[1], 4)
    measured = measured.model_copy(update={"correction": (scale, shift_deg)})
    _refuse_mixed(name, first, records, flights)
    scaled = [flight.with_scale(gain, offset_deg) for flight in flights]
    records = [Record.of(flight.segment, supply_v, airspeed_m_s) for flight in scaled]
    fitted = fit(records, start=_scaled(first.theta))
    known = _known(fitted, records, supply_v, airspeed_m_s)
    _refuse_broken(name, known, records, scaled)
    known = known.model_copy(update={"thresholds": _thresholds(known, fitted, records)})
    sizes = detectable([watched(known, record) for record in records])
    servo = _linear(fitted.theta, flights)
    estimates = {key: _estimate(fitted, first, place) for place, key in enumerate(NAMES)}
    return CalibratedSurface(
        name,
        known,
        estimates,
        _effects(fitted, records, estimates),
        measured,
        servo,
        _tolerance(known),
        _constant_deg(fitted),
        fitted.held_out_rms_deg,
        fitted.explained_share,
        tuple(FlightRecord(flight.label, flight.segment.duration_s) for flight in flights),
        sizes,
        _sharper(known, fitted, records, sizes),
        _notes(gain, known),
    )


def _scaled(theta: FloatArray) -> FloatArray:
    """The same servo with a reading in degrees of the command."""
    gain = theta[0]
    out = theta.copy()
    out[0], out[1] = 1.0, 0.0
    out[5] -= np.log(gain)
    for place in (6, 7, 8, 10, 11, 12):
        out[place] /= gain
    return out


def _check(name: str, fitted: Fit, records: Sequence[Record], flights: Sequence[Flight]) -> None:
    """Refuse flights whose position has little to do with the command."""
    gain = fitted.theta[0]
    logs = ", ".join(flight.label for flight in flights)
    ahead_s = max(_ahead_s(record) for record in records)
    if ahead_s > 0.0:
        raise CalibrationError(
            f"{name}: the position moves {1e3 * ahead_s:.0f} ms before the command in {logs}: swapped columns, or "
            "clocks that disagree"
        )
    for record, flight in zip(records, flights, strict=True):
        jam = _jam(record) if fitted.explained_share < _DOUBTFUL else ""
        if jam:
            raise CalibrationError(f"{name}: not a good flight: {flight.label}: {jam}; {_ADVICE}")
    crude = float(np.median([_crude_gain(record) for record in records]))
    if crude > 0.0 and not _FAR_GAINS[0] <= crude <= _FAR_GAINS[1]:
        # So far from one that the fit did not get there.
        gain = crude * fit([Record.of(flight.with_scale(crude, 0.0).segment) for flight in flights]).theta[0]
    elif fitted.explained_share < _POOR:
        raise CalibrationError(
            f"{name}: not a good flight: no servo explains more than {max(fitted.explained_share, 0.0):.0%} of how the "
            f"position moves in {logs}: it does not follow its command, or moves too little for its noise; {_ADVICE}"
        )
    wanted_deg = max(float(np.ptp(asked_deg(flight.segment))) for flight in flights) * abs(gain)
    given_deg = fitted.reach_deg[1] - fitted.reach_deg[0]
    if given_deg < _LEAST_REACH * wanted_deg:
        raise CalibrationError(
            f"{name}: not a good flight: asked for {wanted_deg:.3g} deg of travel, the position shows "
            f"{given_deg:.3g} deg in {logs}; {_ADVICE}"
        )
    if not _FAR_GAINS[0] <= gain <= _FAR_GAINS[1]:
        raise CalibrationError(
            f"{name}: the position moves by {gain:.3g} times its command in {logs}: check scale and unit in the "
            "aircraft file, or a servo that has lost its travel"
        )


def _ahead_s(record: Record) -> float:
    """By how much the position moves before the command [s]; 0 if it does not, or hardly moves."""
    step_s = max(record.period_s, 0.005)
    grid_s = np.arange(record.time_s[0], record.time_s[-1], step_s)
    if grid_s.size < _FEWEST:
        return 0.0
    asked = np.diff(np.interp(grid_s, record.command_s, record.command_deg))
    seen = np.diff(np.interp(grid_s, record.time_s, record.measured_deg))
    most = max(round(_LONGEST_LEAD_S / step_s), 2)
    middle = seen[most:-most]
    power = np.correlate(asked, middle, mode="valid")
    lead = int(np.argmax(power)) - most
    # Noise is ahead of anything by chance.
    size = float(np.sqrt((middle @ middle) * (asked @ asked)))
    if float(power.max()) < _ALIKE * size:
        return 0.0
    return lead * step_s if lead > 1 else 0.0


def _jam(record: Record) -> str:
    """Where the position stays longest while the command moves, in words; nothing if it never does."""
    time_s, seen_deg = record.time_s, record.measured_deg
    asked_deg = np.interp(time_s, record.command_s, record.command_deg)
    still_deg = max(_STILL_NOISES * noise_deg(seen_deg), _STILL_DEG)
    block = np.floor((time_s - time_s[0]) / _STILL_S).astype(int)
    edges = np.searchsorted(block, np.arange(block[-1] + 2))
    longest = (_JAMMED_S, 0.0, 0.0, 0.0, 0.0)
    asked_by_deg = max(_ASKED * still_deg, _ASKED_SHARE * float(np.ptp(asked_deg)))
    for first, last in itertools.pairwise(edges.tolist()):
        if last - first < 2:
            continue
        at_deg = float(np.median(seen_deg[first:last]))
        away = np.flatnonzero(np.abs(seen_deg - at_deg) > still_deg)
        place = int(np.searchsorted(away, first))
        begin = int(away[place - 1]) + 1 if place else 0
        end = int(away[place]) if place < away.size else time_s.size
        if end <= begin or not begin <= first:
            continue
        moved_deg = float(np.ptp(asked_deg[begin:end]))
        lasted_s = float(time_s[end - 1] - time_s[begin])
        if moved_deg > asked_by_deg:
            longest = max(longest, (lasted_s, float(time_s[begin]), float(time_s[end - 1]), at_deg, moved_deg))
    lasted_s, from_s, to_s, at_deg, moved_deg = longest
    if lasted_s <= _JAMMED_S or lasted_s > _ALWAYS * float(np.ptp(time_s)):
        return ""
    until = "since" if to_s >= time_s[-1] - _STILL_S else "from"
    span = f"{until} {from_s:.1f} s" + ("" if until == "since" else f" to {to_s:.1f} s")
    return f"stuck at {at_deg:.1f} deg {span} while the command moves by {moved_deg:.0f} deg"


def _crude_gain(record: Record) -> float:
    """Slope of the position over the command, at the lag that suits it best; 0 if they have little in common."""
    best = (_IN_COMMON, 0.0)
    seen = record.measured_deg - record.measured_deg.mean()
    for lag_s in np.arange(0.0, _LONGEST_LEAD_S, 0.02):
        asked = np.interp(record.time_s - lag_s, record.command_s, record.command_deg)
        asked -= asked.mean()
        common, asked2 = float(asked @ seen), float(asked @ asked)
        share = common / max(float(np.sqrt(asked2 * (seen @ seen))), 1e-300)
        best = max(best, (share, common / max(asked2, 1e-300)))
    return best[1]


def _known(fitted: Fit, records: Sequence[Record], supply_v: float, airspeed_m_s: float) -> CalibratedServo:
    """What goes into the file, with the usual thresholds."""
    spread = np.array([prior.between for prior in PRIORS]) ** 2
    if not airspeed_m_s:
        for key, pushed in _PUSHED.items():
            spread[NAMES.index(key)] += (_NEVER_LOGGED * pushed) ** 2
    resting = [NAMES.index(name) for name in ("deadband_deg", "friction_deg", "play_deg")]
    spread[resting] += (_WARMTH * fitted.theta[resting]) ** 2
    if len(records) > 1:
        changes = _changes(fitted, records)
        spread = (_KNOWN_FLIGHTS * spread + (changes**2).sum(axis=0)) / (_KNOWN_FLIGHTS + len(records) - 1.0)
        spread = np.maximum(spread, _LEAST_SHARE * np.array([prior.between for prior in PRIORS]) ** 2)
    between = np.diag(spread) + _UNCERTAINTIES * fitted.covariance
    noise = fitted.noise
    return CalibratedServo(
        parameters={key: float(f"{value:.6g}") for key, value in zip(NAMES, fitted.theta.tolist(), strict=True)},
        between=lower_triangle(between),
        noise=CalibratedNoise(
            still_deg=float(f"{noise.still_deg:.4g}"),
            lag_s=float(f"{noise.lag_s:.4g}"),
            colour=(round(noise.colour[0], 4), round(noise.colour[1], 4)),
            innovation=float(f"{noise.innovation:.4g}"),
            period_s=float(f"{noise.period_s:.6g}"),
        ),
        reach_deg=(round(fitted.reach_deg[0], 3), round(fitted.reach_deg[1], 3)),
        supply_v=round(supply_v, 3),
        airspeed_m_s=round(airspeed_m_s, 2),
        flights=len(records),
    )


def _changes(fitted: Fit, records: Sequence[Record]) -> FloatArray:
    """How each flight alone would change the parameters, as far as it tells; shape (flights, 13)."""
    from servofd.estimate.fit import FAMILY, residual

    between = np.array([prior.between for prior in PRIORS])
    out = []
    for record in records:
        reading_deg, slopes, speed = FAMILY.predicted(fitted.theta, record, fitted.reach_deg)
        error_deg, inside = residual(record.measured_deg, reading_deg, fitted.reach_deg)
        rows = record.usable & inside
        sigma = fitted.noise.sigma_deg(speed[rows])
        weight = np.minimum(1.0, 2.5 / np.maximum(np.abs(error_deg[rows]) / sigma, 1e-9)) / sigma**2 / 4.0
        block = (slopes[rows] * weight[:, None]).T @ slopes[rows] + np.diag((2.0 * between) ** -2.0)
        out.append(np.linalg.solve(block, slopes[rows].T @ (weight * error_deg[rows])))
    return np.array(out)


def _refuse_mixed(name: str, fitted: Fit, records: Sequence[Record], flights: Sequence[Flight]) -> None:
    """Refuse flights of different aircraft, or with different servos."""
    if len(records) < 2:
        return
    usual = np.array([prior.between for prior in PRIORS])
    apart = np.abs(_changes(fitted, records)) / (2.0 * usual)
    worst = np.unravel_index(int(np.argmax(apart)), apart.shape)
    if apart[worst] > _STRANGE:
        raise CalibrationError(
            f"{name}: not the same aircraft, or not the same servo: {_SPOKEN[NAMES[worst[1]]]} of "
            f"{flights[int(worst[0])].label} differs by {apart[worst]:.0f} times what good flights differ by"
        )


def _refuse_broken(name: str, known: CalibratedServo, records: Sequence[Record], flights: Sequence[Flight]) -> None:
    """Refuse flights in which something changed that is larger than good flights differ by."""
    from servofd.detection.words import describe

    trial = known.model_copy(update={"thresholds": {key: _REFUSED * MARGIN * FLOORS[key] for key in STATISTICS}})
    for record, flight in zip(records, flights, strict=True):
        found = judged(watched(trial, record)).faults
        if found:
            text = "; then ".join(describe(fault) for fault in found)
            raise CalibrationError(f"{name}: not a good flight: {flight.label}: {text}; {_ADVICE}")


def _thresholds(known: CalibratedServo, fitted: Fit, records: Sequence[Record]) -> dict[str, float]:
    """Thresholds that the flights stay below where they were left out of the fit; wider ones after short flights."""
    seconds = sum(float(np.count_nonzero(record.usable)) * record.period_s for record in records)
    margin = MARGIN * float(np.cbrt(max(_ENOUGH_S / seconds, 1.0)))
    largest = np.zeros(len(STATISTICS))
    for record, left_deg in zip(records, fitted.held_out_deg, strict=True):
        statistics = statistics_of(watched(known, record), left_deg)
        if statistics.size:
            largest = np.maximum(largest, statistics)
    return {
        key: float(f"{max(FLOORS[key], _OWN_MARGIN * value) * margin:.3g}")
        for key, value in zip(STATISTICS, largest.tolist(), strict=True)
    }


def _estimate(fitted: Fit, first: Fit, place: int) -> Estimate:
    """What the flights say of a parameter; the first fit knows what other servos would have done as well."""
    value, deviation = fitted.estimates[place].tolist()
    return Estimate.of(value, max(deviation, float(first.estimates[place, 1])))


def _effects(fitted: Fit, records: Sequence[Record], estimates: Mapping[str, Estimate]) -> tuple[str, ...]:
    """Effects without which what was left out is predicted worse."""
    flown = float(np.median(np.concatenate([record.load for record in records]))) > _FLYING

    def gained(together: tuple[str, ...]) -> float:
        if max(abs(float(fitted.theta[NAMES.index(each)])) for each in together) < _NOTHING:
            return 0.0
        return worse_without(fitted, records, together)

    def resting(key: str) -> str:
        return f"{_RESTING[key]} {_shown(estimates[key], least=flown and key == 'play_deg')}"

    found = {resting(key): gained((key,)) for key in _RESTING}
    if max(found.values()) < _PAYS:  # they may stand for each other
        widest = max(_RESTING, key=lambda key: estimates[key].value / _WIDTHS[key])
        others = " or ".join(name for key, name in _RESTING.items() if key != widest)
        found = {f"{resting(widest)}, which may be {others}": gained(tuple(_RESTING))}
    reach = max(abs(fitted.reach_deg[0]), abs(fitted.reach_deg[1]))
    pressure = 0.5 * AIR_KG_M3 * _FAST_M_S**2 / PRESSURE_PA
    gives = pressure * (abs(estimates["hinge"].value) * reach + abs(estimates["hinge_deg"].value))
    found[f"gives way {gives:.2g} deg at {reach:.0f} deg and {_FAST_M_S:g} m/s"] = gained(("hinge", "hinge_deg"))
    bend = max(abs(estimates[each].value) for each in ("bend2_deg", "bend3_deg"))
    found[f"reading bent by {bend:.2g} deg"] = gained(("bend2_deg", "bend3_deg"))
    return tuple(text for text, ratio in sorted(found.items(), key=lambda each: -each[1]) if ratio >= _PAYS)


def _shown(estimate: Estimate, *, least: bool) -> str:
    """Size with its interval; play that the air pushes to one side may be wider than it shows."""
    value, low, high = (max(each, 0.0) for each in estimate)
    if least:
        return f"of at least {low:.2g} deg" if low >= _LEAST_SHOWN_DEG else f"of {value:.2g} deg or more"
    return f"{value:.2g} deg [{low:.2g}, {high:.2g}]"


def _linear(theta: FloatArray, flights: Sequence[Flight]) -> Servo:
    """The servo without its effects."""
    from servofd.servo.transfer import TransferFunction

    natural, damping = float(np.exp(theta[3])), float(np.exp(theta[4]))
    transfer = TransferFunction((natural**2,), (1.0, 2.0 * damping * natural, natural**2))
    logs = ", ".join(f"{flight.label} ({flight.segment.duration_s:.0f} s)" for flight in flights)
    return Servo.model_validate(
        {
            "title": "calibrated servo",
            "bandwidth_hz": float(f"{transfer.bandwidth_rad_s / (2.0 * np.pi):.6g}"),
            "damping": float(f"{damping:.6g}"),
            "delay_s": round(float(theta[2]), 6),
            "hold": "zoh",
            "rate_limit_deg_s": float(f"{np.exp(theta[5]):.6g}"),
            "source": f"fitted to {logs}",
        }
    )


def _tolerance(known: CalibratedServo) -> Tolerance:
    """Three standard deviations between flights, and the effects that a linear servo lacks."""
    deviation = dict(zip(NAMES, 3.0 * np.sqrt(np.diag(known.covariance)), strict=True))
    lacking = sum(known.parameters[key] for key in ("deadband_deg", "friction_deg", "play_deg")) / 2.0

    def rounded(value: float, most: float = 0.9) -> float:
        return float(f"{min(value, most):.3g}")

    return Tolerance(
        gain=rounded(deviation["gain"] + abs(known.parameters["hinge"])),
        delay_s=rounded(deviation["delay_s"]),
        bandwidth=rounded(deviation["ln_bandwidth"] + deviation["ln_damping"]),
        rate=rounded(deviation["ln_rate"] + 0.1),
        bias_deg=rounded(deviation["bias_deg"] + lacking + abs(known.parameters["hinge_deg"]), 900.0),
        noise_deg=rounded(known.noise.still_deg, 900.0),
    )


def _constant_deg(fitted: Fit) -> float:
    largest = max(float(np.nanmax(np.abs(part))) for part in fitted.held_out_deg)
    return float(f"{max(1.5 * largest, 0.05):.2g}")


def _sharper(known: CalibratedServo, fitted: Fit, records: Sequence[Record], now: Detectable) -> str:
    """What three more flights for each of these would show, if good flights differ by as little as they may."""
    vague = _UNCERTAINTIES * fitted.covariance
    between = known.covariance - 0.75 * vague
    if len(records) == 1:
        between -= (3.0 / (_KNOWN_FLIGHTS + 3.0)) * (known.covariance - vague)
    surer = known.model_copy(update={"between": lower_triangle(between)})
    then = detectable([watched(surer, record) for record in records])
    told = [
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
    text += f"{', '.join(told)} at best" if told else "hardly less"
    ratio = np.diag(known.covariance) / np.array([prior.between for prior in PRIORS]) ** 2
    unsure = [_SPOKEN[key] for key, value in zip(NAMES, ratio.tolist(), strict=True) if value > _VAGUE]
    return f"{text}; livelier ones would tell {', '.join(dict.fromkeys(unsure))} better" if unsure else text


def _notes(gain: float, known: CalibratedServo) -> tuple[str, ...]:
    notes = []
    if not _USUAL_GAINS[0] <= gain <= _USUAL_GAINS[1]:
        notes.append(f"the position moves by {gain:.2f} times the command: check the scale in the aircraft file")
    if known.noise.period_s > 0.06:
        notes.append(f"positions at {1.0 / known.noise.period_s:.0f} Hz: slow servos show less")
    return tuple(notes)
