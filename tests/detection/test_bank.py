"""The bank: every hypothesis recovers its own fault, and the decision between them is right where it is sure."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from servofd.core.types import FloatArray
from servofd.detection.bank import BANK, Explanation, Flight, Ridge, Window
from servofd.detection.judge import confirmed, joined, name_fault, narendra, refine_onset_s, scores
from servofd.detection.threshold import Episode
from servofd.detection.verdict import Fault as Found
from servofd.detection.wiring import wiring_problem
from servofd.servo.effects.linkage import RateLimit
from servofd.servo.faults import (
    Bias,
    DeadBand,
    Fault,
    Floating,
    HardOver,
    LossOfEffectiveness,
    Oscillation,
    Slow,
    Stuck,
)
from servofd.servo.loops import play
from servofd.simulation.commands import COMMANDS
from tests.detection.tolerated import MODEL, deviating
from tests.detection.windows import NOISE_DEG, command, flown, judged, residuals_of, window

HYPOTHESES = BANK
GROSS: dict[str, Fault] = {
    "bias": Bias(2.0, bias_deg=2.0),
    "stuck": Stuck(2.0, position_deg=1.0),
    "hardover": HardOver(2.0, position_deg=30.0),
    "floating": Floating(2.0, amplitude_deg=5.0),
    "oscillation": Oscillation(2.0, amplitude_deg=2.0, frequency_hz=2.3),
    "deadband": DeadBand(2.0, width_deg=4.0),
    "slow": Slow(2.0, bandwidth_scale=0.4),
    "loss_of_effectiveness": LossOfEffectiveness(2.0, gain=0.5),
}
SEEDS = range(10)
TIME_S = np.arange(6000) / 100.0


@pytest.mark.parametrize(
    ("kind", "name", "truth"),
    [
        ("bias", "bias_deg", 2.0),
        ("stuck", "position_deg", 1.0),
        ("hardover", "position_deg", 30.0),
        ("oscillation", "amplitude_deg", 2.0),
        ("oscillation", "frequency_hz", 2.3),
        ("slow", "bandwidth_scale", 0.4),
        ("loss_of_effectiveness", "gain", 0.5),
        ("deadband", "width_deg", 4.0),
    ],
)
def test_each_fault_is_recovered_within_its_interval(kind: str, name: str, truth: float) -> None:
    hits = 0
    for seed in SEEDS:
        explanation = HYPOTHESES[kind](window(seed, GROSS[kind]))
        assert explanation is not None
        estimate = explanation.parameters[name]
        assert estimate.value == pytest.approx(truth, rel=0.05)
        assert estimate.low < estimate.value < estimate.high
        hits += estimate.low <= truth <= estimate.high
    # 95 % of ten; eight or fewer have a chance of 9 %, seven of 1 %.
    assert hits >= 8


def test_the_frequency_of_a_limit_cycle_is_as_sure_as_cramer_and_rao_allow() -> None:
    one = window(0, GROSS["oscillation"])
    found = HYPOTHESES["oscillation"](one)
    assert found is not None
    size, frequency = found.parameters["amplitude_deg"], found.parameters["frequency_hz"]
    # In n samples of white noise sigma a sine is known to sigma sqrt(2 / n), its tone to sqrt(6 / n) sigma / (pi T A).
    samples = one.time_s.size
    assert size.deviation == pytest.approx(NOISE_DEG * np.sqrt(2.0 / samples), rel=0.2)
    least_hz = np.sqrt(6.0 / samples) * NOISE_DEG / (np.pi * one.duration_s * size.value)
    assert frequency.deviation == pytest.approx(least_hz, rel=0.2)


@pytest.mark.parametrize(
    ("index", "off"),
    [(0, {"gain": 0.01}), (1, {"delay_s": 0.002}), (2, {"bandwidth": 0.01}), (3, {"bias_deg": 0.3})],
)
def test_nuisances_are_what_a_servo_that_is_a_little_off_adds(index: int, off: dict[str, float]) -> None:
    time_s, one = np.arange(2400) / 100.0, window(0, None)
    command_deg = command(0, time_s)
    added_deg = (deviating(time_s, command_deg, **off) - deviating(time_s, command_deg))[1200:2000]
    (size,) = off.values()
    shape_deg = one.nuisances[:, index]
    assert (shape_deg @ added_deg) / (shape_deg @ shape_deg) == pytest.approx(size, rel=0.04)
    assert np.sum((added_deg - size * shape_deg) ** 2) < 0.06 * np.sum(added_deg**2)


@pytest.mark.parametrize("kind", GROSS)
@pytest.mark.parametrize("seed", range(2))
def test_a_gross_fault_gets_its_name_and_is_never_healthy(kind: str, seed: int) -> None:
    naming = name_fault(window(seed, GROSS[kind]))
    assert naming.kind == kind
    assert naming.best is not None
    assert naming.best.kind == kind
    assert naming.probabilities["healthy"] < 1e-6
    assert sum(naming.probabilities.values()) == pytest.approx(1.0)
    assert list(naming.probabilities.values()) == sorted(naming.probabilities.values(), reverse=True)


@pytest.mark.parametrize("seed", range(4))
def test_a_healthy_servo_is_healthy(seed: int) -> None:
    naming = name_fault(window(seed, None))
    assert naming.kind == "healthy"
    assert naming.probability > 0.9


def test_what_nothing_explains_is_unknown() -> None:
    one = window(1, None)
    rng = np.random.default_rng(5)
    wild = one.healthy_deg + 8.0 * np.sign(rng.standard_normal(one.time_s.size))
    object.__setattr__(one, "measured_deg", wild)
    found = {kind: e for kind, explain in HYPOTHESES.items() if (e := explain(one)) is not None}
    marks = scores(one, found)
    assert min(marks, key=marks.__getitem__) == "unknown"
    assert name_fault(one).best is None


class TestRidge:
    rng = np.random.default_rng(1)
    regressors = rng.standard_normal((200, 3))
    target_deg = regressors @ np.array([1.0, -2.0, 0.5]) + 0.1 * rng.standard_normal(200)

    def test_without_a_prior_it_is_least_squares(self) -> None:
        fit = Ridge(self.regressors, np.full(3, np.inf), 0.1).fit(self.target_deg)
        expected, (cost,), *_ = np.linalg.lstsq(self.regressors, self.target_deg, rcond=None)
        np.testing.assert_allclose(fit.coefficients, expected, rtol=1e-9)
        assert fit.cost_deg2 == pytest.approx(cost)
        assert fit.doubt == 0.0

    def test_a_prior_is_a_measurement_of_zero(self) -> None:
        spread, noise_deg = np.array([0.5, 1.0, 0.02]), 0.1
        fit = Ridge(self.regressors, spread, noise_deg).fit(self.target_deg)
        rows = np.vstack([self.regressors, np.diag(noise_deg / spread)])
        expected = np.linalg.lstsq(rows, np.append(self.target_deg, np.zeros(3)), rcond=None)[0]
        np.testing.assert_allclose(fit.coefficients, expected, rtol=1e-7)
        assert fit.doubt == pytest.approx(float(np.sum((expected / spread) ** 2)))

    def test_intervals_hold_the_truth(self) -> None:
        rng, hits = np.random.default_rng(2), 0
        ridge = Ridge(self.regressors, np.full(3, np.inf), 0.1)
        for _ in range(100):
            target_deg = self.regressors[:, 0] + 0.1 * rng.standard_normal(200)
            low, high = ridge.estimate(ridge.fit(target_deg), target_deg, 0)[1:]
            hits += low <= 1.0 <= high
        assert hits >= 90


class TestOnset:
    """A servo with a bias that it always had, to which a fault adds a degree."""

    time_s = np.arange(1000) / 100.0
    habit_deg, noise_deg = 0.3, 0.05

    def refined_s(
        self, onset_s: float, before_s: float = 4.0, still_s: float = 0.0, size_deg: float = 1.0, way_s: float = 0.0
    ) -> float:
        """Refined onset [s] of what was suspected at 5 s; for so long the fault does not show, or is on its way."""
        noise_deg = self.noise_deg * (-1.0) ** np.arange(self.time_s.size)
        shown = np.where(self.time_s >= onset_s + way_s, 1.0, 0.7) * (self.time_s >= onset_s + still_s)
        measured_deg = self.habit_deg + noise_deg + size_deg * shown

        def of(first_s: float, last_s: float, _: object) -> Window:
            cut = slice(*np.searchsorted(self.time_s, [first_s - 1e-9, last_s + 1e-9]).tolist())
            nuisances, spread = np.ones((self.time_s[cut].size, 1)), np.array([0.5])
            fields = {
                "time_s": self.time_s[cut],
                "measured_deg": measured_deg[cut],
                "error_deg": measured_deg[cut],
                "nuisances": nuisances,
                "spread": spread,
                "noise_deg": self.noise_deg,
                "ridge": Ridge(nuisances, spread, self.noise_deg),
                "onset": None,
            }
            return cast("Window", SimpleNamespace(**fields))

        def predict(other: Window) -> FloatArray:
            return np.where(other.time_s >= onset_s + still_s, self.habit_deg + size_deg, self.habit_deg)

        fault = Explanation("bias", np.zeros(0), 0.0, 1.0, predict=predict)
        flight = cast("Flight", SimpleNamespace(window=of))
        return refine_onset_s(flight, fault, 5.0, of(5.0, 9.0, None), before_s)

    @pytest.mark.parametrize("onset_s", [2.75, 4.0, 5.5])
    def test_it_is_the_first_sample_that_the_fault_spoils(self, onset_s: float) -> None:
        """Health is learnt until 2.7 s, three tenths before the middle of the four seconds before the suspicion."""
        assert self.refined_s(onset_s) == self.refined_s(onset_s, size_deg=-1.0) == onset_s

    def test_where_both_explain_alike_it_is_the_latest(self) -> None:
        assert self.refined_s(3.0, still_s=1.5) == 4.5

    def test_on_its_way_it_is_neither_healthy_nor_explained(self) -> None:
        """0.7 of 1 deg are six sigma off the one and fourteen off the other: both count as four."""
        assert self.refined_s(4.0, way_s=0.25) == 4.25

    def test_a_shorter_look_back(self) -> None:
        assert self.refined_s(4.75, before_s=2.0) == 4.75

    def test_what_predicts_nothing_moves_nothing(self) -> None:
        fault = Explanation("unknown", np.zeros(0), 0.0, 1.0)
        assert refine_onset_s(cast("Flight", None), fault, 5.0, window(0, None)) == 5.0


def only(time_s: FloatArray, command_deg: FloatArray, measured_deg: FloatArray) -> Found:
    judgement = judged(time_s, command_deg, measured_deg)
    assert judgement.suspicions == ()
    (fault,) = judgement.faults
    return fault


class TestFlights:
    @pytest.mark.slow
    def test_a_jam_while_the_command_stays_within_a_dead_band_has_a_rival(self) -> None:
        """A surface that rests under small commands may be stuck, or play may swallow them."""
        command_deg = 2.2 * np.sin(3.0 * TIME_S)
        resting_deg = np.where(TIME_S < 20.0, MODEL.simulate(TIME_S, command_deg, TIME_S), 0.0)
        fault = only(TIME_S, command_deg, resting_deg + NOISE_DEG * np.random.default_rng(1).standard_normal(6000))
        assert {fault.kind, *fault.alternatives} >= {"stuck", "deadband"}

    def test_positions_that_are_lost_in_bursts_change_no_name(self) -> None:
        measured_deg = flown(1, LossOfEffectiveness(20.0, gain=0.5), TIME_S)
        for begin in range(500, 6000, 700):
            measured_deg[begin : begin + 60] = np.nan
        fault = only(TIME_S, command(1, TIME_S), measured_deg)
        assert fault.kind == "loss_of_effectiveness"
        assert fault.parameters["gain"].value == pytest.approx(0.5, abs=0.03)

    @pytest.mark.parametrize("kind", ["stuck", "bias", "loss_of_effectiveness"])
    def test_a_log_that_is_one_long_fault(self, kind: str) -> None:
        since_ever = replace(GROSS[kind], start_s=0.0)
        fault = only(TIME_S, command(2, TIME_S), flown(2, since_ever, TIME_S))
        assert (fault.kind, fault.end_s) == (kind, None)
        assert fault.start_s < 5.0

    @pytest.mark.parametrize("kind", ["stuck", "bias", "hardover", "loss_of_effectiveness"])
    def test_the_first_second_admits_what_it_turns_out_to_be(self, kind: str) -> None:
        fault = only(TIME_S, command(3, TIME_S), flown(3, replace(GROSS[kind], start_s=20.0), TIME_S))
        assert fault.kind == kind
        assert kind in fault.first_signs
        assert "healthy" not in fault.first_signs

    @pytest.mark.parametrize("kind", ["stuck", "bias", "oscillation"])
    def test_a_log_that_starts_inside_a_fault_which_passes(self, kind: str) -> None:
        passing = replace(GROSS[kind], start_s=0.0, end_s=15.0)
        fault = only(TIME_S, command(2, TIME_S), flown(2, passing, TIME_S))
        assert fault.kind == kind
        assert fault.end_s is not None
        assert 10.0 < fault.end_s < 17.0

    @pytest.mark.parametrize("kind", ["bias", "oscillation", "stuck", "deadband"])
    def test_a_passing_fault_has_an_end(self, kind: str) -> None:
        passing = replace(GROSS[kind], start_s=20.0, end_s=30.0)
        fault = only(TIME_S, command(3, TIME_S), flown(3, passing, TIME_S))
        assert fault.kind == kind
        assert 20.0 <= fault.start_s <= fault.alarm_s < 26.0
        assert fault.end_s is not None
        assert 25.0 < fault.end_s < 33.0

    def test_two_faults_one_after_the_other(self) -> None:
        healthy_deg = flown(4, Bias(10.0, end_s=20.0, bias_deg=2.5), TIME_S)
        measured_deg = np.where(TIME_S < 40.0, healthy_deg, flown(4, Stuck(40.0), TIME_S))
        bias, jam = judged(TIME_S, command(4, TIME_S), measured_deg).faults
        assert (bias.kind, jam.kind) == ("bias", "stuck")
        assert bias.end_s is not None
        assert 19.0 < bias.end_s < 23.0
        assert 40.0 <= jam.start_s <= jam.alarm_s < 45.0

    @pytest.mark.parametrize("seed", [0, 2])
    def test_a_small_lasting_loss_is_one_fault_by_the_interval_threshold(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        command_deg = COMMANDS["lively"](TIME_S, rng)
        measured_deg = LossOfEffectiveness(20.0, gain=0.88).deflection(MODEL, TIME_S, command_deg, TIME_S)
        measured_deg += NOISE_DEG * rng.standard_normal(TIME_S.size)
        assert len(judged(TIME_S, command_deg, measured_deg, "interval").faults) == 1

    @pytest.mark.slow
    def test_a_fault_of_unknown_kind_is_as_likely_as_its_likeliest_alternative(self) -> None:
        command_deg = 8.0 * np.sin(2.0 * np.pi * 10.0 * TIME_S)
        resting_deg = 0.05 * np.random.default_rng(0).standard_normal(TIME_S.size)
        (found,) = judged(TIME_S, command_deg, resting_deg).suspicions
        assert found.kind == "unknown"
        assert "stuck" in found.alternatives
        assert 0.01 < found.probability <= 1.0

    @pytest.mark.parametrize("kind", ["bias", "stuck", "hardover", "loss_of_effectiveness"])
    def test_ten_hertz_are_enough(self, kind: str) -> None:
        time_s = np.arange(900) / 10.0
        fault = only(time_s, command(5, time_s), flown(5, replace(GROSS[kind], start_s=30.0), time_s))
        assert fault.kind == kind
        assert 29.5 <= fault.start_s <= fault.alarm_s < 40.0


class TestWiring:
    @pytest.mark.parametrize(
        ("gain", "expected"),
        [
            (-0.97, "position is -0.97x the command throughout: check the sign of the calibration"),
            (57.3, "position is 57.30x the command throughout: check the scale of the calibration"),
            (0.0175, "position is 0.02x the command throughout: check the scale of the calibration"),
            (1.0, ""),
            (0.5, ""),
        ],
    )
    def test_sign_and_scale(self, gain: float, expected: str) -> None:
        command_deg = command(6, TIME_S)
        position_deg = gain * MODEL.simulate(TIME_S, command_deg, TIME_S)
        noise_deg = min(1.0, abs(gain)) * NOISE_DEG * np.random.default_rng(6).standard_normal(TIME_S.size)
        assert wiring_problem(residuals_of(TIME_S, command_deg, position_deg + noise_deg)) == expected

    def test_a_stuck_surface_is_no_question_of_scale(self) -> None:
        residuals = residuals_of(TIME_S, command(6, TIME_S), flown(6, Stuck(0.0), TIME_S))
        assert wiring_problem(residuals) == ""

    def test_a_sign_that_changes_in_flight_is_a_fault(self) -> None:
        command_deg = command(6, TIME_S)
        position_deg = MODEL.simulate(TIME_S, command_deg, TIME_S) * np.where(TIME_S < 30.0, 1.0, -1.0)
        assert wiring_problem(residuals_of(TIME_S, command_deg, position_deg)) == ""


class TestVariants:
    """The same fault in another machine."""

    time_s = np.arange(2400) / 100.0

    def window(self, measured_deg: FloatArray) -> Window:
        noise_deg = NOISE_DEG * np.random.default_rng(9).standard_normal(measured_deg.size)
        one = window(0, None)
        object.__setattr__(one, "measured_deg", (measured_deg + noise_deg)[1200:2000])
        return one

    def test_play_behind_the_servo(self) -> None:
        healthy_deg = MODEL.simulate(self.time_s, command(0, self.time_s), self.time_s)
        found = HYPOTHESES["deadband"](self.window(play(healthy_deg, 3.0, 0.0)))
        assert found is not None
        assert found.parameters["width_deg"].value == pytest.approx(3.0, abs=0.15)

    def test_a_bias_that_stays_has_one_number_and_one_that_grows_has_two(self) -> None:
        """It is told as it is at the end: 2 deg, and 0.3 deg/s over the eight seconds before."""
        healthy_deg = MODEL.simulate(self.time_s, command(0, self.time_s), self.time_s)
        for growth_deg_s, freedom in ((0.0, 1.0), (0.3, 2.0)):
            biased_deg = healthy_deg + 2.0 + growth_deg_s * (self.time_s - 19.99)
            found = HYPOTHESES["bias"](self.window(biased_deg))
            assert found is not None
            assert found.freedom == freedom
            assert found.parameters["bias_deg"].value == pytest.approx(2.0, abs=0.1)

    def test_a_servo_that_has_lost_speed(self) -> None:
        asked_deg = command(0, self.time_s)
        fastest_deg_s = float(np.abs(np.gradient(window(0, None).healthy_deg, 0.01)).max())
        weak = (MODEL + RateLimit(0.4 * fastest_deg_s)).simulate(self.time_s, asked_deg, self.time_s)
        found = HYPOTHESES["slow"](self.window(weak))
        assert found is not None
        limit = found.parameters["rate_limit_deg_s"]
        assert limit.value == pytest.approx(0.4 * fastest_deg_s, rel=0.05)
        assert limit.low < 0.4 * fastest_deg_s < limit.high


def test_narendras_filter_remembers_nine_tenths() -> None:
    np.testing.assert_allclose(narendra(np.array([1.0, 0.0, -2.0, 0.0])), [0.0, 0.1, 0.09, 0.281], rtol=1e-12)


class TestConfirmation:
    episode = Episode(10.0, 12.0, None, "suspect")
    fault = Found("stuck", 10.0, 12.0, 20.0, {}, 0.95, (), "suspect", named_s=14.5)

    def test_a_suspicion_that_is_sure_is_an_alarm_when_it_is_named(self) -> None:
        later = replace(self.fault, start_s=30.0)
        assert confirmed((self.fault, later), self.episode) == (
            replace(self.fault, level="fault", alarm_s=14.5),
            later,
        )

    @pytest.mark.parametrize(
        "other", [{"probability": 0.949}, {"kind": "healthy"}, {"kind": "unknown"}, {"named_s": None}]
    )
    def test_one_that_is_not_remains_one(self, other: dict[str, Any]) -> None:
        doubtful = replace(self.fault, **other)
        assert confirmed((doubtful,), self.episode) == (doubtful,)

    def test_an_alarm_remains_where_it_was_raised(self) -> None:
        crossed = replace(self.fault, level="fault")
        assert confirmed((crossed,), replace(self.episode, level="fault")) == (crossed,)

    def test_neighbours_of_one_kind_are_one_unless_the_servo_was_well_in_between(self) -> None:
        nothing_known = cast("Flight", SimpleNamespace(window=lambda *_: None))
        well = cast("Flight", SimpleNamespace(window=lambda *_: window(0, None)))
        still = cast("Flight", SimpleNamespace(window=lambda *_: window(0, GROSS["stuck"])))
        again = replace(self.fault, start_s=25.0, end_s=None)
        for flight in (nothing_known, still):
            assert joined(flight, [self.fault, again]) == (replace(self.fault, end_s=None),)
        assert joined(well, [self.fault, again]) == (self.fault, again)
        lasting = replace(self.fault, end_s=None)
        assert joined(well, [lasting, replace(again, end_s=40.0)]) == (replace(lasting, end_s=40.0),)
        for other in (replace(again, kind="bias"), replace(again, level="fault")):
            assert joined(nothing_known, [self.fault, other]) == (self.fault, other)
