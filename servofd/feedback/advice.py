"""What a pilot would have to log so that a servo can be judged."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from logparsers.records import FlightLog

_ROTORCRAFT = frozenset(
    {"multirotor", "quadrotor", "hexarotor", "octorotor", "tricopter", "decarotor", "dodecarotor", "coaxial"}
)


_MOTION = (
    "healthy flights of four days tell what each axis loses: `servofd calibrate DAY1 DAY2 DAY3 DAY4 -o plane.toml`, "
    "then `servofd FLIGHT -c plane.toml`; for a verdict on each servo "
)


def what_to_log(log: FlightLog) -> str:
    """One sentence: how this kind of autopilot gets servo positions into its logs.

    Examples
    --------
    >>> from pathlib import Path
    >>> from logparsers import FlightLog
    >>> what_to_log(FlightLog(Path("a.ulg"), "ulog", {}))[:30]
    'send the positions as DEBUG_FL'
    """
    if log.vehicle in _ROTORCRAFT:
        return f"it is of a {log.vehicle}, which has no control surfaces: its outputs turn motors"
    if log.format == "ulog":
        return (
            "send the positions as DEBUG_FLOAT_ARRAY (name SRVP) and log debug topics (SDLOG_PROFILE bit 5); "
            "actuator_outputs and actuator_servos are commands"
        )
    motion = _MOTION if log.vehicle == "fixed wing" else ""
    if log.format == "tlog":
        return motion + (
            "send the positions as NAMED_VALUE_FLOAT SRVP1, SRVP2, ... in degrees: `servofd onboard --stream-only -o "
            "servofd.lua` writes the script, copy it to APM/scripts and set SCR_ENABLE = 1; or audit the autopilot's "
            "own .bin log; SERVO_OUTPUT_RAW is a command"
        )
    return motion + (
        "log its position: RCOU is a command; servos with feedback write CSRV: Volz (SERIALn_PROTOCOL = 14, "
        "SERVO_VOLZ_MASK) or DroneCAN (CAN_D1_PROTOCOL = 1, CAN_D1_UC_SRV_BM), with LOG_BITMASK including RC output"
    )
