"""``servofd FILE``: by what the file is, it does what is wanted most: judge, write a page, open it."""

from __future__ import annotations

import os
import sys
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING

from servofd.cli import audit
from servofd.cli.parser import OneLineParser
from servofd.core.files import beginning, distinct_file_names, write_whole

if TYPE_CHECKING:
    import argparse
    from collections.abc import Collection, Sequence

    from servofd.detection.verdict import LogAudit
    from servofd.outputs.json_report import FailedLog

_PACKED = (".gz", ".zip", ".bz2", ".xz")
_HEAD_BYTES = 2000
_WORST_FIRST = ("fault", "suspect", "unknown", "no_data", "healthy")


def verb_for(words: Sequence[str], verbs: Collection[str]) -> str:
    """What the words ask for: a verb, ``look`` at logs, or nothing where they name neither.

    Examples
    --------
    >>> [verb_for([word], {"audit"}) for word in ("flight.bin", "udpin:127.0.0.1:14550", "audti", "audit")]
    ['look', 'monitor', '', 'audit']
    """
    first = words[0]
    if first.startswith("-"):
        of_the_program = first.partition("=")[0] in ("-h", "--help", "--version", "--print-completion")
        return "look" if not of_the_program and any(not word.startswith("-") for word in words[1:]) else ""
    if first in verbs:
        return first
    if Path(first).exists():
        return "review" if _is_recording(Path(first)) else "look"
    if _is_endpoint(first):
        return "monitor"
    return "look" if set("./\\*?") & set(first) else ""


def _is_recording(path: Path) -> bool:
    from logparsers.detect import RECORDING

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


def look_parser() -> argparse.ArgumentParser:
    """Options of ``servofd FILE``: those of an audit, and whether to open the page."""
    parser = OneLineParser(
        prog="servofd",
        description="Judges every surface of a flight log, writes a page beside it (or into -o DIR) and opens it. "
        "A folder is many logs, an endpoint such as udpin:127.0.0.1:14550 a flying aircraft. "
        "Exit code 0: healthy; 1: a fault was found; 2: could not tell.",
        epilog="All verbs: servofd --help",
    )
    audit.add_options(parser)
    parser.add_argument("--no-open", action="store_true", help="write the page, and do not open it")
    parser.set_defaults(run=run)
    return parser


def run(options: argparse.Namespace) -> int:
    """Audit, write what was asked for and the page, print what it comes to in at most four lines."""
    from servofd.cli.audit_fleet import is_fleet
    from servofd.cli.tables import one_line

    audit.check(options)
    if is_fleet(options) or len(options.logs) > 1:
        return _many(options)
    results = audit.judged(options)
    audit.write(options, results)
    page = Path(options.html) if options.html else _written(options, results)
    if options.json == "-":
        audit.print_json(results)
    else:
        for line in closing_lines(results, page):
            print(one_line(line))
    _open(page, options)
    return audit.exit_code(results)


def _many(options: argparse.Namespace) -> int:
    """Pages of many logs, in a folder, with one that links to them."""
    from servofd.cli.audit_fleet import PAGE, run_fleet

    folder = Path(options.output) if options.output else _beside(options.logs[0])
    options.output, options.pages = None, str(folder)
    code = run_fleet(options)
    _open(folder / PAGE, options)
    return code


def _beside(name: str) -> Path:
    first = Path(name)
    folder = first if first.is_dir() else first.parent
    return (folder if os.access(folder, os.W_OK) else Path()) / "servofd"


def closing_lines(results: Sequence[LogAudit | FailedLog], page: Path | None) -> list[str]:
    """What happened, what to do, what is well, and where the page is: at most four lines."""
    from servofd.detection.words import next_step
    from servofd.outputs.json_report import FailedLog
    from servofd.outputs.motors import motors_of
    from servofd.outputs.sentence import spoken, whole_sentence, worst

    where = f" → {page}" if page else ""
    audits = [result for result in results if not isinstance(result, FailedLog)]
    if not audits:
        failed = next((result for result in results if isinstance(result, FailedLog) and result.log is not None), None)
        motors = None if failed is None or failed.log is None else motors_of(failed.log)
        return [f"Could not tell.{where}" if motors is None else f"No control surfaces: a {motors['kind']}.{where}"]
    shown = min(audits, key=lambda audit: _WORST_FIRST.index(worst((*audit.surfaces, *audit.axes))))
    run_name = f"Run {shown.log.run}: " if shown.log.run else ""
    lines = [f"{run_name}{whole_sentence(shown)}{where}"]
    if len(audits) > 1:
        clear = sum(worst((*audit.surfaces, *audit.axes)) == "healthy" for audit in audits)
        lines.append(f"{clear} of {len(audits)} runs are healthy; this one is the worst.")
    steps = [
        f"{spoken(s.surface).capitalize()}: {next_step(s).removeprefix('do not fly; ')}."
        for s in shown.surfaces
        if s.status in ("fault", "suspect")
    ]
    lines += steps[:1]
    healthy = [spoken(s.surface) for s in shown.surfaces if s.status == "healthy"]
    if healthy and steps:
        lines.append(f"Followed {'its command' if len(healthy) == 1 else 'their commands'}: {', '.join(healthy)}.")
    return lines


def _written(options: argparse.Namespace, results: Sequence[LogAudit | FailedLog]) -> Path | None:
    """Write the page into ``-o``, else beside the log, else where the user is; None if there is nothing to show."""
    from servofd.outputs.audit_page import audit_page
    from servofd.outputs.json_report import FailedLog
    from servofd.outputs.motors import motors_of

    failed = [result for result in results if isinstance(result, FailedLog)]
    if len(failed) == len(results) and not any(one.log is not None and motors_of(one.log) for one in failed):
        return None
    log = Path(options.logs[0])
    folder = Path(options.output) if options.output else log.parent if os.access(log.parent, os.W_OK) else Path()
    bare = Path(log.stem).stem if log.suffix in _PACKED else log.stem
    for stem in distinct_file_names([bare, log.name, f"{log.name}.servofd"]):
        target = folder / f"{stem}.html"
        if not target.exists() or _is_of(target, log.name):
            break
    write_whole(target, audit_page(results).encode())
    return target


def _is_of(page: Path, log: str) -> bool:
    """Whether a page is ours, and of the same log: only such a one is written over without being asked."""
    from servofd.outputs.page import source_tag

    try:
        return source_tag(log).encode() in beginning(page, _HEAD_BYTES)
    except OSError:
        return False


def _open(page: Path | None, options: argparse.Namespace) -> None:
    """Show the page to whoever sits there: not where there is no display, or the output goes to a file."""
    display = not sys.platform.startswith("linux") or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if page is not None and not options.no_open and display and sys.stdout.isatty():
        webbrowser.open(page.resolve().as_uri())
