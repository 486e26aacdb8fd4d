r"""The current of a healthy servo, fitted to what it draws as it moves as its command asks.

A motor draws what its torque needs: to hold the load of the air (hinge moment, proportional to dynamic pressure
:math:`q` and deflection :math:`y`), to overcome friction in either direction, to accelerate, and what its electronics
take. With :math:`s = \tanh(\dot y / 3)` for the direction of motion,

.. math:: i = c_0 + q\,(c_1 |y| + c_2 y + c_3\, \max(s y, 0)) + c_4 \max(s, 0) + c_5 \max(-s, 0) + c_6 |\dot y|
          + c_7\, s \ddot y + c_8 (u - u_0)

and friction may be larger at the ends of the travel. The motion is that of the healthy servo on its commands, so that a
servo that stands still, or a sensor that does, is no excuse. A reading comes later than its motion, and may be the mean
since the one before: both are found by which fits best.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np

from servofd.aircraft.calibrated import lower_triangle
from servofd.aircraft.current import NAMES, CalibratedCurrent, CurrentNoise
from servofd.core.errors import CalibrationError
from servofd.core.fitting import Noise
from servofd.core.series import latest
from servofd.core.statistics import MAD_TO_SIGMA
from servofd.core.types import BoolArray, FloatArray
from servofd.estimate.record import load_at, loads, usual_airspeed_m_s, usual_supply_v
from servofd.servo.context import Context
from servofd.servo.servo_model import ServoModel

_GRID_S: Final = 0.02
"""Steps of the motion: a fifth of the lag of the fastest hobby servo."""
_DIRECTION_DEG_S: Final = 3.0
"""Speed at which friction has three quarters of its direction: hobby servos creep below."""
_LAGS_S: Final = (0.0, 0.02, 0.04, 0.07, 0.11, 0.16, 0.24, 0.35, 0.5)
"""Lags of the motion behind the command that are tried [s]."""
_BEFORE_S: Final = 2.0
"""Motion before and after a part of a series that its readings may see [s]: four of the longest lags."""
_LONGEST_GAP_S: Final = 1.0
"""A command that comes after more than this says nothing of the motion before it."""
HUBER, ROUNDS = 2.5, 5
"""Standard deviations beyond which an error counts by its size, and not its square (Huber); and how often what an
error counts is taken anew."""
_LOOSE_A: Final = 10.0
"""How far any term of a servo's current may be from zero."""
_ENDS: Final = 0.3
"""Share of its friction by which that at the ends of the travel differs from that in the middle."""
_LEAST_ROWS: Final = 40
"""Readings of a current that a fit needs."""
_BEYOND: Final = 1.5
"""Times its reach in the flights that were fitted within which a current is judged."""
_SLOWER: Final = 1.25
"""Times slower or faster than was flown then, likewise."""
_MOST_ROWS: Final = 4_000
"""Readings of which the lag is found."""
_LEAST_A: Final = 1e-4
"""Smallest noise of a current [A], and the finest step of its sensor that is looked for."""
_OF_STEP: Final = float(1.0 / np.sqrt(12.0))
"""Noise of a reading in steps, over the step."""
_FAR_SIGMAS, _MOST_SHARE = 4.0, 3.0
"""Deviations beyond which a reading says nothing about the noise, and the noise of motion over its current at
most."""
MOVES_DEG: Final = 2.0
"""A command that stays within less asks nothing of a servo."""
_ENDS_OF: Final = np.array([name.endswith(("_1", "_2")) for name in NAMES])
_COSTS: Final = np.array([
    [float(name in costs) for name in NAMES] for costs in (("idle",), ("hold",), ("up", "down"), ("speed",))
])  # fmt: skip
"""Sums of terms that are not negative: electronics, what is held to either side, friction there and back (one way a
constant load may help), speed. A minute at 1 Hz gave a friction of -0.08 A, and 0.09 A at rest for 0.01 A: a servo
without power showed in large movements alone."""


