"""Pictures and recordings: what they show is what was audited."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import servofd
from servofd.core.errors import NoMeasurement
from servofd.detection.verdict import LogAudit
from servofd.outputs.chart import Chart, Curve, Panel, bridged, thinned
from servofd.outputs.figure import save_figure
from servofd.outputs.recording.write import save_recording
from tests.recordings.inside import everything

SAMPLES = Path(__file__).parent.parent.parent / "sample_logs"


@pytest.fixture(scope="module")
def stuck() -> LogAudit:
    result: LogAudit
    (result,) = servofd.audit(SAMPLES / "faser_stuck_flight.mat")
    return result


@pytest.fixture(scope="module")
def recording(stuck: LogAudit, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "stuck.rrd"
    save_recording(stuck, path)
    return path


def colour_share(path: Path, colour: str, tolerance: float = 0.1) -> float:
    """Share of pixels close to a colour."""
    from matplotlib.colors import to_rgb
    from matplotlib.image import imread

    picture = imread(path)[:, :, :3]
    return float(np.mean(np.max(np.abs(picture - np.array(to_rgb(colour))), axis=2) < tolerance))


@pytest.mark.slow
def test_the_figure_shows_curves_threshold_and_fault(stuck: LogAudit, tmp_path: Path) -> None:
    from servofd.outputs.palette import COLOURS

    fault, healthy = tmp_path / "fault.png", tmp_path / "healthy.png"
    save_figure(stuck.surfaces[0], fault, "stuck")
    save_figure(stuck.surfaces[1], healthy, "healthy")
    for colour in ("simulated", "measured", "fault"):
        assert colour_share(fault, COLOURS[colour]) > 3e-4
    # The alarm strip and the alarm line are there in one picture and not in the other.
    assert colour_share(fault, COLOURS["fault"]) > 1.5 * colour_share(healthy, COLOURS["fault"])


def test_no_spike_is_lost_in_a_long_figure() -> None:
    values = np.zeros(1_000_000)
    values[123_456], values[654_321] = 7.0, -5.0
    time_s, thin = thinned(np.arange(1_000_000.0), values, 4000)
    assert (thin.max(), thin.min()) == (7.0, -5.0)
    assert abs(time_s[np.argmax(thin)] - 123_456) < 600


def test_a_reading_that_came_twice_does_not_break_the_line_and_silence_does() -> None:
    time_s = np.linspace(0.0, 7.98, 400)
    values = np.where(np.arange(400) % 2, np.nan, np.sin(time_s))  # the second of each pair is not judged
    whole = Curve("measured", "measured", *bridged(time_s, values))
    values[100:200] = np.nan
    silent = Curve("measured", "measured", *bridged(time_s, values))
    for curve, pieces in ((whole, 1), (silent, 2)):
        panel = Panel("deflection", "deg", (curve,), -1.0, 1.0)
        ((_, path),) = Chart("", "", 0.0, 8.0, (panel,)).paths(panel)
        assert path.count("M") == pieces


@pytest.mark.slow
def test_a_surface_without_residual_is_not_drawn(stuck: LogAudit, tmp_path: Path) -> None:
    with pytest.raises(NoMeasurement, match="nothing to draw"):
        save_figure(stuck.surfaces[-1], tmp_path / "x.png", "flap")
    assert not list(tmp_path.iterdir())


def columns(path: Path, entity: str, component: str) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Times [s] and values of one component, read back without servofd."""
    from rerun.chunk import RrdReader

    times, values = [], []
    stream = RrdReader(str(path)).stream().filter(content=entity, has_timeline="time_boot", components=component)
    for chunk in stream:
        batch = chunk.to_record_batch()
        times.append(batch.column("time_boot").to_numpy(zero_copy_only=False).astype("int64") / 1e9)
        cells = batch.column(component)
        values.append(cells.flatten().to_numpy(zero_copy_only=False).reshape(len(cells), -1))
    order = np.argsort(np.concatenate(times), kind="stable")
    return np.concatenate(times)[order], np.concatenate(values)[order]


@pytest.mark.slow
def test_the_recording_reads_back_what_was_audited(stuck: LogAudit, recording: Path) -> None:
    elevator = stuck.surfaces[0]
    assert elevator.residuals is not None
    time_s, deflection = columns(recording, "/surfaces/elevator/deflection", "Scalars:scalars")
    np.testing.assert_allclose(time_s, elevator.residuals.time_s, atol=0.5e-6, rtol=0.0)
    assert np.array_equal(deflection[:, 1], elevator.residuals.simulated_deg, equal_nan=True)
    assert np.array_equal(deflection[:, 2], elevator.residuals.measured_deg, equal_nan=True)
    _, residual = columns(recording, "/surfaces/elevator/residual", "Scalars:scalars")
    settled = elevator.residuals.settled
    assert np.array_equal(residual[settled, 0], elevator.residuals.residual_deg[settled])
    assert np.isnan(residual[~settled, 0]).all()
    assert (residual[:, 1] == 1.5).all()
    assert (residual[:, 2] == -1.5).all()
    when, states = columns(recording, "/surfaces/elevator/state", "StateChange:state")
    assert states[:, 0].tolist() == ["OK", "FAULT"]
    assert when[1] == pytest.approx(elevator.faults[0].alarm_s, abs=1e-6)


@pytest.mark.slow
def test_the_recording_tells_nothing_of_the_machine(recording: Path) -> None:
    assert str(SAMPLES.parent) not in everything(recording)


@pytest.mark.slow
def test_the_recording_passes_the_viewers_own_check(recording: Path) -> None:
    verify = [sys.executable, "-m", "rerun", "rrd", "verify", str(recording)]
    result = subprocess.run(verify, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
