"""Pages that need nothing else: one file, no network, no script; one style for all of them."""

from __future__ import annotations

import platform
from importlib.metadata import version
from pathlib import Path
from typing import Any

from servofd.outputs.palette import STATUS_COLOURS

__all__ = ["page"]

_PACKAGES = ("numpy", "scipy", "numba", "matplotlib")


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

    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent / "templates"), autoescape=True, undefined=StrictUndefined
    )
    return environment.get_template(template).render(versions=_versions(), status_colours=STATUS_COLOURS, **values)


def _versions() -> dict[str, str]:
    from servofd import __version__

    return {"servofd": __version__, "Python": platform.python_version()} | {name: version(name) for name in _PACKAGES}
