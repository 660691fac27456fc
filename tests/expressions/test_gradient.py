"""The law of augmented gradients: random programs against dual numbers and finite differences."""

import gradient_checks as lc
import numpy as np
import pytest
import random_programs as lp
from hypothesis import assume
from hypothesis import strategies as st

import kineverse as kv
from kineverse.expressions import array

WORDS = lp.Vocabulary("law")


def test_gradients_of_random_programs_equal_the_oracle():
    lc.law(lc.general(), WORDS, 40)()


def test_augment_inside_augment():
    lc.law(lc.nested(), WORDS, 25)()


def test_composition():
    lc.law(lc.compositions(), WORDS, 30)()


def test_third_order():
    lc.law(st.one_of(lp.programs(lp.S, 2), lp.nested(lp.S, 2)), WORDS, 30, order=3)()


@lc.examples(20)
@lc.given(lc.SHAPES.flatmap(lambda shape: lp.programs(shape, 3, lp.SMOOTH)))
def test_finite_differences(program):
    e, step = array(lp.build(program, WORDS)), 1e-5
    points = [{**WORDS.values, s: WORDS.values[s] + sign * step} for s in WORDS.symbols for sign in (1, -1)]
    values = [e(p) for p in points]
    jacobian, partial = e.jacobian(WORDS.symbols[:5]), e.partial(WORDS.symbols)
    at = WORDS.values
    assume(max(np.abs(v).max() for v in [*values, jacobian(at)]) < 1e3)
    assume(not _steps(program))
    assert jacobian.shape == (*e.shape, 5)
    assert partial.shape == (*e.shape, 6)
    for i, (up, down) in enumerate(zip(values[::2], values[1::2], strict=True)):
        slope = (up - down) / (2 * step)
        np.testing.assert_allclose(partial(at)[..., i], slope, rtol=1e-4, atol=1e-4)
        if i < 5:
            np.testing.assert_allclose(jacobian(at)[..., i], slope, rtol=1e-4, atol=1e-4)


def _steps(program):
    """Whether a program has steps or kinks, where finite differences say little."""
    kinks = {"floor", "ceil", "mod", "sign", "absolute", "copysign", "minimum", "maximum", "rint", "trunc"}
    kinks |= {"floor_divide", "fmod"}
    return program[0] in kinks or any(_steps(p) for p in program[2:] if isinstance(p, tuple))


DOOR, BOLT = kv.position("door"), kv.position("bolt")
GRADIENT = (2 * DOOR + BOLT).gradient()


def test_entries_by_symbol_and_by_name():
    assert GRADIENT["door:velocity"] is GRADIENT[DOOR.derivative()]
    assert "door:velocity" in GRADIENT
    assert DOOR.derivative() in GRADIENT
    assert GRADIENT.get("door:velocity") == kv.array(2.0)
    assert (GRADIENT.get("dor"), GRADIENT.get(DOOR), GRADIENT.get("dor", 1)) == (None, None, 1)


@pytest.mark.parametrize("key", ["door", DOOR, "dor:velocity", kv.velocity("dor")], ids=str)
def test_other_keys_are_refused(key):
    assert key not in GRADIENT
    with pytest.raises(kv.errors.UnknownNameError) as error:
        GRADIENT[key]
    assert str(error.value).startswith(
        f"The gradient has no entry for '{key}'; its keys are speeds. Did you mean 'door:velocity'"
    )
    assert isinstance(error.value, KeyError)


def test_gradient_of_a_constant_is_empty():
    with pytest.raises(kv.errors.UnknownNameError, match=r"no entry for 'door:velocity'.*no speed at all"):
        kv.array(1.0).gradient()["door:velocity"]
