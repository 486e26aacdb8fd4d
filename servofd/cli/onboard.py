"""``servofd onboard``: the surveillance as a script for ArduPilot itself."""

from __future__ import annotations

from pathlib import Path

from servofd.aircraft.schema import load_aircraft
from servofd.cli.options import Options
from servofd.cli.terminal import check_targets, complain, say
from servofd.core.errors import ConfigError
from servofd.core.files import write_whole
from servofd.onboard.plan import outputs_of, plan_onboard
from servofd.onboard.script import stream_script, watch_script


def run(options: Options) -> int:
    """Write the script."""
    check_targets([options.output], {"the aircraft file": [options.aircraft]})
    aircraft = None if options.aircraft is None else load_aircraft(options.aircraft)
    name, parameters = Path(options.output).name, "SCR_ENABLE = 1"
    if options.stream_only:
        outputs = range(1, 17) if aircraft is None else outputs_of(aircraft, options.surface)
        text = stream_script(outputs, name)
        done = f"sends {', '.join(f'SRVP{output} and SRVA{output}' for output in outputs)}"
        if aircraft is None:
            done = "sends SRVP1 to SRVP16 and SRVA1 to SRVA16, as far as servos answer"
    elif aircraft is None:
        how = "`servofd config` drafts one, `servofd calibrate` makes it good"
        raise ConfigError(f"onboard needs an aircraft file: {how}")
    else:
        plan = plan_onboard(aircraft, options.surface, rate_hz=options.rate_hz, instructions=options.instructions)
        for note in plan.notes:
            complain(f"{note}")
        done = f"watches {', '.join(f'{one.surface} on output {one.output}' for one in plan.surfaces)}"
        text, parameters = watch_script(plan, name), f"{parameters} and SCR_HEAP_SIZE = {plan.heap_bytes} or more"
    write_whole(options.output, text.encode("ascii"))
    say(f"{options.output}: {done}. Copy it to APM/scripts on the SD card, set {parameters}, and reboot.")
    return 0
