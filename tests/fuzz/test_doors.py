"""Every door withstands some broken inputs; the long campaigns (docs/robustness.md) begin with the same ones."""

from __future__ import annotations

import random
from typing import TYPE_CHECKING

import pytest

from tests.fuzz.doors import DOORS, entered
from tests.fuzz.mutate import mutant

if TYPE_CHECKING:
    from pathlib import Path

FEW, MANY = 20, 200
CHEAP = (
    "matlab4",
    "matlab5",
    "hdf5",
    "table",
    "packed",
    "old_text",
    "one_frame",
    "results",
    "live",
)
"""Doors whose sound inputs are made in no time."""


def withstand(name: str, number: int, folder: Path) -> set[str]:
    """Let sound inputs in, then broken ones; gives what became of the latter."""
    door = DOORS[name]
    seeds = door.seeds(folder)
    for content in seeds:
        entered(door, content, folder)
    rng = random.Random(name)  # noqa: S311 - a seed, not a secret
    return {entered(door, mutant(rng, seeds, door.shape), folder) for _ in range(number)}


@pytest.mark.slow
@pytest.mark.parametrize("name", CHEAP)
def test_a_door_takes_a_few_broken_inputs(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert withstand(name, FEW, tmp_path)


@pytest.mark.nightly
@pytest.mark.parametrize("name", DOORS)
def test_a_door_takes_many_broken_inputs(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert len(withstand(name, MANY, tmp_path)) > 1
