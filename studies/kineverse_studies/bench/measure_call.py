"""``call``: pose and Jacobian at one configuration, called from Python."""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from time import perf_counter

import numpy as np

from kineverse.compilation import CompiledFunction, Evaluator, compile
from kineverse.compilation.program import Program
from kineverse.compilation.toolchain import NO_UNDEFINED_FLAGS, optimisation_level, toolchain
from kineverse.expressions import array
from kineverse.lie import Array

from .harness import BenchmarkSettings, Contender, Contenders, time_calls, time_contenders
from .result import BenchmarkResult, Measurement, bound_median, compare_speed
from .workloads import BenchmarkRobot, find_benchmark_robot

BOUND, WRITTEN, PLAIN = "kineverse, bound call", "kineverse, bound call with input", "kineverse, plain call"
REDUCED, HELD = "pinocchio, reduced to the chain", "pinocchio, reduced, placement held"
PATH, WHOLE = "pinocchio, path to the frame", "pinocchio, all joints"
MUJOCO = "mujoco, all joints"

_CHECKED = 50
_BOUND_AT_ONCE = 40
_TABLE = 147, 62


def measure(settings: BenchmarkSettings) -> BenchmarkResult:
    """Measure interleaved calls at the same configurations."""
    robot = find_benchmark_robot(settings)
    configurations = robot.configurations(settings.configurations)
    participants = Contenders(list(_ours(robot, configurations)))
    participants.add_peer("pinocchio", lambda: _pinocchio(robot, configurations))
    participants.add_peer("mujoco", lambda: [_mujoco(robot, configurations)])
    measured = time_contenders("call", participants.contenders, settings.rounds, settings.progress)
    tables = list(_table_compile_times(settings.processes))
    return BenchmarkResult(
        name="call",
        work=(
            f"pose 4x4 and Jacobian 6x{len(robot.chain)} of {robot.frame}, one configuration, from Python; "
            f"inputs go through {len(configurations)} configurations"
        ),
        measurements=(*measured.values(), *tables),
        comparisons=(
            compare_speed(measured, BOUND, REDUCED, 8.0),
            compare_speed(measured, BOUND, HELD),
            *(compare_speed(measured, WRITTEN, peer, 3.0) for peer in (REDUCED, HELD)),
            *(compare_speed(measured, PLAIN, peer, 1.3) for peer in (REDUCED, HELD)),
            compare_speed(measured, PLAIN, PATH),
            compare_speed(measured, PLAIN, WHOLE, 3.0),
            compare_speed(measured, PLAIN, MUJOCO),
            *(bound_median(table, 2.0) for table in tables),
        ),
        missing=tuple(participants.missing),
    )


def pose_and_jacobian(robot: BenchmarkRobot) -> CompiledFunction:
    """Return the compiled function of pose and Jacobian."""
    model = robot.model
    return compile([model.fk(robot.frame), model.jacobian(robot.frame)], robot.chain, wait=True)


def _table_compile_times(times: int) -> Iterator[Measurement]:
    """Yield the time to generate and compile C for a matrix of constants, without cache."""
    compiler = toolchain()
    if compiler is None:
        return
    numbers = np.random.default_rng(0).normal(size=_TABLE)
    samples = []
    with tempfile.TemporaryDirectory(prefix="kineverse-bench-") as folder:
        for _ in range(times):
            start = perf_counter()
            program = Program([array(numbers)], ())
            flags = (optimisation_level(program.instructions) or "", *NO_UNDEFINED_FLAGS)
            command = compiler.arguments(flags, str(Path(folder, "library.so")))
            subprocess.run(command, input=program.source().encode(), check=True)
            samples.append(perf_counter() - start)
    yield Measurement("kineverse, {}x{} constants compiled".format(*_TABLE), "s", tuple(samples))


