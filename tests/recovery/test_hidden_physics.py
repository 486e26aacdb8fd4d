"""The servo in which effects are hidden: healthy it is the model's, and each effect does what its name says."""

from __future__ import annotations

import numpy as np
import pytest

from hidden_physics import (
    CATALOGUE,
    EXCITATIONS,
    LEVELS,
    OUTSIDE,
    STRUCTURAL,
    Air,
    Effects,
    deflection,
    draw,
    effect_rms_deg,
    hidden,
    sweep,
)
from servofd.core.types import FloatArray
from servofd.servo.library import servo_named
from servofd.servo.servo_model import ServoModel

MODEL = ServoModel.of(servo_named("hs225bb-eq31"))
TIME_S = np.arange(3000) / 100.0
TRIANGLE_DEG = 8.0 * (2.0 / np.pi) * np.arcsin(np.sin(2.0 * np.pi * TIME_S / 20.0))
"""Slow enough (1.6 deg/s) for a servo to be where it would rest, but for 0.0554 s and 0.004 s of lag."""
LAG_S = 6660.7936 / 122237.64 + 0.004 + 0.005
"""Of a ramp: ratio of the last coefficients of Eq. 3.1, transport delay, half a sample of hold."""

_LOSSES, _SQUARE = 94.88, 6660.7936
RUSH = np.exp(-np.pi / np.sqrt(4.0 * _SQUARE / _LOSSES**2 - 1.0))
"""How far a motor with the coefficients of Eq. 3.1 runs past the speed that its supply sustains: 10.6 %."""


def moved(effects: Effects, command_deg: FloatArray, airspeed_m_s: float = 20.0, supply_v: float = 6.0) -> FloatArray:
    air = Air.steady(30.0, airspeed_m_s, supply_v)
    return deflection(effects, TIME_S, command_deg, air, np.random.default_rng(0))


def difference(name: str, **values: float) -> FloatArray:
    """What an effect changes under the slow triangle."""
    return moved({name: values}, TRIANGLE_DEG) - moved({}, TRIANGLE_DEG)


def rising(values: FloatArray) -> FloatArray:
    return values[(TIME_S > 16.5) & (TIME_S < 24.0)]


def falling(values: FloatArray) -> FloatArray:
    return values[(TIME_S > 6.5) & (TIME_S < 14.0)]


def up_from_level(values: FloatArray) -> FloatArray:
    return values[(TIME_S > 22.0) & (TIME_S < 24.5)]


def down_to_level(values: FloatArray) -> FloatArray:
    return values[(TIME_S > 26.0) & (TIME_S < 28.5)]


@pytest.mark.parametrize("excitation", EXCITATIONS)
def test_without_effects_it_is_the_model(excitation: str) -> None:
    record = hidden(3, {}, excitation, jitter_s=0.002)
    exact_deg = MODEL.simulate(record.time_s, record.command_deg, record.time_s)
    np.testing.assert_allclose(record.clean_deg, exact_deg, rtol=0, atol=5e-4)  # measured 4e-5 without jitter


def test_a_servo_of_another_step_is_the_same_at_rest_and_at_full_speed() -> None:
    step_deg = np.where(TIME_S < 1.0, -50.0, 50.0)
    healthy_deg = moved({}, step_deg)
    np.testing.assert_allclose(healthy_deg[[90, -1]], [-50.0, 50.0], atol=1e-6)
    rate_deg_s = 100.0 * np.diff(healthy_deg)
    assert np.max(rate_deg_s) == pytest.approx((1.0 + RUSH) * 370.0, rel=0.01)
    assert np.mean(rate_deg_s[115:120]) == pytest.approx(370.0, rel=0.02)


@pytest.mark.parametrize(("rate_up", "rate_down"), [(80.0, 80.0), (40.0, 90.0)])
def test_the_rate_limit_holds_in_each_direction(rate_up: float, rate_down: float) -> None:
    square_deg = np.where(TIME_S % 3.0 < 1.5, 20.0, -20.0)
    rate_deg_s = np.diff(moved({"rate_limit": {"rate_up_deg_s": rate_up, "rate_down_deg_s": rate_down}}, square_deg))
    assert np.max(rate_deg_s) * 100.0 == pytest.approx((1.0 + RUSH) * rate_up, rel=0.01)
    assert np.min(rate_deg_s) * 100.0 == pytest.approx(-(1.0 + RUSH) * rate_down, rel=0.01)
    assert np.median(rate_deg_s[rate_deg_s > 0.2]) * 100.0 == pytest.approx(rate_up, rel=1e-3)


