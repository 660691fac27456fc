"""CasADi graph of the robot at many points, as CasADi's map in C and as numpy operations."""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from kineverse.compilation.toolchain import Toolchain, no_compiler, toolchain
from kineverse.errors import CompileError
from kineverse.lie import Array
from kineverse_studies.bench.harness import Contender, time_calls
from kineverse_studies.bench.kinematics import CHECKED, COUPLER, CRANK, GROUND, ROCKER, pin_to_one_core
from kineverse_studies.bench.workloads import BenchmarkRobot

COMPILER_FLAGS = ("-O3", "-march=native", "-fPIC", "-shared")
"""Flags for the C code of a map, which is faster than a map over the C code of the function."""


def make_casadi_function(robot: BenchmarkRobot) -> Any:
    pose, jacobian = robot.model.fk(robot.frame), robot.model.jacobian(robot.frame)
    inputs = ca.vertcat(*(symbol.casadi for symbol in robot.chain))
    outputs = [ca.densify(pose.casadi.T), ca.densify(jacobian.casadi.T)]
    return ca.Function("pose_and_jacobian", [inputs], ca.cse(outputs))


def compile_map(function: Any, rows: int, folder: Path, compiler: Toolchain) -> Any:
    mapped = function.map(rows)
    generator = ca.CodeGenerator("map.c")
    generator.add(mapped)
    source, library = folder / "map.c", folder / "map.so"
    source.write_text(generator.dump(), encoding="utf-8")
    command = [*compiler.command, *COMPILER_FLAGS, str(source), "-o", str(library), "-lm"]
    done = subprocess.run(
        command,
        capture_output=True,
        encoding="utf-8",
        errors="replace",
        check=False,
        env=compiler.environment(str(folder)),
    )
    if done.returncode:
        raise CompileError(f"CasADi's map cannot be compiled: {done.stderr.strip().splitlines()[0]}")
    return ca.external(mapped.name(), str(library))


class BoundMap:
    def __init__(self, function: Any, points: Array, outputs: tuple[Array, ...]) -> None:
        self._references = function, points, outputs
        self._buffer, self._run = function.buffer()
        self._buffer.set_arg(0, points.reshape(-1).data)
        for k, output in enumerate(outputs):
            self._buffer.set_res(k, output.reshape(-1).data)

    def __call__(self) -> None:
        self._run()


CHUNK_SIZE = 1024  # number of points of a chunk: columns stay in the cache, and numpy's overhead is small
NUMPY_OPERATIONS: Mapping[int, Callable[..., Any]] = {
    ca.OP_ADD: np.add,
    ca.OP_SUB: np.subtract,
    ca.OP_MUL: np.multiply,
    ca.OP_DIV: np.divide,
    ca.OP_NEG: np.negative,
    ca.OP_INV: np.reciprocal,
    ca.OP_SQ: np.square,
    ca.OP_TWICE: lambda x, out: np.multiply(x, 2.0, out=out),
    ca.OP_SQRT: np.sqrt,
    ca.OP_SIN: np.sin,
    ca.OP_COS: np.cos,
    ca.OP_ASSIGN: lambda x, out: np.copyto(out, x),
}
"""Numpy functions of CasADi's operations, as far as joints with one coordinate need them."""


class NumpyGraph:
    def __init__(self, function: Any) -> None:
        self._columns = np.zeros((function.sz_w(), CHUNK_SIZE))
        self._steps: list[tuple[int, Any, list[int], list[int]]] = []
        for k in range(function.n_instructions()):
            code = function.instruction_id(k)
            if code == ca.OP_CONST:
                argument = function.instruction_constant(k)
            elif code in (ca.OP_INPUT, ca.OP_OUTPUT):
                argument = None
            elif code in NUMPY_OPERATIONS:
                argument = NUMPY_OPERATIONS[code]
            else:
                raise CompileError(f"numpy is not told what CasADi's operation {code} is.")
            places = function.instruction_input(k), function.instruction_output(k)
            self._steps.append((code, argument, *places))

    def __call__(self, points: Array, outputs: Sequence[Array]) -> None:
        """Evaluate at all rows of points, shape (N, n), and write to outputs, each of N rows."""
        flat = [output.reshape(len(points), -1) for output in outputs]
        for first in range(0, len(points), CHUNK_SIZE):
            some = slice(first, first + CHUNK_SIZE)
            self._evaluate(points[some].T.copy(), [output[some].T for output in flat])

    def _evaluate(self, inputs: Array, outputs: Sequence[Array]) -> None:
        columns = list(self._columns[:, : inputs.shape[1]])
        for code, argument, read, written in self._steps:
            if code == ca.OP_INPUT:
                np.copyto(columns[written[0]], inputs[read[1]])
            elif code == ca.OP_OUTPUT:
                np.copyto(outputs[written[0]][written[1]], columns[read[0]])
            elif code == ca.OP_CONST:
                columns[written[0]].fill(argument)
            else:
                argument(*[columns[place] for place in read], out=columns[written[0]])


