"""Implicit functions: values by closed forms, derivatives by the theorem, of any order and augmented."""

import gradient_checks as lc
import gradient_oracle as oracle
import implicit_functions as known
import numpy as np
import pytest
import random_programs as lp
from hypothesis import assume, given
from hypothesis import strategies as st
from implicit_functions import u, v, w
from numpy.testing import assert_allclose

import kineverse as kv
from kineverse.expressions import array
from kineverse.expressions import functions as f
from kineverse.expressions.implicit import implicit_nodes

WORDS = lp.Vocabulary("implicit")
a, b, c = WORDS.positions
FUNCTIONS = {
    "Kepler": (known.kepler(), ((-6, 6), (-0.6, 0.6))),
    "cubic": (known.cubic(), ((-20, 20),)),
    "polar": (known.polar(), ((0.5, 3), (-2, 2))),
    "spherical": (known.spherical(), ((0.8, 2), (-1, 1), (-1, 1))),
}


@pytest.fixture(params=FUNCTIONS)
def function(request):
    return FUNCTIONS[request.param][0]


def points(function, count=40):
    lower, upper = np.array(FUNCTIONS[function.name][1]).T
    return np.random.default_rng(1).uniform(lower, upper, (count, len(lower)))


def at(expression, function, point):
    return expression(dict(zip(function.inputs, map(float, point), strict=True)))


def slopes(of, point, step=1e-5):
    """Return central differences, the last axis over the elements of the point."""
    around = [(of(point + step * e) - of(point - step * e)) / (2 * step) for e in np.eye(len(point))]
    return np.stack(around, axis=-1)


# -- values ------------------------------------------------------------------------------------------------


def test_values_equal_closed_forms():
    cubic = known.cubic().apply([u])
    for p in np.linspace(-30, 30, 61):
        assert_allclose(cubic({u: p}), [known.cubic_root(p)], rtol=0, atol=1e-14)
    polar, spherical = known.polar().apply([u, v]), known.spherical().apply([u, v, w])
    for p in points(known.spherical()):
        wanted = [np.linalg.norm(p), np.arctan2(p[1], p[0]), np.arctan2(p[2], np.hypot(p[0], p[1]))]
        assert_allclose(at(spherical, known.spherical(), p), wanted, rtol=0, atol=1e-14)
        wanted = [np.hypot(p[0], p[1]), np.arctan2(p[1], p[0])]
        assert_allclose(at(polar, known.polar(), p[:2]), wanted, rtol=0, atol=1e-14)


@pytest.mark.parametrize("eccentricity", [0.0, 0.1, 0.6])
def test_kepler_equation_by_its_inverse(eccentricity):
    anomalies = np.linspace(-7, 7, 101)
    solve = kv.compile(known.kepler().apply([u, v]), tier="interpreter")
    means = anomalies - eccentricity * np.sin(anomalies)
    assert_allclose([solve([m, eccentricity])[0] for m in means], anomalies, rtol=0, atol=1e-14)


def test_residuals_are_zero_with_expressions_as_inputs(function):
    arguments = [f.sin(a) * 0.3 + 0.9 + 0.1 * k * b for k in range(len(function.inputs))]
    if function.name == "Kepler":
        arguments[1] = 0.5 * f.cos(b)
    itself = function.apply(arguments)
    residual = function.substitute(function.residual, [itself[i] for i in range(itself.shape[0])], arguments)
    for p, q in np.random.default_rng(2).uniform(-1, 1, (20, 2)):
        assert np.abs(residual({a: p, b: q})).max() < 1e-14


# -- derivatives -------------------------------------------------------------------------------------------


