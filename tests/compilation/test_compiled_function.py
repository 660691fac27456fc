"""What calls take and give."""

from __future__ import annotations

import copy
import gc
import pickle
from array import array as plain_array
from pathlib import Path

import numpy as np
import pytest
from compiled_programs import arm, same_bits

import kineverse as kv
from kineverse.compilation import Evaluator

a, b, c = kv.position("door/a"), kv.position("door/b"), kv.velocity("door/a")
length = kv.parameter("door/length", 2.0)
in_each_tier = pytest.mark.parametrize("tier", ["interpreter", pytest.param("c", marks=pytest.mark.compiler)])


def test_one_output_gives_an_array_and_a_list_a_tuple() -> None:
    assert kv.compile(kv.array([[a, b], [a * b, 1.0]]))([2.0, 3.0]).tolist() == [[2.0, 3.0], [6.0, 1.0]]
    (only,) = kv.compile([a + b])([2.0, 3.0])
    assert only.shape == ()
    assert only == 5.0
    pair = kv.compile((a + b, kv.array([a, b])))([2.0, 3.0])
    assert isinstance(pair, tuple)
    assert [v.tolist() for v in pair] == [5.0, [2.0, 3.0]]


def test_default_inputs_are_the_sorted_symbols_and_given_ones_keep_their_order() -> None:
    assert kv.compile(b * a + c).inputs == (a, c, b)
    f = kv.compile(a - b, [b, c, a])
    assert f.names == ("door/b", "door/a:velocity", "door/a")
    assert f([1.0, 99.0, 5.0]) == 4.0


def test_shapes_of_any_dimension_are_in_c_order() -> None:
    numbers = np.arange(24.0).reshape(2, 3, 4)
    f = kv.compile([kv.array(numbers.tolist()) * a, numbers, a, np.zeros((0, 3))], [a])
    assert f.shapes == ((2, 3, 4), (2, 3, 4), (), (0, 3))
    scaled, constant, scalar, empty = f([2.0])
    assert np.array_equal(scaled, 2 * numbers)
    assert np.array_equal(constant, numbers)
    assert scalar == 2.0
    assert empty.shape == (0, 3)


def test_a_function_without_inputs() -> None:
    f = kv.compile(np.eye(3))
    assert f.inputs == ()
    assert np.array_equal(f([]), np.eye(3))
    assert np.array_equal(f({}), np.eye(3))
    assert np.array_equal(f.batch(np.zeros((2, 0))), [np.eye(3)] * 2)
    with pytest.raises(kv.errors.ShapeError, match="no numbers"):
        f([1.0])


@in_each_tier
@pytest.mark.parametrize("outputs", [1, 2, 3])
def test_calls_share_no_memory(tier: str, outputs: int) -> None:
    f = kv.compile([kv.array([a + i, b]) for i in range(outputs)], tier=tier, wait=tier == "c")
    first, second = f([1.0, 2.0]), f([3.0, 4.0])
    assert [v.tolist() for v in first] == [[1.0 + i, 2.0] for i in range(outputs)]
    assert [v.tolist() for v in second] == [[3.0 + i, 4.0] for i in range(outputs)]
    assert not any(np.shares_memory(v, w) for v in first for w in second)
    assert not np.shares_memory(first[0], first[-1]) or outputs == 1
    assert all(v.flags.writeable and v.flags.owndata for v in first)


@in_each_tier
def test_vectors_of_every_type_are_accepted(tier: str) -> None:
    f = kv.compile(kv.array([a, b, a * b]), tier=tier, wait=tier == "c")
    wanted, strided = [1.0, -3.0, -3.0], np.zeros((2, 4))
    strided[:, 1] = 1.0, -3.0
    readonly = np.array([1.0, -3.0])
    readonly.flags.writeable = False
    unaligned = np.frombuffer(b"\0" + np.array([1.0, -3.0]).tobytes(), offset=1)
    for x in (
        [1.0, -3.0], (1, -3), np.array([1.0, -3.0]), np.array([1, -3], dtype=np.float32), np.array([1, -3]),
        np.array([1.0, -3.0], dtype=">f8"), strided[:, 1], np.array([-3.0, 1.0])[::-1], readonly, unaligned,
        plain_array("d", [1.0, -3.0]), plain_array("f", [1.0, -3.0]), np.array([1, -3], dtype=np.int8),
    ):  # fmt: skip
        assert f(x).tolist() == wanted


