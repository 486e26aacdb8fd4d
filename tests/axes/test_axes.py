"""Lost shares are found again, the statistic is what it says, and what a servo received is never read."""

from __future__ import annotations

import functools
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

import logparsers
from logparsers.records import FlightLog
from servofd.aircraft.axes import motion_to_toml
from servofd.aircraft.outputs import outputs_of
from servofd.aircraft.schema import load_aircraft
from servofd.axes.calibrate import calibrate_motion, spread_between, tail_of
from servofd.axes.judge import judge_motion
from servofd.axes.model import Inputs
from servofd.axes.motion import Motion, airframe_of, cell_means, motion_of_table
from servofd.axes.windows import sliding
from servofd.cli import main
from servofd.core.errors import CalibrationError, ConfigError, NoMeasurement
from servofd.core.windows import Sizes, distance
from servofd.detection.verdict import LogAudit
from tests.axes.flights import calibrated, flown

DAYS = ("2026-05-01", "2026-05-02", "2026-05-03")


def test_the_distance_of_healthy_windows_is_chi_square() -> None:
    rng = np.random.default_rng(1)
    between = np.array([[0.01, 0.1], [0.1, 25.0]])
    ratios = []
    for _ in range(400):
        asked = rng.normal(0.0, 30.0, 60)
        loss, offset = rng.multivariate_normal(np.zeros(2), between)
        inputs = Inputs(
            -loss * asked + offset + rng.normal(0.0, 40.0, 60), -asked, np.ones(60), np.ones(60, dtype=bool)
        )
        found = sliding(inputs, 60, 40.0**2)
        loss, offset = found.value[:, -1]
        if loss - found.covariance[0, 1, -1] / found.covariance[1, 1, -1] * offset > 0.0:
            ratios.append(distance(found.beyond(Sizes.nothing(between), np.zeros((2, 2))))[-1])
    one_sided = [r for r in ratios if r > 0.0]
    assert stats.kstest(one_sided, stats.chi2(2).cdf).pvalue > 0.01


def test_more_effect_than_expected_is_no_loss() -> None:
    asked = np.sin(np.arange(200.0))
    inputs = Inputs(3.0 * asked, -asked, np.ones(200), np.ones(200, dtype=bool))
    healthy = np.diag([0.01, 1.0])
    assert distance(sliding(inputs, 100, 1.0).beyond(Sizes.nothing(healthy), healthy)).max() < 0.1


@pytest.mark.slow
def test_the_spread_between_flights_is_found_again() -> None:
    rng = np.random.default_rng(2)
    truth = np.array([[0.01, 0.2], [0.2, 100.0]])
    flights = []
    for _ in range(1000):
        loss, offset = rng.multivariate_normal(np.zeros(2), truth)
        asked = rng.normal(0.0, 30.0, 200)
        residual = -loss * asked + offset + rng.normal(0.0, 20.0, 200)
        found = sliding(Inputs(residual, -asked, np.ones(200), np.ones(200, dtype=bool)), 200, 400.0)
        flights.append(found.at(found.known))
    assert spread_between(flights, np.diag([0.0025, 10.0])) == pytest.approx(truth, rel=0.15, abs=0.05)


def test_means_over_cells_keep_the_integral_of_an_irregular_channel() -> None:
    rng = np.random.default_rng(3)
    time_s = np.sort(rng.uniform(0.0, 10.0, 997))
    values = np.sin(time_s)
    grid_s = np.arange(0.2, 9.9, 0.2)
    means = cell_means(grid_s, time_s, values)
    assert means == pytest.approx((np.cos(grid_s - 0.2) - np.cos(grid_s)) / 0.2, abs=2e-3)


def test_days_and_steepness_tell_the_rate() -> None:
    tops = (1.0 - np.random.default_rng(4).uniform(size=400)) ** (-1.0 / 3.0)
    tail = tail_of(tops, np.full(400, 0.1), days=5)
    level = tail.level(0.1)
    assert np.mean(level**-3.0) / 0.1 == pytest.approx(0.1, rel=0.5)
    assert tail_of(tops, np.full(400, 0.1), days=1).level(0.1) > level


@pytest.mark.slow
def test_healthy_flights_are_healthy_and_a_loss_is_measured() -> None:
    model = calibrated()
    assert model.days == 3
    assert model.axes["roll"].explained > 0.8
    held_out = judge_motion(model, flown(50, "2026-05-09"))
    assert {audit.axis: audit.status for audit in held_out}["roll"] == "healthy"
    failed = judge_motion(model, flown(51, "2026-05-09", aileron_share=0.5, from_s=60.0))
    roll = next(audit for audit in failed if audit.axis == "roll")
    assert roll.status in ("suspect", "fault")
    assert roll.since_s == pytest.approx(60.0, abs=2.0)
    assert roll.lost_share is not None
    assert roll.lost_share.low < 0.5 < roll.lost_share.high
    assert "one of them, or both at half effect" in roll.reason


