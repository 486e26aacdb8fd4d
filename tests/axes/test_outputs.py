"""Axes in the terminal and in recordings."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from scipy import stats

from servofd.aircraft.axes import motion_to_toml
from servofd.axes.judge import judge_motion
from servofd.cli import main
from servofd.estimate.statistics import Estimate
from servofd.outputs.sentence import axes_sentence
from tests.axes.flights import flown
from tests.axes.test_axes import as_table
from tests.axes.test_bad_input import calibrated, roll_of


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


@pytest.mark.slow
def test_an_axis_that_is_surely_a_little_weak_is_not_said_to_answer_as_ever() -> None:
    healthy = roll_of(flown(50, "2026-05-09"))
    assert healthy.status == "healthy"
    assert healthy.lost_share is not None
    width = healthy.lost_share.high - healthy.lost_share.low
    as_ever = replace(healthy, lost_share=Estimate(0.0, -width / 2.0, width / 2.0))
    weak = replace(healthy, lost_share=Estimate(0.1, 0.03, 0.17))
    assert axes_sentence([as_ever]) == "Roll answered as on healthy days."
    size = "10% weaker (3 to 17%), as one healthy flight in 40 seems to be: look at the next ones."
    assert axes_sentence([weak]) == f"Roll is probably {size}"
    both = axes_sentence([as_ever, replace(weak, axis="pitch")])
    assert both == f"Roll answered as on healthy days. Pitch is probably {size}"


@pytest.mark.slow
def test_the_reason_of_a_weak_axis_says_how_rare_that_is() -> None:
    """A fifth less: its interval excludes nothing lost in some of these flights, and all of those say so."""
    found = [roll_of(flown(seed, "2026-05-09", aileron_share=0.82, from_s=0.0)) for seed in range(60, 63)]
    healthy = [audit for audit in found if audit.status == "healthy"]
    for audit in healthy:
        assert ("weaker than in its good flights" in audit.reason) == audit.is_weaker
    assert any(audit.is_weaker for audit in healthy)


@pytest.mark.slow
def test_few_flights_of_calibration_leave_the_lost_share_less_sure() -> None:
    flight, widths = flown(50, "2026-05-09"), []
    for flights in (2, 6, 100):
        (roll,) = judge_motion(calibrated().model_copy(update={"flights": flights}), flight)
        assert roll.lost_share is not None
        widths.append(roll.lost_share.high - roll.lost_share.low)
    normal = widths[-1] / stats.t.ppf(0.975, 99)
    assert widths[0] == pytest.approx(normal * stats.t.ppf(0.975, 1), rel=1e-6)
    assert widths[1] == pytest.approx(normal * stats.t.ppf(0.975, 5), rel=1e-6)
