"""``servofd config``: an aircraft file drafted from a log."""

from __future__ import annotations

from typing import TYPE_CHECKING

from servofd.cli.terminal import say
from servofd.core.errors import NoMeasurement
from servofd.feedback.draft import draft_aircraft, draft_to_toml, fitted_to_toml
from servofd.feedback.flown import flown_aircraft, one_log

if TYPE_CHECKING:
    from servofd.cli.options import Options


def run(options: Options) -> int:
    """Print the draft."""
    # Of what was booted more than once, the longest flight tells most.
    log = max(one_log(options.log).by_boots(), key=lambda flight: flight.duration_s)
    if log.is_of_autopilot:
        say(draft_to_toml(draft_aircraft(log)), end="")
    elif log.format == "faser":
        raise NoMeasurement(f"{log.label}: FASER logs have their aircraft file: configs/faser.toml")
    else:
        aircraft = flown_aircraft(log)
        if not any(surface.model.predicts for surface in aircraft.surfaces.values()):
            raise NoMeasurement(
                f"{log.label}: no servo can be fitted to {', '.join(aircraft.surfaces)}: record commands and positions "
                "of a flight in which they move"
            )
        say(fitted_to_toml(log, aircraft), end="")
    return 0