@pytest.mark.slow
def test_what_happens_in_a_running_alarm_is_another_event_and_a_recovery_is_none() -> None:
    half = functools.partial(flown, 54, "2026-05-09", duration_s=160.0, aileron_share=0.5, from_s=50.0, later_s=100.0)
    worse = next(a for a in judge_motion(calibrated(), half(later_share=0.0)) if a.axis == "roll")
    assert [event.start_s for event in worse.events] == pytest.approx([50.0, 100.0], abs=2.0)
    for event, lost in zip(worse.events, (0.5, 1.0), strict=True):
        assert event.is_own
        assert event.end_s is None
        assert event.lost_share.low < lost < event.lost_share.high
    assert "since 100.0 s" in worse.reason
    well = next(a for a in judge_motion(calibrated(), half(later_share=1.0)) if a.axis == "roll")
    (event,) = well.events
    assert event.end_s is not None
    assert 100.0 < event.end_s < 115.0
    assert event.lost_share.low < 0.5 < event.lost_share.high


@pytest.mark.slow
def test_the_verdict_is_causal() -> None:
    flight = flown(52, "2026-05-09", aileron_share=0.0, from_s=60.0)
    whole = next(a for a in judge_motion(calibrated(), flight) if a.axis == "roll")
    (event, *_) = whole.events
    cut = next(a for a in judge_motion(calibrated(), flight.until(event.alarm_s + 0.02)) if a.axis == "roll")
    assert cut.events[0].alarm_s == event.alarm_s
    assert cut.score == pytest.approx(whole.score[: cut.score.size])


@pytest.mark.slow
def test_a_flight_without_motion_is_not_called_healthy() -> None:
    calm = flown(53, "2026-05-09")
    calm.commands_us["roll"][:] = 0.0
    roll = next(audit for audit in judge_motion(calibrated(), calm) if audit.axis == "roll")
    assert roll.status != "healthy"


def test_one_short_flight_is_refused() -> None:
    with pytest.raises(CalibrationError, match="at least 60 s"):
        calibrate_motion([flown(1, duration_s=30.0)])


@pytest.mark.slow
def test_a_log_that_is_too_short_is_left_out_and_the_others_calibrate() -> None:
    model = calibrate_motion([flown(seed) for seed in range(1, 4)] + [flown(9, duration_s=8.0)])
    assert model.flights == 3
    assert [why.partition(":")[0] for why in model.left_out] == ["flight 9"]


@pytest.mark.slow
def test_a_flight_of_another_aircraft_is_left_out_and_named() -> None:
    good = [flown(seed, f"2026-05-0{seed}") for seed in range(1, 4)]
    assert calibrated().left_out == ()
    model = calibrate_motion([*good, flown(4, "2026-05-04", aileron_share=0.5, from_s=0.0)])
    assert model.flights == 3
    assert re.match("flight 4: roll has [45][0-9]% less effect", model.left_out[0])


@pytest.mark.slow
def test_an_axis_that_was_asked_too_little_does_not_keep_the_others_from_being_cleared() -> None:
    roll = next(a for a in judge_motion(calibrated(), flown(50, "2026-05-09")) if a.axis == "roll")
    calm = replace(roll, axis="side", status="unknown", events=(), identifiable=0.2)
    unknown = replace(calm, axis="pitch", identifiable=0.9)
    for axes, cleared in (
        ((roll, calm), True),
        ((calm,), False),
        ((roll, calm, calm), False),
        ((roll, unknown), False),
    ):
        log = FlightLog(Path("a.bin"), "dataflash", {})
        audit = LogAudit(log, load_aircraft("simulated"), (), axes=axes)
        assert (not audit.not_judged) == cleared


@pytest.mark.slow
def test_one_flight_calibrates_by_its_halves_and_says_how_often_it_is_wrong() -> None:
    model = calibrate_motion([flown(1, duration_s=300.0)])
    assert (model.flights, model.days) == (1, 1)
    assert model.axes["roll"].false_alarms_per_hour > 0.0


HEADER = (
    "t_s,ail_cmd_us,ele_cmd_us,thr_us,ailL_out_us,p_rad_s,q_rad_s,r_rad_s,ax_m_s2,ay_m_s2,az_m_s2,phi_rad,theta_rad,"
)


def table(folder: Path, *, out_us: float = 0.0, airspeed: str = "airspeed_est_m_s", speed: float = 17.0) -> Path:
    path = folder / "2026-05-01-flight.csv"
    rng = np.random.default_rng(5)
    rows = [
        f"{k / 10},{rng.normal():.3f},1,1400,{out_us},{rng.normal():.3f},0,0,0.1,0.2,-9.8,0.1,0,{speed},0.0"
        for k in range(100)
    ]
    path.write_text("\n".join([HEADER + airspeed + ",airspeed_pitot_m_s", *rows]) + "\n")
    return path


