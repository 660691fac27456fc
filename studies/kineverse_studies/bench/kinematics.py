"""Benchmarks of poses and Jacobians: ``call``, ``frames``, ``batch`` and ``loop``."""

from __future__ import annotations

import os
import subprocess
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any

import casadi as ca
import numpy as np

from kineverse.articulations import Revolute
from kineverse.compile import CompiledFunction, Evaluator, compile, compiler_information  # noqa: A004
from kineverse.compile.program import Program
from kineverse.compile.toolchain import NO_UNDEFINED_FLAGS, optimisation_level, toolchain
from kineverse.expressions import array
from kineverse.lie import Array
from kineverse.loops import CloseLoop
from kineverse.model.body import Pose
from kineverse.model.frame import WORLD, Frame
from kineverse.model.model import Model
from kineverse.spatial import translation

from .harness import (
    BenchmarkResult,
    BenchmarkSettings,
    Contender,
    Contenders,
    Measurement,
    bound_median,
    compare_speed,
    time_calls,
    time_contenders,
)
from .peers.casadi import BoundMap, NumpyGraph, compile_map, make_casadi_function
from .workloads import BenchmarkRobot, find_benchmark_robot

BOUND, WRITTEN, PLAIN = "kineverse, bound call", "kineverse, bound call with input", "kineverse, plain call"
REDUCED, HELD = "pinocchio, reduced to the chain", "pinocchio, reduced, placement held"
PATH, WHOLE = "pinocchio, path to the frame", "pinocchio, all joints"
MUJOCO = "mujoco, all joints"
_CHECKED_CALLS = 50
_BOUND_AT_ONCE = 40
_TABLE = 147, 62


def measure_call(settings: BenchmarkSettings) -> BenchmarkResult:
    """Measure interleaved calls at the same configurations."""
    robot = find_benchmark_robot(settings)
    configurations = robot.configurations(settings.configurations)
    participants = Contenders(list(_call_with_kineverse(robot, configurations)))
    participants.add_peer("pinocchio", lambda: _call_with_pinocchio(robot, configurations))
    participants.add_peer("mujoco", lambda: [_call_with_mujoco(robot, configurations)])
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


def _call_with_kineverse(robot: BenchmarkRobot, configurations: Array) -> Iterator[Contender]:
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
        return _stack_results(outputs(evaluators[0], point, bound) for point in points[:_CHECKED_CALLS])

    yield Contender(
        PLAIN, time_calls(plain, len(points)), lambda: _stack_results(map(function, points[:_CHECKED_CALLS]))
    )
    yield Contender(WRITTEN, time_calls(written, len(points)), lambda: results(False))
    yield Contender(BOUND, bound, lambda: results(True))


def _call_with_pinocchio(robot: BenchmarkRobot, configurations: Array) -> Iterator[Contender]:
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
        work, checked = partial(run, peer, rows), partial(map, peer.pose_and_jacobian, rows[:_CHECKED_CALLS])
        yield Contender(name, time_calls(work, len(rows)), lambda checked=checked: _stack_results(checked()))  # type: ignore[misc]


def _call_with_mujoco(robot: BenchmarkRobot, configurations: Array) -> Contender:
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
        lambda: _stack_results(map(peer.pose_and_jacobian, rows[:_CHECKED_CALLS])),
    )


def _stack_results(results: Iterable[tuple[Array, ...]]) -> list[Array]:
    poses, jacobians = zip(*results, strict=True)
    return [np.array(poses), np.array(jacobians)]


PINOCCHIO_FRAMES, MUJOCO_FRAMES = "pinocchio", "mujoco"
_CHECKED_FRAMES = 10


