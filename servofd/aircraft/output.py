"""Which output of the autopilot turns a surface, as the names of its channels tell."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from servofd.aircraft.schema import Surface

_COMMANDS_OF_OUTPUT = re.compile(r"(?:.*:)?(?:RCOU\.C|RCO2\.C|RCO3\.C|SERVO_OUTPUT_RAW\.servo)(\d+)(?:_raw)?")
COMMANDS_OF_SERVO = re.compile(r"CSRV\[(\d+)\]\.PosCmd")
POSITIONS_FROM_0 = re.compile(r"CSRV\[(\d+)\]\.Pos")
POSITIONS_FROM_1 = re.compile(r"(?:.*:)?(?:NAMED_VALUE_FLOAT|NVF|NVAL)\[SRVP(\d+)\]\.[vV]alue")


def output_of(surface: Surface) -> int | None:
    """Number of the output that turns a surface, from 1, as it says or its channels tell; None if they do not.

    Examples
    --------
    >>> from servofd.aircraft.schema import load_aircraft
    >>> output_of(load_aircraft("simulated").surfaces["rudder"]), output_of(load_aircraft("faser").surfaces["rudder"])
    (4, None)
    """
    if surface.output is not None:
        return surface.output
    places = [(_COMMANDS_OF_OUTPUT, surface.command.channel, 0), (COMMANDS_OF_SERVO, surface.command.channel, 1)]
    if surface.measured is not None:
        places += [(POSITIONS_FROM_0, surface.measured.channel, 1), (POSITIONS_FROM_1, surface.measured.channel, 0)]
    for pattern, channel, base in places:
        match = pattern.fullmatch(channel)
        if match:
            return int(match[1]) + base
    return None
