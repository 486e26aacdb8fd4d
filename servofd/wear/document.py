"""A trend as plain dictionaries and lists, schema servofd.trend/1."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from servofd.wear.follow import FEWEST_FOR_LINE
from servofd.wear.records import QUANTITIES

if TYPE_CHECKING:
    from servofd.estimate.statistics import Estimate
    from servofd.wear.follow import QuantityTrend, SurfaceTrend
    from servofd.wear.series import Piece
    from servofd.wear.trend import AircraftTrend


def trend_document(seen: AircraftTrend) -> dict[str, Any]:
    """Everything that a trend found.

    Examples
    --------
    >>> from servofd.wear.trend import trend_logs
    >>> seen = trend_logs(["sample_logs/faser_healthy_flight.mat"], "faser", surfaces=("rudder",), workers=0)
    >>> trend_document(seen)["surfaces"]["rudder"]["quantities"]["dead_band_deg"]["forecast"]["reason"]
    'too few flights for a trend'
    """
    return {
        "schema": "servofd.trend/1",
        "aircraft": seen.aircraft or None,
        "order": {"by": seen.order.by, "reason": seen.order.reason},
        "flights": [
            {
                "number": number,
                "path": log.path,
                "run": log.run or None,
                "start_utc": log.start_utc.isoformat() if log.start_utc else None,
                "alarms": {flight.surface: flight.alarm for flight in log.flights if flight.alarm},
            }
            for number, log in enumerate(seen.order.logs, start=1)
        ],
        "surfaces": {surface.surface: _surface(surface) for surface in seen.surfaces},
        "problems": list(seen.problems),
    }


def _surface(surface: SurfaceTrend) -> dict[str, Any]:
    return {
        "serials": [{"from_flight": number, "serial": serial or None} for number, serial in surface.serials],
        "rests_in": surface.place,
        "events": [
            {
                "kind": event.kind,
                "flight": event.first,
                "reason": event.reason,
                "changes": {name: {"before": j.before, "after": j.after} for name, j in event.jumps.items()},
            }
            for event in surface.events
        ],
        "quantities": {name: _quantity(one) for name, one in surface.quantities.items()},
        "missing": dict(surface.missing),
        "notes": list(surface.notes),
    }


def _quantity(one: QuantityTrend) -> dict[str, Any]:
    what, forecast = QUANTITIES[one.name], one.forecast
    return {
        "title": what.title,
        "shown": {"unit": what.unit, "scale": what.scale, "digits": what.digits},
        "worse": what.worse,
        "flights": [int(number) for number in one.flights.number],
        "values": one.flights.value.tolist(),
        "deviations": one.flights.deviation.tolist(),
        "pieces": [_piece(piece) for piece in one.pieces],
        "now": _estimate(one.now),
        "per_flight": None if one.slope is None else _estimate(one.slope),
        "limit": one.limit,
        "forecast": {
            "kind": forecast.kind,
            "reason": forecast.reason,
            "flight": forecast.flight,
            "low": forecast.low,
            "high": forecast.high,
        },
    }


def _piece(piece: Piece) -> dict[str, Any]:
    """First and last flight, and the line between them."""
    ends = {"first": piece.first, "last": piece.last}
    if piece.number.size < FEWEST_FOR_LINE:
        return ends
    return ends | {"begin": _estimate(piece.line.at(piece.first)), "end": _estimate(piece.line.at(piece.last))}


def _estimate(estimate: Estimate) -> dict[str, float]:
    return {"value": estimate.value, "low": estimate.low, "high": estimate.high}
