"""What is compared between library and oracle; shared by the law tests and by the mutants that must fail them."""

import itertools

import gradient_oracle as oracle
import numpy as np
import random_programs as lp
from hypothesis import HealthCheck, Phase, assume, given, settings
from hypothesis import strategies as st

from hypothesis_profiles import attempts
from kineverse.expressions import array
from kineverse.symbols import Symbol

MODES = (True, False)


def numbers(expressions, values):
    """Return the values of many expressions with one evaluation."""
    if not expressions:
        return []
    flat = np.concatenate([e.ravel() for e in expressions])(values)
    parts = np.split(flat, np.cumsum([e.size for e in expressions])[:-1])
    return [p.reshape(e.shape) for p, e in zip(parts, expressions, strict=True)]


def close(actual, wanted, scale=1.0):
    assert actual.shape == wanted.shape
    assert np.isfinite(actual).all()
    np.testing.assert_allclose(actual, wanted, rtol=1e-8, atol=1e-9 * scale)


def check(expression, value, values, order=2):
    """Compare value, D in both modes, and D of a few entries in both modes, with the oracle."""
    wanted, layer = [(expression, value)], [(expression, value)]
    for _ in range(order):
        following = []
        for (e, v), mode in itertools.product(layer, MODES):
            entries = e.gradient(mode)
            expected = {k: entry for k, entry in v.D(mode).items() if isinstance(k, Symbol)}
            missing = set(entries) - set(expected)
            assert not missing, f"keys that nothing accounts for: {missing}"
            for key, entry in expected.items():
                found = entries.get(key)
                if found is None:  # entries that are structurally zero are left out
                    found = array(np.zeros(e.shape))
                following.append((found, entry))
        wanted += following
        layer = following[:3]
    for actual, (_, v) in zip(numbers([e for e, _ in wanted], values), wanted, strict=True):
        expected = np.broadcast_to(v.v, actual.shape)
        close(actual, expected, scale=1 + np.abs(expected).max(initial=0))


def check_program(program, vocabulary, order=2):
    """Check one program, unless its oracle says that nothing can be said."""
    values = vocabulary.values
    try:
        with np.errstate(all="ignore"):
            value = lp.interpret(program, vocabulary, values)
            bound = largest(value, order)
    except oracle.NearKink:
        assume(False)
    assume(np.isfinite(bound) and bound < 1e5)
    check(array(lp.build(program, vocabulary)), value, values, order)


def largest(value, order):
    """Return the largest number among value and derivatives; beyond some size only rounding is compared."""
    numbers_found = [np.abs(value.v).max(initial=0)]
    if order:
        numbers_found += [largest(entry, order - 1) for mode in MODES for entry in value.D(mode).values()]
    return np.max(numbers_found)


SHAPES = st.sampled_from([lp.S, lp.V3, lp.M23, lp.M33])


def examples(count, **options):
    """Settings: as many examples, always the same ones."""
    return settings(
        max_examples=attempts(count),
        derandomize=True,
        database=None,
        deadline=None,
        suppress_health_check=list(HealthCheck),
        report_multiple_bugs=False,
        **options,
    )


def law(strategy, vocabulary, count, order=2):

    @examples(count)
    @given(strategy)
    def run(program):
        check_program(program, vocabulary, order)

    return run


def corpus(strategy, count):
    """Return programs of a strategy, always the same ones."""
    drawn = []

    @examples(count, phases=[Phase.generate])
    @given(strategy)
    def run(program):
        drawn.append(program)

    run()
    return drawn


def general(depth=3):
    return SHAPES.flatmap(lambda shape: lp.programs(shape, depth))


def nested():
    return st.sampled_from([lp.S, lp.V3]).flatmap(lp.nested)


def compositions():
    return st.sampled_from([lp.S, lp.V3]).flatmap(lp.compositions)
