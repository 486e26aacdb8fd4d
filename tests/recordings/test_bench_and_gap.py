"""Recordings of identify and explain: what was measured, what was simulated, and nothing of the machine."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servofd.cli import main
from servofd.outputs.live_recording import LiveRecording, Samples
from servofd.outputs.palette import COLOURS, rgba
from servofd.outputs.recording.stream import surface_place
from servofd.servo.context import NO_CONTEXT
from tests.recordings.inside import everything
from tests.recovery.bench import sweep, written

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
def bench(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recording of two tests with one servo, in a folder whose name must not leave the machine."""
    folder = tmp_path_factory.mktemp("secret_hangar")
    logs = [written(folder / f"chirp_{k}.csv", sweep("hs225bb-eq31", duration_s=20.0)) for k in (1, 2)]
    for _ in range(2):  # a second run replaces the first one's output
        assert main(["identify", *map(str, logs), "--rrd", str(folder / "servo.rrd")]) == 0
    return folder / "servo.rrd"


@pytest.mark.slow
def test_the_servo_that_was_found_stands_beside_each_test(bench: Path) -> None:
    log = sweep("hs225bb-eq31", duration_s=20.0)
    found = curves(bench)
    for name in ("elevator", "elevator 2"):
        time_us, deflection = found[surface_place(name, "deflection")]
        _, error = found[surface_place(name, "error")]
        used = np.isin(np.rint(log.measured_s * 1e6), time_us)  # a reading far out of the noise may be none
        assert used.sum() == time_us.size >= 0.999 * log.measured_s.size
        np.testing.assert_allclose(deflection[:, 2], log.measured_deg[used], atol=1e-5)
        np.testing.assert_array_equal(deflection[:, 2] - error[:, 0], deflection[:, 1])
        assert np.std(error) < 0.15
    said = everything(bench)
    assert "bandwidth" in said
    assert "chirp_1.csv, chirp_2.csv" in said
    assert "secret_hangar" not in said


def test_there_are_no_verdicts_to_review(bench: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["review", str(bench)]) == 2
    assert "servo.rrd: a recording of servofd identify: no verdicts to review" in capsys.readouterr().err


@pytest.mark.parametrize("surface", ['a/b "c"', "<script>alert(1)</script>", "Höhenruder ✈"])
def test_names_of_surfaces_are_kept_as_they_are(surface: str, tmp_path: Path) -> None:
    live = LiveRecording("x", [surface], path=tmp_path / "live.rrd")
    time_s = np.arange(5) / 10.0
    columns = [np.full(5, float(k)) for k in range(5)]
    asked_deg, simulated_deg, measured_deg, residual_deg, threshold_deg = columns
    deflections = asked_deg, simulated_deg, measured_deg
    live.add(Samples(surface, time_s, *deflections, residual_deg, threshold_deg, time_s, asked_deg, NO_CONTEXT))
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
    assert main(["audit", str(log), "--rrd", str(path)]) == 1
    assert not any(letter in everything(path) for letter in "升降舵飛行")
    capsys.readouterr()
    assert main(["review", str(path)]) == 1
    assert "升降舵: " in capsys.readouterr().out
    assert main(["review", str(path), "--threshold-deg", "1.5"]) == 1


def test_every_recording_has_the_colours_of_the_palette(bench: Path, tmp_path: Path) -> None:
    LiveRecording("x", ["rudder"], path=tmp_path / "live.rrd").close()
    wanted = str([rgba(name) for name in ("command", "simulated", "measured")])
    assert COLOURS["simulated"] == "#0072b2"
    for path in (bench, tmp_path / "live.rrd"):
        assert wanted in everything(path)
