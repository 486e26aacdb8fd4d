"""Damaged files of every kind: a log or a `LogError`, never anything else, and not a word on stderr."""

from __future__ import annotations

import io
import random

import pytest

import logparsers
from logparsers import FlightLog, LogError
from tests.parsers import writers
from tests.parsers.writers import COMMAND, FLIGHT, TIME_S

SEEDS = {
    "level4": writers.flight_level4(),
    "level5": writers.matlab({**FLIGHT, "inner": {"more": {"dr": COMMAND}}}),
    "level7": writers.matlab({"flight": FLIGHT}, compressed=True),
    "matlab73": writers.matlab73(FLIGHT),
    "raptrs": writers.raptrs(),
    "table": writers.table({"time_s": TIME_S, "tail_cmd_deg": COMMAND, "note": ["a"] * TIME_S.size}, end="\r\n"),
    "quoted": writers.table({"time_s": TIME_S, "note": ['"a;b"'] * TIME_S.size, "tail_cmd_deg": COMMAND}, ";"),
    "blanks": writers.table({"time_s": TIME_S, "tail_cmd_deg": COMMAND}, "   "),
}
EXTREMES = (
    b"\xff\xff\xff\xff",
    b"\x7f\xff\xff\xff",
    b"\xff\xff\xff\x7f",
    b"\0\0\0\0",
    b"\0\0\xf0\x7f",
    b"\x7f\xa0\0\0",
)
CASES = 700


def outcome(content: bytes) -> FlightLog | LogError:
    try:
        return logparsers.read(io.BytesIO(content))
    except LogError as error:
        return error


def mutated(rng: random.Random, content: bytes) -> bytes:
    """Cut, grow, shrink, flip or overwrite; half of the time near the beginning, where the headers are."""
    broken = bytearray(content)
    at = rng.randrange(len(content) if rng.random() < 0.5 else min(len(content), 800))
    match rng.randrange(6):
        case 0:
            del broken[at:]
        case 1:
            broken[at:at] = rng.randbytes(rng.randrange(1, 20))
        case 2:
            del broken[at : at + rng.randrange(1, 40)]
        case 3:
            broken[at : at + 4] = rng.choice(EXTREMES)
        case _:
            for _ in range(rng.choice([1, 1, 2, 5])):
                broken[rng.randrange(at + 1)] ^= 1 << rng.randrange(8)
    return bytes(broken)


@pytest.mark.parametrize("kind", SEEDS)
def test_damaged_bytes_are_a_log_or_a_log_error(kind: str, capfd: pytest.CaptureFixture[str]) -> None:
    rng = random.Random(kind)  # noqa: S311 - a seed, not a secret
    outcomes = set()
    for _ in range(CASES):
        result = outcome(mutated(rng, SEEDS[kind]))
        if isinstance(result, LogError):
            assert "\n" not in str(result)
            assert str(result).startswith("<file>: ")
        else:
            assert result.channels
        outcomes.add(type(result).__name__)
    assert capfd.readouterr() == ("", "")
    assert {"FlightLog", "UnreadableLog"} <= outcomes


def test_random_bytes() -> None:
    rng = random.Random(0)  # noqa: S311
    for size in range(1, 600):
        with pytest.raises(LogError):
            logparsers.read(io.BytesIO(rng.randbytes(size)))