def test_first_and_second_derivatives_by_finite_differences(function):
    itself = function.apply(function.inputs)
    first = itself.jacobian(function.inputs)
    second = first.jacobian(function.inputs)
    third = second.jacobian(function.inputs)
    for p in points(function, 8):
        assert_allclose(
            at(first, function, p), slopes(lambda q: at(itself, function, q), p), rtol=0, atol=1e-8
        )
        assert_allclose(
            at(second, function, p), slopes(lambda q: at(first, function, q), p), rtol=1e-7, atol=1e-7
        )
        assert_allclose(
            at(third, function, p), slopes(lambda q: at(second, function, q), p), rtol=1e-6, atol=1e-6
        )


def test_derivatives_equal_the_implicit_function_theorem_in_numpy(function):
    """x' = -A⁻¹ B, and x'' by differentiating r(x(u), u) = 0 twice."""
    n, k = len(function.unknowns), len(function.inputs)
    everything = [*function.unknowns, *function.inputs]
    first = function.equations.partial(everything)
    numbers = kv.compile([first, first.partial(everything)], everything, tier="interpreter")
    itself = function.apply(function.inputs)
    jacobian = itself.jacobian(function.inputs)
    hessian = jacobian.jacobian(function.inputs)
    for p in points(function, 10):
        one, two = numbers([*at(itself, function, p), *p])
        by_inputs = -np.linalg.solve(one[:, :n], one[:, n:])
        direction = np.vstack([by_inputs, np.eye(k)])
        curvature = -np.einsum(
            "ij,jkl->ikl", np.linalg.inv(one[:, :n]), np.einsum("imn,mk,nl->ikl", two, direction, direction)
        )
        assert_allclose(at(jacobian, function, p), by_inputs, rtol=1e-11, atol=1e-12)
        assert_allclose(at(hessian, function, p), curvature, rtol=1e-10, atol=1e-10)


def test_partial_is_the_same_by_positions_and_by_parameters():
    """Parameters have no D; what they change is asked for by ``partial``, alone and behind coordinates."""
    p, q = kv.parameter("implicit/p", 0.4), kv.parameter("implicit/q", 1.3)
    kepler, polar = known.kepler(), known.polar()
    symbols = [u, v]
    for function, values in ((kepler, {p: 0.4, q: 1.3}), (polar, {p: 0.7, q: 1.3})):
        by_position = function.apply(symbols).partial(symbols)({u: values[q], v: values[p]})
        assert_allclose(function.apply(symbols).jacobian(symbols)({u: values[q], v: values[p]}), by_position)
        fixed = function.apply([q, p])
        assert fixed.gradient() == {}
        assert_allclose(fixed.partial([q, p])(values), by_position, rtol=1e-14)
        twice = function.apply([q, a * p]).partial([p, a, q]).partial([p])
        steps = [
            function.apply([q, a * p]).partial([p, a, q])({**values, a: 0.8, p: values[p] + s})
            for s in (1e-5, -1e-5)
        ]
        assert_allclose(twice({**values, a: 0.8})[..., 0], (steps[0] - steps[1]) / 2e-5, rtol=1e-6, atol=1e-7)


# -- the law -----------------------------------------------------------------------------------------------


def _solved(kind, arguments):
    """Return library and oracle of a function of two programs, bounded so that it has a solution."""

    def run(library, sin, plus, times, make):
        one, two = (sin(e) for e in arguments(library))
        if kind == "Kepler":
            return make(plus(times(2.0, one), 0.4), times(0.5, two))
        return make(plus(one, 2.0), times(1.5, two))

    ours = run(
        True,
        f.sin,
        lambda e, n: e + n,
        lambda n, e: n * e,
        lambda *e: FUNCTIONS[kind][0].apply([array(i) for i in e]),
    )
    if kind == "Kepler":
        ours = ours[0]
    theirs = run(
        False,
        oracle.sin,
        lambda e, n: oracle.add(e, oracle.Value(n)),
        lambda n, e: oracle.mul(oracle.Value(n), e),
        known.kepler_oracle if kind == "Kepler" else known.polar_oracle,
    )
    return ours, theirs


ARGUMENTS = st.one_of(lp.programs(lp.S, 2), lp.nested(lp.S, 2))


