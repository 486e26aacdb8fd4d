"""Pages: complete, self-contained, readable by anybody, and silent about the machine."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest

import servofd
from servofd.aircraft.series import Series
from servofd.detection.verdict import LogAudit
from servofd.discrepancy.explanation import Explanation, explain_gap
from servofd.jobs.workflow import FailedLog
from servofd.outputs.audit_report import audit_report
from servofd.outputs.explain_report import explain_report
from servofd.outputs.page import html_page
from servofd.outputs.palette import BANNER_COLOURS
from servofd.servo.effects.linkage import RateLimit
from servofd.servo.library import servo_named
from servofd.servo.servo_model import ServoModel

SAMPLES = Path(__file__).parent.parent.parent / "sample_logs"
VOID = {"meta", "link", "br", "hr", "img", "input"}


class Page(HTMLParser):
    """Elements of a page with their attributes; fails on one that is not closed."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self._open: list[str] = []
        self.feed(text)
        assert not self._open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        if not {"style", "script"} & set(self._open):
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())

    def of(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.tags if name == tag]


@pytest.fixture(scope="module")
def audits() -> list[LogAudit]:
    named = {"faser_stuck_flight.mat": None, "table_three_faults.csv": "hs225bb-eq31"}
    return [audit for name, servo in named.items() for audit in servofd.audit(SAMPLES / name, servo=servo)]


@pytest.fixture(scope="module")
def audited(audits: list[LogAudit]) -> str:
    return html_page(
        audit_report([*audits, FailedLog("/home/someone/secret/lost.bin", "/home/someone/secret/lost.bin: empty file")])
    )


def slow_servo(limit_deg_s: float | None, surface: str = "elevator", jams_s: float = np.inf) -> Explanation:
    """Doublets that a rate limit distorts, or not, and maybe a jam ends."""
    time_s = np.arange(0.0, 30.0, 0.02)
    command_deg = 8.0 * np.sign(np.sin(0.15 * time_s**1.5))
    known = ServoModel.of(servo_named("hs225bb-eq31"))
    true = known if limit_deg_s is None else known + RateLimit(limit_deg_s)
    moved_deg = true.simulate(time_s, command_deg, time_s)
    moved_deg[time_s >= jams_s] = moved_deg[np.searchsorted(time_s, min(jams_s, time_s[-1]))]
    measured_deg = moved_deg + 0.1 * np.random.default_rng(0).standard_normal(time_s.size)
    return explain_gap(Series(surface, time_s, command_deg, time_s, measured_deg), known)


@pytest.fixture(scope="module")
def explained() -> str:
    return html_page(explain_report([slow_servo(60.0)], "flight.csv"))


@pytest.mark.slow
def test_an_audit_begins_with_its_verdict_and_shows_every_fault(audited: str, audits: list[LogAudit]) -> None:
    page = Page(audited)
    verdicts = re.findall(r'<p class="verdict">(.*?)</p>', audited)
    assert re.findall(r"<h1>(.*?)</h1>", audited) == ["2 of 3 logs show a fault; no verdict on 1."]
    assert verdicts[0] == "ELEVATOR JAMMED at 0:05 (-0.2 deg). Do not fly."
    assert verdicts[2] == "Could not be read."
    assert "lost.bin: empty file" in page.text
    faults = [fault for audit in audits for surface in audit.surfaces for fault in surface.faults]
    assert len(faults) >= 4
    for fault in faults:
        assert f"({fault.start_s:.2f} s; shaded from there)" in page.text
    for words in (
        "do not fly",
        "jammed linkage",
        "95% intervals",
        "less than one in a million hours",
        "position rate",
        "nullspace filter",
    ):
        assert words.lower() in page.text.lower()
    assert f"servofd {servofd.__version__}" in page.text


@pytest.mark.slow
def test_a_flight_with_a_fault_stands_before_those_without() -> None:
    logs = ["faser_healthy_flight.mat", "faser_stuck_flight.mat"]
    results = [audit for name in logs for audit in servofd.audit(SAMPLES / name)]
    assert [any(surface.faults for surface in result.surfaces) for result in results] == [False, True]
    text = html_page(audit_report([*results, FailedLog("none.csv", "none.csv: no such file")]))
    at = [text.index(f"<h2>{name}</h2>") for name in (logs[1], logs[0], "none.csv")]
    assert at == sorted(at)
    contents = text[text.index("All logs") :]
    assert contents.index(logs[1]) < contents.index(logs[0])


@pytest.mark.slow
def test_an_explanation_shows_the_gap_before_and_after(explained: str) -> None:
    page = Page(explained)
    for words in ("rate limit", "noise floor", "held-out samples", "Rivals, tried"):
        assert words in page.text
    assert len(page.of("svg")) >= 6  # two of the motion, over what the gap follows, spectrum, coherence, correlation


@pytest.mark.slow
def test_an_explanation_without_a_gap_has_a_page_too() -> None:
    page = Page(html_page(explain_report([slow_servo(None)], "flight.csv")))
    assert "Nothing is missing" in page.text
    assert "Rivals" not in page.text


@pytest.fixture(params=[pytest.param(name, marks=pytest.mark.slow) for name in ("audited", "explained")])
def text(request: pytest.FixtureRequest) -> str:
    found: str = request.getfixturevalue(request.param)
    return found


