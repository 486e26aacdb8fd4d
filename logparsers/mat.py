"""MATLAB files of level 4, 5 and 7: numbers and structures of them, as views of the file.

A file is a chain of variables, each with its size before it. Texts, cells, objects, functions, sparse and complex
arrays are stepped over; nothing is copied but what was compressed, and that only up to what its header promises and
`archive.check_size` allows.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from logparsers.archive import IN_MEMORY_MB, check_size
from logparsers.errors import TruncatedLog, UnreadableLog

CODES4: Final = ("f8", "f4", "i4", "i2", "u2", "u1")
CODES5: Final = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
MATRIX, COMPRESSED = 14, 15
"""Numbers of an array and of a compressed element among them."""
STRUCTURE, NUMERIC = 2, range(6, 16)
"""Numbers of the array classes: structure, and all numeric ones."""
COMPLEX: Final = 0x0800
"""Flag of an array that has imaginary parts."""
HEADER4: Final = struct.calcsize("5i")
"""Bytes of the header of a level-4 variable."""
TAG: Final = struct.calcsize("2I")
"""Bytes before an element of a level-5 file: its type and its size."""
BEGIN5: Final = 128
"""Bytes of the header of a level-5 file, whose last two tell the order of the bytes."""
DEEPEST: Final = 16
"""Structures within structures; deeper ones are forged."""
MOST_PARTS: Final = 200_000
"""Arrays and fields of a file: each costs memory of its own, however small it is."""


@dataclass(frozen=True, slots=True)
class Header4:
    """Header of one level-4 variable.

    `dtype`: byte order and type of the values, as numpy writes them. `numeric`: False for text and sparse matrices.
    `shape`: rows and columns. `parts`: 2 if an imaginary part follows the real one. `name_bytes`: length of the name
    with its closing NUL.
    """

    dtype: str
    numeric: bool
    shape: tuple[int, int]
    parts: int
    name_bytes: int


def header4(head: bytes) -> Header4 | None:
    """Read a level-4 header in whichever byte order makes sense, or None if neither does.

    `head`: at least 20 bytes.
    """
    for order, machine in (("<", 0), (">", 1)):
        kind, rows, columns, imaginary, name_bytes = struct.unpack(order + "5i", head[:HEADER4])
        m, o, p, t = (kind // 10**k % 10 for k in (3, 2, 1, 0))
        sizes = rows >= 0 and columns >= 0 and imaginary in (0, 1) and 1 < name_bytes <= 256
        if 0 <= kind < 2000 and m == machine and o == 0 and p < len(CODES4) and t <= 2 and sizes:
            return Header4(order + CODES4[p], t == 0, (rows, columns), 1 + imaginary, name_bytes)
    return None


def level4(path: Path, content: memoryview) -> dict[str, Any]:
    r"""Decode every real array of a level-4 file.

    Result (shape (rows, columns)): by name, in the order of the file, in the type of the file.
    """
    found = {}
    at = 0
    while at < len(content):
        if len(content) - at < HEADER4:
            raise _cut(path, "the header of a variable", len(content), at + HEADER4)
        header = header4(bytes(content[at : at + HEADER4]))
        if header is None:
            raise UnreadableLog(
                f"{path}: no MATLAB level-4 variable at byte {at}; copy the log again from its recorder"
            )
        start = at + HEADER4 + header.name_bytes
        name = bytes(content[at + HEADER4 : start]).rstrip(b"\0").decode("ascii", "replace")
        size = prod(header.shape)
        at = start + size * header.parts * np.dtype(header.dtype).itemsize
        if at > len(content):
            raise _cut(path, name, len(content), at)
        if header.numeric and header.parts == 1:
            found[name] = np.frombuffer(content, header.dtype, size, start).reshape(header.shape, order="F")
    return found


def level5(path: Path, content: memoryview) -> dict[str, Any]:
    """Decode every real array of a level-5 file, and the structures that hold them.

    Result: by name, in the order of the file: numbers in the type of the file, a structure by the names of its fields.
    """
    reading = _Level5(path, "<" if bytes(content[BEGIN5 - 2 : BEGIN5]) == b"IM" else ">")
    found: dict[str, Any] = {}
    at = BEGIN5
    while at < len(content):
        if len(content) - at < TAG:
            raise _cut(path, "the header of a variable", len(content), at + TAG)
        kind, size = struct.unpack_from(reading.order + "2I", content, at)
        end = at + TAG + size
        element = content[at + TAG : end]
        if end > len(content):
            raise _cut(path, reading.name(element, kind), len(content), end)
        if kind == COMPRESSED:
            kind, element = reading.inflated(element)
        if kind == MATRIX:
            name, value = reading.array(element, DEEPEST)
            if value is not None:
                found[name] = value
        at = end
    return found


@dataclass(slots=True)
class _Level5:
    """A level-5 file while it is being read."""

    path: Path
    order: str
    inflated_bytes: int = 0
    parts: int = 0

    def inflated(self, element: memoryview) -> tuple[int, memoryview]:
        """As much as the header at the beginning of a compressed variable promises."""
        unpack = zlib.decompressobj()
        head = unpack.decompress(element, TAG)
        kind, size = struct.unpack(self.order + "2I", head)
        self.inflated_bytes += size
        check_size(self.path, self.inflated_bytes, IN_MEMORY_MB)
        body = unpack.decompress(unpack.unconsumed_tail, size) if size else b""
        if len(body) < size:
            raise ValueError(f"a compressed variable holds {len(body)} of {size} bytes")
        return kind, memoryview(body)

    def name(self, element: memoryview, kind: int) -> str:
        """Name of a variable of which only the beginning is left."""
        try:
            start = zlib.decompressobj().decompress(element, 512)[TAG:] if kind == COMPRESSED else bytes(element[:512])
            parts = self.elements(memoryview(start))
            return bytes([next(parts)[1] for _ in range(3)][2]).decode("ascii", "replace")
        except (zlib.error, struct.error, StopIteration, ValueError):
            return "a variable"

    def elements(self, content: memoryview) -> Iterator[tuple[int, memoryview]]:
        """What stands within an array: type and content of one part after the other."""
        at = 0
        while at + TAG <= len(content):
            kind, size = struct.unpack_from(self.order + "2I", content, at)
            small = kind >> 16  # size and type share four bytes, up to four bytes of data follow at once
            start, room = (at + TAG // 2, TAG // 2) if small else (at + TAG, len(content) - at - TAG)
            if small:
                kind, size = kind & 0xFFFF, small
            if size > room:
                raise ValueError(f"an element of {size} bytes does not fit into the {room} that are left")
            yield kind, content[start : start + size]
            at += TAG if small else TAG + -(-size // TAG) * TAG

    def array(self, content: memoryview, depth: int) -> tuple[str, Any]:
        """Name and value of an array; no value if it is none of those that are read."""
        self.parts += 1
        if self.parts > MOST_PARTS:
            raise UnreadableLog(
                f"{self.path}: more than {MOST_PARTS} arrays and fields: no flight log; save plain vectors"
            )
        if not content:  # an empty field
            return "", None
        if depth == 0:
            raise ValueError(f"more than {DEEPEST} structures within one another")
        parts = self.elements(content)
        (word,) = struct.unpack_from(self.order + "I", next(parts)[1])
        kind = word & 0xFF
        if word & COMPLEX or not (kind == STRUCTURE or kind in NUMERIC):
            return "", None  # an object has no dimensions, but the names of its class
        shape = tuple(np.frombuffer(next(parts)[1], self.order + "i4").tolist())
        name = bytes(next(parts)[1]).decode("ascii", "replace")
        if not shape or min(shape) < 1:
            return name, None
        if kind == STRUCTURE:
            return name, self.structure(parts, depth) if prod(shape) == 1 else None
        return name, self.numbers(*next(parts), shape)

    def structure(self, parts: Iterator[tuple[int, memoryview]], depth: int) -> Mapping[str, Any]:
        (width,) = struct.unpack_from(self.order + "i", next(parts)[1])
        names = bytes(next(parts)[1])
        if width < 1:
            raise ValueError(f"field names of {width} bytes")
        starts = range(0, len(names), width)
        labels = (names[at : at + width].split(b"\0")[0].decode("ascii", "replace") for at in starts)
        fields = ((label, self.array(part, depth - 1)[1]) for label, (_, part) in zip(labels, parts, strict=False))
        return {label: value for label, value in fields if value is not None}

    def numbers(self, kind: int, content: memoryview, shape: tuple[int, ...]) -> NDArray[Any]:
        if kind not in CODES5:
            raise ValueError(f"values of unknown type {kind}")
        return np.frombuffer(content, self.order + CODES5[kind], prod(shape)).reshape(shape, order="F")


def _cut(path: Path, name: str, size: int, needed: int) -> TruncatedLog:
    """Error for a file that ends inside a variable."""
    return TruncatedLog(
        f"{path}: the file ends inside {name!r}: it has {size} bytes and needs at least {needed}, so that channel is "
        "lost for the whole flight; copy the log again from its recorder"
    )