def test_what_a_servo_received_is_never_read(tmp_path: Path) -> None:
    """A fault freezes the output: who reads it finds every fault, and nothing in flight."""
    one = motion_of_table(logparsers.read(table(tmp_path)))
    other = motion_of_table(logparsers.read(table(tmp_path, out_us=400.0)))
    assert one.day == "2026-05-01"
    for axis, values in one.commands_us.items():
        assert np.array_equal(values, other.commands_us[axis])
    assert np.array_equal(one.rates_deg_s, other.rates_deg_s)


def test_a_pitot_that_reads_zero_is_no_airspeed(tmp_path: Path) -> None:
    assert motion_of_table(logparsers.read(table(tmp_path))).airspeed_source == "GPS and wind"
    with pytest.raises(NoMeasurement, match="no airspeed that measures anything"):
        motion_of_table(logparsers.read(table(tmp_path, speed=0.0)))


@pytest.mark.slow
def test_a_file_of_motion_alone_is_an_aircraft(tmp_path: Path) -> None:
    path = tmp_path / "plane.toml"
    path.write_text(motion_to_toml(calibrated()))
    assert load_aircraft(path).motion == calibrated()
    path.write_text(motion_to_toml(calibrated()).replace('"roll_', '"rowl_'))
    with pytest.raises(ConfigError, match="form: there are roll_rate"):
        load_aircraft(path)


def as_table(folder: Path, name: str, flight: Motion) -> str:
    columns = {
        "t_s": flight.time_s,
        "ail_cmd_us": flight.commands_us["roll"],
        "throttle": flight.throttle,
        **dict(zip(("p_deg_s", "q_deg_s", "r_deg_s"), flight.rates_deg_s, strict=True)),
        **dict(zip(("ax_m_s2", "ay_m_s2", "az_m_s2"), flight.accelerations_m_s2, strict=True)),
        "roll_deg": flight.roll_deg,
        "pitch_deg": flight.pitch_deg,
        "airspeed_m_s": flight.airspeed_m_s,
    }
    path = folder / name
    np.savetxt(path, np.column_stack(list(columns.values())), "%.4f", ",", header=",".join(columns), comments="")
    return str(path)


@pytest.mark.slow
def test_two_commands_from_logs_to_a_verdict(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    good = [as_table(tmp_path, f"{DAYS[k]}.csv", flown(k, DAYS[k])) for k in range(3)]
    plane, out = str(tmp_path / "plane.toml"), tmp_path / "audit.json"
    assert main(["calibrate", *good, "-o", plane]) == 0
    assert "3 flights, " in capsys.readouterr().out
    bad = as_table(tmp_path, "2026-05-09.csv", flown(51, "2026-05-09", aileron_share=0.5, from_s=60.0))
    page = tmp_path / "page.html"
    assert main(["audit", bad, "-c", plane, "--json", str(out), "--html", str(page)]) in (1, 2)
    roll = json.loads(out.read_text())["logs"][0]["axes"]["roll"]
    assert roll["status"] in ("suspect", "fault")
    assert roll["lost_share"] == pytest.approx(0.5, abs=0.2)
    assert roll["since_s"] == pytest.approx(60.0, abs=2.0)
    assert roll["members"] == ["aileron_left", "aileron_right"]
    assert set(roll) >= {"reason", "offset_us", "false_alarms_per_hour", "identifiable"}
    words = page.read_text()
    assert "one of them, or both at half effect" in words
    assert "is judged by the motion" in words
    assert "Each servo is simulated" not in words
    well = as_table(tmp_path, "2026-05-08.csv", flown(50, "2026-05-08"))
    assert main(["audit", well, "-c", plane]) == 0


def test_elevons_and_tails_share_their_axes() -> None:
    parameters = {"SERVO1_FUNCTION": 77.0, "SERVO2_FUNCTION": 78.0, "SERVO3_FUNCTION": 70.0}
    wing = airframe_of(outputs_of(parameters))
    assert wing.members == {"roll": ("elevon_left", "elevon_right"), "pitch": ("elevon_left", "elevon_right")} | {
        "thrust": ("engine",)
    }
    assert sum(weight for _, weight in wing.commands["pitch"]) == 1.0
    assert sum(weight for _, weight in wing.commands["roll"]) == 0.0
    tail = airframe_of(outputs_of({"SERVO5_FUNCTION": 79.0, "SERVO6_FUNCTION": 80.0, "SERVO1_FUNCTION": 4.0}))
    assert tail.members["side"] == tail.members["pitch"] == ("vtail_left", "vtail_right")
    assert not airframe_of(outputs_of({f"SERVO{k}_FUNCTION": 32.0 + k for k in range(1, 5)})).commands
