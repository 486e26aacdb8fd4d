"""A software-in-the-loop flight with servo feedback, in which two servos jam; nothing is configured by hand.

The aileron on output 1 is frozen from 93.5 to 128.4 s, the elevator on output 10 from 133.4 to 168.1 s; the other
four servos are healthy, and of two different types.
"""

from __future__ import annotations

from pathlib import Path

import pytest

import servofd
from servofd.cli import main
from tests.external.test_bench_tables import DATA

LOGS = DATA / "logs"

pytestmark = pytest.mark.skipif(
    not LOGS.is_dir(), reason="no flight logs: set SERVOFD_EXTERNAL_DATA to the directory that holds bench/ and logs/"
)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("suffix", "aileron", "elevator", "only"),
    [
        ("bin", "aileron_1", "elevator_10", ("aileron_1", "elevator_2", "elevator_10")),
        pytest.param("bin", "aileron_1", "elevator_10", (), marks=pytest.mark.nightly),
        pytest.param("tlog", "servo_1", "servo_10", (), marks=pytest.mark.nightly),
    ],
)
def test_both_jams_are_found_and_nothing_else(suffix: str, aileron: str, elevator: str, only: tuple[str, ...]) -> None:
    (result,) = servofd.audit(LOGS / f"ardupilot_sitl_feedback.{suffix}", surfaces=only)
    verdicts = {verdict.surface: verdict for verdict in result.surfaces}
    assert len(verdicts) == (len(only) if only else 6)
    assert {name for name, verdict in verdicts.items() if verdict.status == "fault"} == {aileron, elevator}
    sound = [verdict for name, verdict in verdicts.items() if name not in (aileron, elevator)]
    # Readings that are a sample or two late at steps of the command, as in both logs, contradict no servo; where they
    # come at 25 Hz, one of four is to be looked at.
    assert {v.status for v in sound} <= {"healthy", "suspect"}
    assert sum(v.status == "healthy" for v in sound) >= 0.75 * len(sound)
    # A servo fitted to the log accuses of what no servo would do: one brisk command after the jam at 93.5 s shows it.
    assert verdicts[aileron].faults[0].start_s == pytest.approx(93.5, abs=0.3)
    assert verdicts[aileron].faults[0].alarm_s == pytest.approx(94.5, abs=1.5)
    # The elevator rested when it jammed at 133.4 s; its first large motion comes at 142 s.
    assert verdicts[elevator].faults[0].start_s == pytest.approx(133.4, abs=0.6)
    assert verdicts[elevator].faults[0].alarm_s <= 144.5


@pytest.mark.nightly
@pytest.mark.parametrize("ends_mb", [(1.4, 8.5, 13.0), (2.5, 4.0, 5.5, 7.0, 10.0, 11.5, 13.0)])
def test_no_beginning_of_the_log_accuses_a_servo_that_is_well(ends_mb: tuple[float, ...], tmp_path: Path) -> None:
    """Of 1.4 to 13 MB, cut anywhere: only what has jammed by then is at fault, and both jams are before the end."""
    content = (LOGS / "ardupilot_sitl_feedback.bin").read_bytes()
    jammed_s = {"aileron_1": 93.5, "elevator_10": 133.4}
    log = tmp_path / "beginning.bin"
    for megabytes in ends_mb:
        log.write_bytes(content[: int(megabytes * 1e6)])
        (result,) = servofd.audit(log)
        faults = {verdict.surface: verdict.faults[0].start_s for verdict in result.surfaces if verdict.faults}
        assert faults == {name: pytest.approx(jammed_s[name], abs=0.6) for name in faults}
        assert len(result.surfaces) == 6
    assert set(faults) == set(jammed_s)


@pytest.mark.nightly
def test_the_drafted_file_gives_the_same_verdicts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = str(LOGS / "ardupilot_sitl_feedback.bin")
    assert main(["config", log]) == 0
    config = tmp_path / "plane.toml"
    config.write_text(capsys.readouterr().out)
    assert main(["audit", log, "-c", str(config)]) == 1
    capsys.readouterr()
    (drafted,), (fitted,) = servofd.audit(log, config), servofd.audit(log)
    assert [v.status for v in drafted.surfaces] == [v.status for v in fitted.surfaces]
    assert sum(v.status == "fault" for v in drafted.surfaces) == 2


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        pytest.param("ardupilot_sitl_feedback.bin", "ArduPlane V4.7.0-dev", marks=pytest.mark.nightly),
        ("ardupilot_plane_1s.bin", "ArduPlane V3.8.2-dev"),
        ("ardupilot_no_gps.bin", "ArduCopter V3.6.8"),
        ("ardupilot_vtol.tlog", "NAMED_VALUE_FLOAT SRVP1"),
        ("px4_small.ulg", "DEBUG_FLOAT_ARRAY"),
    ],
)
def test_info_tells_what_is_there_and_what_is_missing(
    name: str, expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["info", str(LOGS / name)]) == 0
    assert expected in capsys.readouterr().out


@pytest.mark.nightly
@pytest.mark.skipif(not (LOGS / "vehicles").is_dir(), reason="no logs of vehicles")
def test_a_jam_with_hardly_any_current_is_no_fault_of_the_sensor() -> None:
    """An elevon that is held draws 0.24 A while the healthy one would draw 2.7 A."""
    (audit,) = servofd.audit(LOGS / "vehicles" / "elevon_six_faults.bin.gz")
    elevon = audit["elevon_left"]
    assert elevon.faults[0].kind == "stuck"
    assert elevon.current is not None
    assert "its sensor is at fault" not in f"{elevon.reason} {elevon.current.reason}"
