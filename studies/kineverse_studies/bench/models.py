"""Benchmarks of models: ``motion``, ``document`` and ``edit``."""

from __future__ import annotations

import itertools
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

from kineverse._gc import no_collection
from kineverse.articulations import Revolute
from kineverse.articulations.joint import Joint
from kineverse.expressions import Expression
from kineverse.formats.document import from_bytes, read_operations, to_bytes, to_json
from kineverse.lie import Array
from kineverse.model import Diff, Model, Operation, Pose, ReadRecorder, Writes
from kineverse.model.frame import WORLD
from kineverse.model.violations import Violations
from kineverse.state import State
from kineverse.symbols import position

from .harness import (
    Bar,
    BenchmarkResult,
    BenchmarkSettings,
    Comparison,
    Contender,
    Contenders,
    Measurement,
    bound_median,
    compare_speed,
    time_calls,
    time_contenders,
)
from .workloads import BenchmarkRobot, find_benchmark_robot, make_kitchen_model, strip_shapes

TO_EMPTY, TO_LARGE = "append an operation to an empty model", "append it to a large model"
REPLACE = "replace an operation that others read"
COPY = "copy a large model, per operation"
RELEVANT, RELEVANT_NEW = "constraints_for a pose", "constraints_for a new expression"
READERS = 7  # number of operations that read the writes of the replaced one
_AXES = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
_APPENDED = 100
_QUERIES = 100


@dataclass(frozen=True)
class Measured(Operation):
    """Operation that writes a number."""

    name: str
    value: float

    def apply(self, model: ReadRecorder) -> Writes:
        return Writes(data={self.name: self.value})


@dataclass(frozen=True)
class Doubled(Operation):
    """Operation that reads a number and writes its double."""

    name: str
    of: str

    def apply(self, model: ReadRecorder) -> Writes:
        """Write twice the number that is read."""
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


@dataclass(frozen=True, slots=True)
class DocumentTimes:
    """Size and times of one document."""

    nodes: int
    written: float  # times [s] to write a model as text, to read it, and of both for msgpack
    read: float
    packed: float
    unpacked: float


