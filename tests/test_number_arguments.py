"""Who takes a number takes the same things for one, everywhere; nothing is cut off in silence."""

from __future__ import annotations

import warnings
from fractions import Fraction

import numpy as np
import pytest

import kineverse as kv

a = kv.position("a")
MODEL = kv.Model()
with MODEL.edit() as _edit:
    _edit.constrain("c", 5, a, 6)
COMPILED = kv.compile(2 * a, tier="interpreter")

TAKERS = {
    "call": lambda x: (2 * a)({"a": x}) / 2,
    "compiled": lambda x: COMPILED({"a": x}) / 2,
    "state": lambda x: kv.State({"a": x})["a"],
    "updated": lambda x: kv.State({a: 0}).updated({a: x})[a],
    "extended": lambda x: kv.State().extended({a: x})[a],
    "parameter": lambda x: kv.parameter("p", x).value,
    "violations": lambda x: MODEL.violations({"a": x})[0].value,
}

NO_NUMBERS = [
    1j, np.complex128(0.5 + 2j), np.complex64(0.5), np.array(0.5 + 2j), "0.5", b"1", bytearray(b"1"), np.str_("1"),
    np.array("1"), np.array([0.5]), np.array([0.5, 1]), [0.5], None, {}, 10**400, np.timedelta64(3, "s"),
]  # fmt: skip

NUMBERS = [0.5, 1, np.float32(0.5), np.float64(0.5), np.int8(1), np.array(0.5), Fraction(1, 2)]


@pytest.mark.parametrize("value", NO_NUMBERS, ids=repr)
@pytest.mark.parametrize("taker", TAKERS)
def test_values_that_are_not_real_numbers_are_refused(taker, value) -> None:
    with warnings.catch_warnings(), pytest.raises(kv.errors.InvalidValueError, match="number"):
        warnings.simplefilter("ignore")  # numpy's own, which a user may not look at
        TAKERS[taker](value)


@pytest.mark.parametrize("value", NUMBERS, ids=repr)
@pytest.mark.parametrize("taker", TAKERS)
def test_real_numbers_of_any_type_are_accepted(taker, value) -> None:
    assert TAKERS[taker](value) == float(value)
