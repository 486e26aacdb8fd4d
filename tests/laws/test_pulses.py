"""Pulses: the firmware's formula, statement by statement, and its inverse."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from servofd.aircraft.schema import Aircraft, plain_aircraft
from servofd.core.errors import ConfigError
from servofd.simulation.pulses import Output, outputs_of

AILERON, FLAP = 4, 2

outputs = st.builds(
    Output,
    surface=st.just("any"),
    number=st.just(1),
    function=st.sampled_from([AILERON, FLAP]),
    min_us=st.integers(800, 1300),
    trim_us=st.integers(1350, 1650),
    max_us=st.integers(1700, 2200),
    travel_deg=st.floats(5.0, 90.0),
    reversed=st.booleans(),
)


def firmware(output: Output, fraction: np.float32) -> int:
    """`SRV_Channel::pwm_from_angle` and `pwm_from_range`, for -1 to 1 of the travel."""
    low, trim, high = output.min_us, output.trim_us, output.max_us
    x = -fraction if output.reversed else fraction
    if output.function == FLAP:
        return low + int((x + np.float32(1.0)) * np.float32(0.5 * (high - low)))
    if x > 0.0:
        return trim + int(x * np.float32(high - trim))
    return trim - int(-x * np.float32(trim - low))


@given(outputs, st.floats(-120.0, 120.0))
def test_pulses_are_those_of_the_firmware(output: Output, deflection_deg: float) -> None:
    fraction = np.clip(np.float32(deflection_deg) / np.float32(output.travel_deg), np.float32(-1), np.float32(1))
    assert output.pulse_us(np.array([deflection_deg])).tolist() == [firmware(output, fraction)]


@given(outputs, st.floats(-1.0, 1.0))
def test_a_pulse_asks_for_what_was_wanted_to_a_microsecond(output: Output, fraction: float) -> None:
    wanted_deg = fraction * output.travel_deg
    asked_deg = output.deflection_deg(output.pulse_us(np.array([wanted_deg])))
    shortest_us = min(output.max_us - output.trim_us, output.trim_us - output.min_us)
    assert abs(asked_deg[0] - wanted_deg) <= 1.01 * output.travel_deg / shortest_us


def aircraft(**channels: str) -> Aircraft:
    """Surfaces commanded in microseconds on these channels."""
    command = {"unit": "us", "trim_us": 1520.0, "slope_deg_per_us": -0.06}
    return Aircraft.model_validate(
        {"surfaces": {n: {"command": {**command, "channel": c}} for n, c in channels.items()}}
    )


def test_functions_follow_from_names() -> None:
    names = ["aileron_left", "aileron_right", "elevator", "rudder", "flap", "elevon_l", "elevon_r", "v_tail_right"]
    found = {o.surface: (o.number, o.function) for o in outputs_of(plain_aircraft(names))}
    assert list(found.values()) == [(1, 4), (5, 4), (2, 19), (4, 21), (6, 2), (7, 77), (8, 78), (9, 80)]
    sideless = outputs_of(plain_aircraft(["elevon1", "elevon2", "gimbal", "hook"]))
    assert [o.function for o in sideless] == [77, 78, 94, 95]


def test_a_command_in_microseconds_tells_its_output() -> None:
    (one, two) = outputs_of(aircraft(elevator="RCOU.C5", rudder="SERVO_OUTPUT_RAW.servo9_raw"))
    assert (one.number, two.number, one.reversed) == (5, 9, True)
    assert (one.min_us, one.trim_us, one.max_us) == (1020, 1520, 2020)
    assert one.travel_deg == pytest.approx(30.0)
    np.testing.assert_allclose(one.deflection_deg(np.array([1620])), [-6.0])


@pytest.mark.parametrize(
    ("made", "expected"),
    [
        (aircraft(elevator="RCOU.C5", rudder="RCOU.C5"), "output of its own"),
        (aircraft(elevator="RCOU.C15"), "from 1 to 14"),
        (plain_aircraft([f"s{k}" for k in range(14)]), "room for 13"),
    ],
)
def test_impossible_outputs_are_refused(made: Aircraft, expected: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(expected)):
        outputs_of(made)
