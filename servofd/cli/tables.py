"""Tables and progress on the terminal."""

from __future__ import annotations

import sys
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

__all__ = ["STATUS_STYLE", "one_line", "print_table", "progress_bar"]

STATUS_STYLE = {
    "healthy": "green",
    "suspect": "yellow",
    "fault": "bold red",
    "no_data": "dim",
    "unknown": "yellow",
}


def one_line(message: object) -> str:
    r"""Text of a message on one line, whatever a file name brought into it.

    Examples
    --------
    >>> one_line("a\nb.csv: empty")
    'a b.csv: empty'
    """
    return " ".join(str(message).split())


def print_table(headings: Sequence[str], rows: Sequence[Sequence[str]], title: str = "") -> None:
    """Print rows under headings, as wide as the terminal, coloured by status where a cell is one."""
    from rich import box
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console()
    if not console.is_terminal:
        # A file or a pipe has no width: never fold.
        console = Console(width=400)
    table = Table(*headings, title=title or None, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    for row in rows:
        table.add_row(*(Text(cell, style=STATUS_STYLE.get(cell, "")) for cell in row))
    console.print(table)


@contextmanager
def progress_bar(what: str, total: int) -> Iterator[Callable[[str], None]]:
    """Show how far a job is, on stderr and only if somebody looks; gives the function to call after each step."""
    if not sys.stderr.isatty():
        yield lambda _step: None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(what, total=total)
        yield lambda step: progress.update(task, advance=1, description=f"{what}: {step}")
