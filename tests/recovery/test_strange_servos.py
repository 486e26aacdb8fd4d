"""Servos of another structure than any model's, and runs without torque: what is told of them is right or a tie."""

from __future__ import annotations

import numpy as np
import pytest

from places import case, score_line
from validity import found_in, lot


@pytest.mark.parametrize(
    "seed",
    [
        pytest.param(196, marks=pytest.mark.slow),
        *(
            pytest.param(seed, marks=pytest.mark.nightly)
            for seed in (48, 90, 148, 184, 356, 1436, 1496, 1946, 1972, 2166, 2396)
        ),
    ],
)
def test_two_effects_at_any_place_of_the_slow_pole_are_told(seed: int) -> None:
    """Play behind a limit of the speed, friction of a motor at its limit, a dead band where the pole is after it.

    A limit with a delay, which a slow pole elsewhere looks like; friction that nearly stops a motor at its limit,
    neither of which is found without the other.
    """
    line = score_line(case(seed))
    assert line["in_set"]
    assert line["per_name"] <= 2.0


@pytest.mark.nightly
def test_structures_that_are_none_of_the_models() -> None:
    lines = [score_line(case(seed)) for seed in range(1, 200, 2)]
    there = [line for line in lines if line["truth"]]
    assert np.mean([line["in_set"] for line in there]) >= 0.98
    assert np.mean([line["per_name"] for line in there]) <= 1.25
    assert sum(line["wrong"] for line in lines) <= 1
    assert all(not line["named"] for line in lines if not line["truth"])


@pytest.mark.slow
def test_lost_torque_is_found_when_it_is_lost_and_a_healthy_run_is_not_accused() -> None:
    drawn = lot(2)
    found = found_in(drawn)
    assert [each.run for each in found] == [drawn.run]
    assert drawn.is_found(found)
    assert found_in(lot(2, healthy=True)) == []


@pytest.mark.nightly
def test_lost_torque_in_a_hundred_sets_of_runs() -> None:
    sets = [lot(seed) for seed in range(1, 200, 2)]
    assert sum(each.is_found(found_in(each)) for each in sets) >= 95
    assert not any(found_in(lot(seed, healthy=True)) for seed in range(1, 600, 2))
