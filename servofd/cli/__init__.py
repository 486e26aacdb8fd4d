"""The command line: one file per verb, and the only place that prints or chooses exit codes.

Exit codes: 0 done and healthy, 1 done and at least one fault, 2 could not tell (one line on stderr says why).
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
from typing import TYPE_CHECKING, NoReturn

from servofd import __version__
from servofd.cli import audit, config, design, info, servos, simulate

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["main"]

_COULD_NOT_TELL = 2
_INTERRUPTED = 128 + signal.SIGINT


class _OneLineParser(argparse.ArgumentParser):
    """Reports a wrong call in one line, with the way to help."""

    def error(self, message: str) -> NoReturn:
        self.exit(_COULD_NOT_TELL, f"{self.prog}: {message} (see '{self.prog} --help')\n")


def build_parser() -> argparse.ArgumentParser:
    """All verbs and their options."""
    parser = _OneLineParser(
        prog="servofd",
        description="Tells which servo of an aircraft is lying, from its flight log.",
        epilog="Example: servofd audit sample_logs/faser_stuck_flight.mat",
    )
    parser.add_argument("--version", action="version", version=f"servofd {__version__}")
    verbs = parser.add_subparsers(dest="verb", metavar="VERB", required=True)
    for verb in (info, config, audit, simulate, servos, design):
        verb.add_parser(verbs)
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one verb and return its exit code.

    Parameters
    ----------
    arguments : sequence of str, optional
        Words after the program's name; those of the process if left out.

    Examples
    --------
    >>> main(["design", "s9254", "--pole", "50"])  # doctest: +ELLIPSIS
    Futaba S9254...
    0
    """
    options = build_parser().parse_args(arguments)
    # Importing these takes a while; `servofd --help` does without.
    from logparsers import LogError
    from servofd.errors import ServofdError

    try:
        code: int = options.run(options)
        sys.stdout.flush()
    except (LogError, ServofdError) as error:
        print(f"servofd: {error}", file=sys.stderr)
        return _COULD_NOT_TELL
    except KeyboardInterrupt:
        print("servofd: interrupted; nothing half-written was left behind", file=sys.stderr)
        return _INTERRUPTED
    except BrokenPipeError:
        # The reader of our output has gone (`servofd ... | head`); keep Python from complaining at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _COULD_NOT_TELL
    return code
