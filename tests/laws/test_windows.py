"""Windows: sizes are those of generalised least squares, and a compiled stream tests a position by the same."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from servofd.aircraft.priors import FITTED, NAMES, PRIORS
from servofd.core.types import BoolArray, FloatArray
from servofd.core.windows import Sizes, Sums, distance, fitted, known_from, lasting
from servofd.detection import changes
from servofd.estimate.family import PATTERNS


def test_sizes_are_those_of_generalised_least_squares() -> None:
    rng = np.random.default_rng(1)
    a, x, noise_var = rng.normal(size=(3, 80)), rng.normal(size=(2, 80)), 0.3
    sigma = np.diag([0.5, 2.0, 0.1]) + 0.05
    e = rng.normal(size=80)
    total = noise_var * np.eye(80) + a.T @ sigma @ a
    inverse = np.linalg.inv(x @ np.linalg.solve(total, x.T))
    theta = inverse @ x @ np.linalg.solve(total, e)

    precision = np.zeros((5, 5))
    precision[:3, :3] = noise_var * np.linalg.inv(sigma)
    window = Sums.of(np.vstack([a, x, e]), np.ones(80, dtype=bool)).between(0, 80)
    found = fitted(window, 2, precision)
    sizes = found.scaled(noise_var)
    rest = fitted(window.given(3, precision[:3, :3]), 2)
    assert rest.sizes.value == pytest.approx(found.sizes.value)
    assert rest.explained == pytest.approx(found.explained)
    assert sizes.value[:, 0] == pytest.approx(theta)
    assert sizes.covariance[..., 0] == pytest.approx(inverse)
    assert found.explained[0] / noise_var == pytest.approx(theta @ np.linalg.solve(inverse, theta))
    swapped = fitted(window, 1, precision[:4, :4], (0, 1, 2, 4, 5))
    alone = fitted(Sums.of(np.vstack([a, x[1:], e]), np.ones(80, dtype=bool)).between(0, 80), 1, precision[:4, :4])
    assert swapped.sizes.value == pytest.approx(alone.sizes.value)


def test_what_a_flight_was_like_is_learned_beside_what_its_past_window_was_like() -> None:
    rng = np.random.default_rng(2)
    x, e, noise_var = rng.normal(size=(2, 200)), rng.normal(size=200), 0.5
    flight, window = np.array([[0.2, 0.05], [0.05, 0.4]]), np.array([[0.1, 0.0], [0.0, 0.3]])
    known = known_from(
        Sums.of(np.vstack([x, e]), np.ones(200, dtype=bool)).between(0, 200), 2, flight, window, noise_var
    )
    total = noise_var * np.eye(200) + x.T @ (flight + window) @ x
    gain = flight @ x @ np.linalg.inv(total)
    assert known.value[:, 0] == pytest.approx(gain @ e)
    assert known.covariance[..., 0] == pytest.approx(flight - gain @ x.T @ flight)


def test_the_distance_of_healthy_windows_is_chi_square_on_the_side_of_a_fault() -> None:
    rng = np.random.default_rng(3)
    healthy = np.array([[0.04, 0.1], [0.1, 1.0]])
    drawn = Sizes(rng.multivariate_normal(np.zeros(2), healthy, 4000).T, np.repeat(healthy[..., None], 4000, axis=2))
    assert stats.kstest(distance(drawn, None), stats.chi2(2).cdf).pvalue > 0.01
    beyond = drawn.value[0] > healthy[0, 1] / healthy[1, 1] * drawn.value[1]
    assert distance(drawn)[beyond] == pytest.approx(distance(drawn, None)[beyond])
    assert np.all(distance(drawn)[~beyond] < distance(drawn, None)[~beyond])


@pytest.mark.slow
def test_the_scores_of_a_position_are_sizes_over_what_they_scatter_by() -> None:
    """`servofd.detection.changes` follows a stream in one compiled loop; this is the same by the windows of others."""
    rng = np.random.default_rng(4)
    period_s, count, width, missed_deg, noise_deg = 0.02, 2200, FITTED + len(PATTERNS), 0.2, 0.05
    time_s = np.asarray((np.arange(count) + 0.5) * period_s, dtype=float)
    slopes: FloatArray = np.cumsum(rng.normal(size=(count, width)), axis=0) * 0.002
    error_deg = rng.normal(0.0, noise_deg, count)
    covariance = np.diag(rng.uniform(0.5, 2.0, FITTED)) + 0.1
    first, second, innovation = 0.4, 0.1, 0.9
    tests = changes.Tests(
        np.array([first, second, innovation, 6.0]),
        np.asarray(np.linalg.cholesky(covariance), dtype=float),
        np.asarray(np.linalg.inv(covariance), dtype=float),
        np.ones(5),
        period_s,
        missed_deg,
        np.ones(len(changes.STATISTICS)),
    )
    noise = np.full(count, noise_deg)
    tested = changes.follow(tests, changes.Memory(tests), time_s, error_deg, slopes, noise, np.zeros(count))

    units = np.array([*(prior.between for prior in PRIORS), *(1.0 for _ in PATTERNS)])
    z = np.vstack([(slopes * units).T, error_deg]) / noise_deg
    white = (z[:, 2:] - first * z[:, 1:-1] - second * z[:, :-2]) / innovation
    white[-1] = np.clip(white[-1], -6.0, 6.0)
    sums = Sums.of(white, np.ones(count - 2, dtype=bool))
    precision = np.zeros((FITTED + 1, FITTED + 1))
    precision[:FITTED, :FITTED] = np.linalg.inv(covariance)
    ends = np.searchsorted(time_s[2:], tested.grid_s[-40:])
    for name, column in {
        "loss_10s": NAMES.index("gain"),
        "bias_10s": NAMES.index("bias_deg"),
        "weak_10s": FITTED + PATTERNS.index("weak"),
        "play_30s": FITTED + PATTERNS.index("play"),
    }.items():
        length_s = float(name.partition("_")[2][:-1])
        window = sums.between(np.searchsorted(time_s[2:], tested.grid_s[-40:] - length_s), ends)
        found = fitted(window, 1, precision, (*range(FITTED), column, width))
        own = window.table[column, column]
        missed = window.samples * (missed_deg / innovation / noise_deg) ** 2 / own + found.sizes.covariance[0, 0] ** 2
        away = found.sizes._replace(covariance=found.sizes.covariance + missed)
        score = tested.statistics[-40:, changes.STATISTICS.index(name)]
        assert np.square(score) == pytest.approx(distance(away, None), rel=1e-6), name


def test_a_position_is_alarmed_where_a_statistic_lasts_for_two_times() -> None:
    rng = np.random.default_rng(6)
    ratios: FloatArray = rng.uniform(0.5, 1.19, (200, len(changes.STATISTICS)))  # none is so large that once is enough
    limits: FloatArray = rng.uniform(1.0, 5.0, len(changes.STATISTICS))
    before: FloatArray = ratios[0] * limits
    alarmed: BoolArray = np.greater_equal(changes.exceeded(limits, before, ratios[1:] * limits), 1.0)
    lasts: BoolArray = np.asarray(lasting(ratios[:, 1:].T, 2)) >= 1.0
    assert np.array_equal(alarmed, np.asarray(np.any(lasts, axis=0))[1:])


def test_an_alarm_lasts_as_long_as_each_value_of_it() -> None:
    values = np.random.default_rng(5).normal(size=(2, 40)) + 1.0
    kept = lasting(values, 3)
    assert kept[:, 2:] == pytest.approx(np.min([values[:, 2:], values[:, 1:-1], values[:, :-2]], axis=0))
    assert kept[:, :2].max() <= 0.0
