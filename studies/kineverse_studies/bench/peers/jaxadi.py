"""CasADi graph of the robot as a function of JAX, converted by jaxadi."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import casadi as ca
import jax
import jaxadi
import numpy as np

from kineverse.lie import Array
from kineverse_studies.bench.harness import Benchmark, Contender, time_calls
from kineverse_studies.bench.learning import JAXADI, compile_jax
from kineverse_studies.bench.workloads import BenchmarkRobot


def learning(one: Benchmark, robot: BenchmarkRobot, points: Array) -> Iterator[Contender]:
    """Yield the contender that maps the converted function over all points."""
    inputs: Any = ca.vertcat(*(symbol.casadi for symbol in robot.chain))
    outputs: Any = [robot.model.fk(robot.frame).casadi, robot.model.jacobian(robot.frame).casadi]
    converted: Any = jaxadi.convert(ca.Function("pose_and_jacobian", [inputs], ca.cse(outputs)))
    mapped = jax.jit(jax.vmap(lambda x: converted(x[:, None])))
    call = compile_jax(one, JAXADI, mapped, jax.numpy.asarray(points))
    yield Contender(JAXADI, time_calls(call, len(points)), lambda: [np.asarray(r) for r in call()])
