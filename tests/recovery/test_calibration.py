"""Calibration on one flight: hidden servos found again, and fresh flights of the same servo without false alarms.

The servos are simulated by `benchmarks/fleet.py` and `benchmarks/strangers.py`, which have nothing in common with
servofd's kernels.
"""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from calibration_campaign import segment_of
from strangers import SIZES, SURFACES, Failure, Stranger, draw_failure, fly, stranger

from fleet import FleetServo, deflection, flight
from hidden_physics import hidden
from servofd.aircraft.marks import NO_OTHERS, Rows, Why, marked
from servofd.aircraft.priors import NAMES, PRIORS
from servofd.aircraft.schema import Aircraft, plain_aircraft
from servofd.aircraft.series import Series
from servofd.calibrating.calibrate import calibrate_aircraft
from servofd.calibrating.result import Calibration
from servofd.core.errors import CalibrationError
from servofd.core.series import latest
from servofd.core.types import FloatArray
from servofd.detection.audit import audit_segment
from servofd.detection.flights import Flight
from servofd.detection.monitor import SurfaceMonitor
from servofd.detection.stream import Piece
from servofd.detection.verdict import Fault, SurfaceAudit
from servofd.estimate.family import new_state, simulated, variants
from servofd.servo.catalogue import effect_of
from servofd.servo.context import Context
from servofd.servo.effect import Effect
from servofd.servo.faults import Stuck
from servofd.simulation.commands import COMMANDS
from servofd.simulation.flight import simulate_flight

STYLES = ("gusty", "calm", "hand_flown", "cruise")


def flown(servo: FleetServo, seed: int, style: str, duration_s: float = 120.0) -> Series:
    """One more flight of the same servo, with jitter, lost rows, noise and a coarse converter."""
    rng = np.random.default_rng([seed, 77])
    grid_s = np.arange(round(duration_s * 100.0)) / 100.0
    command_deg = COMMANDS[style](grid_s, rng)
    time_s = np.maximum(grid_s + rng.uniform(-servo.jitter_s, servo.jitter_s, grid_s.size), 0.0)
    kept = rng.random(grid_s.size) >= servo.loss
    position_deg = deflection(servo, time_s, command_deg) + servo.bias_deg
    position_deg = position_deg + servo.noise_deg * rng.standard_normal(grid_s.size)
    if servo.step_deg:
        position_deg = servo.step_deg * np.round(position_deg / servo.step_deg)
    return Series("x", time_s[kept], command_deg[kept], time_s[kept], position_deg[kept])


def calibrated(*segments: Series) -> Calibration:
    return calibrate_aircraft(
        plain_aircraft(["x"], "hs225bb-eq31"), {"x": [Flight(f"{k}.csv", s) for k, s in enumerate(segments)]}
    )


def judged(aircraft: Aircraft, segment: Series) -> SurfaceAudit:
    surface = aircraft.surfaces["x"]
    assert surface.measured is not None
    read = replace(segment, surface="x", measured_deg=surface.measured.to_deg(segment.measured_deg))
    return audit_segment(read, aircraft, duration_s=segment.duration_s)


