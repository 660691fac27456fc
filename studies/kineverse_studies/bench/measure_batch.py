"""``batch``: pose and Jacobian at many configurations."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from kineverse.compilation import compile, compiler_information
from kineverse.lie import Array

from .harness import BenchmarkSettings, Contender, Contenders, time_calls, time_contenders
from .peers.casadi import BoundMap, NumpyGraph, compile_map, make_casadi_function
from .result import BenchmarkResult, compare_speed
from .workloads import BenchmarkRobot, find_benchmark_robot

ONE_CORE, ALL_CORES, FRESH = (
    "kineverse, one core",
    "kineverse, all cores",
    "kineverse, one core, fresh arrays",
)
CASADI, NUMPY, PINOCCHIO = "casadi, map in C", "numpy, same graph", "pinocchio, loop over the reduced robot"


def measure(settings: BenchmarkSettings) -> BenchmarkResult:
    """Measure batches, on one core unless the label says otherwise."""
    robot = find_benchmark_robot(settings)
    configurations = robot.configurations(settings.rows)
    points = robot.chain_columns(configurations)
    with tempfile.TemporaryDirectory(prefix="kineverse-bench-") as folder:
        participants = Contenders(list(_ours(robot, points)))
        participants.contenders += _casadi_graph(robot, points, Path(folder), participants.missing)
        participants.add_peer("pinocchio", lambda: [_pinocchio(robot, configurations)])
        measured = time_contenders("batch", participants.contenders, settings.rounds, settings.progress)
    return BenchmarkResult(
        name="batch",
        work=(
            f"pose 4x4 and Jacobian 6x{len(robot.chain)} of {robot.frame} at {len(points)} configurations; "
            "the time of one of them"
        ),
        measurements=tuple(measured.values()),
        comparisons=(
            compare_speed(measured, ONE_CORE, PINOCCHIO, 40.0),
            compare_speed(measured, ONE_CORE, CASADI, 2.0),
            compare_speed(measured, ONE_CORE, NUMPY),
            compare_speed(measured, ALL_CORES, ONE_CORE),
        ),
        missing=tuple(participants.missing),
    )


def _ours(robot: BenchmarkRobot, points: Array) -> Iterator[Contender]:
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


def _pinocchio(robot: BenchmarkRobot, configurations: Array) -> Contender:
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

    return Contender(PINOCCHIO, pin_to_one_core(time_calls(run, len(rows))), results)


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
