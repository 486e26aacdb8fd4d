"""Axes in flight: alarms of the monitor are those of the audit, on what every autopilot sends."""

from __future__ import annotations

import io
import math
from functools import cache

import numpy as np
import pytest
from rich.console import Console

from logparsers.codec import Codec
from servofd.aircraft.axes import MotionModel
from servofd.aircraft.schema import Aircraft
from servofd.axes.calibrate import calibrate_motion
from servofd.axes.motion import Motion
from servofd.detection.event import Event
from servofd.live.axes import AxisWatch
from servofd.live.session import Session
from servofd.live.vehicle import Vehicle
from servofd.live.view import View
from tests.axes.flights import flown

MIXER = {"SERVO1_FUNCTION": 4.0, "SERVO1_TRIM": 1500.0, "SERVO3_FUNCTION": 70.0, "SERVO3_MIN": 1000.0}


@cache
def model() -> MotionModel:
    days = ("2026-05-01", "2026-05-02", "2026-05-03")
    found = calibrate_motion([flown(seed, days[seed % 3]) for seed in range(3)])
    return found.model_copy(update={"parameters": MIXER})


def sent(watch: AxisWatch, flight: Motion) -> list[Event]:
    """What the watch tells of a flight whose autopilot sends its messages one after the other."""
    events: list[Event] = []
    p, q, r = np.radians(flight.rates_deg_s) * 1e3
    ax, ay, az = flight.accelerations_m_s2 / 9.80665e-3
    roll, pitch = np.radians(flight.roll_deg), np.radians(flight.pitch_deg)
    for k, time_s in enumerate(flight.time_s.tolist()):
        pulses = {"servo1_raw": round(1500.0 + flight.commands_us["roll"][k]), "servo3_raw": 1500}
        watch.receive("SERVO_OUTPUT_RAW", dict(pulses), time_s)
        watch.receive("RAW_IMU", dict(zip(("xgyro", "ygyro", "zgyro"), (p[k], q[k], r[k]), strict=True)), time_s)
        watch.receive("RAW_IMU", dict(zip(("xacc", "yacc", "zacc"), (ax[k], ay[k], az[k]), strict=True)), time_s)
        watch.receive("ATTITUDE", {"roll": roll[k], "pitch": pitch[k]}, time_s)
        watch.receive("VFR_HUD", {"airspeed": flight.airspeed_m_s[k]}, time_s)
        events += watch.due(time_s)
    return events


def view_of(watch: AxisWatch, events: list[Event]) -> View:
    """A screen that shows one vehicle, which has axes and no surface with feedback."""
    session = Session(Codec(0, 191), {})
    session.vehicles[1] = Vehicle(1, Aircraft(motion=watch.model))
    session.vehicles[1].axes = watch
    session.vehicles[1].alarms.publish(events)
    return View(session, "loopback")


def lines_of_screen(view: View) -> list[str]:
    console = Console(width=120, record=True, file=io.StringIO())
    console.print(view.drawn(0.0))
    return console.export_text().splitlines()


@pytest.mark.slow
def test_a_lost_aileron_is_told_in_flight_and_a_healthy_one_is_not() -> None:
    known = model()
    watch = AxisWatch(known)
    assert sent(watch, flown(50, "2026-05-09", duration_s=60.0)) == []
    assert watch.problem == ""
    watch = AxisWatch(known)
    events = sent(watch, flown(51, "2026-05-09", duration_s=60.0, aileron_share=0.2, from_s=30.0))
    assert [event.event for event in events[:2]] == ["alarm", "named"]
    assert {event.surface for event in events} == {"roll"}
    assert 30.0 < events[0].time_s < 45.0
    assert events[1].kind == "loss_of_effectiveness"
    assert watch.has_suspect
    view = view_of(watch, events)
    lines = view.plain(0.0)
    assert any("roll (" in line and "ALARM" in line and "of its threshold" in line for line in lines)
    assert any("ALARM" in line for line in lines_of_screen(view))


@pytest.mark.slow
def test_a_link_without_motion_says_what_is_missing() -> None:
    watch = AxisWatch(model())
    assert "no message of its motion" in watch.problem
    watch.receive("SERVO_OUTPUT_RAW", {"servo1_raw": 1500}, 1.0)
    assert watch.due(2.0) == []
    assert "no body rates" in watch.problem or "no commands" in watch.problem
    assert math.isfinite(watch._judged_s)
