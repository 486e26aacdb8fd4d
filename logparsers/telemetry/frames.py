"""MAVLink frames in a file: find them, check them, gather columns out of them. Compiled; no meaning.

A telemetry log is a sequence of records: arrival time (big-endian uint64 [us]), then one MAVLink frame.
The position of a frame is that of its first byte, the marker; its arrival time stands 8 bytes before.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from logparsers.compiled import compiled
from logparsers.protocol import CHECK_BYTES, HEADER_1, HEADER_2, MARKER_1, MARKER_2, SIGNATURE_BYTES, SIGNED

Bytes = NDArray[np.uint8]
Slots = NDArray[np.int32]

STAMP_BYTES = 8
"""Bytes of the arrival time before each frame."""
BAD_CHECKSUM, LOST_SYNC, TRUNCATED = 1, 2, 3
"""Kinds of a damaged stretch."""

SPAN = np.dtype([("offset", "<i8"), ("length", "<i8"), ("kind", "<i8")])
"""A damaged stretch of a file [bytes]."""

_NOT_A_FRAME, _BAD, _BEYOND, _UNKNOWN, _GOOD = 0, 1, 2, 3, 4
"""What bytes can be: no frame, a frame with a wrong check-sum, one that goes on beyond the end, one of an unknown
message, a good one."""
_LOOKAHEAD = 4
"""Frames that must follow one of an unknown message, which has no check-sum that could be tested."""


def _crc_table() -> NDArray[np.uint16]:
    table = np.arange(256, dtype=np.uint16)
    for _ in range(8):
        table = np.where(table & 1, (table >> 1) ^ 0x8408, table >> 1).astype(np.uint16)
    return table


_CRC = _crc_table()


@compiled
def check_sum(data: Bytes, start: int, stop: int, seed: int) -> int:
    """Check-sum of MAVLink (CRC-16/MCRF4XX) over ``data[start:stop]`` and the seed of the message."""
    crc = 0xFFFF
    for i in range(start, stop):
        crc = (crc >> 8) ^ _CRC[(crc ^ data[i]) & 0xFF]
    last: int = (crc >> 8) ^ _CRC[(crc ^ seed) & 0xFF]
    return last


@compiled
def _inspect(data: Bytes, at: int, slots: Slots, seeds: Bytes) -> tuple[int, int, int]:  # noqa: PLR0911
    """Judge what stands at `at`: (verdict, length of the frame, slot of its message)."""
    size = data.size
    if at >= size:
        return _NOT_A_FRAME, 0, -1
    if data[at] == MARKER_1:
        if at + HEADER_1 + CHECK_BYTES > size:
            return _BEYOND, 0, -1
        header, trailer = HEADER_1, CHECK_BYTES
        message = np.int64(data[at + 5])
    elif data[at] == MARKER_2:
        if at + HEADER_2 + CHECK_BYTES > size:
            return _BEYOND, 0, -1
        if data[at + 2] & ~SIGNED:
            return _NOT_A_FRAME, 0, -1
        header, trailer = HEADER_2, CHECK_BYTES + SIGNATURE_BYTES * (data[at + 2] & SIGNED)
        message = np.int64(data[at + 7]) | np.int64(data[at + 8]) << 8 | np.int64(data[at + 9]) << 16
    else:
        return _NOT_A_FRAME, 0, -1
    body = at + header + data[at + 1]
    if body + trailer > size:
        return _BEYOND, 0, -1
    slot = slots[message] if message < slots.size else -1
    if slot < 0:
        return _UNKNOWN, body + trailer - at, seeds.size
    stored = np.int64(data[body]) | np.int64(data[body + 1]) << 8
    verdict = _GOOD if check_sum(data, at + 1, body, seeds[slot]) == stored else _BAD
    return verdict, body + trailer - at, slot


@compiled
def _leads_on(data: Bytes, start: int, slots: Slots, seeds: Bytes) -> bool:
    """True if a frame of an unknown message, which has no check-sum to test, ends where another begins."""
    for _ in range(_LOOKAHEAD):
        if start == data.size:
            return True
        verdict, length, _ = _inspect(data, start + STAMP_BYTES, slots, seeds)
        if verdict == _GOOD:
            return True
        if verdict != _UNKNOWN:
            return False
        start += STAMP_BYTES + length
    return True


@compiled
def _resume(data: Bytes, start: int, slots: Slots, seeds: Bytes) -> int:
    """Find the first good frame at or after `start`; the end of the data if there is none."""
    for at in range(start, data.size):
        if (data[at] == MARKER_1 or data[at] == MARKER_2) and _inspect(data, at, slots, seeds)[0] == _GOOD:
            return at
    return data.size


@compiled
def _scan(
    data: Bytes,
    slots: Slots,
    seeds: Bytes,
    out: tuple[NDArray[Any], NDArray[np.uint16], NDArray[np.int64], NDArray[Any]],
) -> tuple[int, int, int, int]:
    """Fill markers, kinds, unstamped and spans; return how much of each was used, and the bytes lost."""
    markers, kinds, unstamped, spans = out
    found, bare, hurt, lost, start = 0, 0, 0, 0, 0
    while start < data.size:
        at = start + STAMP_BYTES
        verdict, length, slot = _inspect(data, at, slots, seeds)
        end = at + length
        if verdict == _GOOD or (verdict == _UNKNOWN and _leads_on(data, end, slots, seeds)):
            markers[found] = at
            kinds[found] = slot
            found += 1
            start = end
            continue
        kind = LOST_SYNC
        if verdict == _BAD and _inspect(data, end + STAMP_BYTES, slots, seeds)[0] == _GOOD:
            kind, at = BAD_CHECKSUM, end + STAMP_BYTES  # its length was right: do not look inside it
        else:
            at = _resume(data, start, slots, seeds)
            if at == data.size and (verdict == _BEYOND or start + STAMP_BYTES >= data.size):
                kind = TRUNCATED
        resumed = data.size if at == data.size else max(at - STAMP_BYTES, start)
        if at < data.size:
            _, length, slot = _inspect(data, at, slots, seeds)
            if at - STAMP_BYTES < start:  # the frame survived, its arrival time did not
                resumed = at
                unstamped[bare] = at
                bare += 1
            markers[found] = at
            kinds[found] = slot
            found += 1
        if resumed > start:
            if hurt < spans.size:
                spans[hurt]["offset"] = start
                spans[hurt]["length"] = resumed - start
                spans[hurt]["kind"] = kind
            hurt += 1
            lost += resumed - start
        start = at + length if at < data.size else data.size
    return found, bare, hurt, lost


@compiled
def _gather(data: Bytes, markers: NDArray[Any], offset: int, out: Bytes) -> None:
    for i in range(markers.size):
        at = np.int64(markers[i])
        header = HEADER_1 if data[at] == MARKER_1 else HEADER_2
        available = np.int64(data[at + 1]) - offset  # the sender cuts trailing zeros off
        source = at + header + offset
        for k in range(out.shape[1]):
            out[i, k] = data[source + k] if k < available else 0


def scan(
    data: Bytes, slots: Slots, seeds: Bytes
) -> tuple[NDArray[Any], NDArray[np.uint16], NDArray[np.int64], NDArray[Any], int, int]:
    """Find every good frame.

    `data` (shape (n,)): the file. `slots`, `seeds`: of the dialect. Result: `markers` (shape (m,)): position of each
    frame [bytes], rising. `kinds` (shape (m,)): slot of its message; ``len(seeds)`` for messages the dialect does not
    know. `unstamped`: positions of frames whose arrival time is lost. `spans`: damaged stretches, at most 1000;
    further ones are only counted.
    """
    room = data.size // 8 + 1  # a frame has at least 8 bytes; untouched pages cost nothing
    markers = np.empty(room, dtype=np.uint32 if data.size < 2**32 else np.int64)
    kinds = np.empty(room, dtype=np.uint16)
    unstamped = np.empty(room, dtype=np.int64)
    spans = np.zeros(1000, dtype=SPAN)
    found, bare, hurt, lost = _scan(data, slots, seeds, (markers, kinds, unstamped, spans))
    return markers[:found], kinds[:found], unstamped[:bare].copy(), spans[:hurt].copy(), int(hurt), int(lost)


def gather(data: Bytes, markers: NDArray[Any], offset: int, width: int) -> Bytes:
    """Copy `width` payload bytes of each frame, from `offset` on; bytes the sender cut off are zero.

    Result (shape (m, width)): one row per frame.
    """
    out = np.empty((markers.size, width), dtype=np.uint8)
    _gather(data, markers, offset, out)
    return out


def arrivals_us(data: Bytes, markers: NDArray[Any]) -> NDArray[np.uint64]:
    """Arrival times before each frame [us since 1970]. Positions below 8 have none: do not ask."""
    anywhere: NDArray[Any] = np.ndarray((data.size - STAMP_BYTES + 1,), ">u8", data.data, 0, (1,))
    stamps: NDArray[np.uint64] = anywhere[markers - STAMP_BYTES].astype(np.uint64)
    return stamps


def origins(data: Bytes, markers: NDArray[Any]) -> NDArray[np.uint16]:
    """System * 256 + component of each frame."""
    at = markers + np.where(data[markers] == MARKER_1, 3, 5).astype(markers.dtype)
    senders: NDArray[np.uint16] = data[at].astype(np.uint16) << 8 | data[at + 1]
    return senders
