"""Entries of gradients, asked for by name as everything else that is a mapping of symbols."""

from __future__ import annotations

import pytest

import kineverse as kv

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