def test_mappings_by_name_and_by_symbol() -> None:
    f = kv.compile(length * a + b)
    assert f({"door/a": 3.0, b: 1}) == 7.0
    assert f({a: 3.0, "door/b": np.float32(1), length: 10.0}) == 31.0
    assert f({"door/a": 3.0, "door/b": 1.0, "door/length": 10}) == 31.0
    assert f(kv.State({"door/a": 3.0, "door/b": 1.0, "somewhere/else": 5.0})) == 7.0


def test_missing_and_unknown_names_are_listed() -> None:
    f = kv.compile(length * a + b + c)
    with pytest.raises(kv.errors.UnknownNameError, match="'door/a:velocity', 'door/b'"):
        f({"door/a": 1.0})
    with pytest.raises(kv.errors.UnknownNameError, match=r"'door/x', 'door/bb'.*") as raised:
        f({"door/a": 1.0, "door/x": 2.0, "door/bb": 3.0})
    assert "door/b" in str(raised.value)
    with pytest.raises(kv.errors.UnknownNameError, match="door/a"):
        f(kv.State({"door/b": 1.0, "door/a:velocity": 1.0}))
    with pytest.raises(kv.errors.UnknownNameError):
        f({kv.parameter("door/length", 3.0): 1.0, a: 1.0, b: 1.0, c: 1.0})
    with pytest.raises(kv.errors.DuplicateNameError, match="There are two values for 'door/a'"):
        f({a: 1.0, "door/a": 1.0, b: 1.0, c: 1.0})


@pytest.mark.parametrize("value", [np.nan, float("nan"), "0.3", None, [1.0, 2.0], a + 1, 1j, 10**400])
def test_values_that_are_not_numbers_are_refused_by_name(value: object) -> None:
    f = kv.compile(a + b)
    with pytest.raises(kv.errors.InvalidValueError, match="door/a"):
        f({"door/a": value, "door/b": 1.0})


@in_each_tier
@pytest.mark.parametrize(
    "x",
    [
        [1.0], [1.0, 2.0, 3.0], [[1.0, 2.0]], np.zeros((2, 1)), 1.0, "12", ["1", "2"], [1j, 2j], [1.0, None],
        [a, b], [[1.0], [2.0, 3.0]], None, np.float64(1.0), np.zeros(2, dtype="m8[s]"), b"12345678" * 2, a,
    ],
)  # fmt: skip
def test_vectors_of_a_wrong_shape_are_refused(tier: str, x: object) -> None:
    f = kv.compile([a, a + b], tier=tier, wait=tier == "c")
    evaluator = f.bind()
    with pytest.raises(kv.errors.ShapeError, match=r"2 numbers \('door/a', 'door/b'\)"):
        f(x)
    if x is not None:
        with pytest.raises(kv.errors.ShapeError, match="2 numbers"):
            evaluator(x)
    assert f([1.0, 2.0])[1] == 3.0


@in_each_tier
def test_nan_in_a_vector_propagates(tier: str) -> None:
    first, second = kv.compile(kv.array([a + 1, b + 1]), tier=tier, wait=tier == "c")([np.nan, 1.0])
    assert np.isnan(first)
    assert second == 2.0


def test_inputs_that_are_not_symbols_are_refused() -> None:
    for inputs in (a + b, [a, a + b], [a, "door/b"], "door/a", 3.0, a, [[a, b]]):
        with pytest.raises(kv.errors.ExpressionError, match="swapped"):
            kv.compile(a + b, inputs)  # type: ignore[arg-type]
    with pytest.raises(kv.errors.ExpressionError, match="swapped"):
        kv.compile([a, b], a * b)  # type: ignore[arg-type]


