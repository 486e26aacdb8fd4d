"""What the encoders write is what senders send."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from logparsers.records import Text
from logparsers.telemetry.encode import Message, encode
from logparsers.ulog import UlogFile
from logparsers.ulog.encode import Topic
from logparsers.ulog.encode import encode as encode_ulog
from tests.parsers.tlog_writer import frame, record

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


def test_frames_are_those_of_a_sender_one_by_one() -> None:
    """Two messages in turn, more than 256 frames, zeros at the end cut off, an array and a text."""
    rows = 200
    stamps = 1_700_000_000_000_000 + 50_000 * np.arange(rows)
    count = np.arange(rows)
    positions: dict[str, ArrayLike] = {"time_boot_ms": count, "name": [f"P{k % 3}" for k in count], "value": count}
    arrays: dict[str, ArrayLike] = {"time_usec": count, "data": np.outer(count, np.arange(58) < 3)}
    written = encode(
        [Message("NAMED_VALUE_FLOAT", stamps, positions), Message("DEBUG_FLOAT_ARRAY", stamps + 1, arrays)],
        source=(7, 191),
    )
    one_by_one = []
    for k in range(rows):
        named = {"time_boot_ms": k, "name": f"P{k % 3}", "value": float(k)}
        array = {"time_usec": k, "data": [float(k) if j < 3 else 0.0 for j in range(58)]}
        one_by_one += [
            record(int(stamps[k]), frame("NAMED_VALUE_FLOAT", named, source=(7, 191), sequence=2 * k)),
            record(int(stamps[k]) + 1, frame("DEBUG_FLOAT_ARRAY", array, source=(7, 191), sequence=2 * k + 1)),
        ]
    assert written == b"".join(one_by_one)


def test_nothing_to_write_is_nothing() -> None:
    nothing = np.zeros(0)
    assert encode([]) == b""
    assert encode([Message("ATTITUDE", [], {"roll": nothing})]) == b""


def test_px4_topics_of_every_type_are_read_back() -> None:
    stamps = np.array([5, 15, 25], np.uint64)
    kinds = ("u1", "u2", "u4", "u8", "i1", "i2", "i4", "i8", "f4", "f8")
    columns = {"timestamp": stamps, **{f"x_{kind}": np.array([1, 2, 3], kind) for kind in kinds}}
    second = Topic("many", {name: values[:1] for name, values in columns.items()}, instance=1)
    log = UlogFile.open(encode_ulog([Topic("many", columns), second], texts=[Text(10e-6, "hello"), Text(0.0, "x", 3)]))
    assert log.topics == (("many", 0), ("many", 1))
    for name, values in columns.items():
        assert log.column("many", name).dtype == values.dtype
        np.testing.assert_array_equal(log.column("many", name), values)
    assert [(said.severity, said.text) for said in log.texts] == [(3, "x"), (6, "hello")]
    assert log.damage == ()
