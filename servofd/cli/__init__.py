"""The command line: one file per verb, and the only place that prints or chooses exit codes.

Exit codes: 0 done and healthy, 1 done and at least one fault or unexplained gap, 2 could not tell (one line on stderr
says why).
"""

from __future__ import annotations

import argparse
import atexit
import gc
import io
import os
import signal
import sys
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from servofd.cli import (
    audit,
    calibrate,
    config,
    design,
    explain,
    fleet,
    identify,
    info,
    look,
    manual,
    monitor,
    odds,
    onboard,
    review,
    serve,
    servos,
    simulate,
    sweep,
    trend,
    view,
)
from servofd.cli.completion import SHELLS, PrintCompletion
from servofd.cli.interrupt import interruptible
from servofd.cli.parser import COULD_NOT_TELL, OneLineParser
from servofd.cli.tables import one_line
from servofd.cli.terminal import plain_streams
from servofd.version import __version__

if TYPE_CHECKING:
    from collections.abc import Sequence
    from types import ModuleType

__all__ = ["main", "parsed"]

_GROUPS = {
    "look at flights": (audit, info, explain, view, review, fleet, trend, serve),
    "model an aircraft": (config, calibrate, identify, sweep, servos, odds, design),
    "fly": (monitor, onboard, simulate),
    "more": (manual,),
}
"""In the order in which the help shows them."""
_VERBS = tuple(verb for group in _GROUPS.values() for verb in group)

_INTERRUPTED = 128 + signal.SIGINT
_OBJECTS_BETWEEN_SEARCHES = 100_000


class _WholeParser(OneLineParser):
    """Its help lists the verbs by what one wants to do."""

    def format_help(self) -> str:
        """What to type first, then the verbs in their groups."""
        (verbs,) = (action for action in self._actions if isinstance(action, argparse._SubParsersAction))
        says = {action.dest: action.help or "" for action in verbs._choices_actions}
        lines = [
            "usage: servofd LOG... [-c AIRCRAFT.toml] [options]     judge, and open the page",
            "       servofd VERB ...",
            "",
            str(self.description),
            "",
            "LOG is a flight log (.bin, .log, .tlog, .ulg, .mat, .csv, ...), a folder of them, a recording (.rrd), or",
            "the endpoint of a flying aircraft (udpin:127.0.0.1:14550).",
        ]
        for title, group in _GROUPS.items():
            lines += ["", f"{title}:", *(f"  {name:<12}{says[name]}" for name in map(_name, group))]
        lines += [
            "",
            "servofd help VERB tells its options, servofd LOG --help those of the first form.",
            str(self.epilog),
        ]
        return "\n".join(lines) + "\n"


def build_parser() -> argparse.ArgumentParser:
    """All verbs and their options."""
    parser = _WholeParser(
        prog="servofd",
        description="Tells which servo of an aircraft is lying, from its flight log.",
        epilog="Example: servofd sample_logs/faser_stuck_flight.mat",
    )
    parser.add_argument("--version", action="version", version=f"servofd {__version__}")
    parser.add_argument(
        "--print-completion",
        action=PrintCompletion,
        choices=SHELLS,
        help="print what lets the tabulator key complete verbs, options and files: eval it in your shell's start file",
    )
    verbs = parser.add_subparsers(dest="verb", metavar="VERB", parser_class=OneLineParser)
    for verb in _VERBS:
        verb.add_parser(verbs)
    parser.set_defaults(whole=parser)  # whose page `servofd help` shows
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
    with plain_streams():
        return _main(arguments)


def _main(arguments: Sequence[str] | None) -> int:
    options = parsed(sys.argv[1:] if arguments is None else arguments)
    # Vectors of a log are too short to share out: threads that wait for each other took two to five times the time.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # What is imported stays: to search it for circles, again and again and once more at the end, took 0.15 s of 0.95.
    gc.set_threshold(_OBJECTS_BETWEEN_SEARCHES)
    atexit.register(gc.freeze)
    # Importing these takes a while; `servofd --help` does without.
    from logparsers import LogError
    from servofd.core.errors import EXTRAS, ServofdError, without

    try:
        with interruptible():
            code: int = options.run(options)
            if sys.stdout is not None:
                sys.stdout.flush()
    except (LogError, ServofdError) as error:
        print(f"servofd: {one_line(error)}", file=sys.stderr)
        return COULD_NOT_TELL
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package not in EXTRAS:
            raise
        print(f"servofd: {without(package)}", file=sys.stderr)
        return COULD_NOT_TELL
    except KeyboardInterrupt:
        print("servofd: interrupted; nothing half-written was left behind", file=sys.stderr)
        return _INTERRUPTED
    except BrokenPipeError:
        # The reader of our output has gone (`servofd ... | head`); keep Python from complaining at exit.
        _silence()
        return COULD_NOT_TELL
    except OSError as error:
        print(f"servofd: cannot write the result: {error.strerror or error}", file=sys.stderr)
        _silence()
        return COULD_NOT_TELL
    return code


def parsed(words: Sequence[str]) -> argparse.Namespace:
    """Options of a verb, or of the logs, the recording or the endpoint that stand in its place."""
    parser = build_parser()
    if any("\0" in word for word in words):
        parser.error("a word with a NUL in it, which is in no file's name")
    names = [_name(verb) for verb in _VERBS]
    verb = look.verb_for(words, names) if words else ""
    if verb == "look":
        return look.look_parser().parse_args(words)
    if verb and verb != words[0]:
        return parser.parse_args([verb, *words])
    if words and not verb and not words[0].startswith("-"):
        from servofd.core.errors import suggest

        if words[0] == "compare":
            parser.error("compare: recordings are compared by: servofd review A.rrd --compare B.rrd")
        parser.error(f"{words[0]}: no such file, and {suggest('verb', words[0], names)}")
    options = parser.parse_args(words)
    if options.verb is None:
        parser.error("a log or a verb is needed: servofd flight.bin judges a flight")
    return options


def _name(verb: ModuleType) -> str:
    """What the user types for a verb."""
    return "help" if verb is manual else verb.__name__.rpartition(".")[2]


def _silence() -> None:
    """Keep Python from trying again, and complaining, when it exits."""
    with suppress(io.UnsupportedOperation), Path(os.devnull).open("wb") as nowhere:
        os.dup2(nowhere.fileno(), sys.stdout.fileno())  # what a caller put in its place writes to no file
