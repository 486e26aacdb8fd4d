from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from logparsers import Channel, Damage, FlightLog, MissingChannel

LOG = FlightLog(
    Path("a.csv"),
    "table",
    {
        "tail_cmd_deg": Channel("tail_cmd_deg", np.array([1.0, 2.0]), np.array([0.0, 1.0]), "deg", "tail_cmd_deg"),
        "tail_pos_deg": Channel("tail_pos_deg", np.array([1.5, 4.0]), np.array([3.0, 3.0]), "deg", "tail_pos_deg"),
    },
    (Damage("gap", "no samples"), Damage("gap", "no samples"), Damage("truncated", "one row")),
    run="7",
)


def test_a_channel_that_is_not_there_names_its_neighbours() -> None:
    with pytest.raises(MissingChannel, match=r"a\.csv \(run 7\): no channel 'tail_pos'; .* among them tail_pos_deg"):
        LOG["tail_pos"]
    with pytest.raises(MissingChannel, match="among them tail_cmd_deg, tail_pos_deg"):
        LOG["???"]


def test_the_summary_counts_damage_and_spans_all_channels() -> None:
    assert repr(LOG) == "<FlightLog a.csv (run 7): table, 3.0 s, 2 channels, 2 gap, 1 truncated>"


def test_times_and_values_must_pair() -> None:
    with pytest.raises(ValueError, match="channel 'x'"):
        Channel("x", np.zeros(3), np.zeros(2), "", "x")


def test_a_channel_owns_its_arrays() -> None:
    values = np.zeros(2)
    channel = Channel("x", np.arange(2.0), values, "", "x")
    values[0] = 9.0
    assert channel.values[0] == 0.0
    assert channel.is_constant
    assert not LOG["tail_cmd_deg"].is_constant
