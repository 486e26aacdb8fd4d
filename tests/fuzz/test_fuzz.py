"""A short run of the coverage-guided fuzzer for each format; the long ones are started by hand."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.fuzz.harness import SEEDS

SECONDS = 3
TARGET = Path(__file__).with_name("fuzz_logs.py")


@pytest.mark.nightly
@pytest.mark.skipif(importlib.util.find_spec("atheris") is None, reason="atheris is not installed: pip install atheris")
@pytest.mark.parametrize("kind", SEEDS)
def test_the_fuzzer_finds_nothing_in_a_few_seconds(kind: str, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, str(TARGET), kind, f"-max_total_time={SECONDS}"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert not list(tmp_path.glob("crash-*"))