def _ours(robot: BenchmarkRobot, configurations: Array) -> Iterator[Contender]:
    function = pose_and_jacobian(robot)
    points = list(robot.chain_columns(configurations))
    evaluator = function.bind()

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

    def written() -> None:
        for point in points:
            evaluator(point)

    def plain() -> None:
        for point in points:
            function(point)

    def outputs(evaluate: Evaluator, point: Array, bound: bool) -> tuple[Array, ...]:
        if bound:
            evaluate.input[:] = point
            evaluate()
        else:
            evaluate(point)
        return tuple(output.copy() for output in evaluate.outputs)

    def results(bound: bool) -> list[Array]:
        return _stack_results(outputs(evaluators[0], point, bound) for point in points[:_CHECKED])

    yield Contender(
        PLAIN, time_calls(plain, len(points)), lambda: _stack_results(map(function, points[:_CHECKED]))
    )
    yield Contender(WRITTEN, time_calls(written, len(points)), lambda: results(False))
    yield Contender(BOUND, bound, lambda: results(True))


def _pinocchio(robot: BenchmarkRobot, configurations: Array) -> Iterator[Contender]:
    import pinocchio as pin

    from .peers.pinocchio import PinocchioRobot

    positions = robot.positions(configurations)
    compute, aligned = pin.computeFrameJacobian, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    reduced, whole = PinocchioRobot(robot, reduced=True), PinocchioRobot(robot)

    def look_up_placement(peer: PinocchioRobot, rows: list[Array]) -> None:
        model, data, frame = peer.model, peer.data, peer.frame
        for row in rows:
            compute(model, data, row, frame, aligned)
            data.oMf[frame].homogeneous  # noqa: B018 - makes an array

    def hold_placement(peer: PinocchioRobot, rows: list[Array]) -> None:
        model, data, frame, pose = peer.model, peer.data, peer.frame, peer.pose
        for row in rows:
            compute(model, data, row, frame, aligned)
            pose.homogeneous  # noqa: B018 - makes an array

    def compute_all_joints(peer: PinocchioRobot, rows: list[Array]) -> None:
        model, data, frame, pose = peer.model, peer.data, peer.frame, peer.pose
        for row in rows:
            pin.computeJointJacobians(model, data, row)
            pin.updateFramePlacement(model, data, frame)
            pin.getFrameJacobian(model, data, frame, aligned)
            pose.homogeneous  # noqa: B018 - makes an array

    for name, peer, run in (
        (REDUCED, reduced, look_up_placement),
        (HELD, reduced, hold_placement),
        (PATH, whole, hold_placement),
        (WHOLE, whole, compute_all_joints),
    ):
        rows = peer.rows(positions)
        work, checked = partial(run, peer, rows), partial(map, peer.pose_and_jacobian, rows[:_CHECKED])
        yield Contender(name, time_calls(work, len(rows)), lambda checked=checked: _stack_results(checked()))  # type: ignore[misc]


def _mujoco(robot: BenchmarkRobot, configurations: Array) -> Contender:
    import mujoco

    from .peers.mujoco_kinematics import MujocoRobot

    peer = MujocoRobot(robot)
    rows = peer.rows(robot.positions(configurations))

    def run() -> None:
        # The pose stays in MuJoCo's data.
        kinematics, centres, jacobian = mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_jacBody
        model, data, body, position = peer.model, peer.data, peer.body, peer.data.qpos
        linear, angular = peer.jacobian[:3], peer.jacobian[3:]
        for row in rows:
            position[:] = row
            kinematics(model, data)
            centres(model, data)
            jacobian(model, data, linear, angular, body)

    return Contender(
        MUJOCO,
        time_calls(run, len(rows)),
        lambda: _stack_results(map(peer.pose_and_jacobian, rows[:_CHECKED])),
    )


def _stack_results(results: Iterable[tuple[Array, ...]]) -> list[Array]:
    poses, jacobians = zip(*results, strict=True)
    return [np.array(poses), np.array(jacobians)]
