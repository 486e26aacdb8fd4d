"""``servofd identify`` as tools and people use it; whatever is wrong with a test is told in a sentence."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from logparsers.dataflash.encode import Message, encode
from servofd.aircraft.series import Series
from servofd.cli import main
from servofd.identification.identify import identify
from servofd.outputs.identify_report import identify_charts
from servofd.servo.effects.commands import Delay
from servofd.servo.effects.linkage import RateLimit
from servofd.servo.library import find_servo, servo_named
from servofd.servo.servo_model import ServoModel
from servofd.servo.transfer import TransferFunction
from tests.recovery.bench import step, sweep, written

QUICK = sweep("hs225bb-eq31", duration_s=40.0)


@pytest.mark.slow
def test_the_json_is_what_the_contract_says(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = written(tmp_path / "chirp.csv", QUICK)
    assert main(["identify", str(path), "--json", "-"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["schema"] == "servofd.identify/1"
    assert sorted(document["poles"])[-1] == pytest.approx([-24.84, 0.0], abs=0.6)
    assert document["hold"] == "zoh"
    assert document["delay_s"] == pytest.approx(0.004, abs=3e-4)
    assert document["dc_gain"] == pytest.approx(1.0, abs=0.005)
    assert document["bandwidth_rad_s"] == pytest.approx(28.49, rel=0.02)
    assert document["rate_limit_deg_s"] is None
    low, high = document["coherence_band_rad_s"]
    assert low < 10.0
    assert 100.0 < high < 157.0
    assert document["fit_error"]["rms_deg"] == pytest.approx(0.1, abs=0.01)
    assert 0.0 < document["fit_error"]["max_normalized_error"] < 0.5
    assert document["uncertainty"]["delay_s"]["low"] < 0.004 < document["uncertainty"]["delay_s"]["high"]
    assert any("elevator_cmd_deg" in note for note in document["notes"])


class _Page(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))


@pytest.mark.slow
def test_a_bandwidth_that_a_test_does_not_tell_is_not_stated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked_deg = 10.0 * np.sin(0.6 * QUICK.command_s)
    moved_deg = ServoModel.of(servo_named("hs225bb-eq31")).simulate(QUICK.command_s, asked_deg, QUICK.measured_s)
    path = written(tmp_path / "slow.csv", replace(QUICK, command_deg=asked_deg, measured_deg=moved_deg + NOISE_DEG))
    saved = tmp_path / "servo.toml"
    assert main(["identify", str(path), "--save", str(saved), "--json", str(tmp_path / "found.json")]) == 2
    printed = capsys.readouterr()
    assert "elevator: this test does not tell the bandwidth" in printed.out
    assert "was not written" in printed.err
    assert not saved.exists()
    low, high = json.loads((tmp_path / "found.json").read_text())["uncertainty"]["bandwidth_rad_s"].values()
    assert low <= 28.49 <= high
    assert high > 3.0 * low


@pytest.mark.slow
def test_every_output_and_the_servo_file_in_an_audit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    chirp, large = written(tmp_path / "chirp.csv", QUICK), written(tmp_path / "step.csv", step(72.0))
    saved, page = tmp_path / "mine.toml", tmp_path / "mine.html"
    options = ["--save", str(saved), "--html", str(page)]
    assert main(["identify", str(chirp), str(large), *options]) == 0
    assert "rate limit up" in capsys.readouterr().out

    name, servo, _ = find_servo(str(saved))
    assert name == "mine"
    assert servo.rate_limit_deg_s == pytest.approx(370.0, rel=0.005)
    assert servo.transfer.bandwidth_rad_s == pytest.approx(28.49, rel=0.02)
    flight = tmp_path / "flight.csv"
    assert main(["simulate", "-o", str(flight), "--servo", "hs225bb-eq31"]) == 0
    assert main(["audit", str(flight), "--servo", str(saved)]) == 0
    assert "healthy" in capsys.readouterr().out

    text = page.read_text()
    parser = _Page()
    parser.feed(text)
    charts = [attributes for tag, attributes in parser.tags if attributes.get("role") == "img"]
    assert len(charts) == 4  # motion, response, step, validation
    assert all(chart["aria-label"] for chart in charts)
    ids = [attributes["id"] for _, attributes in parser.tags if "id" in attributes]
    assert len(ids) == len(set(ids))
    # Nothing is fetched: addresses occur as names of XML vocabularies only.
    assert not re.search(r'(src|href)="(?!#)', text)


@pytest.mark.slow
def test_a_reversed_servo_stays_within_its_picture() -> None:
    result = identify(replace(QUICK, measured_deg=-QUICK.measured_deg))
    phase = identify_charts(result)["response"].panels[1]
    low_rad_s, high_rad_s = result.band_rad_s or (0.0, 0.0)
    for curve in phase.curves:
        within = curve.values[(curve.x >= low_rad_s) & (curve.x <= high_rad_s)]
        assert np.mean((within > phase.low) & (within < phase.high)) > 0.95


def _mixed(one: Series, other: Series) -> Series:
    half = one.measured_s < 0.5 * one.measured_s[-1]
    return replace(one, measured_deg=np.where(half, one.measured_deg, other.measured_deg))


FAST = sweep("s9254", duration_s=40.0)
NOISE_DEG = 0.1 * np.random.default_rng(0).standard_normal(QUICK.measured_s.size)
BAD: dict[str, tuple[Series, str]] = {
    "no excitation": (
        Series("x", QUICK.measured_s, 0.0 * NOISE_DEG, QUICK.measured_s, NOISE_DEG),
        "no excitation: the command is 0 deg throughout",
    ),
    "clipped": (replace(QUICK, measured_deg=np.clip(QUICK.measured_deg, -1.5, 1.5)), "position is clipped"),
    "milliseconds": (
        replace(QUICK, command_s=1e3 * QUICK.command_s, measured_s=1e3 * QUICK.measured_s),
        "Are the time stamps in milliseconds?",
    ),
    "too fast": (
        replace(QUICK, command_s=1e-3 * QUICK.command_s, measured_s=1e-3 * QUICK.measured_s),
        "too fast to see a servo",
    ),
    "swapped": (
        Series("x", QUICK.measured_s, QUICK.measured_deg, QUICK.measured_s, QUICK.command_deg),
        "are the two columns swapped?",
    ),
    "swapped, fast servo": (
        Series("x", FAST.measured_s, FAST.measured_deg, FAST.measured_s, FAST.command_deg),
        "are the two columns swapped?",
    ),
    "swapped, steps": (
        Series("x", step(72.0).measured_s, step(72.0).measured_deg, step(72.0).measured_s, step(72.0).command_deg),
        "are the two columns swapped?",
    ),
    "noise only": (replace(QUICK, measured_deg=NOISE_DEG), "the position does not follow the command"),
    "two servos": (_mixed(QUICK, FAST), "data of two servos mixed"),
    "saturated": (
        sweep("hs225bb-eq31", duration_s=15.0, amplitude=10.0, rate_deg_s=60.0),
        "which hides its dynamics; use a smaller amplitude",
    ),
    "drifting": (
        replace(QUICK, measured_deg=QUICK.measured_deg + 0.1 * QUICK.measured_s),
        "the position drifts by 4 deg over the test while the command does not",
    ),
    "jammed half way": (
        replace(QUICK, measured_deg=np.where(QUICK.measured_s < 9.0, QUICK.measured_deg, 2.0)),
        "no servo model explains this motion",
    ),
    "short": (
        Series("x", QUICK.command_s[:20], QUICK.command_deg[:20], QUICK.measured_s[:20], NOISE_DEG[:20]),
        "only 20 measured positions",
    ),
}


SLOW = {"saturated", "jammed half way", "two servos"}


@pytest.mark.slow
@pytest.mark.parametrize("name", [pytest.param(name, marks=pytest.mark.slow) if name in SLOW else name for name in BAD])
def test_what_cannot_be_used_is_told_in_a_sentence(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    segment, sentence = BAD[name]
    path = written(tmp_path / "bad.csv", segment)
    outputs = ["--save", str(tmp_path / "s.toml"), "--html", str(tmp_path / "p.html"), "--json", str(tmp_path / "j")]
    assert main(["identify", str(path), *outputs]) == 2
    printed = capsys.readouterr()
    (line,) = printed.err.strip().splitlines()
    assert sentence in line
    assert "bad.csv" in line
    assert printed.out == ""
    assert [p.name for p in tmp_path.iterdir()] == ["bad.csv"]


def test_outputs_do_not_overwrite_logs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = written(tmp_path / "chirp.csv", QUICK)
    assert main(["identify", str(path), "--save", str(path)]) == 2
    assert "choose another file" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "sentence"),
    [("nonsense", "not valid TOML"), ("", "one entry"), ('[servos.x]\ntitle = "x"', "servos.x")],
)
def test_a_servo_file_that_is_none(
    text: str, sentence: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    servo, path = tmp_path / "servo.toml", written(tmp_path / "chirp.csv", QUICK)
    servo.write_text(text)
    assert main(["audit", str(path), "--servo", str(servo)]) == 2
    assert sentence in capsys.readouterr().err


def chirp_applet(*, telemetry: bool = True) -> bytes:
    """Log of ArduPilot's actuator_chirp.lua: 200 Hz, exponential sweep, position telemetry at 50 Hz."""
    time_s = np.arange(6000) / 200.0
    swept = np.expm1(np.log(40.0) * time_s / 30.0) * 30.0 / np.log(40.0)
    pulse_us = np.floor(1450.0 + 150.0 * np.sin(2.0 * np.pi * 0.5 * swept))
    deflection_deg = ServoModel.of(servo_named("s3151")).simulate(time_s, 0.1 * (pulse_us - 1500.0), time_s)
    deflection_deg += 0.05 * np.random.default_rng(0).standard_normal(time_s.size)
    position_deg = np.repeat(deflection_deg[::4], 4) if telemetry else np.full(time_s.size, -1.0)
    rows = {
        "TimeUS": 1_000_000 + np.round(1e6 * time_s).astype(np.int64),
        "PWM": pulse_us,
        "Freq": 0.5 * np.exp(np.log(40.0) * time_s / 30.0),
        "Pos": position_deg,
    }
    return encode([Message("SCRP", "Qfff", rows)])


