"""Programs of vectors: float as double to its last digits, parameters prepared, and calls from C."""

from __future__ import annotations

import ctypes
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from compiled_programs import (
    APPROXIMATED,
    BINARY,
    SPECIAL,
    UNARY,
    Arm,
    arm,
    build_for,
    elements_of,
    every_operation,
    one_operation_each,
    points,
    same_bits,
)

import kineverse as kv
from kineverse.compilation import codegen, vector_program
from kineverse.compilation.batch import _load as load_batch
from kineverse.compilation.codegen import generate_batch_source
from kineverse.compilation.vector_program import VectorProgram, vector_header, vector_source
from kineverse.expressions.expression import Expression, binary, from_casadi, unary

pytestmark = pytest.mark.compiler

x, y = kv.position("x"), kv.position("y")
OPERATIONS = [*UNARY, *BINARY]
CIRCLE = {ca.OP_SIN, ca.OP_COS}


def float_ulps(wanted: np.ndarray, found: np.ndarray) -> np.ndarray:
    """How many units in the last place floats are from doubles; infinity where only one is NaN or infinite."""
    with np.errstate(all="ignore"):
        rounded = wanted.astype(np.float32)
        spacing = np.spacing(np.minimum(np.abs(rounded), np.float32(3e38))).astype(np.float64)
        apart = np.abs(wanted - found) / spacing
    same = (rounded == found) | (np.isnan(rounded) & np.isnan(found))
    return np.where(same, 0.0, np.where(np.isnan(apart), np.inf, apart))


def load(program: VectorProgram, path: str) -> VectorProgram:
    """Let a program use a library of another place."""
    program._library.code = vector_program._load(path)
    return program


@pytest.fixture(scope="module")
def inputs() -> np.ndarray:
    """Floats on which reductions are hard, and all pairs of special ones; shape (N, 2)."""
    rng, n = np.random.default_rng(0), 1500
    kinds = [
        rng.uniform(-4, 4, n),
        rng.uniform(-1, 1, n),
        rng.uniform(-1e4, 1e4, n),
        rng.uniform(-2e5, 2e5, n),
        rng.normal(size=n) * 10.0 ** rng.uniform(-38, 38, n),
        # Next to multiples of a right angle.
        np.round(rng.uniform(-6e3, 6e3, n)) * np.pi / 2,
        rng.uniform(-90, 90, n),
        1 + rng.normal(size=n) * 10.0 ** rng.uniform(-7, 0, n),
    ]
    first = np.concatenate(kinds)
    pairs = np.stack([first, rng.permutation(first)], axis=1)
    special = np.array([(u, v) for u in SPECIAL for v in SPECIAL])
    with np.errstate(all="ignore"):
        return np.concatenate([pairs, special]).astype(np.float32).astype(np.float64)


@pytest.mark.parametrize(
    "machine", ["native", "x86-64", "by lane", pytest.param("haswell", marks=pytest.mark.long)]
)
def test_float_functions_are_within_their_ulp(inputs: np.ndarray, machine: str, tmp_path: Path) -> None:
    outputs = [unary(op, x) if op in UNARY else binary(op, x, y) for op in OPERATIONS]
    program = VectorProgram(outputs, [x, y])
    load(program, build_for(machine, program._source(), tmp_path))
    wanted = program._program.function.map(len(inputs))(inputs.T)
    for op, value, want in zip(OPERATIONS, program.evaluate(inputs), wanted, strict=True):
        want = np.array(want).ravel()
        apart = float_ulps(want, value)
        worst = int(apart.argmax())
        # What is computed by the C library is so in double, and rounded.
        limit = 2 if op in CIRCLE else 4 if op in APPROXIMATED else 0.501
        assert apart[worst] <= limit, f"operation {op} at {inputs[worst]}: {value[worst]}, not {want[worst]}"
        zeros = (want == 0) & (value == 0)
        assert np.array_equal(np.signbit(want[zeros]), np.signbit(value[zeros]))


def test_every_float_value_is_its_operation(tmp_path: Path) -> None:
    symbols, values = every_operation(depth=1).expressions()
    elements = elements_of(values)
    program = VectorProgram([from_casadi(e, (), frozenset()) for e in elements.values()], symbols)
    # Without the flag to round sums and products together.
    load(program, build_for("native", program._source(), tmp_path))
    results = np.stack(program.evaluate(points(1003, 5)), axis=1)
    for op, wanted, column in one_operation_each(elements, results):
        assert float_ulps(wanted, column).max() <= (4 if op in APPROXIMATED else 0.501)


