"""What `explain` names in real servos on the bench, and how well each run is predicted by a fit to the others."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from servofd import explain, explain_logs
from servofd.core.errors import NoMeasurement
from servofd.discrepancy.explanation import Explanation
from servofd.servo.effects.linkage import Gain
from servofd.servo.effects.sensor import Bias
from tests.external.test_bench_tables import DATA

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not (DATA / "bench").is_dir(),
        reason="no bench records: set SERVOFD_EXTERNAL_DATA to the directory that holds bench/ and logs/",
    ),
]

DEGREES = 'unit = "deg"'


def explained(name: str, folder: Path, where: str) -> Explanation:
    aircraft = folder / f"{name}.toml"
    aircraft.write_text(
        f'[table]\ntime = "t_s"\nrun = "run"\nwhere = {{ {where} }}\n'
        f'[surfaces.servo]\ncommand = {{ channel = "cmd", {DEGREES} }}\nmeasured = {{ channel = "meas", {DEGREES} }}\n'
    )
    return explain(DATA / "bench" / f"{name}.csv", aircraft).explanation


def final_deg(found: Explanation) -> float:
    return found.held_out_deg[1]


def told(found: Explanation) -> set[str]:
    """What is named, and what may stand in its place."""
    return {*found.selection.final.names, *(name for tie in found.selection.ties for name in tie)}


def nominal_deg(found: Explanation) -> float:
    return found.held_out_deg[0]


@pytest.mark.nightly
def test_hobby_servo() -> None:
    """A linear servo leaves 30 deg on the runs that are held out, a motor that is slower upwards and friction 1.92.

    Its readings are counted from where each run began, anywhere within the dead band to either side; whether it is
    dead or sticks is not known, and a pole of 55 rad/s stands for its delay.
    """
    found = explain(DATA / "bench" / "hobby_servo_encoder.csv").explanation
    assert nominal_deg(found) > 15.0
    assert final_deg(found) <= 1.98
    assert found.selection.final.names[0] == "rate_limit"
    assert {"deadband", "friction"} & told(found)
    rates = found.selection.steps[0].fit.values
    np.testing.assert_allclose(rates, (255.0, 276.0), rtol=0.1)
    errors = np.array([each.held_out_rms_deg for each in found.runs])
    assert np.sqrt(np.mean(errors**2)) <= 3.0
    assert all(each.held_out_rms_deg < each.nominal_rms_deg for each in found.runs)


def test_play_where_a_servo_rests() -> None:
    """At 10 Hz play of 0.53 deg is told from where the horn rests, and nothing is said of how it moves."""
    found = explain(DATA / "bench" / "smart_servo_play.csv").explanation
    assert found.selection.final.names == ("backlash",)
    assert found.selection.final.values[0] == pytest.approx(0.53, abs=0.05)
    assert found.selection.ties == (("backlash", "deadband", "friction"),)
    assert found.conclusion == "partly_explained"
    assert "hysteresis" in found.notes[0]


def test_no_play_is_no_play() -> None:
    with pytest.raises(NoMeasurement, match="none is seen"):
        explain(DATA / "bench" / "smart_servo_no_play.csv")


@pytest.mark.nightly
def test_smart_servo_with_a_weight() -> None:
    """A linear servo fitted by itself takes up much of the weight; what is left of it is more than halved."""
    found = explain(DATA / "bench" / "smart_servo_gravity_load.csv").explanation
    assert final_deg(found) <= 0.17
    assert final_deg(found) < 0.5 * nominal_deg(found)
    assert all(each.held_out_rms_deg < 0.5 * each.nominal_rms_deg for each in found.runs)
    assert found.selection.final.names[0] == "gravity_load"


@pytest.mark.nightly
@pytest.mark.parametrize(("kp", "most_deg"), [("400", 2.5), ("100", 1.6)])
def test_smart_servo_of_low_gain(kp: str, most_deg: float, tmp_path: Path) -> None:
    """The first run, sums of sines, as predicted by the other three; and every run better than by a linear servo."""
    found = explained("smart_servo_gains", tmp_path, f'kp = "{kp}", torque_enabled = "1"')
    assert found.selection.final.names[0] == "gravity_load"
    assert "load_friction" in told(found)
    assert nominal_deg(found) > 10.0
    assert final_deg(found) < 0.12 * nominal_deg(found)
    assert found.runs[0].held_out_rms_deg <= most_deg
    assert all(each.held_out_rms_deg < 0.75 * each.nominal_rms_deg for each in found.runs)
    assert not found.undriven


@pytest.mark.nightly
def test_digital_servo_whose_rate_limit_falls_with_its_load() -> None:
    """Slopes of the steps themselves: 388 deg/s without a load, 303 with 400 g."""
    found = explain(DATA / "bench" / "digital_servo_loads.csv").explanation
    assert found.selection.final.names == ("rate_limit",)
    assert final_deg(found) <= 2.25 < 0.5 * nominal_deg(found)
    first = found.varying[0]
    assert (first.parameter, set(first.conditions)) == ("rate_limit_deg_s", {"load_g", "load_kgcm"})
    (_, empty_deg_s), (_, loaded_deg_s) = first.ends
    assert (empty_deg_s, loaded_deg_s) == pytest.approx((388.0, 303.0), rel=0.06)
    assert first.line_rms_deg < 0.5 * first.common_rms_deg
    assert found.notes[-1] == first.sentence


@pytest.mark.nightly
@pytest.mark.parametrize("name", ["geared_joint_plc", "teleop_arm_1", "teleop_arm_2", "geared_joint_multisine"])
def test_healthy_joints(name: str) -> None:
    """No fault is claimed, nothing is left out, and a linear servo with any gain and zero never foresees more.

    Both arms bear their weight at the shoulder and the elbow, from angles that are counted from anywhere.
    """
    explained = explain_logs([DATA / "bench" / f"{name}.csv"])
    assert not explained.failures
    for found in explained.explanations:
        assert "FAULT" not in found.answer
        assert found.fault_s is None
        assert not found.undriven
        fitter = found.selection.fitter
        linear = fitter.halved(fitter.descended((Bias, Gain), fitter.linear[0].physics, 30))
        if not linear.ran_away:
            assert final_deg(found) <= 1.03 * found.rms_deg(linear)["held_out_rms_deg"]
        assert final_deg(found) <= 1.03 * nominal_deg(found)
        if found.surface in ("shoulder_lift", "elbow_flex"):
            assert "gravity_load" in told(found)
            assert final_deg(found) < 0.4 * nominal_deg(found)


@pytest.mark.nightly
def test_linear_drive() -> None:
    """Coulomb friction and offset of the EMPS benchmark, whose closed loop is a servo of second order.

    Published: 20.39 N and -3.165 N; a position error of 1 m is worth 35.15 * 243.45 * 160.18 N.
    """
    found = explain(DATA / "bench" / "emps_linear_drive.csv").explanation
    steps = {step["effect"]: step["parameters"] for step in found.document()["steps"]}
    assert set(steps) == {"friction", "bias"}
    assert 1e3 * nominal_deg(found) > 6.0
    assert 1e3 * final_deg(found) <= 1.65
    newton = 1e-3 * 35.15 * 243.45 * 160.18
    for effect, parameter, published in (("friction", "friction_deg", 20.39), ("bias", "bias_deg", 3.165)):
        value = {key: newton * each for key, each in steps[effect][parameter].items()}
        assert value["low"] < published < value["high"]
        assert value["value"] == pytest.approx(published, rel=0.15)