@pytest.mark.slow
def test_the_chirp_applet_of_ardupilot(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "chirp.bin"
    path.write_bytes(chirp_applet())
    assert main(["identify", str(path), "--json", "-"]) == 0
    document: dict[str, Any] = json.loads(capsys.readouterr().out)
    truth = servo_named("s3151")
    assert document["bandwidth_rad_s"] == pytest.approx(truth.transfer.bandwidth_rad_s, rel=0.02)
    assert document["delay_s"] == pytest.approx(truth.transport_delay_s, abs=5e-4)
    assert document["dc_gain"] == pytest.approx(1.0, abs=0.01)
    notes = " ".join(document["notes"])
    assert "command from SCRP.PWM [us], position from SCRP.Pos" in notes
    assert "which leaves 50 Hz" in notes
    scale = re.search(r"dc gain of 1: ([\d.]+) deg/us", notes)
    assert scale is not None
    assert float(scale[1]) == pytest.approx(0.1, rel=0.01)


def test_the_chirp_applet_without_telemetry(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "chirp.bin"
    path.write_bytes(chirp_applet(telemetry=False))
    assert main(["identify", str(path)]) == 2
    assert "SCRP holds no position" in capsys.readouterr().err


APPENDIX_C = """
[table]
columns = ["meas", "pwm", "cmd"]
sample_rate_hz = 1000.0
[surfaces.servo]
command = { channel = "cmd", unit = "us", trim_us = 700.0, slope_deg_per_us = 0.15 }
measured = { channel = "meas", unit = "count", trim_count = 30000.0, slope_deg_per_count = 0.004 }
"""


@pytest.mark.slow
def test_the_step_of_appendix_c(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Tab-separated `meas pwm cmd` at 1 kHz without header or time, a step from 500 to 900 us."""
    time_s = np.arange(3000) / 1000.0
    command_us = np.where(time_s < 1.0, 500.0, 900.0)
    deflection_deg = ServoModel.of(servo_named("hs225bb-eq31")).simulate(time_s, 0.15 * (command_us - 700.0), time_s)
    noise_deg = 0.02 * np.random.default_rng(0).standard_normal(time_s.size)
    counts = np.round(30000.0 + (deflection_deg + noise_deg) / 0.004).astype(int)
    rows = [f"{c}\t0\t{u:.2f}" for c, u in zip(counts, command_us, strict=True)]
    (tmp_path / "step.txt").write_text("\n".join(rows) + "\n")
    (tmp_path / "bench.toml").write_text(APPENDIX_C)
    assert main(["identify", str(tmp_path / "step.txt"), "-c", str(tmp_path / "bench.toml"), "--json", "-"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["rate_limit_deg_s"] == pytest.approx(370.0, rel=0.005)
    assert document["coherence_band_rad_s"] is None


def test_a_log_of_several_servos_asks_which(capsys: pytest.CaptureFixture[str]) -> None:
    path = Path(__file__).parent.parent.parent / "sample_logs" / "faser_healthy_flight.mat"
    assert main(["identify", str(path)]) == 2
    assert "choose one of elevator, rudder" in capsys.readouterr().err
    assert main(["identify", str(path), "-s", "wing"]) == 2
    assert "unknown surface 'wing'" in capsys.readouterr().err


@pytest.mark.slow
def test_a_dead_band_in_the_loop_is_found_and_widens_the_intervals() -> None:
    """Searches without bounds ended at rate limits of 0 and 3e15 deg/s."""
    time_s = np.arange(3000) / 100.0
    dense_s = np.arange(time_s[-1] * 2000.0 + 1.0) / 2000.0
    command_deg = 4.0 * np.sin(2.0 * np.pi * 0.5 * np.expm1(np.log(25.0) * time_s / 30.0) * 30.0 / np.log(25.0))
    position_deg, speed_deg_s, positions = 0.0, 0.0, []
    for goal_deg in command_deg[np.searchsorted(time_s, dense_s - 0.004 + 1e-9, side="right") - 1]:
        error_deg = goal_deg - position_deg
        error_deg = np.sign(error_deg) * max(abs(error_deg) - 0.5, 0.0)
        speed_deg_s += (1300.0 * error_deg - 52.0 * speed_deg_s) / 2000.0
        position_deg += speed_deg_s / 2000.0
        positions.append(position_deg)
    measured_deg = np.interp(time_s, dense_s, positions) + 0.5 * NOISE_DEG[: time_s.size]
    result = identify(Series("x", time_s, command_deg, time_s, measured_deg))
    assert result.servo.dead_band_deg == pytest.approx(1.0, abs=0.4)
    assert result.servo.rate_up_deg_s is None
    assert any("not in the model" in note for note in result.notes)
    bandwidth, delay_s = result.intervals["bandwidth_rad_s"], result.intervals["delay_s"]
    assert bandwidth.low <= TransferFunction((1300.0,), (1.0, 52.0, 1300.0)).bandwidth_rad_s <= bandwidth.high
    assert delay_s.low <= 0.004 <= delay_s.high


@pytest.mark.slow
def test_a_position_before_its_command_is_told() -> None:
    early_deg = np.interp(QUICK.measured_s + 0.02, QUICK.measured_s, QUICK.measured_deg)
    result = identify(replace(QUICK, measured_deg=early_deg))
    assert any("position seems to come before its command" in note for note in result.notes)


@pytest.mark.slow
def test_a_fast_servo_at_its_rate_limit_has_no_poles_of_infinity_and_no_lag_well_known() -> None:
    time_s = np.arange(2000) / 50.0
    command_deg = 4.0 * np.sin(2.0 * np.pi * np.expm1(np.log(20.0) * time_s / 40.0) * 40.0 / np.log(20.0))
    model = ServoModel(TransferFunction((150.0,), (1.0, 150.0))) + Delay(0.004) + RateLimit(120.0)
    measured_deg = model.simulate(time_s, command_deg, time_s) + 0.5 * NOISE_DEG[: time_s.size]
    steps: list[str] = []
    result = identify(Series("x", time_s, command_deg, time_s, measured_deg), progress=steps.append)
    assert np.max(np.abs(result.servo.linear.poles_rad_s)) < 20.0 * np.pi * 50.0 * 1.001
    lag = result.intervals["lag_s"]
    known = any("ms is well known" in note for note in result.notes)
    assert not known or lag.high - lag.low < max(0.1 * result.servo.linear.lag_s, 1e-3)
    assert result.servo.rate_up_deg_s == pytest.approx(120.0, rel=0.05)
    assert steps == ["linear servo", "rate limits and dead band", "intervals"]
