"""One servo over its flights: what it is like now, how it changes, when it will be too much."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from servofd.wear.events import find_events
from servofd.wear.forecast import Forecast, forecast
from servofd.wear.records import QUANTITIES
from servofd.wear.series import Piece, pieces

if TYPE_CHECKING:
    from collections.abc import Sequence
    from datetime import date

    from servofd.estimate.statistics import Estimate
    from servofd.wear.events import Event
    from servofd.wear.records import FlightEstimate

Place = Literal["servo", "linkage"]

FEWEST_FOR_LINE = 3
_MOST_EVIDENCE = 20.0
"""That one flight may add: no single one decides."""


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
    place: Place
    """Where the zone of rest is: a dead band of the servo, or backlash of the linkage; the flights together tell."""
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


def follow(surface: str, flights: Sequence[tuple[int, FlightEstimate]], wear: Wear) -> SurfaceTrend:
    """Follow one surface.

    Parameters
    ----------
    flights : sequence of (number, FlightEstimate)
        In the order in which they were flown, at least one; a number may be missing where a flight tells nothing.

    Returns
    -------
    SurfaceTrend
        Swaps, known ones and those that the data show, cut all quantities; other changes the one they concern.
    """
    known, notes = _known_swaps(flights, wear)
    in_linkage = sum(np.clip(flight.evidence, -_MOST_EVIDENCE, _MOST_EVIDENCE) for _, flight in flights) > 0.0
    if in_linkage:
        flights = [(number, replace(one, values={**one.values, **one.linkage})) for number, one in flights]
    series = {name: one for name in QUANTITIES if (one := _series(name, flights)) is not None}
    bounds = [number for number, _ in known]
    events: list[Event] = []
    for from_, to in _spans(bounds):
        parts = {name: _within(one, from_, to) for name, one in series.items()}
        events += find_events({name: part for name, part in parts.items() if part is not None}, wear.telling)
    bounds = sorted({*bounds, *(event.first for event in events if event.kind == "swap")})
    quantities = {name: _quantity(name, one, bounds, wear.limits.get(name)) for name, one in series.items()}
    last = flights[-1][1]
    of_axis = any(QUANTITIES[name].of_axis for name in (*series, *last.missing))
    missing = {
        name: last.missing.get(name, "not in these flights")
        for name, what in QUANTITIES.items()
        if name not in series and what.of_axis == of_axis
    }
    serials = _serials(bounds, dict(known), wear)
    place: Place = "linkage" if in_linkage else "servo"
    return SurfaceTrend(surface, place, serials, quantities, tuple(events), missing, notes)


def _known_swaps(
    flights: Sequence[tuple[int, FlightEstimate]], wear: Wear
) -> tuple[tuple[tuple[int, str], ...], tuple[str, ...]]:
    """First flight of each new servo and its serial number, by the dates in the aircraft file."""
    if not wear.swaps:
        return (), ()
    if any(flight.start_utc is None for _, flight in flights):
        return (), ("the swaps of the aircraft file are not used: not every log tells when it was flown",)
    after = [*(removed for _, removed in wear.swaps[1:]), wear.serial]
    found = []
    for (day, _), serial in zip(wear.swaps, after, strict=True):
        later = [number for number, flight in flights if flight.start_utc and flight.start_utc.date() >= day]
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


def _series(name: str, flights: Sequence[tuple[int, FlightEstimate]]) -> Piece | None:
    known = [(number, flight.values[name]) for number, flight in flights if name in flight.values]
    known = [(number, estimate) for number, estimate in known if np.all(np.isfinite(estimate))]
    if not known:
        return None
    numbers, estimates = zip(*known, strict=True)
    values, deviations = [e.value for e in estimates], [e.deviation for e in estimates]
    return Piece(np.array(numbers, dtype=float), np.array(values), np.array(deviations))


def _within(whole: Piece, from_: float, to: float) -> Piece | None:
    inside = (whole.number >= from_) & (whole.number < to)
    return Piece(whole.number[inside], whole.value[inside], whole.deviation[inside]) if inside.any() else None


def _quantity(name: str, whole: Piece, bounds: Sequence[int], limit: float | None) -> QuantityTrend:
    parts = [part for from_, to in _spans(bounds) if (part := _within(whole, from_, to))]
    cut = tuple(piece for part in parts for piece in pieces(part.number, part.value, part.deviation))
    last = cut[-1]
    has_line = last.number.size >= FEWEST_FOR_LINE
    now = last.line.at(last.last) if has_line else _last_estimate(last)
    slope = last.line.slope_estimate if has_line else None
    return QuantityTrend(name, whole, cut, now, slope, limit, _forecast(name, last, now.value, limit))


def _last_estimate(piece: Piece) -> Estimate:
    from servofd.estimate.statistics import Estimate

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
    if beyond and found.kind != "reached" and not QUANTITIES[name].of_axis:  # an axis has alarms of its own
        # One flight moves no line, and a servo that failed in it is no less at fault.
        return Forecast("reached", "was beyond its limit in the last flight: audit that flight")
    return found
