"""Which format is this? Decided by the first bytes, never by the name of the file."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from importlib import import_module
from typing import TYPE_CHECKING

from logparsers.errors import UnknownFormat
from logparsers.mat import HEADER4, header4
from logparsers.protocol import frame_bytes
from logparsers.table import TableLayout, read_table
from logparsers.variables import read_hdf5, read_level4, read_level5

if TYPE_CHECKING:
    from logparsers.only import Only
    from logparsers.records import FlightLog
    from logparsers.source import Source

Test = Callable[[bytes], bool]
Reader = Callable[["Source", TableLayout | None, "Only"], "tuple[FlightLog, ...]"]

A_LOG = "give a flight log"
A_TABLE = "CSV with time_s, <surface>_cmd_deg and <surface>_pos_deg"
HDF5 = b"\x89HDF\r\n\x1a\n"
RECORDING = (b"RRF", b"RRIO")
"""How recordings of Rerun begin."""
FMT_RECORD, FMT_LINE = b"\xa3\x95\x80", re.compile(rb"(?:^|\n)FMT, ?\d+, ?\d+, ?\w")
PARAMETERS = re.compile(rb"(?:#[^\n]*\n)*(?:[A-Z][A-Z0-9]+_[A-Z0-9_]+[ \t]*[,=\t ][ \t]*-?[\d.]+\s*?\n){2}")
TOML_LINE = re.compile(rb"(?:\xef\xbb\xbf)?(?:[ \t]*(?:#[^\n]*)?\r?\n)*(?:[\w-]+[ \t]*=|\[)")
QGC_PARAMETERS = re.compile(rb"# (?:Onboard parameters|Vehicle-Id)")
FRAMES = 3
"""MAVLink frames one behind the other are no accident."""


@dataclass(frozen=True, slots=True)
class Format:
    """One format: how it is recognised, and who reads it.

    `name`: what people call it. `matches`: does a file that starts with these bytes have it? `read`: reader; of a
    format that is recognised but not read, what to give instead.
    """

    name: str
    matches: Test
    read: Reader | str


def _starts(*signatures: bytes) -> Test:
    return lambda head: head.startswith(signatures)


def _is_hdf5(head: bytes) -> bool:
    """The signature stands first, or behind a block of the user's, as in MATLAB 7.3."""
    return any(head.startswith(HDF5, at) for at in (0, 512, 1024, 2048))


def _is_level4(head: bytes) -> bool:
    header = header4(head) if len(head) >= HEADER4 else None
    if header is None:
        return False
    name = head[HEADER4 : HEADER4 + header.name_bytes]
    return name[:1].isalpha() and name.rstrip(b"\0").replace(b"_", b"0").isalnum()


def _is_foreign_archive(head: bytes) -> bool:
    return head[257:262] == b"ustar" or head.startswith((b"7z\xbc\xaf\x27\x1c", b"Rar!\x1a\x07", b"\x28\xb5\x2f\xfd"))


def _is_dji(head: bytes) -> bool:
    return head[16:21] == b"BUILD" or b"DJI_LOG" in head[:512]


def _is_sdlog2(head: bytes) -> bool:
    """Like ArduPilot's, but time has messages of its own, and none of the others a stamp."""
    first_is_attitude = head[5:9] == b"ATT\0" and b"Time" not in head[25:89]
    return head.startswith(FMT_RECORD) and (first_is_attitude or b"StartTime" in head)


def _is_document(*beginnings: bytes) -> Test:
    return lambda head: head.removeprefix(b"\xef\xbb\xbf").lstrip()[:16].lower().startswith(beginnings)


def _is_parameters(head: bytes) -> bool:
    return PARAMETERS.match(head) is not None or QGC_PARAMETERS.match(head) is not None


def _is_settings(*headings: bytes) -> Test:
    """TOML: its first line that is no comment gives a key or a heading, and one of these headings follows."""
    wanted = re.compile(rb"^\[\[?(?:" + b"|".join(headings) + rb")[.\]]", re.MULTILINE)

    def matches(head: bytes) -> bool:
        return TOML_LINE.match(head) is not None and wanted.search(head) is not None

    return matches


def _is_pickle(head: bytes) -> bool:
    return head[:1] == b"\x80" and head[1:2] in (b"\x02", b"\x03", b"\x04", b"\x05") and not _is_text(head)


def _has_control(head: bytes) -> bool:
    """Text but for control characters in its first line."""
    line = head.split(b"\n")[0]
    return b"\n" in head and b"," in line and _is_text(re.sub(rb"[\x01-\x1f]", b"", line)) and b"\0" not in line


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
        size = frame_bytes(head, at)
        if not size or at + size == len(head):
            return size > 0
        at += size + stamp
    return True


def _eager(read: Callable[[Source, TableLayout | None], tuple[FlightLog, ...]]) -> Reader:
    """Make a reader of one that reads every channel anyway."""

    @wraps(read)
    def reading(source: Source, layout: TableLayout | None, only: Only) -> tuple[FlightLog, ...]:
        return tuple(log.only(only) for log in read(source, layout))

    return reading


