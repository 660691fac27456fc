"""Programs to compile: an arm, and random ones that use every operation."""

from __future__ import annotations

import subprocess
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from hypothesis import strategies as st

import kineverse as kv
from kineverse.compilation.toolchain import toolchain
from kineverse.expressions.expression import Expression, binary, unary

# Machines with vectors of 64 bytes (if there are), of 32 with and without fused operations, and of 16; and what
# the processor has to know. The last is one without instructions for vectors.
MACHINES = {"native": "", "haswell": "avx2 fma", "sandybridge": "avx", "x86-64": "", "by lane": ""}

UNARY = [
    ca.OP_NEG, ca.OP_SQ, ca.OP_TWICE, ca.OP_INV, ca.OP_SQRT, ca.OP_FABS, ca.OP_SIGN, ca.OP_FLOOR, ca.OP_CEIL,
    ca.OP_NOT, ca.OP_SIN, ca.OP_COS, ca.OP_TAN, ca.OP_ASIN, ca.OP_ACOS, ca.OP_ATAN, ca.OP_EXP, ca.OP_EXPM1,
    ca.OP_LOG, ca.OP_LOG1P, ca.OP_SINH, ca.OP_COSH, ca.OP_TANH, ca.OP_ASINH, ca.OP_ACOSH, ca.OP_ATANH,
    ca.OP_ERF,
]  # fmt: skip
BINARY = [
    ca.OP_ADD, ca.OP_SUB, ca.OP_MUL, ca.OP_DIV, ca.OP_POW, ca.OP_FMOD, ca.OP_REMAINDER, ca.OP_HYPOT,
    ca.OP_ATAN2, ca.OP_COPYSIGN, ca.OP_FMIN, ca.OP_FMAX, ca.OP_LT, ca.OP_LE, ca.OP_EQ, ca.OP_NE, ca.OP_AND,
    ca.OP_OR, ca.OP_IF_ELSE_ZERO,
]  # fmt: skip
# Computed by polynomials in batches; everything else is the same there to the last bit.
APPROXIMATED = {
    ca.OP_SIN, ca.OP_COS, ca.OP_TAN, ca.OP_ASIN, ca.OP_ACOS, ca.OP_ATAN, ca.OP_ATAN2, ca.OP_EXP, ca.OP_EXPM1,
    ca.OP_LOG, ca.OP_TANH,
}  # fmt: skip

SPECIAL = [
    0.0, -0.0, 1.0, -1.0, 2.0, -2.0, 0.5, -0.5, np.inf, -np.inf, np.nan, 5e-324, -1e-320, 1e-300, 1e300,
    1e308, -1e308, np.pi, -np.pi, np.pi / 2, np.pi / 4, 709.5, -708.5, 745.0, -745.0, 1e10, -1e10, 1e22,
    1.6e6, 1.7e6, 19.9, -20.0, 1 - 1e-16, 1 + 2e-16, 2.2250738585072014e-308, 3e5,
]  # fmt: skip


@dataclass(frozen=True)
class Arm:
    """A chain of joints: symbols, pose of the tip (4, 4) and its geometric Jacobian (6, n)."""

    symbols: list[kv.Symbol]
    pose: Expression
    jacobian: Expression


def arm(prefix: str = "arm", joints: int = 7) -> Arm:
    symbols = [kv.position(f"{prefix}/joint_{i}") for i in range(joints)]
    pose = kv.translation(0.1, 0.2, 0.3)
    axes, origins = [], []
    for i, q in enumerate(symbols):
        pose, axis = pose @ kv.translation(0.1, -0.05 * i, 0.2), i % 3
        axes.append(pose[:3, axis])
        origins.append(pose[:3, 3])
        pose = pose @ (kv.rotation_x, kv.rotation_y, kv.rotation_z)[axis](q)
    pose, columns = pose @ kv.translation(0.1, 0.05, 0.02), []
    for a, o in zip(axes, origins, strict=True):
        r = pose[:3, 3] - o
        cross = [a[1] * r[2] - a[2] * r[1], a[2] * r[0] - a[0] * r[2], a[0] * r[1] - a[1] * r[0]]
        columns.append(kv.array([*cross, *a]))
    return Arm(symbols, pose, np.stack(columns, axis=1))


@dataclass(frozen=True)
class RandomProgram:
    """Values computed from inputs and from each other: (operation, operands) for each behind the inputs."""

    inputs: int
    steps: list[tuple[int, tuple[int, ...]]]

    def expressions(self) -> tuple[list[kv.Symbol], list[Expression]]:
        """Return the inputs, and everything that is computed, inputs included."""
        symbols = [kv.position(f"random/x{i:02}") for i in range(self.inputs)]
        values: list[Expression] = [*symbols, kv.array(0.3), kv.array(-2.0)]
        for op, operands in self.steps:
            arguments = [values[o] for o in operands]
            if op == ca.OP_COPYSIGN:
                # The sign of NaN is nobody's business, and differs.
                arguments[1] = binary(ca.OP_FMIN, arguments[1], 1e300)
            elif op == ca.OP_REMAINDER:
                # For subnormal divisors C libraries disagree about the sign of a zero remainder.
                arguments[1] = binary(ca.OP_FMAX, arguments[1], 1e-300)
            values.append(unary(op, *arguments) if len(arguments) == 1 else binary(op, *arguments))
        return symbols, values