def test_speed_is_proportional_to_voltage() -> None:
    square_deg = np.where(TIME_S % 3.0 < 1.5, 20.0, -20.0)
    for supply_v in (5.0, 7.5):
        rate_deg_s = 100.0 * np.diff(moved({"voltage_rate": {"deg_s_per_v": 10.0}}, square_deg, supply_v=supply_v))
        assert np.median(rate_deg_s[rate_deg_s > 20.0]) == pytest.approx(10.0 * supply_v, rel=1e-3)


def test_a_delay_shifts_and_replaces_the_nominal_one() -> None:
    command_deg = sweep(TIME_S, np.random.default_rng(0))
    later_deg, sooner_deg = moved({"delay": {"delay_s": 0.034}}, command_deg), moved({}, command_deg)
    np.testing.assert_allclose(later_deg[3:], sooner_deg[:-3], atol=1e-6)


def test_a_clock_offset_shifts_the_other_way_when_it_is_negative() -> None:
    command_deg = sweep(TIME_S, np.random.default_rng(0))
    sooner_deg = moved({"clock_offset": {"offset_s": -0.03}}, command_deg)
    np.testing.assert_allclose(sooner_deg[:-3], moved({}, command_deg)[3:], atol=1e-6)


def test_slow_dynamics_stretch_time() -> None:
    step_deg = np.where(TIME_S < 1.0, 0.0, 4.0)
    slow_deg = moved({"slow_dynamics": {"bandwidth_scale": 0.5}, "delay": {"delay_s": 0.01}}, step_deg)
    fast_deg = moved({"delay": {"delay_s": 0.01}}, step_deg)
    # At 1 s + 10 ms the command arrives; from there one moves as the other in half the time.
    np.testing.assert_allclose(slow_deg[101:301:2], fast_deg[101:201], atol=1e-3)


@pytest.mark.parametrize("name", ["deadband", "backlash", "friction"])
def test_hysteresis_is_as_wide_as_it_says(name: str) -> None:
    key, full = ("friction_deg", 2.0) if name == "friction" else ("width_deg", 1.0)
    lag_deg = difference(name, **{key: 1.2})
    half_deg = full * 1.2 / 2.0
    np.testing.assert_allclose(np.mean(rising(lag_deg)), -half_deg, atol=0.02)
    np.testing.assert_allclose(np.mean(falling(lag_deg)), half_deg, atol=0.02)


def test_friction_slides_on_without_sticking_when_it_is_fast_enough() -> None:
    stuck_deg = np.diff(moved({"friction": {"friction_deg": 1.0}}, TRIANGLE_DEG))
    assert np.count_nonzero(stuck_deg == 0.0) > 50  # around reversals
    assert np.all(stuck_deg[1800:2400] > 0.0)


def test_a_soft_dead_band_rests_within_and_a_hard_one_does_not_stop_at_its_edge() -> None:
    step_deg = np.where(TIME_S < 1.0, 0.0, 3.0)
    soft_deg, hard_deg = (moved({name: {"width_deg": 1.0}}, step_deg)[-1] for name in ("deadband", "hard_deadband"))
    assert soft_deg == pytest.approx(2.5, abs=1e-3)
    assert 2.5 < hard_deg < 3.5


def test_friction_of_a_loaded_bearing_grows_with_deflection() -> None:
    lag_deg = rising(difference("bearing_load", friction_deg_per_deg=0.1))
    where_deg = rising(moved({"bearing_load": {"friction_deg_per_deg": 0.1}}, TRIANGLE_DEG))
    np.testing.assert_allclose(lag_deg, -0.1 * np.abs(where_deg), atol=0.03)


def test_air_takes_away_deflection_by_its_pressure() -> None:
    for airspeed_m_s in (10.0, 25.0):
        effects = {"airload": {"deg_per_deg_pa": 1e-3}}
        held_deg = moved(effects, np.full(TIME_S.size, 6.0), airspeed_m_s=airspeed_m_s)[-1]
        pressure_pa = 0.5 * 1.225 * airspeed_m_s**2
        assert 6.0 - held_deg == pytest.approx(1e-3 * pressure_pa * held_deg, rel=1e-6)


