"""Numbers to which MAVLink gives a meaning, by the names that it gives them."""

from __future__ import annotations

from enum import IntEnum, IntFlag
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Mapping


class Autopilot(IntEnum):
    """MAV_AUTOPILOT."""

    GENERIC = 0
    ARDUPILOTMEGA = 3
    INVALID = 8
    PX4 = 12


class Capability(IntFlag):
    """MAV_PROTOCOL_CAPABILITY."""

    PARAM_FLOAT = 2
    COMMAND_INT = 8
    PARAM_ENCODE_BYTEWISE = 16
    MAVLINK2 = 8192


class Command(IntEnum):
    """MAV_CMD."""

    GET_MESSAGE_INTERVAL = 510
    SET_MESSAGE_INTERVAL = 511
    REQUEST_MESSAGE = 512
    REQUEST_AUTOPILOT_CAPABILITIES = 520


class Component(IntEnum):
    """MAV_COMPONENT."""

    AUTOPILOT1 = 1


class Kind(IntEnum):
    """MAV_TYPE."""

    FIXED_WING = 1
    ANTENNA_TRACKER = 5
    GCS = 6
    ONBOARD_CONTROLLER = 18


class ParameterType(IntEnum):
    """MAV_PARAM_TYPE."""

    INT8 = 2
    INT16 = 4
    INT32 = 6
    REAL32 = 9


class RemoteLogCommand(IntEnum):
    """MAV_REMOTE_LOG_DATA_BLOCK_COMMANDS: what a client acknowledges to begin and to end."""

    STOP = 2_147_483_645
    START = 2_147_483_646


class Result(IntEnum):
    """MAV_RESULT."""

    ACCEPTED = 0
    DENIED = 2
    UNSUPPORTED = 3
    IN_PROGRESS = 5


class Severity(IntEnum):
    """MAV_SEVERITY."""

    CRITICAL = 2
    ERROR = 3
    WARNING = 4
    NOTICE = 5
    INFO = 6


class State(IntEnum):
    """MAV_STATE."""

    ACTIVE = 4
    CRITICAL = 5


NO_VEHICLES: Final = (Kind.GCS, Kind.ONBOARD_CONTROLLER, 26, 27, *range(30, 35), *range(36, 43), 44, 48)
"""MAV_TYPE of what sends heartbeats beside a vehicle: gimbals, receivers, cameras, batteries, winches, lamps."""
LONGEST_TEXT: Final = 50
"""Characters of one STATUSTEXT."""
NO_INDEX: Final = 65_535
"""Of a PARAM_VALUE that was sent because it changed, and not as part of a list."""
SIGNED: Final = 1
"""Flag of a MAVLink 2 frame that a signature follows."""
SIGNATURE_BYTES: Final = 13
"""Bytes of the signature at the end of a signed frame."""


def kind_of(vehicle: str, parameters: Mapping[str, float]) -> str:
    """Kind of an aircraft: one with motors that lift it says that it is a fixed wing, and its parameters that they do.

    Examples
    --------
    >>> kind_of("fixed wing", {"Q_ENABLE": 1.0}), kind_of("fixed wing", {"Q_ENABLE": 0.0})
    ('QuadPlane', 'fixed wing')
    """
    lifts = vehicle == "fixed wing" and parameters.get("Q_ENABLE", 0.0) >= 1.0
    return "QuadPlane" if lifts else vehicle
