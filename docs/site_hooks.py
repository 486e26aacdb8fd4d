"""What `mkdocs build` does beyond Markdown: formulas as MathML, and no links out of the site."""

from __future__ import annotations

import re
from html import unescape

from latex2mathml.converter import convert

_FORMULA = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)
_OUTSIDE = re.compile(r"\[([^\]]*)\]\(\.\./[^)]*\)")
_NUMBER = re.compile(r"\\tag\{(\d+)\}")


def on_page_markdown(markdown: str, **_: object) -> str:
    """Links to files of the repository that are no page keep their text; every page leads to the words."""
    return _OUTSIDE.sub(r"\1", markdown) + "\n\n[What the words mean](glossary.md)\n"


def on_page_content(html: str, **_: object) -> str:
    """Formulas as MathML, which browsers show without script or network."""
    return _FORMULA.sub(_mathml, html)


def _mathml(found: re.Match[str]) -> str:
    tex = _NUMBER.sub(r"\\qquad \\text{(\1)}", unescape(found[2]))
    if found[1] == "span":
        return f"{convert(tex)}"
    return f'<div style="overflow-x: auto">{convert(tex, display="block")}</div>'
