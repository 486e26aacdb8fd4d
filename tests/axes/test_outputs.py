"""Axes in the terminal and in recordings."""

from __future__ import annotations

from pathlib import Path

import pytest

from servofd.aircraft.axes import motion_to_toml
from servofd.cli import main
from tests.axes.flights import flown
from tests.axes.test_axes import as_table
from tests.axes.test_bad_input import calibrated


@pytest.mark.slow
def test_an_axis_has_its_line_in_the_terminal_and_its_lanes_in_rerun(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("rerun")
    from rerun.chunk import RrdReader

    plane, recording = tmp_path / "plane.toml", tmp_path / "flight.rrd"
    plane.write_text(motion_to_toml(calibrated()))
    log = as_table(tmp_path, "2026-05-09.csv", flown(51, "2026-05-09", aileron_share=0.2, from_s=60.0))
    main(["audit", log, "-c", str(plane), "--plot", "--rrd", str(recording)])
    line = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("roll  "))
    assert set(line[6:]) & set("▅▆▇█")
    assert set(line[6:20]) <= set("▁▂▃▄·")
    places = {str(chunk.entity_path) for chunk in RrdReader(recording).stream()}
    assert {"/axes/roll/effect", "/axes/roll/distance", "/axes/roll/state"} <= places
