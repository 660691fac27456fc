"""Benchmarks of poses and Jacobians: ``call``, ``frames``, ``batch`` and ``loop``."""

from __future__ import annotations

import os
import subprocess
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from time import perf_counter

import numpy as np

from kineverse.articulations import Revolute
from kineverse.compilation import CompiledFunction, Evaluator, compile, compiler_information
from kineverse.compilation.program import Program
from kineverse.compilation.toolchain import NO_UNDEFINED_FLAGS, optimisation_level, toolchain
from kineverse.expressions import array
from kineverse.lie import Array
from kineverse.loops import CloseLoop
from kineverse.model.body import Pose
from kineverse.model.frame import WORLD, Frame
from kineverse.model.model import Model
from kineverse.spatial import translation

from .harness import Benchmark, BenchmarkResult, BenchmarkSettings, Contender, time_calls
from .workloads import BenchmarkRobot, find_benchmark_robot

BOUND, WRITTEN, PLAIN = "kineverse, bound call", "kineverse, bound call with input", "kineverse, plain call"
CHECKED, CHECKED_FRAMES = 50, 10  # numbers of configurations at which results are compared
_BOUND_AT_ONCE = 40
_TABLE = 147, 62


def measure_call(settings: BenchmarkSettings) -> BenchmarkResult:
    robot = find_benchmark_robot(settings)
    configurations = robot.configurations(settings.configurations)

    one = Benchmark("call", settings)
    peers = one.peers("call", ("pinocchio", "mujoco"), robot, configurations)
    one.time([*_call(robot, configurations), *peers])
    reduced = "pinocchio, reduced to the chain", "pinocchio, reduced, placement held"
    one.speed(BOUND, reduced[0], at_least=8.0)
    one.speed(BOUND, reduced[1])
    one.speed(WRITTEN, *reduced, at_least=3.0)
    one.speed(PLAIN, *reduced, at_least=1.3)
    one.speed(PLAIN, "pinocchio, path to the frame")
    one.speed(PLAIN, "pinocchio, all joints", at_least=3.0)
    one.speed(PLAIN, "mujoco, all joints")
    if times := _table_compile_times(settings.processes):
        one.bound(2.0, one.note("kineverse, {}x{} constants compiled".format(*_TABLE), "s", *times).name)
    return one.result(
        f"pose 4x4 and Jacobian 6x{len(robot.chain)} of {robot.frame}, one configuration, from Python; "
        f"inputs go through {len(configurations)} configurations"
    )


def pose_and_jacobian(robot: BenchmarkRobot) -> CompiledFunction:
    model = robot.model
    return compile([model.fk(robot.frame), model.jacobian(robot.frame)], robot.chain, wait=True)


def stack_results(results: Iterable[tuple[Array, ...]]) -> list[Array]:
    poses, jacobians = zip(*results, strict=True)
    return [np.array(poses), np.array(jacobians)]


def _table_compile_times(times: int) -> list[float]:
    """Return times to generate and compile C for a matrix of constants, without cache [s]."""
    compiler = toolchain()
    if compiler is None:
        return []
    numbers = np.random.default_rng(0).normal(size=_TABLE)
    samples = []
    with tempfile.TemporaryDirectory(prefix="kineverse-bench-") as folder:
        for _ in range(times):
            start = perf_counter()
            program = Program([array(numbers)], ())
            flags = (optimisation_level(program.instructions) or "", *NO_UNDEFINED_FLAGS)
            command = compiler.arguments(flags, str(Path(folder, "library.so")))
            environment = compiler.environment(folder)
            subprocess.run(command, input=program.source().encode(), check=True, env=environment)
            samples.append(perf_counter() - start)
    return samples


def _over(call: Callable[[Array], object], points: Sequence[Array]) -> Callable[[], float]:

    def run() -> None:
        for point in points:
            call(point)

    return time_calls(run, len(points))


