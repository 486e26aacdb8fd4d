"""How large the disagreement would be if the model were right: the noise floor, from the data themselves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from servofd.core.statistics import MAD_TO_SIGMA, correlation_factor
from servofd.core.types import BoolArray, FloatArray
from servofd.discrepancy.known import A_TYPE
from servofd.discrepancy.record import SLOWEST_EXPLAINED_HZ, Record, comb_step_deg

_THIRD = 20.0**0.5
"""Standard deviation of third differences (1, -3, 3, -1) of white noise."""
_GOLDEN = 0.6180339887498949
"""Multiples of it fill the unit interval evenly (Weyl)."""
_MEDIAN_OF_THIRD = 3.02
"""Relative standard deviation of the squared floor, times the root of the number of differences (2000 simulations)."""
_LAGS, _PER_LAG = 25, 4
"""Lags over which errors are correlated at most, and samples for each."""
SMALLEST_DEG = 1e-6
"""Smallest noise floor [deg]: less is rounding."""


def noise_floor_deg(record: Record, error_deg: FloatArray) -> float:
    """Standard deviation of what no servo could follow, from third differences of the error [deg].

    Motion is smooth, noise is not; the median of the differences ignores the few samples at which motion is not.
    """
    third = np.diff(error_deg, 3)[_joined(record)]
    if third.size < 8:
        return SMALLEST_DEG
    if record.step_deg:
        # At rest all differences are whole steps of the converter; spread over one, their median is on no tooth.
        third = third + record.step_deg * (_GOLDEN * np.arange(third.size) % 1.0 - 0.5)
    spread = MAD_TO_SIGMA * float(np.median(np.abs(third - np.median(third)))) / _THIRD
    return max(spread, SMALLEST_DEG)


def floor_uncertainty(record: Record) -> float:
    """Relative standard deviation of the square of the noise floor, by chance."""
    return _MEDIAN_OF_THIRD / float(np.sqrt(max(int(_joined(record).sum()), 1)))


def _joined(record: Record) -> BoolArray:
    """Where four samples in a row count, shape (n - 3,)."""
    counts = record.counts
    return counts[3:] & counts[2:-1] & counts[1:-2] & counts[:-3]


def long_run_factor(error_deg: FloatArray) -> float:
    """How much the correlation of an error widens the variance of its mean, at least 1."""
    return correlation_factor([error_deg], min(_LAGS, error_deg.size // _PER_LAG))


COARSE_STEP_DEG = 0.12
"""10 bits for 120 deg; what is finer is a usual potentiometer's or encoder's converter, and missing in no model."""
_MOST, _FEWEST = 3000, 100
"""Pairs of samples that the noise below coarse steps is measured from: at most, and at least."""
_EDGES = np.arange(-3.5, 4.0)
"""Edges beside a reading that noise of up to a step may cross [steps]."""
_FINEST_SHARE = 0.02
"""Nothing finer is seen through steps: it is what a simulation may be wrong by, too."""
_NODES = 24
"""Nodes of the Gauss and Hermite sum."""
_TEETH = 4
"""Edges to either side over which the mean reading is summed."""


def noise_below_deg(measured_deg: FloatArray, simulated_deg: FloatArray, step_deg: float) -> float:
    """Standard deviation of the noise before a converter of coarse steps [deg].

    Where a position lies between two edges is known from the simulation, and with it how many edges lie between one
    reading and the next on average, for any noise: that noise is taken for which it is what is seen. A simulation that
    is off by much less than a step does no harm, because both readings are.
    """
    from scipy.optimize import brentq
    from scipy.special import ndtr

    crossed = np.abs(np.diff(measured_deg)) / step_deg
    pairs = np.flatnonzero(np.isfinite(crossed) & (np.abs(np.diff(simulated_deg)) < step_deg))
    pairs = pairs[:: max(1, pairs.size // _MOST)]
    if pairs.size < _FEWEST:
        return _FINEST_SHARE * step_deg
    first, second = simulated_deg[pairs] / step_deg, simulated_deg[pairs + 1] / step_deg
    edges = np.round(first)[:, np.newaxis] + _EDGES
    before, after = edges - first[:, np.newaxis], edges - second[:, np.newaxis]
    seen = float(crossed[pairs].sum())
    seen += float(np.sqrt(seen))  # one standard deviation: a floor that is too low makes effects of noise

    def more(share: float) -> float:
        below, then = ndtr(before / share), ndtr(after / share)
        return float(np.sum(below * (1.0 - then) + then * (1.0 - below))) - seen

    low, high = _FINEST_SHARE, 1.0
    if more(low) >= 0.0:
        return low * step_deg
    return step_deg if more(high) <= 0.0 else step_deg * float(brentq(more, low, high, xtol=1e-3))


def noise_within_deg(
    measured_deg: FloatArray, simulated_deg: FloatArray, step_deg: float, sigma_deg: float
) -> FloatArray:
    """What the noise before a converter may have been [deg]: of the normal distribution, if the simulation is right.

    A reading tells between which edges a position lay; where between them is drawn, always in the same way. Unlike the
    difference of two readings it does not depend on how far the position is from an edge.
    """
    from scipy.special import log_ndtr, ndtri_exp

    low = (measured_deg - 0.5 * step_deg - simulated_deg) / sigma_deg
    high = low + step_deg / sigma_deg
    # Beyond the middle the other tail is the accurate one.
    mirrored = low + high > 0.0
    low, high = np.where(mirrored, -high, low), np.where(mirrored, -low, high)
    lower, upper = np.exp(log_ndtr(low) - log_ndtr(high)), 1.0
    drawn = np.random.default_rng(0).uniform(size=low.size)
    share = np.log(lower + drawn * (upper - lower)) + log_ndtr(high)
    noise_deg: FloatArray = sigma_deg * ndtri_exp(share)
    return np.where(mirrored, -noise_deg, noise_deg)


def mean_reading_deg(moved_deg: FloatArray, step_deg: float, sigma_deg: float) -> FloatArray:
    """What a converter with coarse steps reads on average where noise precedes it [deg]: smooth, as no reading is."""
    from scipy.special import ndtr

    whole = np.round(moved_deg / step_deg)
    rest = moved_deg / step_deg - whole
    share = sigma_deg / step_deg
    mean: FloatArray = whole + sum(
        ndtr((rest - k - 0.5) / share) - ndtr(-(rest + k + 0.5) / share) for k in range(_TEETH)
    )
    return step_deg * mean


def stepped_noise_deg(sigma_deg: float, step_deg: float) -> float:
    """Root mean square of what noise changes in a reading of coarse steps [deg].

    A move by (j + r) steps, j whole, crosses j + 1 edges with probability r and else j. The noise is summed over by
    Gauss' and Hermite's nodes.
    """
    nodes, weights = np.polynomial.hermite_e.hermegauss(_NODES)
    whole, rest = np.divmod(np.abs(nodes) * sigma_deg / step_deg, 1.0)
    squares = whole**2 + (2.0 * whole + 1.0) * rest
    return step_deg * float(np.sqrt(weights @ squares / weights.sum()))


_SIGMAS = 4.0
"""Noise floors by which two places differ that are not one."""
_HELD_S = 1.0
"""After a new command a surface may move; servos of 2 Hz and more have come to rest by then."""
_SHORTEST_REST_S = 0.25
"""Shortest rest that counts [s]."""
_STEPS_OF_LOOP = 2.0
"""A loop closed over a converter rests within one step to either side of its command."""
_SPLIT = 0.15
"""Of the variance that may stay if places are two. Places spread evenly leave 1/4, those of a slow swing, which
dwells at its ends, 1 - 8/pi^2 = 0.19; two places leave next to nothing."""
_LEAST_SHARE = 0.1
"""Share of the rests at either of two places at least."""
_FEWEST_CHANGES = 3
"""Of the end at which it lies: a horn that slipped lies elsewhere from then on, play lets it come back."""
_DIGITS = 3
"""Decimals to which commands are compared [deg]."""


def at_rest(record: Record) -> Record:
    """A single run, of which only rests count, if it is too slow for anything else."""
    if 1.0 / record.period_s >= SLOWEST_EXPLAINED_HZ:
        return record
    held_deg, held_s = _held(record)
    rest = _still(record) & (held_s >= _HELD_S) & record.counts
    # On its way a servo passes too few places twice for the steps of its converter to be seen.
    record = replace(record, step_deg=record.step_deg or comb_step_deg(record.measured_deg[rest]))
    side = np.zeros(record.time_s.size)
    for command in np.unique(np.round(held_deg[rest], _DIGITS)):
        there = rest & (np.abs(held_deg - command) < 10.0**-_DIGITS)
        side[there] = _sides(record, there)
    return replace(record, counts=rest, side=side, known=A_TYPE)


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
