"""``servofd simulate``: flights with known truth, as a log or as a vehicle on a live link."""

from __future__ import annotations

import dataclasses
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from logparsers.codec import Codec
from logparsers.endpoint import parse_endpoint
from logparsers.link import open_link
from servofd.aircraft.schema import UNKNOWN_SERVO, load_aircraft, plain_aircraft
from servofd.cli.terminal import complain
from servofd.core.errors import ConfigError, ServofdError, UnknownName, suggest
from servofd.core.files import write_whole
from servofd.live.threads import signature_of
from servofd.servo.catalogue import effect_of
from servofd.servo.faults import FAULTS, in_order
from servofd.servo.library import servo_named
from servofd.simulation.airframe import AirframeFault, fly_airframe
from servofd.simulation.airframe_log import airframe_log
from servofd.simulation.ardupilot import rate_hz as rate_of
from servofd.simulation.flight import simulate_flight
from servofd.simulation.pulses import outputs_of
from servofd.simulation.vehicle.fly import fly, legs
from servofd.simulation.vehicle.troubles import TROUBLES, Air
from servofd.simulation.vehicle.vehicle import Settings
from servofd.simulation.writers import write_flight, writer_for

if TYPE_CHECKING:
    from collections.abc import Callable

    from servofd.aircraft.schema import Aircraft
    from servofd.cli.options import Options
    from servofd.servo.effect import Effect
    from servofd.servo.faults import Fault
    from servofd.simulation.flight import SimulatedFlight
    from servofd.simulation.vehicle.troubles import Trouble

_LOOP_HZ = 50.0
_LIVE_S = 600.0
_AIRFRAME_S, _STORM = 180.0, 10.0
_MOST_CLOCK_S = 1e7
_OF_STREAM = (
    *("speed", "wait", "system", "feedback", "message_hz", "any_rate"),
    *("mavlink1", "signing_key", "clock_s", "trouble"),
)
"""Options of a live link, which make no sense for a file."""

_Made = TypeVar("_Made")


def run(options: Options) -> int:
    """Simulate, and write or fly."""
    if options.airframe is not None or options.turbulence is not None or options.engine_cut is not None:
        return _run_airframe(options)

    if options.stream is None:
        for name in _OF_STREAM:
            if getattr(options, name) is not None:
                raise ConfigError(f"--{name.replace('_', '-')} belongs to --stream; {options.output} is a file")
        writer = writer_for(options.output, options.generation)
    elif options.generation is None:
        writer = None
    else:
        raise ConfigError("--generation: a generation of servo telemetry belongs to a .bin log, and to that alone")
    usual_hz, usual_s = (writer.rate_hz, 60.0) if writer else (_LOOP_HZ, _LIVE_S)
    rate_hz = usual_hz if options.rate_hz is None else options.rate_hz
    duration_s = usual_s if options.duration is None else options.duration
    servo = None if options.servo == UNKNOWN_SERVO else options.servo
    if servo is not None:
        servo_named(servo)
    if options.seed < 0:
        raise ConfigError(f"--seed {options.seed}: give a whole number of zero or more")
    shipped = "faser" if writer and Path(options.output).suffix.lower() == ".mat" else None
    config = options.config or shipped
    surfaces = ("elevator", "aileron", "rudder")
    simulated = next(iter(load_aircraft("simulated").surfaces.values()))
    aircraft = load_aircraft(config) if config else plain_aircraft(surfaces, simulated.servo)
    if servo is not None:
        aircraft = aircraft.with_servo(servo)
    effects: dict[str, list[Effect]] = {}
    for text in options.effect:
        surface, effect = _effect(text)
        effects.setdefault(surface, []).append(effect)
    flown = simulate_flight(
        aircraft,
        command=options.command,
        duration_s=duration_s,
        rate_hz=rate_hz,
        seed=options.seed,
        faults=_faults(options.fault, duration_s),
        effects=effects,
        noise_deg=options.noise_deg,
        outputs=outputs_of(aircraft) if writer is None or writer.pulses else (),
    )
    if writer is None:
        if flown.context.logged:
            raise ConfigError(
                "--stream: an effect depends on the air or the supply, which a stream does not tell: use -o"
            )
        return _stream(options, flown, aircraft)
    write_flight(options.output, flown, aircraft, generation=options.generation)
    print(f"{options.output}: {duration_s:g} s at {rate_hz:g} Hz, {', '.join(flown.surfaces)}")
    return 0


def _run_airframe(options: Options) -> int:
    """An aeroplane that answers its surfaces, as the log of its autopilot."""
    if options.airframe is None:
        raise ConfigError("--turbulence and --engine-cut are of an airframe: --airframe plain")
    if not options.output or Path(options.output).suffix.lower() != ".bin":
        raise ConfigError(f"{options.output or options.stream}: --airframe writes ArduPlane's log, a .bin")
    if options.seed < 0:
        raise ConfigError(f"--seed {options.seed}: give a whole number of zero or more")
    turbulence = 1.0 if options.turbulence is None else options.turbulence
    if not 0.0 <= turbulence <= _STORM:
        raise ConfigError(f"--turbulence {turbulence:g}: from 0 to {_STORM:g}")
    faults = []
    for text in options.fault:
        surface, _, rest = text.partition(":")
        what, *pairs = rest.split(":")
        kind, at, start = what.partition("@")
        values = _numbers(f"--fault {text}", [f"start_s={start}", *pairs]) if at else {}
        if set(values) - {"end_s"} != {"start_s", "value"}:
            raise ConfigError(
                f"--fault {text}: write SURFACE:KIND@START:value=X, for example elevator:stuck@60:value=-2"
            )
        faults.append(AirframeFault(surface, kind, values["start_s"], values["value"], values.get("end_s", math.inf)))
    flight = fly_airframe(
        options.seed,
        mixer=options.airframe,
        duration_s=_AIRFRAME_S if options.duration is None else options.duration,
        turbulence=turbulence,
        faults=tuple(faults),
        engine_cut_s=math.inf if options.engine_cut is None else options.engine_cut,
    )
    write_whole(options.output, airframe_log(flight))
    print(f"{options.output}: {flight.time_s[-1]:.0f} s at 25 Hz, {', '.join(flight.mixer.names)}, no feedback")
    return 0


