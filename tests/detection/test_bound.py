"""The bound that detectors are measured against is the likelihood ratio it claims to be."""

from __future__ import annotations

import numpy as np
import pytest

from bound import KNOWN_ONSET, Health, log_likelihood_ratio

RNG = np.random.default_rng(1)
SIZE, NOISE_DEG = 40, 0.3
SPREAD = np.array([0.5, 0.02])
NUISANCES = np.column_stack([np.ones(SIZE), np.linspace(-5.0, 5.0, SIZE)])
SIGNATURE_DEG = np.where(np.arange(SIZE) >= 15, 0.6, 0.0)
HEALTH = Health(NOISE_DEG, SPREAD, NUISANCES)


def test_running_sums_agree_with_the_dense_normal_densities() -> None:
    error_deg = RNG.normal(size=SIZE)
    ratio = log_likelihood_ratio(HEALTH, error_deg, SIGNATURE_DEG)
    for k in range(SIZE):
        seen = slice(0, k + 1)
        covariance = NOISE_DEG**2 * np.eye(k + 1) + NUISANCES[seen] * SPREAD**2 @ NUISANCES[seen].T
        healthy, faulty = error_deg[seen], error_deg[seen] - SIGNATURE_DEG[seen]
        expected = 0.5 * (healthy @ np.linalg.solve(covariance, healthy) - faulty @ np.linalg.solve(covariance, faulty))
        np.testing.assert_allclose(ratio[k], expected, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_health_reaches_the_limit_no_more_often_than_wald_allows() -> None:
    flights, limit = 4000, np.log(20.0)
    habits = RNG.normal(size=(flights, 2)) * SPREAD
    errors_deg = habits @ NUISANCES.T + NOISE_DEG * RNG.normal(size=(flights, SIZE))
    reached = [log_likelihood_ratio(HEALTH, error_deg, SIGNATURE_DEG).max() >= limit for error_deg in errors_deg]
    assert 0.005 < np.mean(reached) <= 0.05
    np.testing.assert_allclose(np.exp(-KNOWN_ONSET), 1e-3)
