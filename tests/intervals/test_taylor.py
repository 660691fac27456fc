"""Taylor coefficients over an interval enclose those at its points, which automatic differentiation gives."""

import math
from functools import cache

import casadi as ca
import pytest
from hypothesis import given
from hypothesis import strategies as st

import kineverse as kv
from kineverse.expressions import array
from kineverse.expressions import functions as f
from kineverse.intervals.enclosure import Enclosures
from kineverse.intervals.graph import TermGraph, reachable_terms
from kineverse.intervals.taylor import TAYLOR_ORDER, taylor_variable

X = kv.position("x")
CURVES = {
    "polynomial": X**3 - 2 * X + 0.5,
    "quotient": (X + 1) / (X * X + 2),
    "sine and cosine": f.sin(2 * X) * f.cos(X - 0.3),
    "root": f.sqrt(X * X + 1.5),
    "exponential": f.exp(-X) + f.log(X + 3),
    "arctangents": f.arctan(X) + f.arctan2(f.sin(X) + 0.2, f.cos(X) + 1.5),
    "arcsine": f.arcsin(X / 4),
    "spline": kv.spline(X, [-2, 0, 1, 2], [0.0, 1.0, -1.0, 2.0]),
    "minimum": f.minimum(X, 1 - X),
    "maximum": f.maximum(X, 1 - X),
    "between": f.clip(X, -0.5, 0.5) + f.absolute(X),
    "where": f.where(X < 0.2, X * X, 3 * X),
    "logic": (X < 0.5) & ~(X < -0.5),
}
KINKED = ("spline", "minimum", "maximum", "between", "where", "logic")


@cache
def coefficients(name):
    """Derivatives of the value by x over factorials, as a function, by CasADi on the plain graph."""
    sx, found = CURVES[name].casadi, []
    for k in range(TAYLOR_ORDER + 1):
        found.append(sx / math.factorial(k))
        sx = ca.jacobian(sx, X.casadi)
    return ca.Function("coefficients", [X.casadi], [ca.vertcat(*found)])


@pytest.mark.parametrize("name", CURVES)
@given(data=st.data())
@pytest.mark.sampled(2)
def test_series_enclose_the_coefficients_at_points(name, data):
    low = data.draw(st.floats(-1.5, 1.4))
    high = low + data.draw(st.floats(0.0, 0.4))
    x = min(max(low + data.draw(st.floats(0, 1)) * (high - low), low), high)
    exact_series = coefficients(name)(x).full().ravel()
    terms = TermGraph({})
    (series,) = Enclosures(terms).enclose([terms.term(CURVES[name])], {X: taylor_variable((low, high))})
    for k, ((below, above), exact) in enumerate(zip(series, exact_series, strict=False)):
        if math.isfinite(exact) and (k == 0 or name not in KINKED):
            error = 1e-12 * max(1.0, abs(exact))
            assert below - error <= exact <= above + error, k


def test_equal_operations_are_one_term():
    terms = TermGraph({})
    first, second = terms.elements(array([f.sin(X) * 2, f.sin(X) * 2]))
    assert first is second
    assert terms.term(X - 0.0) is terms.term(X)


def test_differences_in_either_order_share_their_decider():
    terms = TermGraph({})
    y = kv.position("y")
    one, other = terms.elements(array([y > X, y < X]))
    deciders = {d.args[0].index if d.op == ca.OP_NEG else d.index for d in (*one.deciders, *other.deciders)}
    assert len(deciders) == 1


def test_given_symbols_are_constants():
    term = TermGraph({X: 2.0}).term(X * 3)
    assert all(t.op != ca.OP_PARAMETER for t in reachable_terms((term,)))


def test_reachable_terms_come_after_their_arguments():
    found = reachable_terms((TermGraph({}).term(CURVES["where"]),))
    numbers = [t.index for t in found]
    assert numbers == sorted(numbers)
    assert all(a.index < t.index for t in found for a in t.args)
