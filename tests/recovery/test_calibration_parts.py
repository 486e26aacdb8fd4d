"""Parts of a calibration, each by itself: what is no good flight, what is unusual, how wide thresholds become."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from servofd.aircraft import Aircraft, plain_aircraft
from servofd.calibrating.calibrate import calibrate_aircraft
from servofd.calibrating.fit import ServoFit
from servofd.calibrating.flights import Flight
from servofd.calibrating.levels import MARGIN, Terms, levels_for, widened
from servofd.calibrating.order import runs_ahead
from servofd.calibrating.servo import FlownServo
from servofd.calibrating.sound import _gross, _loud, _stranger
from servofd.calibrating.still import stands_still
from servofd.calibrating.stretches import Stretch
from servofd.calibrating.surface import _check_fit, _check_scale, _notes, hardly_moved
from servofd.detection.bank.explanation import Estimate
from servofd.errors import CalibrationError
from servofd.segment import Segment
from servofd.servos import servo_named
from servofd.simulation.commands import COMMANDS
from servofd.tolerance import Tolerance
from servofd.types import FloatArray

TIME_S: FloatArray = np.arange(0.0, 20.0, 0.01)
SWEEP_DEG: FloatArray = 10.0 * np.sin(TIME_S**1.4)
TIGHT = Tolerance(gain=0.0, delay_s=0.0, bandwidth=0.0, rate=0.0, bias_deg=0.0, noise_deg=0.0)


def stretches(label: str, *deviations: tuple[float, float, float, float]) -> list[Stretch]:
    """Two seconds each, known to a hundredth of what would be strange."""
    doubt = np.array([1e-3, 1e-4, 3e-3, 1e-2])
    return [Stretch(label, 2.0 * k, 2.0 * k + 2.0, np.array(d), doubt, 20.0) for k, d in enumerate(deviations)]


USUAL = (0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("strange", "words"),
    [
        ((0.2, 0.0, 0.0, 0.0), "gain 1.20 against gain 1.00 in another flight"),
        ((0.0, -0.03, 0.0, 0.0), "delay -30 ms against delay +0 ms"),
        ((0.0, 0.0, -0.5, 0.0), "bandwidth -50% against bandwidth +0%"),
        ((0.0, 0.0, 0.0, 2.0), "bias +2.0 deg against bias +0.0 deg"),
    ],
)
def test_a_flight_of_another_aircraft_is_told(strange: tuple[float, float, float, float], words: str) -> None:
    three = [*stretches("a", *[USUAL] * 4), *stretches("b", *[strange] * 4), *stretches("c", *[USUAL] * 4)]
    found = _stranger(three)
    assert found is not None
    assert (found[0].label, found[0].from_s) == ("b", 0.0)
    assert found[1].startswith(words)


def test_flights_of_one_aircraft_may_differ_as_a_fleet_does() -> None:
    other = (0.05, 0.005, 0.1, 0.5)
    assert _stranger([*stretches("a", *[USUAL] * 4), *stretches("b", *[other] * 4)]) is None
    assert _stranger(stretches("a", *[USUAL] * 4)) is None


@pytest.mark.parametrize(("labels", "rest"), [("aa", "the rest of the flight"), ("ab", "the other flights")])
def test_seconds_with_another_servo_are_told(labels: str, rest: str) -> None:
    late = (0.0, 0.05, 0.0, 0.0)
    found = _gross([*stretches(labels[0], *[USUAL] * 4), *stretches(labels[1], USUAL, late, USUAL)])
    assert found is not None
    assert (found[0].label, found[0].from_s) == (labels[1], 2.0)
    assert found[1].startswith(f"delay +50 ms against {rest}")


def test_seconds_that_differ_little_or_are_alone_are_none_of_another_servo() -> None:
    assert _gross(stretches("a", *[USUAL] * 4, (0.1, 0.015, 0.2, 1.0))) is None
    assert _gross(stretches("a", (0.5, 0.0, 0.0, 0.0))) is None


def terms(residual_deg: FloatArray, by_tolerance: FloatArray | None = None, sigma_deg: float = 0.0) -> Terms:
    """A threshold of 1 deg where nothing else widens it."""
    size = residual_deg.size
    by_tolerance = np.zeros((size, 4)) if by_tolerance is None else by_tolerance
    time_s = np.arange(size) / 50.0
    return Terms(residual_deg, np.ones(size), np.full(size, sigma_deg), by_tolerance, np.zeros(size), time_s)


@pytest.mark.parametrize(("peak_deg", "is_told"), [(1.3, False), (2.0, True)])
def test_seconds_in_which_only_the_residual_is_strange_are_told(peak_deg: float, is_told: bool) -> None:
    residual_deg = np.full(400, 0.5)
    residual_deg[120] = peak_deg
    flights: Any = [SimpleNamespace(flight=SimpleNamespace(label="a"))]
    found = _loud(flights, stretches("a", *[USUAL] * 4), terms(residual_deg), TIGHT, 3.0)
    if not is_told:
        assert found is None
        return
    assert found is not None
    assert (found[0].from_s, found[1]) == (2.0, "the residual reaches 2.0 times what the other stretches need")
    assert _loud(flights, stretches("a", USUAL), terms(residual_deg), TIGHT, 3.0) is None


@pytest.mark.parametrize("seed", range(5))
def test_after_widening_every_residual_has_its_margin_and_nothing_is_wider_than_needed(seed: int) -> None:
    rng = np.random.default_rng(seed)
    by_tolerance = np.abs(rng.standard_normal((500, 4))) + np.array([0.0, 0.0, 0.0, 1.0])
    given = terms(2.0 * rng.standard_normal(500), by_tolerance, sigma_deg=0.05)
    wider = widened(given, TIGHT, 3.0)
    level_deg = given.tolerated_deg(wider) + 3.0 * given.sigma_deg
    left_deg = level_deg - MARGIN * np.abs(given.residual_deg)
    assert left_deg.min() > -1e-9
    assert left_deg.min() < 0.01
    assert widened(given, wider, 3.0) == wider


def test_what_no_habit_explains_becomes_a_bias() -> None:
    given = terms(np.array([0.1, 4.0, 0.1]))
    assert widened(given, TIGHT, 0.0).bias_deg == pytest.approx(MARGIN * 4.0 - 1.0)


def test_two_hours_of_flight_show_the_level_that_is_passed_at_the_wanted_rate() -> None:
    """White noise at 50 Hz with heavy tails: a Gaussian level of 3 deviations would be passed far more often."""
    rng = np.random.default_rng(1)
    given = terms(0.2 * rng.standard_t(5, 400_000), sigma_deg=0.2)
    given = given._replace(base_deg=np.zeros(given.residual_deg.size))
    found = levels_for(given, TIGHT, 20.0, 3.0, 0.02)
    passed = np.flatnonzero(np.abs(given.residual_deg) > found.sigmas * 0.2)
    alarms = 1 + np.count_nonzero(np.diff(passed) > 8)
    assert found.hours == pytest.approx(400_000 / 50.0 / 3600.0)
    assert not found.extrapolated
    assert alarms / found.hours == pytest.approx(20.0, rel=0.35)
    assert found.constant_deg >= MARGIN * np.abs(given.residual_deg).max()
    short = levels_for(Terms(*(values[:1000] for values in given)), TIGHT, 20.0, 3.0, 0.02)
    assert (short.sigmas, short.extrapolated) == (3.0, True)


def flight(measured_deg: FloatArray, command_deg: FloatArray = SWEEP_DEG, time_s: FloatArray = TIME_S) -> Flight:
    return Flight("a.csv", Segment("rudder", time_s, command_deg, time_s, measured_deg))


def test_too_slow_too_short_and_at_rest() -> None:
    assert hardly_moved([flight(SWEEP_DEG)]) == ""
    slow = flight(SWEEP_DEG, SWEEP_DEG, 10.0 * TIME_S)
    assert "position comes at 10 Hz; a calibration needs 15 Hz" in hardly_moved([slow])
    assert "only 2.0 s of flight" in hardly_moved([flight(SWEEP_DEG[:200], SWEEP_DEG[:200], TIME_S[:200])])
    assert "the command moves by 0 deg only" in hardly_moved([flight(SWEEP_DEG, 0.0 * SWEEP_DEG)])


def test_of_next_to_nothing_neither_order_nor_rest_is_said() -> None:
    two = flight(SWEEP_DEG[:2], SWEEP_DEG[:2], TIME_S[:2])
    still = flight(0.0 * SWEEP_DEG, 0.0 * SWEEP_DEG)
    unlike = flight(np.random.default_rng(0).standard_normal(TIME_S.size))
    assert [runs_ahead(one) for one in (two, still, unlike)] == ["", "", ""]
    assert [stands_still(one) for one in (two, still, unlike)] == ["", "", ""]


PRIOR = FlownServo.of(servo_named("hs225bb-eq31"))


def fit(gain: float = 1.0, **changed: float) -> ServoFit:
    servo = replace(PRIOR, bandwidth_hz=changed.pop("bandwidth_hz", PRIOR.bandwidth_hz))
    there = Estimate(gain, gain - 0.01, gain + 0.01)
    numbers = {"noise_deg": 0.1, "error_rms_deg": 0.1} | changed
    return ServoFit(servo, there, Estimate(0.0, -0.1, 0.1), {}, {}, **numbers)


@pytest.mark.parametrize(
    ("found", "words"),
    [
        (fit(), []),
        (fit(-1.0), ["runs against the command"]),
        (fit(1.3), ["moves 1.30 times as far"]),
        (fit(bandwidth_hz=3.0 * PRIOR.bandwidth_hz), ["3 times the bandwidth"]),
        (fit(error_rms_deg=0.6), ["leaves 0.6 deg rms, the noise is 0.1 deg"]),
        (fit(-0.7, bandwidth_hz=1.0), ["runs against", "moves 0.70 times", "times the bandwidth"]),
    ],
)
def test_what_is_unusual_is_noted(found: ServoFit, words: list[str]) -> None:
    notes = _notes(found, PRIOR)
    assert len(notes) == len(words)
    assert all(word in note for word, note in zip(words, notes, strict=True))


def test_what_no_calibration_corrects_is_refused() -> None:
    for gain in (0.49, -2.1):
        with pytest.raises(CalibrationError, match="check units and channels"):
            _check_scale("rudder", fit(gain))
    _check_scale("rudder", fit(-0.51))
    with pytest.raises(CalibrationError, match=r"the best servo leaves 2\.5 deg rms"):
        _check_fit("rudder", fit(error_rms_deg=2.5), [flight(SWEEP_DEG)])
    _check_fit("rudder", fit(error_rms_deg=1.5), [flight(SWEEP_DEG)])


def test_surfaces_that_cannot_be_calibrated_are_told_each_with_its_reason() -> None:
    plane = plain_aircraft(["rudder", "elevator", "aileron"])
    with pytest.raises(CalibrationError) as refused:
        calibrate_aircraft(plane, {"elevator": [], "rudder": [flight(SWEEP_DEG, 0.0 * SWEEP_DEG)]})
    message = str(refused.value)
    assert "aileron: not asked for" in message
    assert "elevator: no measured deflection" in message
    assert "rudder: the command moves by 0 deg only" in message


def test_a_servo_with_effects_is_taken_as_it_is_known() -> None:
    """Play of 0.8 deg in the file: no number of the servo is fitted anew, and the flight needs no wide threshold."""
    entry = plain_aircraft(["rudder"]).model_dump(exclude_unset=True)
    entry["surfaces"]["rudder"]["effects"] = {"backlash": {"width_deg": 0.8}}
    plane = Aircraft.model_validate(entry)
    rng = np.random.default_rng(2)
    command_deg = COMMANDS["lively"](TIME_S, rng)
    measured_deg = plane.model("rudder").simulate(TIME_S, command_deg, TIME_S) + 0.05 * rng.standard_normal(TIME_S.size)
    (one,) = calibrate_aircraft(plane, {"rudder": [flight(measured_deg, command_deg)]}).surfaces
    assert set(one.fit.kept) == set(PRIOR.numbers)
    assert (one.fit.gain.value, one.fit.offset_deg.value, one.fit.numbers) == (1.0, 0.0, {})
    assert one.fit.noise_deg == pytest.approx(0.05, rel=0.1)
    assert one.fit.error_rms_deg == pytest.approx(0.05, rel=0.1)
    assert one.levels.interval_deg < 0.5
