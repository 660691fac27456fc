"""Continuous boolean logic: values, trends by the table of the papers, De Morgan. ``test_trends`` follows them."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import kineverse as kv
from hypothesis_profiles import attempts
from kineverse import logic
from kineverse.errors import ExpressionError, InvalidValueError, ShapeError
from kineverse.expressions import array
from kineverse.logic import less, logic_and, logic_not, logic_or

JOINTS = [kv.position(f"lock/{name}") for name in "abcdefgh"]
SPEEDS = [joint.derivative() for joint in JOINTS]
a, b, c, d = JOINTS[:4]
da, db, dc, dd = SPEEDS[:4]


def D(e, at, heuristic=True):
    return {key: entry(at) for key, entry in e.gradient(heuristic).items()}


# -- values and trends, against the table of the module ----------------------------------------------------


def conjunction(values):
    """The value and the weight of each operand's gradient, written down once more."""
    everything = np.prod(values, axis=0)
    return everything, [1 - v + everything for v in values]


def disjunction(values):
    nothing = np.prod([1 - v for v in values], axis=0)
    return 1 - nothing, [v + nothing for v in values]


SHAPES = [
    [()],
    [(), ()],
    [(3,), (3,)],
    [(), (3,)],
    [(2, 1), (3,), ()],
    [(2, 3)] * 4,
    [(1,), (), (), (2, 1), (2, 2)],
]


@pytest.mark.parametrize("shapes", SHAPES, ids=str)
@pytest.mark.parametrize(("join", "table"), [(logic_and, conjunction), (logic_or, disjunction)])
def test_any_number_of_operands_of_any_shapes(join, table, shapes):
    rng = np.random.default_rng(3)
    values = [rng.uniform(0, 1, shape) for shape in shapes]
    entries = [rng.uniform(-2, 2, shape) for shape in shapes]
    # Operand i has the value values[i] where joint i is 0, and its own gradient.
    operands = [
        (v + joint).with_gradient({speed: g, kv.velocity("shared"): 2 * g})
        for v, g, joint, speed in zip(values, entries, JOINTS, SPEEDS, strict=False)
    ]
    e = join(*operands)
    at = dict.fromkeys(JOINTS, 0.0)
    value, weights = table(np.broadcast_arrays(*values))
    assert e.shape == value.shape
    np.testing.assert_allclose(e(at), value, atol=1e-15)
    trend = D(e, at)
    assert set(trend) == {*SPEEDS[: len(shapes)], kv.velocity("shared")}
    for speed, weight, g in zip(SPEEDS, weights, entries, strict=False):
        np.testing.assert_allclose(trend[speed], weight * g, atol=1e-14)
    shared = sum(2 * w * g for w, g in zip(weights, entries, strict=True))
    np.testing.assert_allclose(trend[kv.velocity("shared")], shared, atol=1e-14)


def test_not_of_any_shape():
    for e in (a, array([a, b * a]), array([[a], [0.25]])):
        at = {a: 0.3, b: -0.5}
        np.testing.assert_allclose(logic_not(e)(at), 1 - e(at))
        for key, entry in D(e, at).items():
            np.testing.assert_allclose(D(~e, at)[key], -entry)
    assert (~array([a, b])).shape == (2,)


@pytest.mark.parametrize("contrast", [0.5, 1, 30.0, None])
def test_less_of_any_shapes(contrast):
    options = {} if contrast is None else {"contrast": contrast}
    steepness = 1e10 if contrast is None else contrast
    left, right = array([[a], [b * b], [1.0]]), array([a + 0.5, c])
    at = {a: 0.3, b: -0.9, c: 0.81}
    e, difference = less(left, right, **options), right(at) - left(at)
    assert e.shape == (3, 2)
    np.testing.assert_allclose(e(at), (1 + np.tanh(difference * steepness)) / 2, atol=1e-15)
    # The trend is that of the difference, whatever the contrast.
    assert D(e, at) == {
        da: pytest.approx(np.array([[0, -1], [1, 0], [1, 0]])),
        db: pytest.approx(np.array([[0, 0], [1.8, 1.8], [0, 0]])),
        dc: pytest.approx(np.array([[0, 1], [0, 1], [0, 1]])),
    }


