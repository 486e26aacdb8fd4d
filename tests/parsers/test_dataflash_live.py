"""A log that comes in blocks holds what a file holds, whatever the link does to the blocks."""

from __future__ import annotations

import io

import numpy as np
import pytest

import logparsers
from logparsers.dataflash.live import BlockStream, RowDecoder
from servofd.simulation.dataflash_writer import dataflash_log
from tests.live.vehicles import PLANE, flown

BLOCK = 200


@pytest.fixture(scope="module")
def log() -> bytes:
    return dataflash_log(flown(duration_s=10.0), PLANE)


def blocks(log: bytes) -> list[bytes]:
    return [log[at : at + BLOCK].ljust(BLOCK, b"\0") for at in range(0, len(log), BLOCK)]


def decoded(pieces: list[bytes]) -> dict[str, tuple[list[float], list[float]]]:
    decoder = RowDecoder()
    found: dict[str, tuple[list[float], list[float]]] = {}
    for piece in pieces:
        if not piece:
            decoder.lose()
        for row in decoder.feed(piece):
            for channel, value in row.values.items():
                times, values = found.setdefault(channel, ([], []))
                times.append(row.time_s)
                values.append(value)
    return found


@pytest.mark.parametrize("channel", ["CSRV[1].Pos", "CSRV[0].PosCmd", "RCOU.C2"])
def test_rows_are_those_of_the_file(log: bytes, channel: str) -> None:
    truth = logparsers.read(io.BytesIO(log))[channel]
    times, values = decoded(blocks(log))[channel]
    np.testing.assert_array_equal(times, truth.time_s)
    np.testing.assert_array_equal(values, truth.values)


def test_what_is_lost_is_asked_for_and_comes_in_order(log: bytes) -> None:
    """Every other sending is lost at random, until the last block is there."""
    rng, stream, sent, out = np.random.default_rng(1), BlockStream(), dict(enumerate(blocks(log))), []
    waiting, now_s = list(sent), 0.0
    while waiting:
        number = waiting.pop(0)
        now_s += 0.005
        if rng.random() < 0.5:
            out += stream.take(number, sent[number], now_s)
        else:
            waiting.insert(min(5, len(waiting)), number)
        for wanted, there in stream.answers(now_s):
            assert there or wanted in waiting
    assert out == list(sent.values())
    assert stream.lost == 0


def test_a_block_that_never_comes_costs_its_rows_alone(log: bytes) -> None:
    stream, out = BlockStream(), []
    sent = blocks(log)
    missing = len(sent) // 2
    for number, data in enumerate(sent):
        if number != missing:
            out += stream.take(number, data, number * 0.02)
    assert stream.lost == 1
    whole, rest = decoded(sent)["CSRV[1].Pos"][0], decoded(out)["CSRV[1].Pos"][0]
    assert set(rest) <= set(whole)
    assert len(whole) - 5 <= len(rest) < len(whole) + 1