def test_inputs_that_miss_a_symbol_are_refused() -> None:
    with pytest.raises(kv.errors.UnknownNameError, match="'door/a:velocity', 'door/b'"):
        kv.compile(a + b + c, [a])
    with pytest.raises(kv.errors.DuplicateNameError, match="'door/a' is given twice"):
        kv.compile(a + b, [a, b, a])
    other = kv.parameter("door/length", 3.0)
    with pytest.raises(kv.errors.DuplicateNameError, match="several symbols"):
        kv.compile(length + other)
    with pytest.raises(kv.errors.CompileError, match="no output"):
        kv.compile([])
    with pytest.raises(kv.errors.InvalidValueError, match="'auto', 'interpreter' and 'c'"):
        kv.compile(a, tier="fast")  # type: ignore[arg-type]


def test_augmented_expressions_and_plain_numbers_compile() -> None:
    assert kv.compile([(a * b).augment({c: 1.0}), 3.0], [a, b])([2.0, 5.0]) == (10.0, 3.0)


def test_pickled_and_copied() -> None:
    mechanism = arm()
    f = kv.compile([mechanism.pose, mechanism.jacobian], wait=True)
    assert copy.copy(f) is f
    assert copy.deepcopy([f])[0] is f
    g = pickle.loads(pickle.dumps(f))
    assert (g.inputs, g.shapes) == (f.inputs, f.shapes)
    x = np.linspace(-1, 1, 7)
    assert all(same_bits(v, w) for v, w in zip(f(x), g(x), strict=True))


def test_repr_is_bounded() -> None:
    symbols = [kv.position(f"many/x{i}") for i in range(500)]
    assert len(repr(kv.compile(symbols, tier="interpreter"))) < 300
    assert "4 inputs" in repr(kv.compile(kv.array(symbols[:4])))


@in_each_tier
def test_evaluators_write_in_place(tier: str) -> None:
    f = kv.compile([a + b, kv.array([a, b])], tier=tier, wait=tier == "c")
    evaluator, other = f.bind(), f.bind()
    assert isinstance(evaluator, Evaluator)
    total, vector = evaluator.outputs
    evaluator.input[:] = 1.0, 2.0
    assert evaluator() is None
    assert total == 3.0
    assert vector.tolist() == [1.0, 2.0]
    evaluator([5, 6])
    assert evaluator.outputs[0] is total
    assert total == 11.0
    assert evaluator.input.tolist() == [5.0, 6.0]
    evaluator(np.array([7.0, 8.0]))
    assert vector.tolist() == [7.0, 8.0]
    evaluator({"door/a": 1.0, "door/b": 1.0})
    assert total == 2.0
    assert other.outputs[0] == 0.0
    with pytest.raises(AttributeError):
        evaluator.input = np.zeros(2)  # type: ignore[misc]
    assert "2 inputs" in repr(evaluator)
    with pytest.raises(TypeError):
        evaluator([1.0, 2.0], [1.0, 2.0])  # type: ignore[call-arg]


@in_each_tier
def test_an_evaluator_outlives_its_function(tier: str) -> None:
    evaluator = kv.compile(a * b, tier=tier, wait=tier == "c").bind()
    for i in range(100):
        evaluator([i, 2.0])
        assert evaluator.outputs[0] == 2.0 * i


def test_a_function_of_constants_is_called_without_arguments():
    for tier in ("interpreter", "auto"):
        f = kv.compile([kv.rotation_z(0.0), kv.array(3.0)], tier=tier)
        assert f.inputs == ()
        assert f()[1] == f([])[1] == f({})[1] == 3
        np.testing.assert_array_equal(f()[0], np.eye(4))
        assert f.batch(np.zeros((2, 0)))[1].tolist() == [3, 3]
    with pytest.raises(
        kv.errors.ShapeError,
        match=r"Nothing is given; a call takes a vector of 1 numbers \('q'\), or a mapping",
    ):
        kv.compile(kv.position("q"))()


@pytest.mark.compiler
@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="there is no /proc")
def test_a_library_is_unloaded_with_the_last_that_needs_it() -> None:
    def loaded() -> int:
        return Path("/proc/self/maps").read_text().count(f"/{key}.so")

    f = kv.compile([a * b + 7.125, np.sin(b)], tier="c", wait=True)
    key = f._library.key
    assert loaded() > 0
    evaluator = f.bind()
    del f
    gc.collect()
    evaluator([2.0, 3.0])
    assert evaluator.outputs[0] == 13.125
    assert loaded() > 0
    del evaluator
    gc.collect()
    assert loaded() == 0