def measure_frames(settings: BenchmarkSettings) -> BenchmarkResult:
    robot = find_benchmark_robot(settings)
    frames = list(robot.model.frames)
    configurations = robot.configurations(settings.configurations)
    participants = Contenders([_frames_with_kineverse(robot, frames, configurations)])
    participants.add_peer("pinocchio", lambda: [_frames_with_pinocchio(robot, frames, configurations)])
    participants.add_peer("mujoco", lambda: [_frames_with_mujoco(robot, frames, configurations)])
    measured = time_contenders("frames", participants.contenders, settings.rounds, settings.progress)
    return BenchmarkResult(
        name="frames",
        work=(
            f"the poses of all {len(frames)} links of {robot.file.name}, one configuration, from Python; "
            f"inputs go through {len(configurations)} configurations"
        ),
        measurements=tuple(measured.values()),
        comparisons=(
            compare_speed(measured, WRITTEN, PINOCCHIO_FRAMES, 2.5),
            compare_speed(measured, WRITTEN, MUJOCO_FRAMES),
        ),
        missing=tuple(participants.missing),
    )


def _frames_with_kineverse(robot: BenchmarkRobot, frames: Sequence[str], configurations: Array) -> Contender:
    function = compile([robot.model.fk(frame) for frame in frames], robot.coordinates, wait=True)
    evaluator = function.bind()
    points = list(configurations)

    def run() -> None:
        for point in points:
            evaluator(point)

    def results() -> list[Array]:
        poses = []
        for point in points[:_CHECKED_FRAMES]:
            evaluator(point)
            poses.append(np.array(evaluator.outputs))
        return poses

    return Contender(WRITTEN, time_calls(run, len(points)), results)


def _frames_with_pinocchio(robot: BenchmarkRobot, frames: Sequence[str], configurations: Array) -> Contender:
    import pinocchio as pin

    from .peers.pinocchio import PinocchioRobot

    peer = PinocchioRobot(robot)
    model, data = peer.model, peer.data
    rows = peer.rows(robot.positions(configurations))
    numbers = [model.getFrameId(frame, pin.FrameType.BODY) for frame in frames]

    def run() -> None:
        forward = pin.framesForwardKinematics
        for row in rows:
            forward(model, data, row)

    def results() -> list[Array]:
        poses = []
        for row in rows[:_CHECKED_FRAMES]:
            pin.framesForwardKinematics(model, data, row)
            poses.append(np.array([data.oMf[k].homogeneous for k in numbers]))
        return poses

    return Contender(PINOCCHIO_FRAMES, time_calls(run, len(rows)), results)


def _frames_with_mujoco(robot: BenchmarkRobot, frames: Sequence[str], configurations: Array) -> Contender:
    import mujoco

    from .peers.mujoco_kinematics import MujocoRobot

    peer = MujocoRobot(robot)
    model, data = peer.model, peer.data
    rows = peer.rows(robot.positions(configurations))
    # The robot's root is MuJoCo's world.
    numbers = [max(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, frame), 0) for frame in frames]

    def run() -> None:
        forward, position = mujoco.mj_kinematics, data.qpos
        for row in rows:
            position[:] = row
            forward(model, data)

    def results() -> list[Array]:
        poses = []
        for row in rows[:_CHECKED_FRAMES]:
            data.qpos[:] = row
            mujoco.mj_kinematics(model, data)
            poses.append(np.array([peer.pose(k) for k in numbers]))
        return poses

    return Contender(MUJOCO_FRAMES, time_calls(run, len(rows)), results)


ONE_CORE, ALL_CORES, FRESH = (
    "kineverse, one core",
    "kineverse, all cores",
    "kineverse, one core, fresh arrays",
)
CASADI, NUMPY, PINOCCHIO_LOOP = (
    "casadi, map in C",
    "numpy, same graph",
    "pinocchio, loop over the reduced robot",
)


def measure_batch(settings: BenchmarkSettings) -> BenchmarkResult:
    """Measure batches, on one core unless the label says otherwise."""
    robot = find_benchmark_robot(settings)
    configurations = robot.configurations(settings.rows)
    points = robot.chain_columns(configurations)
    with tempfile.TemporaryDirectory(prefix="kineverse-bench-") as folder:
        participants = Contenders(list(_batch_with_kineverse(robot, points)))
        participants.contenders += _casadi_graph(robot, points, Path(folder), participants.missing)
        participants.add_peer("pinocchio", lambda: [_batch_with_pinocchio(robot, configurations)])
        measured = time_contenders("batch", participants.contenders, settings.rounds, settings.progress)
    return BenchmarkResult(
        name="batch",
        work=(
            f"pose 4x4 and Jacobian 6x{len(robot.chain)} of {robot.frame} at {len(points)} configurations; "
            "the time of one of them"
        ),
        measurements=tuple(measured.values()),
        comparisons=(
            compare_speed(measured, ONE_CORE, PINOCCHIO_LOOP, 40.0),
            compare_speed(measured, ONE_CORE, CASADI, 2.0),
            compare_speed(measured, ONE_CORE, NUMPY),
            compare_speed(measured, ALL_CORES, ONE_CORE),
        ),
        missing=tuple(participants.missing),
    )


