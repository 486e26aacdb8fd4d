"""``servofd simulate --stream``: the simulated vehicle on a live link."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from servofd.cli.signing import signature_of

if TYPE_CHECKING:
    import argparse

    from servofd.aircraft.schema import Aircraft
    from servofd.simulation.flight import SimulatedFlight
    from servofd.simulation.vehicle.troubles import Trouble

_MOST_CLOCK_S = 1e7


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options that belong to ``--stream`` alone."""
    live = parser.add_argument_group("with --stream")
    live.add_argument("--speed", type=float, metavar="X", help="seconds of flight per second (default: 1)")
    live.add_argument("--wait", action="store_true", default=None, help="take off when somebody has said something")
    live.add_argument("--system", type=int, metavar="N", help="number of the vehicle, 1 to 255 (default: 1)")
    live.add_argument(
        "--feedback",
        metavar="NAME",
        help="how it tells positions: named (NAMED_VALUE_FLOAT, default), port (SERVO_OUTPUT_RAW, port 2) or array "
        "(DEBUG_FLOAT_ARRAY); DataFlash over MAVLink, for whoever asks, is there in each case",
    )
    live.add_argument(
        "--message-hz",
        type=float,
        metavar="HZ",
        help="rate of SERVO_OUTPUT_RAW until somebody asks for another (default: 1, as ArduPlane)",
    )
    live.add_argument(
        "--any-rate",
        action="store_true",
        default=None,
        help="grant rates up to that of the main loop; ArduPlane gives 0.8 of it",
    )
    live.add_argument("--mavlink1", action="store_true", default=None, help="send frames of MAVLink 1")
    live.add_argument(
        "--signing-key", metavar="FILE", help="sign with this key (32 bytes, 64 hex digits, or a passphrase)"
    )
    live.add_argument(
        "--trouble",
        action="append",
        metavar="KIND@START[:KEY=VALUE]",
        help="late, pause, silence, sequence, reboot, stall, freeze or parameter, from START [s] on, as seen on a real "
        "ArduPilot, e.g. late@30:by_s=4 or parameter@60:name=SERVO_VOLZ_RANGE:value=160; may be given again",
    )
    live.add_argument(
        "--clock-s", type=float, metavar="S", help="what its clock shows at the start [s]; 4290 wraps after 5 s"
    )


def refuse_options(options: argparse.Namespace) -> None:
    """Options of a live link make no sense for a file."""
    from servofd.core.errors import ConfigError

    for name in (
        "speed",
        "wait",
        "system",
        "feedback",
        "message_hz",
        "any_rate",
        "mavlink1",
        "signing_key",
        "clock_s",
        "trouble",
    ):
        if getattr(options, name) is not None:
            raise ConfigError(f"--{name.replace('_', '-')} belongs to --stream; {options.output} is a file")


def stream(options: argparse.Namespace, flight: SimulatedFlight, aircraft: Aircraft) -> int:
    """Fly live, and tell about it."""
    from logparsers.codec import Codec
    from logparsers.endpoint import parse_endpoint
    from logparsers.link import open_link
    from servofd.core.errors import ConfigError
    from servofd.simulation.ardupilot import rate_hz
    from servofd.simulation.vehicle.fly import fly, legs
    from servofd.simulation.vehicle.troubles import Air
    from servofd.simulation.vehicle.vehicle import Settings

    if options.mavlink1 and options.signing_key is not None:
        raise ConfigError("--signing-key: frames of MAVLink 1 cannot be signed; leave --mavlink1 out")
    endpoint = parse_endpoint(options.stream)
    names = ("system", "feedback", "message_hz", "any_rate", "speed")
    given: dict[str, Any] = {n: getattr(options, n) for n in names if getattr(options, n) is not None}
    settings = Settings(**given, troubles=tuple(_trouble(text) for text in options.trouble or ()))
    flown_legs = legs(_shifted(flight, options.clock_s), aircraft, settings)
    codec = Codec(settings.system, 1, version=1 if options.mavlink1 else 2, signature=signature_of(options.signing_key))
    link = open_link(endpoint)
    try:
        length_s = flight.time_s.size / rate_hz(flight)
        print(f"{endpoint}: system {settings.system}, {', '.join(flight.surfaces)}, {length_s:g} s; Ctrl-C ends it")
        sys.stdout.flush()
        flown = fly(flown_legs, link, codec, wait=bool(options.wait), air=Air(settings.troubles))
    finally:
        link.close()
    dropped = sum(leg.vehicle.dropped_rows for leg in flown_legs)
    if dropped:
        print(f"servofd: {dropped} rows of the streamed log found its buffer full", file=sys.stderr)
    print(f"{endpoint}: flew {flown.turns} turns of the main loop, sent {flown.sent} messages, heard {flown.heard}")
    return 0


def _trouble(text: str) -> Trouble:
    """Read ``kind@start:key=value``."""
    from servofd.core.errors import ConfigError, UnknownName, suggest
    from servofd.simulation.vehicle.troubles import TROUBLES

    what, *pairs = text.split(":")
    kind, _, start = what.partition("@")
    if kind not in TROUBLES:
        raise UnknownName(f"--trouble {text}: {suggest('trouble', kind, TROUBLES)}")
    values: dict[str, Any] = dict(pair.partition("=")[::2] for pair in (f"start_s={start}", *pairs))
    known = TROUBLES[kind].__dataclass_fields__
    if set(values) - set(known):
        raise ConfigError(f"--trouble {text}: takes {', '.join(known)}; the start stands after the @")
    try:
        return TROUBLES[kind](**{key: value if key == "name" else float(value) for key, value in values.items()})
    except ValueError as error:
        raise ConfigError(f"--trouble {text}: write KIND@START:KEY=NUMBER ({error})") from None


def _shifted(flight: SimulatedFlight, clock_s: float | None) -> SimulatedFlight:
    """The same flight of an autopilot that was booted earlier."""
    from servofd.core.errors import ConfigError

    if clock_s is None:
        return flight
    if not (math.isfinite(clock_s) and 0.0 <= clock_s <= _MOST_CLOCK_S):
        raise ConfigError(f"--clock-s {clock_s:g}: give seconds from 0 to {_MOST_CLOCK_S:g}")
    return replace(flight, time_s=(flight.time_s + clock_s).round(6))