def followed(aircraft: Aircraft, segment: Series) -> tuple[tuple[Fault, ...], FloatArray]:
    """What a monitor finds, ten samples at a time: faults, and residuals [deg]."""
    monitor = SurfaceMonitor("x", aircraft.surfaces["x"], aircraft.model("x"))
    assert ("airspeed_m_s" in monitor.needs) == bool(segment.context.airspeed_s.size)  # as in its good flights
    monitor.surroundings(segment.context)
    pieces: list[Piece] = []
    monitor.listener = lambda _name, piece, _asked: pieces.append(piece)
    rows = [(t, 0, v) for t, v in zip(segment.command_s, segment.command_deg, strict=True)]
    rows += [(t, 1, v) for t, v in zip(segment.measured_s, segment.measured_deg, strict=True)]
    samples = np.array(sorted(rows))
    for some in np.array_split(samples, len(samples) // 10):
        asked, seen = (some[some[:, 1] == role] for role in (0, 1))
        monitor.feed((asked[:, 0], asked[:, 2]), (seen[:, 0], seen[:, 2]))
        if look := monitor.due():
            monitor.events_of(look, look.find())
    monitor.finish()
    return monitor.faults, np.concatenate([piece.residuals.residual_deg for piece in pieces])


def of_stranger(
    aircraft: Stranger, number: int, style: str, surface: str, failure: Failure | None = None, until_s: float = np.inf
) -> Series:
    log = fly(aircraft, number, style, duration_s=240.0 if style == "mixed" else 120.0, failure=failure)
    place = SURFACES.index(surface)
    context = Context(log.command_s, log.airspeed_m_s, log.command_s, log.supply_v)
    asked, seen = log.command_s < until_s, log.position_s < until_s
    return Series(
        "x", log.command_s[asked], log.command_deg[asked, place], log.position_s[seen], log.position_deg[seen, place],
        context=context,
    )  # fmt: skip


@pytest.mark.slow
def test_hidden_numbers_are_found() -> None:
    servo = FleetServo(gain=0.97, delay_s=0.007, bandwidth_scale=1.1, bias_deg=-0.25, noise_deg=0.1, jitter_s=0.002)
    (one,) = calibrated(flown(servo, 0, "gusty")).surfaces
    scale, shift_deg = one.measured.correction
    assert 1.0 / scale == pytest.approx(0.97, abs=0.01)
    assert shift_deg == pytest.approx(0.25 / 0.97, abs=0.03)
    assert one.servo.transfer.bandwidth_rad_s / plain_aircraft(["x"], "hs225bb-eq31").servo(
        "x"
    ).transfer.bandwidth_rad_s == (pytest.approx(1.1, rel=0.1))
    bandwidth_rad_s = 1.1 * 28.49
    assert one.bandwidth_rad_s.low <= bandwidth_rad_s <= one.bandwidth_rad_s.high < 1.1 * bandwidth_rad_s
    assert one.known.noise.still_deg == pytest.approx(0.1, rel=0.15)
    assert one.held_out_rms_deg == pytest.approx(0.1, rel=0.15)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.nightly)])
@pytest.mark.parametrize(
    ("effect", "width_deg", "key"),
    [
        (effect_of("backlash", {"width_deg": 0.3}), 0.3, "play_deg"),
        pytest.param(effect_of("backlash", {"width_deg": 1.0}), 1.0, "play_deg", marks=pytest.mark.nightly),
        pytest.param(effect_of("deadband", {"width_deg": 0.4}), 0.4, "deadband_deg", marks=pytest.mark.nightly),
        pytest.param(effect_of("deadband", {"width_deg": 1.0}), 1.0, "deadband_deg", marks=pytest.mark.nightly),
        (effect_of("friction", {"friction_deg": 0.8}), 1.6, "friction_deg"),
    ],
)
def test_play_dead_band_and_friction_are_told_with_what_they_may_be(
    effect: Effect, width_deg: float, key: str, seed: int
) -> None:
    plane = plain_aircraft(["x"], "s9254")
    log = simulate_flight(plane, duration_s=120.0, seed=seed, noise_deg=0.05, effects={"x": [effect]})
    segment = Series("x", log.time_s, log.command_deg[:, 0], log.time_s, log.measured_deg[:, 0])
    (one,) = calibrated(segment).surfaces
    dead, rub, loose = (one.estimates[name] for name in ("deadband_deg", "friction_deg", "play_deg"))
    assert dead.value + 2.0 * rub.value + loose.value == pytest.approx(width_deg, rel=0.1)
    name = {"play_deg": "play", "deadband_deg": "dead band", "friction_deg": "friction"}[key]
    told = one.effects[0]
    assert told.startswith(name) or (name in told and "which may be" in told)  # dead band and friction rest alike
    size = width_deg / 2.0 if key == "friction_deg" else width_deg
    assert one.estimates[key].low - 0.05 * size <= size <= one.estimates[key].high + 0.05 * size


