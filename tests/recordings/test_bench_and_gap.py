"""Recordings of explain: what was measured, what was simulated, and nothing of the machine."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servofd.cli import main
from servofd.outputs.live_recording import LiveRecording, Samples
from servofd.outputs.palette import COLOURS, rgba
from servofd.outputs.recording.content import Trace
from servofd.outputs.recording.stream import surface_place
from tests.recordings.inside import everything

SAMPLES = Path(__file__).parent.parent.parent / "sample_logs"


def curves(path: Path) -> dict[str, Any]:
    """Time stamps [us] and values of shape (n, k), by entity."""
    from rerun.chunk import RrdReader

    found = {}
    for chunk in RrdReader(str(path)).stream().filter(has_timeline="time_boot", components="Scalars:scalars"):
        batch = chunk.to_record_batch()
        values = batch.column("Scalars:scalars")
        time_us = np.array(batch.column("time_boot").to_numpy(zero_copy_only=False)).astype(np.int64) // 1000
        found[chunk.entity_path] = time_us, np.array(values.flatten()).reshape(len(values), -1)
    return found


@pytest.fixture(scope="module")
def gap(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recording of an explanation, in a folder whose name must not leave the machine."""
    folder = tmp_path_factory.mktemp("secret_hangar")
    log = folder / "bench.csv"
    log.write_bytes(b"".join((SAMPLES / "hidden" / "hidden_07.csv").read_bytes().splitlines(keepends=True)[:1501]))
    LiveRecording("x", ["rudder"], path=folder / "gap.rrd").close()  # an output of before, which is replaced
    assert main(["explain", str(log), "--servo", "hs225bb-eq31", "--rrd", str(folder / "gap.rrd")]) == 0
    return folder / "gap.rrd"


@pytest.mark.slow
def test_there_are_no_verdicts_to_review(gap: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "secret_hangar" not in everything(gap)
    assert main(["review", str(gap)]) == 2
    assert "gap.rrd: a recording of servofd explain: no verdicts to review" in capsys.readouterr().err


@pytest.mark.parametrize("surface", ['a/b "c"', "<script>alert(1)</script>", "Höhenruder ✈"])
def test_names_of_surfaces_are_kept_as_they_are(surface: str, tmp_path: Path) -> None:
    live = LiveRecording("x", [surface], path=tmp_path / "live.rrd")
    time_s = np.arange(5) / 10.0
    columns = [np.full(5, float(k)) for k in range(5)]
    asked_deg, simulated_deg, measured_deg, residual_deg, threshold_deg = columns
    deflections = asked_deg, simulated_deg, measured_deg
    live.add(Samples(surface, Trace(time_s, *deflections, residual_deg, threshold_deg, time_s, asked_deg)))
    live.close()
    time_us, values = curves(tmp_path / "live.rrd")[surface_place(surface, "deflection")]
    np.testing.assert_array_equal(time_us, np.arange(5) * 100_000)
    np.testing.assert_array_equal(values, np.tile([0.0, 1.0, 2.0], (5, 1)))
    # The viewer crashes at a letter that its font lacks.
    assert "✈" not in everything(tmp_path / "live.rrd")


@pytest.mark.slow
def test_an_audit_keeps_names_that_the_viewer_cannot_draw(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log, path = tmp_path / "飛行.csv", tmp_path / "flight.rrd"
    log.write_text((SAMPLES / "table_three_faults.csv").read_text().replace("elevator", "升降舵"))
    assert main(["audit", str(log), "-s", "升降舵", "--servo", "hs225bb-eq31", "--rrd", str(path)]) == 1
    assert not any(letter in everything(path) for letter in "升降舵飛行")
    capsys.readouterr()
    assert main(["review", str(path)]) == 1
    assert "升降舵: " in capsys.readouterr().out


@pytest.mark.slow
def test_every_recording_has_the_colours_of_the_palette(gap: Path, tmp_path: Path) -> None:
    LiveRecording("x", ["rudder"], path=tmp_path / "live.rrd").close()
    wanted = str([rgba(name) for name in ("command", "simulated", "measured")])
    assert COLOURS["simulated"] == "#0072b2"
    assert wanted in everything(tmp_path / "live.rrd")
    assert str([rgba(name) for name in ("command", "fault", "simulated", "measured")]) in everything(gap)
