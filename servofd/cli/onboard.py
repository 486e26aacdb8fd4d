"""``servofd onboard``: the surveillance as a script for ArduPilot itself."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any


def add_parser(verbs: argparse._SubParsersAction[Any]) -> None:
    """Declare the verb."""
    parser = verbs.add_parser(
        "onboard",
        help="write the surveillance as a script that runs on an ArduPilot autopilot",
        description="Writes one Lua script for ArduPilot 4.6 or newer: it watches the servos of an aircraft file on "
        "the autopilot itself, tells the ground station which one fails, logs what it saw and sends the positions.",
        epilog="Example: servofd onboard plane.toml -o servofd.lua; then copy it to APM/scripts and set SCR_ENABLE = 1",
    )
    parser.add_argument(
        "aircraft",
        metavar="AIRCRAFT.toml",
        nargs="?",
        help="aircraft file, best a calibrated one; --stream-only does without",
    )
    parser.add_argument("-o", "--output", required=True, metavar="FILE.lua", help="the script")
    parser.add_argument("-s", "--surface", action="append", default=[], metavar="NAME", help="watch only this surface")
    parser.add_argument(
        "--stream-only", action="store_true", help="only send measured positions, for a log or a monitor on the ground"
    )
    parser.add_argument(
        "--rate-hz", type=float, default=50.0, metavar="HZ", help="how often each servo is looked at (default: 50)"
    )
    parser.add_argument(
        "--instructions",
        type=int,
        default=10_000,
        metavar="N",
        help="SCR_VM_I_COUNT of the autopilot, the instructions of one call (default: 10000, as ArduPilot's)",
    )
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Write the script."""
    from servofd.cli.targets import check_targets
    from servofd.core.files import write_whole

    check_targets([options.output], {"the aircraft file": [options.aircraft]})
    text, done = _streaming(options) if options.stream_only else _watching(options)
    write_whole(options.output, text.encode("ascii"))
    print(f"{options.output}: {done}. Copy it to APM/scripts on the SD card, set SCR_ENABLE = 1, and reboot.")
    return 0


def _watching(options: argparse.Namespace) -> tuple[str, str]:
    from servofd.aircraft.schema import load_aircraft
    from servofd.core.errors import ConfigError
    from servofd.onboard.plan import plan_onboard
    from servofd.onboard.script import watch_script

    if options.aircraft is None:
        raise ConfigError(
            "onboard needs an aircraft file: `servofd config` drafts one, `servofd calibrate` makes it good"
        )
    aircraft = load_aircraft(options.aircraft)
    plan = plan_onboard(aircraft, options.surface, rate_hz=options.rate_hz, instructions=options.instructions)
    for note in plan.notes:
        print(f"servofd: {note}", file=sys.stderr)
    watched = ", ".join(f"{one.surface} on output {one.output}" for one in plan.surfaces)
    return watch_script(plan, Path(options.output).name), f"watches {watched}"


def _streaming(options: argparse.Namespace) -> tuple[str, str]:
    from servofd.aircraft.schema import load_aircraft
    from servofd.onboard.plan import outputs_of
    from servofd.onboard.script import stream_script

    if options.aircraft is None:
        return stream_script(range(1, 17), Path(options.output).name), "sends SRVP1 to SRVP16, as far as servos answer"
    outputs = outputs_of(load_aircraft(options.aircraft), options.surface)
    names = ", ".join(f"SRVP{output}" for output in outputs)
    return stream_script(outputs, Path(options.output).name), f"sends {names}"