def test_contrast_is_one_over_the_width_of_the_change():
    for contrast in (0.1, 1.0, 10.0, 1e4):
        e = less(0, a, contrast=contrast)
        assert e({a: 1 / contrast}) == pytest.approx((1 + math.tanh(1)) / 2)
        assert e({a: -1 / contrast}) == pytest.approx((1 - math.tanh(1)) / 2)
    assert less(0, a)({a: 1e-8}) == 1
    assert less(0, a)({a: -1e-8}) == 0
    assert less(a, b, contrast=2) != less(a, b, contrast=3)
    assert less(a, b) == less(a, b, contrast=1e10)


def test_less_is_half_at_equality():
    for e in (a < b, a > b, a <= b, a >= b, less(a, b, contrast=2), ~(a < b)):
        assert e({a: 0.7, b: 0.7}) == 0.5
        assert set(np.abs([*D(e, {a: 0.7, b: 0.7}).values()])) == {1}
    assert (a < a)({a: 3}) == 0.5
    assert not (a < a).gradient()
    assert ((a < b) & (b < a))({a: 1, b: 1}) == 0.25
    assert ((a < b) | (b < a))({a: 1, b: 1}) == 0.75
    assert kv.where(a < b, 1, 2)({a: 1, b: 1}) == 1  # .5 counts as true


def test_operators_are_the_functions():
    assert (a < b) == less(a, b) == (b > a) == (a <= b) == (b >= a)
    assert (a > 1) == less(1, a)
    assert (a & b) == logic_and(a, b)
    assert (1 & a) == logic_and(1, a)
    assert (a | b) == logic_or(a, b)
    assert (0.5 | a) == logic_or(0.5, a)
    assert ~a == logic_not(a)
    assert (a & b) != (a | b)
    assert (a & b) != a * b
    assert ~a != 1 - a


def test_conjunctions_in_conjunctions_are_flattened():
    e, f = (a < b), (c < d)
    for operator, join in ((lambda x, y: x & y, logic_and), (lambda x, y: x | y, logic_or)):
        flat = join(e, f, a, b)
        assert operator(operator(operator(e, f), a), b) == flat
        assert operator(e, operator(f, operator(a, b))) == flat
        assert operator(operator(e, f), operator(a, b)) == flat
        assert join(flat) == flat
        assert join(array([e, f]), join(a, b)) == join(array([e, f]), a, b)
        assert join(e) is e
        assert join(a) != a, "as a fact a truth is constant, and a is not"
    # One inside of the other stays: it is an operand of its own.
    mixed = (a & b) | (c & d)
    at = {a: 0.9, b: 0.3, c: 0.2, d: 0.6}
    x, y = 0.27, 0.12
    assert mixed(at) == pytest.approx(1 - (1 - x) * (1 - y))
    nothing = (1 - x) * (1 - y)
    assert D(mixed, at)[da] == pytest.approx((x + nothing) * (0.1 + x))
    assert D(mixed, at)[dc] == pytest.approx((y + nothing) * (0.8 + y))
    # Of an array of conjunctions, one is an operand like any other.
    part = logic_and(array([a, b]), c)[0]
    assert D(part & d, at)[dd] == pytest.approx(1 - 0.6 + 0.18 * 0.6)
    assert D(part & d, at)[da] == pytest.approx((1 - 0.18 + 0.18 * 0.6) * (0.1 + 0.18))


# -- random formulas ---------------------------------------------------------------------------------------


def formulas(leaves, negated=False):
    """Nested tuples of "and", "or" and, if wanted, "not"."""

    def grow(inner):
        joined = st.tuples(st.sampled_from(["and", "or"]), st.lists(inner, min_size=1, max_size=3))
        several = joined.map(lambda x: (x[0], *x[1]))
        return st.one_of(several, inner.map(lambda x: ("not", x))) if negated else several

    return st.recursive(leaves, grow, max_leaves=6)


def build(formula):
    if isinstance(formula, kv.Expression):
        return formula
    kind, *operands = formula
    return {"and": logic_and, "or": logic_or, "not": logic_not}[kind](*map(build, operands))


def dual(formula):
    """Return the negation with all negations at the leaves."""
    if isinstance(formula, kv.Expression):
        return ("not", formula)
    kind, *operands = formula
    return formula[1] if kind == "not" else ({"and": "or", "or": "and"}[kind], *map(dual, operands))


