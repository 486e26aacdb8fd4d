"""What a verb found, said once: the terminal, pages, notebooks and recordings each show it in their own way."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from servofd.outputs.chart import Chart

_TALLEST, _AT_THRESHOLD = 24, 12
"""Of a thumbnail: units of its height, and how high the threshold stands; what is twice as large is cut."""


@dataclass(frozen=True, slots=True)
class Cell:
    """What stands in a table, where it is more than text."""

    text: str = ""
    status: str = ""
    """Shown as a badge before the text."""
    link: str = ""
    outline: Sequence[float | None] = ()
    """Largest share of the threshold in each part of a flight, drawn small."""
    soft: str = ""
    choice: str = ""
    """Of a box to tick, what it chooses."""
    order: float | None = None
    """By which a column is sorted, if not by its text."""

    def __str__(self) -> str:
        return ": ".join(filter(None, (self.status, self.text)))

    @property
    def thumbnail(self) -> tuple[str, str]:
        """Outlines of the parts of a flight that stay below the threshold, and of the others.

        Examples
        --------
        >>> Cell(outline=[0.5, None, 1.5]).thumbnail
        ('M0 24v-6', 'M2 24v-18')
        """
        paths = ["", ""]
        for k, share in enumerate(self.outline):
            if share is not None:
                height = round(min(max(share * _AT_THRESHOLD, 1), _TALLEST))
                paths[share >= 1.0] += f"M{k} {_TALLEST}v-{height}"
        return paths[0], paths[1]


@dataclass(frozen=True, slots=True)
class Words:
    """A paragraph; what stands between backticks is to be typed."""

    text: str
    lead: str = ""
    """Its first words, in bold."""
    status: str = ""
    """Colour of its margin."""
    style: str = ""
    """``soft`` for what is beside the point, ``verdict`` for what is the point."""


@dataclass(frozen=True, slots=True)
class Bullets:
    """Sentences one below the other."""

    lines: Sequence[str]


@dataclass(frozen=True, slots=True)
class Table:
    """Rows under headings, with units in these; not shown without rows, but where it has an `id` to be filled."""

    caption: str
    head: Sequence[str | Cell]
    rows: Sequence[Sequence[str | Cell]]
    long: bool = False
    """Of any number of rows: on a page sorted by its headings, not printed on a terminal."""
    id: str = ""


@dataclass(frozen=True, slots=True)
class Figures:
    """Charts, drawn only where they can be seen."""

    draw: Callable[[], Sequence[Chart]]


@dataclass(frozen=True, slots=True)
class Lanes:
    """What a page lays beside its charts: other channels, modes and messages of the log."""

    draw: Callable[[], Mapping[str, Any]]


@dataclass(frozen=True, slots=True)
class Item:
    """One surface, axis or log: its status, why, what to do, and what that rests on."""

    name: str
    status: str
    words: str
    advice: str = ""
    beside: str = ""
    """One more word on a terminal, under the third heading."""
    parts: Sequence[Part] = ()
    """On pages only; of what is well, folded."""


@dataclass(frozen=True, slots=True)
class Items:
    """What is judged alike: a table on the terminal, panels and lines on a page."""

    title: str
    head: Sequence[str]
    items: Sequence[Item]

    @property
    def rows(self) -> list[list[str]]:
        """Its items as rows of a table."""
        return [[one.name, one.status, *filter(None, [one.beside]), one.words] for one in self.items]


@dataclass(frozen=True, slots=True)
class Section:
    """Parts under a heading."""

    title: str
    parts: Sequence[Part]
    status: str = ""
    badge: str = ""
    """Words of the badge, if not the status."""
    folded: bool = False
    """Opened by who wants it; not shown on a terminal."""
    anchor: str = ""


Part = Words | Bullets | Table | Figures | Lanes | Items | Section


@dataclass(frozen=True, slots=True)
class Document:
    """The result of a verb."""

    title: str
    status: str
    """``healthy``, ``suspect``, ``fault``, ``unknown`` or ``no_data``: the colour of its banner."""
    sentence: str
    """What it comes to."""
    facts: str = ""
    """Where it comes from."""
    parts: Sequence[Part] = ()
    evidence: Sequence[Part] = ()
    """What a terminal has no room for: method, whole lists."""
    data: Mapping[str, Any] = field(default_factory=dict)
    """The same for machines."""
    log: str = ""
    """File that a page is of, so that the page of another is never written over."""
    links: Sequence[tuple[str, str]] = ()
    """Words and address of pages that stand beside this one."""


def markdown(document: Document) -> str:
    """Words and tables, as the viewer of recordings shows them."""
    return "\n\n".join([f"# {document.sentence}", document.facts, *_marked(document.parts)]) + "\n"


def _marked(parts: Sequence[Part]) -> list[str]:
    texts: list[str] = []
    for part in parts:
        if isinstance(part, Words):
            texts.append(f"{part.lead} {part.text}".strip())
        elif isinstance(part, Bullets):
            texts.append("\n".join(f"- {_cell(line)}" for line in part.lines))
        elif (isinstance(part, Table) and not part.long) or isinstance(part, Items):
            texts.append(_rows(part.head, part.rows))
        elif isinstance(part, Section) and not part.folded:
            texts += [f"## {part.title}", *_marked(part.parts)]
    return [text for text in texts if text]


def _rows(head: Sequence[str | Cell], rows: Sequence[Sequence[str | Cell]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(_cell(str(cell)) for cell in line)} |" for line in lines) if rows else ""


def _cell(text: str) -> str:
    return " ".join(text.replace("|", "\\|").split())
