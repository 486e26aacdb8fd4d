"""Wear: what is left of the current in motion, over a flight or some cycles, beside good ones.

Worn gears and dry bearings change a current in ways that a model of motion does not know: how much more it is in motion
than at rest, its spread and its roughness, up and down. Good flights differ in these as well; their covariance, with
what is known of servos before, tells how far another good one may be. Cycles of one file are judged five together: what
differs from cycle to cycle averages out, and what differs from day to day does not.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from servofd.aircraft.calibrated import lower_triangle
from servofd.aircraft.current import FEATURES, NAMES, CalibratedCurrent, Wear
from servofd.core.fitting import Noise
from servofd.core.statistics import Estimate
from servofd.core.types import FloatArray
from servofd.core.windows import Sizes, distance
from servofd.current.model import APART, HUBER, ROUNDS, Seen
from servofd.detection.verdict import Fault

_MOVES, _RESTS = 0.8, 0.1
"""Share of a direction from which on a reading is of motion, and up to which it is of rest."""
_FEWEST: Final = 15
"""Readings that a spread needs."""
_LOCAL_S, _LOCAL_ROWS = 1.0, 9
"""A spread is that about a mean of so long, and of so many readings at least: the zero of a sensor wanders."""
_LEAST_A: Final = 1e-4
"""Added to a spread before its logarithm is taken [A]."""
_MEAN_SHARE: Final = 0.02
"""How far the mean currents of good flights are from each other before any is known, as a share."""
_LOG_APART: Final = 0.07
"""How far logarithms of their other features are from each other before any is known."""
_PRIOR_FLIGHTS: Final = 10.0
"""Good flights or cycles that this counts as."""
_OWN: Final = 0.2
"""Share of what features have in common that a few flights do not prove."""
TOGETHER: Final = 5
"""Cycles that are judged together."""
_DAYS: Final = 0.2
"""Share of the variance between cycles that is between days, and no mean of cycles takes away: 0.1 is the median of six
features of a ball screw under three loads (five days of five cycles each)."""
_BLOCKS: Final = 5
"""Blocks of a flight, whose differences give the noise of its features."""
_LEAST_LIMIT: Final = 2.5
"""A good flight is as far from its mean once in some hundred, whatever the good ones were."""
FEWEST_FLIGHTS: Final = 4
"""Good flights or cycles from which on wear can be judged."""
_UP, _DOWN = NAMES.index("up"), NAMES.index("down")


def features_of(seen: Seen) -> FloatArray:
    """`FEATURES` of one flight or cycle, shape (6,); NaN where too few readings tell."""
    left_a = np.where(seen.usable, seen.error_a, 0.0)
    way = seen.slopes[:, _UP] - seen.slopes[:, _DOWN]
    steps_a = np.diff(left_a)
    length = max(round(_LOCAL_S / seen.series.period_s), _LOCAL_ROWS)
    rest = left_a[(np.abs(way) < _RESTS) & seen.usable]
    out = np.full((3, 2), np.nan)
    if rest.size < _FEWEST:
        return out.ravel()
    for k, moves in enumerate((way > _MOVES, way < -_MOVES)):
        here = left_a[moves & seen.usable]
        both = steps_a[moves[1:] & moves[:-1] & seen.usable[1:] & seen.usable[:-1]]
        if min(here.size, both.size) < _FEWEST:
            continue
        ones, kernel = np.ones(here.size), np.ones(min(length, here.size))
        local = np.convolve(here, kernel, "same") / np.convolve(ones, kernel, "same")
        spread, rough = float(np.std(here - local)), float(np.std(both))
        out[:, k] = np.median(here) - np.median(rest), np.log(spread + _LEAST_A), np.log(rough + _LEAST_A)
    return out.ravel()


def wear_of(features: Sequence[FloatArray], usual_a: float) -> Wear | None:
    """What good flights or cycles (n, 6) tell, in the order in which they were flown; None if they are too few.

    `usual_a` is the mean current [A].
    """
    table = np.array([each for each in features if np.isfinite(each).all()])
    if len(table) < FEWEST_FLIGHTS:
        return None
    known = _known(table, usual_a)
    largest = 0.0
    for block in np.array_split(np.arange(len(table)), min(_BLOCKS, len(table) // 2)):
        others = _known(np.delete(table, block, axis=0), usual_a)
        for k in range(len(block)):
            together = table[block[max(0, k + 1 - TOGETHER) : k + 1]]
            largest = max(largest, distance_of(others, together))
    return known.model_copy(update={"limit": float(f"{max(largest, _LEAST_LIMIT):.4g}")})


_PARTS: Final = 10
"""Parts of a flight, each left out once, whose disagreement gives the intervals of what is followed over flights."""


def quantities_of(seen: Seen) -> dict[str, Estimate]:
    """What is followed of a current over flights, with 95 % intervals; what a flight does not show is left out.

    Its size in motion beside that of good flights, its spread in motion, about a running mean, and what is drawn at
    rest [A].
    """
    parts = np.array_split(np.arange(seen.usable.size), _PARTS)
    rest = []
    for part in parts:
        usable = seen.usable.copy()
        usable[part] = False
        rest.append(_followed(seen._replace(usable=usable)))
    whole, others = _followed(seen), np.array(rest)
    deviation = np.sqrt((_PARTS - 1.0) * np.mean((others - others.mean(axis=0)) ** 2, axis=0))  # of the jackknife
    names = ("current_ratio", "current_spread_a", "idle_current_a")
    found = zip(names, whole.tolist(), deviation.tolist(), strict=True)
    return {name: Estimate.of(value, one) for name, value, one in found if np.isfinite((value, one)).all()}


def _followed(seen: Seen) -> FloatArray:
    """Size of the current in motion over the model's, spread and rest, shape (3,)."""
    rows = seen.usable
    motion_a = seen.healthy_a[rows] - seen.known.theta[0]
    columns = np.column_stack([motion_a, np.ones(motion_a.size)]) / seen.noise_a[rows, None]
    drawn = seen.series.current_a[rows] / seen.noise_a[rows]
    if not motion_a.size or np.ptp(motion_a) == 0.0:
        return np.full(3, np.nan)
    best = np.array([1.0, seen.known.theta[0]])
    for _ in range(ROUNDS):  # as the model itself was fitted, to which starts and gusts are spikes
        weighted = columns * Noise(huber=HUBER, is_known=True).weights(drawn - columns @ best)[:, None]
        best = np.linalg.lstsq(weighted.T @ columns, weighted.T @ drawn, rcond=None)[0]
    return np.array([best[0], np.exp(np.mean(features_of(seen)[_SPREADS])), best[1]])


