"""No reader takes more than six times the file beyond what it was asked for."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).resolve().parents[2] / "benchmarks" / "memory.py"


KINDS = (
    *("bin", "bin.gz", "bin.zip", "log", "old_log", "tlog", "named_values", "ulg"),
    *("table", "table_crlf", "table_semicolon", "table_blanks", "table_quoted", "table_runs", "table_digits"),
    *("table_empty", "level4", "level5", "level5_packed"),
    *("hdf5", "hdf5_packed"),
)


@pytest.mark.nightly
@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="peaks are read from /proc")
@pytest.mark.parametrize("kind", KINDS)
def test_six_times_the_file_are_enough(kind: str) -> None:
    command = [sys.executable, str(SCRIPT), kind, "--mb", "20"]
    told = subprocess.run(command, capture_output=True, text=True, check=True, timeout=600).stdout
    assert len(told.splitlines()) == 2
    assert "over" not in told
