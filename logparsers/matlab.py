"""MATLAB files of level 4 and level 5: bytes to numeric vectors, every size checked before it is believed.

Level 4 is one 20-byte header, a name and one column after the other. Level 5 (and 7, its compressed form) is a sequence
of tagged elements; numbers and structures of them are read, everything else in the file is passed over.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from math import prod
from typing import TYPE_CHECKING

import numpy as np

from logparsers.errors import TruncatedLog, UnreadableLog

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from logparsers.records import FloatArray

__all__ = ["Header4", "header4", "level4", "level5"]

CODES4 = ("f8", "f4", "i4", "i2", "u2", "u1")
CODES5 = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
MATRIX, COMPRESSED = 14, 15
STRUCTURE, NUMERIC = 2, range(6, 16)
COMPLEX = 0x0800
DEEPEST = 16
"""Structures within structures; deeper ones are forged."""


@dataclass(frozen=True, slots=True)
class Header4:
    """Header of one level-4 variable.

    Parameters
    ----------
    dtype : str
        Byte order and type of the values, as numpy writes them.
    numeric : bool
        False for text and sparse matrices.
    shape : tuple of int
        Rows and columns.
    parts : int
        2 if an imaginary part follows the real one.
    name_bytes : int
        Length of the name with its closing NUL.
    """

    dtype: str
    numeric: bool
    shape: tuple[int, int]
    parts: int
    name_bytes: int


def header4(head: bytes) -> Header4 | None:
    """Read a level-4 header in whichever byte order makes sense, or None if neither does.

    Parameters
    ----------
    head : bytes
        At least 20 bytes.

    Examples
    --------
    >>> header4(struct.pack(">5i", 1010, 90000, 1, 0, 3))
    Header4(dtype='>f4', numeric=True, shape=(90000, 1), parts=1, name_bytes=3)
    >>> header4(b"time_s,elevator_cmd_deg") is None
    True
    """
    for order, machine in (("<", 0), (">", 1)):
        kind, rows, columns, imaginary, name_bytes = struct.unpack(order + "5i", head[:20])
        m, o, p, t = (kind // 10**k % 10 for k in (3, 2, 1, 0))
        sizes = rows >= 0 and columns >= 0 and imaginary in (0, 1) and 1 < name_bytes <= 256
        if 0 <= kind < 2000 and m == machine and o == 0 and p < len(CODES4) and t <= 2 and sizes:
            return Header4(order + CODES4[p], t == 0, (rows, columns), 1 + imaginary, name_bytes)
    return None


def level4(path: Path, content: bytes) -> dict[str, FloatArray]:
    r"""Decode every real vector of a level-4 file.

    Parameters
    ----------
    path : Path
        The file, for messages.
    content : bytes
        All of it.

    Returns
    -------
    dict of str to ndarray, shape (n,)
        By name, in the order of the file, native float64.

    Raises
    ------
    TruncatedLog
        If the file ends inside a variable.
    UnreadableLog
        If a header makes no sense.

    Examples
    --------
    >>> from pathlib import Path
    >>> level4(Path("a.mat"), struct.pack(">5i", 1030, 2, 1, 0, 3) + b"de\0" + struct.pack(">2h", 7, 8))
    {'de': array([7., 8.])}
    """
    found = {}
    at = 0
    while at < len(content):
        header = _header4_at(path, content, at)
        start = at + 20 + header.name_bytes
        name = content[at + 20 : start].rstrip(b"\0").decode("ascii", "replace")
        size = prod(header.shape)
        at = start + size * header.parts * np.dtype(header.dtype).itemsize
        if at > len(content):
            raise _cut(path, name, len(content), at)
        if header.numeric and header.parts == 1 and 1 in header.shape:
            found[name] = np.frombuffer(content, header.dtype, size, start).astype(np.float64)
    return found


def _header4_at(path: Path, content: bytes, at: int) -> Header4:
    if len(content) - at < 20:
        raise _cut(path, "the header of a variable", len(content), at + 20)
    header = header4(content[at : at + 20])
    if header is None:
        raise UnreadableLog(f"{path}: no MATLAB level-4 variable at byte {at}; copy the log again from its recorder")
    return header


def _cut(path: Path, name: str, size: int, needed: int) -> TruncatedLog:
    return TruncatedLog(
        f"{path}: the file ends inside {name!r}: it has {size} bytes and needs at least {needed}, so that channel is "
        "lost for the whole flight; copy the log again from its recorder"
    )


def level5(path: Path, content: bytes) -> dict[str, FloatArray]:
    """Decode every real vector of a level-5 file, also those inside structures.

    Parameters
    ----------
    path : Path
        The file, for messages.
    content : bytes
        All of it.

    Returns
    -------
    dict of str to ndarray, shape (n,)
        By path (``"flight/de"`` for the field ``de`` of the structure ``flight``), native float64.

    Raises
    ------
    TruncatedLog
        If the file ends inside a variable.
    struct.error, ValueError, zlib.error
        If the bytes make no sense.

    Examples
    --------
    >>> import io
    >>> from pathlib import Path
    >>> from scipy.io import savemat
    >>> file = io.BytesIO()
    >>> savemat(file, {"flight": {"de": np.array([0.5, 0.25])}})
    >>> level5(Path("a.mat"), file.getvalue())
    {'flight/de': array([0.5 , 0.25])}
    """
    order = "<" if content[126:128] == b"IM" else ">"
    found: dict[str, FloatArray] = {}
    at = 128
    while at < len(content):
        if len(content) - at < 8:
            raise _cut(path, "the header of a variable", len(content), at + 8)
        kind, size = struct.unpack_from(order + "2I", content, at)
        element = content[at + 8 : at + 8 + size]
        if at + 8 + size > len(content):
            raise _cut(path, _name5(element, kind, order), len(content), at + 8 + size)
        if kind == COMPRESSED:
            kind, element = _inflated(element, order)
        if kind == MATRIX:
            found.update(_matrix(element, order, "", DEEPEST))
        at += 8 + size
    return found


def _inflated(element: bytes, order: str) -> tuple[int, bytes]:
    matrix = zlib.decompress(element)
    kind, size = struct.unpack_from(order + "2I", matrix)
    if size > len(matrix) - 8:
        raise ValueError(f"a compressed variable holds {len(matrix) - 8} of {size} bytes")
    return kind, matrix[8 : 8 + size]


def _name5(element: bytes, kind: int, order: str) -> str:
    """Name of a variable of which only the beginning is left."""
    try:
        start = zlib.decompressobj().decompress(element, 512)[8:] if kind == COMPRESSED else element
        parts = _elements(start[:512], order)
        return [next(parts)[1] for _ in range(3)][2].decode("ascii", "replace")
    except (zlib.error, struct.error, StopIteration, ValueError):
        return "a variable"


def _elements(content: bytes, order: str) -> Iterator[tuple[int, bytes]]:
    at = 0
    while at + 8 <= len(content):
        kind, size = struct.unpack_from(order + "2I", content, at)
        small = kind >> 16  # size and type share four bytes, up to four bytes of data follow at once
        start, room = (at + 4, 4) if small else (at + 8, len(content) - at - 8)
        if small:
            kind, size = kind & 0xFFFF, small
        if size > room:
            raise ValueError(f"an element of {size} bytes does not fit into the {room} that are left")
        yield kind, content[start : start + size]
        at += 8 if small else 8 + (size + 7) // 8 * 8


def _matrix(content: bytes, order: str, prefix: str, depth: int) -> dict[str, FloatArray]:
    if not content:  # an empty field
        return {}
    if depth == 0:
        raise ValueError(f"more than {DEEPEST} structures within one another")
    parts = _elements(content, order)
    flags, dimensions, name = (next(parts)[1] for _ in range(3))
    (word,) = struct.unpack_from(order + "I", flags)
    shape = np.frombuffer(dimensions, order + "i4").tolist()
    label = prefix + name.decode("ascii", "replace")
    if word & 0xFF == STRUCTURE and prod(shape) == 1:
        return _structure(parts, order, label, depth)
    if word & 0xFF in NUMERIC and not word & COMPLEX and 0 < prod(shape) == max(shape):
        return {label: _vector(*next(parts), order, prod(shape))}
    return {}


def _structure(parts: Iterator[tuple[int, bytes]], order: str, label: str, depth: int) -> dict[str, FloatArray]:
    (width,) = struct.unpack_from(order + "i", next(parts)[1])
    names = next(parts)[1]
    if width < 1:
        raise ValueError(f"field names of {width} bytes")
    found: dict[str, FloatArray] = {}
    for start, (_, field) in zip(range(0, len(names), width), parts, strict=False):
        name = names[start : start + width].split(b"\0")[0].decode("ascii", "replace")
        inner = _matrix(field, order, "", depth - 1)  # fields carry no name of their own
        found.update({"/".join(filter(None, (label, name, key))): values for key, values in inner.items()})
    return found


def _vector(kind: int, content: bytes, order: str, size: int) -> FloatArray:
    if kind not in CODES5:
        raise ValueError(f"values of unknown type {kind}")
    return np.frombuffer(content, order + CODES5[kind], size).astype(np.float64)
