"""What an aircraft file may say of each effect, what is common on a healthy servo, and where a search begins."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from servofd.core.errors import ConfigError
from servofd.servo.catalogue import effects_installed, table_of
from servofd.servo.effect import Effect, Parameter
from servofd.servo.physics import Physics
from servofd.servo.registry import catalogue

NUMBERS = [(effect, parameter) for effect in catalogue() for parameter in effect.parameters]


def named(value: object) -> str:
    return value.name if isinstance(value, Parameter) else value.key() if isinstance(value, type) else ""  # type: ignore[attr-defined]


each_number = pytest.mark.parametrize(("effect", "parameter"), NUMBERS, ids=named)


def entry(effect: type[Effect], parameter: Parameter, value: float) -> dict[str, dict[str, float | str]]:
    numbers: dict[str, float | str] = {p.name: p.typical + p.low * (p.low > 0.0) for p in effect.parameters}
    numbers |= {"lower_deg": -2.0, "upper_deg": 2.0} if "lower_deg" in numbers else {}
    form: dict[str, float | str] = {"form": effect.form} if effect.form else {}
    return {effect.name: form | numbers | {parameter.name: value}}


@each_number
def test_a_file_may_say_what_lies_in_its_range(effect: type[Effect], parameter: Parameter) -> None:
    low, high = parameter.low, parameter.high
    margin = 1e-3 * (high - low)
    for inside in (low + margin, high - margin):
        installed = effects_installed(Physics(), entry(effect, parameter, inside))
        assert {getattr(installed, name) for name in parameter.fields} == {inside}
    for outside in (low - margin, high + margin):
        with pytest.raises(ConfigError, match=f"between {low:g} and {high:g}"):
            effects_installed(Physics(), entry(effect, parameter, outside))


@pytest.mark.parametrize("parameter", [parameter for _, parameter in NUMBERS], ids=lambda parameter: parameter.name)
def test_a_search_begins_at_even_ratios_within_the_range(parameter: Parameter) -> None:
    starts = sorted(parameter.grid)
    assert all(parameter.low <= start <= parameter.high for start in starts)
    for sign in (1.0, -1.0):
        sizes = sorted(sign * value for value in starts if sign * value > 0.0)
        ratios = [b / a for a, b in pairwise(sizes)]
        assert not ratios or max(ratios) <= (1.5 if parameter.kinked else 1.81) * min(ratios)


def test_steps_are_sought_at_the_resolutions_that_sensors_have() -> None:
    (steps,) = next(effect for effect in catalogue() if effect.key() == "quantization (position)").parameters
    for step_deg in (360.0 / 4096.0, 360.0 / 1024.0, 0.1, 0.18, 0.5, 1.0, 2.0):
        assert min(abs(start / step_deg - 1.0) for start in steps.grid) < 1e-9


def test_a_number_that_is_written_keeps_seven_digits_and_the_period_of_frames_ten() -> None:
    effects = {effect.name: effect for effect in reversed(catalogue())}
    written = table_of(
        [effects["pwm_frame"], effects["backlash"]], np.array([0.012345678912345, 0.123456789123, 1.23456789])
    )
    assert written["pwm_frame"] == {"period_s": 0.01234567891, "phase": 0.1234567891}
    assert written["backlash"] == {"width_deg": 1.234568}