@dataclass(frozen=True, eq=False)
class CurrentSeries:
    """What a log holds of the current of one servo.

    `surface`: whose it is. `time_s`, `current_a` (shape (m,)): when it was read [s], rising, and what it was [A].
    `motion`: of the healthy servo on its commands. `context`: airspeed and supply. `notes`: what to know of it.
    """

    surface: str
    time_s: FloatArray
    current_a: FloatArray
    motion: Motion
    context: Context
    notes: tuple[str, ...] = ()

    @cached_property
    def period_s(self) -> float:
        """Usual time between two readings [s]."""
        return float(np.median(np.diff(self.time_s)))

    def within(self, from_s: float, to_s: float) -> CurrentSeries:
        """The same in a part of its time."""
        rows = slice(*np.searchsorted(self.time_s, (from_s, to_s)))
        motion = self.motion.within(from_s - _BEFORE_S, to_s + _BEFORE_S)
        return CurrentSeries(self.surface, self.time_s[rows], self.current_a[rows], motion, self.context, self.notes)


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Commands, and how a healthy servo moves on them, on a grid of its own of shape (n,)."""

    time_s: FloatArray
    asked_deg: FloatArray
    deflection_deg: FloatArray
    speed_deg_s: FloatArray
    push_deg_s2: FloatArray
    """Acceleration."""
    known: BoolArray
    """Where commands are near enough to tell it."""

    @classmethod
    def of(cls, model: ServoModel, command_s: FloatArray, command_deg: FloatArray, to_s: float) -> Motion:
        """Of a servo on commands at times [s] that ask for deflections [deg], shape (k,) each."""
        time_s = np.arange(command_s[0], max(to_s, command_s[-1]) + _GRID_S, _GRID_S)
        deflection_deg = model.simulate(command_s, command_deg, time_s)
        speed_deg_s = np.gradient(deflection_deg, _GRID_S)
        after = np.searchsorted(command_s, time_s, side="right")
        return cls(
            time_s,
            latest(command_s, command_deg, time_s),
            deflection_deg,
            speed_deg_s,
            np.gradient(speed_deg_s, _GRID_S),
            time_s - command_s[after - 1] <= _LONGEST_GAP_S,
        )

    def within(self, from_s: float, to_s: float) -> Motion:
        """The same in a part of its time; the last instant of it before a part without commands."""
        first, last = np.searchsorted(self.time_s, (from_s, to_s)).tolist()
        rows = slice(min(first, self.time_s.size - 1), max(last, 1))
        return Motion(*(getattr(self, each.name)[rows] for each in fields(self)))

    def rows(self, at_s: FloatArray, lag_s: float, width_s: float, values: FloatArray) -> FloatArray:
        """Values (n, k) as readings at some times see them, (m, k): late, and averaged over a width."""
        place = np.clip(np.round((at_s - lag_s - self.time_s[0]) / _GRID_S).astype(int), 0, self.time_s.size - 1)
        return np.asarray(averaged(values, width_s)[place])

    def is_known(self, at_s: FloatArray) -> BoolArray:
        """Whether commands tell the motion at some times."""
        place = np.clip(((at_s - self.time_s[0]) / _GRID_S).astype(int), 0, self.time_s.size - 1)
        known: BoolArray = self.known[place] & (at_s >= self.time_s[0])
        return known


def averaged(values: FloatArray, width_s: float) -> FloatArray:
    """Values on the grid of a motion, shape (n, k), as their means over the time before."""
    if width_s < _GRID_S:
        return values
    sums = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    last = np.arange(1, len(values) + 1)
    first = np.maximum(last - round(width_s / _GRID_S), 0)
    mean: FloatArray = (sums[last] - sums[first]) / (last - first)[:, None]
    return mean


def terms(
    series: CurrentSeries, known: CalibratedCurrent | _Seeing, columns: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Terms of a healthy current at its readings, shape (m, terms), and how much it moves, from 0 to 1, shape (m,).

    `columns` are those of its motion (`_columns`), for whoever sees them with several lags.
    """
    columns = _columns(series, known) if columns is None else columns
    out = series.motion.rows(series.time_s, known.lag_s, known.width_s, columns)
    return out[:, :-1], out[:, -1]


