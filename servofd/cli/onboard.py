"""``servofd onboard``: the surveillance as a script for ArduPilot itself."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from servofd.aircraft.schema import load_aircraft
from servofd.cli.terminal import check_targets, complain, say
from servofd.core.errors import ConfigError
from servofd.core.files import write_whole
from servofd.onboard.plan import outputs_of, plan_onboard
from servofd.onboard.script import stream_script, watch_script

if TYPE_CHECKING:
    from servofd.cli.options import Options


def run(options: Options) -> int:
    """Write the script."""
    check_targets([options.output], {"the aircraft file": [options.aircraft]})
    text, done, parameters = _streaming(options) if options.stream_only else _watching(options)
    write_whole(options.output, text.encode("ascii"))
    say(f"{options.output}: {done}. Copy it to APM/scripts on the SD card, set {parameters}, and reboot.")
    return 0


def _watching(options: Options) -> tuple[str, str, str]:
    if options.aircraft is None:
        raise ConfigError(
            "onboard needs an aircraft file: `servofd config` drafts one, `servofd calibrate` makes it good"
        )
    aircraft = load_aircraft(options.aircraft)
    plan = plan_onboard(aircraft, options.surface, rate_hz=options.rate_hz, instructions=options.instructions)
    for note in plan.notes:
        complain(f"{note}")
    watched = ", ".join(f"{one.surface} on output {one.output}" for one in plan.surfaces)
    parameters = f"SCR_ENABLE = 1 and SCR_HEAP_SIZE = {plan.heap_bytes} or more"
    return watch_script(plan, Path(options.output).name), f"watches {watched}", parameters


def _streaming(options: Options) -> tuple[str, str, str]:
    if options.aircraft is None:
        text = stream_script(range(1, 17), Path(options.output).name)
        return text, "sends SRVP1 to SRVP16 and SRVA1 to SRVA16, as far as servos answer", "SCR_ENABLE = 1"
    outputs = outputs_of(load_aircraft(options.aircraft), options.surface)
    names = ", ".join(f"SRVP{output} and SRVA{output}" for output in outputs)
    return stream_script(outputs, Path(options.output).name), f"sends {names}", "SCR_ENABLE = 1"
