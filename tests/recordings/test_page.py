"""Whatever the page on recordings shows, happens."""

from __future__ import annotations

import re
import runpy
import shlex
from pathlib import Path

import pytest

from servofd.cli import main
from tests.pictures.viewer import VIEWER

ROOT = Path(__file__).parent.parent.parent
PAGE = (ROOT / "docs" / "recordings.md").read_text()


@pytest.mark.slow
def test_the_commands_and_the_python_of_the_page_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "sample_logs").symlink_to(ROOT / "sample_logs")
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```sh\n(.*?)```", PAGE, re.DOTALL)
    commands = [line.removeprefix("servofd ") for block in blocks for line in block.splitlines()]
    for command in commands:
        assert main(shlex.split(command)) == (not command.startswith("simulate")), command
    capsys.readouterr()
    (code,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    exec(compile(code, "recordings.md", "exec"), {})  # noqa: S102 - our own page
    assert capsys.readouterr().out == "3990 samples\n"


@pytest.mark.nightly
@pytest.mark.skipif(VIEWER is None, reason="the rerun command is not installed")
def test_the_pictures_of_the_page_are_what_their_script_draws(tmp_path: Path) -> None:
    try:
        runpy.run_path(str(ROOT / "docs" / "make_recordings.py"))["main"](tmp_path)
    except (RuntimeError, ConnectionError):
        pytest.skip("no software renderer (Debian: mesa-vulkan-drivers)")
    drawn = {path.name for path in (tmp_path / "recordings").iterdir()}
    assert drawn == set(re.findall(r"\]\(recordings/(.*?)\)", PAGE))
