"""``servofd config``: an aircraft file drafted from a log."""

from __future__ import annotations

import argparse
from typing import Any


def add_parser(verbs: argparse._SubParsersAction[Any]) -> None:
    """Declare the verb."""
    parser = verbs.add_parser(
        "config",
        help="draft an aircraft file from a log",
        description="Prints a commented aircraft file: the surfaces of the log, each with a servo fitted to it.",
        epilog="Example: servofd config flight.bin > my_plane.toml && servofd audit flight.bin -c my_plane.toml",
    )
    parser.add_argument("log", metavar="LOG", help="ArduPilot .bin or .log, MAVLink .tlog, PX4 .ulg, or a plain table")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Print the draft."""
    from servofd.core.errors import NoMeasurement
    from servofd.feedback.draft import draft_aircraft
    from servofd.feedback.flown import flown_aircraft, one_log
    from servofd.feedback.toml import draft_to_toml, fitted_to_toml

    # Of what was booted more than once, the longest flight tells most.
    log = max(one_log(options.log).by_boots(), key=lambda flight: flight.duration_s)
    if log.is_of_autopilot:
        print(draft_to_toml(draft_aircraft(log)), end="")
    elif log.format == "faser":
        raise NoMeasurement(f"{log.label}: FASER logs have their aircraft file: configs/faser.toml")
    else:
        aircraft = flown_aircraft(log, None)
        if all(surface.model.origin == "none" for surface in aircraft.surfaces.values()):
            raise NoMeasurement(
                f"{log.label}: no servo can be fitted to {', '.join(aircraft.surfaces)}: record commands and positions "
                "of a flight in which they move"
            )
        print(fitted_to_toml(log, aircraft), end="")
    return 0
