"""A log that is replayed through the monitor."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from servofd.cli import main


def watched(log: Path, plane: str) -> tuple[int, list[dict[str, Any]]]:
    """Exit code and events of a replay; what it prints is left to whoever wants to read it."""
    lines = log.with_suffix(".jsonl")
    code = main(["monitor", str(log), "-c", plane, "--speed", "0", "--plain", "--json-lines", str(lines)])
    return code, [json.loads(line) for line in lines.read_text().splitlines()]
