"""What an outsider broke once, and must not break again."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servofd.cli import main
from servofd.core.types import FloatArray

SAMPLES = Path(__file__).parent.parent.parent / "sample_logs"
HEALTHY = str(SAMPLES / "faser_healthy_flight.mat")


def write(path: Path, command_deg: FloatArray, measured_deg: FloatArray, rate_hz: float = 100.0) -> str:
    time_s = np.arange(command_deg.size) / rate_hz
    rows = [f"{t:.6f},{u:.6f},{y:.6f}" for t, u, y in zip(time_s, command_deg, measured_deg, strict=True)]
    path.write_text("time_s,elevator_cmd_deg,elevator_pos_deg\n" + "\n".join(rows) + "\n")
    return str(path)


def elevator(path: str, capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    main(["audit", path, "--servo", "hs225bb-eq31", "--json", "-"])
    verdict: dict[str, Any] = json.loads(capsys.readouterr().out)["logs"][0]["surfaces"]["elevator"]
    return verdict


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes here")
@pytest.mark.parametrize(
    "verb", [[], ["audit"], ["info"], ["explain"], ["identify"], ["review"], ["config"], ["audit", "--sweep"]]
)
def test_a_pipe_that_nobody_writes_to_is_not_waited_for(
    verb: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pipe = tmp_path / "flight.bin"
    os.mkfifo(pipe)
    assert main([*verb, str(pipe)]) == 2
    assert "is not a regular file" in capsys.readouterr().err


class TestOutputs:
    def test_a_pipe_is_written_to_and_not_replaced(self, tmp_path: Path) -> None:
        pipe = tmp_path / "pipe"
        os.mkfifo(pipe)
        reader = subprocess.Popen(["cat", str(pipe)], stdout=subprocess.PIPE)  # noqa: S607
        assert main(["audit", HEALTHY, "--json", str(pipe)]) == 0
        out, _ = reader.communicate(timeout=30)
        assert json.loads(out)["schema"] == "servofd.audit/1"
        assert pipe.is_fifo()

    def test_a_link_is_followed(self, tmp_path: Path) -> None:
        real, link = tmp_path / "real.json", tmp_path / "link.json"
        real.write_text("old")
        link.symlink_to(real)
        assert main(["audit", HEALTHY, "--json", str(link)]) == 0
        assert link.is_symlink()
        assert json.loads(real.read_text())["logs"]

    def test_neither_the_log_nor_another_output_is_overwritten(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        log = tmp_path / "flight.mat"
        log.write_bytes(Path(HEALTHY).read_bytes())
        assert main(["audit", str(log), "--json", str(log)]) == 2
        assert "is a log already" in capsys.readouterr().err
        assert log.read_bytes() == Path(HEALTHY).read_bytes()
        assert main(["audit", str(log), "--json", str(tmp_path / "z"), "--rrd", str(tmp_path / "z")]) == 2
        assert "another output" in capsys.readouterr().err

    @pytest.mark.slow
    def test_names_that_are_no_file_names(self, tmp_path: Path) -> None:
        text = (tmp_path / "plain.csv").parent / "odd.csv"
        write(text, 5.0 * np.sin(np.arange(600) / 30.0), 5.0 * np.sin(np.arange(600) / 30.0 - 0.19))
        odd = "../../a b/c"
        text.write_text(text.read_text().replace("elevator", odd))
        assert main(["audit", str(text), "-o", str(tmp_path / "out")]) == 0
        names = {path.name for path in (tmp_path / "out").iterdir()}
        assert names == {"audit.json", "odd.html", "odd.rrd", "odd-_.._a_b_c.png"}

    @pytest.mark.slow
    def test_a_full_disk_is_told(self) -> None:
        if not Path("/dev/full").exists():
            pytest.skip("no /dev/full on this system")
        command = f"{sys.executable} -m servofd config --servos --json > /dev/full"
        result = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False)  # noqa: S607
        assert result.returncode == 2
        assert "Traceback" not in result.stderr
        assert "No space left" in result.stderr

    @pytest.mark.slow
    def test_a_terminated_run_leaves_nothing_half_written(self, tmp_path: Path) -> None:
        log = tmp_path / "big.csv"
        main(["simulate", "-o", str(log), "--duration", "200"])
        words = ["audit", str(log), "--servo", "hs225bb-eq31", "-o", str(tmp_path / "out")]
        process = subprocess.Popen([sys.executable, "-m", "servofd", *words])
        for _ in range(600):  # wait for the first output file, bounded
            if process.poll() is not None or any((tmp_path / "out").glob("*")):
                break
            time.sleep(0.05)
        process.send_signal(signal.SIGTERM)
        process.wait(timeout=60)
        assert not [path.name for path in (tmp_path / "out").glob(".*")]


class TestVerdicts:
    @pytest.mark.slow
    @pytest.mark.parametrize(("size_deg", "frequency_hz"), [(3.5, 6.0), (8.0, 10.0), (10.0, 12.0)])
    def test_a_stuck_servo_under_fast_commands_is_not_called_healthy(
        self, size_deg: float, frequency_hz: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        time_s = np.arange(3000) / 100.0
        command_deg = size_deg * np.sin(2.0 * np.pi * frequency_hz * time_s)
        stuck_deg = 0.05 * np.random.default_rng(0).standard_normal(3000)
        verdict = elevator(write(tmp_path / "fast.csv", command_deg, stuck_deg), capsys)
        # The filter passes less than the threshold of such commands; that none of it was obeyed shows all the same.
        assert verdict["status"] in ("suspect", "fault")
        (found,) = verdict["faults"] + verdict["suspicions"]
        assert "stuck" in (found["kind"], *found["alternatives"])

    @pytest.mark.parametrize(("size_deg", "expected"), [(0.0, "unknown"), (1.2, "suspect")])
    def test_a_glitch_does_not_prove_motion(
        self, size_deg: float, expected: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        time_s = np.arange(6000) / 100.0
        measured_deg = 0.05 * np.random.default_rng(0).standard_normal(6000)
        measured_deg[0] = 10.0
        command_deg = size_deg * np.sin(2.0 * np.pi * 0.2 * time_s)
        verdict = elevator(write(tmp_path / "glitch.csv", command_deg, measured_deg), capsys)
        assert verdict["status"] == expected
        assert [found["kind"] for found in verdict["suspicions"]] == ["stuck"] * (expected == "suspect")

    def test_a_position_without_a_command_is_listed(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        path = tmp_path / "lone.csv"
        write(path, 5.0 * np.sin(np.arange(600) / 30.0), 5.0 * np.sin(np.arange(600) / 30.0 - 0.19))
        path.write_text(path.read_text().replace("elevator_cmd_deg", "elevator_cmd"))
        assert main(["audit", str(path), "--json", "-"]) == 2
        assert json.loads(capsys.readouterr().out)["logs"][0]["surfaces"]["elevator"]["status"] == "no_data"

    @pytest.mark.parametrize(("rate_hz", "expected"), [(1e9, "check the unit"), (1e6, "check the unit")])
    def test_a_wrong_time_unit_is_told(
        self, rate_hz: float, expected: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        path = tmp_path / "units.csv"
        rows = "".join(f"{k / rate_hz:.12f},{5 * np.sin(k / 30)},{5 * np.sin(k / 30 - 0.1)}\n" for k in range(600))
        path.write_text("time_s,elevator_cmd_deg,elevator_pos_deg\n" + rows)
        assert main(["audit", str(path)]) == 2
        assert expected in capsys.readouterr().err

    def test_absurd_values_are_told(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        command_deg = 5.0 * np.sin(np.arange(600) / 30.0)
        path = write(tmp_path / "absurd.csv", command_deg, 1e150 * command_deg)
        assert main(["audit", path]) == 2
        assert "check its unit and calibration" in capsys.readouterr().err

    def test_counts_need_not_be_whole(self) -> None:
        from servofd.aircraft.calibration import RadianOrCountCalibration

        faser = RadianOrCountCalibration(channel="x", unit="rad_or_count", trim_count=2048.0, slope_deg_per_count=0.05)
        assert faser.to_deg(np.array([2048.5, 2068.0])) == pytest.approx([0.025, 1.0])


SERVO = "[servos.mine]\ntitle='x'\n{body}\ndelay_s=0.0\nhold='zoh'\nsource='x'\n"
SERVO += "[surfaces.elevator]\nservo='mine'\n{more}"
CHANNELS = "command={channel='elevator_cmd_deg',unit='deg'}\nmeasured={channel='elevator_pos_deg',unit='deg'}\n"
NINE_POLES = "[1.0,9.0,36.0,84.0,126.0,126.0,84.0,36.0,9.0,1.0]"


@pytest.mark.parametrize(
    ("body", "more", "expected"),
    [
        ("numerator=[0.0]\ndenominator=[1.0,1.0]", "", "dc gain"),
        ("numerator=[1.0,0.0]\ndenominator=[1.0,5.0,6.0]", "", "dc gain"),
        ("bandwidth_hz=1e200\ndamping=0.7", "", "bandwidth_hz"),
        ("bandwidth_hz=5.0\ndamping=1e9", "", "damping"),
        (f"numerator=[1.0]\ndenominator={NINE_POLES}", "", "lower order"),
        ("bandwidth_hz=5.0\ndamping=0.7", "filter_pole_rad_s=1e9\n", "filter_pole_rad_s"),
        ("bandwidth_hz=5.0\ndamping=0.7", "threshold_deg=true\n", "threshold_deg"),
    ],
)
def test_servos_that_cannot_be(
    body: str, more: str, expected: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "plane.toml"
    config.write_text(SERVO.format(body=body, more=more) + CHANNELS)
    motion_deg = 5.0 * np.sin(np.arange(600) / 30.0)
    log = write(tmp_path / "flight.csv", motion_deg, motion_deg * 0.9)
    assert main(["audit", log, "-c", str(config)]) == 2
    err = capsys.readouterr().err
    assert expected in err
    assert "Traceback" not in err


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--fault", "elevator:stuck@nan"], "not finite"),
        (["--fault", "elevator:stuck@1000"], "the flight lasts"),
        (["--fault", "elevator:stuck@5", "--fault", "elevator:deadband@8"], "one fault at a time on a surface"),
        (["--fault", "elevator:stuck@5:end_s=4"], "end_s must be later"),
        (["--fault", "elevator:stuck@5:start_s=3"], "after the @"),
        (["--fault", "elevator:stuck@5:position_deg=nan"], "not finite"),
    ],
)
def test_simulated_faults_must_happen(
    arguments: list[str], expected: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["simulate", "-o", str(tmp_path / "a.csv"), *arguments]) == 2
    assert expected in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_every_fault_can_be_asked_for_and_passes(tmp_path: Path) -> None:
    from servofd.servo.faults import FAULTS

    path = tmp_path / "a.csv"
    times = {kind: 2.0 + 4.0 * index for index, kind in enumerate(FAULTS)}
    texts = [f"elevator:{kind}@{start_s}:end_s={start_s + 2.0}" for kind, start_s in times.items()]
    run = ["simulate", "-o", str(path), "--duration", str(4.0 + 4.0 * len(FAULTS)), "--noise-deg", "0"]
    columns = {}
    for name, faults in (("healthy", []), ("failing", texts)):
        assert main([*run, *(word for text in faults for word in ("--fault", text))]) == 0
        columns[name] = np.genfromtxt(path, delimiter=",", names=True)
    time_s = columns["healthy"]["time_s"]
    difference_deg = abs(columns["failing"]["elevator_pos_deg"] - columns["healthy"]["elevator_pos_deg"])
    for start_s in times.values():
        assert difference_deg[(time_s > start_s) & (time_s < start_s + 2.0)].max() > 0.05
        assert difference_deg[(time_s > start_s + 3.3) & (time_s < start_s + 4.0)].max() < 1e-6
