"""Every command of every page runs in an empty folder, in the order in which it stands there."""

from __future__ import annotations

import re
import shlex
import shutil
import signal
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent.parent
BEYOND = re.compile(r"s3://|tcp://|pip install|-m pytest|/dev/tty")
"""What needs more than this machine, or tests the project itself."""
STREAMS = re.compile(r"--stream|^servofd serve|^servofd monitor (?!.*--duration)")
"""What runs until it is ended, beside what comes after it."""
MISSING = re.compile(r"no such file|cannot read", re.IGNORECASE)
ENOUGH_S = 15.0


def commands(page: Path) -> list[str]:
    """Lines of a page that are to be typed."""
    lines = []
    for language, block in re.findall(r"```(sh|console)\n(.*?)```", page.read_text(), re.DOTALL):
        typed = [line for line in block.splitlines() if language == "sh" or line.startswith("$ ")]
        lines += [re.sub(r"\s+# .*", "", line.removeprefix("$ ")) for line in typed]
    return [line for line in lines if line.strip() and not BEYOND.search(line)]


PAGES = [page for page in sorted(ROOT.glob("docs/*.md")) if commands(page)]


@pytest.mark.nightly
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_page_runs_in_an_empty_folder(page: Path, tmp_path: Path) -> None:
    for linked in re.findall(r"\]\((\w+\.py)\)", page.read_text()):
        shutil.copy(page.parent / linked, tmp_path)
    failed = []
    with ExitStack() as running:
        for line in commands(page):
            words = [sys.executable, "-m", *shlex.split(line)] if line.startswith("servofd") else shlex.split(line)
            process = subprocess.Popen(
                words, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, stdin=subprocess.DEVNULL
            )
            if STREAMS.search(line) and "--stream" in line:
                running.callback(process.communicate)
                running.callback(process.send_signal, signal.SIGINT)
                continue
            try:
                told, complained = process.communicate(timeout=ENOUGH_S if STREAMS.search(line) else 300.0)
            except subprocess.TimeoutExpired:
                process.send_signal(signal.SIGINT)
                told, complained = process.communicate()
            # A log that is not cleared ends with 2, and says so where its verdict stands.
            wrong = process.returncode not in (0, 1, 2, 130) or (process.returncode == 2 and not told.strip())
            if wrong or MISSING.search(complained):
                failed.append(f"{line}\n    {complained.strip() or told.strip()}")
    assert not failed, "\n".join(failed)
