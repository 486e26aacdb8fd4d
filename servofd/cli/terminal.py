"""The terminal: tables, messages and progress, in which nothing acts that a file brought; and where results go."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from servofd.core.errors import ConfigError
from servofd.core.files import write_whole
from servofd.outputs.document import Bullets, Document, Items, Part, Section, Table, Words
from servofd.outputs.plain import plain

if TYPE_CHECKING:
    from rich.console import Console, RenderableType


_WIDEST = 100
"""Columns of a terminal that a table of sentences uses: longer lines are hard to read."""
_PIPED = 80
"""Columns of a table of one line a row, where there is no terminal."""
_NARROWEST, _BETWEEN = 64, 3
"""Columns of a terminal below which a table becomes a list, and those between two of a table."""


def say(text: str = "", *, end: str = "\n") -> None:
    """Print text to stdout at once, in which nothing acts."""
    print(plain(text), end=end, flush=True)


def tell(*sentences: str) -> None:
    """Print sentences to stdout, each folded between its words where that is a terminal."""
    from rich.text import Text

    for sentence in sentences:
        _console().print(Text(one_line(sentence)))


def say_aside(text: str) -> None:
    """Print a line to stderr, in which nothing acts."""
    print(plain(text), file=sys.stderr, flush=True)


def console(**options: Any) -> Console:  # noqa: ANN401 - those of rich
    """Console that writes to the terminal itself, and shows text as it is: no markup, no emoji, nothing that acts."""
    from rich.console import Console
    from rich.segment import Segment

    class Plain(Console):
        def on_broken_pipe(self) -> None:
            raise  # noqa: PLE0704 - within its handler: who called decides on the exit code

        def render(self, *words: Any, **more: Any) -> Iterator[Segment]:  # noqa: ANN401 - as rich has it
            for segment in super().render(*words, **more):
                yield segment if segment.control else Segment(plain(segment.text), segment.style)

    return Plain(highlight=False, markup=False, emoji=False, **options)


def has_screen() -> bool:
    """Whether stdout is a terminal on which a picture can change."""
    return sys.stdout is not None and sys.stdout.isatty() and not console().is_dumb_terminal


@contextmanager
def screen() -> Iterator[Callable[[RenderableType], None]]:
    """The whole screen of the terminal, and what draws on it; it is as it was afterwards."""
    from rich.live import Live

    # COLUMNS and LINES are those of a window before it changed its size.
    now = {name: value for name, value in os.environ.items() if name not in ("COLUMNS", "LINES")}
    with Live(
        console=console(_environ=now), screen=True, auto_refresh=False, redirect_stdout=False, redirect_stderr=False
    ) as live:
        yield lambda picture: live.update(picture, refresh=True)


def one_line(message: object) -> str:
    """Text of a message on one line, whatever a file name brought into it."""
    return " ".join(str(message).split())


def complain(message: object, about: object = "") -> None:
    """Say on stderr, in one line, what could not be done, and of what."""
    say_aside(f"servofd: {f'{about}: ' if about else ''}{one_line(message)}")


def worst(codes: Iterable[int]) -> int:
    """Exit code of several results: a fault anywhere outranks what could not be judged."""
    return max(codes, key=(0, 2, 1).index, default=2)


def print_table(
    headings: Sequence[str], rows: Sequence[Sequence[str]], title: str = "", shown: Console | None = None
) -> None:
    """Print rows as a table, or as a list where its words are wider than the terminal; a status has its colour."""
    from rich import box
    from rich.cells import cell_len
    from rich.padding import Padding
    from rich.table import Column
    from rich.table import Table as Grid
    from rich.text import Text

    shown = shown or _console()
    columns = [" ".join(cells).split() for cells in zip(headings, *rows, strict=True)]
    longest = [max(map(cell_len, words)) for words in columns]  # of the words of each column
    if shown.width >= max(_NARROWEST, sum(longest) + _BETWEEN * len(longest)):
        heads = [Column(name, min_width=width) for name, width in zip(headings, longest, strict=True)]
        table = Grid(*heads, title=title or None, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
        for row in rows:
            table.add_row(*(Text(cell, style=_style(cell)) for cell in row))
        shown.print(table)
        return
    if title:
        shown.print(Text(title, style="bold"))
    for row in rows:  # its first two cells on a line, numbers with their headings below, and the last cell as it is
        shown.print(Text.assemble(f"{row[0]}: ", (row[1], _style(row[1]))))
        named = [f"{heading} {cell}" for heading, cell in zip(headings[2:-1], row[2:-1], strict=True) if cell]
        for line in filter(None, (", ".join(named), *row[2:][-1:])):
            shown.print(Padding(Text(line), (0, 0, 0, 2), expand=False))


def print_lines(rows: Sequence[tuple[str, str, tuple[str, ...]]]) -> None:
    """Print status, name and words of each row on a line, cut where the terminal ends; of a pipe at 80 columns.

    Of the words the first are taken that have room.
    """
    from rich.cells import cell_len
    from rich.text import Text

    shown = console() if console().is_terminal else console(width=_PIPED)
    rows = [(status, one_line(name), tuple(map(one_line, forms))) for status, name, forms in rows]
    first = max((cell_len(status) for status, _, _ in rows), default=0)
    second = max((cell_len(name) for _, name, _ in rows), default=0)
    for status, name, forms in rows:
        line, named = Text(status, style=_style(status)), Text(name)
        line.pad_right(first + 1 - line.cell_len)
        named.truncate(min(second, shown.width // 3), overflow="ellipsis", pad=True)
        line.append_text(named)
        room = shown.width - line.cell_len - 1
        line.append(f" {next((words for words in forms if cell_len(words) <= room), forms[-1])}")
        line.truncate(shown.width, overflow="ellipsis")
        shown.print(line, no_wrap=True)


def show(document: Document, *, json: str | None = None, html: str | None = None) -> None:
    """Write the page and the JSON that were asked for, and print the rest: tables and words, what it comes to last."""
    if html:
        write_page(document, html)
    if not give_json(json, document.data):
        print_document(document)


def write_page(document: Document, path: str | Path) -> None:
    """Write the page of a result, with links to those of many flights beside it."""
    from servofd.outputs.page import beside, html_page

    overviews, _ = beside(path)
    document = replace(document, links=(*document.links, *overviews))
    write_whole(path, html_page(document).encode())


def print_document(document: Document) -> None:
    """Print facts, tables and words, what they come to last; pictures, and what is folded, are for pages.

    Of a table of sentences at most 100 columns of a terminal are used; in less than 64, or than its words need, a table
    becomes a list. A file or a pipe has no width: there no line is folded.
    """
    from rich.text import Text

    shown = _console(_WIDEST)
    if document.facts:
        shown.print(Text(one_line(document.facts)))
    _print_parts(document.parts, shown)
    if document.sentence:
        shown.print(Text(document.sentence, style="bold"))


def _print_parts(parts: Sequence[Part], shown: Console) -> None:
    from rich.padding import Padding
    from rich.text import Text

    for part in parts:
        lines: Sequence[str] = ()
        if isinstance(part, Words):
            shown.print(Text(f"{part.lead} {part.text}".strip(), style="bold" if part.style == "verdict" else ""))
        elif isinstance(part, Bullets):
            lines = part.lines
        elif isinstance(part, Table) and part.rows and not part.long:
            print_table(list(map(str, part.head)), [list(map(str, row)) for row in part.rows], part.caption)
        elif isinstance(part, Items) and part.items:
            print_table(part.head, part.rows, "", shown)
            named: dict[str, list[str]] = {}
            for one in part.items:
                named.setdefault(one.advice, []).append(one.name)
            lines = [f"{', '.join(names)}: {advice}" for advice, names in named.items() if advice]
        elif isinstance(part, Section) and not part.folded:
            shown.print(Text(": ".join(filter(None, (part.title, part.badge or part.status))), style="bold"))
            _print_parts(part.parts, shown)
        for line in lines:
            shown.print(Padding(Text(one_line(line)), (0, 0, 0, 2), expand=False))


def _console(widest: int | None = None) -> Console:
    shown = console()
    if not shown.is_terminal:
        return console(width=400)
    shown.width = min(shown.width, widest or shown.width)
    return shown


def _style(cell: str) -> str:
    from servofd.outputs.palette import STATUS_COLOURS

    colour = STATUS_COLOURS.get(cell, "")
    return f"bold {colour}" if cell == "fault" else colour


@contextmanager
def progress(what: str, total: int, done: int | None = None) -> Iterator[Callable[..., None]]:
    """Show how far a job is, on stderr and only on a terminal; gives the function to call after each step.

    Of many items, some of which are done, it shows how many they are and how long the rest will take.
    """
    if not sys.stderr.isatty():
        yield lambda *_step: None
        return
    from rich import progress as bars

    columns: list[bars.ProgressColumn] = [bars.TextColumn("{task.description}", markup=False), bars.BarColumn()]
    if done is not None:
        columns += [bars.MofNCompleteColumn(), bars.TimeElapsedColumn()]
        columns += [bars.TextColumn("left:"), bars.TimeRemainingColumn()]
    # Lines on stdout go above the bar if both are on the same terminal, and past it if not.
    above = done is None or sys.stdout.isatty()
    with bars.Progress(*columns, console=console(stderr=True), transient=True, redirect_stdout=above) as shown:
        task = shown.add_task(what, total=total, completed=done or 0)
        yield lambda *step: shown.update(task, advance=1, description=": ".join((what, *step)))


def give_json(target: str | None, document: Mapping[str, Any]) -> bool:
    """Write a document to the file that ``--json`` names; or print it, where that is ``-``, and tell so."""
    from servofd.outputs.json_report import to_json

    if target and target != "-":
        write_whole(target, to_json(document).encode())
    elif target:
        say(to_json(document), end="")
    return target == "-"


def check_targets(
    outputs: Iterable[str | None], inputs: Mapping[str, Iterable[str | None]], *, folder: str | None = None
) -> None:
    """Refuse outputs that cannot be written, or would overwrite an input or each other."""
    taken = {Path(name).resolve(): what for what, names in inputs.items() for name in names if name}
    for name in outputs:
        if name is None or name == "-":
            continue
        target = Path(name).resolve()
        if not target.parent.is_dir():
            raise ConfigError(f"{name}: the folder {target.parent} does not exist")
        if target.is_dir():
            raise ConfigError(f"{name}: is a folder; give the name of a file in it")
        if not os.access(target if target.exists() else target.parent, os.W_OK):
            raise ConfigError(f"{name}: cannot write here: permission denied")
        if target in taken:
            raise ConfigError(f"{name}: is {taken[target]} already; choose another file for this output")
        taken[target] = "another output"
    if folder is not None and Path(folder).exists() and not Path(folder).is_dir():
        raise ConfigError(f"{folder}: is a file; give the name of a folder")
