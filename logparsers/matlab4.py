"""MATLAB level 4: one 20-byte header, a name and one column after the other, every size checked first."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from math import prod
from typing import TYPE_CHECKING

import numpy as np

from logparsers.errors import TruncatedLog, UnreadableLog

if TYPE_CHECKING:
    from pathlib import Path

    from logparsers.records import FloatArray

__all__ = ["Header4", "cut", "header4", "level4"]

CODES = ("f8", "f4", "i4", "i2", "u2", "u1")


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
        if 0 <= kind < 2000 and m == machine and o == 0 and p < len(CODES) and t <= 2 and sizes:
            return Header4(order + CODES[p], t == 0, (rows, columns), 1 + imaginary, name_bytes)
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
            raise cut(path, name, len(content), at)
        if header.numeric and header.parts == 1 and 1 in header.shape:
            found[name] = np.frombuffer(content, header.dtype, size, start).astype(np.float64)
    return found


def _header4_at(path: Path, content: bytes, at: int) -> Header4:
    if len(content) - at < 20:
        raise cut(path, "the header of a variable", len(content), at + 20)
    header = header4(content[at : at + 20])
    if header is None:
        raise UnreadableLog(f"{path}: no MATLAB level-4 variable at byte {at}; copy the log again from its recorder")
    return header


def cut(path: Path, name: str, size: int, needed: int) -> TruncatedLog:
    """Error for a file that ends inside a variable.

    Parameters
    ----------
    path : Path
        The file.
    name : str
        Name of the variable.
    size, needed : int
        Bytes in the file, and bytes that would complete the variable.

    Examples
    --------
    >>> from pathlib import Path
    >>> cut(Path("a.mat"), "de", 70, 88).args[0].split(",")[0]
    "a.mat: the file ends inside 'de': it has 70 bytes and needs at least 88"
    """
    return TruncatedLog(
        f"{path}: the file ends inside {name!r}: it has {size} bytes and needs at least {needed}, so that channel is "
        "lost for the whole flight; copy the log again from its recorder"
    )
