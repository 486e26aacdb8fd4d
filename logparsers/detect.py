"""Which format is this? Decided by the first bytes, never by the name of the file."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from typing import TYPE_CHECKING

from logparsers.errors import UnknownFormat
from logparsers.faser import read_hdf5, read_level4, read_level5
from logparsers.matlab4 import header4
from logparsers.table import TableLayout, read_table

if TYPE_CHECKING:
    from logparsers.only import Only
    from logparsers.records import FlightLog
    from logparsers.source import Source

__all__ = ["FORMATS", "Format", "detect"]

Test = Callable[[bytes], bool]
Reader = Callable[["Source", TableLayout | None, "Only"], "tuple[FlightLog, ...]"]

HDF5 = b"\x89HDF\r\n\x1a\n"
FMT_RECORD, FMT_LINE = b"\xa3\x95\x80", re.compile(rb"(?:^|\n)FMT, ?\d+, ?\d+, ?\w")
FRAMES = 3
"""MAVLink frames one behind the other are no accident."""


@dataclass(frozen=True, slots=True)
class Format:
    """One format: how it is recognised, and who reads it.

    Parameters
    ----------
    name : str
        What people call it.
    matches : callable
        Does a file that starts with these bytes have it?
    read : callable or None
        Reader; None for a format that is only known well enough to say so.
    """

    name: str
    matches: Test
    read: Reader | None = None


def _starts(*signatures: bytes) -> Test:
    return lambda head: head.startswith(signatures)


def _is_hdf5(head: bytes) -> bool:
    """The signature stands first, or behind a block of the user's, as in MATLAB 7.3."""
    return any(head.startswith(HDF5, at) for at in (0, 512, 1024, 2048))


def _is_level4(head: bytes) -> bool:
    header = header4(head) if len(head) >= 20 else None
    if header is None:
        return False
    name = head[20 : 20 + header.name_bytes]
    return name[:1].isalpha() and name.rstrip(b"\0").replace(b"_", b"0").isalnum()


def _is_text(head: bytes) -> bool:
    """No control character in the first line."""
    line = head.lstrip(b"\r\n")[:64].split(b"\n")[0]
    return not any(c < 32 and c not in b"\t\f\r" for c in line)


def _is_dataflash(head: bytes) -> bool:
    """The definition of a message stands first, in binary or as text."""
    return head.startswith(FMT_RECORD[:2]) or FMT_LINE.match(head) is not None


def _has_dataflash(head: bytes) -> bool:
    """The definition of a message stands behind damage or a comment."""
    return FMT_RECORD in head or FMT_LINE.search(head) is not None


def _is_telemetry(head: bytes) -> bool:
    """MAVLink frames, each behind eight bytes of time as ground stations store them, or one after the other."""
    return any(_frames_on(head, stamp, stamp, 2) for stamp in (8, 0))


def _has_telemetry(head: bytes) -> bool:
    """Several frames in a row stand behind damage."""
    starts = [found.start() for found in re.finditer(rb"[\xfd\xfe]", head)]
    return any(_frames_on(head, at, stamp, FRAMES) for at in starts for stamp in (8, 0))


def _frames_on(head: bytes, at: int, stamp: int, number: int) -> bool:
    """That many frames begin at `at`, or all there is room for."""
    for _ in range(number):
        end = _frame_end(head, at)
        if not end:
            return False
        if end == len(head):
            return True
        at = end + stamp
    return True


def _frame_end(head: bytes, at: int) -> int:
    """Where the frame ends that starts here; 0 if none does."""
    magic, rest = head[at : at + 1], head[at + 1 : at + 3]
    if len(rest) < 2 or magic not in (b"\xfe", b"\xfd"):
        return 0
    return at + rest[0] + (8 if magic == b"\xfe" else 25 if rest[1] & 1 else 12)


def _eager(read: Callable[[Source, TableLayout | None], tuple[FlightLog, ...]]) -> Reader:
    """Make a reader of one that reads every channel anyway."""

    @wraps(read)
    def reading(source: Source, layout: TableLayout | None, only: Only) -> tuple[FlightLog, ...]:
        return tuple(log.only(only) for log in read(source, layout))

    return reading


def _dataflash(source: Source, _: TableLayout | None, only: Only) -> tuple[FlightLog, ...]:
    from logparsers.dataflash import read_dataflash

    return (read_dataflash(source, only),)


def _telemetry(source: Source, _: TableLayout | None, only: Only) -> tuple[FlightLog, ...]:
    from logparsers.telemetry import read_telemetry

    return (read_telemetry(source, only),)


def _ulog(source: Source, _: TableLayout | None, only: Only) -> tuple[FlightLog, ...]:
    from logparsers.ulog import read_ulog

    return (read_ulog(source, only),)


FORMATS = (
    Format("HDF5 (MATLAB 7.3, RAPTRS)", _is_hdf5, _eager(read_hdf5)),
    Format("MATLAB level 5", _starts(b"MATLAB 5.0"), _eager(read_level5)),
    Format("PNG image", _starts(b"\x89PNG")),
    Format("JPEG image", _starts(b"\xff\xd8\xff")),
    Format("PDF document", _starts(b"%PDF")),
    Format("ZIP archive", _starts(b"PK\x03\x04", b"PK\x05\x06")),
    Format("gzip archive", _starts(b"\x1f\x8b")),
    Format("UTF-16 text", _starts(b"\xff\xfe", b"\xfe\xff")),
    Format("ArduPilot DataFlash log", _is_dataflash, _dataflash),
    Format("PX4 ULog", _starts(b"ULog"), _ulog),
    Format("MAVLink telemetry log", _is_telemetry, _telemetry),
    Format("MATLAB level 4", _is_level4, _eager(read_level4)),
    Format("damaged ArduPilot DataFlash log", _has_dataflash, _dataflash),
    Format("damaged MAVLink telemetry log", _has_telemetry, _telemetry),
    Format("text table", _is_text, _eager(read_table)),
)
"""Tried from top to bottom; to add a format is to give its line a reader."""


def detect(head: bytes, label: str) -> Reader:
    r"""Find the reader for a file.

    Parameters
    ----------
    head : bytes
        Its first bytes.
    label : str
        Its name, for the message.

    Raises
    ------
    UnknownFormat
        If nothing here reads it; the message says what it is, as far as that is known.

    Examples
    --------
    >>> detect(b"time_s,elevator_cmd_deg\n", "flight.csv").__name__
    'read_table'
    >>> detect(b"\x89PNG\r\n", "flight.mat")  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    logparsers.errors.UnknownFormat: flight.mat: its format is PNG image, which cannot be read by this version; ...
    """
    known = ", ".join(f.name for f in FORMATS if f.read and not f.name.startswith("damaged"))
    for found in FORMATS:
        if found.matches(head):
            if found.read:
                return found.read
            raise UnknownFormat(
                f"{label}: its format is {found.name}, which cannot be read by this version; it reads {known}"
            )
    first = head[:8].hex(" ")
    raise UnknownFormat(f"{label}: its first bytes ({first}) belong to no known format; this version reads {known}")
