"""Pages in a real browser: nothing scrolls sideways, every picture shows something, and it prints."""

from __future__ import annotations

import html
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

import servofd
from servofd.outputs.audit_page import audit_page
from servofd.outputs.explain_page import explain_page
from servofd.outputs.identify_page import identify_page
from servofd.outputs.palette import COLOURS

SAMPLES = Path(__file__).parent.parent.parent / "sample_logs"
BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
WIDTHS = (360, 800, 1400)
FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--hide-scrollbars"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
)
PROBE = """<script>onload = () => document.title = [...document.querySelectorAll("iframe")].map(f => {
  const page = f.contentDocument.documentElement;
  const drawn = [...page.querySelectorAll("svg")].map(s => Math.round(s.getBBox().width)).join(" ");
  return [page.clientWidth, page.scrollWidth, drawn].join(",") }).join(";")</script>"""

pytestmark = [pytest.mark.slow, pytest.mark.skipif(BROWSER is None, reason="no browser (Debian: chromium)")]


def browse(folder: Path, page: Path, *options: str) -> str:
    """What the browser prints."""
    command = [str(BROWSER), *FLAGS, f"--user-data-dir={folder / 'profile'}", *options, page.as_uri()]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=120).stdout


def audit_text() -> str:
    return audit_page([*servofd.audit(SAMPLES / "faser_stuck_flight.mat")])


def explain_text() -> str:
    log = SAMPLES / "hidden" / "hidden_03.csv"
    return explain_page([servofd.explain_log(log, surface="elevator").explanation], log.name)


def identify_text() -> str:
    log = SAMPLES / "faser_healthy_chirp.mat"
    return identify_page(servofd.identify_logs([log], surface="aileron_right"), log.name)


@pytest.mark.parametrize("write", [audit_text, explain_text, identify_text])
def test_a_page_fits_every_screen_and_shows_its_pictures(write: object, tmp_path: Path) -> None:
    assert callable(write)
    text: str = write()
    frames = "".join(
        f'<iframe width="{width}" height="4000" style="border:0" srcdoc="{html.escape(text)}"></iframe>'
        for width in WIDTHS
    )
    harness = tmp_path / "harness.html"
    harness.write_text(f'<!DOCTYPE html><meta charset="utf-8">{frames}{PROBE}')
    title = re.search(r"<title>(.*?)</title>", browse(tmp_path, harness, "--dump-dom", "--window-size=1500,4000"))
    assert title is not None
    measured = [frame.split(",") for frame in title[1].split(";")]
    assert [int(client) for client, _, _ in measured] == list(WIDTHS)
    for client, scroll, drawn in measured:
        assert int(scroll) <= int(client)
        widths = [int(width) for width in drawn.split()]
        assert len(widths) == text.count("<svg")
        assert min(widths) > 300
    page, shot = tmp_path / "page.html", tmp_path / "page.png"
    page.write_text(text)
    browse(tmp_path, page, f"--screenshot={shot}", "--window-size=1000,3500")
    for colour in (COLOURS["simulated"], COLOURS["measured"]):
        assert share(shot, colour) > 1e-4


def test_an_audit_prints(tmp_path: Path) -> None:
    page, paper = tmp_path / "page.html", tmp_path / "page.pdf"
    page.write_text(audit_text())
    browse(tmp_path, page, f"--print-to-pdf={paper}", "--no-pdf-header-footer")
    content = paper.read_bytes()
    assert content.startswith(b"%PDF")
    assert 4 <= content.count(b"/Type /Page\n") <= 24


def share(path: Path, colour: str) -> float:
    """Share of pixels close to a colour."""
    from matplotlib.colors import to_rgb
    from matplotlib.image import imread

    picture = imread(path)[:, :, :3]
    return float(np.mean(np.max(np.abs(picture - np.array(to_rgb(colour))), axis=2) < 0.1))
