"""Flight modes of an autopilot: when it changed them, and what they are called."""

from __future__ import annotations

import numpy as np

from logparsers.mavlink import enum_name
from logparsers.records import FlightLog

_PX4_STATES = {
    **dict(enumerate(("manual", "altitude", "position", "mission", "hold", "return", "position slow"))),
    **dict(enumerate(("acro", "", "descend", "termination", "offboard", "stabilized"), start=10)),
    **dict(enumerate(("takeoff", "land", "follow target", "precision land", "orbit", "vtol takeoff"), start=17)),
}
"""``NAVIGATION_STATE_`` of PX4-Autopilot's ``msg/VehicleStatus.msg``."""
_PX4_MAIN = {1: "manual", 2: "altitude", 3: "position", 5: "acro", 6: "offboard", 7: "stabilized"}
"""``PX4_CUSTOM_MAIN_MODE_`` of PX4-Autopilot's ``px4_custom_mode.h``: the third byte of ``custom_mode``."""
_PX4_AUTO_MAIN = 4
"""Main mode in which the sub mode says what the autopilot does (``PX4_CUSTOM_MAIN_MODE_AUTO``)."""
_PX4_AUTO = {2: "takeoff", 3: "hold", 4: "mission", 5: "return", 6: "land", 8: "follow target", 9: "precision land"}
"""``PX4_CUSTOM_SUB_MODE_AUTO_`` of the same file: the highest byte, where the main mode is `_PX4_AUTO_MAIN`."""
_CHANNELS = ("MODE.ModeNum", "vehicle_status[0].nav_state", "HEARTBEAT.custom_mode")
_COPTERS = ("quad", "hexa", "octo", "tri", "deca", "dodeca", "coaxial", "multirotor", "helicopter")
_ENUMS = {"ground rover": "ROVER_MODE", "surface boat": "ROVER_MODE", "submarine": "SUB_MODE"}
"""ArduPilot has one list of modes for each kind of vehicle."""


def modes_of(log: FlightLog) -> list[tuple[float, str]]:
    """Time [s] of each change of the flight mode, the first one included, and the mode's name.

    Examples
    --------
    >>> import logparsers
    >>> [(round(at_s, 1), mode) for at_s, mode in modes_of(logparsers.read("sample_logs/telemetry_stuck.tlog"))]
    [(0.0, 'AUTO')]
    """
    name = next((one for one in _CHANNELS if one in log.channels), None)
    if name is None or not (channel := log[name]).values.size:
        return []
    numbers = channel.values.astype(np.int64)
    changed = np.flatnonzero(np.diff(numbers, prepend=numbers[0] - 1))
    return [(float(channel.time_s[k]), _name(int(numbers[k]), name, log)) for k in changed]


def _name(number: int, channel: str, log: FlightLog) -> str:
    if channel.endswith("nav_state"):
        return _PX4_STATES.get(number, f"state {number}")
    if log.firmware.startswith("PX4"):
        main = number >> 16 & 0xFF
        known = _PX4_AUTO.get(number >> 24) if main == _PX4_AUTO_MAIN else _PX4_MAIN.get(main)
        return known or f"mode {number}"
    kind = "COPTER_MODE" if log.vehicle.startswith(_COPTERS) else _ENUMS.get(log.vehicle, "PLANE_MODE")
    name = enum_name(kind, number)
    return f"mode {number}" if name.startswith(kind) else name.replace("fly by wire ", "fbw").upper()
