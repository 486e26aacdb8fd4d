"""Lines and breaks in what many flights tell of one number, neither misled by single flights that went wrong."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np

from servofd.core.statistics import LEAST_DIVISOR, MAD_TO_SIGMA, Estimate
from servofd.core.types import FloatArray
from servofd.wear.estimate import QUANTITIES, ServoEstimate

CHANCE = 1e-6
"""Of a change where there is none: six surfaces with nine numbers, in a hundred fleets, are 5400 chances for one."""
_CLIPPED = 3.0
"""A flight beyond three deviations of the others counts as one at three."""
_ROUNDS = 12
"""Rounds of the iteration for a line and the scatter about it."""
FEWEST_FOR_LINE = 3
"""Flights that a slope needs, and that stand on either side of a break: two that went wrong in a row are no other
servo."""
_LINE = 2
"""Parameters of a line."""
_SMALLEST = 1e-12
"""Added to scatter and spread, so that nothing is divided by zero."""


@dataclass(frozen=True, slots=True, eq=False)
class Line:
    """A line through the flights of one piece.

    `centre`: flight number at which the line has its intercept. `level`, `slope`: at the centre, and per flight.
    `covariance` (shape (2, 2)): of level and slope. `freedom`: number of flights less two.
    """

    centre: float
    level: float
    slope: float
    covariance: FloatArray
    freedom: int

    def at(self, number: float) -> Estimate:
        """Value of the line at a flight, with its 95 % interval."""
        away = np.array([1.0, number - self.centre])
        return self._estimate(self.level + self.slope * away[1], float(away @ self.covariance @ away))

    @property
    def slope_estimate(self) -> Estimate:
        """Change per flight, with its 95 % interval."""
        return self._estimate(self.slope, float(self.covariance[1, 1]))

    @property
    def chance(self) -> float:
        """Probability of so steep a slope if nothing changes."""
        from scipy.stats import t

        deviation = float(np.sqrt(self.covariance[1, 1]))
        return float(2.0 * t.sf(abs(self.slope) / max(deviation, LEAST_DIVISOR), self.freedom))

    def _estimate(self, value: float, variance: float) -> Estimate:
        half = self.student * float(np.sqrt(variance))
        return Estimate(value, value - half, value + half)

    @property
    def student(self) -> float:
        """Standard deviations in a 95 % interval, for so few flights."""
        from scipy.stats import t

        return float(t.ppf(0.975, self.freedom))


@dataclass(frozen=True, eq=False)
class Piece:
    """Flights between two breaks, of shape (k,): their numbers, values and deviations."""

    number: FloatArray
    value: FloatArray
    deviation: FloatArray

    @cached_property
    def line(self) -> Line:
        """The line through them; needs three flights."""
        return fit_line(self.number, self.value, self.deviation)

    def between(self, from_: float, to: float) -> Piece | None:
        """Its flights from one number on and before another; None if there are none."""
        inside = (self.number >= from_) & (self.number < to)
        return Piece(self.number[inside], self.value[inside], self.deviation[inside]) if inside.any() else None

    @property
    def first(self) -> int:
        """Number of the first flight."""
        return int(self.number[0])

    @property
    def last(self) -> int:
        """Number of the last flight."""
        return int(self.number[-1])


def fit_line(number: FloatArray, value: FloatArray, deviation: FloatArray) -> Line:
    """Line through flights that scatter more than their own intervals say, a few of which may have gone wrong.

    Least squares, weighted by the variance of each flight (its own, and the scatter from flight to flight, which is
    found such that the clipped squares of the errors have their expectation); flights beyond three deviations count
    as at three (Huber). It starts from the median of all slopes (Theil and Sen).
    """
    from scipy.stats import theilslopes

    centre = float(np.mean(number))
    x = number - centre
    slope = float(theilslopes(value, x)[0])
    level = float(np.median(value - slope * x))
    freedom = number.size - 2
    design, covariance = np.column_stack([np.ones(x.size), x]), np.zeros((2, 2))
    for _ in range(_ROUNDS):
        error = value - level - slope * x
        sigma = np.sqrt(deviation**2 + _scatter(error, deviation, freedom) ** 2 + _SMALLEST**2)
        weight = np.minimum(1.0, _CLIPPED / np.maximum(np.abs(error) / sigma, _SMALLEST)) / sigma**2
        covariance = np.linalg.inv(design.T @ (weight[:, None] * design))
        level, slope = (float(v) for v in covariance @ (design.T @ (weight * value)))
    return Line(centre, level, slope, covariance, freedom)


def _scatter(error: FloatArray, deviation: FloatArray, freedom: int) -> float:
    """Scatter with which the clipped squared errors, in deviations, have a mean of one; 0 if they have less anyway."""
    from scipy.optimize import brentq

    def excess(scatter: float) -> float:
        squares = error**2 / (deviation**2 + scatter**2 + _SMALLEST**2)
        return float(np.sum(np.minimum(squares, _CLIPPED**2))) / freedom - 1.0

    most = float(np.max(np.abs(error))) * np.sqrt(error.size) + _SMALLEST
    if excess(0.0) <= 0.0 or excess(most) >= 0.0:
        return 0.0
    return float(brentq(excess, 0.0, most, xtol=1e-3 * most))


def pieces(whole: Piece) -> tuple[Piece, ...]:
    """Cut flights where one line does not do, and two lines do: a jump, or another slope.

    A cut must be less likely by chance than `CHANCE`, by the F test of two lines against one with clipped squares,
    times the number of places where it could be; then both parts are cut in the same way.
    """
    cut = _best_cut(whole)
    if cut is None:
        return (whole,)
    sides = whole.between(-np.inf, whole.number[cut]), whole.between(whole.number[cut], np.inf)
    return tuple(piece for side in sides if side for piece in pieces(side))


def _best_cut(whole: Piece) -> int | None:
    """Where to cut, as a number of flights before it; None if one line does."""
    from scipy.stats import f

    size = whole.number.size
    places = np.arange(FEWEST_FOR_LINE, size - FEWEST_FOR_LINE + 1)
    if places.size == 0 or size <= 2 * _LINE:
        return None
    value = _without_outliers(whole.value, whole.deviation)
    weight = 1.0 / (whole.deviation**2 + _local_scatter(value, whole.deviation) ** 2 + _SMALLEST**2)
    before, after = _costs(whole.number, value, weight), _costs(whole.number[::-1], value[::-1], weight[::-1])[::-1]
    two = before[places - 1] + after[places]
    freedom = size - 2 * _LINE
    gain = (before[-1] - two) / _LINE / np.maximum(two / freedom, 1.0)
    chance = f.sf(np.maximum(gain, 0.0), _LINE, freedom) * places.size
    best = int(np.argmax(gain))
    return int(places[best]) if chance[best] < CHANCE else None


def _without_outliers(value: FloatArray, deviation: FloatArray) -> FloatArray:
    """Values no further than three deviations from the median of their neighbours (Hampel)."""
    from scipy.ndimage import median_filter

    middle: FloatArray = median_filter(value, size=5, mode="nearest")
    away = value - middle
    sigma = np.sqrt(deviation**2 + (MAD_TO_SIGMA * float(np.median(np.abs(away)))) ** 2)
    return middle + np.clip(away, -_CLIPPED * sigma, _CLIPPED * sigma)


def _local_scatter(value: FloatArray, deviation: FloatArray) -> float:
    """Scatter from flight to flight, from second differences: neither a trend nor a jump enters."""
    total = MAD_TO_SIGMA * float(np.median(np.abs(np.diff(value, 2)))) / np.sqrt(6.0)
    return float(np.sqrt(max(total**2 - float(np.median(deviation)) ** 2, 0.0)))


def _costs(number: FloatArray, value: FloatArray, weight: FloatArray) -> FloatArray:
    """Weighted squared error of a line through the first k flights, for all k; shape (n,)."""
    x, y = number - number.mean(), value - value.mean()
    w, wx, wy, wxx, wxy, wyy = (np.cumsum(weight * terms) for terms in (np.ones(x.size), x, y, x * x, x * y, y * y))
    spread = np.maximum(wxx - wx**2 / w, _SMALLEST)
    costs: FloatArray = np.maximum(wyy - wy**2 / w - (wxy - wx * wy / w) ** 2 / spread, 0.0)
    return costs


EventKind = Literal["swap", "adjusted", "changed"]

_SIGMAS = 4.0
"""Standard deviations of both levels that a jump must exceed."""
_OF_THE_SERVO = ("dead_band_deg", "delay_s", "bandwidth_hz", "rate_limit_deg_s", "bias_deg", "noise_deg")
"""What another servo brings along; size of residual and margin follow from these."""
_SAME_EVENT = 1
"""Cuts that lie no further apart are one: the best place to cut differs by a flight with the scatter."""
_NUMBERS_OF_ANOTHER_SERVO = 2


class Jump(NamedTuple):
    """One number before and after."""

    before: float
    after: float


@dataclass(frozen=True, slots=True)
class Event:
    """Something was done to the servo, or happened to it, between two flights."""

    kind: EventKind
    first: int
    """Number of the first flight after it."""
    jumps: Mapping[str, Jump]
    """What changed, by name of the quantity."""
    reason: str
    """In words."""


def find_events(series: Mapping[str, Piece], telling: Mapping[str, float]) -> tuple[Event, ...]:
    """Find when numbers of a servo changed at once."""
    found: list[tuple[int, str, Jump]] = []
    for name in _OF_THE_SERVO:
        if name in series:
            cut = itertools.pairwise(pieces(series[name]))
            found += [(b.first, name, jump) for a, b in cut if (jump := _jump(a, b, telling[name]))]
    groups: list[list[tuple[int, str, Jump]]] = []
    for one_cut in sorted(found, key=lambda cut: cut[0]):
        if groups and one_cut[0] - groups[-1][-1][0] <= _SAME_EVENT:
            groups[-1].append(one_cut)
        else:
            groups.append([one_cut])
    return tuple(_event(group) for group in groups)


def _jump(before: Piece, after: Piece, telling: float) -> Jump | None:
    """The step between two pieces; None if there is none, only another slope."""
    middle = (before.last + after.first) / 2.0
    left, right = _end(before, middle), _end(after, middle)
    size = right[0] - left[0]
    if abs(size) < max(telling, _SIGMAS * float(np.hypot(left[1], right[1]))):
        return None
    return Jump(left[0], right[0])


def _end(piece: Piece, number: float) -> tuple[float, float]:
    """Value and deviation of a piece's line where it ends; of its median, if it is too short for a slope."""
    if piece.number.size <= 4:
        return float(np.median(piece.value)), float(np.max(piece.deviation) + np.std(piece.value))
    there = piece.line.at(number)
    return there.value, (there.high - there.value) / piece.line.student


