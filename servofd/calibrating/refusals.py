"""Flights that no servo can be calibrated on, each with its reason."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from servofd.aircraft.priors import NAMES, PRIORS
from servofd.calibrating.flights import Flight, asked_deg, cropped
from servofd.calibrating.known import SPOKEN, changes_of, known_servo, thresholds_above
from servofd.core.errors import CalibrationError
from servofd.detection.calibrated import judged
from servofd.detection.changes import STATISTICS
from servofd.detection.plausible import ENOUGH_MOTION_DEG
from servofd.detection.watch import FLOORS, MARGIN, watched
from servofd.detection.words import describe
from servofd.estimate.fit import fit
from servofd.estimate.record import Record

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from servofd.aircraft.calibrated import CalibratedServo
    from servofd.estimate.fit import Fit

_SHORTEST_S: Final = 2.5
"""A bench test that is all motion; a flight says more."""
_FAR_GAINS: Final = (0.5, 2.0)
_FEWEST: Final = 60
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
_ADVICE: Final = "leave that part out (--until, --between), or the surface (-s)"
_POOR, _DOUBTFUL = 0.6, 0.9
_BEGINNINGS: Final = (1.0 / 3.0, 1.0 / 6.0, 1.0 / 12.0)
"""Shares of a flight that are taken to be good, the shorter ones where no servo explains the whole: of 36 flights of
four aircraft of even seed with a large fault in the middle all are refused and told when and what (25 without, 12 of
them with another reason), of 36 with a medium one 24; of 188 good ones none."""


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
    if motion_deg < ENOUGH_MOTION_DEG:
        return f"the command moves by {motion_deg:.2g} deg only; a calibration needs {ENOUGH_MOTION_DEG:g} deg or more"
    count = sum(int(np.count_nonzero(Record.of(flight.segment).usable)) for flight in flights)
    if count < _FEWEST:
        return f"only {count} positions with commands around them; a calibration needs {_FEWEST}"
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
            f"{name}: the position moves {1e3 * ahead_s:.0f} ms before the command in {logs}: swapped columns, or "
            "clocks that disagree"
        )
    crude = float(np.median([_crude_gain(record) for record in records]))
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


def _changed(fitted: Fit, record: Record, flight: Flight, usual: tuple[float, float]) -> str:
    """What contradicts the servo that the beginning of a flight had, in words; nothing if nothing does.

    A fault that lasts for half of a flight bends the servo that is fitted to all of it.
    """
    for share in _BEGINNINGS if fitted.explained_share < _DOUBTFUL else _BEGINNINGS[:1]:
        until_s = float(record.time_s[0] + share * np.ptp(record.time_s))
        part = Flight(flight.label, cropped(flight.segment, ((-np.inf, until_s),)))
        if hardly_moved([part]):
            continue
        begun = Record.of(part.segment, *usual)
        own = fit([begun], start=fitted.theta)
        if own.explained_share < _POOR:
            continue
        known = known_servo(own, [begun], *usual, pushed=1.0)  # it may have begun on the ground
        found = _faults(known, thresholds_above(known, own, [begun]), record)
        if found:
            return found
    return ""


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
