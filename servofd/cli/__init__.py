"""The command line: one file per verb, and the only place that prints or chooses exit codes.

Exit codes: 0 done and healthy, 1 done and at least one fault or unexplained gap, 2 could not tell (one line on stderr
says why).
"""

from __future__ import annotations

import argparse
import io
import os
import signal
import sys
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from servofd import __version__
from servofd.cli import (
    audit,
    calibrate,
    config,
    design,
    explain,
    fleet,
    identify,
    info,
    manual,
    monitor,
    odds,
    review,
    servos,
    simulate,
    sweep,
    trend,
    view,
)
from servofd.cli.completion import SHELLS, PrintCompletion
from servofd.cli.interrupt import interruptible
from servofd.cli.tables import one_line

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["main"]

_VERBS = (
    info,
    config,
    calibrate,
    audit,
    monitor,
    fleet,
    trend,
    view,
    review,
    explain,
    sweep,
    odds,
    identify,
    simulate,
    servos,
    design,
    manual,
)
"""In the order in which the help shows them."""

_COULD_NOT_TELL = 2
_INTERRUPTED = 128 + signal.SIGINT


class _OneLineParser(argparse.ArgumentParser):
    """Reports a wrong call in one line, with the way to help; options must be spelt out."""

    def __init__(self, **options: Any) -> None:  # noqa: ANN401 - whatever argparse takes
        super().__init__(**(options | {"allow_abbrev": False}))

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
    parser.add_argument(
        "--print-completion",
        action=PrintCompletion,
        choices=SHELLS,
        help="print what lets the tabulator key complete verbs, options and files: eval it in your shell's start file",
    )
    verbs = parser.add_subparsers(dest="verb", metavar="VERB", required=True)
    for verb in _VERBS:
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
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # a terminal that cannot show a sign shows a question mark
    parser = build_parser()
    if any("\0" in word for word in arguments or ()):
        parser.error("a word with a NUL in it, which is in no file's name")
    options = parser.parse_args(arguments)
    # Vectors of a log are too short to share out: threads that wait for each other took two to five times the time.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Importing these takes a while; `servofd --help` does without.
    from logparsers import LogError
    from servofd.errors import ServofdError

    try:
        with interruptible():
            code: int = options.run(options)
            if sys.stdout is not None:
                sys.stdout.flush()
    except (LogError, ServofdError) as error:
        print(f"servofd: {one_line(error)}", file=sys.stderr)
        return _COULD_NOT_TELL
    except KeyboardInterrupt:
        print("servofd: interrupted; nothing half-written was left behind", file=sys.stderr)
        return _INTERRUPTED
    except BrokenPipeError:
        # The reader of our output has gone (`servofd ... | head`); keep Python from complaining at exit.
        _silence()
        return _COULD_NOT_TELL
    except OSError as error:
        print(f"servofd: cannot write the result: {error.strerror or error}", file=sys.stderr)
        _silence()
        return _COULD_NOT_TELL
    return code


def _silence() -> None:
    """Keep Python from trying again, and complaining, when it exits."""
    with suppress(io.UnsupportedOperation), Path(os.devnull).open("wb") as nowhere:
        os.dup2(nowhere.fileno(), sys.stdout.fileno())  # what a caller put in its place writes to no file
