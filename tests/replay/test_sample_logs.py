"""The sample logs: made by their script byte for byte, and judged as their README says."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest

import logparsers
import servofd

SAMPLES = Path(__file__).parent.parent.parent / "sample_logs"
# Status of the surface that matters, onset and alarm [s] (None: healthy).
VERDICTS: dict[str, tuple[str, str, float | None, float | None]] = {
    "faser_healthy_flight": ("aileron_right", "healthy", None, None),
    "faser_healthy_chirp": ("aileron_right", "healthy", None, None),
    "faser_deadband_flight": ("aileron_right", "fault", 0.0, 3.5),
    "faser_deadband_chirp": ("aileron_right", "fault", 0.0, 0.3),
    "faser_stuck_flight": ("elevator", "fault", 5.0, 8.2),
    "faser_stuck_chirp": ("aileron_right", "fault", 0.0, 0.3),
}


@pytest.mark.parametrize("name", VERDICTS)
def test_verdicts(name: str) -> None:
    surface, status, onset_s, alarm_s = VERDICTS[name]
    (result,) = servofd.audit(SAMPLES / f"{name}.mat")
    verdicts = {verdict.surface: verdict for verdict in result.surfaces}
    assert verdicts[surface].status == status
    for other, verdict in verdicts.items():
        if other != surface:
            assert verdict.status == ("no_data" if other.startswith("flap") else "healthy")
    if onset_s is not None and alarm_s is not None:
        (episode,) = verdicts[surface].episodes
        assert onset_s <= episode.start_s <= episode.alarm_s <= alarm_s
        assert episode.end_s is None


def test_the_script_makes_the_same_bytes(tmp_path: Path) -> None:
    made = runpy.run_path(str(SAMPLES / "make.py"))["make"](tmp_path)
    assert {path.stem for path in made} == set(VERDICTS)
    for path in made:
        ours, stored = logparsers.read(path), logparsers.read(SAMPLES / path.name)
        assert list(ours.channels) == list(stored.channels)
        for channel in ours.channels:
            # Single precision on file; another CPU may round the last bit of the simulation otherwise.
            np.testing.assert_allclose(ours[channel].values, stored[channel].values, rtol=2e-7, atol=1.0)
        assert path.stat().st_size == (SAMPLES / path.name).stat().st_size
