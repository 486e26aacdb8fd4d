"""Pages that need nothing else: one file, no network, readable without script; one style for all of them."""

from __future__ import annotations

import platform
import re
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from servofd.outputs.palette import BANNER_COLOURS, STATUS_COLOURS
from servofd.outputs.plain import plain

if TYPE_CHECKING:
    from servofd.outputs.document import Document

_TYPED = re.compile("`(.*?)`")
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
        versions=_versions(),
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


def _versions() -> dict[str, str]:
    from servofd.version import __version__

    return {"servofd": __version__, "Python": platform.python_version()} | {name: version(name) for name in _PACKAGES}
