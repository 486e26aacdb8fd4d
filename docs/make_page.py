"""Draws the picture of the page: a headless Chromium looks at the page of a sample flight.

Run: python docs/make_page.py
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import servofd

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT))
SIZE = (900, 700)


def main(folder: Path = ROOT / "docs") -> None:
    from tests.pictures.browser import Browser

    (folder / "page").mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch, Browser(Path(scratch)) as browser:
        (found,) = servofd.audit(ROOT / "sample_logs" / "ardupilot_volz_stuck.bin")
        page = found.save_html(Path(scratch) / "page.html")
        browser.size(*SIZE)
        browser.goto(page.as_uri())
        browser.shot(folder / "page" / "page.png", whole=False)
    print("wrote page/page.png")


if __name__ == "__main__":
    main()
