"""Lines, cuts and forecasts on numbers whose truth is known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from servofd.wear.series import FEWEST_FLIGHTS, Piece, find_events, fit_line, forecast, pieces

TELLING = dict.fromkeys(("dead_band_deg", "bias_deg", "delay_s", "bandwidth_hz", "noise_deg"), 0.1)


def piece(value: np.ndarray, deviation: float = 0.01) -> Piece:
    return Piece(np.arange(1.0, value.size + 1.0), value, np.full(value.size, deviation))


def noisy(value: np.ndarray, seed: int = 0, sigma: float = 0.01) -> np.ndarray:
    return value + sigma * np.random.default_rng(seed).standard_normal(value.size)


NUMBER = np.arange(1.0, 41.0)


@settings(max_examples=30, deadline=None)
@given(st.floats(-1.0, 1.0), st.floats(-10.0, 10.0), st.integers(0, 100))
def test_a_line_moves_and_scales_with_its_values(slope: float, level: float, seed: int) -> None:
    plain = noisy(np.zeros(20), seed)
    one = fit_line(NUMBER[:20], plain, np.full(20, 0.01))
    other = fit_line(NUMBER[:20], plain + level + slope * NUMBER[:20], np.full(20, 0.01))
    assert other.slope == pytest.approx(one.slope + slope, abs=1e-4)
    assert other.at(7.0).value == pytest.approx(one.at(7.0).value + level + 7.0 * slope, abs=2e-3)


@pytest.mark.slow
def test_the_interval_of_a_slope_holds_it_in_95_of_100() -> None:
    """200 draws with scatter beyond each flight's own interval: 95 % within 3 standard deviations of a binomial."""
    held = 0
    for seed in range(200):
        line = fit_line(NUMBER[:12], noisy(0.02 * NUMBER[:12], seed, 0.03), np.full(12, 0.01))
        held += line.slope_estimate.low <= 0.02 <= line.slope_estimate.high
    assert 0.90 <= held / 200 <= 0.995


def test_two_flights_that_went_wrong_neither_bend_nor_cut() -> None:
    value = noisy(0.02 * NUMBER)
    value[[10, 11]] += 5.0
    (whole,) = pieces(piece(value))
    assert whole.line.slope == pytest.approx(0.02, rel=0.1)


@pytest.mark.parametrize("first", [4, 12, 25, 38])
def test_a_jump_is_cut_where_it_is(first: int) -> None:
    value = noisy(np.where(first <= NUMBER, 0.0, 0.5))
    assert [(one.first, one.last) for one in pieces(piece(value))] == [(1, first - 1), (first, 40)]


@pytest.mark.slow
def test_healthy_numbers_are_not_cut_and_have_no_trend() -> None:
    """The chance of any is 1e-6 each; scatter three times what the flights claim."""
    for seed in range(100):
        value = noisy(np.zeros(40), seed, 0.03)
        (whole,) = pieces(piece(value))
        assert forecast(whole, 2.0, above=True).kind == "none"


def test_wear_that_begins_late_is_another_slope_and_no_event() -> None:
    value = noisy(np.maximum(0.0, 0.05 * (NUMBER - 20.0)))
    cut = pieces(piece(value))
    assert len(cut) == 2
    assert cut[1].line.slope == pytest.approx(0.05, rel=0.1)
    assert find_events({"dead_band_deg": piece(value)}, TELLING) == ()
    found = forecast(cut[1], 2.0, above=True)
    assert found.flight == pytest.approx(60.0, abs=2.0)


def test_what_steps_together_is_another_servo_and_what_steps_alone_is_not() -> None:
    step = np.where(NUMBER >= 15, 1.0, 0.0)
    both = {
        "bias_deg": piece(noisy(step, 1)),
        "delay_s": piece(noisy(-step, 2)),
        "noise_deg": piece(noisy(0 * step, 3)),
    }
    (swap,) = find_events(both, TELLING)
    assert (swap.kind, swap.first, set(swap.jumps)) == ("swap", 15, {"bias_deg", "delay_s"})
    (trim,) = find_events({"bias_deg": piece(noisy(step))}, TELLING)
    (healed,) = find_events({"dead_band_deg": piece(noisy(-step))}, TELLING)
    (damaged,) = find_events({"dead_band_deg": piece(noisy(step))}, TELLING)
    assert (trim.kind, healed.kind, damaged.kind) == ("adjusted", "swap", "changed")
    assert "not wear" in damaged.reason


def test_a_step_within_what_a_healthy_servo_may_differ_by_is_not_told() -> None:
    step = np.where(NUMBER >= 15, 0.09, 0.0)
    assert find_events({"delay_s": piece(noisy(step, sigma=0.001), 0.001)}, TELLING) == ()


@pytest.mark.parametrize(
    ("value", "limit", "kind", "reason"),
    [
        (0.02 * NUMBER[: FEWEST_FLIGHTS - 1], 2.0, "none", "are needed for a forecast"),
        (0.02 * NUMBER[:2], 2.0, "none", "too few flights"),
        (0.0 * NUMBER, 2.0, "none", "no trend that chance does not explain"),
        (-0.02 * NUMBER, 2.0, "none", "moves away"),
        (0.002 * NUMBER, 2.0, "none", "not within the next 160 flights"),
        (0.02 * NUMBER, 2.0, "crossing", "crosses its limit"),
        (0.06 * NUMBER, 2.0, "reached", "is beyond its limit"),
        (np.full(3, 2.5), 2.0, "reached", "is beyond its limit"),
        (np.array([1.5, 3.5, 2.5, 1.2, 3.9]), 2.0, "none", "are needed for a forecast"),
    ],
)
def test_a_forecast_is_made_or_refused_in_words(value: np.ndarray, limit: float, kind: str, reason: str) -> None:
    found = forecast(piece(noisy(value, sigma=0.004), 0.004), limit, above=True)
    assert found.kind == kind
    assert reason in found.reason


def test_a_forecast_downwards_is_that_upwards_mirrored() -> None:
    up = noisy(0.02 * NUMBER)
    above, below = forecast(piece(up), 2.0, above=True), forecast(piece(-up), -2.0, above=False)
    assert (above.flight, above.low, above.high) == pytest.approx((below.flight, below.low, below.high))


@pytest.mark.slow
def test_the_interval_of_a_forecast_holds_the_crossing_in_95_of_100() -> None:
    held = 0
    for seed in range(100):
        found = forecast(piece(noisy(0.02 * NUMBER[:25], seed, 0.01)), 2.0, above=True)
        assert found.low is not None
        assert found.high is not None
        held += found.low <= 100.0 <= found.high
    assert 0.90 <= held / 100 <= 0.99
