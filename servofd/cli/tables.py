"""Tables and progress on the terminal."""

from __future__ import annotations

import sys
from contextlib import contextmanager
from typing import TYPE_CHECKING

from servofd.cli.terminal import console

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from rich.console import Console

    from servofd.detection.verdict import LogAudit, SurfaceAudit

_WIDEST = 100
"""Columns of a terminal that a table of sentences uses: longer lines are hard to read."""
_NARROWEST = 64
"""Below this a table of sentences becomes a list."""


def one_line(message: object) -> str:
    r"""Text of a message on one line, whatever a file name brought into it.

    Examples
    --------
    >>> one_line("a\nb.csv: empty")
    'a b.csv: empty'
    """
    return " ".join(str(message).split())


def print_table(headings: Sequence[str], rows: Sequence[Sequence[str]], title: str = "") -> None:
    """Print rows under headings as a table, on a narrow terminal as a list; coloured by status where a cell is one."""
    _print_table(_console(), headings, rows, title)


def print_verdicts(audit: LogAudit) -> None:
    """Print the verdict on each surface of a log in a sentence, the whole in another, and what to do next.

    At most 100 columns of a terminal are used; in less than 64 the table becomes a list. A file or a pipe has no width:
    there no line is folded.
    """
    from rich.padding import Padding
    from rich.text import Text

    from servofd.detection.words import headline, next_step
    from servofd.outputs.sentence import axes_sentence

    log, shown = audit.log, _console()
    if shown.is_terminal:
        shown.width = min(shown.width, _WIDEST)
    title = f"{log.label}   {log.format}, {log.duration_s:.1f} s"
    rows = [[s.surface, s.status, s.model.origin, _why(s)] for s in audit.surfaces]
    if rows:
        _print_table(shown, ["surface", "status", "model", "why"], rows, title)
    if audit.axes:
        rows = [[axis.axis, axis.status, axis.reason] for axis in audit.axes]
        _print_table(shown, ["axis", "status", "what the motion tells"], rows, "" if audit.surfaces else title)
    for damage in log.damage_summary:
        shown.print(Text(f"damage: {damage.kind}: {damage.note}"))
    shown.print(Text(headline(audit.surfaces) if audit.surfaces else axes_sentence(audit.axes), style="bold"))
    for surface in audit.surfaces:
        if next_step(surface):
            step = Text(f"{surface.surface}: {next_step(surface)}")
            shown.print(Padding(step, (0, 0, 0, 2), expand=False))


def _why(surface: SurfaceAudit) -> str:
    """Why this status; of a healthy surface also what the log would have shown."""
    from servofd.outputs.sentence import seen

    return "; ".join(filter(None, (surface.reason, seen(surface.detectable) if surface.status == "healthy" else "")))


def _console() -> Console:
    shown = console()
    return shown if shown.is_terminal else console(width=400)


def _print_table(shown: Console, headings: Sequence[str], rows: Sequence[Sequence[str]], title: str) -> None:
    from rich import box
    from rich.table import Table
    from rich.text import Text

    if shown.width < _NARROWEST:
        _print_list(shown, headings, rows, title)
        return
    table = Table(*headings, title=title or None, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    for row in rows:
        table.add_row(*(Text(cell, style=_style(cell)) for cell in row))
    shown.print(table)


def _print_list(shown: Console, headings: Sequence[str], rows: Sequence[Sequence[str]], title: str) -> None:
    """Each row as its first two cells on a line, numbers with their headings below, and the last cell as it is."""
    from rich.padding import Padding
    from rich.text import Text

    if title:
        shown.print(Text(title, style="bold"))
    for row in rows:
        shown.print(Text.assemble(f"{row[0]}: ", (row[1], _style(row[1]))))
        named = [f"{heading} {cell}" for heading, cell in zip(headings[2:-1], row[2:-1], strict=True) if cell]
        for line in filter(None, (", ".join(named), *row[2:][-1:])):
            shown.print(Padding(Text(line), (0, 0, 0, 2), expand=False))


def _style(cell: str) -> str:
    """Colour of a cell that is a status; none of any other."""
    from servofd.outputs.palette import STATUS_COLOURS

    colour = STATUS_COLOURS.get(cell, "")
    return f"bold {colour}" if cell == "fault" else colour


@contextmanager
def progress_bar(what: str, total: int) -> Iterator[Callable[[str], None]]:
    """Show how far a job is, on stderr and only if somebody looks; gives the function to call after each step."""
    if not sys.stderr.isatty():
        yield lambda _step: None
        return
    from rich.progress import BarColumn, Progress, TextColumn

    columns = TextColumn("{task.description}", markup=False), BarColumn()
    with Progress(*columns, console=console(stderr=True), transient=True) as progress:
        task = progress.add_task(what, total=total)
        yield lambda step: progress.update(task, advance=1, description=f"{what}: {step}")


@contextmanager
def progress_with_estimate(what: str, total: int, done: int = 0) -> Iterator[Callable[[], None]]:
    """Show how many of many items are done and how long the rest will take, as `progress_bar` does."""
    if not sys.stderr.isatty():
        yield lambda: None
        return
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left:"),
        TimeRemainingColumn(),
    )
    # Lines on stdout go above the bar if both are on the same terminal, and past it if not.
    with Progress(
        *columns, console=console(stderr=True), transient=True, redirect_stdout=sys.stdout.isatty()
    ) as progress:
        task = progress.add_task(what, total=total, completed=done)
        yield lambda: progress.update(task, advance=1)
