"""When a named fault began: the split between healthy and faulty that makes the data most likely."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from servofd.detection.bank.flight import Flight
    from servofd.detection.bank.window import Explanation, Window

BEFORE_S = 4.0
_HEALTHY_BEFORE_S = 0.3
_FEWEST_HEALTHY = 30
_UNDECIDED = 4.0
"""Splits whose log-likelihood is this close to the best, in units of 1/2, are equally good."""


def refine_onset_s(
    flight: Flight, fault: Explanation, rough_s: float, window: Window, before_s: float = BEFORE_S
) -> float:
    """Move the onset to where the fault begins to explain the data better than health does [s].

    Where several instants do alike, because the surface did not move, the last of them is taken: it is the first
    motion that the fault spoils.
    """
    if fault.predict is None:
        return rough_s
    wide = flight.window(rough_s - before_s, float(window.time_s[-1]), window.onset)
    if wide is None:
        return rough_s
    surely_healthy = wide.time_s < wide.time_s[0] + 0.5 * before_s - _HEALTHY_BEFORE_S
    error_deg = wide.error_deg
    if np.count_nonzero(surely_healthy) >= _FEWEST_HEALTHY:
        known = type(wide.ridge)(wide.nuisances[surely_healthy], wide.spread, wide.noise_deg)
        habits = known.fit(error_deg[surely_healthy]).coefficients
        error_deg = error_deg - wide.nuisances @ habits
    healthy = error_deg**2
    faulty = (wide.measured_deg - fault.predict(wide)) ** 2
    # Misfits beyond four sigma all count alike: the transition itself is neither healthy nor explained.
    most = 16.0 * wide.noise_deg**2
    gain = np.minimum(healthy, most) - np.minimum(faulty, most)
    cost = np.concatenate([[0.0], np.cumsum(gain)])
    near = np.flatnonzero(cost <= cost.min() + _UNDECIDED * wide.noise_deg**2)
    split = int(near[-1])
    return float(wide.time_s[min(split, wide.time_s.size - 1)])