def _columns(series: CurrentSeries, known: CalibratedCurrent | _Seeing) -> FloatArray:
    """The same on the grid of the motion, shape (n, terms + 1)."""
    motion = series.motion
    y, v = motion.deflection_deg, motion.speed_deg_s
    way = np.tanh(v / _DIRECTION_DEG_S)
    load = np.ones(y.size)
    if known.airspeed_m_s and series.context.airspeed_s.size:
        load = loads(series.context, motion.time_s, known.airspeed_m_s) / load_at(known.airspeed_m_s)
    middle, half = 0.5 * sum(known.reach_deg), max(0.5 * (known.reach_deg[1] - known.reach_deg[0]), 1e-3)
    place = np.clip((y - middle) / half, -1.0, 1.0)
    bowl = 1.5 * place**2 - 0.5
    up, down, held = np.maximum(way, 0.0), np.maximum(-way, 0.0), load * (y - middle) / 10.0
    volts = np.zeros(y.size)
    if known.supply_v and series.context.voltage_s.size:
        volts = series.context.supply_v(motion.time_s) - known.supply_v
    return np.column_stack([
        np.ones(y.size), np.abs(held), held, up, down, np.abs(v) / 100.0, np.maximum(way * held, 0.0),
        way * motion.push_deg_s2 / 1000.0, up * place, up * bowl, down * place, down * bowl, volts, way**2,
    ])  # fmt: skip


class _Seeing(NamedTuple):
    """What terms depend on, before they are fitted."""

    reach_deg: tuple[float, float]
    lag_s: float
    width_s: float
    supply_v: float
    airspeed_m_s: float