@pytest.mark.slow
def test_a_dead_band_that_moves_like_friction_may_be_either() -> None:
    """A motor of three poles, which the fitted servo has not: half of one looks like friction while it follows."""
    log = hidden(4004, {"deadband": {"width_deg": 0.67}}, "flight", duration_s=120.0)
    (one,) = calibrated(Series("x", log.time_s, log.command_deg, log.time_s, log.measured_deg)).surfaces
    assert one.estimates["deadband_deg"].low < 0.67 < one.estimates["deadband_deg"].high
    assert one.estimates["friction_deg"].low < 0.0
    assert one.effects[0].endswith("which may be dead band")
    assert one.estimates["play_deg"].high < 0.2


@pytest.mark.slow
def test_small_faults_are_found_and_named() -> None:
    servo = flight(101, "gusty").servo
    aircraft = calibrated(flown(servo, 0, "gusty")).aircraft
    healthy = flown(servo, 1, "gusty", 60.0)
    off_deg = np.where(healthy.measured_s > 30.0, 1.0, 0.0)
    (fault,) = judged(aircraft, replace(healthy, measured_deg=healthy.measured_deg + off_deg)).faults
    assert fault.kind == "bias"
    assert fault.start_s == pytest.approx(30.0, abs=0.3)
    assert fault.alarm_s == pytest.approx(30.0, abs=2.5)
    assert fault.parameters["bias_deg"].value == pytest.approx(1.0, abs=0.2)


@pytest.mark.slow
def test_a_flight_that_turns_bad_is_refused() -> None:
    healthy = flown(FleetServo(noise_deg=0.1), 0, "gusty")
    weak = np.where(healthy.measured_s > 80.0, 0.6, 1.0)
    with pytest.raises(CalibrationError, match="not a good flight"):
        calibrated(replace(healthy, measured_deg=weak * healthy.measured_deg))
    wobble_deg = np.where(healthy.measured_s > 60.0, 2.0 * np.sin(20.0 * healthy.measured_s), 0.0)
    with pytest.raises(CalibrationError, match="oscillates"):
        calibrated(replace(healthy, measured_deg=healthy.measured_deg + wobble_deg))


@pytest.mark.nightly
@pytest.mark.parametrize("seed", [200, 206])
def test_a_fault_of_any_kind_in_the_middle_of_a_good_flight_is_refused_with_its_time(seed: int) -> None:
    """A good and a cheap servo; each fault bends the servo that is fitted to the whole flight."""
    for place, kind in enumerate(SIZES):
        failure = draw_failure(7000 * seed + place, 240.0, kind, "large")
        flown_so = fly(stranger(seed), 50 + place, "mixed", failure=failure)
        segment = replace(segment_of(flown_so, failure.surface), surface="x")
        with pytest.raises(CalibrationError, match="not a good flight") as refused:
            calibrated(segment)
        found = re.search(r"(?:since|from) ([\d.]+) ", str(refused.value))
        assert found is not None
        assert failure.start_s - 1.0 < float(found[1]) < failure.start_s + 8.0


@pytest.mark.slow
def test_what_was_calibrated_on_the_ground_is_not_judged_in_the_air() -> None:
    origin = stranger(210)
    ground = replace(segment_of(fly(origin, 1, "taxi"), "elevator"), surface="x")
    found = calibrated(ground)
    assert any("is not judged" in note for note in found.surfaces[0].notes)
    assert judged(found.aircraft, ground).status == "healthy"
    for style in ("cruise", "aerobatics"):
        verdict = judged(
            found.aircraft, replace(segment_of(fly(origin, 2, style, duration_s=90.0), "elevator"), surface="x")
        )
        assert verdict.status == "unknown"
        assert "calibrate it on one that is as fast" in verdict.reason


