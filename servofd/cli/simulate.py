"""``servofd simulate``: flights with known truth."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from servofd.cli import stream

if TYPE_CHECKING:
    from collections.abc import Callable

    from servofd.servo.effects import Effect
    from servofd.servo.failing import Fault

OUTPUTS = ".csv (plain table), .mat (FASER), .bin (ArduPilot DataFlash), .tlog (MAVLink) or .ulg (PX4)"

_LOOP_HZ = 50.0
_LIVE_S = 600.0
_AIRFRAME_S, _STORM = 180.0, 10.0

_Made = TypeVar("_Made")


def add_parser(verbs: argparse._SubParsersAction[Any]) -> None:
    """Declare the verb."""
    parser = verbs.add_parser(
        "simulate",
        help="write a log of a simulated flight, or fly it live",
        description="Simulates an aircraft's servos, healthy or with faults, and writes the log of the flight, or "
        "flies it as a vehicle on a MAVLink link.",
        epilog="Example: servofd simulate -o flight.csv --fault elevator:deadband@20:width_deg=3",
    )
    where = parser.add_mutually_exclusive_group(required=True)
    where.add_argument("-o", "--output", metavar="FILE", help=OUTPUTS)
    where.add_argument(
        "--stream",
        metavar="ENDPOINT",
        help="udpout:HOST:PORT, udpin:HOST:PORT, tcp:HOST:PORT, tcpin:HOST:PORT or a serial device: be an ArduPlane "
        "there, in real time",
    )
    parser.add_argument("-c", "--config", metavar="AIRCRAFT.toml", help="aircraft file, or the name of a shipped one")
    parser.add_argument(
        "--servo",
        metavar="NAME",
        help="library servo of all surfaces; default: as in the shipped simulated",
    )
    parser.add_argument("--duration", type=float, metavar="S", help="length [s] (default: 60; of a stream 600)")
    parser.add_argument(
        "--rate-hz",
        type=float,
        metavar="HZ",
        help="sample rate (default: 100; in a .tlog 40; of a stream 50, the main loop of an ArduPlane)",
    )
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="the same seed gives the same flight")
    parser.add_argument(
        "--command",
        default="flight",
        help="flight, calm, lively, cruise or hand_flown; on the bench chirp, steps or doublets (default: flight)",
    )
    parser.add_argument(
        "--noise-deg", type=float, default=0.1, metavar="X", help="noise of the position (default: 0.1)"
    )
    parser.add_argument(
        "--fault",
        action="append",
        default=[],
        metavar="SURFACE:KIND@START[:KEY=VALUE]",
        help="stuck, bias, hardover, floating, oscillation, deadband, slow or loss_of_effectiveness, from START [s] on "
        "(until end_s=... if it passes); may be given again, on one surface for a later time",
    )
    parser.add_argument(
        "--effect",
        action="append",
        default=[],
        metavar="SURFACE:EFFECT[:KEY=VALUE]",
        help="anything that explain can find, in its words, e.g. elevator:backlash:width_deg=1; delay is the total, "
        "limits replace those of the servo; form=... as in an aircraft file",
    )
    parser.add_argument(
        "--generation",
        metavar="NAME",
        help="servo telemetry of a .bin: volz (ArduPilot 4.7: degrees, with the command; default) or dronecan "
        "(up to 4.6: radians)",
    )
    parser.add_argument(
        "--airframe",
        metavar="MIXER",
        help="an aeroplane without servo feedback that answers its surfaces, into a .bin: plain, elevon or vtail; "
        "faults stuck, loss_of_effectiveness, slow and bias, each with value=... (deg, share left, s, deg)",
    )
    parser.add_argument(
        "--turbulence", type=float, metavar="X", help="of an airframe: 1 is gusts of 1.5 m/s (default: 1)"
    )
    parser.add_argument("--engine-cut", type=float, metavar="S", help="of an airframe: from when on it glides [s]")
    stream.add_options(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Simulate, and write or fly."""
    if options.airframe is not None or options.turbulence is not None or options.engine_cut is not None:
        return _run_airframe(options)
    from servofd.aircraft.schema import UNKNOWN_SERVO, load_aircraft, plain_aircraft
    from servofd.core.errors import ConfigError
    from servofd.servo.library import servo_named
    from servofd.simulation.flight import simulate_flight
    from servofd.simulation.pulses import outputs_of
    from servofd.simulation.writers import Writer, write_flight, writer_for

    if options.stream is None:
        stream.refuse_options(options)
        writer: Writer | None = writer_for(options.output, options.generation)
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
    aircraft = load_aircraft(config) if config else plain_aircraft(surfaces, _simulated_servo())
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
        return stream.stream(options, flown, aircraft)
    write_flight(options.output, flown, aircraft, generation=options.generation)
    print(f"{options.output}: {duration_s:g} s at {rate_hz:g} Hz, {', '.join(flown.surfaces)}")
    return 0


def _simulated_servo() -> str:
    """Servo of the aircraft that comes with servofd to be simulated."""
    from servofd.aircraft.schema import load_aircraft

    return next(iter(load_aircraft("simulated").surfaces.values())).servo


def _run_airframe(options: argparse.Namespace) -> int:
    """An aeroplane that answers its surfaces, as the log of its autopilot."""
    from servofd.core.errors import ConfigError
    from servofd.core.files import write_whole
    from servofd.simulation.airframe import AirframeFault, fly_airframe
    from servofd.simulation.airframe_log import airframe_log

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
    from servofd.core.errors import ConfigError
    from servofd.servo.failing import in_order

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
    from servofd.core.errors import ConfigError, UnknownName, suggest
    from servofd.servo.faults import FAULTS

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
    from servofd.core.errors import ConfigError, ServofdError
    from servofd.servo.effect_table import TabledEffect
    from servofd.servo.effects import Plan

    where = f"--effect {text}"
    surface, _, rest = text.partition(":")
    name, *pairs = rest.split(":")
    if not (surface and name):
        raise ConfigError(f"{where}: write SURFACE:EFFECT:KEY=VALUE, e.g. elevator:delay:delay_s=0.02")
    forms = [pair for pair in pairs if pair.startswith("form=")]
    values: dict[str, float | str] = dict(_numbers(where, [pair for pair in pairs if pair not in forms]))
    if forms:
        values["form"] = forms[-1].removeprefix("form=")
    tabled = TabledEffect(name, values)
    try:
        tabled.install(Plan())
    except ServofdError as error:
        raise ConfigError(f"{where}: {error}") from None
    return surface, tabled


def _numbers(where: str, pairs: list[str]) -> dict[str, float]:
    from servofd.core.errors import ConfigError

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
    import dataclasses

    from servofd.core.errors import ConfigError

    fields = {f.name: f for f in dataclasses.fields(kind) if f.init}  # type: ignore[arg-type]
    required = {n for n, f in fields.items() if f.default is dataclasses.MISSING}
    if set(values) - set(fields) or required - set(values):
        raise ConfigError(f"{where}: takes {', '.join(fields)}; {', '.join(sorted(required))} must be given")
    try:
        return kind(**values)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from None