def _faults(texts: list[str], duration_s: float) -> dict[str, tuple[Fault, ...]]:
    """Faults of each surface, within the flight and one at a time."""
    faults: dict[str, tuple[Fault, ...]] = {}
    for text in texts:
        surface, fault = _fault(text)
        if not 0.0 <= fault.start_s < duration_s:
            raise ConfigError(
                f"--fault {text}: starts at {fault.start_s:g} s, the flight lasts from 0 to {duration_s:g} s"
            )
        try:
            faults[surface] = in_order([*faults.get(surface, ()), fault])
        except ConfigError as error:
            raise ConfigError(f"--fault {text}: {error}") from None
    return faults


def _fault(text: str) -> tuple[str, Fault]:
    """Read ``surface:kind@start:key=value``."""
    surface, _, rest = text.partition(":")
    what, *pairs = rest.split(":")
    kind, at, start = what.partition("@")
    if not (surface and at):
        raise ConfigError(f"--fault {text}: write SURFACE:KIND@START, for example elevator:stuck@20")
    if kind not in FAULTS:
        raise UnknownName(f"--fault {text}: {suggest('fault', kind, FAULTS)}")
    if any(pair.startswith("start_s=") for pair in pairs):
        raise ConfigError(f"--fault {text}: the time stands after the @, not in start_s")
    values = _numbers(f"--fault {text}", [f"start_s={start}", *pairs])
    fault: Fault = _made(FAULTS[kind], values, f"--fault {text}")
    return surface, fault


def _effect(text: str) -> tuple[str, Effect]:
    """Read ``surface:effect:key=value``."""
    where = f"--effect {text}"
    surface, _, rest = text.partition(":")
    name, *pairs = rest.split(":")
    if not (surface and name):
        raise ConfigError(f"{where}: write SURFACE:EFFECT:KEY=VALUE, e.g. elevator:delay:delay_s=0.02")
    forms = [pair for pair in pairs if pair.startswith("form=")]
    values: dict[str, float | str] = dict(_numbers(where, [pair for pair in pairs if pair not in forms]))
    if forms:
        values["form"] = forms[-1].removeprefix("form=")
    try:
        return surface, effect_of(name, values)
    except ServofdError as error:
        raise ConfigError(f"{where}: {error}") from None


def _numbers(where: str, pairs: list[str]) -> dict[str, float]:
    values = {}
    for pair in pairs:
        key, _, number = pair.partition("=")
        try:
            values[key] = float(number)
        except ValueError:
            raise ConfigError(f"{where}: {pair!r} is not KEY=NUMBER") from None
        if not math.isfinite(values[key]):
            raise ConfigError(f"{where}: {pair!r} is not finite")
    return values


def _made(kind: Callable[..., _Made], values: dict[str, float], where: str) -> _Made:
    """Instance of a small dataclass from its numbers."""
    fields = {f.name: f for f in dataclasses.fields(kind) if f.init}  # type: ignore[arg-type]
    required = {n for n, f in fields.items() if f.default is dataclasses.MISSING}
    if set(values) - set(fields) or required - set(values):
        raise ConfigError(f"{where}: takes {', '.join(fields)}; {', '.join(sorted(required))} must be given")
    try:
        return kind(**values)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from None


def _stream(options: Options, flight: SimulatedFlight, aircraft: Aircraft) -> int:
    """Fly live, and tell about it."""
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
        length_s = flight.time_s.size / rate_of(flight)
        print(f"{endpoint}: system {settings.system}, {', '.join(flight.surfaces)}, {length_s:g} s; Ctrl-C ends it")
        sys.stdout.flush()
        flown = fly(flown_legs, link, codec, wait=bool(options.wait), air=Air(settings.troubles))
    finally:
        link.close()
    dropped = sum(leg.vehicle.dropped_rows for leg in flown_legs)
    if dropped:
        complain(f"{dropped} rows of the streamed log found its buffer full")
    print(f"{endpoint}: flew {flown.turns} turns of the main loop, sent {flown.sent} messages, heard {flown.heard}")
    return 0


def _trouble(text: str) -> Trouble:
    """Read ``kind@start:key=value``."""
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
    if clock_s is None:
        return flight
    if not (math.isfinite(clock_s) and 0.0 <= clock_s <= _MOST_CLOCK_S):
        raise ConfigError(f"--clock-s {clock_s:g}: give seconds from 0 to {_MOST_CLOCK_S:g}")
    return dataclasses.replace(flight, time_s=(flight.time_s + clock_s).round(6))
