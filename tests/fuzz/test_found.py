"""What campaigns of broken inputs have found, and must not find again."""

from __future__ import annotations

import io
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pyarrow import parquet

import logparsers
from logparsers import Channel, FlightLog
from logparsers.endpoint import parse_endpoint
from logparsers.errors import LinkError
from servofd import audit, cli
from servofd.aircraft.outputs import find_pairs, outputs_of
from servofd.aircraft.pace import pace_steps
from servofd.aircraft.schema import load_aircraft, plain_aircraft
from servofd.batch.key import Job
from servofd.cli import main
from servofd.core.errors import ConfigError, RecordingError
from servofd.detection.monitor import SurfaceMonitor
from servofd.detection.verdict import Statistics
from servofd.feedback.draft import surface_entry
from servofd.fleets.store import FleetStore, read_table
from servofd.live.session import stamped
from servofd.outputs.recording import read
from servofd.outputs.recording.content import Recording, Trace, audit_of
from servofd.outputs.recording.read import rejudged, statistics_of
from servofd.outputs.recording.stream import recording_file
from servofd.outputs.recording.viewer import run_rerun
from servofd.servo.library import find_servo
from tests.fuzz import seeds
from tests.fuzz.doors import DOORS


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("x = " + "9" * 5000, "digits"),
        ("x = " + "[" * 3000 + "]" * 3000, "too deep"),
        ("x = \udcff", "not a text file"),
    ],
)
def test_toml_that_python_cannot_hold(text: str, reason: str, tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    path.write_text(text, errors="surrogateescape")
    for load in (load_aircraft, find_servo):
        with pytest.raises(ConfigError, match=reason):
            load(str(path))


@pytest.mark.parametrize("name", ["a" * 5000, "a\0b", "a\0b.toml", "a" * 5000 + ".toml"])
def test_names_that_no_file_can_have(name: str) -> None:
    with pytest.raises(ConfigError):
        load_aircraft(name)


@pytest.mark.parametrize("threshold_deg", [1e4, 1e300])
def test_a_threshold_that_nothing_reaches(threshold_deg: float, tmp_path: Path) -> None:
    path = tmp_path / "flight.csv"
    path.write_bytes(seeds.logs_of("table")[0])
    (found,) = audit(path, servo="hs225bb-eq31", threshold_deg=threshold_deg)
    assert not any(surface.faults for surface in found.surfaces)
    assert all(surface.statistics for surface in found.surfaces)


@pytest.mark.parametrize("curve", ["asked_deg", "measured_deg"])
def test_a_recording_whose_numbers_no_servo_reaches(curve: str, tmp_path: Path) -> None:
    path = tmp_path / "flight.csv"
    path.write_bytes(seeds.logs_of("table")[0])
    (found,) = audit(path, servo="hs225bb-eq31", surfaces=("elevator",))
    recording = Recording.of(found)
    values = getattr(recording.traces["elevator"], curve).copy()
    values[20] = -1e308
    damaged = replace(recording, traces={"elevator": recording.traces["elevator"]._replace(**{curve: values})})
    (again,) = rejudged(damaged).audit.surfaces
    assert (again.status, again.faults) == ("unknown", ())
    assert "reaches 1e+308 deg" in again.reason


@pytest.mark.slow
def test_a_delay_longer_than_the_flight(tmp_path: Path) -> None:
    flight, servo = tmp_path / "flight.csv", tmp_path / "servo.toml"
    flight.write_bytes(seeds.logs_of("table")[0])
    servo.write_bytes(seeds.SERVO.replace(b"delay_s = 0.004", b"delay_s = 10.0"))
    (found,) = audit(flight, servo=str(servo))
    assert {surface.status for surface in found.surfaces} <= {"fault", "suspect", "unknown"}


def test_a_stream_that_stands_still_has_a_pace() -> None:
    assert pace_steps(np.array([0.0, 1.0, 1.0, 1.0, 1.0])).tolist() == [1.0, 0.0, 0.0, 0.0]
    assert pace_steps(np.zeros(3)).tolist() == [0.0, 0.0]


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """A folder of results."""
    seeds.fleet_parts(tmp_path)
    return tmp_path / "results"


@pytest.mark.slow
def test_one_wrong_bit_in_a_table_is_told(results: Path) -> None:
    (part,) = (results / "logs").glob("*.parquet")
    content = bytearray(part.read_bytes())
    content[content.index(read_table(results, "logs")[0]["content"].encode()) + 7] ^= 1  # another log's digest
    part.write_bytes(content)
    for use in (
        lambda: read_table(results, "logs"),
        lambda: FleetStore(results, Job().key),
    ):
        with pytest.raises(ConfigError, match=r"damaged .*remove it"):
            use()


@pytest.mark.slow
def test_results_name_no_folder_outside(results: Path) -> None:
    meta = results / "fleet.json"
    meta.write_text(meta.read_text().replace(Job().key, "../../elsewhere"))
    with pytest.raises(ConfigError, match="holds results of the form"):
        FleetStore(results, Job().key)


def test_messages_that_come_again_change_nothing() -> None:
    plane, flown = plain_aircraft(["elevator"], "hs225bb-eq31"), seeds.flight()
    asked, seen = flown.command_deg[:, 0], flown.measured_deg[:, 0]

    def last_reading(again: int) -> object:
        monitor = SurfaceMonitor("elevator", plane.surfaces["elevator"], plane.model("elevator"))
        for row, time_s in enumerate(flown.time_s):
            stamps = np.full(again, time_s)
            monitor.feed((stamps, np.full(again, asked[row])), (stamps, np.full(again, seen[row])))
        assert monitor.was_judged
        return monitor.reading

    assert last_reading(1) == last_reading(5)


def test_a_stream_of_one_instant_is_not_judged() -> None:
    plane = plain_aircraft(["elevator"], "hs225bb-eq31")
    monitor = SurfaceMonitor("elevator", plane.surfaces["elevator"], plane.model("elevator"))
    stamps, values = np.full(300, 7.0), np.arange(300.0) % 9.0
    assert monitor.feed((stamps, values), (stamps, values)) == []
    assert monitor.finish() == []
    assert not monitor.was_judged


def test_a_log_whose_name_no_file_can_have(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["audit", "9" * 5000]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_a_position_too_large_for_a_number() -> None:
    """Of FASER logs, in radians: in degrees it is beyond what 64 bits hold."""
    calibration = load_aircraft("faser").surfaces["elevator"].measured
    assert calibration is not None
    assert np.isinf(calibration.to_deg(np.array([0.1, 0.2, 1e308, 0.3]))).tolist() == [False, False, True, False]


@pytest.mark.slow
@pytest.mark.parametrize("code", [102, -6])
def test_a_recording_at_which_its_library_ends_the_process(
    code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """About one in a hundred that are broken; another process meets it first."""
    path = tmp_path / "flight.rrd"
    path.write_bytes(DOORS["recording"].seeds(tmp_path)[0])
    monkeypatch.setattr(read, "run_rerun", lambda *words: subprocess.CompletedProcess(words, code, ""))
    with pytest.raises(RecordingError, match="damaged beyond"):
        read.read_recording(path)


def test_recorded_numbers_whose_squares_are_none() -> None:
    time_s, huge = np.arange(3.0), np.array([1e300, -1e300, 0.0])
    found = statistics_of(Trace(time_s, time_s, time_s, huge, huge, time_s, time_s, time_s))
    assert found is not None
    assert np.isinf(found.std_deg)
    assert np.isinf(found.simulation_error_rms_deg)
    endless = np.array([np.inf, 0.0, 0.0])
    found = statistics_of(Trace(time_s, time_s, endless, endless, time_s, time_s, time_s, time_s))
    assert found is not None
    assert np.isnan(found.simulation_error_rms_deg)


def test_positions_whose_squares_are_none() -> None:
    found = Statistics.of(np.array([1e300, -1e300]), np.array([1e308, 1e308]))
    assert (found.mean_deg, found.max_abs_deg) == (0.0, 1e300)
    assert np.isinf([found.std_deg, found.simulation_error_rms_deg]).all()


def test_recorded_samples_that_come_again_or_too_late() -> None:
    time_s, asked_s = np.array([0.0, 1.0, 1.0, 0.5, 2.0]), np.array([0.0, 0.0, 3.0, 1.0, 4.0])
    trace = Trace(time_s, time_s, time_s, time_s, time_s, time_s, asked_s, np.arange(5.0))
    segment = trace.segment("x")
    assert segment.measured_s.tolist() == [0.0, 1.0, 2.0]
    assert segment.command_s.tolist() == [0.0, 3.0, 4.0]
    assert segment.command_deg.tolist() == [0.0, 2.0, 4.0]


def test_recorded_commands_that_are_no_numbers() -> None:
    time_s = np.arange(3.0)
    trace = Trace(time_s, time_s, time_s, time_s, time_s, time_s, time_s, np.array([np.inf, 1.0, np.nan]))
    assert trace.segment("elevator").command_deg.tolist() == [1.0]


def test_a_recording_with_two_schemas() -> None:
    with pytest.raises(RecordingError, match="written by schema"):
        audit_of({"schema": ["servofd.identification/1", "servofd.recording/1"]}, "a.rrd")


@pytest.mark.slow
def test_a_table_without_a_row(tmp_path: Path) -> None:
    """Its column of nothing was no column of truths."""
    seeds.fleet_parts(tmp_path)
    (part,) = (tmp_path / "results" / "logs").iterdir()
    parquet.write_table(parquet.read_table(part).slice(0, 0), part)
    with FleetStore(tmp_path / "results", Job().key) as store:
        store.forget_not_judged()
    assert read_table(tmp_path / "results", "logs") == []


def test_a_recording_with_a_column_that_its_library_cannot_name(tmp_path: Path) -> None:
    """It wrote one, and ended the process that read it."""
    path = tmp_path / "flight.rrd"
    with recording_file(path, "servofd", None) as recorder:
        recorder.properties("flight.csv", {"sch\0ma": "servofd.audit/1"})
    with pytest.raises(RecordingError, match="damaged beyond"):
        read.read_recording(path)


def test_the_program_that_reads_first_says_what_it_met_and_reports_to_nobody(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME", "APPDATA", "LOCALAPPDATA"):
        monkeypatch.setenv(name, str(tmp_path / "home"))
    monkeypatch.delenv("CI", raising=False)
    (tmp_path / "broken.rrd").write_bytes(b"RRF2" + bytes(100))
    assert run_rerun("rrd", "verify", str(tmp_path / "broken.rrd")).returncode != 0
    assert not list(tmp_path.rglob("*analytics*"))


@pytest.mark.slow
def test_a_file_of_two_recordings(tmp_path: Path) -> None:
    """Rerun takes the first of them, with a warning."""
    names = [str(tmp_path / name) for name in ("one.rrd", "two.rrd", "both.rrd")]
    for name in names[:2]:
        Path(name).write_bytes(DOORS["recording"].seeds(tmp_path)[0])
    assert run_rerun("rrd", "merge", *names[:2], "-o", names[2]).returncode == 0
    with pytest.raises(RecordingError, match="holds 2 recordings"):
        read.read_recording(tmp_path / "both.rrd")


@pytest.mark.parametrize(
    ("denominator", "why"),
    [
        ("[1.0, 42.0, 9007199254740993]", "swings no faster"),
        ("[1e308, 42.0, 811.0]", "nothing beside"),
        ("[1e-320, 42.0, 811.0]", "nothing beside"),
    ],
)
def test_a_servo_that_no_clock_can_follow(tmp_path: Path, denominator: str, why: str) -> None:
    """It swung a hundred million times a second, which took forever, or its poles were no numbers."""
    path = tmp_path / "servo.toml"
    path.write_text(
        f'[servos.mine]\ntitle = "My servo"\nnumerator = [811.0]\ndenominator = {denominator}\ndelay_s = 0.004\n'
        'hold = "zoh"\nrate_limit_deg_s = 300.0\nsource = "bench"\n'
    )
    with pytest.raises(ConfigError, match=why):
        find_servo(str(path))


def test_a_word_that_is_in_no_name(capsys: pytest.CaptureFixture[str]) -> None:
    """No shell can say it; a program that calls `main` can."""
    with pytest.raises(SystemExit) as ended:
        main(["audit", "flight\0.csv"])
    assert ended.value.code == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_a_log_without_a_name(capsys: pytest.CaptureFixture[str]) -> None:
    """As of a variable that is not set; it was taken for the folder, and everything below it audited."""
    assert main(["audit", ""]) == 2
    assert "without a name" in capsys.readouterr().err


@pytest.mark.parametrize("size", ["amplitude_deg=1e308", "frequency_hz=-1e308"])
def test_a_fault_larger_than_any_servo(size: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flight = tmp_path / "flight.csv"
    assert main(["simulate", "-o", str(flight), "--fault", f"rudder:oscillation@1:{size}"]) == 2
    assert "must be within 1e+09" in capsys.readouterr().err
    assert not flight.exists()


@pytest.mark.parametrize("pole", ["1e-320", "1e30", "0", "nan"])
def test_a_filter_pole_whose_powers_are_no_numbers(pole: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["config", "--filter", "s9254", "--pole", pole]) == 2
    assert "must lie between" in capsys.readouterr().err


@pytest.mark.parametrize("rate_hz", ["1e-320", "0", "nan", "2e6"])
def test_a_rate_whose_inverse_is_no_time(rate_hz: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["config", "--filter", "s9254", "--pole", "50", "--rate-hz", rate_hz]) == 2
    assert "give a rate between" in capsys.readouterr().err


def test_a_filter_that_takes_a_billion_samples_to_settle(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["config", "--filter", "s9254", "--pole", "1e-5"]) == 2
    assert "is no use at 100 Hz" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["tcp:localhost:" + "9" * 5000, "/dev/ttyACM0," + "9" * 5000])
def test_a_port_of_thousands_of_digits(text: str) -> None:
    with pytest.raises(LinkError, match="is no"):
        parse_endpoint(text)


def test_a_program_that_cannot_write_leaves_no_file_open(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(cli, "_show_help", _full)
    before = len(list(Path("/dev/fd").iterdir()))
    assert main(["help"]) == 2
    assert len(list(Path("/dev/fd").iterdir())) <= before  # what earlier tests left open may be closed meanwhile
    assert "No space left" in capsys.readouterr().err


def _full(_options: object) -> int:
    raise OSError(28, "No space left on device")


def test_the_latest_arrival_that_a_telemetry_log_can_hold() -> None:
    """Its microseconds, as seconds in a float and back, are one more than fit."""
    assert stamped((2**64 - 1) / 1e6, b"frame") == b"\xff" * 8 + b"frame"


def test_a_servo_of_an_output_that_no_autopilot_has() -> None:
    """Of a damaged log; it is judged by its channels."""
    log = logparsers.read(io.BytesIO(seeds.logs_of("dataflash")[0]))
    pairs = find_pairs(log)
    far = replace(pairs[0], output=replace(pairs[0].output, number=5_000_001))
    assert "output" in surface_entry(log, pairs[0])
    assert "output" not in surface_entry(log, far)


def test_a_function_of_an_output_that_is_no_number() -> None:
    assert outputs_of(
        {"SERVO1_FUNCTION": float("nan"), "SERVO2_FUNCTION": float("inf"), "SERVO3_FUNCTION": 21.0}
    ).keys() == {3}


def test_pulses_and_positions_whose_squares_are_none() -> None:
    time_s = np.arange(9.0)
    huge = [Channel(name, time_s, 1e300 * np.sin(time_s), "", name) for name in ("RCOU.C1", "CSRV[1].Pos")]
    log = FlightLog(Path("a.bin"), "dataflash", {channel.name: channel for channel in huge})
    assert len(find_pairs(log)) == 1


def test_stamps_of_damaged_records_that_lie_centuries_apart(tmp_path: Path) -> None:
    """Counted are the seconds in which there is something, not those between."""
    time_s = 0.02 * np.arange(3000.0)
    time_s[2990:] += 1e10
    motion_deg = 5.0 * np.sin(time_s)
    rows = "".join(f"{t:.2f},{deg:.3f},{deg:.3f}\n" for t, deg in zip(time_s, motion_deg, strict=True))
    path = tmp_path / "flight.csv"
    path.write_text("time_s,elevator_cmd_deg,elevator_pos_deg\n" + rows)
    (result,) = audit(path)
    assert [surface.surface for surface in result.surfaces] == ["elevator"]
