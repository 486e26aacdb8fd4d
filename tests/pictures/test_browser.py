"""Pages in a real browser: nothing scrolls sideways, every picture shows something, and it prints."""

from __future__ import annotations

import html
import re
import socket
import subprocess
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

import servofd
from servofd.outputs.audit_report import audit_report
from servofd.outputs.explain_report import explain_report
from servofd.outputs.identify_report import identify_report
from servofd.outputs.page import html_page
from servofd.outputs.palette import COLOURS
from tests.pictures.browser import BROWSER, FLAGS, Browser, wait_for

if TYPE_CHECKING:
    from collections.abc import Iterator

SAMPLES = Path(__file__).parent.parent.parent / "sample_logs"
WIDTHS = (360, 400, 1280)
ON_PAPER = "#c77f00"
"""The colour of what was measured, darkened for thin lines on white."""
PROBE = """<script>onload = () => document.title = [...document.querySelectorAll("iframe")].map(f => {
  const page = f.contentDocument.documentElement;
  const drawn = [...page.querySelectorAll("svg")].map(s => Math.round(s.getBBox().width)).join(" ");
  return [page.clientWidth, page.scrollWidth, drawn].join(",") }).join(";")</script>"""

pytestmark = [pytest.mark.nightly, pytest.mark.skipif(BROWSER is None, reason="no browser (Debian: chromium)")]


def browse(folder: Path, page: Path, *options: str) -> str:
    """What the browser prints."""
    command = [str(BROWSER), *FLAGS, f"--user-data-dir={folder / 'profile'}", *options, page.as_uri()]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=120).stdout


def audit_text() -> str:
    return html_page(audit_report([*servofd.audit(SAMPLES / "faser_stuck_flight.mat")]))


def explain_text() -> str:
    log = SAMPLES / "hidden" / "hidden_03.csv"
    return html_page(explain_report([servofd.explain(log, surface="elevator").explanation], log.name))


def identify_text() -> str:
    log = SAMPLES / "faser_healthy_chirp.mat"
    return html_page(identify_report(servofd.identify(log, surface="aileron_right"), log.name))


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
    for shades in ((COLOURS["simulated"],), (COLOURS["measured"], ON_PAPER)):
        assert max(share(shot, colour) for colour in shades) > 1e-4


def test_an_audit_prints(tmp_path: Path) -> None:
    page, paper = tmp_path / "page.html", tmp_path / "page.pdf"
    page.write_text(audit_text())
    browse(tmp_path, page, f"--print-to-pdf={paper}", "--no-pdf-header-footer")
    content = paper.read_bytes()
    assert content.startswith(b"%PDF")
    assert 4 <= content.count(b"/Type /Page\n") <= 24


@pytest.fixture
def browser(tmp_path: Path) -> Iterator[Browser]:
    with Browser(tmp_path) as found:
        yield found


def plots(browser: Browser) -> list[dict[str, float]]:
    """Where the plots of the first chart are."""
    found: list[dict[str, float]] = browser.tell(
        "[...document.querySelector('.chart').querySelectorAll('.plot')].map(p => p.getBoundingClientRect().toJSON())"
    )
    return found


