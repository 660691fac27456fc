"""Many points at once: the same numbers as one by one."""

from __future__ import annotations

import ctypes
import gc
import mmap
import sys
import threading

import numpy as np
import pytest
from compiled_programs import (
    APPROXIMATED,
    RandomProgram,
    arm,
    elements_of,
    every_operation,
    one_operation_each,
    points,
    random_programs,
    same_bits,
    ulps,
)
from hypothesis import HealthCheck, given, settings

import kineverse as kv
from hypothesis_profiles import attempts
from kineverse.compilation import batch, c_library, codegen
from kineverse.compilation import batch as memory
from kineverse.expressions.expression import from_casadi

a, b = kv.position("door/a"), kv.position("door/b")


@pytest.fixture(scope="module", params=["interpreter", pytest.param("c", marks=pytest.mark.compiler)])
def function(request: pytest.FixtureRequest) -> kv.CompiledFunction:
    """Outputs whose rows are whole vectors, odd, single and shorter than a vector; the last is constant."""
    mechanism = arm()
    p = mechanism.pose[:3, 3]
    return kv.compile(
        [mechanism.pose, mechanism.jacobian, p @ p, p, np.eye(2)], tier=request.param, wait=True
    )


def one_by_one(f: kv.CompiledFunction, x: np.ndarray) -> list[np.ndarray]:
    results = [f(row) for row in x]
    return [np.array([r[i] for r in results]).reshape(len(x), *shape) for i, shape in enumerate(f.shapes)]


def close(first: np.ndarray, second: np.ndarray) -> bool:
    return np.allclose(first, second, rtol=0, atol=1e-14, equal_nan=True) and first.shape == second.shape


@pytest.mark.parametrize("count", [0, 1, 2, 7, 8, 9, 15, 16, 17, 33, 100])
def test_any_number_of_rows(function: kv.CompiledFunction, count: int) -> None:
    x = np.random.default_rng(count).uniform(-3, 3, (count, 7))
    results = function.batch(x)
    assert all(close(v, w) for v, w in zip(results, one_by_one(function, x), strict=True))
    assert all(v.flags.c_contiguous and v.flags.writeable for v in results)


