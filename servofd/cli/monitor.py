"""``servofd monitor``: watches the servos of a flying aircraft."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from functools import partial
from pathlib import Path

from logparsers.codec import Codec, Signature
from logparsers.endpoint import parse_endpoint
from logparsers.link import open_link
from servofd.aircraft.current_source import with_current_sources
from servofd.aircraft.outputs import resolved, streamed
from servofd.aircraft.schema import Aircraft, load_aircraft
from servofd.cli.monitor_outputs import Outputs
from servofd.cli.options import Options
from servofd.cli.terminal import complain
from servofd.core.errors import ConfigError
from servofd.core.files import beginning
from servofd.detection.verdict import describe
from servofd.feedback.flown import one_log
from servofd.live.channels import ChannelTable
from servofd.live.run import Pace, replay_log, replay_telemetry, watch_link
from servofd.live.session import Session
from servofd.live.threads import Receiver, signature_of, speaking

_ON_THE_CARD, _HEAD_BYTES = b"CSRV", 16_000_000
"""A log that holds what ArduPilot writes on its card names this message in its beginning."""


def run(options: Options) -> int:
    """Watch until the end, then say what was found."""
    is_log = Path(options.endpoint).is_file()
    has_card = options.dataflash or (is_log and _ON_THE_CARD in beginning(Path(options.endpoint), _HEAD_BYTES))
    aircraft = _aircraft(options.config, has_card=has_card)
    if min(aircraft) < 0 and options.dataflash:  # a vehicle that is not known yet is asked for no log
        raise ConfigError("--dataflash: which vehicle has which file? -c 1=FILE -c 2=FILE")
    if options.dataflash and options.no_request:
        raise ConfigError("--dataflash has to ask for the log, which --no-request forbids")
    if options.dataflash and is_log:
        raise ConfigError(f"{options.endpoint}: --dataflash asks a vehicle for its log, and this is a file")
    if options.no_alert and options.alert_to:
        raise ConfigError("--no-alert and --alert-to exclude each other")
    _check_files(options)
    if options.speed is not None and not is_log:
        raise ConfigError(f"{options.endpoint}: --speed is for a log file, and there is none of that name")
    try:
        session = _replay(options, aircraft) if is_log else _watch(options, aircraft)
    except BrokenPipeError:  # who pipes a monitor into something has to learn that nobody watches any more
        raise OSError("standard output was closed; what was written to files until then is whole") from None
    return _verdict(session)


def _check_files(options: Options) -> None:
    """Refuse files that cannot be written, or are the log itself."""
    for name in (options.tlog, options.rrd, options.json_lines if options.json_lines != "-" else None):
        if name and not Path(name).resolve().parent.is_dir():
            raise ConfigError(f"{name}: the folder {Path(name).resolve().parent} does not exist")
        if name and Path(name).resolve() == Path(options.endpoint).resolve():
            raise ConfigError(f"{name}: is the log that is replayed; choose another file")


def _watch(options: Options, aircraft: Mapping[int, Aircraft]) -> Session:
    endpoint = parse_endpoint(options.endpoint)
    signature = signature_of(options.signing_key)
    with contextlib.ExitStack() as open_:
        link = open_link(endpoint)
        open_.callback(link.close)
        component, codec = options.component, Codec(0, options.component, signature=signature)
        session = Session(codec, aircraft, aside=True, remote_log=options.dataflash, component=component)
        if not options.no_request:
            session.send = open_.enter_context(speaking(link, component, options.system, signature))
            session.alert = None if options.no_alert else session.send
        _alert_aside(options, session, signature, open_)
        outputs = Outputs(options, session, str(endpoint), open_)
        receiver = Receiver(link)
        open_.callback(receiver.close)
        outputs.receiver = receiver
        # However it ends, what was found is printed.
        with contextlib.suppress(KeyboardInterrupt):
            watch_link(session, receiver, outputs, options.duration)
        outputs.events(session.finish(receiver.now_s()))
    return session


def _replay(options: Options, aircraft: Mapping[int, Aircraft]) -> Session:
    """Replay a log in the same view; nothing is sent but alerts, if they have an address."""
    pace = Pace(1.0 if options.speed is None else options.speed)
    path = Path(options.endpoint)
    with contextlib.ExitStack() as open_:
        log = one_log(path, next(iter(aircraft.values())))
        signature = signature_of(options.signing_key)
        recorded = signature.of_any_time() if signature else None
        is_stream = log.format == "tlog"
        if not is_stream:
            if len(aircraft) > 1:
                raise ConfigError(f"{path}: is the log of one vehicle; give the one -c FILE of it")
            aircraft = {system: resolved(log, craft) for system, craft in aircraft.items()}
        aircraft = {system: with_current_sources(log, craft) for system, craft in aircraft.items()}
        # Whether it has the aircraft's channels in the autopilot's own log, which came with it.
        wanted = {s.watched_channel for craft in aircraft.values() for s in craft.surfaces.values()} - {""}
        remote = is_stream and any(name in log.channels for name in ChannelTable(wanted).unknown)
        codec = Codec(0, options.component, signature=recorded)
        session = Session(codec, aircraft, is_stream=is_stream, remote_log=remote)
        _alert_aside(options, session, signature, open_)
        outputs = Outputs(options, session, options.endpoint, open_)
        replay = partial(replay_telemetry, session, path) if is_stream else partial(replay_log, session, log)
        outputs.events(session.finish(replay(outputs, pace, options.duration)))
    return session


def _alert_aside(options: Options, session: Session, signature: Signature | None, open_: contextlib.ExitStack) -> None:
    if options.alert_to:
        link = open_link(parse_endpoint(options.alert_to))
        open_.callback(link.close)
        session.alert = open_.enter_context(speaking(link, options.component, options.system, signature))


def _verdict(session: Session) -> int:
    """Exit code; the reason for a 2 goes to stderr."""
    axes = [vehicle.axes for vehicle in session.vehicles.values() if vehicle.axes is not None]
    if any(monitor.has_fault for monitor in session.judges) or any(one.has_fault for one in axes):
        return 1
    suspect = [audit.reason for one in axes if one.has_suspect for audit in one.audits if audit.status == "suspect"]
    doubtful = [f"{one.name}: {describe(one.suspicions[0])}" for one in session.judges if one.suspicions]
    unjudged = session.unjudged() if session.watched or all(one.problem for one in axes) else ""
    names = ", ".join(sorted(session.names)[:8])
    if any(one.has_suspect for one in axes):
        complain(f"not cleared: {next(iter(suspect), 'an axis did not answer its command')}")
    elif doubtful:
        complain(f"not cleared: no alarm stands, but look at it: {'; '.join(doubtful)}")
    elif unjudged:
        is_dark = names and not any(monitor.was_judged for _, monitor in session.watched)
        complain(f"could not tell: {unjudged}{f'; received {names}' if is_dark else ''}")
    else:
        return 0
    return 2


def _aircraft(names: list[str], *, has_card: bool) -> dict[int, Aircraft]:
    """The aircraft by system; channels of the log on the card become those of telemetry where it does not come."""
    known: dict[int, Aircraft] = {}
    loaded: list[Aircraft] = []
    for name in names:
        head, equals, path = name.partition("=")
        numbered = equals and head.isdigit()
        system = int(head) if numbered else min((0, *(number - 1 for number in known)))
        if numbered and (system in known or not 0 < system < 256):
            what = "has two files" if system in known else "is no system id, which is 1 to 255"
            raise ConfigError(f"-c {name}: vehicle {system} {what}")
        aircraft = load_aircraft(path if numbered else name)
        if not numbered and aircraft in loaded:
            by_id = f"-c 1={name} -c 2={name}, by system id"
            raise ConfigError(f"-c {name}: given twice; two vehicles of one file are {by_id}")
        loaded.append(aircraft)
        unnamed = [key for key, one in aircraft.surfaces.items() if not one.can_be_watched]
        if unnamed and len(unnamed) == len(aircraft.surfaces):
            raise ConfigError(
                f"{path or name}: {', '.join(unnamed)}: no servo is named; name one (servo = ...), or let "
                "'servofd calibrate' make the file from a good flight"
            )
        if unnamed:
            complain(f"{', '.join(unnamed)}: not watched: no servo is named; calibrate them on a good flight, too")
        known[system] = streamed(aircraft, has_card=has_card)
    return known
