"""Benchmark of functions for JAX and PyTorch: ``learning``."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from importlib import import_module
from time import perf_counter
from typing import Any, Literal

import numpy as np

from kineverse.compilation import compile
from kineverse.compilation.backends import to_jax, to_torch
from kineverse.expressions import Expression
from kineverse.lie import Array

from .harness import Benchmark, BenchmarkResult, BenchmarkSettings, Contender, time_calls
from .workloads import BenchmarkRobot, find_benchmark_robot

BATCH = "kineverse, f.batch"
IN_C, IN_OPERATIONS, UNFUSED, GRADIENT = (
    f"kineverse, to_jax {how}" for how in ("in C", "in operations", "in operations, unfused", "and grad")
)
TORCH, TORCH_OPERATIONS, BACKWARD = (
    f"kineverse, to_torch {how}" for how in ("in C", "in operations", "and backward")
)
JAXADI = "jaxadi, vmap"
# XLA's fusion for CPUs computes shared parts again for each output.
WITHOUT_FUSION = {"xla_disable_hlo_passes": "fusion"}
_ROWS = 4096
_TIERS: tuple[Literal["c", "operations"], ...] = ("c", "operations")


def measure_learning(settings: BenchmarkSettings) -> BenchmarkResult:
    robot = find_benchmark_robot(settings)
    points = robot.chain_columns(robot.configurations(min(settings.rows, _ROWS)))
    outputs = [robot.model.fk(robot.frame), robot.model.jacobian(robot.frame)]

    one = Benchmark("learning", settings)
    with doubles():
        ours = [*_batch(outputs, robot, points), *_jax(one, outputs, robot, points)]
        has_torch = one.has("torch")
        if has_torch:
            ours += _torch(outputs, robot, points)
        one.time([*ours, *one.peers("learning", ("jaxadi",), one, robot, points)])
    one.speed(BATCH, IN_C, at_most=5.0)
    one.speed(BATCH, UNFUSED, at_most=15.0)
    one.speed(BATCH, IN_OPERATIONS, GRADIENT)
    one.speed((IN_C, UNFUSED), JAXADI, at_least=1.0)
    if has_torch:
        one.speed(BATCH, TORCH, at_most=2.0)
        one.speed(BATCH, TORCH_OPERATIONS, BACKWARD)
    return one.result(
        f"pose 4x4 and Jacobian 6x{len(robot.chain)} of {robot.frame} at {len(points)} configurations at "
        "once, in double; grad and backward are those of the sum over both"
    )


@contextmanager
def doubles() -> Iterator[None]:
    """Have JAX compute in double."""
    jax = import_module("jax")
    before = jax.config.jax_enable_x64
    jax.config.update("jax_enable_x64", True)
    try:
        yield
    finally:
        jax.config.update("jax_enable_x64", before)


def compile_jax(one: Benchmark, name: str, function: Callable[[Any], Any], x: Any) -> Callable[[], Any]:
    """Return a call that waits for its results, after the first one, which compiles and is noted."""
    wait = import_module("jax").block_until_ready
    start = perf_counter()
    wait(function(x))
    one.note(f"{name}, first call", "s", perf_counter() - start)
    return lambda: wait(function(x))


def _batch(outputs: Sequence[Expression], robot: BenchmarkRobot, points: Array) -> Iterator[Contender]:
    function = compile([*outputs], robot.chain, tier="c")
    results = function.batch(points)
    run = time_calls(lambda: function.batch(points, out=results), len(points))
    yield Contender(BATCH, run, lambda: list(function.batch(points)))


def _jax(
    one: Benchmark, outputs: list[Expression], robot: BenchmarkRobot, points: Array
) -> Iterator[Contender]:
    jax = import_module("jax")
    x = jax.numpy.asarray(points)
    in_c, in_operations = (to_jax(outputs, robot.chain, tier=tier) for tier in _TIERS)

    def loss(x: Any) -> Any:
        return sum(result.sum() for result in in_c(x))

    unfused = jax.jit(in_operations, compiler_options=WITHOUT_FUSION)
    for name, function in ((IN_C, in_c), (IN_OPERATIONS, in_operations), (UNFUSED, unfused)):
        call = compile_jax(one, name, function, x)
        yield Contender(name, time_calls(call, len(points)), partial(_arrays, call))
    call = compile_jax(one, GRADIENT, jax.jit(jax.vmap(jax.grad(loss))), x)
    yield Contender(GRADIENT, time_calls(call, len(points)))


def _torch(outputs: list[Expression], robot: BenchmarkRobot, points: Array) -> Iterator[Contender]:
    torch = import_module("torch")
    x = torch.tensor(points)
    leaf = torch.tensor(points, requires_grad=True)
    in_c, in_operations = (to_torch(outputs, robot.chain, tier=tier) for tier in _TIERS)
    for name, function in ((TORCH, in_c), (TORCH_OPERATIONS, in_operations)):
        call = partial(function, x)
        yield Contender(name, time_calls(call, len(points)), partial(_arrays, call))

    def backward() -> None:
        leaf.grad = None
        sum(result.sum() for result in in_c(leaf)).backward()

    yield Contender(BACKWARD, time_calls(backward, len(points)))


def _arrays(call: Callable[[], Any]) -> list[Array]:
    return [np.asarray(result) for result in call()]
