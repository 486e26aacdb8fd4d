"""Thresholds of a servo that was fitted to several runs."""

import numpy as np

from servofd.aircraft.series import Series
from servofd.calibrating.levels import levels_of
from servofd.servo.library import servo_named
from servofd.servo.servo_model import ServoModel


def test_many_short_runs_make_a_constant_threshold_surer_than_one() -> None:
    model = ServoModel.of(servo_named("hs225bb-eq31"))
    time_s = np.arange(200) / 100.0
    command_deg = 20.0 * np.sin(2.0 * np.pi * time_s)
    wrong_deg = model.simulate(time_s, command_deg, time_s) + 40.0 * np.sign(np.sin(9.0 * np.pi * time_s))
    run = Series("x", time_s, command_deg, time_s, wrong_deg)
    one, many = levels_of(model, [run]), levels_of(model, [run] * 16)
    assert one["threshold"] == many["threshold"] == "constant"
    assert many["threshold_deg"] < 0.6 * one["threshold_deg"]
