"""The documentation as a site: it builds, every command in it is valid, and its tutorial and notebooks run."""

from __future__ import annotations

import argparse
import re
import runpy
import shlex
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest

from servofd.cli import build_parser, parsed

ROOT = Path(__file__).parent.parent.parent
PAGES = sorted([*ROOT.glob("docs/*.md"), ROOT / "README.md", *ROOT.glob("sample_logs/*.md")])

NUMBER = re.compile(r"\d+(?:\.\d+)?")


def verbs() -> dict[str, str]:
    """Each verb and its line of help."""
    parser = build_parser()
    (found,) = (a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    return {choice.dest: str(choice.help) for choice in found._choices_actions}


def test_the_index_lists_every_verb_with_its_help() -> None:
    index = (ROOT / "docs" / "index.md").read_text()
    for verb, text in verbs().items():
        assert f"| `servofd {verb}` | {text} |" in index, f"docs/index.md says nothing of {verb}"
    assert set(re.findall(r"^\| `servofd (\w+)`", index, re.MULTILINE)) == set(verbs())


def commands(text: str) -> list[str]:
    """Calls of servofd in code blocks and in tables."""
    found = []
    for language, block in re.findall(r"```(sh|console)\n(.*?)```", text, re.DOTALL):
        pattern = r"^\$ servofd (.*)$" if language == "console" else r"^servofd (.*)$"
        found += re.findall(pattern, block, re.MULTILINE)
    return found + re.findall(r"^\| `servofd (\S+ [^`]*)` \|", text, re.MULTILINE)


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_every_command_is_valid(path: Path) -> None:
    for command in commands(path.read_text()):
        options = parsed(shlex.split(command.partition(" > ")[0], comments=True))
        assert options.verb, command


def test_the_pages_hold_commands() -> None:
    assert sum(len(commands(path.read_text())) for path in PAGES) >= 30


class Links(HTMLParser):
    """What a page loads, and where it leads."""

    def __init__(self) -> None:
        super().__init__()
        self.loaded: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        name = {"script": "src", "img": "src", "link": "href"}.get(tag)
        self.loaded += [value for key, value in attrs if key == name and value]


@pytest.mark.slow
def test_the_site_builds_strictly_and_loads_nothing_from_the_network(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path / "site")]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert not result.stderr
    pages = {path.stem: path.read_text() for path in (tmp_path / "site").glob("*.html")}
    assert {path.stem for path in ROOT.glob("docs/*.md")} <= set(pages)
    for name, text in pages.items():
        links = Links()
        links.feed(text)
        if name != "404":  # its addresses begin at the root of the server
            assert links.loaded
            assert all((tmp_path / "site" / link.partition("?")[0]).exists() for link in links.loaded)
        assert "\\(" not in text
        assert "$$" not in text
    assert pages["odds"].count("<math") == 2
    assert [p.name for p in (tmp_path / "site").glob("**/*.py")] == ["own_effect.py"]


@pytest.mark.nightly
def test_the_tutorial_is_what_its_script_writes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    runpy.run_path(str(ROOT / "docs" / "make_tutorial.py"))["main"](tmp_path)
    capsys.readouterr()
    text = (tmp_path / "tutorial.md").read_text()
    kept = (ROOT / "docs" / "tutorial.md").read_text()
    assert NUMBER.sub("#", text) == NUMBER.sub("#", kept), "run docs/make_tutorial.py"
    # Fits end in the same place on every machine, but for the last digits.
    for now, then in zip(NUMBER.findall(text), NUMBER.findall(kept), strict=True):
        assert float(now) == pytest.approx(float(then), rel=0.05, abs=0.02), f"{now} is not {then}"
    drawn = {path.name for path in (tmp_path / "tutorial").iterdir()}
    assert drawn == {path.name for path in (ROOT / "docs" / "tutorial").iterdir()}
    assert drawn == set(re.findall(r"\]\(tutorial/(.*?)\)", text))


@pytest.mark.nightly
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("path", sorted(ROOT.glob("examples/*.ipynb")), ids=lambda path: path.name)
def test_a_notebook_runs_and_is_kept_without_results(path: Path) -> None:
    import nbformat
    from nbclient import NotebookClient

    notebook = nbformat.read(path, as_version=4)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert not any(cell.outputs for cell in code)
    NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(ROOT)}}).execute()
    assert any("image/png" in output.get("data", {}) for cell in code for output in cell.outputs)