def fit_current(
    parts: Sequence[CurrentSeries], *, is_own: bool = False, late_s: tuple[float, float] | None = None
) -> CalibratedCurrent:
    """Fit a healthy current to good flights, and by how much others, or the rest of the same (`is_own`), may differ.

    `late_s`: by how much its readings come late, and over how long they average, where that is known.

    Raises `CalibrationError` if there is too little motion or current.
    """
    reach = np.concatenate([np.zeros(0), *map(_between, parts)])
    if reach.size == 0 or float(np.ptp(reach)) < MOVES_DEG:
        raise CalibrationError(f"its command moves by less than {MOVES_DEG:g} deg: no current to learn from")
    usual_v = float(np.median([usual_supply_v(part.context) for part in parts]))
    ends = float(np.quantile(reach, 0.002)), float(np.quantile(reach, 0.998))
    draft = _Seeing(ends, 0.0, 0.0, usual_v, usual_airspeed_m_s([part.context for part in parts]))
    rows = [part.motion.is_known(part.time_s) for part in parts]
    if sum(int(np.count_nonzero(each)) for each in rows) < _LEAST_ROWS:
        raise CalibrationError(f"fewer than {_LEAST_ROWS} readings of its current with commands around them")
    period_s = float(np.median([part.period_s for part in parts]))
    drawn = np.concatenate([part.current_a[each] for part, each in zip(parts, rows, strict=True)])
    if not np.ptp(drawn) > 0.0:
        raise CalibrationError("its current never changes: not a measurement")
    least_a = _least_noise(drawn)
    columns = [_columns(part, draft) for part in parts]
    lag_s, width_s = late_s or _late_s(parts, rows, columns, draft, least_a)
    chosen = draft._replace(lag_s=lag_s, width_s=width_s)
    tables = [terms(part, chosen, each)[0] for part, each in zip(parts, columns, strict=True)]
    table = np.concatenate([each[use] for each, use in zip(tables, rows, strict=True)])
    still, share, weight = _spread(drawn, least_a), 0.0, np.ones(drawn.size)
    for _ in range(ROUNDS):
        theta, _ = _solved(table, drawn, weight)
        motion_a = np.maximum(table @ theta - theta[0], 0.0)
        still, share = _noise(drawn - table @ theta, motion_a, least_a)
        sigma = np.hypot(still, share * motion_a)
        weight = Noise(huber=HUBER, sigma=sigma, is_known=True).weights(drawn - table @ theta)
    theta, covariance = _solved(table, drawn, weight)
    left = drawn - table @ theta
    sigma = np.hypot(still, share * np.maximum(table @ theta - theta[0], 0.0))
    scaled = np.clip(left / sigma, -HUBER, HUBER)
    colour = float(np.clip(np.mean(scaled[1:] * scaled[:-1]) / np.mean(scaled**2), 0.0, 0.95))
    spread_a, free = float(np.var(drawn)), drawn.size - 2 * len(NAMES)  # half of the terms follow a few starts
    known = CalibratedCurrent(
        parameters={name: float(f"{value:.6g}") for name, value in zip(NAMES, theta.tolist(), strict=True)},
        between=lower_triangle(np.eye(len(NAMES))),
        noise=CurrentNoise(
            still_a=float(f"{still:.4g}"), share=round(share, 4), colour=round(colour, 4),
            period_s=float(f"{period_s:.6g}"),
        ),
        lag_s=chosen.lag_s,
        width_s=round(chosen.width_s, 6),
        reach_deg=(round(ends[0], 3), round(ends[1], 3)),
        explained_share=round(1.0 - float(np.var(left)) / max(spread_a, 1e-12) * drawn.size / max(free, 1), 4),
        most_a=float(f"{max(float(np.quantile(drawn, 0.999)) - theta[0], still):.4g}"),
        supply_v=round(chosen.supply_v, 3),
        airspeed_m_s=round(chosen.airspeed_m_s, 2),
        airspeeds_m_s=_airspeeds(parts),
    )  # fmt: skip
    # Readings that are alike say a thing once.
    unsure = _UNCERTAINTIES * ((1.0 + colour) / (1.0 - colour) * covariance)
    left_a = [part.current_a - table @ theta for part, table in zip(parts, tables, strict=True)]
    covariance = unsure + np.diag(_apart(parts, known, left_a, is_own=is_own) + _ROUNDED * np.diag(unsure))
    return known.model_copy(update={"between": lower_triangle(covariance)})


def _late_s(
    parts: Sequence[CurrentSeries], rows: Sequence[BoolArray], columns: Sequence[FloatArray], draft: _Seeing,
    least_a: float,
) -> tuple[float, float]:  # fmt: skip
    """By how much readings come late, and over how long they average [s]: as fits their `rows` best."""
    step = 1 + sum(map(np.count_nonzero, rows)) // _MOST_ROWS
    some = [
        replace(p, time_s=p.time_s[use][::step], current_a=p.current_a[use][::step])
        for p, use in zip(parts, rows, strict=True)
    ]
    drawn, best = np.concatenate([part.current_a for part in some]), (np.inf, 0.0, 0.0)
    period_s = float(np.median([part.period_s for part in parts]))
    for width_s in (0.0, period_s) if period_s > 2.0 * _GRID_S else (0.0,):
        means = [averaged(each, width_s) for each in columns]
        for lag_s in _LAGS_S:
            seeing = draft._replace(lag_s=lag_s)
            table = np.concatenate([terms(part, seeing, mean)[0] for part, mean in zip(some, means, strict=True)])
            left = drawn - table @ _solved(table, drawn, np.ones(len(table)))[0]
            cost = float(np.mean(np.minimum(np.abs(left), HUBER * _spread(left, least_a)) ** 2))
            best = min(best, (cost, lag_s, width_s), key=lambda each: each[0])
    return best[1:]


