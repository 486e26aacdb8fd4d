"""Leaves the topics nobody asked for out of a PX4 log, so that its decoder need not look at them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from logparsers.compiled import compiled

if TYPE_CHECKING:
    from collections.abc import Container

    from numpy.typing import NDArray

    Bytes = NDArray[np.uint8]

__all__ = ["chain", "sieve"]

_HEADER = 16
_ADD, _DATA = ord("A"), ord("D")
_KNOWN = np.zeros(256, dtype=np.bool_)
_KNOWN[list(b"ABCDFILMOPQRS")] = True
_APPENDED = 0x01


@compiled
def _walk(data: Bytes, topics: NDArray[np.int64], dropped: NDArray[np.bool_], out: Bytes) -> tuple[int, int, int]:
    """Follow the messages; note the topics announced, copy what is not dropped: (end, topics, bytes copied).

    Ends early where what follows is no message. An empty `out` counts, and copies nothing.
    """
    at, found, kept = 16, 0, 0
    while at + 3 <= data.size:
        size = int(data[at]) + 256 * int(data[at + 1])
        kind = data[at + 2]
        end = at + 3 + size
        if end > data.size or size == 0 or not _KNOWN[kind]:
            break
        if kind == _ADD:
            if size < 3:
                break
            if found < topics.size:
                topics[found] = at
            found += 1
        if kind == _DATA and size < 2:
            break
        if kind != _DATA or not dropped[int(data[at + 3]) + 256 * int(data[at + 4])]:
            if out.size:
                out[kept : kept + 3 + size] = data[at:end]
            kept += 3 + size
        at = end
    return at, found, kept


def chain(data: Bytes) -> int:
    """Find the end of the last whole message [bytes]; the length of the file if nothing is cut or damaged."""
    nothing = np.zeros(0, dtype=np.uint8)
    end, _, _ = _walk(data, np.zeros(0, dtype=np.int64), np.zeros(1 << 16, dtype=np.bool_), nothing)
    return int(end)


def sieve(data: Bytes, wanted: Container[str]) -> Bytes | None:
    """Copy a log without the samples of unwanted topics.

    Parameters
    ----------
    data : ndarray of uint8, shape (n,)
        The file.
    wanted : container of str
        Topics to keep.

    Returns
    -------
    ndarray of uint8 or None
        A log in the same format; all else is kept, also the start of a last message that was cut. None if
        the file is damaged, or has parts appended by position: then only the whole of it will do.
    """
    if data.size < _HEADER + 43 or (data[_HEADER + 2] == ord("B") and data[_HEADER + 11] & _APPENDED):
        return None
    keep_all = np.zeros(1 << 16, dtype=np.bool_)
    nothing = np.zeros(0, dtype=np.uint8)
    end, found, _ = _walk(data, np.zeros(0, dtype=np.int64), keep_all, nothing)
    if not _is_cut(data, end):
        return None
    topics = np.zeros(found, dtype=np.int64)
    _walk(data, topics, keep_all, nothing)
    dropped = _unwanted(data, topics, wanted)
    _, _, kept = _walk(data, topics, dropped, nothing)
    out = np.empty(_HEADER + kept + data.size - end, dtype=np.uint8)
    out[:_HEADER] = data[:_HEADER]
    out[_HEADER + kept :] = data[end:]
    if kept:
        _walk(data, topics, dropped, out[_HEADER : _HEADER + kept])
    return out


def _is_cut(data: Bytes, end: int) -> bool:
    """Whether the file ends inside a message, or with one; otherwise something is wrong at `end`."""
    rest = data[end:]
    if rest.size < 3:
        return True
    return bool(_KNOWN[rest[2]] and rest.size < 3 + int(rest[0]) + 256 * int(rest[1]))


def _unwanted(data: Bytes, topics: NDArray[np.int64], wanted: Container[str]) -> NDArray[Any]:
    """Message numbers that only ever stand for unwanted topics."""
    asked, known = np.zeros(1 << 16, dtype=np.bool_), np.zeros(1 << 16, dtype=np.bool_)
    for at in topics.tolist():
        size = int(data[at]) + 256 * int(data[at + 1])
        number = int(data[at + 4]) + 256 * int(data[at + 5])
        name = data[at + 6 : at + 3 + size].tobytes().decode("utf-8", errors="ignore")
        known[number] = True
        asked[number] |= name in wanted
    return known & ~asked
