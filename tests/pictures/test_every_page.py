"""Every kind of page in a real browser: on a phone nothing scrolls sideways, all text has contrast, and it is small."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

import servofd
from servofd.cli import main
from servofd.jobs.workflow import FailedLog
from servofd.outputs.audit_report import audit_report
from servofd.outputs.explain_report import explain_report
from servofd.outputs.identify_report import identify_report
from servofd.outputs.page import FLEET_PAGE as PAGE
from servofd.outputs.page import html_page
from servofd.simulation.airframe import airframe_log, fly_airframe
from tests.pictures.browser import BROWSER, Browser

if TYPE_CHECKING:
    from collections.abc import Callable

SAMPLES = Path(__file__).parent.parent.parent / "sample_logs"
LARGEST_BYTES, LARGEST_FIGURES_BYTES = 500_000, 1_200_000
"""Of a page of charts, and of one with the figures of a model."""
AA = 4.5
CONTRAST = """(() => {
  const channel = (c) => { c /= 255; return c <= 0.03928 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4; };
  const luminance = ([r, g, b]) => 0.2126 * channel(r) + 0.7152 * channel(g) + 0.0722 * channel(b);
  const parsed = (text) => (text.match(/[\\d.]+/g) || []).map(Number);
  const behind = (one) => {
    for (; one; one = one.parentElement) {
      const colour = parsed(getComputedStyle(one).backgroundColor);
      if (colour.length === 3 || colour[3] === 1) return colour.slice(0, 3);
    }
    return matchMedia("(prefers-color-scheme: dark)").matches ? [18, 18, 18] : [255, 255, 255];
  };
  const words = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  let worst = [99, ""];
  for (let node = words.nextNode(); node; node = words.nextNode()) {
    const one = node.parentElement;
    if (!node.textContent.trim() || one.closest("svg, script, style") || !one.checkVisibility()) continue;
    const style = getComputedStyle(one);
    const [a, b] = [luminance(parsed(style.color)), luminance(behind(one))].sort((x, y) => y - x);
    const size = parseFloat(style.fontSize), bold = parseInt(style.fontWeight) >= 600;
    const ratio = (a + 0.05) / (b + 0.05) * (size >= 24 || (bold && size >= 18.66) ? 1.5 : 1);
    if (ratio < worst[0]) worst = [ratio, node.textContent.trim().slice(0, 60)];
  }
  return worst;
})()"""

pytestmark = [pytest.mark.nightly, pytest.mark.skipif(BROWSER is None, reason="no browser (Debian: chromium)")]


def fault(folder: Path) -> Path:
    page = folder / "fault.html"
    page.write_text(html_page(audit_report([*servofd.audit(SAMPLES / "faser_stuck_flight.mat")])))
    return page


def several(folder: Path) -> Path:
    page = folder / "several.html"
    found = [*servofd.audit(SAMPLES / "faser_healthy_flight.mat"), *servofd.audit(SAMPLES / "px4_stuck.ulg")]
    page.write_text(html_page(audit_report([*found, FailedLog("lost.bin", "lost.bin: empty file")])))
    return page


def axes(folder: Path) -> Path:
    days = [folder / f"2026-05-0{k + 1}.bin" for k in range(3)]
    for k, day in enumerate(days):
        day.write_bytes(airframe_log(fly_airframe(k, day=k, duration_s=90.0)))
    plane, bad, page = folder / "plane.toml", folder / "2026-05-09.bin", folder / "axes.html"
    bad.write_bytes(airframe_log(fly_airframe(9, duration_s=60.0)))
    assert main(["calibrate", *map(str, days), "-o", str(plane)]) == 0
    main(["audit", str(bad), "-c", str(plane), "--html", str(page)])
    return page


def no_model(folder: Path) -> Path:
    """Positions that no servo would make of these commands."""
    time_s, rng = 0.02 * np.arange(3000), np.random.default_rng(0)
    walk = np.cumsum(rng.normal(0.0, 0.4, time_s.size))
    columns = time_s, 8.0 * np.sin(0.7 * time_s), walk - np.convolve(walk, np.full(200, 1 / 200), "same")
    log, page = folder / "walk.csv", folder / "walk.html"
    np.savetxt(
        log, np.column_stack(columns), "%.3f", ",", header="time_s,elevator_cmd_deg,elevator_pos_deg", comments=""
    )
    assert main([str(log), "--no-open", "--html", str(page)]) == 2
    return page


def no_feedback(folder: Path) -> Path:
    log, page = folder / "wing.bin", folder / "wing.html"
    log.write_bytes(airframe_log(fly_airframe(9, duration_s=60.0)))
    assert main([str(log), "--no-open", "--html", str(page)]) == 2
    assert "servofd calibrate DAY1" in page.read_text(encoding="utf-8")
    return page


def fleet(folder: Path) -> Path:
    logs = folder / "flights"
    logs.mkdir()
    for name in ("faser_stuck_flight.mat", "faser_healthy_flight.mat", "table_three_faults.csv"):
        (logs / name).write_bytes((SAMPLES / name).read_bytes())
    (logs / "broken.bin").write_bytes(b"\xa3\x95")
    main([str(logs), "--no-open", "-o", str(folder / "pages")])
    return folder / "pages" / PAGE


def trend(folder: Path) -> Path:
    page = folder / "trend.html"
    main(["trend", str(SAMPLES / "faser_healthy_flight.mat"), "-c", "faser", "--html", str(page)])
    return page


def explain(folder: Path) -> Path:
    page, log = folder / "explain.html", SAMPLES / "hidden" / "hidden_03.csv"
    page.write_text(html_page(explain_report([servofd.explain(log, surface="elevator").explanation], log.name)))
    return page


def identify(folder: Path) -> Path:
    page, log = folder / "identify.html", SAMPLES / "faser_healthy_chirp.mat"
    page.write_text(html_page(identify_report(servofd.identify(log, surface="aileron_right"), log.name)))
    return page


@pytest.mark.parametrize("write", [fault, several, axes, no_model, no_feedback, fleet, trend, explain, identify])
def test_a_page_fits_a_phone_can_be_read_and_is_small(write: Callable[[Path], Path], tmp_path: Path) -> None:
    page = write(tmp_path)
    assert page.stat().st_size <= (LARGEST_FIGURES_BYTES if write in (explain, identify) else LARGEST_BYTES)
    (tmp_path / "browser").mkdir()
    with Browser(tmp_path / "browser") as browser:
        for width, dark in ((360, False), (360, True), (1280, False)):
            browser.size(width, dark=dark)
            browser.goto(page.as_uri())
            browser.shot(tmp_path / f"{page.stem}-{width}{'-dark' if dark else ''}.png")
            ratio, words = browser.tell(CONTRAST)
            assert ratio >= AA, (width, dark, words)
            assert browser.tell(
                "[...document.querySelectorAll('.wide')].every(one => one.scrollWidth <= one.clientWidth)"
            )
            browser.tell("document.querySelectorAll('details').forEach(one => one.open = true)")
            assert browser.tell("document.documentElement.scrollWidth") <= width
            assert browser.tell("document.querySelector('#words dt') !== null")
        assert browser.complaints == []