def test_friction_under_load_holds_a_share_of_it() -> None:
    # Going up against the weight the motor pulls e, of which a share is lost: e (1 - share) = droop sin; going down it
    # is helped: e (1 + share) = droop sin.
    weight = {"gravity_load": {"droop_deg": 12.0}}
    rubbed_deg = moved({**weight, "load_friction": {"share": 0.3}}, TRIANGLE_DEG) - TRIANGLE_DEG
    free_deg = moved(weight, TRIANGLE_DEG) - TRIANGLE_DEG
    up, down = (np.mean(where(rubbed_deg)) for where in (up_from_level, down_to_level))
    free_up, free_down = (np.mean(where(free_deg)) for where in (up_from_level, down_to_level))
    assert up / free_up == pytest.approx(1.0 / 0.7, rel=0.1)
    assert down / free_down == pytest.approx(1.0 / 1.3, rel=0.1)


def test_weight_droops_by_the_sine() -> None:
    for command_deg in (10.0, 60.0):
        held_deg = moved({"gravity_load": {"droop_deg": 20.0}}, np.full(TIME_S.size, command_deg))[-1]
        assert command_deg - held_deg == pytest.approx(20.0 * np.sin(np.radians(held_deg)), rel=1e-6)


def test_gain_bias_and_stops_are_what_they_say() -> None:
    healthy_deg = moved({}, TRIANGLE_DEG)
    np.testing.assert_allclose(moved({"gain": {"gain": 0.8}}, TRIANGLE_DEG), 0.8 * healthy_deg, atol=1e-9)
    np.testing.assert_allclose(moved({"bias": {"bias_deg": -0.7}}, TRIANGLE_DEG), healthy_deg - 0.7, atol=1e-9)
    stops = {"lower_deg": -3.0, "upper_deg": 5.0}
    np.testing.assert_allclose(
        moved({"position_limit": stops}, TRIANGLE_DEG), np.clip(healthy_deg, -3.0, 5.0), atol=1e-9
    )


def test_a_stalled_shaft_leaves_its_stop_when_its_command_does() -> None:
    stops = {"lower_deg": -3.0, "upper_deg": 5.0}
    fast_deg = 8.0 * np.sin(2.0 * np.pi * 2.0 * TIME_S)
    stalled_deg, strained_deg = (moved({name: stops}, fast_deg) for name in ("hard_stop", "position_limit"))
    assert stalled_deg.max() == pytest.approx(5.0)
    assert strained_deg.max() == pytest.approx(5.0)
    left = [np.flatnonzero(values[200:250] > 4.9)[-1] for values in (stalled_deg, strained_deg)]
    assert left[0] < left[1]


def test_pulse_frames_hold_the_command_over_their_period() -> None:
    steps_deg = moved({"pwm_frame": {"period_s": 0.5}, "slow_dynamics": {"bandwidth_scale": 8.0}}, TRIANGLE_DEG)
    jumps_s = TIME_S[1:][np.diff(steps_deg) > 0.4]
    assert jumps_s.size > 20
    np.testing.assert_allclose(np.diff(jumps_s[:9]), 0.5, atol=0.011)


def test_a_sensor_lags_by_its_time_constant() -> None:
    # Behind a ramp of 1.6 deg/s by that rate times the time constant.
    assert np.mean(rising(difference("sensor_lag", time_constant_s=0.1))) == pytest.approx(-0.16, abs=0.001)
    assert np.mean(rising(moved({}, TRIANGLE_DEG) - TRIANGLE_DEG)) == pytest.approx(-1.6 * LAG_S, rel=0.03)


def test_an_elastic_rod_rings_at_its_frequency() -> None:
    step_deg = np.where(TIME_S < 1.0, 0.0, 5.0)
    values = {"frequency_hz": 4.0, "damping_ratio": 0.05}
    ringing_deg = moved({"resonance": values}, step_deg)[120:520] - 5.0
    crossings = np.flatnonzero(np.diff(np.sign(ringing_deg)))
    assert 0.5 / np.mean(np.diff(crossings) / 100.0) == pytest.approx(4.0 * np.sqrt(1.0 - 0.05**2), rel=0.02)


def test_a_skewed_arm_turns_less_on_one_side() -> None:
    bent_deg = difference("linkage_nonlinearity", arm_offset_deg=40.0)
    # delta'' = -tan(offset): minus half of that times the square, in radians.
    expected_deg = -0.5 * np.tan(np.radians(40.0)) * np.radians(5.0) ** 2 * 180.0 / np.pi
    at_deg = np.interp(5.0, rising(moved({}, TRIANGLE_DEG)), rising(bent_deg))
    assert at_deg == pytest.approx(expected_deg, rel=0.1)


