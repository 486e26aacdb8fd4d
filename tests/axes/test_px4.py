"""PX4: surfaces by their control allocation, old topics, a VTOL while it flies forward, and what has no surfaces."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from servofd.axes.calibrate import calibrate_motion
from servofd.axes.read import motion_of
from servofd.core.errors import CalibrationError, NoMeasurement
from servofd.flight.change import judge_motion_alone
from servofd.flight.columns import flight_of
from servofd.flight.judge import judge_flight
from tests.axes.flights import flown
from tests.axes.ulogs import ALLOCATED, ELEVONS, Surfaces, read_as_ulog


@pytest.mark.slow
@pytest.mark.parametrize("surfaces", [ALLOCATED, ELEVONS, None], ids=["ailerons", "elevons", "actuator_controls"])
def test_ailerons_elevons_and_old_controls_ask_the_same_of_roll(surfaces: Surfaces | None, tmp_path: Path) -> None:
    flight = flown(4, duration_s=180.0, aileron_share=0.4, from_s=100.0, gusts=1.0)
    found = motion_of(read_as_ulog(tmp_path, flight, surfaces))
    seen_s = found.time_s - 0.5 / found.rate_hz  # the mean of the cell before
    asked = np.interp(seen_s, flight.time_s, flight.commands_us["roll"])
    assert np.corrcoef(asked, found.commands_us["roll"])[0, 1] > 0.95
    assert np.std(found.commands_us["roll"]) == pytest.approx(np.std(asked), rel=0.05)
    for ours, true in ((found.roll_deg, flight.roll_deg), (found.pitch_deg, flight.pitch_deg)):
        np.testing.assert_allclose(ours, np.interp(seen_s, flight.time_s, true), atol=0.5)
    roll = judge_motion_alone(found)["roll"]
    assert roll.status == "look"
    assert roll.since_s == pytest.approx(100.0, abs=5.0)


def test_outputs_have_the_names_ends_and_trims_of_the_allocation(tmp_path: Path) -> None:
    twice = {"roll": ((15, 1.0), (3, 1.0), (3, 1.0), (12, 1.0))}
    parameters = {"CA_SV_CS0_TRIM": 0.1, "PWM_AUX_FUNC2": 201, "PWM_AUX_MIN2": 1100, "PWM_AUX_MAX2": 1900}
    parameters |= {"CA_SV_CS3_TRQ_Y": -1.0}
    outputs = flight_of(read_as_ulog(tmp_path, flown(5), twice, parameters=parameters)).outputs
    assert [one.name for one in outputs] == ["aileron", "elevator_2", "elevator_3", "servo_4"]
    assert outputs[0].trim == pytest.approx(0.1)
    assert [one.span_us for one in outputs[:2]] == [800.0, 1000.0]
    assert [one.axes for one in outputs[1:]] == [{"pitch": 1.0}, {"pitch": 1.0}, {"yaw": -1.0}]


def test_a_flight_alone_is_asked_every_question_of_its_outputs(tmp_path: Path) -> None:
    alone = judge_flight(read_as_ulog(tmp_path, flown(5, duration_s=180.0), ALLOCATED))
    assert alone is not None
    said = {check.name: check for check in alone.checks}
    assert {said[name].status for name in ("saturation", "trim", "travel", "asymmetry", "limit_cycle")} == {"ok"}
    assert "aileron" in said["travel"].text


def test_a_vtol_is_judged_where_it_flies_forward(tmp_path: Path) -> None:
    flight = flown(5, duration_s=120.0)
    state = np.where(flight.time_s < 30.0, 3.0, 4.0)
    found = motion_of(read_as_ulog(tmp_path, flight, ALLOCATED, vtol_state=state, vehicle=22))
    assert found.lifted_share == pytest.approx(0.25, abs=0.01)
    assert not found.present[found.time_s < 29.8].any()


def test_a_vtol_that_only_hovers_is_no_flight_to_calibrate(tmp_path: Path) -> None:
    flight = flown(5, duration_s=60.0)
    hovers = motion_of(
        read_as_ulog(tmp_path, flight, ALLOCATED, vtol_state=np.full(flight.time_s.size, 3.0), vehicle=22)
    )
    with pytest.raises(CalibrationError, match="motors carry the aircraft"):
        calibrate_motion([hovers])
    alone = judge_flight(read_as_ulog(tmp_path, flight, ALLOCATED, vtol_state=np.full(flight.time_s.size, 3.0)))
    assert alone is not None
    assert "never flew" in alone.sentence


def test_damaged_samples_of_one_component_are_left_out_alone(tmp_path: Path) -> None:
    flight = flown(5, duration_s=60.0)
    log = read_as_ulog(tmp_path, flight, ALLOCATED)
    channels = dict(log.channels)
    wrong = channels["vehicle_attitude[0].q[1]"]
    values = np.where(np.arange(wrong.values.size) == 400, np.nan, wrong.values)
    channels[wrong.name] = replace(wrong, values=values)
    sound, found = motion_of(log), motion_of(replace(log, channels=channels))
    np.testing.assert_allclose(found.roll_deg, sound.roll_deg, atol=2.0)


@pytest.mark.parametrize(
    ("vehicle", "surfaces", "said"),
    [(2, ALLOCATED, "a quadrotor: no control surfaces"), (20, ELEVONS, "tailsitter"), (1, {}, "CA_SV_CS")],
)
def test_what_cannot_be_judged_says_why(vehicle: int, surfaces: Surfaces, said: str, tmp_path: Path) -> None:
    with pytest.raises(NoMeasurement, match=said):
        motion_of(read_as_ulog(tmp_path, flown(6, duration_s=20.0), surfaces, vehicle=vehicle))