def _event(group: Sequence[tuple[int, str, Jump]]) -> Event:
    first = int(np.median([cut[0] for cut in group]))
    jumps = {name: jump for _, name, jump in group}
    changes = ", ".join(_change(name, jump) for name, jump in jumps.items())
    dead_band = jumps.get("dead_band_deg")
    if len(jumps) >= _NUMBERS_OF_ANOTHER_SERVO or (dead_band and dead_band.after < dead_band.before):
        return Event("swap", first, jumps, f"another servo or linkage since flight {first}: {changes}")
    if "bias_deg" in jumps:
        return Event("adjusted", first, jumps, f"trimmed, or the horn moved, before flight {first}: {changes}")
    return Event(
        "changed", first, jumps, f"changed at once before flight {first}, by damage or repair, not wear: {changes}"
    )


def _change(name: str, jump: Jump) -> str:
    what = QUANTITIES[name]
    before, after = (f"{what.scale * value:z.{what.digits}f}" for value in (jump.before, jump.after))
    return f"{what.title} {before} to {after} {what.unit}"


FEWEST_FLIGHTS = 8
"""Six degrees of freedom: a 95 % interval of 2.4 deviations."""
TOO_FEW = "too few flights for a trend"
"""Reason of a forecast that only more flights can bring."""
HORIZON = 4.0
"""A forecast reaches at most four times as many flights as were seen."""