def test_a_converter_rounds() -> None:
    read_deg = hidden(1, {"quantization": {"step_deg": 0.9}}, "flight").measured_deg
    np.testing.assert_allclose(read_deg / 0.9, np.round(read_deg / 0.9), atol=1e-9)


def test_a_set_point_runs_no_faster_than_its_firmware_lets_it() -> None:
    step_deg = np.where(TIME_S < 1.0, 0.0, 20.0)
    moved_deg = moved({"set_point_speed": {"rate_deg_s": 40.0}}, step_deg)
    along = (TIME_S > 1.3) & (TIME_S < 1.5)
    np.testing.assert_allclose(moved_deg[along], 40.0 * (TIME_S[along] - 1.0 - LAG_S + 0.005), atol=0.02)


def test_bristles_give_way_before_they_slide() -> None:
    tiny_deg = 0.15 * np.sin(2.0 * np.pi * 0.5 * TIME_S)
    bent_deg, stuck_deg = (
        moved(effects, tiny_deg)
        for effects in (
            {"lugre_friction": {"friction_deg": 0.4, "presliding_deg": 0.2}},
            {"friction": {"friction_deg": 0.4}},
        )
    )
    assert np.ptp(stuck_deg[500:]) == 0.0
    assert np.ptp(bent_deg[500:]) > 0.02
    slid_deg = difference("lugre_friction", friction_deg=0.4, presliding_deg=0.2)
    assert np.mean(rising(slid_deg)) == pytest.approx(-0.4, abs=0.02)


@pytest.mark.parametrize("name", [*CATALOGUE, *STRUCTURAL, *OUTSIDE])
def test_every_effect_changes_the_log_and_nothing_else(name: str) -> None:
    effects = {name: draw(np.random.default_rng(1), name, "large")}
    record, again, healthy = (hidden(2, what, "sweep", duration_s=30.0) for what in (effects, effects, {}))
    for column in ("time_s", "command_deg", "measured_deg", "airspeed_m_s", "servo_voltage_v"):
        np.testing.assert_array_equal(getattr(record, column), getattr(again, column))
        if (column, name) != ("time_s", "stamp_jitter") and column != "measured_deg":
            np.testing.assert_array_equal(getattr(record, column), getattr(healthy, column))
    assert np.all(np.diff(record.time_s) > 0.0)
    assert np.all(np.isfinite(record.measured_deg))
    assert dict(record.truth[name]) == effects[name]
    if name == "stamp_jitter":
        assert np.std(record.time_s - healthy.time_s) > 0.002
    else:
        assert effect_rms_deg(record, healthy) > 0.1


@pytest.mark.slow
def test_sizes_rise() -> None:
    healthy = hidden(4, {}, "sweep", duration_s=30.0)
    for name in CATALOGUE:
        rms_deg = [
            effect_rms_deg(
                hidden(4, {name: draw(np.random.default_rng(0), name, level)}, "sweep", duration_s=30.0), healthy
            )
            for level in LEVELS
        ]
        assert rms_deg == sorted(rms_deg)


def test_noise_rows_and_scatter_are_as_ordered() -> None:
    record = hidden(5, {}, "flight", 0.2, spread=0.03, jitter_s=0.002, row_loss=0.03)
    assert 0.96 < record.time_s.size / 6000 < 0.98
    assert np.std(record.measured_deg - record.clean_deg) == pytest.approx(np.hypot(0.2, 0.044 / 12**0.5), rel=0.03)
    whole = hidden(5, {}, "flight", 0.2, jitter_s=0.002)
    np.testing.assert_allclose(np.round(whole.command_deg, 2), whole.command_deg, atol=1e-12)
    other = hidden(5, {}, "flight", 0.2, spread=0.03, jitter_s=0.002)
    assert 0.005 < effect_rms_deg(other, whole) < 0.2
    assert np.ptp(whole.airspeed_m_s) > 8.0
    assert np.ptp(whole.servo_voltage_v) > 1.5


def test_an_unknown_effect_is_refused() -> None:
    with pytest.raises(ValueError, match="no effect gremlins"):
        hidden(0, {"gremlins": {}}, "flight")
