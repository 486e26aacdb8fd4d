"""``servofd serve``: a local page for logs."""

from __future__ import annotations

import secrets
from pathlib import Path
from typing import TYPE_CHECKING

from servofd.aircraft.schema import UNKNOWN_SERVO, check_servo, load_aircraft
from servofd.batch.key import Job
from servofd.cli.options import LOOPBACK
from servofd.cli.terminal import say, say_aside
from servofd.core.errors import ConfigError
from servofd.serve.app import application
from servofd.serve.flights import Flights
from servofd.serve.guard import listening, serve

if TYPE_CHECKING:
    from servofd.cli.options import Options


def run(options: Options) -> int:
    """Serve until Ctrl-C."""
    if options.servo not in (None, UNKNOWN_SERVO):
        check_servo(options.servo)
    job = Job(load_aircraft(options.config) if options.config else None, options.servo)
    token = "" if options.host in LOOPBACK else secrets.token_urlsafe(18)
    try:
        sockets = listening(options.host, options.port)
    except OSError as error:
        reason = error.strerror or error
        raise ConfigError(
            f"{options.host}:{options.port}: cannot listen here: {reason}; --port 0 takes a free one"
        ) from None
    host = f"[{options.host}]" if ":" in options.host else options.host
    link = f"http://{host}:{sockets.getsockname()[1]}/{f'?token={token}' if token else ''}"
    folder = Path(options.folder)
    with Flights(folder, job, most_bytes=options.most_mb * 1_000_000, workers=options.workers) as flights:
        say(f"{link}   flights in {folder.resolve()}; Ctrl-C ends it")
        if token:
            say_aside("Whoever has this link sees all flights of the folder.")
        serve(application(flights, token), sockets, "" if options.no_open else link)
    return 0
