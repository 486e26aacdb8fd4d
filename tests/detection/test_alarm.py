"""Alarms: how long a crossing has to last, when they clear, and what suspicion adds."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from servofd.detection.alarm import Episode, crossings, find_episodes
from servofd.detection.residual import ResidualGenerator
from servofd.detection.threshold import constant_threshold, interval_threshold, suspicion
from servofd.segment import Segment
from servofd.simulation.commands import COMMANDS
from servofd.tolerance import Tolerance
from servofd.types import FloatArray
from tests.detection.tolerated import MODEL, deviating

TIME_S = np.arange(6000) / 100.0
GENERATOR = ResidualGenerator(MODEL, 50.0)
STEADY_DEG = 6.0 * np.sin(3.0 * TIME_S)

residuals_deg = arrays(float, st.integers(1, 60), elements=st.floats(-4.0, 4.0))


def found(
    command_deg: FloatArray, measured_deg: FloatArray, *, suspicious: bool = True, persistence: int = 1
) -> tuple[Episode, ...]:
    """Episodes against a constant threshold of 1.5 deg."""
    noise_deg = 0.1 * np.random.default_rng(1).standard_normal(TIME_S.size)
    segment = Segment("x", TIME_S, command_deg, TIME_S, measured_deg + noise_deg)
    residuals = GENERATOR.run(segment)
    threshold = constant_threshold(interval_threshold(GENERATOR, segment, residuals, Tolerance()), 1.5)
    suspects = suspicion(residuals, threshold) if suspicious else None
    return find_episodes(residuals, threshold, persistence=persistence, suspicion=suspects)


class TestPersistence:
    @given(residuals_deg)
    def test_one_is_the_thesis_own_rule(self, residual_deg: FloatArray) -> None:
        level_deg = np.full(residual_deg.size, 1.5)
        np.testing.assert_array_equal(crossings(residual_deg, level_deg), np.abs(residual_deg) >= 1.5)

    @given(residuals_deg, st.integers(1, 8))
    def test_an_alarm_is_so_many_crossings_on_one_side_and_nothing_else(
        self, residual_deg: FloatArray, persistence: int
    ) -> None:
        level_deg = np.full(residual_deg.size, 1.5)
        expected = [
            k + 1 >= persistence
            and (
                all(r >= 1.5 for r in residual_deg[k + 1 - persistence : k + 1])
                or all(r <= -1.5 for r in residual_deg[k + 1 - persistence : k + 1])
            )
            for k in range(residual_deg.size)
        ]
        assert crossings(residual_deg, level_deg, persistence).tolist() == expected

    @given(residuals_deg, st.integers(1, 8))
    def test_asking_for_more_never_raises_more(self, residual_deg: FloatArray, persistence: int) -> None:
        level_deg = np.full(residual_deg.size, 1.5)
        more = crossings(residual_deg, level_deg, persistence + 1)
        assert not np.any(more & ~crossings(residual_deg, level_deg, persistence))
        np.testing.assert_array_equal(more, crossings(-residual_deg, level_deg, persistence + 1))

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