def test_a_page_needs_nothing_else(text: str) -> None:
    page = Page(text)
    assert not {"link", "iframe", "img", "object"} & {tag for tag, _ in page.tags}
    assert all(not script for script in page.of("script"))  # without address: it stands in the page
    assert not re.search(r"fetch|XMLHttp|import\(|WebSocket|eval|innerHTML = (?!asDrawn)", text)
    assert not [a for _, a in page.tags if any(name.startswith("on") for name in a)]
    # Nothing is fetched: addresses occur as names of XML vocabularies only.
    assert not re.search(r'(?:src|href)="(?!#)|url\((?!#)|@import', text)
    anchors = {a["href"] for a in page.of("a")}
    ids = [a["id"] for _, a in page.tags if "id" in a]
    assert {str(a).removeprefix("#") for a in anchors} <= set(ids)
    assert len(ids) == len(set(ids))


def test_a_page_can_be_read_without_seeing_it(text: str) -> None:
    page = Page(text)
    assert page.of("html") == [{"lang": "en"}]
    pictures = [p for _, p in page.tags if p.get("role") == "img"]
    assert len(pictures) >= 4
    assert all(len(str(p["aria-label"])) > 40 for p in pictures)
    assert all(p.get("role") == "img" or p["aria-hidden"] == "true" for p in page.of("svg"))
    assert len(page.of("caption")) == len(page.of("table"))
    assert all(cell["scope"] in ("row", "col") for cell in page.of("th"))
    assert page.of("title")
    for svg in re.findall(r"<svg.*?</svg>", text, re.DOTALL):
        assert ET.fromstring(svg).tag.endswith("svg")  # noqa: S314 - our own page


def luminance(colour: str) -> float:
    """Relative luminance, WCAG 2.1."""
    parts = [int(colour[k : k + 2], 16) / 255.0 for k in (1, 3, 5)]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in parts]
    return float(np.dot(linear, [0.2126, 0.7152, 0.0722]))


def contrast(one: str, other: str) -> float:
    dark, light = sorted(luminance(colour) for colour in (one, other))
    return (light + 0.05) / (dark + 0.05)


def test_text_stands_out_from_its_ground_by_day_and_by_night() -> None:
    """WCAG 2.1, AA: 4.5 for text, 3 for lines that carry meaning; white text stands on the banners."""
    style = html_page(audit_report([FailedLog("a.csv", "a.csv: no such file")]))
    day, night = (
        {name: value.replace("#fff", "#ffffff") if len(value) == 4 else value for name, value in found}
        for found in (
            re.findall(r"--(\w+): (#[0-9a-f]+);", block)
            for block in re.findall(r":root \{(.*?)\}", style, re.DOTALL)[:2]
        )
    )
    for colours in (day, night):
        for ground in ("paper", "tint"):
            for ink in ("ink", "soft", "link"):
                assert contrast(colours[ground], colours[ink]) >= 4.5, (ground, ink)
            for line in ("command", "simulated", "measured", "residual", "threshold"):
                assert contrast(colours[ground], colours[line]) >= 3.0, (ground, line)
    assert all(contrast("#ffffff", colour) >= 4.5 for colour in BANNER_COLOURS.values())


def test_a_page_tells_nothing_of_the_machine(text: str) -> None:
    for word in (str(SAMPLES.parent), str(Path.home()), "someone", "secret", "/tmp"):  # noqa: S108 - looked for
        assert word not in text


def test_what_a_log_is_called_cannot_become_markup() -> None:
    page = html_page(audit_report([FailedLog("<script>alert(1).csv", "<script>alert(1).csv: no such file")]))
    assert "<script>alert" not in page
    assert "&lt;script&gt;alert" in page


@pytest.mark.nightly
def test_an_hour_of_eight_surfaces_stays_small(tmp_path: Path) -> None:
    import pandas as pd

    rng, time_s = np.random.default_rng(0), np.arange(0.0, 3600.0, 0.01)
    model = ServoModel.of(servo_named("hs225bb-eq31"))
    columns = {"time_s": time_s}
    for k in range(8):
        command_deg = np.repeat(rng.normal(0.0, 3.0, 3600), 100)
        position_deg = model.simulate(time_s, command_deg, time_s) + 0.1 * rng.standard_normal(time_s.size)
        if k == 0:
            position_deg[time_s > 1800.0] = 2.0 + 0.1 * rng.standard_normal(180_000 - 1)
        columns |= {f"s{k}_cmd_deg": command_deg, f"s{k}_pos_deg": position_deg}
    path = tmp_path / "hour.csv"
    pd.DataFrame(columns).to_csv(path, index=False, float_format="%.3f")
    (audit,) = servofd.audit(path)
    page = html_page(audit_report([audit]))
    assert len(page.encode()) < 1_200_000
    assert "S0 JAMMED at 30:00 (+2.0 deg). Do not fly." in page


@pytest.mark.slow
def test_of_several_surfaces_the_one_that_is_explained_worst_heads_the_page() -> None:
    report = explain_report([slow_servo(None, "aileron"), slow_servo(None, "elevator", jams_s=18.0)], "flight.csv")
    assert (report.status, report.sentence) == ("fault", "Unexplained: elevator; nothing missing: aileron.")
    page = html_page(report)
    assert '<header class="banner fault">' in page
    assert page.index("<h2>elevator ") < page.index("<h2>aileron ")
