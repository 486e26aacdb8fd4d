"""``servofd config``: an aircraft file drafted from a log."""

from __future__ import annotations

import argparse
from typing import Any


def add_parser(verbs: argparse._SubParsersAction[Any]) -> None:
    """Declare the verb."""
    parser = verbs.add_parser(
        "config",
        help="draft an aircraft file from an autopilot's log",
        description="Prints a commented aircraft file drafted from what the log says about its own servos.",
        epilog="Example: servofd config flight.bin > my_plane.toml && servofd audit flight.bin -c my_plane.toml",
    )
    parser.add_argument("log", metavar="LOG", help="ArduPilot .bin or .log, MAVLink .tlog, PX4 .ulg")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Print the draft."""
    from servofd.errors import NoMeasurement
    from servofd.feedback.draft import draft_aircraft
    from servofd.feedback.toml import draft_to_toml
    from servofd.job import one_log

    log = one_log(options.log)
    if not log.is_of_autopilot:
        raise NoMeasurement(
            f"{log.label}: a {log.format} log does not describe its aircraft; start from configs/faser.toml"
        )
    print(draft_to_toml(draft_aircraft(log)), end="")
    return 0
