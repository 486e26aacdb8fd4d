"""Draws the picture of the monitor's view: the simulated flight with a jammed elevator, replayed."""

from __future__ import annotations

import io
import re
import sys
from pathlib import Path

from rich.console import Console

from logparsers.codec import Codec
from logparsers.replay import replayed
from servofd.aircraft.schema import load_aircraft, plain_aircraft
from servofd.live.session import Session
from servofd.live.view import View, event_line
from servofd.servo.faults import Stuck
from servofd.simulation.flight import simulate_flight
from servofd.simulation.pulses import outputs_of
from servofd.simulation.telemetry_writer import telemetry_log

_SHOWN_S = 24.0


def main(folder: Path) -> None:
    """Write ``monitor.svg``."""
    plane = plain_aircraft(["aileron", "elevator", "rudder"], "hs225bb-eq31")
    flight = simulate_flight(
        plane, rate_hz=40.0, duration_s=_SHOWN_S, seed=3, faults={"elevator": Stuck(20.0)}, outputs=outputs_of(plane)
    )
    session = Session(Codec(0, 191), {0: load_aircraft("simulated")})
    view = View(session, "udpin:127.0.0.1:14550")
    now_s = 0.0
    for number, (now_s, frame) in enumerate(replayed(telemetry_log(flight, plane))):
        events = session.take(now_s, frame)
        events += session.step(now_s) if number % 5 == 0 else []
        for event in events:
            view.note(event_line(event))
    console = Console(record=True, width=110, file=io.StringIO())
    console.print(view.drawn(now_s))
    svg = console.export_svg(title="servofd monitor", unique_id="monitor")
    # Fonts of the reader's machine will do; nothing is fetched.
    (folder / "monitor.svg").write_text(re.sub(r"@font-face \{.*?\}\s*", "", svg, flags=re.DOTALL))


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent / "monitor")
