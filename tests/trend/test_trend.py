"""From estimates and logs to the trend of an aircraft."""

from __future__ import annotations

import datetime
import json
from typing import TYPE_CHECKING

import numpy as np
import pytest

from servofd.aircraft.schema import Aircraft, load_aircraft, plain_aircraft
from servofd.aircraft.series import Series
from servofd.cli import main
from servofd.core.errors import ConfigError, NoMeasurement
from servofd.core.statistics import Estimate
from servofd.outputs.page import html_page
from servofd.outputs.trend_report import trend_report
from servofd.servo.faults import DeadBand
from servofd.servo.loops import play
from servofd.simulation.flight import simulate_flight
from servofd.wear.estimate import ServoEstimate, estimate_flight
from servofd.wear.trend import FlownLog, in_order, trend_document, trend_logs, trend_of
from trend_fleets import crossing_at, healthy_fleet, widths_trend

if TYPE_CHECKING:
    from pathlib import Path

    from servofd.core.types import FloatArray

PLANE = plain_aircraft(["rudder"], "hs225bb-eq31")
START = datetime.datetime(2026, 5, 1, 9, 0, tzinfo=datetime.UTC)


def flown(width_deg: float = 0.0, seed: int = 1, command: str = "flight", **changed: FloatArray) -> Series:
    faults = {"rudder": DeadBand(0.0, width_deg=width_deg)} if width_deg else {}
    flight = simulate_flight(PLANE, command=command, duration_s=40.0, seed=seed, faults=faults)
    columns = {"command_deg": flight.command_deg[:, 0], "measured_deg": flight.measured_deg[:, 0]} | changed
    return Series("rudder", flight.time_s, columns["command_deg"], flight.time_s, columns["measured_deg"])


def logs(widths_deg: list[float], start: datetime.datetime | None = None, identity: str = "") -> list[FlownLog]:
    """Logs whose estimates are drawn, one a day."""
    made = []
    for number, width_deg in enumerate(widths_deg, start=1):
        rng = np.random.default_rng(number)
        values = {"dead_band_deg": Estimate.of(width_deg + 0.01 * rng.standard_normal(), 0.01)}
        begun = None if start is None else start + datetime.timedelta(days=number - 1)
        name = f"flight{number}.csv"
        made.append(FlownLog(name, "", begun, identity, {"rudder": ServoEstimate(values, {})}, ()))
    return made


@pytest.mark.slow
@pytest.mark.parametrize("width_deg", [0.05, *(pytest.param(w, marks=pytest.mark.nightly) for w in (0.0, 0.6, 2.5))])
def test_the_width_of_a_dead_band_is_found(width_deg: float) -> None:
    """Within 0.025 deg on average, and within the interval of each flight, but for one of six."""
    found = [estimate_flight(flown(width_deg, seed), PLANE).values["dead_band_deg"] for seed in range(6)]
    assert np.mean([one.value for one in found]) == pytest.approx(width_deg, abs=0.025)
    assert sum(one.low < width_deg < one.high for one in found) >= 5
    assert max(one.deviation for one in found) < 0.17  # a third of the tolerance, as of a uniform spread


@pytest.mark.slow
@pytest.mark.parametrize("width_deg", [0.5, pytest.param(1.5, marks=pytest.mark.nightly)])
def test_backlash_behind_the_servo_is_told_from_a_dead_band_before_it(width_deg: float) -> None:
    time_s = np.arange(0.0, 40.0, 0.001)
    for seed in range(3):
        command = flown(seed=seed)
        moved_deg = PLANE.model("rudder").simulate(command.command_s, command.command_deg, time_s)
        noise_deg = 0.1 * np.random.default_rng(seed).standard_normal(command.measured_s.size)
        seen_deg = np.interp(command.measured_s, time_s, play(moved_deg, width_deg, 0.0)) + noise_deg
        values, *_ = estimate_flight(flown(seed=seed, measured_deg=seen_deg), PLANE)
        assert values["dead_band_deg"].value == pytest.approx(width_deg, abs=0.06)
        assert values["play_deg"].value > 0.4 * width_deg
        assert values["delay_s"].value == pytest.approx(0.004, abs=0.003)
        before, *_ = estimate_flight(flown(width_deg, seed), PLANE)
        assert "play_deg" not in before or before["play_deg"].value < 0.1 * width_deg


