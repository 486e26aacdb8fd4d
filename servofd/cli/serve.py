"""``servofd serve``: a local page for logs."""

from __future__ import annotations

import socket
from pathlib import Path

from servofd.aircraft.schema import UNKNOWN_SERVO, check_servo, load_aircraft
from servofd.batch.key import Job
from servofd.cli.options import Options
from servofd.cli.terminal import say
from servofd.core.errors import ConfigError
from servofd.serve.app import application
from servofd.serve.flights import Flights
from servofd.serve.guard import serve

_HOST = "127.0.0.1"
"""Nobody but this computer can talk to the page."""


def run(options: Options) -> int:
    """Serve until Ctrl-C."""
    if options.servo not in (None, UNKNOWN_SERVO):
        check_servo(options.servo)
    job = Job(load_aircraft(options.config) if options.config else None, options.servo)
    try:
        sockets = socket.create_server((_HOST, options.port))
    except OSError as error:
        reason = error.strerror or error
        raise ConfigError(f"{_HOST}:{options.port}: cannot listen here: {reason}; --port 0 takes a free one") from None
    link = f"http://{_HOST}:{sockets.getsockname()[1]}/"
    folder = Path(options.folder)
    with Flights(folder, job, most_bytes=options.most_mb * 1_000_000, workers=options.workers) as flights:
        say(f"{link}   flights in {folder.resolve()}; Ctrl-C ends it")
        serve(application(flights), sockets, "" if options.no_open else link)
    return 0