def _of_autopilot(kind: str) -> Reader:
    """Make a reader of ``read_<kind>`` in the package of that name, which takes a while to import."""

    def reading(source: Source, _: TableLayout | None, only: Only) -> tuple[FlightLog, ...]:
        return (getattr(import_module(f"logparsers.{kind}"), f"read_{kind}")(source, only),)

    return reading


_dataflash, _telemetry, _ulog = map(_of_autopilot, ("dataflash", "telemetry", "ulog"))


read_text = _eager(read_table)

FORMATS = (
    Format("HDF5 (MATLAB 7.3, RAPTRS)", _is_hdf5, read_hdf5),
    Format("MATLAB level 5", _starts(b"MATLAB 5.0"), read_level5),
    Format("PNG image", _starts(b"\x89PNG"), A_LOG),
    Format("JPEG image", _starts(b"\xff\xd8\xff"), A_LOG),
    Format("PDF document", _starts(b"%PDF"), A_LOG),
    Format("tar, 7z, RAR or Zstandard archive", _is_foreign_archive, "unpack it; .gz, .bz2, .xz and .zip are read"),
    Format("UTF-16 text", _starts(b"\xff\xfe", b"\xfe\xff"), "save it as UTF-8"),
    Format("ROS bag", _starts(b"#ROSBAG"), "export each topic with rostopic echo -b BAG -p TOPIC > TOPIC.csv"),
    Format("MCAP recording", _starts(b"\x89MCAP"), f"export its topics to {A_TABLE}"),
    Format("SQLite database, as ROS 2 bags are", _starts(b"SQLite format 3\0"), f"export its topics to {A_TABLE}"),
    Format(
        "Betaflight blackbox log",
        _starts(b"H Product:Blackbox"),
        "it has no servo positions; log those",
    ),
    Format("DJI flight record", _is_dji, f"export it with a DJI log converter to {A_TABLE}"),
    Format(
        "web page",
        _is_document(b"<!doctype html", b"<html", b"<head"),
        "download the log itself, not the page around it",
    ),
    Format("pointer of Git LFS", _starts(b"version https://git-lfs"), "fetch the log itself with git lfs pull"),
    Format("XML document, as GPX and KML are", _is_document(b"<?xml", b"<gpx", b"<kml"), A_LOG),
    Format("JSON document", _is_document(b"{", b"[{", b"[["), f"save it as {A_TABLE}"),
    Format("mission of a ground station", _starts(b"QGC WPL"), A_LOG),
    Format("TOML file of an aircraft", _is_settings(b"surfaces", b"motion"), "give it with -c, beside a log"),
    Format("TOML file of a servo", _is_settings(b"servos"), "give it with --servo, beside a log"),
    Format("file of parameters", _is_parameters, "give the log of a flight, which holds them too"),
    Format("storage of ArduPilot's parameters (eeprom.bin)", _starts(b"PA\x06\0"), A_LOG),
    Format("Rerun recording", _starts(*RECORDING), "servofd review reads it back"),
    Format("NumPy array", _starts(b"\x93NUMPY"), f"save it as {A_TABLE}"),
    Format("Python pickle", _is_pickle, f"it may run programs; save it as {A_TABLE}"),
    Format("Parquet table", _starts(b"PAR1"), f"save it as {A_TABLE}"),
    Format("Excel or OLE document", _starts(b"\xd0\xcf\x11\xe0"), f"save it as {A_TABLE}"),
    Format("PX4 log of before 2016 (sdlog2)", _is_sdlog2, f"export it with sdlog2_dump.py to {A_TABLE}"),
    Format("ArduPilot DataFlash log", _is_dataflash, _dataflash),
    Format("PX4 ULog", _starts(b"ULog"), _ulog),
    Format("MAVLink telemetry log", _is_telemetry, _telemetry),
    Format("MATLAB level 4", _is_level4, read_level4),
    Format("damaged ArduPilot DataFlash log", _has_dataflash, _dataflash),
    Format("damaged MAVLink telemetry log", _has_telemetry, _telemetry),
    Format("text table", _is_text, read_text),
    Format("text with control characters in its first line", _has_control, "take them out of the names"),
)
"""Tried from top to bottom; to add a format is to give its line a reader."""


def detect(head: bytes, label: str) -> Reader:
    r"""Find the reader for a file.

    Examples
    --------
    >>> detect(b"time_s,elevator_cmd_deg\n", "flight.csv").__name__
    'read_table'
    >>> detect(b"\x89PNG\r\n", "flight.mat")
    Traceback (most recent call last):
    logparsers.errors.UnknownFormat: flight.mat: is a PNG image, which is no log to read; give a flight log
    """
    for found in FORMATS:
        if found.matches(head):
            if not isinstance(found.read, str):
                return found.read
            raise UnknownFormat(f"{label}: is a {found.name}, which is no log to read; {found.read}")
    known = ", ".join(f.name for f in FORMATS if not isinstance(f.read, str) and not f.name.startswith("damaged"))
    first = head[:8].hex(" ")
    raise UnknownFormat(f"{label}: its first bytes ({first}) belong to no known format; this version reads {known}")