@pytest.mark.slow
def test_other_numbers_of_the_servo_are_those_it_was_simulated_with() -> None:
    values, missing, _ = estimate_flight(flown(0.3), PLANE)
    assert values["delay_s"].low < 0.004 < values["delay_s"].high
    assert values["bandwidth_hz"].low < 28.49 / (2.0 * np.pi) < values["bandwidth_hz"].high
    assert values["noise_deg"].value == pytest.approx(0.1, rel=0.05)
    assert values["gain"].value == pytest.approx(1.0, abs=0.01)
    assert 0.0 < values["residual_p95_deg"].value < 1.5
    assert 0.0 < values["margin"].value < 1.0
    assert set(missing) == {"rate_limit_deg_s", "rate_per_volt_deg_s_v"}


@pytest.mark.slow
def test_a_bias_is_found() -> None:
    segment = flown(command="steps")
    values, *_ = estimate_flight(flown(command="steps", measured_deg=segment.measured_deg + 0.7), PLANE)
    assert values["bias_deg"].value == pytest.approx(0.7, abs=0.02)


@pytest.mark.slow
def test_no_interval_is_wider_than_what_was_known_and_the_calibrated_flight_is_within_its_limits(
    tmp_path: Path,
) -> None:
    """A healthy surface, calibrated on two flights, followed over these and one more."""
    for seed in range(3):
        assert main(["simulate", "-o", str(tmp_path / f"{seed}.bin"), "--duration", "60", "--seed", str(seed)]) == 0
    good = [str(tmp_path / f"{seed}.bin") for seed in range(2)]
    assert main(["calibrate", *good, "-s", "elevator", "-o", str(tmp_path / "plane.toml")]) == 0
    plane = load_aircraft(tmp_path / "plane.toml")
    seen = trend_logs([str(tmp_path / "*.bin")], plane, surfaces=("elevator",), workers=0)
    assert not seen.has_alarm
    assert len(seen.order.logs) == 3
    for surface in seen.surfaces:
        known = plane.surfaces[surface.surface].calibrated
        assert known is not None
        sigma = dict(zip(known.parameters, np.sqrt(np.diag(known.covariance)).tolist(), strict=True))
        for name in ("delay_s", "play_deg", "bias_deg", "gain", "friction_deg"):
            if name in surface.quantities:
                assert surface.quantities[name].flights.deviation.max() <= sigma[name]
        gain = surface.quantities["gain"].flights
        assert np.all(np.abs(gain.value - 1.0) < 3.0 * gain.deviation)


def test_a_calm_flight_tells_nothing_of_the_dynamics_and_says_so() -> None:
    segment = flown()
    rng = np.random.default_rng(0)
    still = flown(
        command_deg=0.0 * segment.command_deg, measured_deg=0.1 * rng.standard_normal(segment.measured_s.size)
    )
    values, missing, _ = estimate_flight(still, PLANE)
    shown = "its motion shows no more of it than is known of any servo"
    assert missing["dead_band_deg"] == missing["delay_s"] == missing["gain"] == shown
    assert set(values) == {"residual_p95_deg", "margin", "bias_deg", "noise_deg"}


@pytest.mark.slow
@pytest.mark.parametrize("rad_s", [0.05, 0.2, 1.0])
def test_slow_motion_tells_little_of_delay_and_bandwidth_and_says_so(rad_s: float) -> None:
    segment = flown()
    asked_deg = 10.0 * np.sin(rad_s * segment.command_s)
    noise_deg = np.random.default_rng(0).normal(0.0, 0.1, segment.measured_s.size)
    moved_deg = PLANE.model("rudder").simulate(segment.command_s, asked_deg, segment.measured_s) + noise_deg
    values, missing, _ = estimate_flight(flown(command_deg=asked_deg, measured_deg=moved_deg), PLANE)
    assert abs(values["dead_band_deg"].value) < 0.05
    truth = {"delay_s": 0.004, "bandwidth_hz": 28.49 / (2.0 * np.pi)}
    for name, value in truth.items():
        if rad_s < 1.0 or name in missing:
            assert missing[name] == "its motion shows no more of it than is known of any servo"
        else:
            assert values[name].low < value < values[name].high


