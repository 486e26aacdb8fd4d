"""Ways to fly: the same seed gives the same flight, and each moves as much as its docstring says."""

from __future__ import annotations

import re

import numpy as np
import pytest

from servofd.simulation.commands import COMMANDS

TIME_S = np.round(np.arange(12_000) / 100.0, 9)
MEASURED = re.compile(r"measured: ([\d.]+) deg rms, peak rate (\d+) deg/s")


@pytest.mark.parametrize("style", COMMANDS)
def test_a_seed_is_a_flight(style: str) -> None:
    one, same, other = (COMMANDS[style](TIME_S, np.random.default_rng(seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert one.shape == TIME_S.shape
    assert np.array_equal(one, other) == (style == "chirp")  # a sweep leaves nothing to chance


@pytest.mark.parametrize("style", ["calm", "gusty", "cruise", "hand_flown"])
def test_docstrings_tell_what_is_measured(style: str) -> None:
    commands = [COMMANDS[style](TIME_S, np.random.default_rng(seed)) for seed in range(20)]
    rms_deg = np.median([np.sqrt(np.mean(command**2)) for command in commands])
    peak_deg_s = np.median([np.max(np.abs(np.diff(command))) * 100.0 for command in commands])
    told = MEASURED.search(COMMANDS[style].__doc__ or "")
    assert told is not None
    assert (float(told[1]), int(told[2])) == (round(float(rms_deg), 1), round(float(peak_deg_s)))


def test_a_cruise_stays_well_below_a_degree() -> None:
    for seed in range(20):
        command = COMMANDS["cruise"](TIME_S, np.random.default_rng(seed))
        assert np.sqrt(np.mean(command**2)) < 0.4
        assert np.max(np.abs(command)) < 1.5