_UNCERTAINTIES: Final = 4.0
"""Factor by which the covariance of the fit is widened: two standard deviations count as one."""
APART: Final = 0.1
"""Share by which each term of a current differs between flights: wind, warmth and supply."""
_APART_OWN: Final = 0.2
"""The same within a log that it was fitted to a part of, whose motions are few."""
_LEAST: Final = 0.1
"""The least of it, as a share of the mean current of motion."""
_IDLE_APART: Final = 0.3
"""Of what electronics take: warmth, and pulses that come faster."""
_ROUNDED: Final = 1e-3
"""Share of a variance that a file of five digits may leave out without becoming no covariance."""
_PRIOR_FLIGHTS: Final = 4.0
"""The shares count as so many differences between flights."""


def _apart(
    parts: Sequence[CurrentSeries], known: CalibratedCurrent, left_a: Sequence[FloatArray], *, is_own: bool
) -> FloatArray:
    """Variances of the terms between flights, shape (13,), of which the current has left so much of each."""
    tables = [terms(part, known)[0] for part in parts]
    usual_a = float(np.mean(np.maximum(np.concatenate(tables) @ known.theta - known.theta[0], 0.0)))
    share = _APART_OWN if is_own else APART
    apart = np.hypot(share * known.theta, _LEAST * usual_a) ** 2
    apart[0] = (_IDLE_APART * np.hypot(known.theta[0], known.noise.still_a)) ** 2
    if len(parts) > 1:
        changes = np.array([_change(t, left, apart, known) for t, left in zip(tables, left_a, strict=True)])
        apart = (_PRIOR_FLIGHTS * apart + (changes**2).sum(axis=0)) / (_PRIOR_FLIGHTS + len(parts) - 1.0)
    return np.asarray(apart)


def _change(table: FloatArray, left: FloatArray, apart: FloatArray, known: CalibratedCurrent) -> FloatArray:
    """How one flight alone would change the terms, as far as it tells, shape (13,)."""
    motion_a = np.maximum(table @ known.theta - known.theta[0], 0.0)
    weight = 0.25 / np.hypot(known.noise.still_a, known.noise.share * motion_a) ** 2
    block = (table * weight[:, None]).T @ table + np.diag(1.0 / (4.0 * apart))
    return np.asarray(np.linalg.solve(block, table.T @ (weight * np.nan_to_num(left))))


def _airspeeds(parts: Sequence[CurrentSeries]) -> tuple[float, float] | None:
    """Slowest and fastest while currents were read, but for glitches [m/s]; None if some flight did not log it."""
    if not all(part.context.airspeed_s.size for part in parts):
        return None
    flown = [np.interp(part.time_s, part.context.airspeed_s, part.context.airspeed_m_s) for part in parts]
    slowest, fastest = np.quantile(np.concatenate(flown), (0.01, 0.99)).tolist()
    return round(slowest, 2), round(fastest, 2)


def _between(part: CurrentSeries) -> FloatArray:
    """Deflections of the motion while its current was read."""
    inside = slice(*np.searchsorted(part.motion.time_s, part.time_s[[0, -1]] if part.time_s.size else (0, 0)).tolist())
    return part.motion.deflection_deg[inside][part.motion.known[inside]]


