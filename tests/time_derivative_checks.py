"""The motion law: along q̇ = R(q)u, ė = Σ D(e)[v]·v, and ë likewise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

import kineverse as kv


def assert_time_derivatives(
    model: kv.Model,
    expressions: Sequence[kv.Expression],
    start: Mapping[kv.Symbol, float],
    speeds: Mapping[kv.Symbol, float],
) -> None:
    """Differences of values along the motion are ė, and those of ė are ë, entry by entry of the gradients."""
    h = 2e-3
    weights = np.array([-1 / 60, 3 / 20, -3 / 4, 0, 3 / 4, -3 / 20, 1 / 60]) / h
    points = [{**model.integrate(start, speeds, k * h), **speeds} for k in range(-3, 4)]
    for e in expressions:
        first = rate_of(e)
        for below, above in ((e, first), (first, rate_of(first))):
            values = np.array([below(p) for p in points])
            expected = above(points[3])
            size = max(1.0, float(np.abs(expected).max()), float(np.abs(values).max()))
            np.testing.assert_allclose(np.tensordot(weights, values, 1), expected, rtol=0, atol=1e-8 * size)


def rate_of(e: kv.Expression) -> kv.Expression:
    """Return Σ D(e)[v]·v over the speeds, which are constant."""
    terms = (entry * key for key, entry in e.gradient(heuristic=False).items() if key.order == 1)
    return sum(terms, kv.Expression(np.zeros(e.shape)))
