"""Damaged files of every kind: a log or a `LogError`, never anything else, in bounded time and memory, in silence."""

from __future__ import annotations

import io
import random
import resource
import time

import pytest

import logparsers
from logparsers import LogError
from tests.fuzz.harness import SEEDS, outcome
from tests.fuzz.mutate import mutated

MUTANTS = 1_000
"""Of each kind; a campaign of any length is benchmarks/fuzz.py."""
LONGEST_S = 3.0
"""For a file of a few kilobytes; most take a few milliseconds."""
MOST_KILOBYTES = 400_000
"""By which no damaged file of a few kilobytes may raise the peak memory of the process, compilers included."""


def survive(kind: str, number: int) -> set[str]:
    """Read that many mutants; return the kinds of outcome."""
    rng = random.Random(kind)  # noqa: S311 - a seed, not a secret
    outcome(SEEDS[kind])  # compiles
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    outcomes = set()
    for turn in range(number):
        content = mutated(rng, SEEDS[kind])
        begun = time.process_time()
        outcomes.add(type(outcome(content)).__name__)
        if time.process_time() - begun >= LONGEST_S:
            # The first damaged file of all compiles what reads damage; a slow file is slow the second time too.
            begun = time.process_time()
            outcome(content)
            assert time.process_time() - begun < LONGEST_S, f"mutant {turn} of {kind}"
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < MOST_KILOBYTES
    return outcomes


@pytest.mark.nightly
@pytest.mark.parametrize("kind", SEEDS)
def test_damaged_bytes_are_a_log_or_a_log_error(kind: str, capfd: pytest.CaptureFixture[str]) -> None:
    outcomes = survive(kind, MUTANTS)
    assert "FlightLog" in outcomes
    assert len(outcomes) > 1
    assert capfd.readouterr() == ("", "")


@pytest.mark.nightly
def test_random_bytes() -> None:
    rng = random.Random(0)  # noqa: S311
    for size in range(1, 600):
        with pytest.raises(LogError):
            logparsers.read(io.BytesIO(rng.randbytes(size)))
