"""``servofd monitor``: watches the servos of a flying aircraft."""

from __future__ import annotations

import argparse
import contextlib
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from servofd.cli.parser import LARGEST, SMALLEST, number, whole
from servofd.cli.signing import signature_of

if TYPE_CHECKING:
    from collections.abc import Mapping

    from logparsers.records import FlightLog
    from servofd.aircraft.schema import Aircraft
    from servofd.live.session import Session
    from servofd.live.speaker import Speaker

_VIEWER_PORT = 9876
_ADDRESS, _PORT = whole("an id from 1 to 255", 1, 255), whole("a port from 1 to 65535", 1, 65_535)
_LASTING, _SPEED = number("a positive number of seconds", SMALLEST), number("a positive number, or 0", 0.0, LARGEST)

_ON_THE_CARD, _HEAD_BYTES = b"CSRV", 16_000_000
"""A log that holds what ArduPilot writes on its card names this message in its beginning."""


def add_parser(verbs: argparse._SubParsersAction[Any]) -> None:
    """Declare the verb."""
    parser = verbs.add_parser(
        "monitor",
        help="watch the servos of a flying aircraft on its MAVLink stream",
        description="Watches the servos of a flying aircraft and raises alarms. Never commands the vehicle. Exit code "
        "0: healthy; 1: a fault was found; 2: could not tell.",
        epilog="Example: servofd monitor udpin:127.0.0.1:14550 -c my_plane.toml",
    )
    parser.add_argument(
        "endpoint",
        metavar="ENDPOINT",
        help="udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT, tcpin:HOST:PORT, a serial device, or a log file",
    )
    parser.add_argument(
        "-c",
        "--config",
        action="append",
        required=True,
        metavar="[ID=]AIRCRAFT.toml",
        help="aircraft file; of several vehicles one for each system id",
    )
    parser.add_argument("--duration", type=_LASTING, default=float("inf"), metavar="S", help="end after so long [s]")
    parser.add_argument("--speed", type=_SPEED, metavar="X", help="of a replay; 0: as fast as it goes (default: 1)")
    parser.add_argument("--rrd", metavar="FILE", help="write a Rerun recording")
    parser.add_argument("--serve", action="store_true", help="let Rerun viewers on this machine connect")
    parser.add_argument("--viewer-port", type=_PORT, default=_VIEWER_PORT, metavar="PORT", help="(default: 9876)")
    parser.add_argument("--tlog", metavar="FILE", help="write all that is received as a telemetry log")
    parser.add_argument("--alert-to", metavar="ENDPOINT", help="send alerts there (default: back to the stream)")
    parser.add_argument("--no-alert", action="store_true", help="send no alerts")
    parser.add_argument("--no-request", action="store_true", help="send nothing at all to the stream")
    parser.add_argument("--dataflash", action="store_true", help="ask for the autopilot's own log (CSRV, RCOU) as well")
    parser.add_argument("--system", type=_ADDRESS, metavar="ID", help="system id to speak as (default: the vehicle's)")
    parser.add_argument("--component", type=_ADDRESS, default=191, metavar="ID", help="component id (default: 191)")
    parser.add_argument("--signing-key", metavar="FILE", help="file with the key that frames are signed with")
    parser.add_argument("--json-lines", metavar="FILE", help="write each event as a line of JSON; - prints them")
    parser.add_argument("--plain", action="store_true", help="print lines instead of a changing picture")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Watch until the end, then say what was found."""
    from servofd.core.errors import ConfigError
    from servofd.core.files import beginning

    is_log = Path(options.endpoint).is_file()
    has_card = options.dataflash or (is_log and _ON_THE_CARD in beginning(Path(options.endpoint), _HEAD_BYTES))
    aircraft = _aircraft(options.config, has_card=has_card)
    if options.dataflash and options.no_request:
        raise ConfigError("--dataflash has to ask for the log, which --no-request forbids")
    if options.dataflash and is_log:
        raise ConfigError(f"{options.endpoint}: --dataflash asks a vehicle for its log, and this is a file")
    if options.no_alert and options.alert_to:
        raise ConfigError("--no-alert and --alert-to exclude each other")
    for name in (options.tlog, options.rrd, options.json_lines if options.json_lines != "-" else None):
        if name and not Path(name).resolve().parent.is_dir():
            raise ConfigError(f"{name}: the folder {Path(name).resolve().parent} does not exist")
        if name and Path(name).resolve() == Path(options.endpoint).resolve():
            raise ConfigError(f"{name}: is the log that is replayed; choose another file")
    if options.speed is not None and not is_log:
        raise ConfigError(f"{options.endpoint}: --speed is for a log file, and there is none of that name")
    session = _replay(options, aircraft) if is_log else _watch(options, aircraft)
    return _verdict(session)


def _watch(options: argparse.Namespace, aircraft: Mapping[int, Aircraft]) -> Session:
    """Watch a live link."""
    from logparsers.codec import Codec
    from logparsers.endpoint import parse_endpoint
    from logparsers.link import open_link
    from servofd.cli.monitor_outputs import Outputs
    from servofd.live.run import watch_link
    from servofd.live.session import Session
    from servofd.live.speaker import Speaker
    from servofd.live.threads import Receiver

    endpoint = parse_endpoint(options.endpoint)
    signature = signature_of(options.signing_key)
    with contextlib.ExitStack() as open_:
        link = open_link(endpoint)
        open_.callback(link.close)
        session = Session(
            Codec(0, options.component, signature=signature),
            aircraft,
            aside=True,
            remote_log=options.dataflash,
            component=options.component,
        )
        speaker = Speaker(options.system or 0, options.component, signature)
        if not options.no_request:
            to_vehicle = open_.enter_context(speaker.to(link))
            session.send = to_vehicle
            if not options.no_alert:
                session.alert = to_vehicle
        _alert_aside(options, session, speaker, open_)
        outputs = open_.enter_context(Outputs.of(options, session, str(endpoint), aircraft))
        receiver = Receiver(link)
        open_.callback(receiver.close)
        outputs.receiver = receiver
        # However it ends, what was found is printed.
        with contextlib.suppress(KeyboardInterrupt):
            watch_link(session, receiver, outputs, options.duration)
        outputs.events(session.finish(receiver.now_s()), receiver.now_s())
    return session


def _replay(options: argparse.Namespace, aircraft: Mapping[int, Aircraft]) -> Session:
    """Replay a log in the same view; nothing is sent but alerts, if they have an address."""
    from logparsers.codec import Codec
    from servofd.aircraft.resolve import resolved
    from servofd.cli.monitor_outputs import Outputs
    from servofd.feedback.flown import one_log
    from servofd.live.run import Pace, replay_log, replay_telemetry
    from servofd.live.session import Session
    from servofd.live.speaker import Speaker

    pace = Pace(1.0 if options.speed is None else options.speed)
    path = Path(options.endpoint)
    with contextlib.ExitStack() as open_:
        log = one_log(path, next(iter(aircraft.values())))
        signature = signature_of(options.signing_key)
        recorded = signature.of_any_time() if signature else None
        is_stream = log.format == "tlog"
        if not is_stream:
            aircraft = {system: resolved(log, craft) for system, craft in aircraft.items()}
        session = Session(
            Codec(0, options.component, signature=recorded),
            aircraft,
            is_stream=is_stream,
            remote_log=is_stream and _asks_its_log(aircraft, log),
        )
        _alert_aside(options, session, Speaker(options.system or 0, options.component, signature), open_)
        outputs = open_.enter_context(Outputs.of(options, session, options.endpoint, aircraft))
        now_s = 0.0
        with contextlib.suppress(KeyboardInterrupt):
            if log.format == "tlog":
                now_s = replay_telemetry(session, path, outputs, pace, options.duration)
            else:
                now_s = replay_log(session, log, outputs, pace, options.duration)
        outputs.events(session.finish(now_s), now_s)
    return session


def _alert_aside(options: argparse.Namespace, session: Session, speaker: Speaker, open_: contextlib.ExitStack) -> None:
    """Send alerts to an address of their own, if there is one."""
    from logparsers.endpoint import parse_endpoint
    from logparsers.link import open_link

    if options.alert_to:
        link = open_link(parse_endpoint(options.alert_to))
        open_.callback(link.close)
        session.alert = open_.enter_context(speaker.to(link))


def _asks_its_log(aircraft: Mapping[int, Aircraft], log: FlightLog) -> bool:
    """Whether a telemetry log has the aircraft's channels in the autopilot's own log, which came with it."""
    from servofd.live.channels import ChannelTable

    wanted = {s.measured.channel for craft in aircraft.values() for s in craft.surfaces.values() if s.measured}
    return any(name in log.channels for name in ChannelTable(wanted).unknown)


def _verdict(session: Session) -> int:
    """Exit code; the reason for a 2 goes to stderr."""
    axes = [vehicle.axes for vehicle in session.vehicles.values() if vehicle.axes is not None]
    if any(monitor.has_fault for _, monitor in session.watched) or any(one.has_fault for one in axes):
        return 1
    suspect = [audit for one in axes if one.has_suspect for audit in one.audits if audit.status == "suspect"]
    if any(one.has_suspect for one in axes):
        why = suspect[0].reason if suspect else "an axis did not answer its command"
        print(f"servofd: not cleared: {why}", file=sys.stderr)
        return 2
    doubtful = [monitor for _, monitor in session.watched if monitor.suspicions]
    if doubtful:
        from servofd.detection.words import describe

        found = "; ".join(f"{monitor.name}: {describe(monitor.suspicions[0])}" for monitor in doubtful)
        print(f"servofd: not cleared: no alarm stands, but look at it: {found}", file=sys.stderr)
        return 2
    by_motion = not session.watched and any(not one.problem for one in axes)
    unjudged = "" if by_motion else session.unjudged()
    if not unjudged:
        return 0
    names = ", ".join(sorted(session.names)[:8])
    heard = f"; heard {names}" if names and not any(monitor.was_judged for _, monitor in session.watched) else ""
    print(f"servofd: could not tell: {unjudged}{heard}", file=sys.stderr)
    return 2


def _aircraft(names: list[str], *, has_card: bool) -> dict[int, Aircraft]:
    """The aircraft by system; channels of the log on the card become those of telemetry where it does not come."""
    from servofd.aircraft.resolve import streamed
    from servofd.aircraft.schema import load_aircraft
    from servofd.core.errors import ConfigError

    known: dict[int, Aircraft] = {}
    for name in names:
        head, equals, path = name.partition("=")
        system = int(head) if equals and head.isdigit() and len(head) <= 3 else 0
        if system in known or (len(names) > 1 and not 0 < system < 256):
            raise ConfigError(f"{name}: several vehicles need one file each, as -c 1=FILE -c 2=FILE")
        aircraft = load_aircraft(path if system else name)
        unnamed = [key for key, surface in aircraft.surfaces.items() if not surface.names_servo]
        if unnamed:  # an audit fits them to its log; in flight there is none yet
            raise ConfigError(
                f"{path if system else name}: {', '.join(unnamed)}: no servo is named; name one (servo = ...), or let "
                "'servofd calibrate' make the file from a good flight"
            )
        known[system] = streamed(aircraft, has_card=has_card)
    return known
