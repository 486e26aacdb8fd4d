"""What a DataFlash log tells about the flight as a whole: parameters, texts, firmware, date."""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from logparsers.dataflash.formats import NUMBER, WORDS
from logparsers.records import Text

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from logparsers.dataflash.file import DataFlashFile

__all__ = ["ParameterChange", "firmware", "parameter_changes", "start_utc", "texts", "vehicle"]

GPS_EPOCH: Final = datetime(1980, 1, 6, tzinfo=UTC)
# Since that year, UTC is this much behind GPS time [s].
LEAP_SECONDS: Final = (
    (2017, 18),
    (2015.5, 17),
    (2012.5, 16),
    (2009, 15),
    (2006, 14),
    (0, 13),
)
FIX_3D: Final = 3
VEHICLES: Final = {
    "ArduPlane": "fixed wing", "ArduRover": "ground rover", "Rover": "ground rover", "ArduSub": "submarine",
    "AntennaTracker": "antenna tracker", "Blimp": "airship",
}  # fmt: skip
FRAMES: Final = {
    1: "quadrotor", 2: "hexarotor", 3: "octorotor", 4: "octorotor", 5: "hexarotor", 6: "helicopter", 7: "tricopter",
    8: "coaxial", 9: "coaxial", 10: "coaxial", 11: "helicopter", 12: "dodecarotor", 13: "helicopter",
}  # fmt: skip
FIRST_WEEK: Final = 1000  # before 1999 there was no autopilot


@dataclass(frozen=True, slots=True)
class ParameterChange:
    """A parameter got a value: at the start of the log, or later.

    Parameters
    ----------
    time_s : float
        Since boot [s]; NaN if the log does not say.
    name : str
        For example ``"SERVO1_TRIM"``.
    value : float
        As logged.
    """

    time_s: float
    name: str
    value: float


def parameter_changes(file: DataFlashFile) -> tuple[ParameterChange, ...]:
    """Follow the parameters through a log.

    Parameters
    ----------
    file : DataFlashFile
        The log.

    Returns
    -------
    tuple of ParameterChange
        In the order of the log; repetitions of the same value left out.
    """
    last: dict[str, float] = {}
    changes = []
    for time, name, value in _rows(file, "PARM", {"Name": WORDS, "Value": NUMBER}):
        if last.get(name) != value:
            last[name] = value
            changes.append(ParameterChange(time, name, value))
    return tuple(changes)


def texts(file: DataFlashFile, message: str, field: str) -> tuple[Text, ...]:
    """Collect a text column with its times.

    Parameters
    ----------
    file : DataFlashFile
        The log.
    message, field : str
        For example ``"MSG"``, ``"Message"``.

    Returns
    -------
    tuple of Text
        Empty if the log has no such column.
    """
    return tuple(Text(time, text) for time, text in _rows(file, message, {field: WORDS}))


def firmware(file: DataFlashFile) -> str:
    """Find the name and version of the firmware.

    Parameters
    ----------
    file : DataFlashFile
        The log.

    Returns
    -------
    str
        For example ``"ArduPlane V4.5.1 (1a2b3c4d)"``; empty if neither VER nor MSG has it.
    """
    said = (t.text for t in (*texts(file, "VER", "FWS"), *file.texts))
    return next((t for t in said if re.match(r"[A-Za-z][\w:]* V?\d+\.\d", t)), "")


def vehicle(file: DataFlashFile) -> str:
    """Tell what kind of aircraft it is, in MAVLink's words; the log itself names only the firmware.

    Parameters
    ----------
    file : DataFlashFile
        The log.

    Returns
    -------
    str
        For example ``"fixed wing"``; the name of a firmware that serves several kinds, ``""`` if it is unknown.
    """
    name = file.firmware.partition(" ")[0]
    if name in ("ArduCopter", "APM:Copter"):
        return FRAMES.get(int(file.parameters.get("FRAME_CLASS", 0.0)), "multirotor")
    return VEHICLES.get(name, name)


def start_utc(file: DataFlashFile) -> datetime | None:
    """Find out when the vehicle was booted.

    Parameters
    ----------
    file : DataFlashFile
        The log.

    Returns
    -------
    datetime or None
        By the first GPS message with a 3D fix; None without one.
    """
    layout = file.formats["GPS"] if file.count("GPS") else None
    if layout is None or layout.clock is None:
        return None
    week, ms = ("GWk", "GMS") if "GWk" in layout.fields else ("Week", "TimeMS")
    if not layout.has({week: NUMBER, ms: NUMBER, "Status": NUMBER}):
        return None
    rows = file.table("GPS", (week, ms, "Status"))
    fixed = np.flatnonzero((rows["Status"] >= FIX_3D) & (rows[week] > FIRST_WEEK) & ~file.suspect("GPS"))
    if not len(fixed):
        return None
    first = fixed[0]
    try:
        since_boot = timedelta(seconds=float(file.times_s("GPS")[first]))
        gps = GPS_EPOCH + timedelta(weeks=int(rows[week][first]), milliseconds=int(rows[ms][first]))
        year = gps.year + (gps.month - 1) / 12
        return gps - timedelta(seconds=next(s for since, s in LEAP_SECONDS if year >= since)) - since_boot
    except (OverflowError, ValueError):  # a damaged row: no such year, or no number
        return None


def _rows(file: DataFlashFile, name: str, fields: Mapping[str, bool]) -> Iterable[tuple[Any, ...]]:
    """Time [s] and columns, row by row; nothing if the log has no such columns."""
    layout = file.formats.get(name)
    if layout is None or not layout.has(fields):
        return ()
    rows = file.table(name, tuple(fields))
    return zip(file.times_s(name).tolist(), *(rows[f].tolist() for f in fields), strict=True)
