"""The words at the end of every page are those of the glossary."""

from __future__ import annotations

import html
import re
from pathlib import Path

from servofd.fleets.overview import overview
from servofd.outputs.fleet_report import fleet_report
from servofd.outputs.page import html_page

GLOSSARY = Path(__file__).parent.parent.parent / "docs" / "glossary.md"


def test_every_page_ends_with_the_glossary() -> None:
    rows = [line.strip("| ").split(" | ", 1) for line in GLOSSARY.read_text().splitlines() if line.startswith("| ")][1:]
    meant = {word.strip(): re.sub(r" \(\[[^\]]*\]\([^)]*\)\)", "", text).strip() for word, text in rows}
    page = html_page(fleet_report(overview([]).document()))
    said = dict(re.findall(r"<dt>(.*?)</dt><dd>(.*?)</dd>", page))
    assert {html.unescape(word): html.unescape(text) for word, text in said.items()} == meant
