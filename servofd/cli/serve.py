"""``servofd serve``: a local page for logs."""

from __future__ import annotations

import argparse
import secrets
import sys
from pathlib import Path
from typing import Any

from servofd.cli.parser import whole

_PORT, _MOST_MB = 8787, 4096
_FREE_PORT, _SIZE = whole("a port from 0 to 65535", 0, 65_535), whole("a number from 1 to 1000000", 1, 1_000_000)
_LOOPBACK = ("127.0.0.1", "localhost", "::1")


def add_parser(verbs: argparse._SubParsersAction[Any]) -> None:
    """Declare the verb."""
    parser = verbs.add_parser(
        "serve",
        help="a local page: drop logs on it, see their verdicts",
        description="Serves a page on this computer: logs that are dropped on it, or lie in its folder, are judged one "
        "after the other; each gets its page, JSON and recording. Ctrl-C ends it.",
        epilog="Example: servofd serve --folder flights",
    )
    parser.add_argument("--folder", default="flights", metavar="DIR", help="folder of logs (default: flights)")
    parser.add_argument("-c", "--config", metavar="AIRCRAFT.toml", help="aircraft file, or the name of a shipped one")
    parser.add_argument(
        "--servo",
        metavar="NAME",
        help="servo of all surfaces: of the library, FILE.toml, or unknown (fitted)",
    )
    parser.add_argument(
        "--port", type=_FREE_PORT, default=_PORT, metavar="PORT", help=f"(default: {_PORT}; 0: a free one)"
    )
    parser.add_argument(
        "--host",
        default=_LOOPBACK[0],
        metavar="ADDRESS",
        help="address to listen on (default: this computer only); for any other a link with a token is printed",
    )
    parser.add_argument(
        "--most-mb", type=_SIZE, default=_MOST_MB, metavar="MB", help=f"largest log that is taken (default: {_MOST_MB})"
    )
    parser.add_argument("--workers", type=_SIZE, metavar="N", help="processes (default: one per core)")
    parser.add_argument("--no-open", action="store_true", help="do not open the page")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Serve until Ctrl-C."""
    from servofd.aircraft.schema import UNKNOWN_SERVO, load_aircraft
    from servofd.batch.key import Job
    from servofd.core.errors import ConfigError, needs
    from servofd.servo.library import find_servo

    needs("starlette", "uvicorn")
    from servofd.serve.app import application
    from servofd.serve.flights import Flights
    from servofd.serve.server import listening, serve

    if options.servo not in (None, UNKNOWN_SERVO):
        find_servo(options.servo)
    job = Job(load_aircraft(options.config) if options.config else None, options.servo)
    token = "" if options.host in _LOOPBACK else secrets.token_urlsafe(18)
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
        print(f"{link}   flights in {folder.resolve()}; Ctrl-C ends it", flush=True)
        if token:
            print("Whoever has this link sees all flights of the folder.", file=sys.stderr)
        serve(application(flights, token), sockets, "" if options.no_open else link)
    return 0