@pytest.mark.slow
def test_positions_that_pause_are_no_change_of_the_servo() -> None:
    healthy = flown(FleetServo(noise_deg=0.05, bias_deg=4.0), 0, "gusty", 60.0)
    t = healthy.measured_s
    heard = (t < 30.0) | (t > 37.3)
    paused = replace(healthy, measured_s=t[heard], measured_deg=healthy.measured_deg[heard])
    aircraft = calibrated(paused).aircraft
    verdict = judged(aircraft, paused)
    assert verdict.status == "healthy"
    assert verdict.residuals is not None
    assert float(np.nanmax(np.abs(verdict.residuals.residual_deg))) < 0.5
    assert followed(aircraft, paused)[1] == pytest.approx(verdict.residuals.residual_deg, abs=1e-9, nan_ok=True)


@pytest.mark.slow
def test_sticks_at_their_ends_for_a_moment_do_not_hide_a_servo_s_travel() -> None:
    """Before take-off, in positions that are few: the reach that was seen is that of 99.8 % of them."""
    healthy = flown(FleetServo(noise_deg=0.05), 0, "gusty", 80.0)
    far = healthy.command_s < healthy.command_s[0] + 0.04
    assert "x" in calibrated(replace(healthy, command_deg=np.where(far, 90.0, healthy.command_deg))).aircraft.surfaces


@pytest.mark.slow
@pytest.mark.parametrize("seed", [pytest.param(1, marks=pytest.mark.nightly), 3])
def test_a_jam_of_most_of_the_flight_is_refused_with_its_time(seed: int) -> None:
    plane = plain_aircraft(["x"], "s9254")
    log = simulate_flight(plane, seed=seed, faults={"x": Stuck(20.0)})
    segment = Series("x", log.time_s, log.command_deg[:, 0], log.time_s, log.measured_deg[:, 0])
    with pytest.raises(CalibrationError, match="not a good flight") as refused:
        calibrated(segment)
    found = re.search(r"since ([\d.]+) s", str(refused.value))
    assert found is not None
    assert float(found[1]) == pytest.approx(20.0, abs=0.5)


@pytest.mark.nightly
def test_flights_of_two_servos_are_refused() -> None:
    one, other = (flown(FleetServo(noise_deg=0.1, gain=gain), 0, "gusty") for gain in (1.0, 0.6))
    with pytest.raises(CalibrationError, match="not the same aircraft"):
        calibrated(one, other)


@pytest.mark.slow
def test_more_flights_measure_what_differs_between_them() -> None:
    servo = FleetServo(noise_deg=0.1)
    (one,) = calibrated(flown(servo, 0, "gusty")).surfaces
    (many,) = calibrated(*(flown(servo, seed, "gusty") for seed in range(4))).surfaces
    assert many.known.covariance[0, 0] < one.known.covariance[0, 0]
    # What one flight foresees of four comes true, and they foresee no more.
    now, then = one.detectable, many.detectable
    for wording, unit, before, after in (
        (r"an offset of ([\d.]+) deg", 1.0, now.bias_deg, then.bias_deg),
        (r"the loss of (\d+)% of", 0.01, now.loss_share, then.loss_share),
        (r"keeps (\d+)% of its speed", 0.01, now.slow_share, then.slow_share),
    ):
        assert before is not None
        told = re.search(wording, one.sharper)
        assert after == pytest.approx(unit * float(told[1]) if told else before, rel=0.1)
    assert "an offset of" in one.sharper
    assert many.sharper.startswith("12 more flights like these would show hardly less")


