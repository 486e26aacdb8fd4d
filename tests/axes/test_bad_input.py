"""Flights that are not as those of the calibration: none becomes a fault of a surface, and each is said in words."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from logparsers.records import Channel, FlightLog
from servofd.aircraft.axes import MotionModel
from servofd.axes.calibrate import calibrate_motion
from servofd.axes.judge import judge_motion
from servofd.axes.motion import Motion, motion_of_autopilot
from servofd.axes.verdict import AxisAudit
from servofd.core.errors import CalibrationError, NoMeasurement
from servofd.core.types import FloatArray
from tests.axes.flights import calibrated, flown

OF_THE_DAY = "2026-05-09"
MIXER = {"SERVO1_FUNCTION": 4.0, "SERVO3_FUNCTION": 70.0, "SERVO5_FUNCTION": 33.0}


def roll_of(flight: Motion) -> AxisAudit:
    return next(audit for audit in judge_motion(calibrated(), flight) if audit.axis == "roll")


@pytest.mark.slow
def test_an_engine_that_never_ran_is_no_axis() -> None:
    assert set(calibrated().axes) == {"roll"}


@pytest.mark.slow
def test_gusts_twice_as_strong_are_no_fault() -> None:
    assert [event for event in roll_of(flown(60, OF_THE_DAY, gusts=12.0)).events if event.is_own] == []


@pytest.mark.slow
def test_more_effect_after_a_payload_was_dropped_is_no_loss() -> None:
    audit = roll_of(flown(61, OF_THE_DAY, aileron_share=1.25, from_s=60.0))
    assert all(event.lost_share.low <= 0.0 for event in audit.events)
    assert audit.status != "fault"


@pytest.mark.slow
def test_a_trim_that_changes_is_an_offset_and_no_loss() -> None:
    audit = roll_of(flown(62, OF_THE_DAY, trim_step_us=60.0, from_s=60.0))
    (event, *_) = audit.events
    assert event.start_s == pytest.approx(60.0, abs=2.0)
    assert event.lost_share.low < 0.0 < event.lost_share.high
    assert event.offset_us.low < 60.0 < event.offset_us.high
    assert "acted as if" in audit.reason


@pytest.mark.slow
def test_another_aircraft_is_said_to_differ_from_the_beginning() -> None:
    audit = roll_of(flown(63, OF_THE_DAY, aileron_share=0.5, from_s=0.0))
    assert audit.events[0].from_start
    assert audit.status == "suspect"
    assert "from the first judged second on" in audit.reason
    assert not any(event.is_own for event in audit.events)


@pytest.mark.slow
def test_a_failure_of_another_aircraft_is_no_more_than_suspect() -> None:
    flight = flown(80, OF_THE_DAY, aileron_share=0.0, from_s=60.0)
    assert roll_of(flight).status == "fault"
    audit = roll_of(replace(flight, commands_us={"roll": 1.6 * flight.commands_us["roll"]}))  # shorter horns
    assert audit.events[0].from_start
    assert audit.since_s == pytest.approx(60.0, abs=3.0)
    assert audit.status == "suspect"


@pytest.mark.slow
def test_nothing_is_judged_in_a_stall() -> None:
    flight = flown(64, OF_THE_DAY)
    audit = roll_of(replace(flight, accelerations_m_s2=flight.accelerations_m_s2 * np.array([[1.0], [1.0], [3.0]])))
    assert audit.judged_share < 0.1
    assert (audit.status, audit.events) == ("unknown", ())
    assert "nearer to the stall" in audit.reason


@pytest.mark.slow
def test_a_flight_slower_than_any_of_the_calibration_is_not_judged() -> None:
    flight = flown(66, OF_THE_DAY)
    audit = roll_of(replace(flight, airspeed_m_s=0.7 * flight.airspeed_m_s))
    assert audit.status == "unknown"
    assert "outside the calibrated airspeed" in audit.reason


def log_of(
    flight: Motion,
    *,
    lift_us: FloatArray | float = 1000.0,
    speed: str = "CTUN.As",
    mixer: Mapping[str, float] = MIXER,
    command_every: int = 1,
) -> FlightLog:
    """The same flight as an autopilot logs it."""
    p, q, r = np.radians(flight.rates_deg_s)
    ones = np.ones(flight.time_s.size)
    series = {
        "RCOU.C1": 1500.0 + flight.commands_us["roll"],
        "RCOU.C3": 1500.0 * ones,
        "RCOU.C5": lift_us * ones,
        **dict(zip((f"IMU[0].Gyr{axis}" for axis in "XYZ"), (p, q, r), strict=True)),
        **dict(zip((f"IMU[0].Acc{axis}" for axis in "XYZ"), flight.accelerations_m_s2, strict=True)),
        "ATT.Roll": flight.roll_deg,
        "ATT.Pitch": flight.pitch_deg,
    }
    if speed:
        series[speed] = flight.airspeed_m_s
    every = {name: command_every if name.startswith("RCOU") else 1 for name in series}
    channels = {
        name: Channel(name, flight.time_s[:: every[name]], values[:: every[name]], "", name)
        for name, values in series.items()
    }
    return FlightLog(Path(f"{flight.day}.bin"), "dataflash", channels, parameters=dict(mixer))


def calibrated_on(**kind: Any) -> MotionModel:
    """From logs of another kind."""
    flights = [flown(seed, f"2026-05-0{1 + seed % 3}") for seed in range(6)]
    return calibrate_motion([motion_of_autopilot(log_of(flight, **kind)) for flight in flights])


def rolls_of(model: MotionModel, flight: Motion, **kind: Any) -> AxisAudit:
    motion = motion_of_autopilot(log_of(flight, **kind), model.rate_hz)
    return next(audit for audit in judge_motion(model, motion) if audit.axis == "roll")


@pytest.mark.slow
def test_commands_at_3_hz_are_judged_by_a_calibration_of_their_kind() -> None:
    model = calibrated_on(command_every=8)
    assert (model.rate_hz, model.days) == (10.0, 3)
    assert rolls_of(model, flown(70, OF_THE_DAY), command_every=8).events == ()
    lost = rolls_of(model, flown(71, OF_THE_DAY, aileron_share=0.0, from_s=60.0), command_every=8)
    assert lost.since_s == pytest.approx(60.0, abs=3.0)
    assert lost.lost_share is not None
    assert lost.lost_share.low < 1.0 < lost.lost_share.high


@pytest.mark.slow
def test_commands_at_3_hz_are_not_judged_by_a_faster_calibration() -> None:
    with pytest.raises(NoMeasurement, match=r"come at 3\.12 Hz, those of the calibration at 25 Hz"):
        rolls_of(calibrated(), flown(65, OF_THE_DAY), command_every=8)


@pytest.mark.slow
def test_a_glider_has_no_engine_and_is_judged() -> None:
    glider = {"SERVO1_FUNCTION": 4.0}
    model = calibrated_on(mixer=glider)
    assert set(model.axes) == {"roll"}
    assert rolls_of(model, flown(72, OF_THE_DAY), mixer=glider).status == "healthy"
    lost = rolls_of(model, flown(73, OF_THE_DAY, aileron_share=0.5, from_s=60.0), mixer=glider)
    assert lost.since_s == pytest.approx(60.0, abs=2.0)


@pytest.mark.slow
def test_vtol_transitions_are_left_out_and_it_is_said() -> None:
    flight = flown(67, OF_THE_DAY)
    hovers = (flight.time_s < 20.0) | (flight.time_s > 100.0)
    lift_us = np.where(hovers, 1600.0, 1000.0)
    hangs = hovers & (np.random.default_rng(1).random(hovers.size) < 0.5)  # wild motion that no aileron asked for
    wild = replace(flight, rates_deg_s=flight.rates_deg_s + 200.0 * hangs)
    audit = rolls_of(calibrated(), wild, lift_us=lift_us)
    assert audit.events == ()
    assert "left out: 33% of the log, while motors lifted it" in audit.reason
    assert not audit.inputs.usable[(audit.time_s < 20.0) | (audit.time_s > 100.1)].any()
    lost = rolls_of(calibrated(), flown(79, OF_THE_DAY, aileron_share=0.0, from_s=60.0), lift_us=lift_us)
    assert lost.since_s == pytest.approx(60.0, abs=2.0)
    hovering = rolls_of(calibrated(), flight, lift_us=1600.0)
    assert hovering.reason == "the aircraft never flew; left out: 100% of the log, while motors lifted it"


def test_no_airspeed_at_all_says_what_to_log() -> None:
    with pytest.raises(NoMeasurement, match="no airspeed that measures anything"):
        motion_of_autopilot(log_of(flown(68, OF_THE_DAY, duration_s=30.0), speed=""))


def test_a_pitot_that_reads_0_is_no_airspeed() -> None:
    flight = flown(69, OF_THE_DAY, duration_s=30.0)
    blocked = log_of(replace(flight, airspeed_m_s=np.zeros_like(flight.airspeed_m_s)), speed="ARSP.Airspeed")
    with pytest.raises(NoMeasurement, match="no airspeed that measures anything"):
        motion_of_autopilot(blocked)
    estimated = dict(blocked.channels) | {"CTUN.As": log_of(flight)["CTUN.As"]}
    assert motion_of_autopilot(replace(blocked, channels=estimated)).airspeed_source == "the autopilot's estimate"


@pytest.mark.slow
def test_an_aircraft_with_other_surfaces_is_one_line() -> None:
    without = replace(flown(50, OF_THE_DAY), commands_us={})
    with pytest.raises(NoMeasurement, match="no output commands roll"):
        judge_motion(calibrated(), without)
    with pytest.raises(CalibrationError, match="flights of one aircraft"):
        calibrate_motion([flown(50, OF_THE_DAY), without])


def test_one_short_flight_and_no_flight_are_refused() -> None:
    for flights in ([], [flown(1, duration_s=30.0)]):
        with pytest.raises(CalibrationError):
            calibrate_motion(flights)
