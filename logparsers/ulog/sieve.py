"""Takes the samples of a PX4 log aside, so that only those that are asked for are decoded, and each topic at once."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from logparsers.compiled import compiled

if TYPE_CHECKING:
    from collections.abc import Container

    from numpy.typing import NDArray

    Bytes = NDArray[np.uint8]

_HEADER, _STAMP, _HEAD = 16, 8, 3
"""Bytes of the header of a PX4 log, of the time stamp at its end and at the beginning of a sample, and of what stands
before each message: its size and its kind."""
_TOPICS = 1 << 16
"""Numbers that topics can have."""
_FLAG_BITS, _FLAGS, _INCOMPATIBLE = ord("B"), 43, 11
"""Kind and bytes of the message of flags that comes first, and which byte of it forbids to read on in order."""
_ADD, _DATA, _DROPOUT, _PARAMETER = ord("A"), ord("D"), ord("O"), ord("P")
_TEXT, _TAGGED = ord("L"), ord("C")
_KNOWN = np.zeros(256, dtype=np.bool_)
_KNOWN[list(b"ABCDFILMOPQRS")] = True
_APPENDED = 0x01


@compiled
def _u16(data: Bytes, at: int) -> int:
    """Two bytes as a number, the lower one first."""
    return int(data[at]) | int(data[at + 1]) << 8


@compiled
def _walk(data: Bytes, topics: NDArray[np.int64], dropped: NDArray[np.bool_], out: Bytes) -> tuple[int, int, int]:
    """Follow the messages; note the topics announced, copy what is not dropped: (end, topics, bytes copied).

    Ends early where what follows is no message. An empty `out` counts, and copies nothing.
    """
    at, found, kept = _HEADER, 0, 0
    while at + _HEAD <= data.size:
        size = _u16(data, at)
        kind = data[at + 2]
        end = at + _HEAD + size
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
        if kind != _DATA or not dropped[_u16(data, at + _HEAD)]:
            if out.size:
                out[kept : kept + _HEAD + size] = data[at:end]
            kept += _HEAD + size
        at = end
    return at, found, kept


def chain(data: Bytes) -> int:
    """Find the end of the last whole message [bytes]; the length of the file if nothing is cut or damaged."""
    no_bytes = np.zeros(0, dtype=np.uint8)
    end, _, _ = _walk(data, np.zeros(0, dtype=np.int64), np.zeros(_TOPICS, dtype=np.bool_), no_bytes)
    return int(end)


class NotPlain(Exception):  # noqa: N818 - no error of the file: another way has to be taken
    """Samples are not what their format says, or not announced before they come."""


class Samples:
    """Samples of the wanted topics of a sound log, and how late it was when something else was logged.

    `data` (shape (n,)): the file. `places` (shape (m,)): where each sample begins. `numbers` (shape (m,)): of their
    topics. `sizes` (shape (2, 65536)): least and most bytes of a sample of each topic. `dropouts_us`, `parameters_us`:
    newest stamp before each dropout, and before each change of a parameter [us].
    """

    def __init__(
        self,
        data: Bytes,
        places: NDArray[np.int64],
        numbers: NDArray[np.int64],
        sizes: NDArray[np.int64],
        dropouts_us: NDArray[np.int64],
        parameters_us: NDArray[np.int64],
    ) -> None:
        order = np.argsort(numbers.astype(np.uint16), kind="stable")
        self._data, self._places, self._numbers, self._sizes = data, places[order], numbers[order], sizes
        self.dropouts_us, self.parameters_us = dropouts_us, parameters_us

    def of(self, number: int, width: int, most: int) -> Bytes:
        """All samples of a topic behind each other, `width` bytes of each; none has more than `most`."""
        first, last = np.searchsorted(self._numbers, [number, number + 1]).tolist()
        if last > first and (self._sizes[0, number] < width or self._sizes[1, number] > most):
            raise NotPlain
        out = np.empty((last - first) * width, dtype=np.uint8)
        _gather(self._data, self._places[first:last], width, out)
        return out


def set_aside(data: Bytes, wanted: Container[str]) -> tuple[Bytes, Samples] | None:
    """A log without any sample, and the samples of the wanted topics; None if only the whole of it will do.

    `data` (shape (n,)): the file. The log keeps all else, also the start of a last message that was cut. None if the
    file is damaged, or has parts appended by position.
    """
    if data.size < _HEADER + _FLAGS or (data[_HEADER + 2] == _FLAG_BITS and data[_HEADER + _INCOMPATIBLE] & _APPENDED):
        return None
    no_bytes, no_numbers = np.zeros(0, dtype=np.uint8), np.zeros(0, dtype=np.int64)
    all_, none = np.ones(_TOPICS, dtype=np.bool_), np.zeros(_TOPICS, dtype=np.bool_)
    end, found, kept = _walk(data, no_numbers, all_, no_bytes)
    if not is_cut(data, end):
        return None
    topics = np.zeros(found, dtype=np.int64)
    _walk(data, topics, none, no_bytes)
    dropped = _unwanted(data, topics, wanted)
    sizes = np.zeros((2, _TOPICS), dtype=np.int64)
    counts = np.zeros(3, dtype=np.int64)
    if not _collect(data, end, dropped, counts, no_numbers, no_numbers, sizes, no_numbers, no_numbers):
        return None
    places, numbers, dropouts_us, parameters_us = (np.zeros(counts[k], dtype=np.int64) for k in (0, 0, 1, 2))
    _collect(data, end, dropped, counts, places, numbers, sizes, dropouts_us, parameters_us)
    out = np.empty(_HEADER + kept + data.size - end, dtype=np.uint8)
    out[:_HEADER] = data[:_HEADER]
    out[_HEADER + kept :] = data[end:]
    if kept:
        _walk(data, topics, all_, out[_HEADER : _HEADER + kept])
    return out, Samples(data, places, numbers, sizes, dropouts_us, parameters_us)


@compiled
def _stamp(data: Bytes, at: int) -> int:
    stamp = np.int64(0)
    for k in range(_STAMP):
        stamp |= np.int64(data[at + k]) << (8 * k)
    return int(stamp)


@compiled
def _note(
    count: int,
    at: int,
    number: int,
    size: int,
    places: NDArray[np.int64],
    numbers: NDArray[np.int64],
    sizes: NDArray[np.int64],
) -> None:
    if places.size:
        places[count], numbers[count] = at, number
        return
    sizes[0, number] = size if sizes[1, number] == 0 else min(sizes[0, number], size)
    sizes[1, number] = max(sizes[1, number], size)


@compiled
def _collect(
    data: Bytes,
    end: int,
    dropped: NDArray[np.bool_],
    counts: NDArray[np.int64],
    places: NDArray[np.int64],
    numbers: NDArray[np.int64],
    sizes: NDArray[np.int64],
    dropouts_us: NDArray[np.int64],
    parameters_us: NDArray[np.int64],
) -> bool:
    """Note every wanted sample, and the newest stamp at each dropout and parameter; empty arrays only count.

    False if a topic is announced twice or too late, or a stamp is no time.
    """
    added = np.zeros(_TOPICS, dtype=np.bool_)
    at, begun = _HEADER, False
    counts[:] = 0
    latest = _stamp(data, _HEADER - _STAMP)
    while at < end:
        size = _u16(data, at)
        kind = data[at + 2]
        begun = begun or kind in (_ADD, _TEXT, _TAGGED)
        if kind == _ADD:
            number = _u16(data, at + _HEAD + 1)
            if added[number]:
                return False
            added[number] = True
        elif kind == _DATA:
            number = _u16(data, at + _HEAD)
            if not added[number]:
                return False
            if not dropped[number]:
                stamp = _stamp(data, at + _HEAD + 2) if size >= 2 + _STAMP else np.int64(-1)
                if stamp < 0:
                    return False
                latest = max(latest, stamp)
                _note(counts[0], at + _HEAD + 2, number, size - 2, places, numbers, sizes)
                counts[0] += 1
        elif kind == _DROPOUT and begun:
            if dropouts_us.size:
                dropouts_us[counts[1]] = latest
            counts[1] += 1
        elif kind == _PARAMETER and begun:
            if parameters_us.size:
                parameters_us[counts[2]] = latest
            counts[2] += 1
        at += _HEAD + size
    return True


@compiled
def _gather(data: Bytes, places: NDArray[np.int64], width: int, out: Bytes) -> None:
    for k in range(places.size):
        for j in range(width):
            out[k * width + j] = data[places[k] + j]


def is_cut(data: Bytes, end: int) -> bool:
    """Whether the file ends inside a message, or with one; otherwise something is wrong at `end`."""
    rest = data[end:]
    if rest.size < _HEAD:
        return True
    return bool(_KNOWN[rest[2]] and rest.size < _HEAD + _u16(rest, 0))


def _unwanted(data: Bytes, topics: NDArray[np.int64], wanted: Container[str]) -> NDArray[Any]:
    """Message numbers that only ever stand for unwanted topics."""
    asked, known = np.zeros(_TOPICS, dtype=np.bool_), np.zeros(_TOPICS, dtype=np.bool_)
    for at in topics.tolist():
        size = _u16(data, at)
        number = _u16(data, at + _HEAD + 1)
        name = data[at + _HEAD + 3 : at + _HEAD + size].tobytes().decode("utf-8", errors="ignore")
        known[number] = True
        asked[number] |= name in wanted
    return known & ~asked
