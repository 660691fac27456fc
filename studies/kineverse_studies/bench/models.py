"""Benchmarks of models: ``motion``, ``document`` and ``edit``."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from pathlib import Path
from time import perf_counter
from typing import Any
from xml.etree import ElementTree

import numpy as np

from kineverse._runtime import no_collection
from kineverse.articulations import Revolute
from kineverse.articulations.joint import Joint
from kineverse.expressions import Expression
from kineverse.formats import document
from kineverse.lie import Array
from kineverse.model import Diff, Model, Operation, Pose, ReadRecorder, Writes
from kineverse.model.frame import WORLD
from kineverse.model.violations import Violations
from kineverse.state import State
from kineverse.symbols import position

from .harness import Benchmark, BenchmarkResult, BenchmarkSettings, Contender, time_calls
from .workloads import BenchmarkRobot, find_benchmark_robot, make_kitchen_model, strip_shapes

TO_EMPTY, TO_LARGE = "append an operation to an empty model", "append it to a large model"
REPLACE = "replace an operation that others read"
COPY = "copy a large model, per operation"
RELEVANT, RELEVANT_NEW = "constraints_for a pose", "constraints_for a new expression"
READERS = 7  # number of operations that read the writes of the replaced one
_AXES = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
_APPENDED = _QUERIES = 100


@dataclass(frozen=True)
class Measured(Operation):
    name: str
    value: float

    def apply(self, model: ReadRecorder) -> Writes:
        return Writes(data={self.name: self.value})


@dataclass(frozen=True)
class Doubled(Operation):
    name: str
    of: str

    def apply(self, model: ReadRecorder) -> Writes:
        return Writes(data={self.name: 2.0 * model.data[self.of]})


def make_large_model(operations: int) -> Model:
    """Return a model of chains of joints with a constraint each, and of numbers that depend on one number."""
    model = Model()
    with model.edit() as edit:
        edit.apply(Measured("source", 1.0))
        for k in range(READERS):
            edit.apply(Doubled(f"reader {k}", "source"))
        for k in range(operations - READERS - 1):
            edit.apply(_chain_joint(k))
        for k in range(operations - len(model.constraints)):
            q = position(f"joint {k}")
            edit.constrain(f"near {k}", -0.5, q, 0.5)
    return model


def _chain_joint(number: int) -> Revolute:
    parent = WORLD if number % 8 == 0 else f"link {number - 1}"
    return Revolute(
        name=f"joint {number}",
        parent=parent,
        child=f"link {number}",
        origin=Pose((1.0, 0.0, 0.0, 0.1, 0.0, 1.0, 0.0, 0.2, 0.0, 0.0, 1.0, 0.3)),
        axis=_AXES[number % 3],
        lower=-1.0,
        upper=1.0,
    )


def large_model_contenders(large: Model) -> Iterator[Contender]:
    """Yield the edits and queries of a large model; appending is also measured on an empty model."""
    yield Contender(TO_EMPTY, time_calls(_append_operations, _APPENDED, Model))
    yield Contender(TO_LARGE, time_calls(_append_operations, _APPENDED, large.copy))

    values = count(2)

    def replace_source() -> None:
        with large.edit() as edit:
            edit.replace("measured source", Measured("source", float(next(values))))

    yield Contender(REPLACE, time_calls(replace_source))

    yield Contender(COPY, time_calls(lambda: large.copy() and None, len(large.history.tags)))

    ends = range(7, len(large.frames), 8)
    poses = [large.fk(f"link {k}") for k in ends[:_QUERIES]]
    numbers = count()

    def query_poses() -> None:
        for pose in poses:
            large.constraints_for(pose)

    def make_expressions() -> list[Expression]:
        number = float(next(numbers))
        return [pose[0, 3] + number for pose in poses]

    def query_expressions(expressions: list[Expression]) -> None:
        for expression in expressions:
            large.constraints_for(expression)

    yield Contender(RELEVANT, time_calls(query_poses, len(poses)))
    yield Contender(RELEVANT_NEW, time_calls(query_expressions, len(poses), make_expressions))


def _append_operations(model: Model) -> None:
    for k in range(_APPENDED):
        name = f"appended {k}"
        with model.edit() as edit:
            edit.apply(Revolute(name=name, parent=WORLD, child=name, lower=-1.0, upper=1.0))


def count_reruns(large: Model) -> int:
    """Return the number of operations that run when the one that others read is replaced."""
    diffs: list[Diff] = []
    listener = large.listen(diffs.append)
    with large.edit() as edit:
        edit.replace("measured source", Measured("source", -1.0))
    listener.close()
    return diffs[0].reruns


NODES_PER_CONSTRAINT = 9  # number of nodes that one constraint adds to a document


def make_document_model(nodes: int) -> Model:
    model = Model()
    with model.edit() as edit, no_collection():
        for i in range(max(nodes // NODES_PER_CONSTRAINT, 1)):
            a, b = position(f"door{i}/hinge"), position(f"door{i}/handle")
            edit.constrain(f"door{i}/lock", -1.0, np.sin(a) * b + np.cos(b) * (0.1 + i) * a, 1.0)
    return model


def read_document(text: str) -> Model:
    return document.from_bytes(text.encode())


def forget_blobs(model: Model) -> Model:
    """Return a model without the bytes of its operations, so that they are encoded when it is written."""
    for entry in model.history.sequence:
        entry.blob = None
    return model


def make_joints(count: int) -> Model:
    """Return a model of chains of joints with limits."""
    model = Model()
    with no_collection(), model.edit() as edit:
        for k in range(count):
            edit.apply(_chain_joint(k))
    return model


def time_document(nodes: int) -> tuple[int, dict[str, float]]:
    """Return the exact number of nodes of a document, and its times [s] by what is done."""
    model, times = make_document_model(nodes), {}

    def timed(what: str, work: Callable[[], Any]) -> Any:
        start = perf_counter()
        found = work()
        times[what] = perf_counter() - start
        return found

    with no_collection():
        text = timed("written", lambda: document.to_json(model))
        timed("read", lambda: read_document(text))
        data = timed("written as msgpack", lambda: document.to_bytes(forget_blobs(model)))
        timed("read from msgpack", lambda: document.from_bytes(data))
    return text.count('["'), times


INTEGRATOR, INTEGRATE = "kineverse, integrator", "kineverse, model.integrate"
CHECKER, VIOLATIONS = "kineverse, constraint checker", "kineverse, model.violations"
_STEP = 0.02
_CHECKED = 10


def measure_motion(settings: BenchmarkSettings) -> BenchmarkResult:
    name, model = make_kitchen_model()
    count, random = settings.configurations, np.random.default_rng(0)
    q = random.uniform(-1, 1, (count, len(model.symbols)))
    v = random.uniform(-1, 1, (count, len(model.speeds)))
    one = Benchmark("motion", settings)
    one.time(_steps(model, q, v))
    one.time(_checks(model, q, v))
    one.bound(5e-6, INTEGRATOR, CHECKER)
    return one.result(
        f"{name}: {len(model.symbols)} coordinates after {_STEP} s at constant speeds, and "
        f"{len(model.constraints)} constraints; {count} random configurations"
    )


def _steps(model: Model, q: Array, v: Array) -> list[Contender]:
    integrator = model.integrator()
    integrator.wait()
    symbols, columns = integrator.symbols, integrator.speeds
    states = [State(dict(zip(symbols, row, strict=True))) for row in q[:_CHECKED].tolist()]
    speeds = [dict(zip(columns, row, strict=True)) for row in v[:_CHECKED].tolist()]
    vectors = list(zip(q, v, strict=True))

    def run() -> None:
        for start, speed in vectors:
            integrator(start, speed, _STEP)

    def run_plain() -> list[State]:
        return [model.integrate(*pair, _STEP) for pair in zip(states, speeds, strict=True)]

    def ends() -> Sequence[Array]:
        return [integrator(*pair, _STEP) for pair in vectors[:_CHECKED]]

    def plain_ends() -> Sequence[Array]:
        return [np.array([after[s] for s in symbols]) for after in run_plain()]

    return [
        Contender(INTEGRATOR, time_calls(run, len(vectors)), ends),
        Contender(INTEGRATE, time_calls(run_plain, len(states)), plain_ends),
    ]


def _checks(model: Model, q: Array, v: Array) -> list[Contender]:
    symbols = (*model.symbols, *model.speeds)
    checker = model.constraint_checker(symbols)
    checker.wait()
    points = list(np.hstack([q, v]))
    states = [State(dict(zip(symbols, row.tolist(), strict=True))) for row in points[:_CHECKED]]

    def run() -> None:
        for point in points:
            checker(point)

    def run_plain() -> list[Violations]:
        return [model.violations(state) for state in states]

    def excesses(find: Callable[[], list[Violations]]) -> Sequence[Array]:
        return [np.array([violation.excess for violation in found]) for found in find()]

    return [
        Contender(
            CHECKER,
            time_calls(run, len(points)),
            lambda: excesses(lambda: [checker.violations(point) for point in points[:_CHECKED]]),
        ),
        Contender(VIOLATIONS, time_calls(run_plain, len(states)), lambda: excesses(run_plain)),
    ]


WRITTEN, READ = "robot and kitchen, written", "robot and kitchen, read"
PACKED, UNPACKED = f"{WRITTEN} as msgpack", f"{READ} from msgpack"
AGAIN = f"{WRITTEN} again as msgpack"
JOINT_WRITTEN, JOINT_READ = "a joint, written as bytes", "a joint, read from bytes"
OURS, MSGPACK = "robot, written and read", "robot, written and read as msgpack"


def measure_document(settings: BenchmarkSettings) -> BenchmarkResult:
    robot = find_benchmark_robot(settings)
    home = robot.model.copy()
    home.include("kitchen")
    text = document.to_json(home)
    one = Benchmark("document", settings)
    one.time(_home_contenders(robot, home, text))
    size = one.note("robot and kitchen, size", "byte", len(text.encode()))
    one.time([*_robot_contenders(robot), *one.peers("document", ("pinocchio", "mujoco"), robot)])
    sizes = [settings.operations * factor for factor in (1, 10, 100)]
    growth = [time_document(nodes) for nodes in settings.progress(sizes, "document", "size")]
    for nodes, times in growth:
        for what, seconds in times.items():
            one.note(f"{nodes:,} nodes, {what}", "s", seconds)
    one.time(_joint_contenders())
    many = make_joints(settings.operations)
    start = perf_counter()
    data = document.to_bytes(many)
    middle = perf_counter()
    document.from_bytes(data)
    one.note(f"{len(many.history.tags):,} joints, written", "s", middle - start)
    one.note(f"{len(many.history.tags):,} joints, read", "s", perf_counter() - middle)
    one.bound(0.05, WRITTEN, READ)
    one.bound(0.008, PACKED)
    one.bound(0.012, UNPACKED)
    one.bound(4e-5, JOINT_WRITTEN)
    one.bound(6e-5, JOINT_READ)
    one.bound(2e6, size.name)
    one.speed((OURS, MSGPACK), "pinocchio, archive", "mujoco, MJCF", "mujoco, MJB")
    (small, before), (large, after) = growth[0], growth[-1]
    for what, seconds in after.items():
        ratio = seconds / (large / small) / before[what]
        one.compare(f"{what}, a node of {large:,} beside one of {small:,}", ratio, "x", 3)
    return one.result(
        f"{robot.file.name} with the kitchen that ships, {len(home.history.tags)} operations; the robot "
        f"alone; constraints of {', '.join(f'{nodes:,}' for nodes, _ in growth)} nodes"
    )


def _home_contenders(robot: BenchmarkRobot, home: Model, text: str) -> Iterator[Contender]:
    data = document.to_bytes(home)

    def poses(make: Callable[[], Model]) -> Callable[[], list[Array]]:
        values = dict.fromkeys(home.fk(robot.frame).symbols, 0.1)
        return lambda: [make().fk(robot.frame)(values)]

    yield Contender(WRITTEN, time_calls(lambda: document.to_json(forget_blobs(home))), poses(lambda: home))
    yield Contender(READ, time_calls(partial(read_document, text)), poses(lambda: read_document(text)))
    yield Contender(PACKED, time_calls(lambda: document.to_bytes(forget_blobs(home))))
    yield Contender(AGAIN, time_calls(partial(document.to_bytes, home)))
    yield Contender(
        UNPACKED, time_calls(partial(document.from_bytes, data)), poses(lambda: document.from_bytes(data))
    )


def _joint_contenders() -> Iterator[Contender]:
    model = make_joints(1)
    (tag,) = model.history.tags
    blob = document.operation_to_bytes(model, tag)
    # Many at once, as a single one takes less time than it takes to wake the processor.
    for name, work in (
        (JOINT_WRITTEN, lambda: document.operation_to_bytes(forget_blobs(model), tag)),
        (JOINT_READ, lambda: document.operation_from_bytes(blob)),
    ):
        yield Contender(name, time_calls(partial(_repeat, work), _QUERIES))


def _repeat(work: Callable[[], object]) -> None:
    for _ in range(_QUERIES):
        work()


def _robot_contenders(robot: BenchmarkRobot) -> Iterator[Contender]:
    yield Contender(OURS, time_calls(lambda: read_document(document.to_json(forget_blobs(robot.model)))))
    yield Contender(
        MSGPACK, time_calls(lambda: document.from_bytes(document.to_bytes(forget_blobs(robot.model))))
    )


JOINT = "kineverse, joint replaced"
SHIFT = 0.01  # displacement of the joint [m]
_CONFIGURATION_RANGE = 0.3  # value of all coordinates [rad], [m]


def replace_joint(robot: BenchmarkRobot) -> Contender:
    model = robot.model.copy()
    tag, joint = _middle_joint(robot)
    origin = joint.origin
    assert isinstance(origin, Pose)  # as in all robot descriptions
    values = dict.fromkeys(robot.chain, _CONFIGURATION_RANGE)
    shifts = count(1)

    def edited_pose(shift: float) -> Array:
        with model.edit() as edit:
            edit.replace(tag, replace(joint, origin=_shift_origin(origin, shift)))
        return np.asarray(model.fk(robot.frame)(values))

    # Each shift differs from the last, because an edit that changes nothing takes no time.
    return Contender(
        JOINT, time_calls(lambda: edited_pose(SHIFT * next(shifts))), lambda: [edited_pose(SHIFT)]
    )


def _middle_joint(robot: BenchmarkRobot) -> tuple[str, Joint]:
    name = robot.chain[len(robot.chain) // 2].path
    for tag in robot.model.history.tags:
        operation = robot.model.history.entry(tag).operation
        if isinstance(operation, Joint) and operation.name == name:
            return tag, operation
    raise LookupError(name)


def _shift_origin(origin: Pose, shift: float) -> Pose:
    matrix = np.array(origin.matrix)
    matrix[0, 3] += shift
    return Pose.from_matrix(matrix)


def _edited_text(robot: BenchmarkRobot) -> str:
    name = _middle_joint(robot)[1].name
    root = ElementTree.fromstring(strip_shapes(robot.file))
    element = next(e for e in root.iterfind("joint") if e.get("name") == name)
    origin = element.find("origin")
    if origin is None:
        origin = ElementTree.SubElement(element, "origin")
    x, y, z = map(float, origin.get("xyz", "0 0 0").split())
    origin.set("xyz", f"{x + SHIFT!r} {y!r} {z!r}")
    return ElementTree.tostring(root, encoding="unicode")


def measure_edit(settings: BenchmarkSettings) -> BenchmarkResult:
    robot = find_benchmark_robot(settings)
    large = make_large_model(settings.operations)
    one = Benchmark("edit", settings)
    one.time(large_model_contenders(large))
    runs = one.note("operations run by that", "operations", count_reruns(large))
    positions = robot.positions(np.full((1, len(robot.coordinates)), _CONFIGURATION_RANGE))
    with tempfile.TemporaryDirectory(prefix="kineverse-bench-") as folder:
        moved = replace(robot, file=Path(folder, "edited.urdf"))
        moved.file.write_text(_edited_text(robot), encoding="utf-8")
        arguments = robot, moved, _middle_joint(robot)[1].child, positions
        one.time([replace_joint(robot), *one.peers("edit", ("pinocchio", "mujoco"), *arguments)])
    one.speed(TO_LARGE, TO_EMPTY, at_least=0.5)
    one.compare(runs.name, runs.median, runs.unit, 1 + READERS)
    one.bound(50e-6, RELEVANT)
    one.bound(20e-6, COPY)
    one.bound(5e-3, JOINT)
    one.speed(JOINT, "pinocchio, file read again", "mujoco, joint moved, compiled")
    return one.result(
        f"edits of a model of {len(large.history.tags)} operations and {len(large.constraints)} "
        f"constraints; one joint of {robot.file.name} replaced, until the next pose of {robot.frame}"
    )
