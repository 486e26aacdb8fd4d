"""Pages that need nothing else: one file, no network, readable without script; one style for all of them."""

from __future__ import annotations

import platform
from importlib.metadata import version
from pathlib import Path
from typing import Any

from servofd.outputs.palette import BANNER_COLOURS, STATUS_COLOURS
from servofd.outputs.plain import plain

_PACKAGES = ("numpy", "scipy", "numba")


def page(template: str, **values: Any) -> str:  # noqa: ANN401 - whatever the template shows
    """Text of a page.

    Parameters
    ----------
    template : str
        Name of a file in ``templates``.
    **values
        What it shows; text is escaped, whatever a log or a file name brought into it.

    Examples
    --------
    >>> values = dict.fromkeys(("sentence", "source", "method"), "")
    >>> "&lt;b&gt;" in page("identify.html", surface="<b>", rows=[], notes=[], pictures=[], **values)
    True
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup

    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent / "templates"), autoescape=True, undefined=StrictUndefined
    )
    text = environment.get_template(template).render(
        versions=_versions(),
        status_colours=STATUS_COLOURS,
        banner_colours=BANNER_COLOURS,
        source_tag=lambda log: Markup(source_tag(log)),  # noqa: S704 - escaped there
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
