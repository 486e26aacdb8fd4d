"""Axes in the terminal and in recordings."""

from __future__ import annotations

import gzip
from dataclasses import replace
from pathlib import Path

import pytest
from scipy import stats

from servofd.aircraft.axes import motion_to_toml
from servofd.axes.judge import judge_motion
from servofd.axes.verdict import AxisAudit, AxisDetectable, AxisEvent, reason_of
from servofd.cli import main
from servofd.core.statistics import Estimate
from servofd.fleets.overview import overview
from servofd.fleets.store import read_logs, read_table
from servofd.outputs.sentence import axes_sentence
from tests.axes.flights import calibrated, flown
from tests.axes.test_axes import as_table
from tests.axes.test_bad_input import roll_of
from tests.fleet.conftest import in_line


@pytest.mark.slow
def test_an_axis_has_its_lanes_in_rerun(tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    from rerun.chunk import RrdReader

    plane, recording = tmp_path / "plane.toml", tmp_path / "flight.rrd"
    plane.write_text(motion_to_toml(calibrated()))
    log = as_table(tmp_path, "2026-05-09.csv", flown(51, "2026-05-09", aileron_share=0.2, from_s=60.0))
    main(["audit", log, "-c", str(plane), "--rrd", str(recording)])
    places = {str(chunk.entity_path) for chunk in RrdReader(recording).stream()}
    assert {"/axes/roll/effect", "/axes/roll/distance", "/axes/roll/state"} <= places


@pytest.mark.slow
def test_many_flights_without_feedback_are_judged_by_their_axes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """In lines, overview, page, tables and exit code, as flights whose servos report positions are."""
    monkeypatch.setattr("servofd.fleets.run.run_local", in_line)
    plane, flights, results = tmp_path / "plane.toml", tmp_path / "flights", tmp_path / "results"
    plane.write_text(motion_to_toml(calibrated()))
    flights.mkdir()
    as_table(flights, "2026-05-08.csv", flown(50, "2026-05-08"))
    as_table(flights, "2026-05-09.csv", flown(51, "2026-05-09", aileron_share=0.2, from_s=60.0))
    code = main(["audit", str(flights), "-c", str(plane), "-o", str(results)])
    lines = capsys.readouterr().out.splitlines()
    kept = read_table(results, "axes")
    assert [row["axis"] for row in kept] == ["roll", "roll"]
    found = {Path(row["path"]).stem[-1]: row for row in kept}
    assert found["8"]["status"] == "healthy"
    assert found["9"]["status"] in ("suspect", "fault")
    assert found["9"]["lost_share"] == pytest.approx(0.8, abs=0.15)
    assert code == (1 if found["9"]["status"] == "fault" else 2)
    assert any(line.startswith(f"{found['9']['status']} ") and "2026-05-09.csv" in line for line in lines)
    (count,) = overview(read_logs(results)).axes
    assert count["logs"] == {"healthy": 1, found["9"]["status"]: 1}
    assert count["effect_left"] is not None
    assert count["effect_left"][0] == count["effect_left"][1] == pytest.approx(1.0, abs=0.1)
    page = (results / "fleet.html").read_text()
    assert "Axes, judged by the motion of the aircraft" in page
    assert "No log was judged" not in page


@pytest.mark.slow
def test_a_flight_that_comes_again_under_another_name_does_not_calibrate(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first = Path(as_table(tmp_path, "2026-05-08.csv", flown(50, "2026-05-08")))
    again = tmp_path / "copy.csv.gz"
    again.write_bytes(gzip.compress(first.read_bytes()))
    assert main(["calibrate", str(first), str(again), "-o", str(tmp_path / "plane.toml")]) == 2
    assert "copy.csv.gz: the same flight as " in capsys.readouterr().err
    assert not (tmp_path / "plane.toml").exists()


@pytest.mark.slow
def test_an_axis_that_is_surely_a_little_weak_is_not_said_to_answer_as_ever() -> None:
    healthy = roll_of(flown(50, "2026-05-09"))
    assert healthy.status == "healthy"
    assert healthy.lost_share is not None
    width = healthy.lost_share.high - healthy.lost_share.low
    as_ever = replace(healthy, lost_share=Estimate(0.0, -width / 2.0, width / 2.0))
    weak = replace(healthy, status="unknown", lost_share=Estimate(0.1, 0.03, 0.17))
    assert axes_sentence([as_ever]) == "Roll answered as on healthy days."
    size = "10% weaker (3 to 17%), as one healthy flight in 40 seems to be: look at the next ones."
    assert axes_sentence([weak]) == f"Roll is probably {size}"
    both = axes_sentence([as_ever, replace(weak, axis="pitch")])
    assert both == f"Roll answered as on healthy days. Pitch is probably {size}"


@pytest.mark.slow
def test_the_gravest_axis_decides_whether_to_fly_and_that_is_said_once() -> None:
    flight = roll_of(flown(50, "2026-05-09"))
    roll, pitch = replace(flight, status="suspect", reason="lost a half"), replace(flight, axis="pitch", status="fault")
    assert axes_sentence([roll]) == "ROLL: lost a half. Look at it before the next flight."
    assert axes_sentence([roll, pitch]).endswith("Do not fly.")
    assert axes_sentence([roll], "fault") == axes_sentence([roll], "suspect") == "ROLL: lost a half."
    assert axes_sentence([roll, pitch], "suspect").endswith("Do not fly.")
    assert not axes_sentence([roll, pitch], "fault").endswith("fly.")


@pytest.mark.slow
def test_an_axis_whose_interval_excludes_nothing_lost_is_not_healthy() -> None:
    """A fifth less: its interval excludes nothing lost in some of these flights, and all of those say so."""
    found = [roll_of(flown(seed, "2026-05-09", aileron_share=0.82, from_s=0.0)) for seed in range(60, 63)]
    for audit in found:
        assert audit.lost_share is not None
        assert audit.status != "healthy" or audit.lost_share.low <= 0.0
        assert ("weaker than in its good flights" in audit.reason) == audit.is_weaker
    assert any(audit.is_weaker for audit in found)


@pytest.mark.parametrize(
    ("lost", "offset", "holds", "nothing"),
    [
        ((-3.71, -4.2, -3.2), (0.0, -9.0, 9.0), False, False),
        ((-0.02, -0.21, 0.18), (-1.0, -20.0, 18.0), True, True),
        ((-0.02, -0.5, 0.45), (-1.0, -40.0, 38.0), True, True),
        ((-0.2, -0.3, -0.1), (-1.0, -4.0, -0.5), True, True),
        ((0.5, 0.4, 0.6), (-1.0, -20.0, 18.0), True, False),
        ((0.12, 0.02, 0.22), (-1.0, -40.0, 38.0), True, False),
        ((0.02, -0.2, 0.2), (60.0, 40.0, 80.0), True, False),
        ((0.3, -5.0, 5.7), (45.0, -1200.0, 1300.0), True, False),
    ],
)
def test_sizes_that_cannot_be_or_say_nothing_are_no_reason(
    lost: tuple[float, float, float], offset: tuple[float, float, float], *, holds: bool, nothing: bool
) -> None:
    event = AxisEvent(10.0, 11.0, None, 3.0, Estimate(*lost), Estimate(*offset))
    assert (event.model_holds, event.is_nothing) == (holds, nothing)


def healthy_roll() -> AxisAudit:
    return next(one for one in judge_motion(calibrated(), flown(50, "2026-05-09")) if one.axis == "roll")


@pytest.mark.slow
def test_an_offset_that_is_known_is_not_called_a_loss_that_may_be_none() -> None:
    model, half = calibrated(), Estimate(0.07, -0.13, 0.27)
    event = AxisEvent(60.0, 61.0, None, 9.0, half, Estimate(56.0, 40.0, 72.0))
    either = replace(event, lost_share=Estimate(0.25, -0.21, 0.99), offset_us=Estimate(70.0, -16.0, 155.0))
    audits = [replace(healthy_roll(), members=(), events=(one,), status="suspect") for one in (event, either)]
    said = [reason_of(audit, model, audit.events[0], {}) for audit in audits]
    assert "acted as if +56 us away" in said[0]
    assert "hardly tells which" in said[1]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("least", "lost", "says"),
    [
        (0.1, Estimate(0.1, -0.6, 0.8), "known to ±70% only"),
        (0.1, Estimate(0.0, -0.1, 0.1), "too little motion"),
        (0.6, Estimate(0.1, -0.6, 0.8), "too little motion"),
    ],
)
def test_too_little_motion_is_no_reason_where_one_that_got_stuck_would_have_shown(
    least: float, lost: Estimate, says: str
) -> None:
    both, smallest = ("aileron_left", "aileron_right"), AxisDetectable(least, 40.0)
    judged = replace(healthy_roll(), status="unknown", members=both, detectable=smallest)
    calm = replace(judged, lost_share=lost, identifiable=0.05)
    assert says in reason_of(calm, calibrated(), None, {"stall": 0.0})


@pytest.mark.slow
def test_few_flights_of_calibration_leave_the_lost_share_less_sure() -> None:
    flight, widths = flown(50, "2026-05-09"), []
    for flights in (2, 6, 100):
        axis = calibrated().axes["roll"].model_copy(update={"flights": flights})
        (roll,) = judge_motion(calibrated().model_copy(update={"axes": {"roll": axis}}), flight)
        assert roll.lost_share is not None
        widths.append(roll.lost_share.high - roll.lost_share.low)
    normal = widths[-1] / stats.t.ppf(0.975, 99)
    assert widths[0] == pytest.approx(normal * stats.t.ppf(0.975, 1), rel=1e-6)
    assert widths[1] == pytest.approx(normal * stats.t.ppf(0.975, 5), rel=1e-6)
