"""Implicit functions as nodes: equal ones are one, they can be sent, and bad ones are refused."""

import copy
import itertools
import pickle

import implicit_functions as known
import numpy as np
import pytest
from implicit_functions import u, v, x, y
from numpy.testing import assert_allclose

import kineverse as kv
from kineverse.errors import InvalidValueError, ShapeError
from kineverse.expressions import array
from kineverse.expressions.implicit import Implicit, ImplicitFunction, implicit_nodes

a, b, c = (kv.position(f"implicit/{n}") for n in "abc")


def test_equal_content_is_one_node():
    first, second = known.polar().apply([a, b]), known.polar().apply([a, b])
    assert first == second
    assert hash(first) == hash(second)
    assert implicit_nodes([first, second, first * 2]) == implicit_nodes([second])
    assert (first - second)({a: 1.0, b: 0.2}).tolist() == [0.0, 0.0]
    others = [
        known.polar().apply([b, a]),
        known.spherical().apply([a, b, b])[:2],
        _changed(known.polar(), steps=13).apply([a, b]),
        _changed(known.polar(), rows=(2, 1)).apply([a, b]),
        _changed(known.polar(), name="other").apply([a, b]),
        _changed(known.polar(), seed=array([u, v])).apply([a, b]),
        _changed(known.polar(), residual=known.polar().residual * 2).apply([a, b]),
        _changed(known.polar(), inputs=(v, u), seed=array([v, u])).apply([a, b]),
    ]
    assert all(e != o for e, o in itertools.combinations([first, *others], 2))


def _changed(function, **parts):
    names = ("name", "unknowns", "inputs", "residual", "rows", "seed", "steps")
    return ImplicitFunction(**{n: parts.get(n, getattr(function, n)) for n in names})


def test_symbols_of_the_definition_do_not_occur_outside():
    """Its unknowns and inputs are its own: the same symbols outside are others."""
    itself = known.polar().apply([x, y])
    assert set(itself.symbols) == {x, y}
    assert set(itself.gradient()) == {x.derivative(), y.derivative()}
    assert_allclose(itself({x: 3.0, y: 4.0}), [5, np.arctan2(4, 3)])
    assert_allclose(itself.substitute({x: 4.0})({y: 3.0}), [5, np.arctan2(3, 4)])
    swapped = known.polar().apply([v, u])
    assert_allclose(swapped({v: 3.0, u: 4.0}), [5, np.arctan2(4, 3)])
    assert swapped.substitute({u: v, v: u}) == known.polar().apply([u, v])


@pytest.mark.parametrize("function", [known.cubic(), known.polar(), known.spherical()], ids=lambda f: f.name)
def test_pickled_copied_and_deep_copied(function):
    itself = function.apply(function.inputs)
    jacobian = itself.jacobian(function.inputs)
    values = dict(zip(function.inputs, (0.9, 0.3, -0.2), strict=False))
    for other in (pickle.loads(pickle.dumps([itself, jacobian])), copy.deepcopy([itself, jacobian])):
        assert other == [itself, jacobian]
        assert other[1](values).tobytes() == jacobian(values).tobytes()
    assert copy.copy(itself) == itself
    assert pickle.loads(pickle.dumps(function)).key == function.key


def test_an_implicit_node_prints_its_name():
    assert "polar" in repr(known.polar().apply([a, b])) or "implicit" in repr(known.polar().apply([a, b]))
    assert implicit_nodes([known.polar().apply([a, b])])[0].label == "polar"
    assert isinstance(implicit_nodes([known.cubic().apply([a])])[0], Implicit)


@pytest.mark.parametrize(
    ("parts", "error", "text"),
    [
        ({"unknowns": ()}, ShapeError, "'polar' has 0 unknowns"),
        ({"seed": array([u])}, ShapeError, "'polar' has 2 unknowns"),
        ({"seed": array([u, v, v])}, ShapeError, r"\(3,\)"),
        ({"rows": (0,)}, ShapeError, "'polar' has 2 unknowns"),
        ({"rows": (1, 1)}, ShapeError, "'polar': rows are 2 different ones of 3"),
        ({"rows": (1, 3)}, ShapeError, "'polar': rows are 2 different ones of 3"),
        ({"rows": (-1, 1)}, ShapeError, "'polar': rows are 2 different ones of 3"),
        ({"residual": x * y}, ShapeError, "the residual is a vector"),
        (
            {"residual": array([x - a, y - u])},
            InvalidValueError,
            "'polar': the residual is about implicit/a, too",
        ),
        ({"seed": array([x, v])}, InvalidValueError, "'polar': the seed is about unknown/x, too"),
        ({"inputs": (u, v, u)}, InvalidValueError, "'polar': a symbol is given twice"),
        ({"inputs": (u, v, x)}, InvalidValueError, "'polar': a symbol is given twice"),
        ({"unknowns": (x, x)}, InvalidValueError, "'polar': a symbol is given twice"),
        ({"steps": -1}, InvalidValueError, "'polar'.*steps"),
    ],
)
def test_bad_definitions_are_refused(parts, error, text):
    with pytest.raises(error, match=text):
        _changed(known.polar(), **{"rows": (0, 1), **parts})


@pytest.mark.parametrize("count", [0, 1, 3])
def test_the_wrong_number_of_arguments_is_refused(count):
    with pytest.raises(ShapeError, match=f"'polar' is a function of 2 inputs, not of {count}\\."):
        known.polar().apply([a, b, c][:count])


def test_arguments_are_scalars():
    with pytest.raises(ShapeError, match="'polar' is a function of scalars"):
        known.polar().apply([array([a, b]), b])