def make_document_model(nodes: int) -> Model:
    """Return a model of constraints on two coordinates each, with about ``nodes`` nodes as a document."""
    model = Model()
    with model.edit() as edit, no_collection():
        for i in range(max(nodes // NODES_PER_CONSTRAINT, 1)):
            a, b = position(f"door{i}/hinge"), position(f"door{i}/handle")
            edit.constrain(f"door{i}/lock", -1.0, np.sin(a) * b + np.cos(b) * (0.1 + i) * a, 1.0)
    return model


def read_document(text: str) -> Model:
    """Return the model of a document, with all operations applied."""
    model = Model()
    with model.edit() as edit, no_collection():
        for tag, operation in read_operations(text):
            edit.apply(operation, tag)
    return model


def time_document(nodes: int) -> DocumentTimes:
    """Measure once the times of a document of about ``nodes`` nodes."""
    model = make_document_model(nodes)
    with no_collection():
        times = [perf_counter()]
        text = to_json(model)
        times.append(perf_counter())
        read_document(text)
        times.append(perf_counter())
        data = to_bytes(model)
        times.append(perf_counter())
        from_bytes(data)
        times.append(perf_counter())
    return DocumentTimes(
        text.count("\n[") - 1, *(after - before for before, after in itertools.pairwise(times))
    )


INTEGRATOR, INTEGRATE = "kineverse, integrator", "kineverse, model.integrate"
CHECKER, VIOLATIONS = "kineverse, constraint checker", "kineverse, model.violations"
_STEP = 0.02
_CHECKED = 10


def measure_motion(settings: BenchmarkSettings) -> BenchmarkResult:
    """Measure the compiled objects, from arrays to arrays, and the plain methods, from states to states."""
    name, model = make_kitchen_model()
    count = settings.configurations
    random = np.random.default_rng(0)
    q = random.uniform(-1, 1, (count, len(model.symbols)))
    v = random.uniform(-1, 1, (count, len(model.speeds)))
    measured = time_contenders("motion", _steps(model, q, v), settings.rounds, settings.progress)
    measured |= time_contenders("motion", _checks(model, q, v), settings.rounds, settings.progress)
    return BenchmarkResult(
        name="motion",
        work=(
            f"{name}: {len(model.symbols)} coordinates after {_STEP} s at constant speeds, and "
            f"{len(model.constraints)} constraints; {count} random configurations"
        ),
        measurements=tuple(measured.values()),
        comparisons=(bound_median(measured[INTEGRATOR], 5e-6), bound_median(measured[CHECKER], 5e-6)),
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
OURS, MSGPACK = "robot, written and read", "robot, written and read as msgpack"
PINOCCHIO_ARCHIVE, XML, MJB = "pinocchio, archive", "mujoco, MJCF", "mujoco, MJB"


def measure_document(settings: BenchmarkSettings) -> BenchmarkResult:
    """Measure documents of a robot in a kitchen beside formats of peers, and of large models."""
    robot = find_benchmark_robot(settings)
    home = robot.model.copy()
    home.include("kitchen")
    text = to_json(home)
    measured = time_contenders(
        "document", list(_home_contenders(robot, home, text)), settings.rounds, settings.progress
    )
    size = Measurement("robot and kitchen, size", "byte", (float(len(text.encode())),))
    participants = Contenders(list(_robot_contenders(robot)))
    participants.add_peer("pinocchio", lambda: [_pinocchio(robot)])
    participants.add_peer("mujoco", lambda: list(_mujoco(robot)))
    peers = time_contenders("document", participants.contenders, settings.rounds, settings.progress)
    sizes = [settings.operations * factor for factor in (1, 10, 100)]
    growth = [time_document(nodes) for nodes in settings.progress(sizes, "document", "size")]
    return BenchmarkResult(
        name="document",
        work=(
            f"{robot.file.name} with the kitchen that ships, {len(home.history.tags)} operations; the robot "
            f"alone; constraints of {', '.join(f'{g.nodes:,}' for g in growth)} nodes"
        ),
        measurements=(*measured.values(), size, *peers.values(), *_times(growth)),
        comparisons=(
            bound_median(measured[WRITTEN], 0.05),
            bound_median(measured[READ], 0.05),
            bound_median(size, 2e6),
            *(
                compare_speed(peers, ours, peer)
                for ours in (OURS, MSGPACK)
                for peer in (PINOCCHIO_ARCHIVE, XML, MJB)
            ),
            *_node_time_ratios(growth[0], growth[-1]),
        ),
        missing=tuple(participants.missing),
    )


def _home_contenders(robot: BenchmarkRobot, home: Model, text: str) -> Iterator[Contender]:
    data = to_bytes(home)

    def poses(make: Callable[[], Model]) -> Callable[[], list[Array]]:
        values = dict.fromkeys(home.fk(robot.frame).symbols, 0.1)
        return lambda: [make().fk(robot.frame)(values)]

    yield Contender(WRITTEN, time_calls(partial(to_json, home)), poses(lambda: home))
    yield Contender(READ, time_calls(partial(read_document, text)), poses(lambda: read_document(text)))
    yield Contender(PACKED, time_calls(partial(to_bytes, home)))
    yield Contender(UNPACKED, time_calls(partial(from_bytes, data)), poses(lambda: from_bytes(data)))


def _robot_contenders(robot: BenchmarkRobot) -> Iterator[Contender]:
    yield Contender(OURS, time_calls(lambda: read_document(to_json(robot.model))))
    yield Contender(MSGPACK, time_calls(lambda: from_bytes(to_bytes(robot.model))))


def _pinocchio(robot: BenchmarkRobot) -> Contender:
    import pinocchio

    from .peers.pinocchio import PinocchioRobot

    model = PinocchioRobot(robot).model
    return Contender(
        PINOCCHIO_ARCHIVE, time_calls(lambda: pinocchio.Model().loadFromString(model.saveToString()))
    )


def _mujoco(robot: BenchmarkRobot) -> Iterator[Contender]:
    import mujoco
    import numpy as np

    from .peers.mujoco_kinematics import MujocoRobot, make_robot_mjcf

    model: Any = MujocoRobot(robot).model
    spec: Any = mujoco.MjSpec.from_string(make_robot_mjcf(robot))
    spec.compile()

    def binary() -> None:
        buffer = np.zeros(mujoco.mj_sizeModel(model), np.uint8)
        mujoco.mj_saveModel(model, None, buffer)
        mujoco.MjModel.from_binary_path("robot.mjb", {"robot.mjb": buffer.tobytes()})

    yield Contender(XML, time_calls(lambda: mujoco.MjModel.from_xml_string(spec.to_xml())))
    yield Contender(MJB, time_calls(binary))


def _times(growth: list[DocumentTimes]) -> Iterator[Measurement]:
    for g in growth:
        for what, time in _times_by_label(g).items():
            yield Measurement(f"{g.nodes:,} nodes, {what}", "s", (time,))


def _node_time_ratios(small: DocumentTimes, large: DocumentTimes) -> Iterator[Comparison]:
    ratio = large.nodes / small.nodes
    before = _times_by_label(small)
    for what, time in _times_by_label(large).items():
        name = f"{what}, a node of {large.nodes:,} beside one of {small.nodes:,}"
        yield Comparison(name, time / ratio / before[what], "x", Bar(3, at_least=False))


def _times_by_label(growth: DocumentTimes) -> dict[str, float]:
    return {
        "written": growth.written,
        "read": growth.read,
        "written as msgpack": growth.packed,
        "read from msgpack": growth.unpacked,
    }


JOINT, PINOCCHIO, MUJOCO = (
    "kineverse, joint replaced",
    "pinocchio, file read again",
    "mujoco, joint moved, compiled",
)

_SHIFT = 0.01  # displacement of the joint [m]
_CONFIGURATION_RANGE = 0.3  # value of all coordinates [rad], [m]


def replace_joint(robot: BenchmarkRobot) -> Contender:
    """Return the contender that replaces an operation and evaluates the new pose."""
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
        JOINT, time_calls(lambda: edited_pose(_SHIFT * next(shifts))), lambda: [edited_pose(_SHIFT)]
    )


def _middle_joint(robot: BenchmarkRobot) -> tuple[str, Joint]:
    """Return tag and operation of the middle joint of the chain."""
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


def _sampled_configurations(robot: BenchmarkRobot) -> dict[str, Array]:
    return robot.positions(np.full((1, len(robot.coordinates)), _CONFIGURATION_RANGE))


def reread_file(robot: BenchmarkRobot, folder: Path) -> Contender:
    """Return the contender that reads a file with the joint moved, as pinocchio models are immutable."""
    import pinocchio as pin

    from .peers.pinocchio import PinocchioRobot

    file = folder / "edited.urdf"
    file.write_text(_edited_text(robot), encoding="utf-8")
    edited = replace(robot, file=file)

    def edited_pose() -> Array:
        peer = PinocchioRobot(edited)
        (row,) = peer.rows(_sampled_configurations(robot))
        pin.framesForwardKinematics(peer.model, peer.data, row)
        pose: Array = peer.pose.homogeneous
        return pose

    return Contender(PINOCCHIO, time_calls(edited_pose), lambda: [edited_pose()])


def recompile_specification(robot: BenchmarkRobot) -> Contender:
    """Return the contender that moves a body in MuJoCo's specification and compiles it."""
    import mujoco

    from .peers.mujoco_kinematics import MujocoRobot, make_robot_mjcf

    joint = _middle_joint(robot)[1]
    peer = MujocoRobot(robot)
    (row,) = peer.rows(_sampled_configurations(robot))
    specification = mujoco.MjSpec.from_string(make_robot_mjcf(robot))
    place = specification.body(joint.child).pos
    start = np.array(place)
    shifts = count(1)

    def edited_pose(shift: float) -> Array:
        place[:] = start + np.array([shift, 0.0, 0.0])
        peer.model = specification.compile()
        peer.data = mujoco.MjData(peer.model)
        peer.data.qpos[:] = row
        mujoco.mj_kinematics(peer.model, peer.data)
        return peer.pose(peer.body)

    return Contender(
        MUJOCO, time_calls(lambda: edited_pose(_SHIFT * next(shifts))), lambda: [edited_pose(_SHIFT)]
    )


def _edited_text(robot: BenchmarkRobot) -> str:
    """Return the robot's file with the joint moved, without shapes."""
    name = _middle_joint(robot)[1].name
    root = ElementTree.fromstring(strip_shapes(robot.file))
    element = next(e for e in root.iterfind("joint") if e.get("name") == name)
    origin = element.find("origin")
    if origin is None:
        origin = ElementTree.SubElement(element, "origin")
    x, y, z = map(float, origin.get("xyz", "0 0 0").split())
    origin.set("xyz", f"{x + _SHIFT!r} {y!r} {z!r}")
    return ElementTree.tostring(root, encoding="unicode")


def measure_edit(settings: BenchmarkSettings) -> BenchmarkResult:
    """Measure edits of a large model and of a robot."""
    robot = find_benchmark_robot(settings)
    large = make_large_model(settings.operations)
    measured = time_contenders(
        "edit", list(large_model_contenders(large)), settings.rounds, settings.progress
    )
    runs = Measurement("operations run by that", "operations", (float(count_reruns(large)),))
    with tempfile.TemporaryDirectory(prefix="kineverse-bench-") as folder:
        participants = Contenders([replace_joint(robot)])
        participants.add_peer("pinocchio", lambda: [reread_file(robot, Path(folder))])
        participants.add_peer("mujoco", lambda: [recompile_specification(robot)])
        edited = time_contenders("edit", participants.contenders, settings.rounds, settings.progress)
    ratio = compare_speed(measured, TO_LARGE, TO_EMPTY)
    return BenchmarkResult(
        name="edit",
        work=(
            f"edits of a model of {len(large.history.tags)} operations and {len(large.constraints)} "
            f"constraints; one joint of {robot.file.name} replaced, until the next pose of {robot.frame}"
        ),
        measurements=(*measured.values(), runs, *edited.values()),
        comparisons=(
            replace(ratio, bar=Bar(0.5, at_least=True)),
            Comparison(runs.name, runs.median, runs.unit, Bar(1 + READERS, at_least=False)),
            bound_median(measured[RELEVANT], 50e-6),
            bound_median(measured[COPY], 20e-6),
            bound_median(edited[JOINT], 5e-3),
            compare_speed(edited, JOINT, PINOCCHIO),
            compare_speed(edited, JOINT, MUJOCO),
        ),
        missing=tuple(participants.missing),
    )
