"""Enclosures of implicit functions contain their solutions."""

import math

import numpy as np
import pytest

import kineverse as kv
from kineverse.expressions import array
from kineverse.expressions.implicit import ImplicitFunction
from kineverse.intervals.arithmetic import REALS
from kineverse.intervals.enclosure import Enclosures
from kineverse.intervals.graph import TermGraph
from kineverse.intervals.taylor import taylor_variable

X, U, Q = kv.position("unknown"), kv.position("input"), kv.position("q")
CUBIC = ImplicitFunction("cubic", (X,), (U,), array([X**3 + X - U]), (0,), array([U / 2]), 12)


def enclosed(low, high):
    terms = TermGraph({})
    (root,) = CUBIC.apply([Q])
    (series,) = Enclosures(terms).enclose([terms.term(root)], {Q: taylor_variable((low, high))})
    return series


@pytest.mark.parametrize("low", np.linspace(-2, 2, 9))
def test_values_and_slopes_of_an_implicit_function_are_enclosed(low):
    high = low + 0.05
    series = enclosed(low, high)
    for u in np.linspace(low, high, 7):
        x = 2 / math.sqrt(3) * math.sinh(math.asinh(1.5 * math.sqrt(3) * u) / 3)
        assert series[0][0] <= x <= series[0][1]
        assert series[1][0] <= 1 / (3 * x * x + 1) <= series[1][1]
    assert series[0][1] - series[0][0] < 0.1


def test_nothing_is_known_over_an_unbounded_interval():
    assert enclosed(-math.inf, math.inf) == (REALS,)
