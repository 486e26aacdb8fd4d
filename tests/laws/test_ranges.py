"""What an aircraft file may say of each effect, what is common on a healthy servo, and where a search begins."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from servofd.errors import ConfigError
from servofd.models.catalogue import CATALOGUE, MissingEffect
from servofd.models.effect_table import effects_installed, table_of
from servofd.models.missing_effect import Parameter
from servofd.models.physics import Physics

RATES = (2.0, 3e3, 60.0, 20.0, 600.0, 12)
ONE_RATE = (2.0, 3e3, 60.0, 40.0, 350.0, 4)
LOWER, UPPER = (-90.0, 0.0, 2.0, -15.0, -2.0, 5), (0.0, 90.0, 2.0, 2.0, 15.0, 5)
BAND = (0.0, 20.0, 0.3, 0.1, 6.0, 8)
STEPS = (0.02, 10.0, 0.1, 360.0 / 4096.0, 3.0, 44)
RANGES: dict[tuple[str, str], tuple[float, float, float, float, float, int]] = {
    ("bias", "bias_deg"): (-30.0, 30.0, 0.3, -1.0, 1.0, 2),
    ("gain", "gain"): (0.2, 2.0, 0.03, 0.8, 1.2, 4),
    ("delay", "delay_s"): (0.0, 0.5, 0.003, 0.0, 0.25, 8),
    ("clock_offset", "offset_s"): (-0.5, 0.5, 0.003, -0.15, 0.2, 9),
    ("slow_dynamics", "bandwidth_scale"): (0.1, 4.0, 0.1, 0.3, 1.5, 7),
    ("rate_limit (motor)", "rate_limit_deg_s"): RATES,
    ("rate_limit (output)", "rate_limit_deg_s"): RATES,
    ("rate_limit (set point)", "rate_limit_deg_s"): RATES,
    ("rate_limit (motor, asymmetric)", "rate_up_deg_s"): ONE_RATE,
    ("rate_limit (motor, asymmetric)", "rate_down_deg_s"): ONE_RATE,
    ("position_limit (linkage)", "lower_deg"): LOWER,
    ("position_limit (linkage)", "upper_deg"): UPPER,
    ("position_limit (servo)", "lower_deg"): LOWER,
    ("position_limit (servo)", "upper_deg"): UPPER,
    ("deadband (error from the edge)", "width_deg"): BAND,
    ("deadband (whole error)", "width_deg"): BAND,
    ("backlash", "width_deg"): (0.0, 8.0, 0.3, 0.1, 6.0, 8),
    ("friction", "friction_deg"): (0.0, 10.0, 0.15, 0.05, 2.0, 7),
    ("sensor_lag", "time_constant_s"): (0.0, 1.0, 0.01, 0.003, 0.25, 7),
    ("airload", "deg_per_deg_pa"): (-2e-3, 2e-2, 2e-4, -2e-4, 2.5e-3, 6),
    ("voltage_rate", "deg_s_per_v"): (0.5, 600.0, 12.0, 4.0, 70.0, 8),
    ("pwm_frame", "period_s"): (2e-3, 0.2, 0.02, 0.0, 0.0, 0),
    ("pwm_frame", "phase"): (-1.0, 2.0, 0.5, 0.0, 0.0, 0),
    ("quantization (position)", "step_deg"): STEPS,
    ("quantization (command)", "step_deg"): STEPS,
    ("supply_coupling", "deg_per_a"): (-20.0, 20.0, 0.3, -1.0, 1.0, 2),
    ("damping", "damping_scale"): (0.1, 6.0, 0.1, 0.4, 2.2, 4),
    ("gravity_load", "droop_deg"): (-180.0, 180.0, 2.0, -2.0, 45.0, 6),
    ("load_friction", "share"): (0.0, 0.95, 0.1, 0.05, 0.6, 4),
    ("current_limit", "knee_deg"): (0.3, 1e3, 300.0, 1.0, 50.0, 5),
    ("linkage_nonlinearity", "quadratic_per_deg"): (-0.05, 0.05, 2e-3, -4e-3, 4e-3, 2),
    ("linkage_nonlinearity", "cubic_per_deg2"): (-5e-3, 5e-3, 2e-4, -4e-4, 4e-4, 2),
    ("resonance", "frequency_hz"): (1.0, 80.0, 30.0, 3.0, 34.0, 11),
    ("resonance", "damping_ratio"): (5e-3, 0.5, 0.05, 0.03, 0.15, 2),
}
SPLIT = (0.35, 0.97, 0.2, 0.8, 0.8, 1)
NUMBERS = [(effect, parameter) for effect in CATALOGUE for parameter in effect.parameters]


def named(value: object) -> str:
    return value.name if isinstance(value, Parameter) else value.key() if isinstance(value, type) else ""  # type: ignore[attr-defined]


each_number = pytest.mark.parametrize(("effect", "parameter"), NUMBERS, ids=named)


def entry(effect: type[MissingEffect], parameter: Parameter, value: float) -> dict[str, dict[str, float | str]]:
    numbers: dict[str, float | str] = {p.name: p.typical + p.low * (p.low > 0.0) for p in effect.parameters}
    numbers |= {"lower_deg": -2.0, "upper_deg": 2.0} if "lower_deg" in numbers else {}
    form: dict[str, float | str] = {"form": effect.form} if effect.form else {}
    return {effect.name: form | numbers | {parameter.name: value}}


@each_number
def test_a_file_may_say_what_lies_in_its_range(effect: type[MissingEffect], parameter: Parameter) -> None:
    expected = SPLIT if parameter.aside else RANGES[effect.key(), parameter.name]
    low, high = expected[:2]
    margin = 1e-3 * (high - low)
    for inside in (low + margin, high - margin):
        installed = effects_installed(Physics(), entry(effect, parameter, inside))
        assert {getattr(installed, name) for name in parameter.fields} == {inside}
    for outside in (low - margin, high + margin):
        with pytest.raises(ConfigError, match=f"between {low:g} and {high:g}"):
            effects_installed(Physics(), entry(effect, parameter, outside))


@each_number
def test_a_search_begins_where_numbers_are_common(effect: type[MissingEffect], parameter: Parameter) -> None:
    expected = SPLIT if parameter.aside else RANGES[effect.key(), parameter.name]
    starts = sorted(parameter.grid)
    ends = (starts[0], starts[-1]) if starts else (0.0, 0.0)
    assert (parameter.typical, *ends, len(starts)) == expected[2:]
    for sign in (1.0, -1.0):
        sizes = sorted(sign * value for value in starts if sign * value > 0.0)
        ratios = [b / a for a, b in pairwise(sizes)]
        assert not ratios or max(ratios) <= (1.5 if parameter.kinked else 1.81) * min(ratios)


def test_steps_are_sought_at_the_resolutions_that_sensors_have() -> None:
    (steps,) = next(effect for effect in CATALOGUE if effect.key() == "quantization (position)").parameters
    for step_deg in (360.0 / 4096.0, 360.0 / 1024.0, 0.1, 0.18, 0.5, 1.0, 2.0):
        assert min(abs(start / step_deg - 1.0) for start in steps.grid) < 1e-9


def test_a_number_that_is_written_keeps_seven_digits_and_the_period_of_frames_ten() -> None:
    effects = {effect.name: effect for effect in reversed(CATALOGUE)}
    written = table_of(
        [effects["pwm_frame"], effects["backlash"]], np.array([0.012345678912345, 0.123456789123, 1.23456789])
    )
    assert written["pwm_frame"] == {"period_s": 0.01234567891, "phase": 0.1234567891}
    assert written["backlash"] == {"width_deg": 1.234568}