def _batch_with_kineverse(robot: BenchmarkRobot, points: Array) -> Iterator[Contender]:
    model = robot.model
    tier = "c" if compiler_information().compiler else "auto"
    function = compile([model.fk(robot.frame), model.jacobian(robot.frame)], robot.chain, tier=tier)  # type: ignore[call-overload]
    outputs = function.batch(points)

    def run() -> None:
        function.batch(points, out=outputs)

    def fresh() -> None:
        function.batch(points)

    def results() -> list[Array]:
        return list(function.batch(points))

    yield Contender(ONE_CORE, pin_to_one_core(time_calls(run, len(points))), results)
    yield Contender(FRESH, pin_to_one_core(time_calls(fresh, len(points))))
    yield Contender(ALL_CORES, time_calls(run, len(points)))


def _casadi_graph(
    robot: BenchmarkRobot, points: Array, folder: Path, missing: list[str]
) -> Iterator[Contender]:
    """Yield contenders that evaluate Kineverse's graph with numpy, or CasADi's map in C."""
    rows, function = len(points), make_casadi_function(robot)
    numpy_graph = NumpyGraph(function)
    outputs = _outputs(robot, rows)
    yield Contender(
        NUMPY,
        pin_to_one_core(time_calls(lambda: numpy_graph(points, outputs), rows)),
        _results(lambda: numpy_graph(points, outputs), outputs),
    )
    if compiler_information().compiler is None:
        missing.append("casadi's map in C is missing: there is no C compiler")
        return
    map_outputs = _outputs(robot, rows)
    mapped = BoundMap(compile_map(function, rows, folder), points, map_outputs)
    yield Contender(CASADI, pin_to_one_core(time_calls(mapped, rows)), _results(mapped, map_outputs))


def _batch_with_pinocchio(robot: BenchmarkRobot, configurations: Array) -> Contender:
    import pinocchio as pin

    from .peers.pinocchio import PinocchioRobot

    peer = PinocchioRobot(robot, reduced=True)
    rows = peer.rows(robot.positions(configurations))
    poses, jacobians = _outputs(robot, len(rows))

    def run() -> None:
        compute, aligned = pin.computeFrameJacobian, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        model, data, frame, pose = peer.model, peer.data, peer.frame, peer.pose
        for k, row in enumerate(rows):
            jacobians[k] = compute(model, data, row, frame, aligned)
            poses[k] = pose.homogeneous

    def results() -> list[Array]:
        run()
        return [poses, jacobians[:, :, peer.columns]]

    return Contender(PINOCCHIO_LOOP, pin_to_one_core(time_calls(run, len(rows))), results)


def _outputs(robot: BenchmarkRobot, rows: int) -> tuple[Array, Array]:
    return np.zeros((rows, 4, 4)), np.zeros((rows, 6, len(robot.chain)))


def _results(run: Callable[[], object], outputs: tuple[Array, ...]) -> Callable[[], list[Array]]:
    def results() -> list[Array]:
        run()
        return list(outputs)

    return results


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


ROOTFINDER = "casadi, rootfinder in the interpreter"
_CRANK, _COUPLER, _ROCKER, _GROUND = 0.4, 1.1, 0.9, 1.0