@pytest.fixture(scope="module")
def mechanism() -> Arm:
    return arm("vectors")


def test_doubles_equal_batches(mechanism: Arm, tmp_path: Path) -> None:
    program = VectorProgram([mechanism.pose, mechanism.jacobian], mechanism.symbols, scalar="double")
    batch = load_batch(build_for("native", generate_batch_source(program._program), tmp_path))
    for count in (0, 1, 2 * program.lanes + 1):
        rows = np.random.default_rng(count).uniform(-3, 3, (count, 7))
        wanted = np.empty((count, 4, 4)), np.empty((count, 6, 7))
        places = (ctypes.c_void_p * 2)(*(w.ctypes.data for w in wanted))
        assert batch(rows.ctypes.data, ctypes.addressof(places), count, 0) == 0
        assert all(same_bits(r, w) for r, w in zip(program.evaluate(rows), wanted, strict=True))


def test_parameters_are_prepared_as_in_single_calls() -> None:
    symbols, values = every_operation(depth=1, seed=1).expressions()
    program = VectorProgram(values, [], symbols, scalar="double")
    f = kv.compile(values, symbols, tier="interpreter")
    assert program.kept > len(values) // 2
    for row in points(40, 5):
        results = program.evaluate(np.zeros((1, 0)), row)
        assert all(same_bits(r[0].reshape(1), w.reshape(1)) for r, w in zip(results, f(row), strict=True))


def test_prepared_parameters_and_pieces_change_nothing(
    mechanism: Arm, monkeypatch: pytest.MonkeyPatch
) -> None:
    outputs = [mechanism.pose, mechanism.jacobian, kv.array([[1.0, 2.0]])]
    rows = np.random.default_rng(0).uniform(-3, 3, (37, 7))
    rows[:, 3:] = rows[0, 3:]
    wanted = kv.compile(outputs, mechanism.symbols, tier="interpreter").batch(rows)
    monkeypatch.setattr(codegen, "PART_LENGTH", 7)
    split = VectorProgram(outputs, mechanism.symbols[:3], mechanism.symbols[3:])
    results = split.evaluate(rows[:, :3], dict(zip(mechanism.symbols[3:], rows[0, 3:], strict=True)))
    assert split.stored > 0
    assert split.kept >= 8
    assert all(np.abs(r - w).max() < 1e-6 for r, w in zip(results, wanted, strict=True))
    kept = split.prepare(rows[0, 3:])
    assert kept.shape == (split.kept, split.lanes)
    assert kept.ctypes.data % 64 == 0
    assert np.array_equal(kept, np.repeat(kept[:, :1], split.lanes, axis=1))
    again = split.allocate(split.kept)
    assert split.prepare(rows[0, 3:], out=again) is again
    assert np.array_equal(kept, again)


def test_far_away_nothing_is_lost_between_parameters(mechanism: Arm) -> None:
    base, obstacle = kv.position("far/base"), kv.position("far/obstacle")
    seen = kv.inverse(kv.translation(obstacle, 0, 0)) @ kv.translation(base, 0, 0) @ mechanism.pose
    program = VectorProgram([seen], mechanism.symbols, [base, obstacle])
    rows = np.random.default_rng(0).uniform(-3, 3, (20, 7))
    wanted = kv.compile(mechanism.pose, mechanism.symbols, tier="interpreter").batch(rows)
    wanted[:, 0, 3] += 0.3
    assert np.abs(program.evaluate(rows, [1e4 + 0.1, 1e4 - 0.2])[0] - wanted).max() < 1e-6


def test_cache_knows_split_and_scalar_and_no_names() -> None:
    def sine(name: str, inputs: int = 1, **options: str) -> VectorProgram:
        a, b = kv.position(f"{name}/a"), kv.position(f"{name}/b")
        return VectorProgram([np.sin(a * 1.8125) + b], [a, b][:inputs], [a, b][inputs:], **options)

    first = sine("secret")
    assert not first.find()
    assert first.request() is None
    first.wait()
    assert first.error is None
    assert sine("other").find()
    assert not sine("secret", 2).find()
    assert not sine("secret", scalar="double").find()
    assert "secret" not in first._source()


