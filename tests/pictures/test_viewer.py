"""What the viewer shows: every tab of a healthy flight, of each kind of fault, of a log with gaps."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import servofd
from servofd.cli import main
from servofd.outputs.palette import COLOURS
from servofd.outputs.recording.write import save_recording
from tests.pictures.viewer import Viewer, pixels, share_of, viewer, why_not

SAMPLES = Path(__file__).parent.parent.parent / "sample_logs"
FAULTS = {
    "bias": "faser_bias_flight.mat",
    "deadband": "faser_deadband_flight.mat",
    "floating": "faser_floating_flight.mat",
    "hardover": "faser_hardover_flight.mat",
    "loss_of_effectiveness": "faser_loss_flight.mat",
    "oscillation": "faser_oscillation_flight.mat",
    "slow": "faser_slow_flight.mat",
    "stuck": "faser_stuck_flight.mat",
}
pytestmark = pytest.mark.nightly


def recorded(log: Path, folder: Path, **options: bool) -> Path:
    """Recording of a log's first run."""
    path = folder / f"{log.stem}.rrd"
    save_recording(next(iter(servofd.audit(log))), path, **options)
    return path


@pytest.fixture(scope="module")
def opened(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Viewer]:
    folder = tmp_path_factory.mktemp("probe")
    reason = why_not(recorded(SAMPLES / "table_three_faults.csv", folder), folder)
    if reason:
        pytest.skip(reason)
    with viewer() as one:
        yield one


def band(picture: NDArray[np.float64], top: float, bottom: float) -> NDArray[np.float64]:
    """Rows of a picture between two shares of its height."""
    height = picture.shape[0]
    return picture[int(top * height) : int(bottom * height)]


def check_surface(picture: NDArray[np.float64], *, fault: bool) -> None:
    """Curves in the upper plot, residual and thresholds in the middle one, the lane below; the fault in all three."""
    deflection, residual, lane = band(picture, 0.09, 0.475), band(picture, 0.525, 0.805), band(picture, 0.85, 0.93)
    # Left of here stand legends and axes.
    width = picture.shape[1]
    assert share_of(deflection[:, width // 12 :], COLOURS["measured"]) > 5e-4
    # A quarter, half and three quarters along: the whole flight is in view, not a minute around the cursor.
    for place in (0.3, 0.5, 0.75):
        column = deflection[:, int(place * width) : int(place * width) + width // 20]
        assert share_of(column, COLOURS["measured"]) > 2e-4
    assert share_of(residual, COLOURS["threshold"], 0.3) > 2e-4
    shaded = np.array([0.16, 0.09, 0.04])  # the palette's vermillion, as the viewer blends it with its black
    share = float(np.mean(np.max(np.abs(deflection - shaded), axis=2) < 0.03))
    lane_share = share_of(lane, "#aa4400", 0.1)
    if fault:
        assert share > 0.05
        assert lane_share > 0.03
        assert share_of(residual[:, width // 12 :], COLOURS["fault"], 0.35) > 2e-4
    else:
        assert share < 0.01
        assert lane_share == 0.0
        assert share_of(lane, "#007d5b", 0.1) > 0.1


def test_a_healthy_flight(opened: Viewer, tmp_path: Path) -> None:
    tabs = opened.open(recorded(SAMPLES / "faser_healthy_flight.mat", tmp_path))
    assert len(tabs) == 5  # overview, four surfaces with a measurement
    pictures = [opened.picture(tab) for tab in tabs]
    assert len(set(pictures)) == len(tabs)
    overview = pixels(pictures[0])
    assert share_of(band(overview, 0.1, 0.3), "#007d5b", 0.1) > 0.2
    for picture in pictures[1:5]:
        check_surface(pixels(picture), fault=False)
    assert not opened.complaints()


@pytest.mark.parametrize("kind", FAULTS)
def test_each_kind_of_fault_is_seen(kind: str, opened: Viewer, tmp_path: Path) -> None:
    (audit,) = servofd.audit(SAMPLES / FAULTS[kind])
    (place,) = (i for i, s in enumerate(audit.surfaces) if s.faults)
    path = tmp_path / f"{kind}.rrd"
    save_recording(audit, path)
    tabs = opened.open(path)
    shown = [s.surface for s in audit.surfaces if s.residuals is not None]
    tab = 1 + shown.index(audit.surfaces[place].surface)
    opened.set_time(39.0)
    check_surface(pixels(opened.picture(tabs[tab])), fault=True)
    overview = pixels(opened.picture(tabs[0]))
    assert share_of(band(overview, 0.1, 0.3), "#aa4400", 0.1) > 5e-3
    assert share_of(band(overview, 0.3, 0.66), COLOURS["fault"]) > 1e-5  # the onset's marker
    assert not opened.complaints()


def test_gaps_are_empty_and_said(opened: Viewer, tmp_path: Path) -> None:
    log = tmp_path / "gap.csv"
    assert main(["simulate", "-o", str(log)]) == 0
    lines = log.read_text().splitlines(keepends=True)
    count = len(lines)
    log.write_text("".join(lines[: count * 4 // 10] + lines[count * 6 // 10 :]))
    tabs = opened.open(recorded(log, tmp_path))
    picture = pixels(opened.picture(tabs[1]))
    width = picture.shape[1]
    within = slice(int(0.44 * width), int(0.56 * width))
    for plot in (band(picture, 0.09, 0.475), band(picture, 0.525, 0.805)):
        for name in ("measured", "simulated", "residual"):
            assert share_of(plot[:, within], COLOURS[name]) == 0.0
    lane = band(picture, 0.86, 0.91)[:, within]
    assert share_of(lane, "#707070", 0.1) > 0.2
    assert not opened.complaints()


def test_a_flight_that_was_recorded_live(opened: Viewer, tmp_path: Path) -> None:
    path = tmp_path / "live.rrd"
    log = str(SAMPLES / "telemetry_stuck.tlog")
    options = ["-c", "simulated", "--speed", "0", "--plain", "--no-alert"]
    assert main(["monitor", log, *options, "--rrd", str(path)]) == 1
    overview, elevator = (pixels(opened.picture(opened.open(path)[place])) for place in (0, 2))
    lanes = band(overview, 0.1, 0.3)
    assert share_of(lanes, "#007d5b", 0.1) > 0.1
    assert share_of(lanes, "#aa4400", 0.1) > 5e-3
    half = elevator.shape[1] // 2
    for place in (slice(half // 4, half), slice(half, None)):  # the whole flight, not its last minute
        assert share_of(band(elevator, 0.09, 0.475)[:, place], COLOURS["measured"]) > 5e-4
    assert share_of(band(elevator, 0.525, 0.805)[:, half:], COLOURS["fault"], 0.35) > 2e-4
    assert not opened.complaints()


def test_letters_that_the_viewer_cannot_draw(opened: Viewer, tmp_path: Path) -> None:
    log = tmp_path / "飛行.csv"
    log.write_text((SAMPLES / "table_three_faults.csv").read_text().replace("elevator", "升降舵 ✈/"))
    path = recorded(log, tmp_path).rename(tmp_path / "flight.rrd")
    tabs = opened.open(path)
    assert len({opened.picture(tab) for tab in tabs}) == len(tabs) == 4
    assert not opened.complaints()
