"""What ``servofd simulate --effect`` hides, ``servofd explain`` tells in the same words: those of the contract."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest

import logparsers
from servofd.cli import main

SIZES = {
    "delay": "delay_s=0.03",
    "slow_dynamics": "bandwidth_scale=0.6",
    "rate_limit": "rate_limit_deg_s=20",
    "rate_limit, asymmetric": "rate_up_deg_s=20:rate_down_deg_s=40",
    "rate_limit, of the output": "form=output:rate_limit_deg_s=20",
    "rate_limit, of the set point": "form=set point:rate_limit_deg_s=40",
    "position_limit": "lower_deg=-2:upper_deg=3",
    "deadband": "width_deg=1",
    "backlash": "width_deg=1",
    "friction": "friction_deg=0.5",
    "gain": "gain=0.8",
    "bias": "bias_deg=1",
    "airload": "deg_per_deg_pa=0.001",
    "voltage_rate": "deg_s_per_v=3",
    "pwm_frame": "period_s=0.05",
    "sensor_lag": "time_constant_s=0.03",
    "quantization": "step_deg=1",
    "linkage_nonlinearity": "quadratic_per_deg=0.01:cubic_per_deg2=-0.0005",
    "resonance": "frequency_hz=6:damping_ratio=0.05",
    "clock_offset": "offset_s=0.03",
    "gravity_load": "droop_deg=8",
    "load_friction": "share=0.4",
    "current_limit": "knee_deg=2",
    "supply_coupling": "deg_per_a=2",
    "external_load": "deg_per_unit=40",
}
CONTEXT = ("airspeed_m_s", "servo_voltage_v", "servo_current_a")


def simulated(folder: Path, *effects: str, duration_s: float = 12.0) -> Path:
    path = folder / "log.csv"
    options = [option for effect in effects for option in ("--effect", f"elevator:{effect}")]
    assert main(["simulate", "-o", str(path), "--command", "gusty", "--duration", str(duration_s), *options]) == 0
    return path


@pytest.mark.parametrize(("name", "size"), SIZES.items(), ids=SIZES)
def test_every_effect_shows_in_the_surface_that_has_it(name: str, size: str, tmp_path: Path) -> None:
    effect = name.partition(",")[0]
    with_it = logparsers.read(simulated(tmp_path, f"{effect}:{size}")).channels
    without = logparsers.read(simulated(tmp_path)).channels
    gap = with_it["elevator_pos_deg"].values - without["elevator_pos_deg"].values
    assert float(np.sqrt(np.mean(gap**2))) > 0.09
    assert np.array_equal(with_it["rudder_pos_deg"].values, without["rudder_pos_deg"].values)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "airload",
        *(
            pytest.param(name, marks=pytest.mark.nightly)
            for name in ("rate_limit, asymmetric", "voltage_rate", "supply_coupling", "external_load")
        ),
    ],
)
def test_what_was_hidden_is_named_with_its_size(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    effect = name.partition(",")[0]
    path = simulated(tmp_path, f"{effect}:{SIZES[name]}", duration_s=40.0)
    capsys.readouterr()
    better = tmp_path / "better.toml"
    options = ["--servo", "hs225bb-eq31", "--json", "-", "--save", str(better)]
    assert main(["explain", str(path), "-s", "elevator", *options]) == 0
    document = json.loads(capsys.readouterr().out)
    assert [step["effect"] for step in document["steps"]] == [effect]
    parameters = document["steps"][0]["parameters"]
    for pair in SIZES[name].split(":"):
        key, _, value = pair.partition("=")
        assert parameters[key]["value"] == pytest.approx(float(value), rel=0.04)
        assert f"{parameters[key]['value']:.3g}" in document["answer"]
    assert tomllib.loads(better.read_text())["surfaces"]["elevator"]["threshold_deg"] < 1.0  # in the air of the log


def test_the_log_holds_what_the_servos_felt(tmp_path: Path) -> None:
    plain = logparsers.read(simulated(tmp_path, "backlash:width_deg=1")).channels
    assert not any(name in plain for name in CONTEXT)
    felt = logparsers.read(simulated(tmp_path, "supply_coupling:deg_per_a=1")).channels
    assert all(name in felt for name in CONTEXT)
    assert "servo_current_a" not in logparsers.read(simulated(tmp_path, "airload:deg_per_deg_pa=0.001")).channels


@pytest.mark.parametrize("suffix", ["bin", "tlog", "ulg", "mat"])
def test_a_format_that_cannot_hold_it_is_refused(
    suffix: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / f"log.{suffix}"
    assert main(["simulate", "-o", str(path), "--effect", "elevator:airload:deg_per_deg_pa=0.001"]) == 2
    assert "choose -o FILE.csv" in capsys.readouterr().err
    assert not path.exists()
