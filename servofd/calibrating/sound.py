"""Whether flights that somebody called good are: what no healthy servo does, by the model that fits most of them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servofd.calibrating.spread import spread
from servofd.calibrating.stretches import telling
from servofd.detection.judge import judge
from servofd.detection.words import describe

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servofd.aircraft import Surface
    from servofd.calibrating.levels import Terms
    from servofd.calibrating.stretches import Flown, Stretch
    from servofd.detection.bank.flight import Fault
    from servofd.tolerance import Tolerance
    from servofd.types import FloatArray

__all__ = ["problem"]

_GROSS = np.array([0.15, 0.02, 0.4, 1.5])
"""Deviations of gain, delay [s], bandwidth and bias [deg] within one flight that no healthy servo has: five times what
a whole fleet strays (the default `Tolerance`), rounded; seven times for the delay, which load on the telemetry link
shifts."""
_STRANGE = np.array([0.1, 0.015, 0.3, 1.5])
"""Differences between two flights of one aircraft that no servo has: three to five times what a fleet strays."""
_TIMES_SPREAD, _DOUBTS = 6.0, 4.0
_PEAK, _TIMES_PEAK = 1.5, 3.0
"""A stretch is odd if its residual passes 1.5 thresholds, and three times what the median stretch reaches."""
_ALWAYS_FAULTY = ("stuck", "hardover", "floating", "oscillation")
"""What no servo does by nature. A dead band or slowness from the first to the last second may be how it is."""
_SURE = 0.9
_FORMS = ("gain {:.2f}", "delay {:+.0f} ms", "bandwidth {:+.0%}", "bias {:+.1f} deg")


def problem(
    flights: Sequence[Flown],
    stretches: Sequence[Stretch],
    terms: Terms,
    tolerance: Tolerance,
    sigmas: float,
    surface: Surface,
) -> str:
    """Say why these flights cannot all be good; nothing if they can.

    Parameters
    ----------
    flights : sequence of Flown
        Of one surface, with the servo that fits most of them.
    stretches : sequence of Stretch
        Of all flights.
    terms : Terms
        Of the interval threshold.
    tolerance : Tolerance
        As most stretches need it, not yet widened to hold all.
    sigmas : float
        Standard deviations of noise in the threshold.
    surface : Surface
        Its entry, for the bank.

    Returns
    -------
    str
        What is wrong, where and since when, without the name of the surface.
    """
    faults = _named(flights, tolerance, sigmas, surface)
    for label, fault in faults:
        if fault.kind in _ALWAYS_FAULTY and fault.probability >= _SURE:
            return f"{label}: {describe(fault)}"
    odd = _stranger(telling(stretches)) or _gross(telling(stretches))
    if odd is None:
        odd = _loud(flights, stretches, terms, tolerance, sigmas)
    if odd is None:
        return ""
    stretch, how = odd
    for label, fault in faults:
        if label == stretch.label and fault.start_s <= stretch.to_s and (fault.end_s or np.inf) >= stretch.from_s:
            return f"{label}: {describe(fault)}"
    return f"{stretch.label}: from {stretch.from_s:.1f} to {stretch.to_s:.1f} s {how}"


def _named(flights: Sequence[Flown], tolerance: Tolerance, sigmas: float, surface: Surface) -> list[tuple[str, Fault]]:
    """What the bank makes of each flight."""
    judged = surface.model_copy(
        update={"tolerance": tolerance, "threshold": "interval", "threshold_sigmas": sigmas, "persistence": 1}
    )
    return [
        (flight.label, fault)
        for flight, generator, residuals in flights
        for fault in judge(generator, flight.segment, residuals, judged).faults
    ]


def _stranger(stretches: Sequence[Stretch]) -> tuple[Stretch, str] | None:
    """First stretch of a flight with another servo than the others, if flights differ more than a fleet does."""
    labels = list(dict.fromkeys(s.label for s in stretches))
    medians = np.array([np.median([s.deviation for s in stretches if s.label == label], axis=0) for label in labels])
    doubts = np.array([np.median([s.doubt for s in stretches if s.label == label], axis=0) for label in labels])
    excess = np.ptp(medians, axis=0) / (_STRANGE + _DOUBTS * doubts.max(axis=0))
    which = int(np.argmax(excess))
    if len(labels) < 2 or excess[which] <= 1.0:
        return None
    away = np.abs(medians[:, which] - np.median(medians[:, which]))
    worst = len(labels) - 1 - int(np.argmax(away[::-1]))
    other = medians[int(np.argmax(np.abs(medians[:, which] - medians[worst, which]))), which]
    first = next(s for s in stretches if s.label == labels[worst])
    mine, theirs = _shown(which, float(medians[worst, which])), _shown(which, float(other))
    return first, f"{mine} against {theirs} in another flight: not the same aircraft, or a fault"


def _shown(which: int, value: float) -> str:
    return _FORMS[which].format({0: 1.0 + value, 1: 1e3 * value}.get(which, value))


def _gross(stretches: Sequence[Stretch]) -> tuple[Stretch, str] | None:
    """Stretch in which the servo is another one."""
    if len(stretches) < 2:
        return None
    deviation = np.array([s.deviation for s in stretches])
    doubt = np.array([s.doubt for s in stretches])
    limit = np.clip(_TIMES_SPREAD * spread(stretches), _GROSS, 2.0 * _GROSS) + _DOUBTS * doubt
    excess = np.abs(deviation - np.median(deviation, axis=0)) / limit
    worst, which = divmod(int(np.argmax(excess)), excess.shape[1])
    if excess[worst, which] <= 1.0:
        return None
    value = float(deviation[worst, which])
    alone = len({s.label for s in stretches}) == 1
    rest = "the rest of the flight" if alone else "the other flights: a fault, or not the same aircraft"
    return stretches[worst], f"{_shown(which, value)} against {rest}"


def _loud(
    flights: Sequence[Flown], stretches: Sequence[Stretch], terms: Terms, tolerance: Tolerance, sigmas: float
) -> tuple[Stretch, str] | None:
    """Stretch whose residual passes its threshold as none of the others does."""
    ratio = terms.ratio(tolerance, sigmas)
    labels = [what.flight.label for what in flights]
    peaks = np.array([_peak(ratio, terms, labels.index(s.label), s) for s in stretches])
    if peaks.size < 2:
        return None
    worst = int(np.argmax(peaks))
    if peaks[worst] <= max(_PEAK, _TIMES_PEAK * float(np.median(peaks))):
        return None
    return stretches[worst], f"the residual reaches {peaks[worst]:.1f} times what the other stretches need"


def _peak(ratio: FloatArray, terms: Terms, flight: int, stretch: Stretch) -> float:
    inside = (terms.flight == flight) & (terms.time_s >= stretch.from_s) & (terms.time_s <= stretch.to_s)
    return float(np.max(ratio[inside], initial=0.0))
