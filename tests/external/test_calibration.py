"""Calibration on the good part of a software-in-the-loop flight in which two servos jam later, and on bench data."""

from __future__ import annotations

from pathlib import Path

import pytest

import servofd
from servofd.aircraft.schema import Aircraft, load_aircraft
from servofd.calibrating.result import calibration_to_toml
from servofd.cli import main
from servofd.core.errors import CalibrationError
from tests.external.test_bench_tables import DATA

LOG = DATA / "logs" / "ardupilot_sitl_feedback.bin"
JAMMED = {"aileron_1", "elevator_10"}


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if not LOG.exists():
        pytest.skip("no flight logs: set SERVOFD_EXTERNAL_DATA to the directory that holds bench/ and logs/")
    import logparsers
    from servofd.feedback.draft import draft_to_toml

    path = tmp_path_factory.mktemp("sitl") / "plane.toml"
    path.write_text(draft_to_toml(logparsers.read(LOG)))
    return path


@pytest.mark.nightly
def test_the_good_part_calibrates_and_the_whole_shows_both_jams(config: Path, tmp_path: Path) -> None:
    found = servofd.calibrate([LOG], config, spans=((float("-inf"), 93.0),))
    assert len(found.surfaces) == 6
    assert all(one.detectable.bias_deg is not None and one.detectable.bias_deg < 2.0 for one in found.surfaces)
    target = tmp_path / "calibrated.toml"
    target.write_text(calibration_to_toml(found))
    (result,) = servofd.audit(LOG, load_aircraft(target))
    verdicts = {verdict.surface: verdict for verdict in result.surfaces}
    assert {name for name, verdict in verdicts.items() if verdict.status == "fault"} == JAMMED
    good = {name: v for name, v in verdicts.items() if name not in JAMMED}
    assert good["elevator_2"].status == "healthy"
    # A minute at one airspeed does not tell the load of the air from lost travel where a surface hardly moved.
    assert all(v.status == "healthy" or v.reason.startswith("too little motion") for v in good.values())
    aileron, elevator = verdicts["aileron_1"].faults[0], verdicts["elevator_10"].faults[0]
    assert (aileron.kind, elevator.kind) == ("stuck", "stuck")
    assert aileron.alarm_s == pytest.approx(93.7, abs=0.5)
    assert 133.4 <= elevator.alarm_s <= 143.5


@pytest.mark.nightly
def test_the_whole_flight_is_refused_and_both_jams_are_named(
    config: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / "calibrated.toml"
    assert main(["calibrate", str(LOG), "-c", str(config), "-o", str(target)]) == 2
    error = capsys.readouterr().err
    assert "aileron_1: not a good flight" in error
    assert "elevator_10: not a good flight" in error
    assert not any(other in error for other in ("elevator_2", "rudder_4", "aileron_9", "rudder_12"))
    assert not target.exists()


def bench(threshold_deg: float) -> Aircraft:
    servo = {"title": "bench", "bandwidth_hz": 5.0, "damping": 0.8, "delay_s": 0.01, "hold": "zoh", "source": "guess"}
    return Aircraft.model_validate(
        {
            "table": {"time": "t_s", "run": "run"},
            "servos": {"bench": servo | {"rate_limit_deg_s": 400.0}},
            "surfaces": {
                "shaft": {
                    "servo": "bench",
                    "threshold_deg": threshold_deg,
                    "command": {"channel": "cmd", "unit": "deg"},
                    "measured": {"channel": "meas", "unit": "deg"},
                }
            },
        }
    )


NO_PLAY = [("no_play", run) for run in "234"]


@pytest.mark.slow
@pytest.mark.skipif(not (DATA / "bench").is_dir(), reason="no bench data: set SERVOFD_EXTERNAL_DATA")
@pytest.mark.parametrize(
    ("name", "run"),
    [
        ("gravity_load", "0"),
        ("no_play", "1"),
        ("play", "3"),
        ("play", "4"),
        *(pytest.param(*each, marks=pytest.mark.nightly) for each in (("gravity_load", "3"), *NO_PLAY)),
    ],
)
def test_a_smart_servo_calibrated_on_one_run_is_at_fault_in_no_other(name: str, run: str) -> None:
    """Loaded, or pulled by a hand: around 180 deg, at 10 Hz, for 20 s to 60 s."""
    path = DATA / "bench" / f"smart_servo_{name}.csv"
    found = servofd.calibrate([path], bench(3.0), runs=(run,))
    statuses = [result.surfaces[0].status for result in servofd.audit(path, found.aircraft)]
    assert set(statuses) <= {"healthy", "suspect", "unknown"}
    assert name != "gravity_load" or statuses == ["healthy", "healthy"]


@pytest.mark.slow
@pytest.mark.skipif(not (DATA / "bench").is_dir(), reason="no bench data: set SERVOFD_EXTERNAL_DATA")
@pytest.mark.parametrize("run", ["1", "2"])
def test_small_steps_of_a_servo_with_play_tell_too_little(run: str) -> None:
    with pytest.raises(CalibrationError, match="would show no less than the loss"):
        servofd.calibrate([DATA / "bench" / "smart_servo_play.csv"], bench(3.0), runs=(run,))


@pytest.mark.slow
@pytest.mark.skipif(not (DATA / "bench").is_dir(), reason="no bench data: set SERVOFD_EXTERNAL_DATA")
def test_a_servo_that_sticks_under_its_load_is_refused() -> None:
    """With a proportional gain of 100 the servo gives way to its load: no linear model tells where it goes."""
    with pytest.raises(CalibrationError, match="shaft"):
        servofd.calibrate([DATA / "bench" / "smart_servo_gains.csv"], bench(3.0), runs=("0",))
