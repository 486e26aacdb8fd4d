"""Flights that are not as those of the calibration: none becomes a fault of a surface, and each is said in words."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from logparsers.records import Channel, FlightLog
from servofd.aircraft.axes import MotionModel
from servofd.axes.autopilot import motion_of_autopilot
from servofd.axes.calibrate import calibrate_motion
from servofd.axes.judge import judge_motion
from servofd.axes.motion import Motion
from servofd.core.errors import CalibrationError, NoMeasurement
from servofd.detection.axis_verdict import AxisAudit
from tests.axes.flights import flown

OF_THE_DAY = "2026-05-09"
MIXER = {"SERVO1_FUNCTION": 4.0, "SERVO3_FUNCTION": 70.0, "SERVO5_FUNCTION": 33.0}


@functools.cache
def calibrated() -> MotionModel:
    return calibrate_motion([flown(seed, f"2026-05-0{1 + seed % 3}") for seed in range(6)])


def roll_of(flight: Motion) -> AxisAudit:
    return next(audit for audit in judge_motion(calibrated(), flight) if audit.axis == "roll")


def test_an_engine_that_never_ran_is_no_axis() -> None:
    assert set(calibrated().axes) == {"roll"}


def test_gusts_twice_as_strong_are_no_fault() -> None:
    assert [event for event in roll_of(flown(60, OF_THE_DAY, gusts=12.0)).events if event.is_own] == []


def test_more_effect_after_a_payload_was_dropped_is_no_loss() -> None:
    audit = roll_of(flown(61, OF_THE_DAY, aileron_share=1.25, from_s=60.0))
    assert all(event.lost_share.low <= 0.0 for event in audit.events)
    assert audit.status != "fault"


def test_a_trim_that_changes_is_an_offset_and_no_loss() -> None:
    audit = roll_of(flown(62, OF_THE_DAY, trim_step_us=60.0, from_s=60.0))
    (event, *_) = audit.events
    assert event.start_s == pytest.approx(60.0, abs=2.0)
    assert event.lost_share.low < 0.0 < event.lost_share.high
    assert event.offset_us.low < 60.0 < event.offset_us.high
    assert "acts as if it stood" in audit.reason


def test_another_aircraft_is_said_to_differ_from_the_beginning() -> None:
    audit = roll_of(flown(63, OF_THE_DAY, aileron_share=0.5, from_s=0.0))
    assert audit.events[0].from_start
    assert audit.status == "suspect"
    assert "from the first judged second on" in audit.reason
    assert not any(event.is_own for event in audit.events)


def test_nothing_is_judged_in_a_stall() -> None:
    flight = flown(64, OF_THE_DAY)
    audit = roll_of(replace(flight, accelerations_m_s2=flight.accelerations_m_s2 * np.array([[1.0], [1.0], [3.0]])))
    assert audit.judged_share < 0.1
    assert (audit.status, audit.events) == ("unknown", ())
    assert "nearer to the stall" in audit.reason


def test_a_flight_slower_than_any_of_the_calibration_is_not_judged() -> None:
    flight = flown(66, OF_THE_DAY)
    audit = roll_of(replace(flight, airspeed_m_s=0.7 * flight.airspeed_m_s))
    assert audit.status == "unknown"
    assert "outside the calibrated airspeed" in audit.reason


def log_of(flight: Motion, *, lift_us: float = 1000.0, airspeed: bool = True) -> FlightLog:
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
    if airspeed:
        series["CTUN.As"] = flight.airspeed_m_s
    channels = {name: Channel(name, flight.time_s, values, "", name) for name, values in series.items()}
    return FlightLog(Path("flight.bin"), "dataflash", channels, parameters=MIXER)


def test_commands_three_times_a_second_are_not_judged_by_a_faster_calibration() -> None:
    log = log_of(flown(65, OF_THE_DAY))
    slow = {name: Channel(name, c.time_s[::8], c.values[::8], "", name) for name, c in log.channels.items()}
    seldom = replace(log, channels=slow)
    assert motion_of_autopilot(seldom).rate_hz == pytest.approx(3.125)
    with pytest.raises(NoMeasurement, match=r"come at 3\.12 Hz, those of the calibration at 25 Hz"):
        motion_of_autopilot(seldom, calibrated().rate_hz)


def test_while_motors_lift_nothing_is_judged() -> None:
    flight = flown(67, OF_THE_DAY, duration_s=30.0)
    assert motion_of_autopilot(log_of(flight)).present.any()
    assert not motion_of_autopilot(log_of(flight, lift_us=1600.0)).present.any()


def test_a_log_without_airspeed_says_what_to_log() -> None:
    with pytest.raises(NoMeasurement, match="no airspeed that measures anything"):
        motion_of_autopilot(log_of(flown(68, OF_THE_DAY, duration_s=30.0), airspeed=False))


def test_one_short_flight_and_no_flight_are_refused() -> None:
    for flights in ([], [flown(1, duration_s=30.0)]):
        with pytest.raises(CalibrationError):
            calibrate_motion(flights)
