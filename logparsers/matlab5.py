"""MATLAB level 5, and level 7, its compressed form: a sequence of tagged elements, each within the one around it.

Real vectors and structures of them are read; text, cells, objects and matrices are passed over.
"""

from __future__ import annotations

import struct
import zlib
from math import prod
from typing import TYPE_CHECKING

import numpy as np

from logparsers.matlab4 import cut

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from logparsers.records import FloatArray

__all__ = ["level5"]

CODES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
MATRIX, COMPRESSED = 14, 15
STRUCTURE, NUMERIC = 2, range(6, 16)
COMPLEX = 0x0800
DEEPEST = 16
"""Structures within structures; deeper ones are forged."""


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
            raise cut(path, "the header of a variable", len(content), at + 8)
        kind, size = struct.unpack_from(order + "2I", content, at)
        element = content[at + 8 : at + 8 + size]
        if at + 8 + size > len(content):
            raise cut(path, _name(element, kind, order), len(content), at + 8 + size)
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


def _name(element: bytes, kind: int, order: str) -> str:
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
    if kind not in CODES:
        raise ValueError(f"values of unknown type {kind}")
    return np.frombuffer(content, order + CODES[kind], size).astype(np.float64)