def last_of_a_page(count: int) -> np.ndarray:
    """Return doubles behind which there is memory that cannot be touched."""
    size = -(-8 * count // mmap.PAGESIZE) * mmap.PAGESIZE
    pages = mmap.mmap(-1, size + mmap.PAGESIZE)
    start = ctypes.addressof(ctypes.c_char.from_buffer(pages))
    assert ctypes.CDLL(None).mprotect(ctypes.c_void_p(start + size), mmap.PAGESIZE, 0) == 0
    return np.frombuffer(pages, count=size // 8)[size // 8 - count :]


@pytest.mark.sampled(2)
@pytest.mark.compiler
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="uses mprotect")
@pytest.mark.parametrize("inputs", [1, 2, 3, 5, 7, 8, 9])
def test_nothing_behind_points_and_results_is_touched(inputs: int) -> None:
    x = [kv.position(f"x{k}") for k in range(inputs)]
    total = sum(x, kv.expressions.array(0.0))
    f = kv.compile([kv.expressions.array([total] * outputs) for outputs in (1, 3, 9)], x, tier="c")
    for rows in (*range(1, 4), *range(7, 26)):
        points = last_of_a_page(rows * inputs).reshape(rows, inputs)
        points[:] = np.arange(points.size).reshape(points.shape)
        out = [last_of_a_page(rows * outputs).reshape(rows, outputs) for outputs in (1, 3, 9)]
        f.batch(points, out=out)
        for result in out:
            assert (result == points.sum(axis=1)[:, None]).all()


@pytest.mark.compiler
def test_functions_without_inputs_have_batches_of_any_number_of_rows() -> None:
    f = kv.compile([np.eye(2), np.array(3.0)], [], tier="c")
    for rows in (0, 1, 7, 8, 20):
        first, second = f.batch(np.zeros((rows, 0)))
        assert first.shape == (rows, 2, 2)
        assert (first == np.eye(2)).all()
        assert (second == np.full(rows, 3.0)).all()


@pytest.mark.parametrize("offset", [0, 1, 2, 5])
@pytest.mark.parametrize("count", [64, 77])
def test_results_written_past_the_caches(
    function: kv.CompiledFunction, monkeypatch: pytest.MonkeyPatch, offset: int, count: int
) -> None:
    monkeypatch.setattr(batch, "_STREAMED_BYTES", -1)
    x = np.random.default_rng(offset).uniform(-3, 3, (count, 7))
    out, fences = [], []
    for shape in function.shapes:
        size = count * int(np.prod(shape))
        memory = np.full(size + 40, 7.0)
        start = -memory.ctypes.data % 64 // 8 + 8 + offset
        out.append(memory[start : start + size].reshape(count, *shape))
        fences.append((memory[:start], memory[start + size :]))
    assert function.batch(x, out)[0] is out[0]
    assert all(close(v, w) for v, w in zip(out, one_by_one(function, x), strict=True))
    assert all(np.all(fence == 7.0) for pair in fences for fence in pair)


@pytest.mark.parametrize("tier", ["interpreter", pytest.param("c", marks=pytest.mark.compiler)])
def test_one_output_gives_an_array(tier: str) -> None:
    f = kv.compile(a * b, tier=tier)
    assert f.batch([[1, 2], [3, 4]]).tolist() == [2.0, 12.0]
    out = np.empty(2)
    assert f.batch([[1, 2], [3, 4]], out=out) is out
    assert f.batch([[1, 2], [3, 5]], out=[out]) is out
    assert out.tolist() == [2.0, 15.0]


def test_points_of_any_type_and_strides(function: kv.CompiledFunction) -> None:
    x = np.random.default_rng(0).integers(-2, 3, (20, 7))
    wanted, wide = function.batch(x.astype(float)), np.zeros((40, 14))
    wide[::2, ::2] = x
    readonly = x.astype(float)
    readonly.flags.writeable = False
    for same in (
        x.astype(np.float32),
        x,
        wide[::2, ::2],
        np.asfortranarray(x),
        x.astype(">f8"),
        x.tolist(),
        readonly,
    ):
        assert all(same_bits(v, w) for v, w in zip(function.batch(same), wanted, strict=True))


@pytest.mark.parametrize(
    "x",
    [
        np.zeros(7),
        np.zeros((2, 6)),
        np.zeros((2, 7, 1)),
        [],
        1.0,
        "text",
        np.zeros((2, 7), complex),
        [[None] * 7],
        None,
    ],
)
def test_invalid_points_are_refused(function: kv.CompiledFunction, x: object) -> None:
    with pytest.raises(kv.errors.ShapeError, match=r"shape \(N, 7\)"):
        function.batch(x)


def test_out_that_does_not_fit_is_refused() -> None:
    f, x = kv.compile([kv.array([a, b, a]), a * b]), np.ones((4, 2))
    first, second = np.empty((4, 3)), np.empty(4)
    readonly = np.empty((4, 3))
    readonly.flags.writeable = False
    shared = np.empty(14)
    for out in (
        first, [first], [first, second, second], [second, first], [np.empty((3, 3)), second],
        [np.empty((4, 3), np.float32), second], [np.empty((3, 4)).T, second], [readonly, second],
        [np.empty((4, 6))[:, ::2], second], [[0.0] * 12, second], 3, "out",
        [shared[:12].reshape(4, 3), shared[10:]],
    ):  # fmt: skip
        with pytest.raises(kv.errors.ShapeError, match="out="):
            f.batch(x, out=out)
    assert f.batch(x, out=[first, second])[1] is second


def test_out_may_share_memory_with_the_points() -> None:
    f, x = kv.compile(kv.array([b, a + b]), [a, b]), np.arange(40.0).reshape(20, 2)
    wanted = f.batch(x.copy())
    assert np.array_equal(f.batch(x, out=x), wanted)


def test_nan_stays_in_its_row(function: kv.CompiledFunction) -> None:
    x = np.random.default_rng(3).uniform(-3, 3, (64, 7))
    wanted = [v.copy() for v in function.batch(x)]
    x[5, 2], x[17, 0], x[63, 6] = np.nan, np.inf, 1e300
    results, others = function.batch(x), np.delete(np.arange(64), [5, 17, 63])
    assert all(same_bits(v[others], w[others]) for v, w in zip(results, wanted, strict=True))
    assert np.isnan(results[0][5]).any()
    assert np.isnan(results[0][17]).any()
    assert close(results[0][63], function(x[63])[0])


def check_every_value(program: RandomProgram, x: np.ndarray) -> None:
    """Compare each value with its operation applied to the operands that the batch itself computed.

    So nothing is amplified, and every operation answers for itself. The operations are those that CasADi made
    of the program: it knows what x / -x is, whatever x is.
    """
    symbols, values = program.expressions()
    elements = elements_of(values)
    outputs = kv.array([from_casadi(element, (), frozenset()) for element in elements.values()])
    results = kv.compile(outputs, symbols, tier="c").batch(x)
    for op, wanted, column in one_operation_each(elements, results):
        if op in APPROXIMATED:
            assert ulps(wanted, column).max() <= 4
        else:
            assert same_bits(wanted, column)


@pytest.mark.compiler
def test_every_operation_equals_single_calls() -> None:
    check_every_value(every_operation(depth=4), points(2003, 5))


@pytest.mark.compiler
@settings(max_examples=attempts(5), suppress_health_check=[HealthCheck.too_slow])
@given(random_programs())
def test_random_programs_equal_single_calls(program: RandomProgram) -> None:
    check_every_value(program, points(1003, 5))


@pytest.mark.compiler
def test_programs_longer_than_one_c_function(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(codegen, "PART_LENGTH", 7)
    # A constant of its own, for a library of its own.
    mechanism = arm()
    f = kv.compile([mechanism.pose, mechanism.jacobian * 1.03125], tier="c")
    x = np.random.default_rng(0).uniform(-3, 3, (20, 7))
    assert all(close(v, w) for v, w in zip(f.batch(x), one_by_one(f, x), strict=True))


@pytest.mark.parametrize("count", [0, 1, 5, 32, 33, 100])
def test_batches_by_the_interpreter(count: int) -> None:
    mechanism = arm()
    f = kv.compile([mechanism.pose, mechanism.jacobian], tier="interpreter")
    x = np.random.default_rng(0).uniform(-3, 3, (count, 7))
    results = f.batch(x)
    assert all(same_bits(v, w) for v, w in zip(results, one_by_one(f, x), strict=True))
    assert f._batch._library is None


@pytest.mark.compiler
def test_small_batches_are_interpreted_until_they_add_up() -> None:
    f, x = kv.compile([a * b * 3.375, kv.array([a, b])]), np.ones((10, 2))
    f.batch(x)
    assert f._batch._library._build is None
    library = f._batch._library
    f._batch._spent = 1.0
    f.batch(x)
    assert library.wait(60)
    assert f.batch(x)[0].tolist() == [3.375] * 10


@pytest.mark.compiler
def test_large_batches_wait_for_the_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    f = kv.compile([kv.array([np.sin(a * 1.4375), b])])
    x = np.random.default_rng(0).uniform(-3, 3, (100, 2))
    monkeypatch.setattr(batch, "_INTERPRETING", 0.1)
    assert close(f.batch(x)[0], one_by_one(f, x)[0])
    assert f._batch._library.code is not None


def test_many_threads_and_pieces(function: kv.CompiledFunction, monkeypatch: pytest.MonkeyPatch) -> None:
    x = np.random.default_rng(0).uniform(-3, 3, (5000, 7))
    wanted = [v.copy() for v in function.batch(x)]
    monkeypatch.setattr(c_library, "cores", lambda: 4)
    monkeypatch.setattr(c_library, "_threads", None)
    wrong = []

    def work() -> None:
        for _ in range(5):
            wrong.extend(not same_bits(v, w) for v, w in zip(function.batch(x), wanted, strict=True))

    threads = [threading.Thread(target=work) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not any(wrong)


def test_errors_in_threads_reach_the_caller(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(c_library, "cores", lambda: 3)

    def work(first: int, end: int) -> None:
        raise MemoryError(f"{first} {end}")

    with pytest.raises(MemoryError):
        c_library.parallel_rows(work, 1000, 1)


def test_pieces_make_up_all_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(c_library, "cores", lambda: 3)
    for count in (0, 1, 7, 8, 1000, 1001):
        done = []
        c_library.parallel_rows(lambda first, end, done=done: done.extend(range(first, end)), count, 4)
        assert sorted(done) == list(range(count))


def test_memory_is_reused_only_after_results_are_deleted() -> None:
    size = memory._SMALLEST_BUFFER // 8 + 1
    first = memory.allocate_aligned(size)
    assert first.ctypes.data % 64 == 0
    assert first.shape == (size,)
    first[:] = 1.0
    piece, address = first[100:200].reshape(10, 10), first.ctypes.data
    del first
    gc.collect()
    second = memory.allocate_aligned(size)
    second[:] = 2.0
    assert np.all(piece == 1.0)
    del piece
    gc.collect()
    third = memory.allocate_aligned(size)
    assert third.ctypes.data == address
    third[:] = 3.0
    assert np.all(second == 2.0)


def test_free_memory_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    memory._free_blocks.clear()
    size = memory._SMALLEST_BUFFER // 8 + 1
    monkeypatch.setattr(memory, "_LARGEST_TOTAL", 2 * 8 * size + 200)
    leases = [memory.allocate_aligned(size) for _ in range(5)]
    del leases
    gc.collect()
    assert len(memory._free_blocks) == 2
    memory._free_blocks.clear()
