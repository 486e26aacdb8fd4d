"""Numbers to which MAVLink gives a meaning, by the names that it gives them."""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum
from typing import TYPE_CHECKING, Any, Final

from numpy.typing import NDArray

if TYPE_CHECKING:
    import numpy as np

_PREFIXES: Final = {
    "Autopilot": "MAV_AUTOPILOT_",
    "Capability": "MAV_PROTOCOL_CAPABILITY_",
    "Command": "MAV_CMD_",
    "Component": "MAV_COMP_ID_",
    "Kind": "MAV_TYPE_",
    "ParameterType": "MAV_PARAM_TYPE_",
    "RemoteLogCommand": "MAV_REMOTE_LOG_DATA_BLOCK_",
    "Result": "MAV_RESULT_",
    "State": "MAV_STATE_",
}
"""Enumerations of MAVLink that are used: `Autopilot.PX4` is MAV_AUTOPILOT_PX4."""


def __getattr__(name: str) -> Any:  # noqa: ANN401 - pymavlink is untyped
    """One of these enumerations, out of pymavlink, which takes a while to import."""
    if name not in _PREFIXES:
        raise AttributeError(name)
    from logparsers.mavlink import constants

    return constants(_PREFIXES[name])


class Severity(IntEnum):
    """MAV_SEVERITY."""

    CRITICAL = 2
    ERROR = 3
    WARNING = 4
    NOTICE = 5
    INFO = 6


LONGEST_TEXT: Final = 50
"""Characters of one STATUSTEXT."""
NO_INDEX: Final = 65_535
"""Of a PARAM_VALUE that was sent because it changed, and not as part of a list."""
SIGNED: Final = 1
"""Flag of a MAVLink 2 frame that a signature follows."""
SIGNATURE_BYTES: Final = 13
"""Bytes of the signature at the end of a signed frame."""


MARKER_1, MARKER_2 = 0xFE, 0xFD
"""First byte of a frame of version 1, and of version 2."""
HEADER_1, HEADER_2, CHECK_BYTES = 6, 10, 2
"""Bytes of a header of version 1, of one of version 2, and of the check-sum behind the payload."""


def frame_bytes(data: bytes | NDArray[np.uint8], at: int) -> int:
    """Length of the frame that begins at a place, as its header tells it; 0 if none begins there."""
    if len(data) < at + 3 or data[at] not in (MARKER_1, MARKER_2):
        return 0
    if data[at] == MARKER_1:
        return HEADER_1 + int(data[at + 1]) + CHECK_BYTES
    return HEADER_2 + int(data[at + 1]) + CHECK_BYTES + SIGNATURE_BYTES * (int(data[at + 2]) & SIGNED)


def kind_of(vehicle: str, parameters: Mapping[str, float]) -> str:
    """Kind of an aircraft: the parameters of a fixed wing say whether it has motors that lift it."""
    lifts = vehicle == "fixed wing" and parameters.get("Q_ENABLE", 0.0) >= 1.0
    return "QuadPlane" if lifts else vehicle