@pytest.mark.slow
def test_a_flight_in_which_the_surface_jammed_is_no_account_of_its_servo() -> None:
    """No line runs through its dead band, which a fit puts at -63 deg; what was found is said, and it is an alarm."""
    flights = [f"sample_logs/faser_{name}_flight.mat" for name in ("healthy", "stuck")]
    seen = trend_logs(flights, "faser", surfaces=("elevator",), workers=0)
    elevator = seen.surfaces[0]
    assert seen.order.logs[1].path.endswith("faser_stuck_flight.mat")
    assert elevator.quantities["dead_band_deg"].flights.number.tolist() == [1]
    assert elevator.quantities["residual_p95_deg"].flights.number.tolist() == [1, 2]
    assert elevator.missing["rate_limit_deg_s"] == "stood still for a part of the flight"
    assert not {"effect", "offset_us"} & set(elevator.missing)
    assert seen.has_alarm
    assert "stuck" in trend_document(seen)["flights"][1]["alarms"]["elevator"]


def test_a_short_flight_is_refused() -> None:
    whole = flown()
    short = Series(
        "rudder", whole.command_s[:200], whole.command_deg[:200], whole.measured_s[:200], whole.measured_deg[:200]
    )
    with pytest.raises(NoMeasurement, match="too short a flight"):
        estimate_flight(short, PLANE)


def test_logs_are_ordered_by_time_if_all_tell_it_and_by_name_if_not() -> None:
    made = logs([0.0] * 12, START)
    shuffled = [made[k] for k in np.random.default_rng(0).permutation(12)]
    assert in_order(shuffled).logs == tuple(made)
    assert in_order(shuffled).by == "time"
    silent = [*made[:11], logs([0.0] * 12)[11]]
    assert in_order(silent).by == "name"
    assert "1 of 12 do not tell" in in_order(silent).reason
    assert [log.path for log in in_order(silent).logs][:3] == ["flight1.csv", "flight2.csv", "flight3.csv"]


def test_a_swap_in_the_aircraft_file_begins_another_servo() -> None:
    entry = PLANE.surfaces["rudder"].model_dump(exclude_defaults=True)
    entry |= {"serial": "B02", "swaps": [{"date": datetime.date(2026, 5, 11), "removed": "A17"}]}
    plane = Aircraft.model_validate({"surfaces": {"rudder": {"servo": "hs225bb-eq31", **entry}}})
    seen = trend_of(logs([0.05] * 20, START), plane).surfaces[0]
    assert seen.serials == ((1, "A17"), (11, "B02"))
    assert [(p.first, p.last) for p in seen.quantities["dead_band_deg"].pieces] == [(1, 10), (11, 20)]
    undated = trend_of(logs([0.05] * 20), plane).surfaces[0]
    assert undated.serials == ((1, "B02"),)
    assert "not every log holds the date of its flight" in undated.notes[0]


def test_logs_of_several_vehicles_are_refused() -> None:
    mixed = [*logs([0.0] * 3, identity="ArduPlane, system 1"), *logs([0.0] * 3, identity="ArduPlane, system 2")]
    with pytest.raises(ConfigError, match="2 vehicles, a trend follows one"):
        trend_of(mixed, PLANE)


@pytest.mark.parametrize(
    ("line", "why"),
    [
        ("swaps = [{ date = 2026-05-02 }, { date = 2026-05-01 }]", "the dates must rise"),
        ('swaps = [{ date = "soon" }]', "swaps.0.date"),
        ("swaps = [{ day = 2026-05-02 }]", "date"),
        ("limits = { dead_band_deg = -1.0 }", "limits.dead_band_deg"),
        ("limits = { deadband_deg = 1.0 }", "did you mean dead_band_deg"),
        ("serial = 17", "serial"),
    ],
)
def test_wrong_keys_of_the_aircraft_file_are_told(tmp_path: Path, line: str, why: str) -> None:
    text = '[surfaces.rudder]\ncommand = { channel = "c", unit = "deg" }\n'
    (tmp_path / "plane.toml").write_text(text + line + "\n")
    with pytest.raises(ConfigError, match=why):
        load_aircraft(tmp_path / "plane.toml")