def test_closed_loops_close_in_float() -> None:
    model = kv.load("articulations/four_bar")
    outputs = [model.fk(frame) for frame in model.frames if frame != "world"]
    symbols = sorted(set().union(*(o.symbols for o in outputs)), key=str)
    rows = model.default_state().vector(symbols) + np.linspace(-0.05, 0.05, 20)[:, None]
    results = VectorProgram(outputs, symbols).evaluate(rows)
    wanted = kv.compile(outputs, symbols, tier="interpreter").batch(rows)
    assert all(np.abs(r - w).max() < 1e-5 for r, w in zip(results, wanted, strict=True))


def test_poses_of_a_robot_within_a_micrometre() -> None:
    model = kv.load("pr2")
    poses = [model.fk(f)[:3] for f in model.frames if str(f).startswith("pr2/r_")]
    symbols = sorted(set().union(*(p.symbols for p in poses)), key=str)
    rows = np.random.default_rng(0).uniform(-1, 1, (500, len(symbols)))
    results = VectorProgram(poses, symbols).evaluate(rows)
    wanted = kv.compile(poses, symbols, tier="interpreter").batch(rows)
    assert len(poses) > 10
    assert max(np.abs(r - w).max() for r, w in zip(results, wanted, strict=True)) < 1e-6


_CALLER = r"""
typedef void (*Compute)(const V *, const V *, V *, V *);
EXPORTED int call(Compute compute, const double *parameters, const V *x, V *kept, V *o) {
  V store[arm_stored + 1];
  arm_prepare(parameters, kept);
  arm_compute(x, kept, store, o);
  compute(x, kept, store, o + 16);
  V most = splat(REAL(0.0));
  for (int i = 0; i < 16; i++) most = larger(most, magnitude(o[i] - o[16 + i]));
  return any(most > splat(REAL(0.0)));
}
"""


def test_written_c_includes_and_calls_programs(mechanism: Arm, tmp_path: Path) -> None:
    program = VectorProgram([mechanism.pose], mechanism.symbols[2:], mechanism.symbols[:2], scalar="double")
    source = vector_header("double") + vector_source(program, name="arm") + _CALLER
    call = ctypes.CDLL(build_for("native", source, tmp_path)).call
    vectors, kept, o = program.allocate(5), program.allocate(program.kept), program.allocate(32)
    vectors[:] = np.random.default_rng(0).uniform(-3, 3, vectors.shape)
    parameters = np.array([0.3, -0.4])
    addresses = (ctypes.c_void_p(a.ctypes.data) for a in (parameters, vectors, kept, o))
    assert call(ctypes.c_void_p(program.compute_address), *addresses) == 0
    poses = o[:16].T.reshape(-1, 4, 4)
    rows = np.concatenate([np.tile(parameters, (program.lanes, 1)), vectors.T], axis=1)
    wanted = kv.compile(mechanism.pose, mechanism.symbols, tier="interpreter").batch(rows)
    assert np.abs(poses - wanted).max() < 1e-13
    assert program.prepare_address


def inverse_error_function() -> Expression:
    return unary(ca.OP_ERFINV, x)


def test_what_cannot_be_compiled_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    with pytest.raises(kv.errors.CompileError, match="erfinv"):
        VectorProgram([inverse_error_function()], [x])
    with pytest.raises(kv.errors.UnknownNameError, match="'y'"):
        VectorProgram([x + y], [x])
    with pytest.raises(kv.errors.DuplicateNameError, match="'x'"):
        VectorProgram([x + y], [x, y], [x])
    program = VectorProgram([x + y], [x], [y])
    for rows in (np.zeros(1), np.zeros((2, 2))):
        with pytest.raises(kv.errors.ShapeError, match=r"shape \(N, 1\)"):
            program.evaluate(rows, [1.0])
    with pytest.raises(kv.errors.ShapeError, match="vector of 1 numbers"):
        program.evaluate(np.zeros((2, 1)))
    with pytest.raises(kv.errors.ShapeError, match=r"allocate\(1\)"):
        program.prepare([1.0], out=np.zeros(3))
    broken = tmp_path / "cc"
    broken.write_text("#!/bin/sh\necho 'cannot do that' >&2\nexit 3\n")
    broken.chmod(0o755)
    monkeypatch.setenv("CC", str(broken))
    failing = VectorProgram([x - 1.140625], [x])
    with pytest.raises(kv.errors.CompileError, match="cannot do that"):
        failing.wait()
    assert "cannot do that" in (failing.error or "")


@pytest.mark.usefixtures("no_compiler")
def test_a_vector_program_needs_a_compiler() -> None:
    with pytest.raises(kv.errors.CompileError, match="no C compiler"):
        VectorProgram([x], [x])
