"""The healthy current that a log shows by itself, where it was not calibrated: enough for blocked and unpowered."""

from __future__ import annotations

import itertools
import operator
from typing import Final

import numpy as np

from servofd.aircraft.current import CalibratedCurrent
from servofd.core.errors import CalibrationError
from servofd.current.judge import EXPLAINED_OWN, limits_of
from servofd.current.model import CurrentSeries, fit_current, see

_PARTS: Final = (3, 2, 1)
"""Into how many parts a log is cut, one after the other; how late its readings come is known from the first ones."""


def own_current(series: CurrentSeries) -> CalibratedCurrent:
    """Return the healthy current that a log shows by itself: of the part that predicts the whole most sharply.

    Raises `CalibrationError` if no part of the log has enough motion and current.
    """
    first_s, last_s = float(series.time_s[0]), float(series.time_s[-1])
    found: list[tuple[bool, float, CalibratedCurrent]] = []
    sharpest = operator.itemgetter(0, 1)
    reason, late_s = "", None
    for count in _PARTS:
        best = min(found, key=sharpest, default=None)
        if best is not None and not best[0]:
            late_s = best[2].late_s
        for from_s, to_s in itertools.pairwise(np.linspace(first_s, last_s, count + 1).tolist()):
            part = series.within(from_s, np.nextafter(to_s, np.inf))
            try:
                known = fit_current([part], is_own=True, late_s=late_s)
            except CalibrationError as error:
                reason = reason or str(error)
                continue
            known = known.model_copy(update={"fitted_between_s": (round(from_s, 2), round(to_s, 2))})
            sharpness_a = float(np.mean(see(series, known).noise_a))
            found.append((known.explained_share < EXPLAINED_OWN, sharpness_a, known))
    if not found:
        raise CalibrationError(reason)
    known = min(found, key=sharpest)[2]
    part = series.within(*(known.fitted_between_s or (first_s, last_s)))
    return known.model_copy(update={"limits_nats": limits_of([{series.surface: see(part, known)}])})
