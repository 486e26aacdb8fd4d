"""Names from outside act nowhere: terminal, page, picture, TOML, tables, and file names that are no UTF-8."""

from __future__ import annotations

import io
import os
import sys
import tomllib
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from servofd.cli import main
from servofd.cli.terminal import console, plain_streams
from servofd.core.toml_text import toml_inline
from servofd.outputs.picture import Picture, new_figure

ACTS = [*map(chr, range(8)), "\x1b", "\x7f", "\x80", "\x9b", "\u202e", "\ufeff"]
NAMES = ["a\x1b[31m\x9b2J", "<script>alert(1)</script>", "x\\1\\g<2>$\\frac$\"']]>"]


def flight(path: Path, surface: str) -> str:
    time_s = np.arange(1500) / 50
    command = 5.0 * np.sin(2.0 * time_s)
    rows = "".join(f"{t:.2f},{c:.4f},{p:.4f}\n" for t, c, p in zip(time_s, command, np.roll(command, 2), strict=True))
    path.write_text(f'time_s,"{surface}_cmd_deg","{surface}_pos_deg"\n{rows}'.replace("\"'", "'"), encoding="utf-8")
    return str(path)


@pytest.mark.slow
@pytest.mark.parametrize("surface", ["ele\x9b31m\u202evator", "a<script>alert(1)</script>", "x\\1\\g<2>$\\frac$'"])
def test_an_audit_of_hostile_names(surface: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bad = b"\xff" if sys.platform == "linux" else b""  # elsewhere no file has such a name
    log = flight(tmp_path / os.fsdecode(b"fl" + bad + b"\x1b[2Jight.csv"), surface)
    page, out = tmp_path / "a.html", tmp_path / "out"
    assert main(["audit", log, "--html", str(page), "-o", str(out)]) in (0, 2)
    said = capsys.readouterr()
    for text in (said.out, said.err, page.read_text(encoding="utf-8")):
        assert not [sign for sign in ACTS if sign in text]
    assert "<script>alert" not in page.read_text(encoding="utf-8")
    assert len(list(out.iterdir())) == 3
    assert main(["audit", str(tmp_path), "-o", str(tmp_path / "fleet")]) in (0, 2)


@pytest.mark.parametrize("name", NAMES)
def test_a_picture_of_a_hostile_name(name: str) -> None:
    figure, (axes,) = new_figure()
    axes.plot([0, 1], [0, 1], label=name, clip_on=True)
    axes.set_title(f"{name} $x$ \udcff")
    axes.legend()
    picture = Picture(name, name, name, figure)
    inline = picture.inline()
    ElementTree.fromstring(inline)  # noqa: S314 - our own
    assert "<script>" not in inline
    assert picture.png()[:4] == b"\x89PNG"


@pytest.mark.parametrize("name", [*NAMES, "\udcff", "\x7f\u2028", "ok"])
def test_toml_holds_any_name(name: str) -> None:
    text = toml_inline({name: name, "list": [name]})
    assert not [sign for sign in ACTS if sign in text]
    whole = name.replace("\udcff", "\ufffd")
    assert tomllib.loads(f"v = {text}")["v"] == {whole: whole, "list": [whole]}


def test_streams_are_plain_within_and_as_they_were_after(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stdout", stream)
    with plain_streams():
        sys.stdout.writelines(["a\x1bb\udcff ", "c\td\n"])
        console(force_terminal=True, color_system="truecolor").print("[red]x[/] :smile: \x1b]0;y\x9c", style="bold")
    assert sys.stdout is stream
    first, second = stream.getvalue().splitlines()
    assert first == "a\\x1bb\\udcff c\td"
    assert "[red]x[/] :smile: \\x1b]0;y\\x9c" in second
    assert "\x1b[1m" in second  # rich's own
