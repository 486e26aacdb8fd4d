"""Calibrated with airspeed and judged without, or the other way about: what is not known of the air is no fault."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from strangers import SURFACES, fly, stranger

from servofd.aircraft.priors import NAMES
from servofd.aircraft.schema import plain_aircraft
from servofd.aircraft.series import Series
from servofd.calibrating.calibrate import calibrate_aircraft
from servofd.detection.audit import audit_segment
from servofd.detection.flights import Flight
from servofd.detection.seen import Healthy, Pace
from servofd.servo.context import NO_CONTEXT, Context

if TYPE_CHECKING:
    from servofd.aircraft.schema import Aircraft
    from servofd.core.types import FloatArray
    from servofd.detection.verdict import SurfaceAudit

SEED = 323
"""Without airspeed, its aileron was said to move by only 89 % of its command in aerobatics, which are flown fast."""


def flown(number: int, style: str, duration_s: float) -> Series:
    flight = fly(stranger(SEED), number, style, duration_s=duration_s)
    place = (SEED // 2) % len(SURFACES)
    command_deg, position_deg = flight.command_deg[:, place], flight.position_deg[:, place]
    context = Context(flight.command_s, flight.airspeed_m_s, flight.command_s, flight.supply_v)
    return Series("x", flight.command_s, command_deg, flight.position_s, position_deg, context=context)


def calibrated(good: Series) -> Aircraft:
    return calibrate_aircraft(plain_aircraft(["x"]), {"x": [Flight("good.csv", good)]}).aircraft


def audited(aircraft: Aircraft, segment: Series) -> SurfaceAudit:
    measured = aircraft.surfaces["x"].measured
    assert measured is not None
    read = replace(segment, measured_deg=measured.to_deg(segment.measured_deg))
    return audit_segment(read, aircraft, duration_s=read.duration_s)


@pytest.fixture(scope="module")
def aircraft() -> Aircraft:
    return calibrated(flown(1, "mixed", 240.0))


@pytest.mark.slow
@pytest.mark.parametrize("number", [50, *(pytest.param(each, marks=pytest.mark.nightly) for each in (51, 52))])
def test_a_fast_flight_without_airspeed_is_no_loss_of_travel(aircraft: Aircraft, number: int) -> None:
    segment = flown(number, "aerobatics", 90.0)
    verdict = audited(aircraft, replace(segment, context=NO_CONTEXT))
    assert verdict.status == "healthy"
    assert "no airspeed in this log" in verdict.reason
    assert "no airspeed" not in audited(aircraft, segment).reason
    half = np.where(segment.measured_s < 45.0, 1.0, 0.6) * segment.measured_deg
    assert audited(aircraft, replace(segment, measured_deg=half, context=NO_CONTEXT)).status == "fault"


@pytest.mark.slow
def test_an_airspeed_that_no_good_flight_logged_acts_on_nothing() -> None:
    aircraft = calibrated(replace(flown(1, "mixed", 240.0), context=NO_CONTEXT))
    segment = flown(51, "aerobatics", 90.0)
    blind = audited(aircraft, replace(segment, context=NO_CONTEXT))
    no_air = replace(segment.context, airspeed_m_s=np.full(segment.command_s.size, 80.0))
    assert audited(aircraft, replace(segment, context=no_air)).statistics == blind.statistics
    assert blind.status != "fault"


@pytest.mark.slow
def test_only_what_the_air_does_becomes_less_certain(aircraft: Aircraft) -> None:
    known = aircraft.surfaces["x"].calibrated
    assert known is not None
    assert known.airspeed_m_s is not None
    assert known.airspeed_m_s > 10.0
    more = np.diag(known.without_airspeed().covariance - known.covariance)
    assert {name for name, added in zip(NAMES, more, strict=True) if added > 0.0} == {"hinge", "hinge_deg"}
    assert type(known).model_validate(known.without_airspeed().model_dump()).airspeed_m_s == known.airspeed_m_s


def levels_deg(aircraft: Aircraft, segment: Series, parts: list[tuple[float, Context]]) -> list[FloatArray]:
    """Thresholds of a stream, in parts that begin at some times with what is known of the air by then."""
    surface = aircraft.surfaces["x"]
    assert surface.calibrated is not None
    assert surface.measured is not None
    pace = Pace(segment.period_s, segment.command_s[:101], None)
    stream = Healthy(surface, aircraft.model("x")).stream(pace)
    ends_s = [begin_s for begin_s, _ in parts[1:]] + [np.inf]
    found = []
    for (begin_s, context), end_s in zip(parts, ends_s, strict=True):
        stream.surroundings(context)
        rows = (segment.command_s >= begin_s) & (segment.command_s < end_s)
        stream.commands(segment.command_s[rows], segment.command_deg[rows])
        rows = (segment.measured_s >= begin_s) & (segment.measured_s < end_s)
        seen_deg = surface.measured.to_deg(segment.measured_deg[rows])
        for at_s, value in zip(segment.measured_s[rows].tolist(), seen_deg.tolist(), strict=True):
            stream.position(at_s, value)
        piece = stream.evaluate()
        assert piece is not None
        assert not piece.alarm.any()
        found.append(piece.threshold.level_deg)
    return found


@pytest.mark.slow
def test_a_stream_that_learns_its_airspeed_later_is_as_sure_from_then_on(aircraft: Aircraft) -> None:
    servo = aircraft.surfaces["x"].calibrated
    assert servo is not None
    assert servo.airspeed_m_s is not None
    segment, usual = flown(50, "aerobatics", 30.0), np.array([servo.airspeed_m_s])
    told = Context(np.zeros(1), usual, NO_CONTEXT.voltage_s, NO_CONTEXT.voltage_v)
    known = levels_deg(aircraft, segment, [(0.0, told), (15.0, told)])
    learnt = levels_deg(aircraft, segment, [(0.0, NO_CONTEXT), (15.0, told)])
    assert (learnt[0] > 0.9999 * known[0]).all()  # a level is found by search, to four digits
    assert np.median(learnt[0] / known[0]) > 1.02
    assert learnt[1] == pytest.approx(known[1], rel=1e-9, nan_ok=True)
