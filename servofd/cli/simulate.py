"""``servofd simulate``: flights with known truth, as a log or as a vehicle on a live link."""

from __future__ import annotations

import dataclasses
import math
import sys
from pathlib import Path
from typing import Any

from logparsers.codec import Codec
from logparsers.endpoint import parse_endpoint
from logparsers.link import open_link
from servofd.aircraft.schema import Aircraft
from servofd.cli.options import Options
from servofd.cli.terminal import complain, say
from servofd.core.errors import ConfigError, UnknownName, suggest
from servofd.core.files import write_whole
from servofd.jobs.simulating import aircraft_to_fly, simulate
from servofd.live.threads import signature_of
from servofd.simulation.airframe import AirframeFault, airframe_log, fly_airframe
from servofd.simulation.ardupilot import rate_hz as rate_of
from servofd.simulation.flight import SimulatedFlight
from servofd.simulation.vehicle.fly import fly, legs
from servofd.simulation.vehicle.troubles import TROUBLES, Air, Trouble
from servofd.simulation.vehicle.vehicle import Settings
from servofd.simulation.words import numbers_of

_LOOP_HZ = 50.0
"""Main loop of a simulated vehicle, as ArduPlane's [Hz]."""
_FILE_S, _LIVE_S = 60.0, 600.0
"""Duration of a simulated log, and of a simulated vehicle [s]."""
_AIRFRAME_S = 180.0
"""Duration of a flight without servo feedback [s]."""
_MOST_CLOCK_S = 1e7
"""Latest start of the vehicle's clock [s]: 116 days."""
_SETTINGS = ("speed", "system", "feedback", "message_hz", "any_rate")
_OF_STREAM = (*_SETTINGS, "wait", "mavlink1", "signing_key", "clock_s", "trouble")
"""Options of a live link, which make no sense for a file; among them how a vehicle speaks."""


_OF_SERVOS = ("config", "servo", "rate_hz", "command", "noise_deg", "effect", "generation", *_OF_STREAM)
"""Options of a flight whose servos report their positions, which that of an airframe does not."""


def run(options: Options) -> int:
    """Simulate, and write or fly."""
    if options.airframe is not None:
        return _run_airframe(options)

    if options.stream is None:
        for name in _OF_STREAM:
            if getattr(options, name) is not None:
                raise ConfigError(f"--{name.replace('_', '-')} belongs to --stream; {options.output} is a file")
    elif options.generation is not None:
        raise ConfigError("--generation: a generation of servo telemetry belongs to a .bin log, and to that alone")
    streamed = options.stream is not None
    duration_s = options.duration if options.duration is not None else _LIVE_S if streamed else _FILE_S
    output = None if streamed else options.output
    aircraft = aircraft_to_fly(options.config, options.servo, output)
    names = ("command", "seed", "fault", "effect", "noise_deg", "generation")
    asked: dict[str, Any] = {name: given for name in names if (given := getattr(options, name)) is not None}
    rate_hz = _LOOP_HZ if streamed and options.rate_hz is None else options.rate_hz
    flight = simulate(output, aircraft, duration_s=duration_s, rate_hz=rate_hz, pulses=streamed, **asked)
    if streamed:
        if flight.context.logged:
            why = "an effect depends on the air or the supply, which a stream does not hold: use -o"
            raise ConfigError(f"--stream: {why}")
        return _stream(options, flight, aircraft)
    say(f"{output}: {duration_s:g} s at {rate_of(flight):g} Hz, {', '.join(flight.surfaces)}")
    return 0


def _run_airframe(options: Options) -> int:
    """An aeroplane that answers its surfaces, as the log of its autopilot."""
    if not options.output or Path(options.output).suffix.lower() != ".bin":
        raise ConfigError(f"{options.output or options.stream}: --airframe writes ArduPlane's log, a .bin")
    for name in _OF_SERVOS:
        if getattr(options, name) not in (None, []):
            what = f"--{name.replace('_', '-')}"
            raise ConfigError(f"{what}: with --airframe only --seed, --duration and --fault count; leave {what} out")
    if options.seed < 0:
        raise ConfigError(f"--seed {options.seed}: give a whole number of zero or more")
    faults = []
    for text in options.fault:
        surface, _, rest = text.partition(":")
        what, *pairs = rest.split(":")
        kind, at, start = what.partition("@")
        values = numbers_of(f"--fault {text}", [f"start_s={start}", *pairs]) if at else {}
        if set(values) - {"end_s"} != {"start_s", "value"}:
            example = "SURFACE:KIND@START:value=X, for example elevator:stuck@60:value=-2"
            raise ConfigError(f"--fault {text}: write {example}")
        faults.append(AirframeFault(surface, kind, values["start_s"], values["value"], values.get("end_s", math.inf)))
    duration_s = _AIRFRAME_S if options.duration is None else options.duration
    flight = fly_airframe(options.seed, mixer=options.airframe, duration_s=duration_s, faults=tuple(faults))
    write_whole(options.output, airframe_log(flight))
    say(f"{options.output}: {flight.time_s[-1]:.0f} s at 25 Hz, {', '.join(flight.surfaces.values())}, no feedback")
    return 0


def _stream(options: Options, flight: SimulatedFlight, aircraft: Aircraft) -> int:
    """Fly live, and tell about it."""
    if options.mavlink1 and options.signing_key is not None:
        raise ConfigError("--signing-key: frames of MAVLink 1 cannot be signed; leave --mavlink1 out")
    endpoint = parse_endpoint(options.stream)
    given: dict[str, Any] = {n: getattr(options, n) for n in _SETTINGS if getattr(options, n) is not None}
    settings = Settings(**given, troubles=tuple(_trouble(text) for text in options.trouble or ()))
    if options.clock_s is not None:  # the same flight of an autopilot that was booted earlier
        if not (math.isfinite(options.clock_s) and 0.0 <= options.clock_s <= _MOST_CLOCK_S):
            raise ConfigError(f"--clock-s {options.clock_s:g}: give seconds from 0 to {_MOST_CLOCK_S:g}")
        flight = dataclasses.replace(flight, time_s=(flight.time_s + options.clock_s).round(6))
    flown_legs = legs(flight, aircraft, settings)
    codec = Codec(settings.system, 1, version=1 if options.mavlink1 else 2, signature=signature_of(options.signing_key))
    link = open_link(endpoint)
    try:
        length_s = flight.time_s.size / rate_of(flight)
        say(f"{endpoint}: system {settings.system}, {', '.join(flight.surfaces)}, {length_s:g} s; Ctrl-C ends it")
        sys.stdout.flush()
        flown = fly(flown_legs, link, codec, wait=bool(options.wait), air=Air(settings.troubles))
    finally:
        link.close()
    dropped = sum(leg.vehicle.dropped_rows for leg in flown_legs)
    if dropped:
        complain(f"{dropped} rows of the streamed log found its buffer full")
    say(f"{endpoint}: flew {flown.turns} turns of the main loop, sent {flown.sent} messages, received {flown.received}")
    return 0


def _trouble(text: str) -> Trouble:
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
