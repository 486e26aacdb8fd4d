"""Where real logs are found: ``$SERVOFD_EXTERNAL_DATA``, or ``shared/data`` beside the repository."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


def real_logs(suffix: str) -> list[Path]:
    """Real logs with a suffix; the test is skipped, with the reason, if there are none."""
    named = os.environ.get("SERVOFD_EXTERNAL_DATA")
    place = Path(named) if named else Path(__file__).resolve().parents[3] / "shared" / "data"
    found = sorted(place.glob(f"logs/*{suffix}"))
    if not found:
        pytest.skip(f"no real {suffix} logs: set SERVOFD_EXTERNAL_DATA, or put them into shared/data/logs")
    return found
