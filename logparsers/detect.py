"""Which format is this? Decided by the first bytes, never by the name of the file."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
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

Test = Callable[[bytes], object]
Reader = Callable[["Source", TableLayout | None, "Only"], "tuple[FlightLog, ...]"]

A_LOG = "give a flight log"
A_TABLE = "CSV with time_s, <surface>_cmd_deg and <surface>_pos_deg"
RECORDING = (b"RRF", b"RRIO")
"""How recordings of Rerun begin."""
FMT_RECORD = b"\xa3\x95\x80"
FMT_LINE = rb"FMT, ?\d+, ?\d+, ?\w"
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


def _begins(pattern: bytes) -> Test:
    """The file begins with what a regular expression describes; a dot is any byte."""
    return re.compile(pattern, re.DOTALL).match


def _is_document(beginnings: bytes) -> Test:
    return _begins(rb"(?i:(?:\xef\xbb\xbf)?\s*(?:" + beginnings + rb"))")


def _is_level4(head: bytes) -> bool:
    header = header4(head) if len(head) >= HEADER4 else None
    if header is None:
        return False
    name = head[HEADER4 : HEADER4 + header.name_bytes]
    return name[:1].isalpha() and name.rstrip(b"\0").replace(b"_", b"0").isalnum()


def _is_sdlog2(head: bytes) -> bool:
    """Like ArduPilot's, but time has messages of its own, and none of the others a stamp."""
    first_is_attitude = head[5:9] == b"ATT\0" and b"Time" not in head[25:89]
    return head.startswith(FMT_RECORD) and (first_is_attitude or b"StartTime" in head)


def _is_settings(headings: bytes) -> Test:
    """TOML: its first line that is no comment gives a key or a heading, and one of these headings follows."""
    line = rb"(?:\xef\xbb\xbf)?(?:[ \t]*(?:#[^\n]*)?\r?\n)*(?=[\w-]+[ \t]*=|\[)"
    return _begins(line + rb"(?:.*\n)?\[\[?(?:" + headings + rb")[.\]]")


def _has_control(head: bytes) -> bool:
    """Text but for control characters in its first line."""
    line = head.split(b"\n")[0]
    return b"\n" in head and b"," in line and _is_text(re.sub(rb"[\x01-\x1f]", b"", line)) and b"\0" not in line


def _is_text(head: bytes) -> bool:
    """No control character in the first line."""
    line = head.lstrip(b"\r\n")[:64].split(b"\n")[0]
    return not any(c < 32 and c not in b"\t\f\r" for c in line)


def _has_dataflash(head: bytes) -> bool:
    """The definition of a message stands behind damage or a comment."""
    return FMT_RECORD in head or re.search(rb"(?:^|\n)" + FMT_LINE, head) is not None


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


def _of_autopilot(kind: str) -> Reader:
    """Make a reader of ``read_<kind>`` in the package of that name, which takes a while to import."""

    def reading(source: Source, _: TableLayout | None, only: Only) -> tuple[FlightLog, ...]:
        return (getattr(import_module(f"logparsers.{kind}"), f"read_{kind}")(source, only),)

    return reading


_dataflash, _telemetry, _ulog = map(_of_autopilot, ("dataflash", "telemetry", "ulog"))


