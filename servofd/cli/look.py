"""``servofd FILE``: by what the file is, it does what is wanted most: judge, write a page, open it."""

from __future__ import annotations

import os
import sys
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING

from servofd.cli import audit
from servofd.cli.terminal import one_line, say
from servofd.jobs.workflow import FailedLog
from servofd.outputs.audit_report import audit_report
from servofd.outputs.page import FLEET_PAGE
from servofd.outputs.sentence import LEAST_CLEARED, answers, whole_sentence, worst

if TYPE_CHECKING:
    from collections.abc import Sequence

    from servofd.cli.options import Options
    from servofd.detection.verdict import LogAudit


def run(options: Options) -> int:
    """Audit, write what was asked for and the page, print what it comes to in at most four lines."""
    audit.check(options)
    if audit.is_fleet(options) or len(options.logs) > 1:
        return _many(options)
    results = audit.judged_logs(options)
    report = audit_report(results)
    audit.write(options, results, report)
    page = Path(options.html) if options.html else audit.page_of(options, report)
    if options.json != "-":
        for line in _closing_lines(results, report.sentence, page):
            say(one_line(line))
    _open(page, options)
    return audit.exit_code(results)


def _many(options: Options) -> int:
    """Pages of many logs, in a folder, with one that links to them."""
    from servofd.cli.fleet import run_fleet

    first = Path(options.logs[0])
    beside = first if first.is_dir() else first.parent
    folder = Path(options.output or (beside if os.access(beside, os.W_OK) else Path()) / "servofd")
    options.output, options.pages = None, str(folder)
    code = run_fleet(options, audit.job_of(options))
    _open(folder / FLEET_PAGE, options)
    return code


def _closing_lines(results: Sequence[LogAudit | FailedLog], sentence: str, page: Path | None) -> list[str]:
    """What happened, what to do, what is well, and where the page is: one line a surface."""
    where = f" → {page}" if page else ""
    audits = [result for result in results if not isinstance(result, FailedLog)]
    if not audits:
        return [f"{sentence}{where}"]
    shown = min(audits, key=lambda audit: LEAST_CLEARED.index(worst((*audit.surfaces, *audit.axes))))
    run_name = f"Run {shown.log.run}: " if shown.log.run else ""
    lines = [f"{run_name}{whole_sentence(shown)}{where}"]
    if len(audits) > 1:
        clear = sum(worst((*audit.surfaces, *audit.axes)) == "healthy" for audit in audits)
        lines.append(f"{clear} of {len(audits)} runs are healthy; this one is the worst.")
    return lines + answers(shown)


def _open(page: Path | None, options: Options) -> None:
    """Show the page to whoever sits there: not where there is no display, or the output goes to a file."""
    display = not sys.platform.startswith("linux") or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if page is not None and not options.no_open and display and sys.stdout.isatty():
        webbrowser.open(page.resolve().as_uri())