def _solved(table: FloatArray, drawn: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Terms by weighted least squares; friction at the ends is like that in the middle as far as nothing tells.

    What costs current gives none back (`_COSTS`): of those that the fit takes for negative by more than it knows them,
    the surest is held at zero, and the others are fitted again.
    """
    friction = max(float(np.std(drawn)), _LEAST_A)
    block = (table * weight[:, None]).T @ table
    block += np.diag(np.where(_ENDS_OF, 1.0 / (_ENDS * friction) ** 2, 1.0 / _LOOSE_A**2))
    while True:
        covariance = np.asarray(np.linalg.inv(block), dtype=np.float64)
        theta: FloatArray = covariance @ (table.T @ (weight * drawn))
        sigmas = _COSTS @ theta / np.sqrt(np.einsum("ij,jk,ik->i", _COSTS, covariance, _COSTS))
        least = int(np.argmin(sigmas))
        if sigmas[least] >= -1.0:
            return theta, covariance
        block += np.outer(_COSTS[least], _COSTS[least]) / _LEAST_A**2


def _least_noise(drawn: FloatArray) -> float:
    """Noise that a current has at least by the steps of its sensor [A].

    Examples
    --------
    >>> float(round(_least_noise(np.array([0.0, 0.3, 0.1, 0.1])), 4))
    0.0289
    """
    steps = np.diff(np.unique(np.round(drawn / _LEAST_A))) * _LEAST_A
    return max(_OF_STEP * float(steps.min()), _LEAST_A) if steps.size else _LEAST_A


def _spread(values: FloatArray, least_a: float) -> float:
    return max(MAD_TO_SIGMA * float(np.median(np.abs(values - np.median(values)))), least_a)


def _noise(left: FloatArray, motion_a: FloatArray, least_a: float) -> tuple[float, float]:
    """Noise at rest [A], and as a share of the current of motion."""
    order = np.argsort(motion_a)
    quiet, busy = order[: order.size // 2], order[3 * order.size // 4 :]
    still = max(float(np.sqrt(_square(left[quiet], least_a))), least_a)
    extra = max(_square(left[busy], least_a) - still**2, 0.0) / max(float(np.mean(motion_a[busy] ** 2)), least_a**2)
    return still, min(float(np.sqrt(extra)), _MOST_SHARE)


def _square(left: FloatArray, least_a: float) -> float:
    """Mean square of what is left, with what is far off counted as less."""
    most = _FAR_SIGMAS * _spread(left, least_a)
    return float(np.mean(np.clip(left, -most, most) ** 2))


class Seen(NamedTuple):
    """A series beside a healthy current."""

    series: CurrentSeries
    known: CalibratedCurrent
    slopes: FloatArray
    """Terms, shape (m, terms)."""
    healthy_a: FloatArray
    moving: FloatArray
    """From 0 to 1, shape (m,)."""
    noise_a: FloatArray
    usable: BoolArray

    @property
    def sigma_a(self) -> FloatArray:
        """By which good servos differ from it, shape (m,)."""
        between: FloatArray = np.einsum("ij,jk,ik->i", self.slopes, self.known.covariance, self.slopes)
        return np.asarray(np.sqrt(self.noise_a**2 + between))

    @property
    def error_a(self) -> FloatArray:
        """Residual, NaN where none is judged, shape (m,)."""
        return np.where(self.usable, self.series.current_a - self.healthy_a, np.nan)


def see(series: CurrentSeries, known: CalibratedCurrent) -> Seen:
    """Lay a series beside a healthy current."""
    table, moving = terms(series, known)
    healthy_a = table @ known.theta
    motion_a = healthy_a - known.theta[0]
    noise = known.noise
    noise_a = np.hypot(noise.still_a, noise.share * np.maximum(motion_a, 0.0))
    middle, half = 0.5 * sum(known.reach_deg), 0.5 * (known.reach_deg[1] - known.reach_deg[0])
    (deflection_deg,) = series.motion.rows(series.time_s, known.lag_s, 0.0, series.motion.deflection_deg[:, None]).T
    usable = series.motion.is_known(series.time_s) & np.isfinite(series.current_a)
    usable &= np.abs(deflection_deg - middle) <= _BEYOND * half  # what holds it further out is not known
    if known.airspeeds_m_s is not None and series.context.airspeed_s.size:
        slowest, fastest = known.airspeeds_m_s
        airspeed_m_s = np.interp(series.time_s, series.context.airspeed_s, series.context.airspeed_m_s)
        usable &= (airspeed_m_s >= slowest / _SLOWER) & (airspeed_m_s <= fastest * _SLOWER)
    return Seen(series, known, table, healthy_a, moving, noise_a, usable)
