"""``document``: models written down and read again, a PR2 in a kitchen and up to a million nodes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

from kineverse.formats.document import document_of, from_bytes, to_bytes
from kineverse.model.model import Model

from .agreement import Array
from .large_document import Growth, grown, read
from .peers import Field
from .result import Bar, Comparison, Measurement, Result, at_most, faster
from .robot import Robot, find_robot
from .settings import Settings
from .timing import Contender, race, timed

WRITTEN, READ = "robot and kitchen, written", "robot and kitchen, read"
PACKED, UNPACKED = f"{WRITTEN} as msgpack", f"{READ} from msgpack"
OURS, MSGPACK = "robot, written and read", "robot, written and read as msgpack"
PINOCCHIO, XML, MJB = "pinocchio, archive", "mujoco, MJCF", "mujoco, MJB"


def measure(settings: Settings) -> Result:
    """Measure documents of a robot in a kitchen, beside what peers keep robots in, and how they grow."""
    robot = find_robot(settings)
    home = robot.model.copy()
    home.include("kitchen")
    text = document_of(home)
    measured = race("document", list(_of_home(robot, home, text)), settings.rounds, settings.progress)
    size = Measurement("robot and kitchen, size", "byte", (float(len(text.encode())),))
    field = Field(list(_of_robot(robot)))
    field.admit("pinocchio", lambda: [_pinocchio(robot)])
    field.admit("mujoco", lambda: list(_mujoco(robot)))
    peers = race("document", field.contenders, settings.rounds, settings.progress)
    sizes = [settings.operations * factor for factor in (1, 10, 100)]
    growth = [grown(nodes) for nodes in settings.progress(sizes, "document", "size")]
    return Result(
        name="document",
        work=(
            f"{robot.file.name} with the kitchen that ships, {len(home.history.tags)} operations; the robot "
            f"alone; constraints of {', '.join(f'{g.nodes:,}' for g in growth)} nodes"
        ),
        measurements=(*measured.values(), size, *peers.values(), *_times(growth)),
        comparisons=(
            at_most(measured[WRITTEN], 0.05),
            at_most(measured[READ], 0.05),
            at_most(size, 2e6),
            *(faster(peers, ours, peer) for ours in (OURS, MSGPACK) for peer in (PINOCCHIO, XML, MJB)),
            *_linear(growth[0], growth[-1]),
        ),
        missing=tuple(field.missing),
    )


def _of_home(robot: Robot, home: Model, text: str) -> Iterator[Contender]:
    data = to_bytes(home)

    def poses(made: Callable[[], Model]) -> Callable[[], list[Array]]:
        values = dict.fromkeys(home.fk(robot.frame).symbols, 0.1)
        return lambda: [made().fk(robot.frame)(values)]

    yield Contender(WRITTEN, timed(partial(document_of, home)), poses(lambda: home))
    yield Contender(READ, timed(partial(read, text)), poses(lambda: read(text)))
    yield Contender(PACKED, timed(partial(to_bytes, home)))
    yield Contender(UNPACKED, timed(partial(from_bytes, data)), poses(lambda: from_bytes(data)))


def _of_robot(robot: Robot) -> Iterator[Contender]:
    yield Contender(OURS, timed(lambda: read(document_of(robot.model))))
    yield Contender(MSGPACK, timed(lambda: from_bytes(to_bytes(robot.model))))


def _pinocchio(robot: Robot) -> Contender:
    import pinocchio

    from .pinocchio_robot import PinocchioRobot

    model = PinocchioRobot(robot).model
    return Contender(PINOCCHIO, timed(lambda: pinocchio.Model().loadFromString(model.saveToString())))


def _mujoco(robot: Robot) -> Iterator[Contender]:
    import mujoco
    import numpy as np

    from .mujoco_robot import MujocoRobot, mujoco_text

    model: Any = MujocoRobot(robot).model
    spec: Any = mujoco.MjSpec.from_string(mujoco_text(robot))
    spec.compile()

    def binary() -> None:
        buffer = np.zeros(mujoco.mj_sizeModel(model), np.uint8)
        mujoco.mj_saveModel(model, None, buffer)
        mujoco.MjModel.from_binary_path("robot.mjb", {"robot.mjb": buffer.tobytes()})

    yield Contender(XML, timed(lambda: mujoco.MjModel.from_xml_string(spec.to_xml())))
    yield Contender(MJB, timed(binary))


def _times(growth: list[Growth]) -> Iterator[Measurement]:
    for g in growth:
        for what, time in _ways(g).items():
            yield Measurement(f"{g.nodes:,} nodes, {what}", "s", (time,))


def _linear(small: Growth, large: Growth) -> Iterator[Comparison]:
    """Yield how many times as long a node takes in the large model as in the small one."""
    ratio = large.nodes / small.nodes
    before = _ways(small)
    for what, time in _ways(large).items():
        name = f"{what}, a node of {large.nodes:,} beside one of {small.nodes:,}"
        yield Comparison(name, time / ratio / before[what], "x", Bar(3, at_least=False))


def _ways(growth: Growth) -> dict[str, float]:
    return {
        "written": growth.written,
        "read": growth.read,
        "written as msgpack": growth.packed,
        "read from msgpack": growth.unpacked,
    }
