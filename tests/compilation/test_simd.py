"""Elementary functions of vectors: as the C library's to 4 ulp, for every width of vectors there is."""

from __future__ import annotations

import ctypes
from pathlib import Path

import numpy as np
import pytest
from compiled_programs import APPROXIMATED, BINARY, SPECIAL, UNARY, build_for, ulps

import kineverse as kv
from kineverse.compilation.batch import _load
from kineverse.compilation.codegen import generate_batch_source
from kineverse.compilation.program import Program
from kineverse.expressions.expression import binary, unary

x, y = kv.position("x"), kv.position("y")
OPERATIONS = [*UNARY, *BINARY]


@pytest.fixture(scope="module")
def program() -> Program:
    return Program([unary(op, x) if op in UNARY else binary(op, x, y) for op in OPERATIONS], [x, y])


@pytest.fixture(scope="module")
def inputs() -> np.ndarray:
    """Pairs of numbers on which reductions are hard, and all pairs of special ones; shape (N, 2)."""
    rng, n = np.random.default_rng(0), 6000
    kinds = [
        rng.uniform(-4, 4, n),
        rng.uniform(-1, 1, n),
        rng.normal(size=n) * 1e-3,
        rng.uniform(-1.6e6, 1.6e6, n),
        rng.normal(size=n) * 10.0 ** rng.uniform(-300, 300, n),
        # Next to multiples of a right angle.
        np.round(rng.uniform(-1e6, 1e6, n)) * np.pi / 2 * (1 + rng.integers(-2, 3, n) * 1.1e-16),
        rng.uniform(-750, 750, n),
        1 + rng.normal(size=n) * 10.0 ** rng.uniform(-16, 0, n),
    ]
    first = np.concatenate(kinds)
    pairs = np.stack([first, rng.permutation(first)], axis=1)
    return np.concatenate([pairs, np.array([(u, v) for u in SPECIAL for v in SPECIAL])])


@pytest.fixture(scope="module")
def wanted(program: Program, inputs: np.ndarray) -> list[np.ndarray]:
    values = program.function.map(len(inputs))(inputs.T)
    return [np.array(v).ravel() for v in values]


@pytest.mark.compiler
@pytest.mark.parametrize(
    "machine",
    [
        "native",
        "x86-64",
        pytest.param("haswell", marks=pytest.mark.long),
        pytest.param("sandybridge", marks=pytest.mark.long),
    ],
)
def test_simd_functions_are_within_four_ulp(
    program: Program, inputs: np.ndarray, wanted: list[np.ndarray], machine: str, tmp_path: Path
) -> None:
    library = build_for(machine, generate_batch_source(program), tmp_path)
    outputs = [np.empty(len(inputs)) for _ in OPERATIONS]
    places = (ctypes.c_void_p * len(outputs))(*(o.ctypes.data for o in outputs))
    assert _load(library)(inputs.ctypes.data, ctypes.addressof(places), len(inputs), 1) == 0
    for op, value, want in zip(OPERATIONS, outputs, wanted, strict=True):
        apart = ulps(want, value)
        worst = int(apart.argmax())
        limit = 4 if op in APPROXIMATED else 0
        assert apart[worst] <= limit, f"operation {op} at {inputs[worst]}: {value[worst]}, not {want[worst]}"
        zeros = want == 0
        assert np.array_equal(np.signbit(want[zeros]), np.signbit(value[zeros]))