_SPREADS: Final = slice(FEATURES.index("spread_up"), FEATURES.index("spread_down") + 1)
_DEVIATIONS: Final = 3.0
"""Between good flights, that make a limit: as of positions."""


def followed_limits(known: CalibratedCurrent) -> dict[str, float]:
    """What `quantities_of` may come to, by what good flights differ by."""
    limits = {"current_ratio": 1.0 + _DEVIATIONS * APART}
    if known.wear is not None:
        deviation = float(np.sqrt(np.mean(np.diag(known.wear.covariance)[_SPREADS])))
        limits["current_spread_a"] = float(np.exp(np.mean(known.wear.mean[_SPREADS]) + _DEVIATIONS * deviation))
    return limits


def _known(table: FloatArray, usual_a: float) -> Wear:
    count = len(table)
    prior = np.diag(np.array([_MEAN_SHARE * usual_a] * 2 + [_LOG_APART] * 4) ** 2)
    shared = np.cov(table.T)
    shared = (1.0 - _OWN) * shared + _OWN * np.diag(np.diag(shared))
    between = (_PRIOR_FLIGHTS * prior + (count - 1.0) * shared) / (_PRIOR_FLIGHTS + count - 1.0)
    return Wear(
        mean=tuple(float(f"{x:.6g}") for x in table.mean(axis=0)),
        between=lower_triangle(between),
        limit=_LEAST_LIMIT,
        flights=count,
    )


def distance_of(known: Wear, together: FloatArray) -> float:
    """J of the mean of some flights (k, 6) beside good ones, over the number of features."""
    days = _DAYS + (1.0 - _DAYS) / len(together)
    learnt = (_DAYS + (1.0 - _DAYS) / TOGETHER) * TOGETHER / known.flights
    away = (together.mean(axis=0) - np.array(known.mean))[:, None]
    return float(distance(Sizes(away, (days + learnt) * known.covariance[..., None]), None)[0]) / len(FEATURES)


def worn(seen: Seen, before: Sequence[FloatArray] = ()) -> tuple[Fault, ...]:
    """Whether a flight, with the cycles before it, is further from good ones than they are from each other."""
    known, own = seen.known.wear, features_of(seen)
    if known is None or not np.isfinite(own).all():
        return ()
    together = np.array([*(each for each in before if np.isfinite(each).all()), own])[-TOGETHER:]
    ratio = distance_of(known, together) / known.limit
    if ratio < 1.0:
        return ()
    first_s, last_s = (float(seen.series.time_s[k]) for k in (0, -1))
    away = (together.mean(axis=0) - np.array(known.mean)) / np.sqrt(np.diag(known.covariance))
    most = int(np.argmax(np.abs(away)))
    size = float(np.sqrt(ratio))
    off = Estimate.of(float(away[most]), 1.0)  # in standard deviations between good flights
    parameters = {"distance": Estimate.of(size, 1.0 / np.sqrt(2.0 * len(FEATURES))), FEATURES[most]: off}
    return (Fault("worn", first_s, last_s, None, parameters, 1.0, (), "suspect", named_s=last_s, witness="current"),)
