"""Numbers from elsewhere: computed with 60 digits, with Octave, and by independent discretisation.

`getbasicq.json` is the intended behaviour of thesis Appendix B for 14 plants; `residual.json` the exact sampled
filters of the six servo models of the thesis at 100 Hz.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servofd.core.errors import DesignError
from servofd.detection.nullspace import design_nullspace_filter
from servofd.detection.probability import Noise
from servofd.detection.pulse import design_pulse_filter
from servofd.servo.transfer import TransferFunction

HERE = Path(__file__).parent
GETBASICQ: dict[str, Any] = json.loads((HERE / "getbasicq.json").read_text())
RESIDUAL: dict[str, Any] = json.loads((HERE / "residual.json").read_text())
CASES = [name for name in GETBASICQ if name != "_about"]
SERVOS = [name for name, entry in RESIDUAL.items() if isinstance(entry, dict) and "num" in entry]

FIFTEEN_DIGITS = 1e-10
TEN_DIGITS = 1e-9
ROUND_OFF = 1e-15
REFERENCE_BANDWIDTH = 2e-5  # the reference was read off a frequency grid; ours is exact


def same(ours: Any, theirs: Any) -> None:
    ours, theirs = (np.trim_zeros(np.atleast_1d(np.asarray(x, dtype=float)), "f") for x in (ours, theirs))
    np.testing.assert_allclose(ours, theirs, rtol=FIFTEEN_DIGITS, atol=0.0)


@pytest.mark.parametrize("name", CASES)
def test_nullspace_filter(name: str) -> None:
    case = GETBASICQ[name]
    plant = [
        [TransferFunction(tuple(n), tuple(d)) for n, d in zip(tops, bottoms, strict=True)]
        for tops, bottoms in zip(case["num"], case["den"], strict=True)
    ]
    design = design_nullspace_filter(plant, case["p"])
    for row, expected in zip(design.rows, case["reference"], strict=True):
        assert row.output == expected["Qy_output_index"]
        assert row.normalised_input == expected["fault_channel_normalised"]
        assert len(row.poles_rad_s) == expected["order"]
        same(row.denominator, expected["den"])
        same(row.qy, expected["Qy_num"])
        same(row.dc_qy, expected["dc_Qy"])
        same(row.dc_qu, expected["dc_Qu"])
        same(row.scale, expected["scale"])
        for qu, expected_qu in zip(row.qu, expected["Qu_num"], strict=True):
            same(qu, expected_qu)
        zeros = sorted(([z.real, z.imag] for z in row.removed_zeros_rad_s), key=lambda z: z[1])
        np.testing.assert_allclose(
            np.reshape(zeros, (-1, 2)), np.reshape(sorted(expected["removed_zeros"], key=lambda z: z[1]), (-1, 2))
        )
        for fault, expected_fault in zip(row.faults, expected["rfsys"], strict=True):
            same(fault.numerator, expected_fault["num"])
            same(fault.denominator, expected_fault["den"])
            same(fault.dc_gain, expected_fault["dcgain"])
    assert design.leakage(np.geomspace(0.01, 1000.0, 200)) < 1e-12


def test_the_sign_of_the_pole_does_not_matter() -> None:
    servo = TransferFunction((122300.0,), (1.0, 94.88, 6660.7936, 122237.64))
    assert design_nullspace_filter(servo, 50.0) == design_nullspace_filter(servo, -50.0)


@pytest.mark.parametrize("pole", [0.0, float("nan"), float("inf")])
def test_a_useless_pole_is_refused(pole: float) -> None:
    servo = TransferFunction((1.0,), (1.0, 1.0))
    with pytest.raises(DesignError, match="pole"):
        design_nullspace_filter(servo, pole)
    with pytest.raises(DesignError, match="pole"):
        design_pulse_filter(servo, 0.0, 0.01, pole)


def test_a_plant_without_dc_gain_is_refused() -> None:
    with pytest.raises(DesignError, match="zero frequency"):
        design_nullspace_filter(TransferFunction((1.0, 0.0), (1.0, 2.0, 1.0)), 50.0)


@pytest.mark.parametrize("name", SERVOS)
def test_sampled_filter(name: str) -> None:
    entry = RESIDUAL[name]
    transfer = TransferFunction((entry["num"],), tuple(entry["den"]))
    design = design_pulse_filter(transfer, entry["delay"], entry["T"], 50.0)
    # Coefficients below round-off of the leading one (an a of 1e-15 beside 1) carry no digits to compare.
    a, b = np.trim_zeros(np.array(entry["a"]), "b"), np.array(entry["b"])
    np.testing.assert_allclose(np.append(design.a, np.zeros(b.size))[: a.size], a, rtol=TEN_DIGITS, atol=ROUND_OFF)
    np.testing.assert_allclose(np.append(design.b[0], np.zeros(b.size))[: b.size], b, rtol=TEN_DIGITS)
    np.testing.assert_allclose(design.md, entry["Md"], rtol=TEN_DIGITS)
    assert design.g == pytest.approx(entry["g"], rel=TEN_DIGITS)
    assert design.noise_gain == pytest.approx(entry["noise_gain"], rel=TEN_DIGITS)
    np.testing.assert_allclose(design.autocorrelation(12), entry["rho"], rtol=TEN_DIGITS)
    np.testing.assert_allclose(design.fault_step(20), entry["fault_step"], rtol=TEN_DIGITS, atol=ROUND_OFF)
    assert design.leakage(np.linspace(0.1, 314.0, 300)) < 1e-12


@pytest.mark.parametrize("name", SERVOS)
def test_poles_gain_and_bandwidth(name: str) -> None:
    entry = RESIDUAL[name]
    transfer = TransferFunction((entry["num"],), tuple(entry["den"]))
    ours = sorted([p.real, p.imag] for p in transfer.poles_rad_s)
    np.testing.assert_allclose(ours, sorted(entry["poles"]), rtol=TEN_DIGITS)
    assert transfer.dc_gain == pytest.approx(entry["dcgain"], rel=TEN_DIGITS)
    assert transfer.bandwidth_rad_s == pytest.approx(entry["bandwidth_3dB_rad_s"], rel=REFERENCE_BANDWIDTH)
    drop = abs(transfer.at(np.array([1j * transfer.bandwidth_rad_s]))[0]) / transfer.dc_gain
    assert 20.0 * np.log10(drop) == pytest.approx(-3.0, abs=1e-9)


def test_the_sampled_fault_response_follows_the_continuous_one() -> None:
    step = design_pulse_filter(
        TransferFunction((122300.0,), (1.0, 94.88, 6660.7936, 122237.64)), 0.004, 0.01, 50.0
    ).fault_step(31)
    continuous = list(RESIDUAL["f_to_r_ct_step"].values())
    np.testing.assert_allclose(step, continuous, atol=0.003)


def test_several_commands_with_their_own_delays_do_not_reach_the_residual() -> None:
    first = TransferFunction((122300.0,), (1.0, 94.88, 6660.7936, 122237.64))
    second = TransferFunction((-327.05,), (1.0, 17.27, 654.1))
    design = design_pulse_filter((first, second), (0.004, 0.015), 0.01, 30.0)
    assert design.leakage(np.linspace(0.1, 314.0, 300)) < 1e-11
    # The command with the smaller gain, half, is the one whose fault is normalised.
    assert design.fault_step(400, command=1)[-1] == pytest.approx(1.0, abs=1e-6)
    assert design.fault_step(400, command=0)[-1] == pytest.approx(-2.0, rel=2e-3)


def test_false_alarm_rate() -> None:
    table = RESIDUAL["pfa_per_hour_100Hz_HS225eq"]
    rho = RESIDUAL["HS225BB_eq3_1"]["rho"][1]
    for z, expected in zip(table["z"], table["upcross"], strict=True):
        assert 1.0 - np.exp(-Noise(1.0, rho, 0.01).false_alarms_per_hour(z)) == pytest.approx(expected, rel=1e-3)
    for target, z in RESIDUAL["z_for_target_pfa_per_hour"].items():
        rate = -np.expm1(-Noise(1.0, rho, 0.01).false_alarms_per_hour(z))
        assert rate == pytest.approx(float(target), rel=2e-3)


def test_false_alarm_rate_at_the_ends() -> None:
    assert Noise(0.0, 0.5, 0.01).false_alarms_per_hour(1.5) == 0.0
    assert Noise(1.0, 0.5, 0.01).false_alarms_per_hour(60.0) == 0.0
    assert 0.0 < Noise(1.0, 0.999, 0.01).false_alarms_per_hour(0.1) < 360_000.0