@pytest.mark.slow
@pytest.mark.parametrize(
    "style", ["gusty", *(pytest.param(each, marks=pytest.mark.nightly) for each in ("calm", "hand_flown"))]
)
@pytest.mark.parametrize("number", [0, pytest.param(1, marks=pytest.mark.nightly)])
def test_no_false_alarm_in_fresh_flights(style: str, number: int) -> None:
    servo = flight(100 + number, style).servo
    aircraft = calibrated(flown(servo, 0, style)).aircraft
    fresh = [judged(aircraft, flown(servo, seed, other)) for seed in (1, 2, 3) for other in STYLES]
    assert [fault for verdict in fresh for fault in verdict.faults] == []


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3, pytest.param(5, marks=pytest.mark.nightly)])
def test_motors_with_friction_play_and_load_are_quiet_and_their_faults_are_named(seed: int) -> None:
    """Good and cheap servos of an aircraft that shares no physics with the model."""
    aircraft = stranger(seed)
    known = calibrated(of_stranger(aircraft, 1, "mixed", "elevator")).aircraft
    for style in ("taxi", "cruise", "turbulence", "aerobatics"):
        assert judged(known, of_stranger(aircraft, 2, style, "elevator")).faults == (), style
    for kind, size in (("stuck", 1.0), ("bias", 1.5), ("oscillation", 1.5), ("loss_of_effectiveness", 0.4)):
        bad = of_stranger(aircraft, 3, "turbulence", "elevator", Failure(kind, "elevator", 60.0, size))
        first = judged(known, bad).faults[0]
        assert kind in (first.kind, *first.alternatives), (kind, first)
        assert first.alarm_s == pytest.approx(60.0, abs=8.0)


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "name"), [(3, "elevator"), pytest.param(9, "rudder", marks=pytest.mark.nightly)])
def test_a_servo_calibrated_on_half_a_minute_is_quiet_in_other_flights(seed: int, name: str) -> None:
    """Half a minute shows less than flights do."""
    short = of_stranger(stranger(seed), 1, "mixed", name, until_s=30.0)
    known = calibrated(short).aircraft
    for style in ("taxi", "turbulence", "aerobatics"):
        assert judged(known, of_stranger(stranger(seed), 2, style, name)).faults == (), style


@pytest.mark.slow
def test_a_servo_whose_neutral_is_far_from_zero_is_calibrated_as_well() -> None:
    """Bends of its reading are those of the angles seen: the cube of 180 deg would be anything."""
    servo = FleetServo(noise_deg=0.1)
    segments = [flown(servo, seed, "gusty") for seed in (1, 2)]
    away = [replace(s, command_deg=s.command_deg + 180.0, measured_deg=s.measured_deg + 180.0) for s in segments]
    found = calibrated(away[0])
    verdict = judged(found.aircraft, away[1])
    assert verdict.status == "healthy", verdict.reason
    assert verdict.detectable.bias_deg is not None
    assert verdict.detectable.bias_deg < 6.0


def test_an_overbalanced_surface_stays_a_number() -> None:
    """With half its torque the servo of the test of a weak motor loses the surface to the air; the test goes on."""
    theta = np.array([prior.value for prior in PRIORS])
    theta[NAMES.index("hinge")] = -0.3
    time_s = np.arange(0.0, 60.0, 0.02)
    command_deg = 10.0 * np.sin(time_s)
    table = variants(theta)
    position_deg, _ = simulated(
        table, new_state(table.shape[0]), (time_s, command_deg, 0.0 * time_s), time_s, np.full(time_s.size, 3.0),
        np.ones(time_s.size), np.where(time_s == 0.0, 0.0, np.nan),
    )  # fmt: skip
    assert np.abs(position_deg).max() <= 400.0


@pytest.mark.nightly
def test_a_stream_finds_what_an_audit_finds() -> None:
    aircraft = stranger(3)
    known = calibrated(of_stranger(aircraft, 1, "mixed", "rudder")).aircraft
    segment = of_stranger(aircraft, 4, "turbulence", "rudder", Failure("bias", "rudder", 60.0, 2.0))
    segment = segment.at(np.isfinite(segment.measured_deg))
    nobody, never = np.full(segment.measured_s.size, NO_OTHERS), np.zeros(segment.measured_s.size, dtype=np.int8)
    asked_deg = latest(segment.command_s, segment.command_deg, segment.measured_s)
    why, _ = marked(Rows(segment.measured_s, segment.measured_deg, asked_deg, nobody, never))
    verdict = judged(known, segment.at(why == Why.COUNTS))  # what a log leaves out a monitor leaves out itself
    faults, streamed = followed(known, segment)
    assert verdict.residuals is not None
    np.testing.assert_allclose(streamed, verdict.residuals.residual_deg, rtol=0.0, atol=1e-9)
    assert faults == verdict.faults
