"""What all results of a notebook have in common: they show themselves, and become a table, a figure or a page."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import fields
from functools import wraps
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

from logparsers import LogError
from servofd.core.errors import ServofdError, needs
from servofd.core.files import write_whole
from servofd.feedback.draft import BY_DAYS
from servofd.outputs.chart import Chart
from servofd.outputs.document import Document
from servofd.outputs.figure import chart_figure
from servofd.outputs.page import html_page
from servofd.outputs.sentence import spoken

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


class Shown(ABC):
    """A result that a notebook shows, and that becomes a table or a page."""

    __slots__ = ()

    @abstractmethod
    def report(self) -> Document:
        """What the verb found, as the command line prints it and its page shows it."""

    @abstractmethod
    def _rows(self) -> list[dict[str, Any]]:
        """One for each surface or quantity."""

    @property
    def sentence(self) -> str:
        """What it comes to, in a sentence."""
        return self.report().sentence

    @property
    def status(self) -> str:
        """``healthy``, ``suspect``, ``fault``, ``unknown`` or ``no_data``: which colour it has."""
        return self.report().status

    def to_html(self) -> str:
        """Text of its page."""
        return html_page(self.report())

    def _save(self, path: str | Path, text: str) -> Path:
        write_whole(path, text.encode())
        return Path(path)

    def to_pandas(self) -> pd.DataFrame:
        """One row for each surface or quantity."""
        return frame(self._rows())

    def save_html(self, path: str | Path) -> Path:
        """Write its page, and give the path."""
        return self._save(path, self.to_html())

    def __repr__(self) -> str:
        """Short: one line, and one for each surface or quantity."""
        rows = [["" if v is None else str(v) for v in list(row.values())[:_SHORT]] for row in self._rows()]
        widths = [max((len(row[k]) for row in rows), default=0) for k in range(len(rows[0]) if rows else 0)]
        lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
        report, name = self.report(), type(self).__name__
        head = f"{name}: {report.sentence.removeprefix(f'{name}: ')}{f' ({report.facts})' if report.facts else ''}"
        return "\n".join([head, *(f"  {line}" for line in lines)])

    def _repr_html_(self) -> str:
        rows = self._rows()
        head = [spoken(name) for name in (rows[0] if rows else ())][:_SHOWN]
        cells = [["" if value is None else value for value in row.values()][:_SHOWN] for row in rows]
        return html_page(self.report(), "cell.html", head=head, rows=cells)


_SHORT, _SHOWN = 3, 6
"""Columns of a row in a terminal, and in a notebook."""

P = ParamSpec("P")
Given = TypeVar("Given")
Result = TypeVar("Result")

_OPTION = re.compile(r"(?<![\w-])(?:-(?P<short>[cs])|--(?P<long>[a-z][a-z-]*))(?![\w-])(?: (?P<value>[A-Za-z0-9.]+))?")
_DISORDER = ("split the log there", "sort it by its time, or number the flights in a column run")
_BY_DAYS = "`servofd.calibrate(days).save('plane.toml')`, then `servofd.audit(flight, 'plane.toml')`"
_TABLES = ("DataFrame:", "dict:")
_KEYWORDS = {"c": "aircraft", "s": "surface", "config": "aircraft", "duration": "duration_s"}


def in_words_of_python(verb: Callable[P, Given]) -> Callable[P, Given]:
    """The verb with errors that name its arguments where those of the command line name options."""

    @wraps(verb)
    def call(*args: P.args, **options: P.kwargs) -> Given:
        try:
            return verb(*args, **options)
        except (LogError, ServofdError) as error:
            text = str(error).replace(*_DISORDER) if str(error).startswith(_TABLES) else str(error)
            said = re.split("(`.*?`)", text.replace(BY_DAYS, _BY_DAYS))  # a command to be typed stays as it is
            error.args = ("".join(s if s[:1] == "`" else _OPTION.sub(keyword, s) for s in said), *error.args[1:])
            raise

    def keyword(option: re.Match[str]) -> str:
        name = option["short"] or option["long"].replace("-", "_")
        return f"{_KEYWORDS.get(name, name)}={option['value'] or ''}"

    return call


def shown(name: str, verb: Callable[P, object], kind: Callable[..., Result]) -> Callable[P, Result]:
    """The verb as the command line calls it, with a result of the `kind` that shows itself."""

    @wraps(verb)
    @in_words_of_python
    def call(*args: P.args, **options: P.kwargs) -> Result:
        try:
            signature(verb).bind(*args, **options)
        except TypeError as error:
            raise TypeError(f"servofd.{name}: {error}; help(servofd.{name}) lists them") from None
        return kind(**fields_of(verb(*args, **options)))

    call.__name__ = call.__qualname__ = name
    return call


class Drawn(ABC):
    """A surface or an axis that draws itself."""

    __slots__ = ()

    def __repr__(self) -> str:
        """Name, status and reason."""
        known: Any = self
        return f"{getattr(known, 'axis', None) or known.surface}: {known.status}: {known.reason}"

    @abstractmethod
    def chart(self) -> Chart:
        """The whole flight of it."""

    def plot(self, ax: Axes | Sequence[Axes] | None = None) -> Figure:
        """Figure of the whole flight; into one's own axes, the upper part into one, or all of it into several."""
        return chart_figure(self.chart(), ax)


def frame(columns_or_rows: Any) -> pd.DataFrame:  # noqa: ANN401 - as pandas takes it
    """Table of pandas."""
    needs("pandas")
    import pandas as pd

    return pd.DataFrame(columns_or_rows)


def fields_of(found: Any) -> dict[str, Any]:  # noqa: ANN401 - any dataclass
    """Its fields by their names."""
    return {field.name: getattr(found, field.name) for field in fields(found)}