def batch(robot: BenchmarkRobot, points: Array, folder: Path, missing: list[str]) -> Iterator[Contender]:
    """Yield contenders that evaluate Kineverse's graph with numpy, or CasADi's map in C."""
    rows, function = len(points), make_casadi_function(robot)

    def contender(name: str, run: Callable[[], object], outputs: tuple[Array, ...]) -> Contender:
        def results() -> list[Array]:
            run()
            return list(outputs)

        return Contender(name, pin_to_one_core(time_calls(run, rows)), results)

    def outputs() -> tuple[Array, Array]:
        return np.zeros((rows, 4, 4)), np.zeros((rows, 6, len(robot.chain)))

    graph, arrays = NumpyGraph(function), outputs()
    yield contender("numpy, same graph", lambda: graph(points, arrays), arrays)
    compiler = toolchain()
    if compiler is None:
        missing.append(f"casadi's map in C is missing: {no_compiler()}")
        return
    mapped = outputs()
    compiled = compile_map(function, rows, folder, compiler)
    yield contender("casadi, map in C", BoundMap(compiled, points, mapped), mapped)


def loop(angles: Array) -> Iterator[Contender]:
    """Yield the contender that closes a four-bar linkage by CasADi's rootfinder."""
    crank, x = ca.SX.sym("crank"), ca.SX.sym("x", 2)
    end = _link_transform(crank, CRANK) + _link_transform(x[0], COUPLER)
    gap = end - _link_transform(x[1], ROCKER) - ca.vertcat(GROUND, 0)
    solver = ca.rootfinder("four_bar", "fast_newton", {"x": x, "p": crank, "g": gap})
    start, angle = ca.MX.sym("start", 2), ca.MX.sym("angle")
    solution = solver(x0=start, p=angle)["x"]
    position = ca.Function("end", [x, crank], [end])(solution, angle)
    function: Any = ca.Function("loop", [start, angle], [position, ca.jacobian(position, angle)])
    starts = [_closing_angles(angle) for angle in angles]
    buffer, run = function.buffer()
    guess, given, out, derivative = np.zeros(2), np.zeros(1), np.zeros(2), np.zeros(2)
    buffer.set_arg(0, guess.data)
    buffer.set_arg(1, given.data)
    buffer.set_res(0, out.data)
    buffer.set_res(1, derivative.data)

    def evaluate(angle: float, near: Array, reference: Any = buffer) -> None:
        guess[:] = near
        given[0] = angle
        run()

    def work() -> None:
        for angle, near in zip(angles, starts, strict=True):
            evaluate(angle, near)

    def results() -> list[Array]:
        found = []
        for angle, near in zip(angles[:CHECKED], starts, strict=False):
            evaluate(angle, near)
            found.append((out.copy(), derivative.copy()))
        return [np.array([p for p, _ in found]), np.array([d for _, d in found])]

    yield Contender("casadi, rootfinder in the interpreter", time_calls(work, len(angles)), results)


def _link_transform(angle: ca.SX, length: float) -> ca.SX:
    return length * ca.vertcat(ca.cos(angle), ca.sin(angle))


def _closing_angles(crank: float) -> Array:
    """Return angles of coupler and rocker near those that close the loop, by intersecting two circles."""
    pin = CRANK * np.array([np.cos(crank), np.sin(crank)])
    offset = np.array([GROUND, 0.0]) - pin
    distance = np.linalg.norm(offset)
    along = (COUPLER**2 - ROCKER**2 + distance**2) / (2 * distance)
    across = np.sqrt(COUPLER**2 - along**2)
    end = pin + (along * offset + across * np.array([-offset[1], offset[0]])) / distance
    to_end, from_ground = end - pin, end - np.array([GROUND, 0.0])
    angles = np.array(
        [np.arctan2(to_end[1], to_end[0]), np.arctan2(from_ground[1], from_ground[0])], dtype=np.float64
    )
    return angles + 0.05
