"""Values by name, columns by position, and what is said to those who mean something else."""

from __future__ import annotations

import math
import pickle

import numpy as np
import pytest

import kineverse as kv
from kineverse.expressions.gradient import Gradient

door, bolt, length = kv.position("kitchen/door"), kv.position("kitchen/bolt"), kv.parameter("length", 2.0)
e = length * np.sin(door) + bolt


def test_unknown_names_are_refused() -> None:
    assert e({"kitchen/door": 0.0, "kitchen/bolt": 1.0}) == 1
    with pytest.raises(
        kv.errors.UnknownNameError,
        match=r"Unknown symbol 'door'. Did you mean 'kitchen/door'\?.* go into kv\.State\(\{\.\.\.\}\)",
    ):
        e({"kitchen/door": 0.0, "kitchen/bolt": 1.0, "door": 1.0})
    with pytest.raises(kv.errors.UnknownNameError, match=r"Unknown symbol 'lenght'\. Did you mean 'length'"):
        e({"kitchen/door": 0.0, "kitchen/bolt": 1.0, "lenght": 1.0})
    with pytest.raises(kv.errors.UnknownNameError, match="Unknown symbol 'drawer'"):
        (2 * kv.position("lid"))(lid=1.0, drawer=2.0)


def test_states_may_contain_more_symbols() -> None:
    world = kv.State({"kitchen/door": 0.5, "kitchen/bolt": 1.0, "drawer": 3.0})
    assert e(world) == 2 * math.sin(0.5) + 1
    entry = e.gradient()[door.derivative()]
    assert entry(world) == entry({door: 0.5, bolt: 1.0}) == 2 * math.cos(0.5)
    assert e.gradient()[bolt.derivative()]({"kitchen/door": 0.5, "kitchen/bolt": 1.0}) == 1


@pytest.mark.parametrize("call", [math.sin, math.sqrt, math.floor, float, int, math.hypot])
def test_math_functions_of_expressions_name_those_of_numpy(call) -> None:
    with pytest.raises(kv.errors.ExpressionError, match=r"np\.sin\(q\), not math\.sin\(q\)"):
        call(door)
    assert float(kv.array(2.5)) == 2.5
    assert int(kv.array(2.5)) == 2


def test_jacobian_by_speeds_is_refused() -> None:
    speeds = [door.derivative(), bolt.derivative()]
    with pytest.raises(
        kv.errors.ExpressionError,
        match=r"'kitchen/door:velocity' is a speed.*named by positions: that of 'kitchen/door' is",
    ):
        e.jacobian(speeds)
    with pytest.raises(
        kv.errors.ExpressionError,
        match=r"Pass positions, as model\.degrees_of_freedom, or read e\.gradient\(\)",
    ):
        kv.load("kitchen").fk("kitchen/fridge_door").jacobian(kv.load("kitchen").speeds)
    # Columns that are zero for another reason are what they are.
    assert e.jacobian([kv.position("drawer")])({door: 0, bolt: 0}).tolist() == [0]
    assert e.jacobian([door, *speeds])({door: 0, bolt: 0}).tolist() == [2, 0, 0]
    assert (3 * door.derivative()).jacobian(speeds)({}).tolist() == [3, 0]
    assert e.partial(speeds)({door: 0, bolt: 0}).tolist() == [0, 0]
    assert kv.array(1.0).jacobian(speeds)().tolist() == [0, 0]


def test_gradients_print_with_bounded_length() -> None:
    gradient = e.gradient()
    assert isinstance(gradient, Gradient)
    assert (
        repr(gradient)
        == str(gradient)
        == "{kitchen/bolt:velocity: 1, kitchen/door:velocity: length*cos(kitchen/door)}"
    )
    assert gradient == dict(gradient) == pickle.loads(pickle.dumps(gradient))
    assert list(gradient) == list(gradient.keys()) == [bolt.derivative(), door.derivative()]
    assert (len(gradient), door in gradient, gradient.get(door)) == (2, False, None)
    with pytest.raises(TypeError):
        gradient[door] = 1
    many = [kv.position(f"many/<b>{i}") for i in range(300)]
    large = np.sum(kv.array([np.sin(s) ** 2 * np.exp(s) for s in many])).gradient()
    assert len(repr(large)) < 4000
    assert repr(large).endswith("more}")