def _call(robot: BenchmarkRobot, configurations: Array) -> Iterator[Contender]:
    function = pose_and_jacobian(robot)
    points = list(robot.chain_columns(configurations))
    # Each bound call has an evaluator whose input is written before the time is taken. More evaluators would
    # not fit into the first-level cache, and memory access would be measured.
    evaluators = [function.bind() for _ in points[:_BOUND_AT_ONCE]]

    def bound() -> float:
        seconds = 0.0
        for first in range(0, len(points), len(evaluators)):
            for own, point in zip(evaluators, points[first:], strict=False):
                own.input[:] = point
            start = perf_counter()
            for evaluate in evaluators:
                evaluate()
            seconds += perf_counter() - start
        return seconds / (len(evaluators) * -(-len(points) // len(evaluators)))

    def outputs(evaluate: Evaluator, point: Array, bound: bool) -> tuple[Array, ...]:
        if bound:
            evaluate.input[:] = point
            evaluate()
        else:
            evaluate(point)
        return tuple(output.copy() for output in evaluate.outputs)

    def results(bound: bool) -> list[Array]:
        return stack_results(outputs(evaluators[0], point, bound) for point in points[:CHECKED])

    yield Contender(PLAIN, _over(function, points), lambda: stack_results(map(function, points[:CHECKED])))
    yield Contender(WRITTEN, _over(function.bind(), points), lambda: results(False))
    yield Contender(BOUND, bound, lambda: results(True))


def measure_frames(settings: BenchmarkSettings) -> BenchmarkResult:
    robot = find_benchmark_robot(settings)
    frames, configurations = list(robot.model.frames), robot.configurations(settings.configurations)
    evaluator = compile([robot.model.fk(f) for f in frames], robot.coordinates, wait=True).bind()
    points = list(configurations)

    def results() -> Iterator[Array]:
        for point in points[:CHECKED_FRAMES]:
            evaluator(point)
            yield np.array(evaluator.outputs)

    one = Benchmark("frames", settings)
    ours = Contender(WRITTEN, _over(evaluator, points), lambda: list(results()))
    one.time([ours, *one.peers("frames", ("pinocchio", "mujoco"), robot, frames, configurations)])
    one.speed(WRITTEN, "pinocchio", at_least=2.5)
    one.speed(WRITTEN, "mujoco")
    return one.result(
        f"the poses of all {len(frames)} links of {robot.file.name}, one configuration, from Python; "
        f"inputs go through {len(configurations)} configurations"
    )


ONE_CORE, ALL_CORES, FRESH = (
    f"kineverse, {how}" for how in ("one core", "all cores", "one core, fresh arrays")
)


def measure_batch(settings: BenchmarkSettings) -> BenchmarkResult:
    robot = find_benchmark_robot(settings)
    configurations = robot.configurations(settings.rows)
    points = robot.chain_columns(configurations)

    one = Benchmark("batch", settings)
    with tempfile.TemporaryDirectory(prefix="kineverse-bench-") as folder:
        graph = one.peers("batch", ("casadi",), robot, points, Path(folder), one.missing)
        one.time([*_batch(robot, points), *graph, *one.peers("batch", ("pinocchio",), robot, configurations)])
    one.speed(ONE_CORE, "pinocchio, loop over the reduced robot", at_least=40.0)
    one.speed(ONE_CORE, "casadi, map in C", at_least=2.0)
    one.speed(ONE_CORE, "numpy, same graph")
    one.speed(ALL_CORES, ONE_CORE)
    return one.result(
        f"pose 4x4 and Jacobian 6x{len(robot.chain)} of {robot.frame} at {len(points)} configurations; "
        "the time of one of them"
    )


def _batch(robot: BenchmarkRobot, points: Array) -> Iterator[Contender]:
    model = robot.model
    tier = "c" if compiler_information().compiler else "auto"
    function = compile([model.fk(robot.frame), model.jacobian(robot.frame)], robot.chain, tier=tier)  # type: ignore[call-overload]
    outputs = function.batch(points)
    run = time_calls(lambda: function.batch(points, out=outputs), len(points))
    fresh = time_calls(lambda: function.batch(points), len(points))
    yield Contender(ONE_CORE, pin_to_one_core(run), lambda: list(function.batch(points)))
    yield Contender(FRESH, pin_to_one_core(fresh))
    yield Contender(ALL_CORES, run)


def pin_to_one_core(sample: Callable[[], float]) -> Callable[[], float]:
    """Return a sample that runs on one core, if the system supports affinities."""
    if not hasattr(os, "sched_setaffinity"):
        return sample

    def pinned() -> float:
        before = os.sched_getaffinity(0)
        os.sched_setaffinity(0, {max(before)})
        try:
            return sample()
        finally:
            os.sched_setaffinity(0, before)

    return pinned


CRANK, COUPLER, ROCKER, GROUND = 0.4, 1.1, 0.9, 1.0  # lengths of the links of a four-bar linkage [m]


def measure_loop(settings: BenchmarkSettings) -> BenchmarkResult:
    angles = np.random.default_rng(0).uniform(-np.pi, np.pi, settings.configurations)
    one = Benchmark("loop", settings)
    one.time([*_close_loop(angles), *one.peers("loop", ("casadi",), angles)])
    one.bound(5e-6, WRITTEN, PLAIN)
    one.speed(WRITTEN, "casadi, rootfinder in the interpreter")
    return one.result(
        "position of the coupler's end and its derivative by the crank of a four-bar linkage; the crank "
        f"goes through {len(angles)} angles all around"
    )


def make_four_bar() -> Model:
    """Return a four-bar linkage: crank and coupler, closed with the rocker."""
    model = Model()
    with model.edit() as edit:
        for name, parent, x in (
            ("crank", WORLD, 0.0),
            ("coupler", "crank", CRANK),
            ("rocker", WORLD, GROUND),
        ):
            origin = Pose.from_matrix(translation(x, 0, 0))
            edit.apply(Revolute(name=name, parent=parent, child=name, origin=origin, axis=(0.0, 0.0, 1.0)))
        for name, length in (("coupler", COUPLER), ("rocker", ROCKER)):
            edit.add_frame(
                f"{name} end", name, Frame.from_transform(name, translation(length, 0, 0)).transform
            )
        home = (("coupler", 1.0), ("rocker", 1.5))
        edit.apply(CloseLoop(name="four-bar", frame="coupler end", to="rocker end", home=home))
    return model


def _close_loop(angles: Array) -> Iterator[Contender]:
    model = make_four_bar()
    crank = model.symbol("crank")
    position = model.fk("coupler end")[:3, 3]
    function = compile([position, position.jacobian([crank])], [crank], wait=True)
    points = [np.array([angle]) for angle in angles]

    def results() -> list[Array]:
        found = [function(point) for point in points[:CHECKED]]
        return [np.array([p[:2] for p, _ in found]), np.array([j[:2, 0] for _, j in found])]

    yield Contender(WRITTEN, _over(function.bind(), points), results)
    yield Contender(PLAIN, _over(function, points), results)