@st.composite
def random_programs(draw: st.DrawFn, inputs: int = 5, length: int = 60) -> RandomProgram:
    available, steps = inputs + 2, []
    for _ in range(draw(st.integers(1, length))):
        op = draw(st.sampled_from(UNARY + BINARY))
        count = 1 if op in UNARY else 2
        steps.append((op, tuple(draw(st.integers(0, available - 1)) for _ in range(count))))
        available += 1
    return RandomProgram(inputs, steps)


def every_operation(depth: int = 4, seed: int = 0) -> RandomProgram:
    """A program with every operation on the inputs, and ``depth`` times more on what came out."""
    rng = np.random.default_rng(seed)
    steps = [(op, (int(rng.integers(5)),)) for op in UNARY]
    steps += [(op, tuple(int(i) for i in rng.integers(5, size=2))) for op in BINARY]
    for _ in range(depth):
        top = 7 + len(steps)
        steps += [(op, (int(rng.integers(top)),)) for op in UNARY]
        steps += [(op, tuple(int(i) for i in rng.integers(top, size=2))) for op in BINARY]
    return RandomProgram(5, steps)


def elements_of(values: Iterable[Expression]) -> dict[int, ca.SX]:
    """The values and all that they are made from, operands first, each once, by their hashes."""
    elements: dict[int, ca.SX] = {}

    def collect(element: ca.SX) -> None:
        if element.element_hash() not in elements:
            for i in range(element.n_dep()):
                collect(element.dep(i))
            elements[element.element_hash()] = element

    for value in values:
        collect(value.casadi)
    return elements


def one_operation_each(
    elements: dict[int, ca.SX], results: np.ndarray
) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Yield each operation, its value at the operands that were computed, and the computed value.

    ``results`` are the computed elements, shape (N, number of elements).
    """
    columns = dict(zip(elements, results.T, strict=True))
    for place, element in elements.items():
        if element.is_leaf():
            continue
        operands = [element.dep(i).element_hash() for i in range(element.n_dep())]
        v = ca.SX.sym("v", len(operands))
        arguments = [v[operands.index(operand)] for operand in operands]
        single = (ca.SX.unary if len(operands) == 1 else ca.SX.binary)(element.op(), *arguments)
        values = np.array([columns[o] for o in operands], dtype=np.float64)
        yield element.op(), ca.Function("f", [v], [single])(values).full().ravel(), columns[place]


def points(count: int, size: int, seed: int = 0) -> np.ndarray:
    """Numbers of all kinds, shape (count, size): ordinary, large, tiny, and those that are special."""
    rng = np.random.default_rng(seed)
    kinds = [
        rng.uniform(-4, 4, (count, size)),
        rng.uniform(-1, 1, (count, size)),
        rng.normal(size=(count, size)) * 10.0 ** rng.uniform(-20, 20, (count, size)),
        rng.uniform(-1.5e6, 1.5e6, (count, size)),
        rng.choice(SPECIAL, (count, size)),
    ]
    return np.choose(rng.choice(5, (count, size), p=[0.5, 0.2, 0.1, 0.1, 0.1]), kinds)


def same_bits(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether arrays are equal to the last bit; of NaN there is one kind."""
    return bool(np.all((a.view(np.int64) == b.view(np.int64)) | (np.isnan(a) & np.isnan(b))))


def ulps(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """How many units in the last place numbers are apart; infinity where only one is NaN or infinite."""
    with np.errstate(all="ignore"):
        apart = np.abs(a - b) / np.spacing(np.minimum(np.abs(a), 1.7e308))
    return np.where((a == b) | (np.isnan(a) & np.isnan(b)), 0.0, np.where(np.isnan(apart), np.inf, apart))


def build_for(machine: str, source: str, folder: Path) -> str:
    """Return the path of a library for one of MACHINES, or skip the test where it does not run."""
    compiler = toolchain()
    assert compiler is not None
    available = Path("/proc/cpuinfo").read_text().split() if Path("/proc/cpuinfo").exists() else []
    if machine != "native" and (
        "sse2" not in available or not set(MACHINES[machine].split()) <= set(available)
    ):
        pytest.skip(f"this machine does not run code for {machine}")
    if machine == "by lane":
        source = source.replace("__SSE2__", "NOT_DEFINED")
    library = str(folder / "library.so")
    processor = machine.replace("by lane", "x86-64")
    if compiler.is_zig:
        processor = processor.replace("-", "_")
    command = compiler.arguments(("-O2", f"-march={processor}"), library)
    environment = compiler.environment(str(folder))
    subprocess.run(command, input=source.encode(), check=True, capture_output=True, env=environment)
    return library
