"""The command line: one file per verb, and the only place that prints or chooses exit codes.

``servofd LOG`` is in that of ``audit``.

Exit codes: 0 done and healthy, 1 done and at least one fault or unexplained gap, 2 could not tell (one line on stderr
says why).
"""

from __future__ import annotations

import _thread
import atexit
import gc
import io
import os
import pydoc
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path

from servofd.cli.options import COULD_NOT_TELL, VERBS, WAYS, Options, build_parser, look_parser, way_parser
from servofd.cli.terminal import complain, say, say_aside

__all__ = ["build_parser", "interruptible", "main", "parsed"]

_WITHIN = ("design", "servos", "view")
"""Other ways of a verb that stand in its file."""
_NOT_SIMULATING = (*_WITHIN, "config", "help", "info", "review")
"""Verbs that simulate no servo."""
_INTERRUPTED = 128 + signal.SIGINT
"""Exit code after Ctrl-C, as shells have it: 128 and the number of the signal."""
_OBJECTS_BETWEEN_SEARCHES = 100_000
"""New objects after which Python looks for circles of unused ones: rarely, for verbs are short."""
_AGAIN_S = 0.01
"""Pause before an interrupt that was raised where it cannot be handled is raised again [s]."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one verb and return its exit code; `arguments` are the words after the program's name, if not its own."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # a terminal that cannot show a sign shows a question mark
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
            if options.verb not in _NOT_SIMULATING:
                from servofd.jobs.prepare import compile_ahead

                waits = sys.stderr is not None and sys.stderr.isatty()
                compile_ahead(lambda sentence: say_aside(sentence) if waits else None)
            code = _function_of(options.verb)(options)
            if sys.stdout is not None:
                sys.stdout.flush()
            return code
    except (LogError, ServofdError) as error:
        complain(error)
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package not in EXTRAS:
            raise
        complain(without(package))
    except KeyboardInterrupt:
        complain("interrupted; nothing half-written was left behind")
        return _INTERRUPTED
    except OSError as error:
        if not isinstance(error, BrokenPipeError):  # else the reader of our output has gone (`servofd ... | head`)
            complain(f"cannot write the result: {error.strerror or error}")
        # Python would try again, and complain, when it exits; what a caller put in the place of stdout is no file.
        with suppress(io.UnsupportedOperation), Path(os.devnull).open("wb") as nowhere:
            os.dup2(nowhere.fileno(), sys.stdout.fileno())
    return COULD_NOT_TELL


def _function_of(verb: str) -> Callable[[Options], int]:
    """What does a verb, or another way of one, which stands in a file of its own or in that of its verb."""
    if verb == "help":
        return _show_help
    module = import_module(f"servofd.cli.{WAYS[verb][0] if verb in _WITHIN else verb}")
    found: Callable[[Options], int] = getattr(module, f"run_{verb}" if verb in _WITHIN else "run")
    return found


def parsed(words: Sequence[str]) -> Options:
    """Options of a verb, or of the logs, the recording or the endpoint that stand in its place."""
    words = list(words)
    parser = build_parser()
    if any("\0" in word for word in words):
        parser.error("a word with a NUL in it, which is in no file's name")
    if words[:1] == ["version"]:
        words = ["--version"]
    if words and words[0] in WAYS:
        verb, option, *_ = WAYS[words[0]]
        say_aside(f"servofd: 'servofd {words[0]}' is now 'servofd {verb} {option}'")
        return way_parser(words[0]).parse_args(words[1:])
    verb = _verb_for(words) if words else ""
    for way, (of, option, *_) in WAYS.items():
        if option in words and of == ("audit" if verb == "look" else verb):
            return way_parser(way).parse_args([word for word in words[words[0] == of :] if word != option])
    if verb == "look":
        return look_parser().parse_args(words)
    if verb and verb != words[0]:
        return parser.parse_args([verb, *words])
    if words and not verb and not words[0].startswith("-"):
        from servofd.core.errors import suggest

        if words[0] == "compare":
            parser.error("compare: recordings are compared by: servofd review A.rrd --compare B.rrd")
        parser.error(f"{words[0]}: no such file, and {suggest('verb', words[0], VERBS)}")
    options = parser.parse_args(words)
    if options.verb is None:
        parser.error("a log or a verb is needed: servofd flight.bin judges a flight")
    return options


def _verb_for(words: Sequence[str]) -> str:
    """What the words ask for: a verb, ``look`` (the audit that opens its page), or nothing where they name neither."""
    first = words[0]
    if first.startswith("-"):
        of_the_program = first.partition("=")[0] in ("-h", "--help", "--version")
        return "look" if not of_the_program and any(not word.startswith("-") for word in words[1:]) else ""
    if first in VERBS:
        return first
    if Path(first).exists():
        return "review" if _is_recording(Path(first)) else "look"
    if _is_endpoint(first):
        return "monitor"
    return "look" if set("./\\*?") & set(first) else ""


def _is_recording(path: Path) -> bool:
    from logparsers.detect import RECORDING
    from servofd.core.files import beginning

    try:
        return beginning(path, 4).startswith(RECORDING)
    except OSError:  # a folder, or a file that the audit tells what is wrong with
        return False


def _is_endpoint(word: str) -> bool:
    from logparsers.endpoint import parse_endpoint
    from logparsers.errors import LinkError

    try:
        parse_endpoint(word)
    except LinkError:
        return word.partition(":")[0] in ("udpin", "udpout", "tcp", "tcpin")
    return True


def _show_help(options: Options) -> int:
    """The manual of a verb, or the list of them, page by page on a terminal."""
    about = options.about
    parser = way_parser(about) if about in WAYS else ({None: options.whole} | options.manuals).get(about)
    if parser is None:
        from servofd.core.errors import UnknownName, suggest

        raise UnknownName(suggest("verb", about, VERBS))
    if sys.stdout.isatty():
        pydoc.pager(parser.format_help())
    else:
        say(parser.format_help(), end="")
    return 0


@contextmanager
def interruptible() -> Iterator[None]:
    """Within the block, the end of the terminal and a termination raise `KeyboardInterrupt`, and no interrupt is lost.

    Python ignores an exception that strikes inside a finaliser or a weak reference's callback: the run would go
    on, with a traceback on the screen. Such an interrupt is raised once more, a moment later. One that strikes while a
    compiled module loads comes out as an `ImportError`, and is an interrupt again here.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    ends = [signal.SIGINT, signal.SIGTERM]
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:  # not under nohup
        ends.append(signal.SIGHUP)
    before = {number: signal.getsignal(number) for number in ends}
    unraisable, struck = sys.unraisablehook, threading.Event()

    def strike(_number: int, _frame: object) -> None:
        struck.set()
        raise KeyboardInterrupt

    def ignored(event: sys.UnraisableHookArgs) -> None:
        if issubclass(event.exc_type, KeyboardInterrupt):
            # Not from here: this hook may not raise either.
            threading.Timer(_AGAIN_S, _thread.interrupt_main).start()
        else:
            unraisable(event)

    for number in before:
        signal.signal(number, strike)
    sys.unraisablehook = ignored
    try:
        yield
    except ImportError as error:
        if struck.is_set():
            raise KeyboardInterrupt from error
        raise
    finally:
        sys.unraisablehook = unraisable
        for number, handler in before.items():
            signal.signal(number, handler)
