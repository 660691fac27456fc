"""The map of a function over many points, as CasADi generates it in C."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import casadi as ca

from kineverse.compile import compiler_information
from kineverse.errors import CompileError

from .agreement import Array
from .robot import Robot

FLAGS = ("-O3", "-march=native", "-fPIC", "-shared")
"""What a user of CasADi would choose. The C of the map is faster than a map over the C of the function."""


def graph(robot: Robot) -> Any:
    """Return pose and Jacobian of the robot's frame as a function of CasADi's, common parts shared.

    CasADi stores columns first, numpy rows first, so the outputs are transposed.
    """
    pose, jacobian = robot.model.fk(robot.frame), robot.model.jacobian(robot.frame)
    inputs = ca.vertcat(*(symbol.casadi for symbol in robot.chain))
    outputs = [ca.densify(pose.casadi.T), ca.densify(jacobian.casadi.T)]
    return ca.Function("pose_and_jacobian", [inputs], ca.cse(outputs))


def compiled_map(function: Any, rows: int, folder: Path) -> Any:
    """Return the map of a function over rows, compiled in a folder.

    Raises
    ------
    CompileError
        If the compiler fails.
    """
    mapped = function.map(rows)
    generator = ca.CodeGenerator("map.c")
    generator.add(mapped)
    source, library = folder / "map.c", folder / "map.so"
    source.write_text(generator.dump(), encoding="utf-8")
    compiler = compiler_information().compiler or "cc"
    command = [compiler, *FLAGS, str(source), "-o", str(library), "-lm"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise CompileError(f"CasADi's map cannot be compiled: {done.stderr.strip().splitlines()[0]}")
    return ca.external(mapped.name(), str(library))


class BoundMap:
    """A map with the memory it reads and writes.

    Parameters
    ----------
    function
        A map.
    points
        Its input, a row for each point.
    outputs
        What it writes.
    """

    def __init__(self, function: Any, points: Array, outputs: tuple[Array, ...]) -> None:
        self._kept = function, points, outputs
        self._buffer, self._run = function.buffer()
        self._buffer.set_arg(0, points.reshape(-1).data)
        for k, output in enumerate(outputs):
            self._buffer.set_res(k, output.reshape(-1).data)

    def __call__(self) -> None:
        """Evaluate at all points."""
        self._run()
