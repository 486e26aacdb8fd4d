"""How the aircraft itself moved, for the scene: attitude, and where it flew if that may be shown."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from logparsers.records import FlightLog
    from servofd.core.types import FloatArray

_ATTITUDES = (
    ("ATT.Roll", "ATT.Pitch", "ATT.Yaw"),
    ("ATTITUDE.roll", "ATTITUDE.pitch", "ATTITUDE.yaw"),
)
_QUATERNIONS = tuple(
    tuple(f"{topic}.q[{i}]" for i in range(4)) for topic in ("vehicle_attitude[0]", "vehicle_attitude")
)
_POSITIONS = (
    ("POS.Lat", "POS.Lng", "POS.Alt"),
    ("GPS[0].Lat", "GPS[0].Lng", "GPS[0].Alt"),
    ("GPS.Lat", "GPS.Lng", "GPS.Alt"),
    ("GLOBAL_POSITION_INT.lat", "GLOBAL_POSITION_INT.lon", "GLOBAL_POSITION_INT.alt"),
    ("vehicle_gps_position[0].lat", "vehicle_gps_position[0].lon", "vehicle_gps_position[0].alt"),
    ("vehicle_gps_position[0].latitude_deg", "vehicle_gps_position[0].longitude_deg", "vehicle_gps_position[0].alt"),
)
_PERIOD_S = 0.1
_EARTH_RADIUS_M = 6_371_008.8
"""Mean radius, IUGG."""
_WHOLE_DEGREES = 1e-7
"""Messages hold latitude and longitude in 1e-7 deg, altitude in mm."""


def attitude_of(log: FlightLog) -> FloatArray | None:
    """Time [s], roll, pitch and yaw [deg], of shape (n, 4), at most ten a second; None if the log has none."""
    found = _together(log, _ATTITUDES)
    if found is not None:
        names, rows = found
        if log[names[0]].unit == "rad":
            rows[:, 1:] = np.degrees(rows[:, 1:])
        return rows
    found = _together(log, _QUATERNIONS)
    return None if found is None else _euler(found[1])


def geo_of(log: FlightLog) -> FloatArray | None:
    """Time [s], latitude, longitude [deg] and altitude [m], of shape (n, 4); None if the log has none."""
    found = _together(log, _POSITIONS) or _together(log, tuple(names[:2] for names in _POSITIONS))
    if found is None:
        return None
    names, rows = found
    scale = _WHOLE_DEGREES if np.max(np.abs(rows[:, 1:3])) > 360.0 else 1.0
    height_m = rows[:, 3] if rows.shape[1] > 3 else np.zeros(len(rows))
    if rows.shape[1] > 3 and scale != 1.0 and log[names[2]].unit != "m":
        height_m = height_m * 1e-3
    placed = np.column_stack([rows[:, 0], rows[:, 1:3] * scale, height_m])
    # Receivers report 0, 0 until they have a fix.
    placed = placed[np.any(placed[:, 1:3] != 0.0, axis=1)]
    return placed if len(placed) > 1 else None


def local_of(geo: FloatArray) -> FloatArray:
    """Time [s], east, north and up from the first fix [m], of shape (n, 4): the flight without the place.

    Examples
    --------
    >>> local_of(np.array([[0.0, 60.0, 10.0, 5.0], [1.0, 60.001, 10.001, 7.0]])).round(1)[1].tolist()
    [1.0, 55.6, 111.2, 2.0]
    """
    moved = np.radians(geo[:, 1:3] - geo[0, 1:3])
    east_m = _EARTH_RADIUS_M * moved[:, 1] * np.cos(np.radians(geo[0, 1]))
    return np.column_stack([geo[:, 0], east_m, _EARTH_RADIUS_M * moved[:, 0], geo[:, 3] - geo[0, 3]])


def _together(log: FlightLog, choices: tuple[tuple[str, ...], ...]) -> tuple[tuple[str, ...], FloatArray] | None:
    """First set of channels that the log has, thinned: their names, and time and values of shape (n, 1 + k)."""
    for names in choices:
        if not all(name in log.channels for name in names):
            continue
        channels = [log[name] for name in names]
        if any(c.time_s.shape != channels[0].time_s.shape for c in channels):
            continue
        rows = np.column_stack([channels[0].time_s, *(c.values for c in channels)])
        rows = rows[np.all(np.isfinite(rows), axis=1)]
        rows = rows[np.flatnonzero(np.diff(np.floor(rows[:, 0] / _PERIOD_S), prepend=-np.inf))]
        if len(rows) > 1:
            return names, rows
    return None


def _euler(rows: FloatArray) -> FloatArray:
    """Quaternions (w, x, y, z) to roll, pitch and yaw [deg]."""
    w, x, y, z = rows[:, 1:].T
    roll = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return np.column_stack([rows[:, 0], np.degrees([roll, pitch, yaw]).T])