def test_a_chart_tells_values_and_shows_a_part_from_near(browser: Browser, tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    page.write_text(audit_text())
    browser.size(1280)
    browser.goto(page.as_uri())
    upper = plots(browser)[0]
    # 0:08.50: the elevator rests at -0.2 deg, a healthy servo would be at about 5.
    first, last = (float(browser.tell(f"document.querySelector('.chart').dataset.{end}")) for end in ("first", "last"))
    middle = upper["y"] + upper["height"] / 2

    def across(time_s: float) -> float:
        return upper["x"] + upper["width"] * (time_s - first) / (last - first)

    browser.mouse("mouseMoved", across(8.5), middle)
    told = browser.tell("document.querySelector('.readout').textContent")
    found = re.findall(r"(command|healthy servo|measured) (-?[\d.]+) deg", told)
    values = {name: float(value) for name, value in found}
    assert told.startswith("0:08.5")
    assert values["measured"] == pytest.approx(-0.2, abs=0.3)
    assert values["healthy servo"] == pytest.approx(5.0, abs=0.6)
    browser.mouse("mousePressed", across(7.5), middle, 1)
    browser.mouse("mouseMoved", across(8.0), middle, 1)
    browser.mouse("mouseReleased", across(8.5), middle)
    ticks = browser.tell("[...document.querySelector('.times').children].map(t => t.textContent)")
    assert ticks[0] in ("0:07.50", "0:07.60")
    assert browser.tell("document.querySelector('.label').style.left.slice(0, -1) | 0") in range(58, 63)
    browser.tell("document.querySelector('.plots').focus()")
    browser.key("0")
    assert browser.tell("document.querySelector('.chart svg').getAttribute('viewBox')") == "0 0 2000 500"
    assert browser.complaints == []
    assert browser.requested == [page.as_uri()]


def test_a_chart_is_turned_nearer_loses_a_curve_and_gets_a_lane(browser: Browser, tmp_path: Path) -> None:
    found = servofd.audit(SAMPLES / "ardupilot_volz_stuck.bin")
    assert isinstance(found, servofd.Audit)
    page = found.save_html(tmp_path / "page.html")
    assert page.stat().st_size < 200_000
    browser.size(1280)
    browser.goto(page.as_uri())

    def viewed() -> list[float]:
        box = browser.tell("document.querySelector('.chart svg').getAttribute('viewBox')")
        return [float(number) for number in box.split()]

    wheel = """(target => { const at = target.getBoundingClientRect(); target.dispatchEvent(new WheelEvent("wheel",
        { deltaY: -500, clientX: at.left + at.width / 4, clientY: at.top + 5, cancelable: true })); })"""
    browser.tell(f"{wheel}(document.querySelector('.chart .plot'))")
    assert viewed() == [0.0, 0.0, 2000.0, 500.0]  # a wheel over a page scrolls it
    browser.tell("document.querySelector('.plots').focus()")
    browser.tell(f"{wheel}(document.querySelector('.chart .plot'))")
    x, _, width, _ = viewed()
    assert width == pytest.approx(2000.0 / np.e, rel=0.01)
    assert x + width / 4 == pytest.approx(500.0, rel=0.02)  # what is under the pointer stays there
    # The axis follows what is in view; a curve that is hidden counts no more.
    before = viewed()[3]
    browser.tell(
        "[...document.querySelectorAll('.legend button')].find(b => b.textContent === 'healthy servo').click()"
    )
    browser.tell("[...document.querySelectorAll('.legend button')].find(b => b.textContent === 'command').click()")
    assert browser.tell("getComputedStyle(document.querySelector('path.simulated')).display") == "none"
    assert viewed()[3] < before
    drawn = len(plots(browser))
    browser.tell("""(select => { select.selectedIndex = 2; select.dispatchEvent(new Event("change")); })
        (document.querySelector(".more select"))""")
    assert browser.tell("document.querySelector('path.other').getBoundingClientRect().width") > 600
    assert len(plots(browser)) == drawn + 1
    roll = found.log["ATT.Roll"]
    shown = browser.tell("[...document.querySelectorAll('.lane1 .tick')].map(one => +one.textContent)")
    assert min(shown) >= roll.values.min() - 5.0
    assert max(shown) <= roll.values.max() + 5.0
    browser.tell("document.querySelector('.legend button.other').click()")
    assert len(plots(browser)) == drawn
    assert browser.complaints == []


def test_what_stands_still_is_in_view_and_a_name_hides_its_own_curve(browser: Browser, tmp_path: Path) -> None:
    """A jammed surface has two points in a picture, its beginning and its end, and neither is near its middle."""
    time_s = np.arange(0.0, 60.0, 0.02)
    command_deg = 8.0 * np.sin(1.3 * time_s) - 20.0
    position_deg = np.where(time_s < 20.0, np.interp(time_s - 0.05, time_s, command_deg), 5.0)
    current_a = 0.1 + 0.02 * np.abs(np.gradient(position_deg, time_s))
    log = {
        "time_s": time_s,
        "rudder_cmd_deg": command_deg,
        "rudder_pos_deg": position_deg,
        "rudder_current_a": current_a,
    }
    found = servofd.audit(log)
    assert isinstance(found, servofd.Audit)
    browser.size(1280)
    browser.goto(found.save_html(tmp_path / "page.html").as_uri())
    last = "[...document.querySelectorAll('.chart')].at(-1)"
    browser.tell(f"{last}.querySelector('.plots').focus()")
    upper = browser.tell(f"{last}.querySelector('.plot').getBoundingClientRect().toJSON()")
    first_s, last_s = (float(browser.tell(f"{last}.dataset.{end}")) for end in ("first", "last"))
    browser.mouse("mouseMoved", upper["x"] + upper["width"] * (40.0 - first_s) / (last_s - first_s), upper["y"] + 5)
    browser.tell(f"{last}.scrollIntoView()")
    for _ in range(3):
        browser.key("+")
    told = browser.tell(f"{last}.querySelector('.readout').textContent")
    shown = [
        float(text)
        for text in browser.tell(
            f"[...{last}.querySelector('.plot').querySelectorAll('.tick.nearer')].map(t => t.textContent)"
        )
    ]
    assert max(shown) >= 0.0 > min(shown), (told, shown)
    # Curves of two names may have one colour.
    names = browser.tell(f"[...{last}.querySelectorAll('.legend .simulated')].map(b => b.textContent)")
    assert len(names) == len(set(names)) == 2
    browser.tell(f"[...{last}.querySelectorAll('.legend .simulated')].at(-1).click()")
    hidden = f"[...{last}.querySelectorAll('path.simulated')].filter(p => p.style.display).map(p => p.dataset.name)"
    assert browser.tell(hidden) == names[1:]
    assert browser.complaints == []


def test_two_fingers_show_a_part_from_near(browser: Browser, tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    page.write_text(audit_text())
    browser.size(400)
    browser.do("Emulation.setTouchEmulationEnabled", enabled=True, maxTouchPoints=2)
    browser.goto(page.as_uri())
    browser.tell("document.querySelector('.chart').scrollIntoView()")
    upper = plots(browser)[0]
    y = upper["y"] + upper["height"] / 2

    def at(share: float) -> tuple[float, float]:
        return upper["x"] + share * upper["width"], y

    browser.touch("touchStart", at(0.4), at(0.6))
    for spread in (0.15, 0.2, 0.3, 0.4):
        browser.touch("touchMove", at(0.5 - spread), at(0.5 + spread))
    browser.touch("touchEnd")
    box = browser.tell("document.querySelector('.chart svg').getAttribute('viewBox')")
    x, _, width, _ = (float(number) for number in box.split())
    assert width == pytest.approx(2000.0 / 4, rel=0.1)  # the fingers went four times as far apart
    assert x + width / 2 == pytest.approx(1000.0, rel=0.1)  # about the middle between them
    assert browser.complaints == []


def test_modes_and_messages_stand_along_the_time_axis(browser: Browser, tmp_path: Path) -> None:
    found = servofd.audit(SAMPLES / "telemetry_stuck.tlog")
    assert isinstance(found, servofd.Audit)
    browser.size(360)
    browser.goto(found.save_html(tmp_path / "page.html").as_uri())
    bands = "[...document.querySelectorAll('.chart')].map(c => [...c.querySelectorAll('.band > *')].map(b => b.title))"
    told = "0:00.03 ArduPlane V4.7.0-dev (simulated by servofd)"
    near, whole, *_ = browser.tell(bands)
    assert (near, whole) == (["AUTO"], ["AUTO", told])
    spread = browser.tell("(b => b.offsetWidth / b.parentElement.offsetWidth)(document.querySelector('.band .mode'))")
    assert spread == pytest.approx(1.0, abs=0.01)
    # The same in words, for who cannot see it.
    browser.tell("document.querySelectorAll('details').forEach(one => one.open = true)")
    assert "mode: AUTO" in browser.tell("document.body.innerText")
    assert browser.complaints == []


def test_without_script_everything_is_there_but_the_hint_to_point_at_it(browser: Browser, tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    page.write_text(re.sub(r"<script>.*?</script>", "", audit_text(), flags=re.DOTALL))
    browser.size(360)
    browser.goto(page.as_uri())
    seen = browser.tell("document.body.innerText")
    for words in (
        "ELEVATOR JAMMED at 0:05",
        "deflection [deg]",
        "0:08",
        "healthy servo",
        "rudder healthy followed its command",
    ):
        assert words in seen
    assert "Point at it" not in seen
    assert browser.tell("document.querySelector('path.measured').getBoundingClientRect().width") > 200
    browser.tell("document.querySelectorAll('details').forEach(one => one.open = true)")
    assert browser.tell("document.documentElement.scrollWidth") == 360


@pytest.mark.parametrize("width", [400, 1280])
def test_logs_are_dropped_and_judged_with_the_keyboard_alone(width: int, browser: Browser, tmp_path: Path) -> None:
    pytest.importorskip("starlette")
    from tests.serve.test_serve import running

    logs = [SAMPLES / "faser_stuck_flight.mat", SAMPLES / "faser_healthy_flight.mat"]
    with running(tmp_path / "club") as link:
        browser.size(width, dark=width == 400)
        browser.goto(link)
        browser.key("Tab")
        assert browser.tell("document.activeElement.id") == "files"
        browser.choose("#files", logs)
        wait_for(lambda: browser.tell("document.querySelectorAll('#flights .badge').length === 2"))
        browser.shot(tmp_path / "list.png")
        assert browser.tell("document.documentElement.scrollWidth <= innerWidth")
        assert browser.tell("document.getElementById('progress').textContent") == ""
        # On to the flight, by its link.
        for _ in range(20):
            browser.key("Tab")
            if "stuck" in (browser.tell("document.activeElement.textContent") or ""):
                break
        browser.key("Enter", text="\r")
        wait_for(
            lambda: browser.tell("document.querySelector('h1')?.textContent.startsWith('ELEVATOR JAMMED') === true")
        )
        assert browser.tell("document.documentElement.scrollWidth <= innerWidth")
        assert browser.tell("document.querySelectorAll('iframe, h1, main').length") == 2
        # Two flights beside each other.
        browser.goto(link)
        browser.tell("document.querySelectorAll('input[type=checkbox]').forEach(box => box.focus() || box.click())")
        browser.tell("document.querySelector('.actions button').focus()")
        browser.key("Enter", text="\r")
        wait_for(lambda: browser.tell("document.querySelector('caption')?.textContent.includes('two flights')"))
        assert browser.tell("document.documentElement.scrollWidth <= innerWidth")
        # The first rows of a table of many columns scroll by themselves.
        wide = tmp_path / "wide.csv"
        rows = [[f"column_{k}" for k in range(40)], *([f"{n + k}" for k in range(40)] for n in range(9))]
        wide.write_text("\n".join(",".join(row) for row in rows))
        browser.goto(link)
        browser.choose("#files", [wide])
        wait_for(lambda: browser.tell("document.querySelectorAll('#flights .badge').length === 3"))
        browser.tell("[...document.querySelectorAll('#flights a')].find(a => a.textContent === 'wide.csv').click()")
        wait_for(lambda: browser.tell("document.querySelector('.wide') !== null"))
        assert browser.tell("(wide => wide.scrollWidth > wide.clientWidth)(document.querySelector('.wide'))")
        assert browser.tell("document.documentElement.scrollWidth <= innerWidth")
    assert browser.complaints == []
    assert all(address.startswith(link) for address in browser.requested)


def test_a_list_of_flights_outlives_its_server(browser: Browser, tmp_path: Path) -> None:
    """Twenty logs are dropped while servofd starts again; nothing is lost, and the page says what happens."""
    pytest.importorskip("starlette")
    from tests.serve.test_serve import running

    logs = []
    for k in range(20):
        logs.append(tmp_path / f"{k}.txt")
        logs[-1].write_text(f"note {k}\n")
    said = "document.getElementById('progress').textContent"
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = str(free.getsockname()[1])
    with running(tmp_path / "club", "--port", port) as link:
        browser.goto(link)
    browser.choose("#files", logs)
    wait_for(lambda: "does not answer" in browser.tell(said))
    with running(tmp_path / "club", "--port", port):
        wait_for(lambda: browser.tell("document.querySelectorAll('#flights .badge.not_a_log').length === 20"))
        wait_for(lambda: browser.tell(said) == "")
        # What is there already is said, with a link.
        browser.choose("#files", logs[:2])
        wait_for(lambda: browser.tell("document.querySelectorAll('#notices li a').length === 2"))
        assert "0.txt is here already" in browser.tell("document.getElementById('notices').textContent")
    assert browser.complaints == []


def share(path: Path, colour: str) -> float:
    """Share of pixels close to a colour."""
    from matplotlib.colors import to_rgb
    from matplotlib.image import imread

    picture = imread(path)[:, :, :3]
    return float(np.mean(np.max(np.abs(picture - np.array(to_rgb(colour))), axis=2) < 0.1))