@dataclass(frozen=True, slots=True)
class Forecast:
    """When, or why not.

    `kind` ({"reached", "crossing", "none"}): the limit is exceeded; it will be; nothing can be said, or nothing
    happens. `reason`: in words. `flight`, `low`, `high`: number of the flight at which the line crosses the limit, with
    its 95 % interval.
    """

    kind: Literal["reached", "crossing", "none"]
    reason: str
    flight: float | None = None
    low: float | None = None
    high: float | None = None

    @property
    def is_alarm(self) -> bool:
        """Whether it calls for an action."""
        return self.kind != "none"


def forecast(piece: Piece, limit: float, *, above: bool) -> Forecast:
    """Extrapolate the line of the last flights to a limit.

    The interval is Fieller's: all flights at which the limit lies within the 95 % interval of the line.
    """
    sign = 1.0 if above else -1.0
    count = piece.number.size
    if count <= 2:
        return Forecast("none", TOO_FEW)
    line = piece.line
    now = line.at(piece.last)
    if min(sign * now.low, sign * now.high) >= sign * limit:
        return Forecast("reached", "is beyond its limit")
    if count < FEWEST_FLIGHTS:
        return Forecast(
            "none", f"only {count} flights since the last change; {FEWEST_FLIGHTS} are needed for a forecast"
        )
    if line.chance > CHANCE:
        return Forecast("none", "no trend that chance does not explain")
    if sign * line.slope <= 0.0:
        return Forecast("none", "moves away from its limit")
    return _crossing(line, piece, limit)


