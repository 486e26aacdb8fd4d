"""How far good flights of a servo differ, where each test alarms, and flights that no servo can be calibrated on."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from logparsers.units import MS_PER_S
from servofd.aircraft.calibrated import CalibratedServo, Noise, lower_triangle
from servofd.aircraft.priors import NAMES, PRIORS
from servofd.core.errors import CalibrationError
from servofd.core.series import latest
from servofd.core.statistics import LEAST_DIVISOR
from servofd.core.tolerance import Tolerance
from servofd.detection.changes import FLOORS, MARGIN, STATISTICS
from servofd.detection.faults import judged
from servofd.detection.flights import asked_deg, cropped
from servofd.detection.moving import statistics_of, watched
from servofd.detection.verdict import describe
from servofd.detection.wiring import ENOUGH_MOTION_DEG
from servofd.estimate.family import middle_of
from servofd.estimate.fit import fit, predicted, reach_of, residual
from servofd.estimate.record import Record
from servofd.servo.library import Servo

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from servofd.aircraft.series import Series
    from servofd.core.types import FloatArray
    from servofd.detection.flights import Flight
    from servofd.estimate.fit import Fit

_OWN_MARGIN: Final = 1.3
"""Factor over what the calibrating flights reached, where they were left out of the fit, that makes a threshold."""
_ENOUGH_S: Final = 120.0
"""Flights of less in all leave more unknown: of six aircraft of even seed that were calibrated on 15, 30, 60 and 120 s,
good flights reached 3.6, 1.2, 1.2 and 1.04 times the thresholds. They widen with the third root of what is missing."""
_UNCERTAINTIES: Final = 4.0
"""Factor by which the covariance of a fit is widened: two standard deviations count as one."""
_KNOWN_FLIGHTS: Final = 4.0
"""A stated prior counts as so many differences between flights."""
_LEAST_SHARE: Final = 0.25
"""Least variance between flights, as a share of the usual one."""
_WARMTH: Final = 0.2
"""Share by which grease on a cold day and wear change friction and play."""
_PUSHED: Final = {"gain": 0.031, "bias_deg": 0.059}
"""What the usual air does to a servo (rms of 20 aircraft of even seed, calibrated with airspeed); where the airspeed
is not known, a share of it is part of what differs between flights."""
_NEVER_LOGGED: Final = 0.3
"""0.3 and 0.6 leave 2 of 240 good flights of even seed at fault, 0 leaves 6; 0.6 hides twice as large losses."""
_SPOKEN: Final = (
    "the scale", "the offset", "the delay", "the bandwidth", "the damping", "the largest speed", "the dead band",
    "the friction", "the play", "the load of the air", "the load of the air", "the bend of the reading",
    "the bend of the reading",
)  # fmt: skip
_MORE: Final = tuple(f"the {name.replace('_', ' ')}" for name in NAMES[len(_SPOKEN) :])
SPOKEN: Final = dict(zip(NAMES, (*_SPOKEN, *_MORE), strict=True))


def known_servo(
    fitted: Fit,
    records: Sequence[Record],
    supply_v: float,
    airspeed_m_s: float,
    *,
    fastest_m_s: float = 0.0,
    pushed: float = _NEVER_LOGGED,
    apart: float = 1.0,
) -> CalibratedServo:
    """What goes into the file, with the usual thresholds.

    Usual supply and airspeed, and the largest one, are 0 where they were not logged; `pushed` is the share of what the
    usual air does that differs between flights then, and `apart` the share of what else differs.
    """
    spread = (apart * np.array([prior.between for prior in PRIORS])) ** 2
    if not airspeed_m_s:
        for key, amount in _PUSHED.items():
            spread[NAMES.index(key)] += (pushed * amount) ** 2
    resting = [NAMES.index(name) for name in ("deadband_deg", "friction_deg", "play_deg")]
    spread[resting] += (_WARMTH * fitted.theta[resting]) ** 2
    if len(records) > 1:
        changes = changes_of(fitted, records)
        spread = (_KNOWN_FLIGHTS * spread + (changes**2).sum(axis=0)) / (_KNOWN_FLIGHTS + len(records) - 1.0)
        spread = np.maximum(spread, _LEAST_SHARE * np.array([prior.between for prior in PRIORS]) ** 2)
    between = np.diag(spread) + _UNCERTAINTIES * fitted.covariance
    noise = fitted.noise
    return CalibratedServo(
        parameters={key: float(f"{value:.6g}") for key, value in zip(NAMES, fitted.theta.tolist(), strict=True)},
        between=lower_triangle(between),
        noise=Noise(
            still_deg=float(f"{noise.still_deg:.4g}"),
            lag_s=float(f"{noise.lag_s:.4g}"),
            colour=(round(noise.colour[0], 4), round(noise.colour[1], 4)),
            innovation=float(f"{noise.innovation:.4g}"),
            period_s=float(f"{noise.period_s:.6g}"),
        ),
        reach_deg=(round(fitted.reach_deg[0], 3), round(fitted.reach_deg[1], 3)),
        middle_deg=middle_of(fitted.reach_deg),
        supply_v=round(supply_v, 3),
        airspeed_m_s=round(airspeed_m_s, 2),
        fastest_m_s=round(fastest_m_s, 2),
        flights=len(records),
    )


def linear_servo(theta: FloatArray, source: str) -> Servo:
    """The servo without its effects."""
    from servofd.servo.transfer import TransferFunction

    natural, damping = float(np.exp(theta[3])), float(np.exp(theta[4]))
    transfer = TransferFunction((natural**2,), (1.0, 2.0 * damping * natural, natural**2))
    return Servo.model_validate(
        {
            "title": "calibrated servo",
            "bandwidth_hz": float(f"{transfer.bandwidth_rad_s / (2.0 * np.pi):.6g}"),
            "damping": float(f"{damping:.6g}"),
            "delay_s": round(float(theta[2]), 6),
            "hold": "zoh",
            "rate_limit_deg_s": float(f"{np.exp(theta[5]):.6g}"),
            "source": source,
        }
    )


def tolerance_of(known: CalibratedServo) -> Tolerance:
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


def constant_deg(fitted: Fit) -> float:
    """Constant threshold that the flights stayed below where they were left out of the fit, with a margin [deg]."""
    largest = max(float(np.nanmax(np.abs(part), initial=0.0)) for part in fitted.held_out_deg)
    return float(f"{max(1.5 * largest, 0.05):.2g}")


def after_more_flights(known: CalibratedServo, fitted: Fit) -> CalibratedServo:
    """The same after three more flights for each, if good flights differ by as little as they may."""
    vague = _UNCERTAINTIES * fitted.covariance
    between = known.covariance - 0.75 * vague
    if known.flights == 1:
        between -= (3.0 / (_KNOWN_FLIGHTS + 3.0)) * (known.covariance - vague)
    return known.model_copy(update={"between": lower_triangle(between)})


def changes_of(fitted: Fit, records: Sequence[Record]) -> FloatArray:
    """How each flight alone would change the parameters, as far as it tells; shape (flights, parameters)."""
    between = np.array([prior.between for prior in PRIORS])
    out = []
    for record in records:
        reading_deg, slopes, speed = predicted(fitted.theta, record, fitted.reach_deg)
        error_deg, inside = residual(record.measured_deg, reading_deg, fitted.reach_deg)
        rows = record.usable & inside
        sigma = fitted.noise.sigma_deg(speed[rows])
        weight = np.minimum(1.0, 2.5 / np.maximum(np.abs(error_deg[rows]) / sigma, 1e-9)) / sigma**2 / 4.0
        block = (slopes[rows] * weight[:, None]).T @ slopes[rows] + np.diag((2.0 * between) ** -2.0)
        out.append(np.linalg.solve(block, slopes[rows].T @ (weight * error_deg[rows])))
    return np.array(out)


def thresholds_above(known: CalibratedServo, fitted: Fit, records: Sequence[Record]) -> dict[str, float]:
    """Thresholds that the flights stay below where they were left out of the fit; wider ones after short flights."""
    seconds = sum(float(np.count_nonzero(record.usable)) * record.period_s for record in records)
    margin = MARGIN * float(np.cbrt(max(_ENOUGH_S / seconds, 1.0)))
    largest = np.zeros(len(STATISTICS))
    for record, left_deg in zip(records, fitted.held_out_deg, strict=True):
        statistics = statistics_of(known, record, left_deg)
        if statistics.size:
            largest = np.maximum(largest, statistics)
    return {
        key: float(f"{max(FLOORS[key], _OWN_MARGIN * value) * margin:.3g}")
        for key, value in zip(STATISTICS, largest.tolist(), strict=True)
    }


_SHORTEST_S: Final = 2.5
"""A bench test that is all motion; a flight says more."""
_FAR_GAINS: Final = (0.5, 2.0)
_FEWEST: Final = 60
"""Positions that a calibration needs."""
_LONGEST_LEAD_S: Final = 0.5
_IN_COMMON: Final = 0.9
"""Correlation from which the slope of the position over the command means something."""
_ALIKE: Final = 0.15
"""Correlation of the two rates from which one is taken to lead the other."""
_LEAST_REACH: Final = 0.5
_STRANGE: Final = 6.0
"""A flight that differs from the others by so many standard deviations between flights is of another aircraft."""
_REFUSED: Final = 1.5
"""A good flight over so many times its thresholds is none."""
_ADVICE: Final = "leave that part out (--between), or the surface (-s)"
_POOR, _DOUBTFUL = 0.6, 0.9
"""Share of the motion explained below which a fit is refused, and below which shorter beginnings are tried."""
_BEGINNINGS: Final = (1.0 / 3.0, 1.0 / 6.0, 1.0 / 12.0)
"""Shares of a flight that are taken to be good, the shorter ones where no servo explains the whole: of 36 flights of
four aircraft of even seed with a large fault in the middle all are refused with time and kind (25 without, 12 of
them with another reason), of 36 with a medium one 24; of 188 good ones none."""


def hardly_moved(segments: Sequence[Series]) -> str:
    """Say what these flights of a surface lack for a fit; nothing if they may do."""
    seconds = sum(segment.duration_s for segment in segments)
    if seconds < _SHORTEST_S:
        return f"only {seconds:.1f} s of motion; a fit needs {_SHORTEST_S:g} s or more"
    motion_deg = max(float(np.ptp(asked_deg(segment))) for segment in segments)
    if motion_deg < ENOUGH_MOTION_DEG:
        return f"the command moves by {motion_deg:.2g} deg only; a fit needs {ENOUGH_MOTION_DEG:g} deg or more"
    count = sum(int(np.count_nonzero(Record.of(segment).usable)) for segment in segments)
    if count < _FEWEST:
        return f"only {count} positions with commands around them; a fit needs {_FEWEST}"
    return ""


def refuse_unlike(
    name: str, fitted: Fit, records: Sequence[Record], flights: Sequence[Flight], usual: tuple[float, float]
) -> None:
    """Refuse flights whose position has little to do with the command, or comes to have less."""
    gain = fitted.theta[0]
    logs = ", ".join(flight.label for flight in flights)
    ahead_s = max(_ahead_s(record) for record in records)
    if ahead_s > 0.0:
        raise CalibrationError(
            f"{name}: the position moves {MS_PER_S * ahead_s:.0f} ms before the command in {logs}: swapped columns, or "
            "clocks that disagree"
        )
    lines = [crude_line(record) for record in records]
    crude = float(np.median([line.gain if line is not None else 0.0 for line in lines]))
    if crude > 0.0 and not _FAR_GAINS[0] <= crude <= _FAR_GAINS[1]:
        # So far from one that the fit did not get there.
        gain = crude * fit([Record.of(flight.with_scale(crude, 0.0).segment) for flight in flights]).theta[0]
    else:
        for record, flight in zip(records, flights, strict=True):
            change = _changed(fitted, record, flight, usual)
            if change:
                raise CalibrationError(f"{name}: not a good flight: {flight.label}: {change}; {_ADVICE}")
    if gain == fitted.theta[0] and fitted.explained_share < _POOR:
        raise CalibrationError(
            f"{name}: not a good flight: no servo explains more than {max(fitted.explained_share, 0.0):.0%} of how the "
            f"position moves in {logs}: it does not follow its command, or moves too little for its noise; {_ADVICE}"
        )
    asked = [replace(r, measured_deg=latest(r.command_s, r.command_deg, r.time_s)) for r in records]
    wanted_deg = abs(gain) * float(np.ptp(reach_of(asked)))  # of the samples that the reach was seen in
    given_deg = float(np.ptp(fitted.reach_deg))
    if given_deg < _LEAST_REACH * wanted_deg:
        raise CalibrationError(
            f"{name}: not a good flight: asked for {wanted_deg:.3g} deg of travel, the position shows "
            f"{given_deg:.3g} deg in {logs}; {_ADVICE}"
        )
    if not _FAR_GAINS[0] <= gain <= _FAR_GAINS[1]:
        raise CalibrationError(
            f"{name}: the position moves by {gain:.2g} times its command in {logs}: check scale and unit in the "
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


def _changed(fitted: Fit, record: Record, flight: Flight, usual: tuple[float, float]) -> str:
    """What contradicts the servo that the beginning of a flight had, in words; nothing if nothing does.

    A fault that lasts for half of a flight bends the servo that is fitted to all of it.
    """
    for share in _BEGINNINGS if fitted.explained_share < _DOUBTFUL else _BEGINNINGS[:1]:
        until_s = float(record.time_s[0] + share * np.ptp(record.time_s))
        part = cropped(flight.segment, ((-np.inf, until_s),))
        if hardly_moved([part]):
            continue
        begun = Record.of(part, *usual)
        own = fit([begun], start=fitted.theta)
        if own.explained_share < _POOR:
            continue
        known = known_servo(own, [begun], *usual, pushed=1.0)  # it may have begun on the ground
        found = _faults(known, thresholds_above(known, own, [begun]), record)
        if found:
            return found
    return ""


class Line(NamedTuple):
    """How the position goes with the command: gain times it, and an offset."""

    gain: float = 1.0
    offset_deg: float = 0.0
    correlation: float = 0.0


def crude_line(record: Record) -> Line | None:
    """Position over command at the lag that suits it best, of either sign; None if they have little in common."""
    best: Line | None = None
    middle_deg = float(record.measured_deg.mean())
    seen = record.measured_deg - middle_deg
    for lag_s in np.arange(0.0, _LONGEST_LEAD_S, 0.02):
        asked = np.interp(record.time_s - lag_s, record.command_s, record.command_deg)
        usual_deg = float(asked.mean())
        asked -= usual_deg
        common, asked2 = float(asked @ seen), float(asked @ asked)
        share = abs(common) / max(float(np.sqrt(asked2 * (seen @ seen))), LEAST_DIVISOR)
        if share > (_IN_COMMON if best is None else best.correlation):
            gain = common / asked2
            best = Line(gain, middle_deg - gain * usual_deg, share)
    return best


def refuse_mixed(name: str, fitted: Fit, records: Sequence[Record], flights: Sequence[Flight]) -> None:
    """Refuse flights of different aircraft, or with different servos."""
    if len(records) < 2:
        return
    usual = np.array([prior.between for prior in PRIORS])
    apart = np.abs(changes_of(fitted, records)) / (2.0 * usual)
    worst = np.unravel_index(int(np.argmax(apart)), apart.shape)
    if apart[worst] > _STRANGE:
        raise CalibrationError(
            f"{name}: not the same aircraft, or not the same servo: {SPOKEN[NAMES[worst[1]]]} of "
            f"{flights[int(worst[0])].label} differs by {apart[worst]:.0f} times what good flights differ by"
        )


def refuse_broken(name: str, known: CalibratedServo, records: Sequence[Record], flights: Sequence[Flight]) -> None:
    """Refuse flights in which something changed that is larger than good flights differ by."""
    for record, flight in zip(records, flights, strict=True):
        found = _faults(known, {key: MARGIN * FLOORS[key] for key in STATISTICS}, record)
        if found:
            raise CalibrationError(f"{name}: not a good flight: {flight.label}: {found}; {_ADVICE}")


def _faults(known: CalibratedServo, thresholds: Mapping[str, float], record: Record) -> str:
    """Faults of a flight that lie well above some thresholds, in words."""
    strict = {key: _REFUSED * value for key, value in thresholds.items()}
    found = judged(watched(known.model_copy(update={"thresholds": strict}), record)).faults
    return "; then ".join(describe(fault) for fault in found)
