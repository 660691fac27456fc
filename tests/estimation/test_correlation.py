"""Autocorrelation time of residuals."""

from __future__ import annotations

import numpy as np
import pytest

from kineverse.estimation.correlation import correlation_time


def errors(count: int, correlation: float, seed: int) -> np.ndarray:
    """Return errors (count, 6) with the autocorrelation ``correlation``^k."""
    result = np.random.default_rng(seed).normal(size=(count, 6))
    for k in range(1, count):
        result[k] = correlation * result[k - 1] + np.sqrt(1.0 - correlation**2) * result[k]
    return result


def test_independent_errors_count_fully() -> None:
    assert np.median([correlation_time(errors(300, 0.0, seed)) for seed in range(20)]) == 1.0


@pytest.mark.parametrize("correlation", [0.5, 0.8])
def test_known_correlation_is_estimated(correlation: float) -> None:
    times = [correlation_time(errors(4000, correlation, seed)) for seed in range(5)]
    # The largest of the components' times counts.
    assert np.mean(times) == pytest.approx((1 + correlation) / (1 - correlation), rel=0.25)


def test_upper_bound_grows_with_uncertainty() -> None:
    """A short recording cannot support a small correlation time; the true one is 9."""
    bounds = {
        count: np.array([correlation_time(errors(count, 0.8, seed), 1.0) for seed in range(20)])
        for count in (60, 2000)
    }
    assert all(np.mean(times >= 9.0) > 0.8 for times in bounds.values())
    assert np.median(bounds[2000]) < 18.0
    assert correlation_time(errors(20, 0.8, 0), 1.0) == 1.0


def test_one_correlated_component_counts_and_one_outlier_does_not() -> None:
    slow = errors(400, 0.0, 1)
    slow[:, 2] = np.sin(np.linspace(0, 6, 400))
    assert correlation_time(slow) > 50.0
    jump = errors(400, 0.0, 2)
    jump[17] = 1e6
    assert correlation_time(jump) == correlation_time(np.zeros((50, 6))) == correlation_time(slow[:20]) == 1.0
