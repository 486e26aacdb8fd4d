"""The effects that may be missing: their numbers are in order, and reach the physics that they name."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest

from servofd.servo.catalogue import by_condition, installed, is_law, plain
from servofd.servo.effect import Effect
from servofd.servo.physics import Physics
from servofd.servo.registry import catalogue

every_effect = pytest.mark.parametrize("effect", catalogue(), ids=lambda effect: effect.key())


@every_effect
def test_a_search_begins_within_the_bounds_and_not_with_nothing(effect: type[Effect]) -> None:
    for parameter in effect.parameters:
        assert parameter.low < parameter.high
        assert parameter.typical > 0.0
        assert all(parameter.low <= value <= parameter.high for value in parameter.grid)
        if parameter.grid and not parameter.aside:
            assert not all(math.isclose(value, parameter.neutral) for value in parameter.grid)


@every_effect
def test_a_neutral_effect_is_none(effect: type[Effect]) -> None:
    """Neutral is what a servo without the effect has; of what is then infinite, the end of the range stands for it."""
    for parameter in effect.parameters:
        for without in (getattr(Physics(), name) for name in parameter.fields):
            if math.isfinite(without) and parameter.name != "frequency_hz":
                assert parameter.neutral == without
            else:
                assert parameter.neutral == (parameter.low if without < 0.0 else parameter.high)


@every_effect
def test_starting_values_rise_and_leave_no_hole(effect: type[Effect]) -> None:
    for parameter in effect.parameters:
        grid = sorted(parameter.grid)
        assert len(set(grid)) == len(grid)
        assert parameter.typical < parameter.high - parameter.low
        if not parameter.kinked:
            assert tuple(grid) == parameter.grid
            beside = [(a, b) for a, b in pairwise(grid) if a > 0.0]
            # 0.3, 1, 3 and 10 typical sizes where a class gives none.
            assert all(b <= 3.34 * a or parameter.name == "damping_ratio" for a, b in beside)


@every_effect
def test_every_number_reaches_the_fields_that_it_names(effect: type[Effect]) -> None:
    values = [parameter.grid[-1] if parameter.grid else parameter.typical for parameter in effect.parameters]
    physics = installed(Physics(), [effect], values)
    expected = dict(effect.fixed)
    for parameter, value in zip(effect.parameters, values, strict=True):
        expected |= dict.fromkeys(parameter.fields, value)
    assert expected == {name: getattr(physics, name) for name in expected}
    assert {name for name, _ in physics} <= set(expected)


@every_effect
def test_the_ends_of_a_range_are_no_answer_and_its_middle_is(effect: type[Effect]) -> None:
    for parameter in effect.parameters:
        if math.isfinite(parameter.high - parameter.low):
            middle, margin = 0.5 * (parameter.low + parameter.high), 1e-2 * (parameter.high - parameter.low)
            for end, inside in ((parameter.low, margin), (parameter.high, -margin)):
                is_neutral = abs(end - parameter.neutral) <= 0.1 * margin
                assert parameter.at_bound(end) == (not parameter.aside and not is_neutral)
                assert not parameter.at_bound(end + inside)
            assert not parameter.at_bound(middle)


@pytest.mark.parametrize("effect", [effect for effect in catalogue() if effect.varies], ids=lambda each: each.key())
def test_a_size_that_goes_with_a_condition_is_an_effect_of_its_own(effect: type[Effect]) -> None:
    law = by_condition(effect, 0, "load")
    assert is_law(law)
    assert plain(law) is effect
    assert [parameter.name for parameter in law.parameters][:-1] == [each.name for each in effect.parameters]