SOFT = st.sampled_from([*JOINTS[:4], ~a, a * b, less(b, c, contrast=2), array([a, c]), array([[b], [d]])])
SHARP = st.builds(
    lambda i, threshold, down: JOINTS[i] < threshold if down else threshold < JOINTS[i],
    st.integers(0, 3),
    st.sampled_from([-1.0, 0.0, 1.0]),
    st.booleans(),
)
# 0 and 1 are worth most looking at, and never at a threshold of SHARP.
SOFT_POINTS = st.lists(st.sampled_from([0.0, 1.0, 0.25, 0.8, 0.5]), min_size=4, max_size=4)
SHARP_POINTS = st.lists(st.sampled_from([-1.5, -0.5, 0.5, 1.5]), min_size=4, max_size=4)


def agree(e, f, at):
    assert e.shape == f.shape
    np.testing.assert_allclose(e(at), f(at), atol=1e-12)
    first, second = D(e, at), D(f, at)
    for key in {*first, *second}:
        np.testing.assert_allclose(first.get(key, 0 * e(at)), second.get(key, 0 * e(at)), atol=1e-12)


@settings(max_examples=attempts(60))
@given(formulas(SOFT), SOFT_POINTS)
def test_de_morgan(formula, point):
    """Values and trends alike, to any depth."""
    agree(~build(formula), build(dual(formula)), dict(zip(JOINTS, point, strict=False)))


@settings(max_examples=attempts(40))
@given(formulas(SHARP, negated=True), SHARP_POINTS)
def test_de_morgan_with_negations_anywhere(formula, point):
    """Where everything is true or false, it does not matter how a formula is written."""
    agree(~build(formula), build(dual(formula)), dict(zip(JOINTS, point, strict=False)))


@settings(max_examples=attempts(40))
@given(formulas(SHARP, negated=True), SHARP_POINTS)
def test_values_equal_those_of_python(formula, point):
    at = dict(zip(JOINTS, point, strict=False))

    def truth(f):
        if isinstance(f, kv.Expression):
            return f(at) > 0.5
        kind, *operands = f
        found = [truth(o) for o in operands]
        return {"and": all(found), "or": any(found), "not": not found[0]}[kind]

    assert build(formula)(at) == truth(formula)


@pytest.mark.parametrize("truths", list(itertools.product([0.0, 1.0], repeat=3)), ids=str)
def test_trend_of_and_ignores_true_operands(truths):
    at = dict(zip((a, b, c), truths, strict=True))
    for join, holding in ((logic_and, 1.0), (logic_or, 0.0)):
        trend = D(join(a, b, c), at)
        # While something is wrong, exactly what is wrong moves; when nothing is, all of it counts again.
        settled = all(t == holding for t in truths)
        for speed, t in zip((da, db, dc), truths, strict=True):
            assert trend[speed] == (1 if settled or t != holding else 0)


# -- bad input ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("contrast", [0, -1, -1e10, math.inf, -math.inf, math.nan, "sharp", None, [1, 2], a])
def test_contrast_is_a_positive_number(contrast):
    with pytest.raises(InvalidValueError, match="contrast is a positive number"):
        less(a, b, contrast=contrast)


def test_operands_that_are_not_numbers_are_refused():
    for join, name in ((logic_and, "and"), (logic_or, "or")):
        with pytest.raises(ExpressionError, match=f"'{name}' needs at least one operand"):
            join()
        with pytest.raises(ShapeError, match=r"\(2,\) and \(3,\)"):
            join(array([a, b]), array([a, b, c]))
        with pytest.raises(InvalidValueError, match="NaN"):
            join(a, math.nan)
    with pytest.raises(ShapeError, match=r"\(2,\) and \(3,\)"):
        less(array([a, b]), np.zeros(3))
    for bad in (lambda: less(math.nan, a), lambda: a < np.array([1, math.nan]), lambda: logic_not(math.nan)):
        with pytest.raises(InvalidValueError, match="NaN"):
            bad()
    with pytest.raises(ExpressionError, match="is not an expression or a number"):
        logic_or(a, "open")
    for chained in (lambda: 0 < a < 1, lambda: a and b, lambda: a or b, lambda: not a):
        with pytest.raises(ExpressionError, match="no truth value"):
            chained()


def test_nodes_are_shared_and_named():
    assert (a < b)._nodes == (a < b)._nodes
    assert {type(n) for n in ((a < b) & ~c)._nodes} == {logic.And}
    for e in (a < b, ~a, a & b, a | b):
        assert {a, *e.symbols} <= {a, b}
        assert not e.is_constant
    assert less(1, 2).is_constant
    assert float(less(1, 2) & ~less(2, 1)) == 1