def test_the_command_line_prints_writes_and_returns_what_it_found(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = trend_of(logs([0.02 * number for number in range(1, 41)], START), PLANE)
    monkeypatch.setattr("servofd.cli.trend.trend_logs", lambda *_, **__: seen)
    words = ["trend", "flights", "-c", "faser", "--json", str(tmp_path / "t.json"), "--html", str(tmp_path / "t.html")]
    assert main(words) == 1
    printed = capsys.readouterr().out
    assert "40 flights, by the UTC time at which each log begins" in printed
    assert "rudder: dead band, friction and play together, full width crosses its limit at flight 100 [" in printed
    document = json.loads((tmp_path / "t.json").read_text())
    found = document["surfaces"]["rudder"]["quantities"]["dead_band_deg"]
    assert document["schema"] == "servofd.trend/1"
    assert found["per_flight"]["value"] == pytest.approx(0.02, rel=0.1)
    assert found["forecast"]["low"] < 100.0 < found["forecast"]["high"]
    assert "crosses its limit at flight" in (tmp_path / "t.html").read_text()


@pytest.mark.slow
def test_the_page_begins_with_the_worst_surface() -> None:
    document = trend_document(trend_of(logs([0.02 * number for number in range(1, 41)], START), PLANE))
    calm = json.loads(json.dumps(document["surfaces"]["rudder"]))
    for quantity in calm["quantities"].values():
        quantity["forecast"] = {"kind": "none", "reason": "no trend"}
    document["surfaces"] = {"aileron": calm, "rudder": document["surfaces"]["rudder"]}
    text = html_page(trend_report(document))
    assert 0 < text.index("<h2>rudder ") < text.index("<h2>aileron ")


def test_nothing_to_follow_is_said_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for words in (
        ["trend", str(tmp_path), "-c", "faser"],
        ["trend", str(tmp_path / "*.bin"), "-c", "faser"],
        ["trend", str(tmp_path), "-c", "no_such_plane"],
        ["trend", str(tmp_path), "-c", "faser", "-s", "wing"],
    ):
        assert main(words) == 2
        printed = capsys.readouterr()
        assert printed.out == ""
        assert len(printed.err.splitlines()) == 1


@pytest.mark.slow
def test_growing_dead_band_is_measured_and_forecast() -> None:
    """Servos of another simulator, with scatter, jitter and losses; 0.02 deg per flight, 2 deg at flight 100."""
    seen = widths_trend(0, [0.02 * number for number in range(1, 26)])
    slope = seen.surfaces[0].quantities["dead_band_deg"].slope
    assert slope is not None
    assert slope.value == pytest.approx(0.02, rel=0.1)
    assert crossing_at(seen) == pytest.approx(100.0, abs=5.0)


@pytest.mark.slow
def test_a_swap_is_recognised_and_is_no_wear() -> None:
    grown = [0.02 * number for number in range(1, 26)]
    seen = widths_trend(0, [*grown, *grown[:10]], swap=26, duration_s=30.0)
    assert [(event.kind, event.first) for event in seen.surfaces[0].events] == [("swap", 26)]


@pytest.mark.nightly
def test_healthy_fleets_raise_no_alarm() -> None:
    """Two here; a hundred in benchmarks/trend_fleets.py."""
    assert not any(healthy_fleet(seed, servos=2, flights=12, duration_s=12.0).has_alarm for seed in range(2))


@pytest.mark.parametrize("count", [1, 9])
def test_a_servo_that_failed_in_the_last_flight_is_beyond_its_limit_though_no_line_moves(count: int) -> None:
    seen = trend_of(logs([*[0.2] * (count - 1), 4.0]), PLANE)
    assert seen.has_alarm
    page = html_page(trend_report(trend_document(seen)))
    assert "friction and play together, full width was beyond its limit in the last flight" in page
    assert not trend_of(logs([*[0.2] * (count - 1), 4.0, 0.2]), PLANE).has_alarm
