"""Alarms: how long a crossing has to last, when they clear, and what suspicion adds."""

from __future__ import annotations

import numpy as np
import pytest

from servofd.aircraft.series import Series
from servofd.core.tolerance import Tolerance
from servofd.core.types import FloatArray
from servofd.detection.probability import Noise, design_cusum
from servofd.detection.residual import ResidualGenerator, Residuals
from servofd.detection.threshold import (
    Episode,
    Threshold,
    constant_threshold,
    find_episodes,
    interval_threshold,
    latch,
    new_latch_memory,
    suspicion,
)
from servofd.simulation.commands import COMMANDS
from tests.detection.tolerated import MODEL, deviating

TIME_S = np.arange(6000) / 100.0
GENERATOR = ResidualGenerator(MODEL, 50.0)
STEADY_DEG = 6.0 * np.sin(3.0 * TIME_S)


def found(
    command_deg: FloatArray, measured_deg: FloatArray, *, suspicious: bool = True, persistence: int = 1
) -> tuple[Episode, ...]:
    """Episodes against a constant threshold of 1.5 deg."""
    noise_deg = 0.1 * np.random.default_rng(1).standard_normal(TIME_S.size)
    segment = Series("x", TIME_S, command_deg, TIME_S, measured_deg + noise_deg)
    residuals = GENERATOR.run(segment)
    threshold = constant_threshold(interval_threshold(GENERATOR, segment, residuals, Tolerance()), 1.5)
    suspects = suspicion(residuals, threshold) if suspicious else None
    return find_episodes(residuals, threshold, persistence=persistence, suspicion=suspects)


class TestPersistence:
    def test_it_delays_the_alarm_of_a_lasting_fault_by_so_many_samples(self) -> None:
        measured_deg = deviating(TIME_S, STEADY_DEG) + 4.0 * (TIME_S >= 20.0)
        alarms = [found(STEADY_DEG, measured_deg, persistence=count)[0].alarm_s for count in (1, 4)]
        assert alarms[1] - alarms[0] == pytest.approx(0.03)

    def test_a_glitch_of_one_sample_needs_less_than_the_filters_memory(self) -> None:
        measured_deg = deviating(TIME_S, STEADY_DEG)
        measured_deg[3000] += 6.0
        assert found(STEADY_DEG, measured_deg, suspicious=False)
        assert not found(STEADY_DEG, measured_deg, suspicious=False, persistence=25)


class TestLatching:
    def test_a_bias_stays_until_the_surface_has_moved_well(self) -> None:
        passes = deviating(TIME_S, STEADY_DEG) + 3.0 * ((TIME_S >= 10.0) & (TIME_S < 12.0))
        (episode,) = found(STEADY_DEG, passes)
        assert episode.start_s == pytest.approx(10.0, abs=0.05)
        assert episode.end_s == pytest.approx(12.0, abs=0.2)
        assert episode.level == "fault"

    def test_without_motion_nothing_clears(self) -> None:
        command_deg = np.where(TIME_S < 12.0, STEADY_DEG, 0.0)
        passes = deviating(TIME_S, command_deg) + 3.0 * ((TIME_S >= 10.0) & (TIME_S < 14.0))
        (episode,) = found(command_deg, passes)
        assert episode.end_s is None

    def test_two_faults_with_enough_motion_between_are_two(self) -> None:
        wrong = ((TIME_S >= 10.0) & (TIME_S < 12.0)) | (TIME_S >= 40.0)
        first, second = found(STEADY_DEG, deviating(TIME_S, STEADY_DEG) + 3.0 * wrong)
        assert first.end_s == pytest.approx(12.0, abs=0.2)
        assert second.end_s is None
        assert second.start_s == pytest.approx(40.0, abs=0.05)

    def test_what_was_suspected_of_a_fault_is_no_second_fault(self) -> None:
        wrong = (TIME_S >= 10.0) & (TIME_S < 12.0)
        assert found(STEADY_DEG, deviating(TIME_S, STEADY_DEG) + 3.0 * wrong) == found(
            STEADY_DEG, deviating(TIME_S, STEADY_DEG) + 3.0 * wrong, suspicious=False
        )


