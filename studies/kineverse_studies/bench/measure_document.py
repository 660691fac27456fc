"""``document``: writing and reading of models, a PR2 in a kitchen and up to a million nodes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

from kineverse.formats.document import from_bytes, to_bytes, to_json
from kineverse.lie import Array
from kineverse.model.model import Model

from .harness import BenchmarkSettings, Contender, Contenders, time_calls, time_contenders
from .large_models import DocumentTimes, read_document, time_document
from .result import Bar, BenchmarkResult, Comparison, Measurement, bound_median, compare_speed
from .workloads import BenchmarkRobot, find_benchmark_robot

WRITTEN, READ = "robot and kitchen, written", "robot and kitchen, read"
PACKED, UNPACKED = f"{WRITTEN} as msgpack", f"{READ} from msgpack"
OURS, MSGPACK = "robot, written and read", "robot, written and read as msgpack"
PINOCCHIO, XML, MJB = "pinocchio, archive", "mujoco, MJCF", "mujoco, MJB"


def measure(settings: BenchmarkSettings) -> BenchmarkResult:
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
            *(compare_speed(peers, ours, peer) for ours in (OURS, MSGPACK) for peer in (PINOCCHIO, XML, MJB)),
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
    return Contender(PINOCCHIO, time_calls(lambda: pinocchio.Model().loadFromString(model.saveToString())))


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
    """Yield the ratios of the time for a node in the large model to that in the small one."""
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
