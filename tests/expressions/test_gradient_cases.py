"""What went wrong in earlier implementations, and the rest of the law that is said in single cases."""

import numpy as np
import pytest

from kineverse import logic
from kineverse.errors import ExpressionError
from kineverse.expressions import array, gradient_keys, total_derivative
from kineverse.expressions import functions as f
from kineverse.spatial import inverse, rotation_z, translation
from kineverse.symbols import Symbol, parameter, position, velocity

a, b, c, w = position("a"), position("b"), position("c"), velocity("wheel")
da, db, dc = a.derivative(), b.derivative(), c.derivative()
AT = {a: 0.4, b: -0.7, c: 1.3}


@pytest.fixture
def g():
    """An expression of the value of a whose ∂/∂a is 4."""
    return a.augment({da: 4})


def D(e, heuristic=True):
    return {str(k): entry(AT) for k, entry in e.gradient(heuristic).items()}


@pytest.mark.parametrize(
    ("make", "slope"),
    [
        (lambda g: g - 3, 4),
        (lambda g: 3 - g, -4),
        (lambda g: g + a, 5),
        (lambda g: a + g, 5),
        (lambda g: g * a, 4 * 0.4 + 0.4),
        (lambda g: a * g, 4 * 0.4 + 0.4),
        (lambda g: g / 2, 2),
        (lambda g: 1 / g, -4 / 0.16),
        (lambda g: a / g, (0.4 - 0.4 * 4) / 0.16),
        (lambda g: g / a, (4 * 0.4 - 0.4) / 0.16),
        (lambda g: g**2, 2 * 0.4 * 4),
        (lambda g: 2**g, np.log(2) * 2**0.4 * 4),
        (lambda g: -g, -4),
        (lambda g: +g, 4),
        (lambda g: np.sin(g), 4 * np.cos(0.4)),
        (lambda g: np.float64(2) * g, 8),
        (lambda g: (np.array([1.0, 2.0]) * g)[1], 8),
        (lambda g: abs(-g), 4),
        (lambda g: g % 0.3, 4),
        (lambda g: 1 % g, -2 * 4),
        (lambda g: g // 0.3 + g, 4),
    ],
)
def test_operators_with_an_overridden_operand(g, make, slope):
    assert D(make(g)) == pytest.approx({"a:velocity": slope})


def test_in_place_operators_equal_the_binary_ones(g):
    e = g
    e -= b
    e *= 2
    e += a
    e /= 4
    e **= 2
    value = (2 * (0.4 + 0.7) + 0.4) / 4
    assert e(AT) == pytest.approx(value**2)
    assert D(e) == pytest.approx({"a:velocity": 2 * value * 9 / 4, "b:velocity": -value})
    assert D(g) == {"a:velocity": 4}  # what e was made from is what it was


def test_the_override_belongs_to_the_node(g):
    assert D(np.sin(g) + np.sin(a)) == pytest.approx({"a:velocity": 5 * np.cos(0.4)})


def test_matrices_of_overridden_entries(g):
    m, n = array([[g, b], [1.0, g]]), array([[c, g], [g, 2.0]])
    product, slope = (m @ n)(AT), (m @ n).gradient()[da](AT)
    assert product == pytest.approx(m(AT) @ n(AT))
    dm, dn = m.gradient()[da](AT), n.gradient()[da](AT)
    assert slope == pytest.approx(dm @ n(AT) + m(AT) @ dn)
    assert np.linalg.inv(m).gradient()[da](AT) == pytest.approx(
        -np.linalg.inv(m(AT)) @ dm @ np.linalg.inv(m(AT))
    )


def test_inverse_of_a_transform_of_overridden_entries(g):
    a_T_b = translation(g, b, 1) @ rotation_z(g)
    by_matrix = np.linalg.inv(a_T_b)
    assert inverse(a_T_b)(AT) == pytest.approx(by_matrix(AT))
    assert inverse(a_T_b).gradient()[da](AT) == pytest.approx(by_matrix.gradient()[da](AT))


def test_slices_of_overridden_arrays():
    e = array([a, b, c]).augment({w: [1, 2, 3], da: 7})
    assert D(e[1]) == {"a:velocity": 7, "b:velocity": 1, "wheel:velocity": 2}
    assert D(np.concatenate([e[::-1], [a]])[3]) == {"a:velocity": 1}
    assert D(e[::-1][0]) == {"a:velocity": 7, "c:velocity": 1, "wheel:velocity": 3}


def test_a_scalar_entry_fits_every_shape():
    e = array([[a, b], [b, a]]).augment({w: a})
    assert e.gradient()[w].shape == (2, 2)
    assert e.gradient()[w](AT) == pytest.approx(np.full((2, 2), 0.4))


def test_with_gradient_is_the_whole_gradient(g):
    assert D((g * b).with_gradient({w: c})) == {"wheel:velocity": 1.3}
    assert dict((g * b).with_gradient({}).gradient()) == {}


def test_zero_entries_count_as_absent(g):
    assert dict(g.with_gradient({w: 0}).gradient()) == {}
    assert D(g.augment({w: 0})) == {"a:velocity": 4}
    assert dict(g.augment({da: 0}).gradient()) == {}
    assert g.with_gradient({w: 0}) == g.with_gradient({})


def test_equal_augmentations_cancel():
    first, second = (a * b).augment({w: c, da: 2}), (a * b).augment({da: 2, w: c})
    assert dict((first - second).gradient()) == {}
    assert (first - second) == 0
    assert dict((first - (a * b).augment({w: c, da: 3})).gradient()) != {}
    difference = a.augment({w: 1}) - a.augment({w: 1}, heuristic=True)
    assert dict(difference.gradient()) == {}
    assert dict(difference.gradient(heuristic=False)) == {w: array(1.0)}


def test_is_constant_is_false_with_a_gradient():
    assert array(3.0).is_constant
    assert not array(3.0).augment({w: 1}).is_constant
    assert array(3.0).augment({w: 1}).symbols == ()
    assert array(3.0).augment({w: 1}).with_gradient({}).is_constant
    assert (a * 0).is_constant
    assert not array(3.0).augment({w: 1}, heuristic=True).is_constant


def test_the_column_of_a_symbol_is_the_entry_of_its_derivative():
    e = array([a * b, da * a]).augment({w: [1, 2]})
    j = e.jacobian([a, da, position("wheel"), c])
    assert j.shape == (2, 4)
    assert j({**AT, da: 5.0}) == pytest.approx(np.array([[-0.7, 0, 1, 0], [5, 0.4, 2, 0]]))
    assert D(e.jacobian([da])[1, 0]) == {"a:velocity": 1}
    assert dict((a * da).gradient()) == {da: da, Symbol("a", 2): a}


def test_jacobians_of_every_shape():
    for e in (a * b, array([a, b, a * b]), array([[a, b, 1], [c, a * c, 2]])):
        for symbols in ([], [b], [a, c, b]):
            j = e.jacobian(symbols)
            assert j.shape == (*e.shape, len(symbols)) == e.partial(symbols).shape
            for i, s in enumerate(symbols):
                entry = e.gradient().get(s.derivative(), 0 * e)
                assert j[..., i](AT) == pytest.approx(entry(AT))
    third = array([[a, b], [c, a * b]]).jacobian([a, b]).jacobian([b])
    assert third.shape == (2, 2, 2, 1)
    assert third(AT)[1, 1, 0, 0] == 1


def test_facts_and_heuristics():
    e = a.augment({da: 4, w: 2}, heuristic=True)
    assert D(e) == {"a:velocity": 4, "wheel:velocity": 2}
    assert D(e, heuristic=False) == {"a:velocity": 1}
    assert D(e.augment({db: 3}), heuristic=False) == {"a:velocity": 1, "b:velocity": 3}
    lock = logic.less(a, b)
    assert D(lock * c, heuristic=False) == {"c:velocity": 0}
    assert D(lock * c) == {"a:velocity": -1.3, "b:velocity": 1.3, "c:velocity": 0}
    assert e.jacobian([a], heuristic=False)(AT) == pytest.approx([1])


def test_total_derivative_ignores_trends():
    e = array([a * b, b]).augment({w: [1, c]}).augment({da: 9}, heuristic=True) * (a < b)
    rate = total_derivative(e)
    at = {**AT, da: 2.0, db: 3.0, w: 5.0}
    truth = (a < b)(AT)
    assert rate(at) == pytest.approx(truth * np.array([-0.7 * 2 + 0.4 * 3 + 5, 3 + 1.3 * 5]))
    assert total_derivative(e, heuristic=True)(at) != pytest.approx(rate(at))
    assert total_derivative(a) is da
    assert total_derivative(parameter("p", 2)) == 0
    assert total_derivative(array(3.0).augment({w: 2}))({w: 0.5}) == 1
    assert total_derivative(array([[1.0, 2.0]])).shape == (1, 2)


def test_partials_are_those_of_the_value():
    p = parameter("p", 2.0)
    e = (p * a**2).augment({da: 100, w: 3}) * p
    assert e.partial([a, p, b])(AT) == pytest.approx([4 * 2 * 0.4, 2 * 2 * 0.16, 0])
    assert e.partial(s for s in (a, p))(AT) == pytest.approx([3.2, 0.64])
    assert f.norm(array([a, p])).partial([a, p])({a: 0, p: 0}) == pytest.approx([0, 0])
    with pytest.raises(ExpressionError, match=r"use partial\(\[\.\.\.\]\)"):
        e.jacobian([p])


def test_gradient_keys_are_found_without_differentiating():
    e = f.where(logic.less(c, 1), a.augment({w: b}), f.norm(array([b, 2.0]))) + 3
    assert gradient_keys(e) == {da, w, db} == set(e.gradient())
    lock = (a < b) * c
    assert gradient_keys(lock) == {da, db, dc}
    assert gradient_keys(lock, heuristic=False) == {dc} == set(lock.gradient(False))
    assert gradient_keys((a * b).with_gradient({w: 1})) == {w}
    assert gradient_keys(a.augment({w: 1}, heuristic=True), heuristic=False) == {da}


def test_keys_are_sorted():
    z, y = position("z"), position("y")
    for e in (z * y * a, f.maximum(z * y, a), (z < y) & (a < 1), (z * a).augment({y.derivative(): 1})):
        assert list(e.gradient()) == sorted(e.gradient(), key=lambda s: s.sort_key)


def test_the_derivatives_of_a_product_of_wheels_need_not_commute():
    heading = position("heading").augment({w: 1, velocity("other"): -1})
    x = position("x").augment({w: np.cos(heading), velocity("other"): 1})
    first = x.gradient()[w].gradient().get(velocity("other"))
    second = x.gradient()[velocity("other")].gradient().get(w)
    assert first({"heading": 0.3}) == pytest.approx(np.sin(0.3))
    assert second is None