@lc.examples(12)
@given(st.sampled_from(["Kepler", "polar"]), ARGUMENTS, ARGUMENTS, st.booleans())
def test_gradients_with_augmented_inputs_and_trends(kind, first, second, wrapped):
    programs = (first, second)
    try:
        with np.errstate(all="ignore"):
            ours, theirs = _solved(
                kind,
                lambda library: [
                    array(lp.build(p, WORDS)) if library else lp.interpret(p, WORDS, WORDS.values)
                    for p in programs
                ],
            )
            if wrapped:
                # Overridden itself, and a factor of something else.
                key, value = WORDS.keys[1], WORDS.values[a]
                ours = ours.augment({key: a}) * a
                theirs = oracle.mul(
                    oracle.augment(theirs, {key: oracle.symbol(a, value)}), oracle.symbol(a, value)
                )
            bound = lc.largest(theirs, 2)
    except oracle.NearKink:
        assume(False)
    assume(np.isfinite(bound) and bound < 1e5)
    lc.check(ours, theirs, WORDS.values)


@lc.examples(10)
@given(st.sampled_from(["Kepler", "polar"]), ARGUMENTS, ARGUMENTS)
def test_substitution_is_composition(kind, first, second):
    """The function of plain symbols, with programs in their places afterwards."""
    symbols, inside = [a, WORDS.symbols[-1]], [("symbol", 0), ("symbol", 5)]
    try:
        with np.errstate(all="ignore"):
            replacements = {
                s: oracle.sin(lp.interpret(p, WORDS, WORDS.values))
                for s, p in zip(symbols, (first, second), strict=True)
            }
            values = {**WORDS.values, **{s: float(r.v) for s, r in replacements.items()}}
            ours, theirs = _solved(
                kind,
                lambda library: [
                    lp.build(p, WORDS) if library else lp.interpret(p, WORDS, values) for p in inside
                ],
            )
            theirs = oracle.composed(theirs, replacements)
            bound = lc.largest(theirs, 2)
    except oracle.NearKink:
        assume(False)
    assume(np.isfinite(bound) and bound < 1e5)
    given_ = {s: f.sin(lp.build(p, WORDS)) for s, p in zip(symbols, (first, second), strict=True)}
    lc.check(array(ours).substitute(given_), theirs, WORDS.values)


def test_nested_implicit_functions():
    """A root of what another root is, in one step and by substitution afterwards."""
    cubic, kepler = known.cubic(), known.kepler()
    inner = cubic.apply([a * b])[0]
    nested = kepler.apply([inner, 0.3 * inner])
    assert nested == kepler.apply([c, 0.3 * c]).substitute({c: inner})
    assert implicit_nodes([nested])[0].function is not implicit_nodes([nested])[1].function
    assert [n.label for n in implicit_nodes([nested])] == ["cubic", "Kepler"]
    values = {a: 1.7, b: 2.1}
    root = known.cubic_root(1.7 * 2.1)
    (found,) = nested(values)
    assert found - 0.3 * root * np.sin(found) == pytest.approx(root, abs=1e-14)
    symbols = [a, b]
    for e in (nested, nested.jacobian(symbols)):
        p = np.array([1.7, 2.1])
        wanted = slopes(lambda q, e=e: e(dict(zip(symbols, q.tolist(), strict=True))), p)
        assert_allclose(e.jacobian(symbols)(values), wanted, rtol=1e-6, atol=1e-7)


def test_an_unused_gradient_and_a_locally_constant_input():
    sharp = known.cubic().apply([a < b])[0]
    assert sharp.gradient(heuristic=False) == {}
    assert set(sharp.gradient()) == {a.derivative(), b.derivative()}
    trend = sharp.gradient()[b.derivative()]({a: 0.1, b: 0.9})
    assert trend == pytest.approx(1 / (3 * known.cubic_root(1.0) ** 2 + 1))