class TestSuspicion:
    @pytest.mark.parametrize("bias_deg", [0.7, -0.7, 1.0])
    def test_a_small_lasting_bias_is_suspect_though_it_never_crosses(self, bias_deg: float) -> None:
        command_deg = COMMANDS["calm"](TIME_S, np.random.default_rng(2))
        measured_deg = deviating(TIME_S, command_deg) + bias_deg * (TIME_S >= 20.0)
        assert found(command_deg, measured_deg, suspicious=False) == ()
        (episode,) = found(command_deg, measured_deg)
        assert (episode.level, episode.end_s) == ("suspect", None)
        assert 20.0 < episode.alarm_s < 22.0

    @pytest.mark.parametrize("bias_deg", [0.0, 0.2, -0.3])
    def test_one_within_the_tolerance_is_not(self, bias_deg: float) -> None:
        command_deg = COMMANDS["calm"](TIME_S, np.random.default_rng(2))
        assert found(command_deg, deviating(TIME_S, command_deg) + bias_deg) == ()

    def test_it_tells_when_a_growing_fault_was_suspected_first(self) -> None:
        command_deg = COMMANDS["calm"](TIME_S, np.random.default_rng(2))
        measured_deg = deviating(TIME_S, command_deg) + np.clip(0.1 * (TIME_S - 20.0), 0.0, 3.0)
        (episode,) = found(command_deg, measured_deg)
        assert episode.level == "fault"
        assert episode.suspected_s is not None
        assert 23.0 < episode.suspected_s < episode.alarm_s
        assert episode.alarm_s == pytest.approx(35.0, abs=1.5)


class TestEpisodesByHand:
    """A minute of samples every 0.1 s against 1.5 deg; noise of 0.1 deg, and a surface that is moved about or not."""

    time_s = np.arange(601) / 10.0

    def found(self, residual_deg: FloatArray, suspected_s: list[float], *, moves: bool = True) -> tuple[Episode, ...]:
        size = self.time_s.size
        immobile_deg = np.where(np.arange(size) % 10 < 5, 6.0, -6.0) * moves
        residuals = Residuals(
            self.time_s,
            np.zeros(size),
            residual_deg,
            residual_deg,
            np.ones(size, dtype=bool),
            immobile_deg,
            np.zeros(size, dtype=np.int8),
        )
        level, nothing = np.full(size, 1.5), np.zeros(size)
        cusum = design_cusum(0.5, 1e-3, Noise(1.0, np.eye(8)[0], 0.1))
        threshold = Threshold("constant", level, nothing, nothing, level / 6.0, cusum, nothing)
        return find_episodes(residuals, threshold, suspicion=np.isin(self.time_s, suspected_s))

    def test_suspicions_ten_seconds_apart_are_one(self) -> None:
        quiet = np.full(601, 0.1)
        assert self.found(quiet, [10.0, 12.0, 22.0, 32.5, 50.0]) == (
            Episode(10.0, 10.0, 22.0, "suspect"),
            Episode(32.5, 32.5, 32.5, "suspect"),
            Episode(50.0, 50.0, None, "suspect"),
        )
        assert self.found(quiet, [49.9])[0].end_s == 49.9
        assert self.found(quiet, []) == ()

    def test_an_alarm_knows_what_announced_it_and_outlasts_its_echo(self) -> None:
        """0.8 deg at 29 s come half a second and more before the rest; 4.5 sigma of what was before are 0.67 deg."""
        residual_deg = np.full(601, 0.1)
        residual_deg[290] = 0.8
        residual_deg[[297, 298, 299]] = 0.6, -0.7, 1.4
        residual_deg[300:310] = -2.0
        first, later = self.found(residual_deg, [5.0, 25.0, 35.0, 40.9, 41.0])[1:]
        assert first == Episode(29.8, 30.0, 30.9, "fault", 25.0)
        assert later == Episode(41.0, 41.0, 41.0, "suspect")

    def test_a_suspicion_that_was_over_long_before_announces_nothing(self) -> None:
        residual_deg = np.where((self.time_s >= 30.0) & (self.time_s < 31.0), 2.0, 0.1)
        earlier, fault = self.found(residual_deg, [19.9])
        assert (earlier.level, fault.suspected_s) == ("suspect", None)
        (fault,) = self.found(residual_deg, [20.0])
        assert (fault.level, fault.suspected_s) == ("fault", 20.0)

    def test_without_motion_an_alarm_stands_and_all_after_it_is_its_echo(self) -> None:
        residual_deg = np.where((self.time_s >= 30.0) & (self.time_s < 31.0), 1.5, 0.1)
        (fault,) = self.found(residual_deg, [45.0, 59.0], moves=False)
        assert fault == Episode(30.0, 30.0, None)


def test_it_clears_after_twenty_thresholds_of_travel_beyond_a_zone() -> None:
    """Each swing of 6 thresholds moves what is held by 4: the fifth after the last loud sample makes twenty."""
    size = 9
    immobile_deg = np.array([0.0, 4.5, -4.5, 4.5, -4.5, 4.5, -4.5, 4.5, -4.5])
    residual_deg = np.array([0.0, 2.0, 0.75, 0.7, 0.7, 0.7, 0.7, 0.7, 2.0])
    found_ = latch(new_latch_memory(), residual_deg, np.full(size, 1.5), immobile_deg, 1, 1.5)
    assert np.flatnonzero(found_.alarm).tolist() == [1, 8]
    assert np.flatnonzero(found_.clear).tolist() == [7]
    assert found_.group.tolist() == [-1, 0, 0, -1, -1, -1, -1, -1, 1]
