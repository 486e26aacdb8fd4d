"""Pages that need nothing else: one file, no network, readable without script; one style for all of them."""

from __future__ import annotations

import os
import platform
import re
import sys
import webbrowser
from html import unescape
from importlib.metadata import version
from pathlib import Path
from typing import Any

from servofd.core.files import beginning
from servofd.outputs.document import Document
from servofd.outputs.palette import BANNER_COLOURS, STATUS_COLOURS
from servofd.outputs.plain import plain
from servofd.version import __version__

_TYPED = re.compile("`(.*?)`")
_HEAD = re.compile(
    r'<meta name="generator" content="servofd">\n(?:<meta name="servofd-log" content="([^"]*)">)?'
    r".*?<title>(.*?) \S servofd<",
    re.DOTALL,
)
_HEAD_BYTES = 2000
"""Beginning of a page in which its head is [bytes]."""
FLEET_PAGE = "fleet.html"
"""Name of the page of all logs of a folder, beside those of each."""
OF_MANY = ("Many flights", "Trend of ")
"""Titles of pages that are of more than one flight begin so."""
_PACKAGES = ("numpy", "scipy", "numba")


def html_page(document: Document, template: str = "document.html", **values: Any) -> str:  # noqa: ANN401
    """Text of the page of a result; text is escaped, whatever a log or a file name brought into it.

    Examples
    --------
    >>> from servofd.outputs.document import Document
    >>> "&lt;b&gt;" in html_page(Document("audit", "fault", "<b> is stuck."))
    True
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup, escape

    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent / "templates"), autoescape=True, undefined=StrictUndefined
    )
    environment.filters["kind"] = lambda part: type(part).__name__
    environment.filters["typed"] = lambda text: Markup(_TYPED.sub(r"<code>\1</code>", str(escape(text))))  # noqa: S704
    text = environment.get_template(template).render(
        versions={"servofd": __version__, "Python": platform.python_version(), **{n: version(n) for n in _PACKAGES}},
        status_colours=STATUS_COLOURS,
        banner_colours=BANNER_COLOURS,
        source_tag=lambda log: Markup(source_tag(log)),  # noqa: S704 - escaped there
        document=document,
        **values,
    )
    return plain(text)


def source_tag(log: str) -> str:
    """What stands in the head of the page of one log, so that the page of another is never written over."""
    from markupsafe import escape

    return f'<meta name="servofd-log" content="{escape(log)}">'


def is_page_of(page: Path, log: str) -> bool:
    """Whether a page is ours, and of a log of this name: only then it is overwritten without a question."""
    return source_tag(log) in _head(page)


def has_display() -> bool:
    """Whether there is a screen for windows."""
    linux = sys.platform.startswith("linux")
    return not linux or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def open_page(address: str) -> None:
    """Show a page to whoever sits there: not where there is no display, or the output goes to a file."""
    if has_display() and sys.stdout.isatty():
        webbrowser.open(address)


def beside(page: str | Path) -> tuple[list[tuple[str, str]], dict[str, str]]:
    """Other pages in the folder of one, to which it can lead.

    Title and file name of those of many flights (of a fleet, of trends); and the file name of the page of each log, by
    the log's, of logs of one name none.
    """
    overviews: list[tuple[str, str]] = []
    flights: dict[str, list[str]] = {}
    for path in sorted(Path(page).resolve().parent.glob("*.html")):
        if path.name == Path(page).name or not (found := _HEAD.search(_head(path))):
            continue
        log, title = (unescape(part or "") for part in found.groups())
        if log:
            flights.setdefault(log, []).append(path.name)
        elif title.startswith(OF_MANY):
            overviews.append((title, path.name))
    return overviews, {log: names[0] for log, names in flights.items() if len(names) == 1}


def _head(path: Path) -> str:
    try:
        return beginning(path, _HEAD_BYTES).decode(errors="replace")
    except OSError:
        return ""
