"""Calibration on one flight: hidden servos found again, and fresh flights of the same servo without false alarms.

The servos are simulated by `benchmarks/fleet.py`, which has nothing in common with servofd's kernel.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fleet import FleetServo, deflection, flight
from servofd.aircraft import Aircraft, plain_aircraft
from servofd.calibrating.calibrate import calibrate_aircraft
from servofd.calibrating.flights import Flight
from servofd.calibrating.result import Calibration
from servofd.detection.judge import Judgement, judge
from servofd.detection.residual import ResidualGenerator
from servofd.errors import CalibrationError
from servofd.segment import Segment
from servofd.simulation.commands import COMMANDS

STYLES = ("lively", "calm", "hand_flown", "cruise")


def flown(servo: FleetServo, seed: int, style: str, duration_s: float = 120.0) -> Segment:
    """One more flight of the same servo, with jitter, lost rows, noise and a coarse converter."""
    rng = np.random.default_rng([seed, 77])
    grid_s = np.arange(round(duration_s * 100.0)) / 100.0
    command_deg = COMMANDS[style](grid_s, rng)
    time_s = np.maximum(grid_s + rng.uniform(-servo.jitter_s, servo.jitter_s, grid_s.size), 0.0)
    kept = rng.random(grid_s.size) >= servo.loss
    position_deg = deflection(servo, time_s, command_deg) + servo.bias_deg
    position_deg = position_deg + servo.noise_deg * rng.standard_normal(grid_s.size)
    if servo.step_deg:
        position_deg = servo.step_deg * np.round(position_deg / servo.step_deg)
    return Segment("x", time_s[kept], command_deg[kept], time_s[kept], position_deg[kept])


def calibrated(*segments: Segment) -> Calibration:
    return calibrate_aircraft(plain_aircraft(["x"]), {"x": [Flight(f"{k}.csv", s) for k, s in enumerate(segments)]})


def judged(aircraft: Aircraft, segment: Segment) -> Judgement:
    surface = aircraft.surfaces["x"]
    assert surface.measured is not None
    segment = replace(segment, measured_deg=surface.measured.to_deg(segment.measured_deg))
    generator = ResidualGenerator.fitting(aircraft.model("x"), segment, surface.filter_pole_rad_s)
    return judge(generator, segment, generator.run(segment), surface)


@pytest.mark.slow
def test_hidden_numbers_are_found_within_their_intervals() -> None:
    servo = FleetServo(gain=0.97, delay_s=0.007, bandwidth_scale=1.1, bias_deg=-0.25, noise_deg=0.1, jitter_s=0.002)
    fit = calibrated(flown(servo, 0, "lively")).surfaces[0].fit
    bandwidth = fit.numbers["bandwidth_hz"].value / (
        plain_aircraft(["x"]).servo("x").transfer.bandwidth_rad_s / 2 / np.pi
    )
    assert bandwidth == pytest.approx(1.1, rel=0.02)
    assert fit.numbers["delay_s"].value == pytest.approx(0.007, abs=5e-4)
    assert fit.gain.value == pytest.approx(0.97, abs=0.002)
    assert fit.offset_deg.value == pytest.approx(-0.25, abs=0.02)
    assert fit.noise_deg == pytest.approx(0.1, rel=0.1)
    assert fit.servo.rate_limit_deg_s == 370.0
    assert "rate_limit_deg_s" in fit.kept


@pytest.mark.slow
def test_a_quiet_flight_keeps_what_it_does_not_show() -> None:
    servo = FleetServo(noise_deg=0.15)
    fit = calibrated(flown(servo, 0, "calm")).surfaces[0].fit
    assert "delay_s" in fit.kept
    assert fit.servo.delay_s == 0.004


@pytest.mark.slow
def test_smaller_faults_are_found_than_before() -> None:
    servo = flight(101, "lively").servo
    found = calibrated(flown(servo, 0, "lively"))
    (one,) = found.surfaces
    assert one.levels.residual_std_deg < 0.6 * one.before.residual_std_deg
    assert one.levels.interval_deg < 0.6 * one.before.threshold_deg
    healthy = flown(servo, 1, "lively", 60.0)
    off = np.where(healthy.measured_s > 30.0, 0.8, 0.0)
    (fault,) = judged(found.aircraft, replace(healthy, measured_deg=healthy.measured_deg + off)).faults
    assert fault.kind == "bias"
    assert fault.alarm_s == pytest.approx(30.0, abs=1.0)


@pytest.mark.slow
def test_a_flight_that_turns_bad_is_refused() -> None:
    healthy = flown(FleetServo(noise_deg=0.1), 0, "lively")
    weak = np.where(healthy.measured_s > 80.0, 0.6, 1.0)
    with pytest.raises(CalibrationError, match="not a good flight"):
        calibrated(replace(healthy, measured_deg=weak * healthy.measured_deg))
    wobble = np.where(healthy.measured_s > 60.0, 2.0 * np.sin(20.0 * healthy.measured_s), 0.0)
    with pytest.raises(CalibrationError, match="oscillates"):
        calibrated(replace(healthy, measured_deg=healthy.measured_deg + wobble))


@pytest.mark.slow
@pytest.mark.parametrize("style", ["lively", "calm", "hand_flown"])
@pytest.mark.parametrize("number", range(2))
def test_no_false_alarm_in_ten_fresh_flights(style: str, number: int) -> None:
    servo = flight(100 + number, style).servo
    aircraft = calibrated(flown(servo, 0, style)).aircraft
    fresh = [judged(aircraft, flown(servo, seed, other)) for seed in (1, 2, 3) for other in STYLES]
    assert len(fresh) >= 10
    assert [fault for judgement in fresh for fault in judgement.faults] == []
