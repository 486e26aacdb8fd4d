"""Write telemetry logs of MAVLink 2 frames: for simulated flights, and for tests of whoever reads them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from logparsers.compiled import compiled
from logparsers.interleave import places
from logparsers.mavlink import Layout, dialect
from logparsers.protocol import CHECK_BYTES, HEADER_2, MARKER_2
from logparsers.telemetry.frames import STAMP_BYTES, check_sum

Bytes = NDArray[np.uint8]

_AROUND = STAMP_BYTES + HEADER_2 + CHECK_BYTES
"""Bytes around a message's fields: arrival time, header, check-sum."""


@dataclass(frozen=True, slots=True, eq=False)
class Message:
    """All frames of one message.

    `name`: as MAVLink calls it. `arrival_us` (shape (n,)): when each frame was received [us since 1970]. `columns`
    (shape (n,) or (n, k)): fields by name; texts as bytes or str; a field left out is zero.
    """

    name: str
    arrival_us: ArrayLike
    columns: Mapping[str, ArrayLike]


def encode(messages: Sequence[Message], *, source: tuple[int, int] = (1, 1)) -> bytes:
    """Write a log of one sender: frames in the order of their arrival.

    Result: the content of a ``.tlog`` file.
    """
    if not messages:
        return b""
    arrivals = [np.asarray(m.arrival_us, np.int64) for m in messages]
    layouts = [dialect().layouts[m.name] for m in messages]
    filled = [payloads(m, layout) for m, layout in zip(messages, layouts, strict=True)]
    lengths = [_trimmed(payload) for payload in filled]
    starts, size = places(arrivals, [n + _AROUND for n in lengths])
    ranks = np.empty(sum(len(s) for s in starts), np.int64)
    ranks[np.argsort(np.concatenate(starts))] = np.arange(ranks.size)
    counts = np.split((ranks % 256).astype(np.uint8), np.cumsum([len(s) for s in starts])[:-1])
    body = np.zeros(size, np.uint8)
    for k, layout in enumerate(layouts):
        stamps = arrivals[k].astype(">u8").view(np.uint8).reshape(-1, STAMP_BYTES)
        _write(body, starts[k], stamps, counts[k], filled[k], lengths[k], layout.id, layout.seed, *source)
    return body.tobytes()


def payloads(message: Message, layout: Layout) -> Bytes:
    """Full payloads of all frames, shape (n, size)."""
    known = layout.fields.values()
    record = np.dtype(
        {
            "names": [f.name for f in known],
            "formats": [f"S{f.width}" if f.is_text else (f.dtype, max(f.length, 1)) for f in known],
            "offsets": [f.offset for f in known],
            "itemsize": layout.size,
        }
    )
    count = np.size(message.arrival_us)
    rows = np.zeros(count, record)
    for name, column in message.columns.items():
        values = np.asarray(column)
        if layout.fields[name].is_text:
            rows[name] = values.astype("S")
        else:
            rows[name] = values.reshape(count, max(layout.fields[name].length, 1))
    return rows.view(np.uint8).reshape(count, layout.size)


def _trimmed(payload: Bytes) -> NDArray[np.int64]:
    """Bytes up to the last that is not zero, of which MAVLink 2 sends at least one."""
    filled = payload[:, ::-1] != 0
    length: NDArray[Any] = np.where(filled.any(axis=1), payload.shape[1] - filled.argmax(axis=1), 1)
    return length.astype(np.int64)


@compiled
def _write(
    body: Bytes,
    starts: NDArray[np.int64],
    stamps: Bytes,
    counts: Bytes,
    payloads: Bytes,
    lengths: NDArray[np.int64],
    number: int,
    seed: int,
    system: int,
    component: int,
) -> None:
    """Put the frames of one message where they belong."""
    for k in range(starts.size):
        at, length = starts[k], lengths[k]
        frame = at + STAMP_BYTES
        body[at:frame] = stamps[k]
        body[frame] = MARKER_2
        body[frame + 1] = length
        body[frame + 4] = counts[k]
        body[frame + 5] = system
        body[frame + 6] = component
        begin = frame + HEADER_2
        for byte in range(3):
            body[begin - 3 + byte] = (number >> (8 * byte)) & 0xFF
        end = begin + length
        body[begin:end] = payloads[k, :length]
        crc = check_sum(body, frame + 1, end, seed)
        body[end] = crc & 0xFF
        body[end + 1] = crc >> 8
