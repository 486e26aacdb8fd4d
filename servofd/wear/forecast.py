"""When a limit will be crossed, if the flights carry it; if not, why not."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from servofd.wear.series import CHANCE

if TYPE_CHECKING:
    from servofd.wear.series import Line, Piece

FEWEST_FLIGHTS = 8
"""Six degrees of freedom: a 95 % interval of 2.4 deviations."""
TOO_FEW = "too few flights for a trend"
"""Reason of a forecast that only more flights can bring."""
HORIZON = 4.0
"""Nobody knows what happens after four times as many flights as were seen."""


@dataclass(frozen=True, slots=True)
class Forecast:
    """When, or why not.

    Parameters
    ----------
    kind : {"reached", "crossing", "none"}
        The limit is exceeded; it will be; nothing can be said, or nothing happens.
    reason : str
        In words.
    flight, low, high : float, optional
        Number of the flight at which the line crosses the limit, with its 95 % interval.
    """

    kind: Literal["reached", "crossing", "none"]
    reason: str
    flight: float | None = None
    low: float | None = None
    high: float | None = None

    @property
    def is_alarm(self) -> bool:
        """Whether somebody should do something."""
        return self.kind != "none"


def forecast(piece: Piece, limit: float, *, above: bool) -> Forecast:
    """Extrapolate the line of the last flights to a limit.

    The interval is Fieller's: all flights at which the limit lies within the 95 % interval of the line.

    Returns
    -------
    Forecast
        ``none`` with a reason if there are fewer than eight flights, no slope that chance does not explain, an
        interval without end, or a crossing beyond four times the flights that were seen.

    Examples
    --------
    >>> import numpy as np
    >>> from servofd.wear.series import Piece
    >>> number = np.arange(1.0, 26.0)
    >>> value = 0.02 * number + 0.004 * np.random.default_rng(0).standard_normal(25)
    >>> found = forecast(Piece(number, value, np.full(25, 0.004)), 2.0, above=True)
    >>> found.kind, round(found.flight), found.low < 100.0 < found.high
    ('crossing', 100, True)
    """
    sign = 1.0 if above else -1.0
    count = piece.number.size
    if count <= 2:
        return Forecast("none", TOO_FEW)
    line = piece.line
    now = line.at(piece.last)
    if sign * (now.value - limit) >= 0.0 and (
        count < FEWEST_FLIGHTS or min(sign * now.low, sign * now.high) >= sign * limit
    ):
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