def _crossing(line: Line, piece: Piece, limit: float) -> Forecast:
    flight = line.centre + (limit - line.level) / line.slope
    span = piece.last - piece.first + 1
    low, high = _fieller(line, limit)
    if flight > piece.last + HORIZON * span:
        return Forecast("none", f"not within the next {HORIZON * span:.0f} flights; further on nothing can be said")
    if not math.isfinite(high):
        return Forecast("none", "rises, but too uncertainly to say when it crosses its limit")
    return Forecast("crossing", "crosses its limit", flight, max(low, float(piece.first)), high)


def _fieller(line: Line, limit: float) -> tuple[float, float]:
    """Flights between which the interval of the line holds the limit.

    Solutions of (level + slope d - limit)^2 = t^2 (c11 + 2 c12 d + c22 d^2) for the distance d from the centre.
    """
    t2, away = line.student**2, line.level - limit
    c11, c12, c22 = line.covariance[0, 0], line.covariance[0, 1], line.covariance[1, 1]
    a, b, c = line.slope**2 - t2 * c22, 2.0 * (line.slope * away - t2 * c12), away**2 - t2 * c11
    inside = b * b - 4.0 * a * c
    if a <= 0.0 or inside < 0.0:
        return -math.inf, math.inf
    ends = sorted((-b + side * math.sqrt(inside)) / (2.0 * a) for side in (-1.0, 1.0))
    return float(line.centre + ends[0]), float(line.centre + ends[1])


@dataclass(frozen=True, slots=True)
class Wear:
    """What a servo may come to, and what counts as a change."""

    limits: Mapping[str, float]
    telling: Mapping[str, float]
    """Smallest sudden change that is reported, of each quantity."""
    serial: str = ""
    swaps: tuple[tuple[date, str], ...] = ()
    """When servos were replaced, and the serial numbers of those that were taken out."""


@dataclass(frozen=True, slots=True, eq=False)
class QuantityTrend:
    """One number of one servo."""

    name: str
    flights: Piece
    """All flights that tell it."""
    pieces: tuple[Piece, ...]
    """The same, cut where it changed."""
    now: Estimate
    """As of the last flight."""
    slope: Estimate | None
    """Change per flight since the last break; None of fewer than three flights."""
    limit: float | None
    forecast: Forecast


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceTrend:
    """One surface over all flights."""

    surface: str
    serials: tuple[tuple[int, str], ...]
    """Number of the first flight of each servo, and its serial number; empty where it is not known."""
    quantities: Mapping[str, QuantityTrend]
    events: tuple[Event, ...]
    missing: Mapping[str, str]
    """Why some quantities are not followed."""
    notes: tuple[str, ...]

    @property
    def alarms(self) -> tuple[QuantityTrend, ...]:
        """What is beyond its limit, or will be."""
        return tuple(one for one in self.quantities.values() if one.forecast.is_alarm)