def measure_loop(settings: BenchmarkSettings) -> BenchmarkResult:
    """Measure the position and Jacobian of the coupler's end over full turns of the crank."""
    angles = np.random.default_rng(0).uniform(-np.pi, np.pi, settings.configurations)
    participants = Contenders([*_loop_with_kineverse(angles), _rootfinder(angles)])
    measured = time_contenders("loop", participants.contenders, settings.rounds, settings.progress)
    return BenchmarkResult(
        name="loop",
        work=(
            "position of the coupler's end and its derivative by the crank of a four-bar linkage; the crank "
            f"goes through {len(angles)} angles all around"
        ),
        measurements=tuple(measured.values()),
        comparisons=(
            bound_median(measured[WRITTEN], 5e-6),
            bound_median(measured[PLAIN], 5e-6),
            compare_speed(measured, WRITTEN, ROOTFINDER),
        ),
        missing=tuple(participants.missing),
    )


def make_four_bar() -> Model:
    """Return a four-bar linkage: crank and coupler, closed with the rocker."""
    model = Model()
    with model.edit() as edit:
        for name, parent, x in (
            ("crank", WORLD, 0.0),
            ("coupler", "crank", _CRANK),
            ("rocker", WORLD, _GROUND),
        ):
            origin = Pose.from_matrix(translation(x, 0, 0))
            edit.apply(Revolute(name=name, parent=parent, child=name, origin=origin, axis=(0.0, 0.0, 1.0)))
        for name, length in (("coupler", _COUPLER), ("rocker", _ROCKER)):
            edit.add_frame(
                f"{name} end", name, Frame.from_transform(name, translation(length, 0, 0)).transform
            )
        home = (("coupler", 1.0), ("rocker", 1.5))
        edit.apply(CloseLoop(name="four-bar", frame="coupler end", to="rocker end", home=home))
    return model


def _loop_with_kineverse(angles: Array) -> Iterator[Contender]:
    model = make_four_bar()
    crank = model.symbol("crank")
    position = model.fk("coupler end")[:3, 3]
    function = compile([position, position.jacobian([crank])], [crank], wait=True)
    evaluator = function.bind()
    points = [np.array([angle]) for angle in angles]

    def bound() -> None:
        for point in points:
            evaluator(point)

    def plain() -> None:
        for point in points:
            function(point)

    def results() -> list[Array]:
        found = [function(point) for point in points[:_CHECKED_CALLS]]
        return [np.array([p[:2] for p, _ in found]), np.array([j[:2, 0] for _, j in found])]

    yield Contender(WRITTEN, time_calls(bound, len(points)), results)
    yield Contender(PLAIN, time_calls(plain, len(points)), results)


def _rootfinder(angles: Array) -> Contender:
    crank, x = ca.SX.sym("crank"), ca.SX.sym("x", 2)
    end = _link_transform(crank, _CRANK) + _link_transform(x[0], _COUPLER)
    gap = end - _link_transform(x[1], _ROCKER) - ca.vertcat(_GROUND, 0)
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
        for angle, near in zip(angles[:_CHECKED_CALLS], starts, strict=False):
            evaluate(angle, near)
            found.append((out.copy(), derivative.copy()))
        return [np.array([p for p, _ in found]), np.array([d for _, d in found])]

    return Contender(ROOTFINDER, time_calls(work, len(angles)), results)


def _link_transform(angle: ca.SX, length: float) -> ca.SX:
    return length * ca.vertcat(ca.cos(angle), ca.sin(angle))


def _closing_angles(crank: float) -> Array:
    """Return angles of coupler and rocker near those that close the loop, by intersecting two circles."""
    pin = _CRANK * np.array([np.cos(crank), np.sin(crank)])
    offset = np.array([_GROUND, 0.0]) - pin
    distance = np.linalg.norm(offset)
    along = (_COUPLER**2 - _ROCKER**2 + distance**2) / (2 * distance)
    across = np.sqrt(_COUPLER**2 - along**2)
    end = pin + (along * offset + across * np.array([-offset[1], offset[0]])) / distance
    to_end, from_ground = end - pin, end - np.array([_GROUND, 0.0])
    angles = np.array(
        [np.arctan2(to_end[1], to_end[0]), np.arctan2(from_ground[1], from_ground[0])], dtype=np.float64
    )
    return angles + 0.05
