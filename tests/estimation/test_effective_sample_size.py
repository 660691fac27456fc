"""Effective sample size of autocorrelated residuals."""

from __future__ import annotations

import numpy as np
import pytest

from kineverse.estimation.recordings import effective_sample_size


def errors(count: int, correlation: float, seed: int) -> np.ndarray:
    """Return errors (count, 6) with the autocorrelation ``correlation``^k."""
    random = np.random.default_rng(seed)
    result = random.normal(size=(count, 6))
    for k in range(1, count):
        result[k] = correlation * result[k - 1] + np.sqrt(1.0 - correlation**2) * result[k]
    return result


def test_independent_errors_count_fully() -> None:
    kept = [effective_sample_size(errors(300, 0.0, seed)) for seed in range(20)]
    assert np.median(kept) == 300


@pytest.mark.parametrize("correlation", [0.5, 0.8])
def test_known_correlation_is_estimated(correlation: float) -> None:
    kept = [effective_sample_size(errors(4000, correlation, seed)) for seed in range(5)]
    # The component with the largest correlation time counts, so the size is smaller.
    assert np.mean(kept) == pytest.approx(4000 * (1 - correlation) / (1 + correlation), rel=0.2)


def test_one_correlated_component_counts_and_one_outlier_does_not() -> None:
    slow = errors(400, 0.0, 1)
    slow[:, 2] = np.sin(np.linspace(0, 6, 400))
    # Two bumps hold little information in any number of rows.
    assert effective_sample_size(slow) == 8
    jump = errors(400, 0.0, 2)
    jump[17] = 1e6
    assert effective_sample_size(jump) == 400
    assert effective_sample_size(np.zeros((50, 6))) == 50
    assert effective_sample_size(slow[:20]) == 20