def follow(
    surface: str, flights: Mapping[int, ServoEstimate], days: Mapping[int, date | None], wear: Wear
) -> SurfaceTrend:
    """Follow one surface over flights, by their numbers, that were flown on some days."""
    known, notes = _known_swaps(days, wear)
    series = {name: one for name in QUANTITIES if (one := _series(name, flights)) is not None}
    bounds = [number for number, _ in known]
    events: list[Event] = []
    for from_, to in _spans(bounds):
        parts = {name: part for name, one in series.items() if (part := one.between(from_, to))}
        events += find_events(parts, wear.telling)
    bounds = sorted({*bounds, *(event.first for event in events if event.kind == "swap")})
    quantities = {name: _quantity(name, one, bounds, wear.limits.get(name)) for name, one in series.items()}
    last = flights[max(flights)]
    told_by = {QUANTITIES[name].of for name in (*series, *last.missing)}
    missing = {
        name: last.missing.get(name, "not in these flights")
        for name, what in QUANTITIES.items()
        if name not in series and what.of in told_by
    }
    serials = _serials(bounds, dict(known), wear)
    return SurfaceTrend(surface, serials, quantities, tuple(events), missing, notes)


def _known_swaps(days: Mapping[int, date | None], wear: Wear) -> tuple[tuple[tuple[int, str], ...], tuple[str, ...]]:
    """First flight of each new servo and its serial number, by the dates in the aircraft file."""
    if not wear.swaps:
        return (), ()
    if None in days.values():
        return (), ("the swaps of the aircraft file are not used: not every log holds the date of its flight",)
    after = [*(removed for _, removed in wear.swaps[1:]), wear.serial]
    found = []
    for (day, _), serial in zip(wear.swaps, after, strict=True):
        later = [number for number, flown in days.items() if flown and flown >= day]
        if later:
            found.append((later[0], serial))
    return tuple(found), ()


def _serials(bounds: Sequence[int], known: Mapping[int, str], wear: Wear) -> tuple[tuple[int, str], ...]:
    """First flight and serial number of each servo; of a swap that only the data show, the number before is unknown."""
    if not bounds:
        return ((1, wear.serial),)
    first = wear.swaps[0][1] if known else ""
    between = [(number, known.get(number, "")) for number in bounds[:-1]]
    return ((1, first), *between, (bounds[-1], wear.serial))


def _spans(bounds: Sequence[int]) -> list[tuple[float, float]]:
    return list(itertools.pairwise([-np.inf, *bounds, np.inf]))


def _series(name: str, flights: Mapping[int, ServoEstimate]) -> Piece | None:
    known = [(number, flight.values[name]) for number, flight in flights.items() if name in flight.values]
    rows = [(number, each.value, each.deviation) for number, each in known if np.all(np.isfinite(each))]
    return Piece(*np.array(rows, dtype=float).T) if rows else None


def _quantity(name: str, whole: Piece, bounds: Sequence[int], limit: float | None) -> QuantityTrend:
    parts = [part for from_, to in _spans(bounds) if (part := whole.between(from_, to))]
    cut = tuple(piece for part in parts for piece in pieces(part))
    last = cut[-1]
    has_line = last.number.size >= FEWEST_FLIGHTS
    now = last.line.at(last.last) if has_line else _last_estimate(last)
    slope = last.line.slope_estimate if has_line else None
    return QuantityTrend(name, whole, cut, now, slope, limit, _forecast(name, last, now.value, limit))


def _last_estimate(piece: Piece) -> Estimate:
    return Estimate.of(float(piece.value[-1]), float(piece.deviation[-1]))


def _forecast(name: str, last: Piece, now: float, limit: float | None) -> Forecast:
    if limit is None:
        return Forecast("none", "no limit is set for it")
    worse = QUANTITIES[name].worse
    lately = _last_estimate(last)
    if worse == "away":
        rising = now > 0.0 if abs(now) >= limit or last.number.size < FEWEST_FOR_LINE else last.line.slope > 0.0
        found = forecast(last, limit if rising else -limit, above=rising)
        beyond = lately.low > limit or lately.high < -limit
    else:
        found = forecast(last, limit, above=worse == "up")
        beyond = lately.low > limit if worse == "up" else lately.high < limit
    if beyond and found.kind != "reached" and QUANTITIES[name].of != "motion":  # an axis has alarms of its own
        # One flight moves no line, and a servo that failed in it is no less at fault.
        return Forecast("reached", "was beyond its limit in the last flight: audit that flight")
    return found
