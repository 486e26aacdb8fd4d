"""Records too slow to show how a servo moves: where it rests can be judged all the same.

Below 20 Hz what a servo does between two commands falls between the samples. While a command is held for long, the
surface rests, and whether it rests in one place or in two is told by samples that come as slowly as they like. A
surface that something pulls from either side, within its play, lies at either end of it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from servofd.discrepancy.noise import noise_floor_deg
from servofd.discrepancy.record import SLOWEST_RATE_HZ
from servofd.discrepancy.steps import comb_step_deg
from servofd.servo.catalogue import Backlash, Bias, DeadBand, Friction, Gain, InsensitiveBand

if TYPE_CHECKING:
    from servofd.core.types import BoolArray, FloatArray
    from servofd.discrepancy.record import Record
    from servofd.servo.missing_effect import MissingEffect

AT_REST: tuple[type[MissingEffect], ...] = (Bias, Gain, Backlash, DeadBand, InsensitiveBand, Friction)
"""Effects that show where a surface rests. The play of the linkage comes before that of the controller: it needs no
more than a pull to be seen."""
_HELD_S = 1.0
"""After a new command a surface may move; servos of 2 Hz and more have come to rest by then."""
_SHORTEST_REST_S = 0.25
_STEPS_OF_LOOP = 2.0
"""A loop closed over a converter rests within one step to either side of its command."""
_SIGMAS = 4.0
_SPLIT = 0.15
"""Of the variance that may stay if places are told as two. Places spread evenly leave 1/4, those of a slow swing, which
dwells at its ends, 1 - 8/pi^2 = 0.19; two places leave next to nothing."""
_LEAST_SHARE = 0.1
_FEWEST_CHANGES = 3
"""Of the end at which it lies: a horn that slipped lies elsewhere from then on, play lets it come back."""
_DIGITS = 3


def at_rest(record: Record) -> Record:
    """A single run, of which only rests count, if it is too slow for anything else."""
    if 1.0 / record.period_s >= SLOWEST_RATE_HZ:
        return record
    held_deg, held_s = _held(record)
    rest = _still(record) & (held_s >= _HELD_S) & record.counts
    # On its way a servo passes too few places twice for the steps of its converter to be seen.
    record = replace(record, step_deg=record.step_deg or comb_step_deg(record.measured_deg[rest]))
    side = np.zeros(record.time_s.size)
    for command in np.unique(np.round(held_deg[rest], _DIGITS)):
        there = rest & (np.abs(held_deg - command) < 10.0**-_DIGITS)
        side[there] = _sides(record, there)
    return replace(record, counts=rest, side=side, free_poles=False)


def rest_sentence(record: Record) -> str:
    """How far apart the places are in which the surface rested at one and the same command."""
    spreads = [0.0]
    for run in record.runs or (record,):
        held_deg, _ = _held(run)
        for command in np.unique(np.round(held_deg[run.counts], _DIGITS)):
            places = run.measured_deg[run.counts & (np.abs(held_deg - command) < 10.0**-_DIGITS)]
            spreads.append(float(np.quantile(places, 0.95) - np.quantile(places, 0.05)))
    return f"at one and the same command it rested within {max(spreads):.2g} deg"


def _held(record: Record) -> tuple[FloatArray, FloatArray]:
    """Command in force at each sample [deg], and for how long it has been [s]."""
    sent_s, deg = record.commands.effective_s, record.commands.command_deg
    new = np.append(True, np.diff(deg) != 0.0)
    index = np.maximum(np.searchsorted(sent_s, record.time_s, side="right") - 1, 0)
    last = np.maximum.accumulate(np.where(new, np.arange(deg.size), 0))[index]
    return deg[index], record.time_s - sent_s[last]


def _still(record: Record) -> BoolArray:
    """Samples at which the surface has not moved for a while, nor will."""
    step = np.abs(np.diff(record.measured_deg))
    least_deg = max((record.step_deg or 0.0) * 1.5, _SIGMAS * noise_floor_deg(record, record.measured_deg))
    still = step < least_deg
    count = max(int(np.ceil(_SHORTEST_REST_S / record.period_s)) // 2, 1)
    kept: BoolArray = np.ones(record.time_s.size, dtype=bool)
    for shift in range(count):
        kept[shift + 1 :] &= still[: still.size - shift]
        kept[: kept.size - shift - 1] &= still[shift:]
    return kept


def _sides(record: Record, there: BoolArray) -> FloatArray:
    """On which side of its play a surface rests: 1 or -1; zeros if it rests in one place, or anywhere."""
    where = np.flatnonzero(there)
    places = record.measured_deg[where]
    nowhere = np.zeros(where.size)
    upper = places > 0.5 * (places.min() + places.max())
    if int(np.abs(np.diff(upper.astype(int))).sum()) < _FEWEST_CHANGES:
        return nowhere
    apart_deg = float(places[upper].mean() - places[~upper].mean())
    noise_deg = noise_floor_deg(record, record.measured_deg)
    share = float(upper.mean())
    within = float(share * places[upper].var() + (1.0 - share) * places[~upper].var())
    is_apart = apart_deg > max(_STEPS_OF_LOOP * (record.step_deg or 0.0), _SIGMAS * noise_deg)
    is_split = within < _SPLIT * float(places.var()) and _LEAST_SHARE <= share <= 1.0 - _LEAST_SHARE
    return np.where(upper, 1.0, -1.0) if is_apart and is_split else nowhere