FORMATS = (
    Format("HDF5 (MATLAB 7.3, RAPTRS)", _begins(rb"(?:.{512}|.{1024}|.{2048})?\x89HDF\r\n\x1a\n"), read_hdf5),
    Format("MATLAB level 5", _begins(rb"MATLAB 5\.0"), read_level5),
    Format("PNG image", _begins(rb"\x89PNG"), A_LOG),
    Format("JPEG image", _begins(rb"\xff\xd8\xff"), A_LOG),
    Format("PDF document", _begins(rb"%PDF"), A_LOG),
    Format(
        "tar, 7z, RAR or Zstandard archive",
        _begins(rb".{257}ustar|7z\xbc\xaf\x27\x1c|Rar!\x1a\x07|\x28\xb5\x2f\xfd"),
        "unpack it; .gz, .bz2, .xz and .zip are read",
    ),
    Format("UTF-16 text", _begins(rb"\xff\xfe|\xfe\xff"), "save it as UTF-8"),
    Format("ROS bag", _begins(rb"#ROSBAG"), "export each topic with rostopic echo -b BAG -p TOPIC > TOPIC.csv"),
    Format("MCAP recording", _begins(rb"\x89MCAP"), f"export its topics to {A_TABLE}"),
    Format("SQLite database, as ROS 2 bags are", _begins(rb"SQLite format 3\0"), f"export its topics to {A_TABLE}"),
    Format("Betaflight blackbox log", _begins(rb"H Product:Blackbox"), "it has no servo positions; log those"),
    Format(
        "DJI flight record", _begins(rb".{16}BUILD|.{0,505}DJI_LOG"), f"export it with a DJI log converter to {A_TABLE}"
    ),
    Format("web page", _is_document(rb"<!doctype html|<html|<head"), "download the log itself, not the page around it"),
    Format("pointer of Git LFS", _begins(rb"version https://git-lfs"), "fetch the log itself with git lfs pull"),
    Format("XML document, as GPX and KML are", _is_document(rb"<\?xml|<gpx|<kml"), A_LOG),
    Format("JSON document", _is_document(rb"\{|\[[{\[]"), f"save it as {A_TABLE}"),
    Format("mission of a ground station", _begins(rb"QGC WPL"), A_LOG),
    Format("TOML file of an aircraft", _is_settings(rb"surfaces|motion"), "give it with -c, beside a log"),
    Format("TOML file of a servo", _is_settings(rb"servos"), "give it with --servo, beside a log"),
    Format(
        "file of parameters",
        _begins(
            rb"# (?:Onboard parameters|Vehicle-Id)"
            rb"|(?:#[^\n]*\n)*(?:[A-Z][A-Z0-9]+_[A-Z0-9_]+[ \t]*[,=\t ][ \t]*-?[\d.]+\s*?\n){2}"
        ),
        "give the log of a flight, which holds them too",
    ),
    Format("storage of ArduPilot's parameters (eeprom.bin)", _begins(rb"PA\x06\0"), A_LOG),
    Format("Rerun recording", _begins(b"|".join(RECORDING)), "servofd review reads it back"),
    Format("NumPy array", _begins(rb"\x93NUMPY"), f"save it as {A_TABLE}"),
    Format("Python pickle", _begins(rb"\x80[\x02-\x05]"), f"it may run programs; save it as {A_TABLE}"),
    Format("Parquet table", _begins(rb"PAR1"), f"save it as {A_TABLE}"),
    Format("Excel or OLE document", _begins(rb"\xd0\xcf\x11\xe0"), f"save it as {A_TABLE}"),
    Format("PX4 log of before 2016 (sdlog2)", _is_sdlog2, f"export it with sdlog2_dump.py to {A_TABLE}"),
    Format("ArduPilot DataFlash log", _begins(rb"\xa3\x95|\n?" + FMT_LINE), _dataflash),
    Format("PX4 ULog", _begins(rb"ULog"), _ulog),
    Format("MAVLink telemetry log", _is_telemetry, _telemetry),
    Format("MATLAB level 4", _is_level4, read_level4),
    Format("damaged ArduPilot DataFlash log", _has_dataflash, _dataflash),
    Format("damaged MAVLink telemetry log", _has_telemetry, _telemetry),
    Format("text table", _is_text, read_table),
    Format("text with control characters in its first line", _has_control, "take them out of the names"),
)
"""Tried from top to bottom: the first that matches takes the file, or refuses it with what to give instead."""


def detect(head: bytes, label: str) -> Reader:
    """Find the reader for a file."""
    for found in FORMATS:
        if found.matches(head):
            if not isinstance(found.read, str):
                return found.read
            raise UnknownFormat(f"{label}: is a {found.name}, which is no log to read; {found.read}")
    known = ", ".join(f.name for f in FORMATS if not isinstance(f.read, str) and not f.name.startswith("damaged"))
    first = head[:8].hex(" ")
    raise UnknownFormat(f"{label}: its first bytes ({first}) belong to no known format; this version reads {known}")
