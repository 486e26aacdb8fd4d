"""``servofd identify`` as tools and people use it; whatever is wrong with a test is told in a sentence."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servofd.cli import main
from servofd.segment import Segment
from servofd.servos import find_servo
from tests.parsers.dataflash_writer import DataflashWriter
from tests.recovery.bench import step, sweep, written

QUICK = sweep("hs225bb-eq31", duration_s=40.0)


def test_the_json_is_what_the_contract_says(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = written(tmp_path / "chirp.csv", QUICK)
    assert main(["identify", str(path), "--json", "-"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["schema"] == "servofd.identify/1"
    assert sorted(document["poles"])[-1] == pytest.approx([-24.84, 0.0], abs=0.6)
    assert document["hold"] == "zoh"
    assert document["delay_s"] == pytest.approx(0.004, abs=3e-4)
    assert document["dc_gain"] == pytest.approx(1.0, abs=0.005)
    assert document["bandwidth_rad_s"] == pytest.approx(28.49, rel=0.02)
    assert document["rate_limit_deg_s"] is None
    low, high = document["coherence_band_rad_s"]
    assert low < 10.0
    assert 100.0 < high < 157.0
    assert document["fit_error"]["rms_deg"] == pytest.approx(0.1, abs=0.01)
    assert 0.0 < document["fit_error"]["max_normalized_error"] < 0.5
    assert document["uncertainty"]["delay_s"]["low"] < 0.004 < document["uncertainty"]["delay_s"]["high"]
    assert any("elevator_cmd_deg" in note for note in document["notes"])


class _Page(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))


def test_every_output_and_the_servo_file_in_an_audit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    chirp, large = written(tmp_path / "chirp.csv", QUICK), written(tmp_path / "step.csv", step(72.0))
    saved, page, folder = tmp_path / "mine.toml", tmp_path / "mine.html", tmp_path / "out"
    options = ["--save", str(saved), "--html", str(page), "-o", str(folder)]
    assert main(["identify", str(chirp), str(large), *options]) == 0
    assert "rate limit up" in capsys.readouterr().out

    name, servo = find_servo(str(saved))
    assert name == "mine"
    assert servo.rate_limit_deg_s == pytest.approx(370.0, rel=0.005)
    assert servo.transfer.bandwidth_rad_s == pytest.approx(28.49, rel=0.02)
    assert main(["audit", str(chirp), "--servo", str(saved)]) == 0
    assert "healthy" in capsys.readouterr().out

    names = {"coherence", "motion", "normalised_error", "response", "step", "validation"}
    assert {picture.stem for picture in folder.glob("*.png")} == names
    assert json.loads((folder / "identify.json").read_text())["schema"] == "servofd.identify/1"

    text = page.read_text()
    parser = _Page()
    parser.feed(text)
    pictures = [attributes for tag, attributes in parser.tags if tag == "svg"]
    assert len(pictures) == len(names)
    assert all(p["role"] == "img" and p["aria-label"] for p in pictures)
    assert "script" not in {tag for tag, _ in parser.tags}
    ids = [attributes["id"] for _, attributes in parser.tags if "id" in attributes]
    assert len(ids) == len(set(ids))
    # Nothing is fetched: addresses occur as names of XML vocabularies only.
    assert not re.search(r'(src|href)="(?!#)', text)


def _mixed(one: Segment, other: Segment) -> Segment:
    half = one.measured_s < 0.5 * one.measured_s[-1]
    return replace(one, measured_deg=np.where(half, one.measured_deg, other.measured_deg))


FAST = sweep("s9254", duration_s=40.0)
NOISE_DEG = 0.1 * np.random.default_rng(0).standard_normal(QUICK.measured_s.size)
BAD: dict[str, tuple[Segment, str]] = {
    "no excitation": (
        Segment("x", QUICK.measured_s, 0.0 * NOISE_DEG, QUICK.measured_s, NOISE_DEG),
        "no excitation: the command is 0 deg throughout",
    ),
    "clipped": (replace(QUICK, measured_deg=np.clip(QUICK.measured_deg, -1.5, 1.5)), "position is clipped"),
    "milliseconds": (
        replace(QUICK, command_s=1e3 * QUICK.command_s, measured_s=1e3 * QUICK.measured_s),
        "Are the time stamps in milliseconds?",
    ),
    "too fast": (
        replace(QUICK, command_s=1e-3 * QUICK.command_s, measured_s=1e-3 * QUICK.measured_s),
        "too fast to see a servo",
    ),
    "swapped": (
        Segment("x", QUICK.measured_s, QUICK.measured_deg, QUICK.measured_s, QUICK.command_deg),
        "are the two columns swapped?",
    ),
    "swapped, fast servo": (
        Segment("x", FAST.measured_s, FAST.measured_deg, FAST.measured_s, FAST.command_deg),
        "are the two columns swapped?",
    ),
    "swapped, steps": (
        Segment("x", step(72.0).measured_s, step(72.0).measured_deg, step(72.0).measured_s, step(72.0).command_deg),
        "are the two columns swapped?",
    ),
    "noise only": (replace(QUICK, measured_deg=NOISE_DEG), "the position does not follow the command"),
    "two servos": (_mixed(QUICK, FAST), "data of two servos mixed"),
    "saturated": (
        sweep("hs225bb-eq31", duration_s=40.0, amplitude=10.0, rate_deg_s=60.0),
        "which hides its dynamics; use a smaller amplitude",
    ),
    "short": (
        Segment("x", *(array[:20] for array in (QUICK.command_s, QUICK.command_deg, QUICK.measured_s, NOISE_DEG))),
        "only 20 measured positions",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_what_cannot_be_used_is_told_in_a_sentence(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    segment, sentence = BAD[name]
    path = written(tmp_path / "bad.csv", segment)
    outputs = ["--save", str(tmp_path / "s.toml"), "--html", str(tmp_path / "p.html"), "--json", str(tmp_path / "j")]
    assert main(["identify", str(path), *outputs, "-o", str(tmp_path / "out")]) == 2
    printed = capsys.readouterr()
    (line,) = printed.err.strip().splitlines()
    assert sentence in line
    assert "bad.csv" in line
    assert printed.out == ""
    assert [p.name for p in tmp_path.iterdir()] == ["bad.csv"]


def test_outputs_do_not_overwrite_logs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = written(tmp_path / "chirp.csv", QUICK)
    assert main(["identify", str(path), "--save", str(path)]) == 2
    assert "choose another file" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "sentence"),
    [("nonsense", "cannot read the servo file"), ("", "one entry"), ('[servos.x]\ntitle = "x"', "servos.x")],
)
def test_a_servo_file_that_is_none(
    text: str, sentence: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    servo, path = tmp_path / "servo.toml", written(tmp_path / "chirp.csv", QUICK)
    servo.write_text(text)
    assert main(["audit", str(path), "--servo", str(servo)]) == 2
    assert sentence in capsys.readouterr().err
