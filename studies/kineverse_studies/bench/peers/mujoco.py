"""Kinematics, documents, edits and searches for near pairs in MuJoCo."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import count
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np

from kineverse.geometry.shapes import Solid
from kineverse.lie import Array, transform
from kineverse.model.body import Capsule, Cylinder, Ellipsoid, Sphere
from kineverse.view.poses import to_wxyz
from kineverse_studies.bench import geometry
from kineverse_studies.bench.harness import Contender, time_calls
from kineverse_studies.bench.kinematics import CHECKED, CHECKED_FRAMES, stack_results
from kineverse_studies.bench.models import SHIFT
from kineverse_studies.bench.workloads import BenchmarkRobot, strip_shapes


class MujocoRobot:
    def __init__(self, robot: BenchmarkRobot) -> None:
        self.model: Any = mujoco.MjModel.from_xml_string(make_robot_mjcf(robot))
        self.data: Any = mujoco.MjData(self.model)
        self.body: int = self.model.body(robot.frame).id
        self.jacobian = np.zeros((6, self.model.nv))
        self.columns: list[int] = [int(self.model.joint(s.path).dofadr[0]) for s in robot.chain]

    def rows(self, positions: dict[str, Array]) -> list[Array]:
        """Return configurations in the order of MuJoCo's joints."""
        columns = [positions[self.model.joint(k).name] for k in range(self.model.njnt)]
        return list(np.ascontiguousarray(np.column_stack(columns)))

    def pose_and_jacobian(self, row: Array) -> tuple[Array, Array]:
        """Return the frame's pose (4, 4) and world-aligned Jacobian (6, n), columns in Kineverse's order."""
        self.data.qpos[:] = row
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_jacBody(self.model, self.data, self.jacobian[:3], self.jacobian[3:], self.body)
        return self.pose(self.body), self.jacobian[:, self.columns]

    def pose(self, body: int) -> Array:
        return transform(self.data.xmat[body].reshape(3, 3), self.data.xpos[body])


def call(robot: BenchmarkRobot, configurations: Array) -> Iterator[Contender]:
    """Yield the contender for a pose, which stays in MuJoCo's data, and a Jacobian."""
    peer = MujocoRobot(robot)
    rows = peer.rows(robot.positions(configurations))

    def run() -> None:
        kinematics, centres, jacobian = mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_jacBody
        model, data, body, position = peer.model, peer.data, peer.body, peer.data.qpos
        linear, angular = peer.jacobian[:3], peer.jacobian[3:]
        for row in rows:
            position[:] = row
            kinematics(model, data)
            centres(model, data)
            jacobian(model, data, linear, angular, body)

    yield Contender(
        "mujoco, all joints",
        time_calls(run, len(rows)),
        lambda: stack_results(map(peer.pose_and_jacobian, rows[:CHECKED])),
    )


def frames(robot: BenchmarkRobot, names: Sequence[str], configurations: Array) -> Iterator[Contender]:
    peer = MujocoRobot(robot)
    model, data = peer.model, peer.data
    rows = peer.rows(robot.positions(configurations))
    # The robot's root is MuJoCo's world.
    numbers = [max(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, frame), 0) for frame in names]

    def run() -> None:
        forward, position = mujoco.mj_kinematics, data.qpos
        for row in rows:
            position[:] = row
            forward(model, data)

    def results() -> Iterator[Array]:
        for row in rows[:CHECKED_FRAMES]:
            data.qpos[:] = row
            mujoco.mj_kinematics(model, data)
            yield np.array([peer.pose(k) for k in numbers])

    yield Contender("mujoco", time_calls(run, len(rows)), lambda: list(results()))


def document(robot: BenchmarkRobot) -> Iterator[Contender]:
    model: Any = MujocoRobot(robot).model
    spec: Any = mujoco.MjSpec.from_string(make_robot_mjcf(robot))
    spec.compile()

    def binary() -> None:
        buffer = np.zeros(mujoco.mj_sizeModel(model), np.uint8)
        mujoco.mj_saveModel(model, None, buffer)
        mujoco.MjModel.from_binary_path("robot.mjb", {"robot.mjb": buffer.tobytes()})

    yield Contender("mujoco, MJCF", time_calls(lambda: mujoco.MjModel.from_xml_string(spec.to_xml())))
    yield Contender("mujoco, MJB", time_calls(binary))


def edit(
    robot: BenchmarkRobot, moved: BenchmarkRobot, body: str, positions: dict[str, Array]
) -> Iterator[Contender]:
    peer = MujocoRobot(robot)
    (row,) = peer.rows(positions)
    specification = mujoco.MjSpec.from_string(make_robot_mjcf(robot))
    place = specification.body(body).pos
    start, shifts = np.array(place), count(1)

    def edited_pose(shift: float) -> Array:
        place[:] = start + np.array([shift, 0.0, 0.0])
        peer.model = specification.compile()
        peer.data = mujoco.MjData(peer.model)
        peer.data.qpos[:] = row
        mujoco.mj_kinematics(peer.model, peer.data)
        return peer.pose(peer.body)

    run = time_calls(lambda: edited_pose(SHIFT * next(shifts)))
    yield Contender("mujoco, joint moved, compiled", run, lambda: [edited_pose(SHIFT)])


def make_robot_mjcf(robot: BenchmarkRobot) -> str:
    """Return the robot's file with options for MuJoCo, so that it neither reads meshes nor merges links."""
    return add_mujoco_options(ElementTree.fromstring(strip_shapes(robot.file)))


def add_mujoco_options(root: ElementTree.Element) -> str:
    options = {"fusestatic": "false", "balanceinertia": "true", "boundmass": "1e-6", "boundinertia": "1e-9"}
    ElementTree.SubElement(ElementTree.SubElement(root, "mujoco"), "compiler", options)
    return ElementTree.tostring(root, encoding="unicode")


class MujocoSearch:
    """Search with MuJoCo's mj_collision and a margin; contacts have distance, middle and normal.

    Boxes are modelled as meshes, because the routine for two boxes misses pairs that are near but not in
    contact. Several contacts for a pair (multiccd) are disabled, because their distances are wrong by
    centimetres.
    """

    def __init__(self, clutter: geometry.Clutter) -> None:
        self._start(_clutter_mjcf(clutter))

    def _start(self, text: str) -> None:
        self.model: Any = mujoco.MjModel.from_xml_string(text)
        self.data: Any = mujoco.MjData(self.model)
        self.names = [self.model.geom(k).name for k in range(self.model.ngeom)]
        self.results: Any = None

    def update(self, angles: Array) -> None:
        self.data.qpos[:] = angles
        mujoco.mj_kinematics(self.model, self.data)

    def query(self) -> object:
        mujoco.mj_collision(self.model, self.data)
        contact = self.data.contact
        self.results = contact.geom, contact.dist, contact.pos, contact.frame
        return self.results

    def distances(self) -> geometry.PairDistances:
        for (a, b), distance in zip(self.results[0].tolist(), self.results[1].tolist(), strict=True):
            yield self.names[a], self.names[b], distance


class MujocoPairSearch(MujocoSearch):
    """Exact search with MuJoCo's mj_geomDistance, after a broadphase of spheres in numpy."""

    def __init__(self, clutter: geometry.Clutter) -> None:
        super().__init__(clutter)
        links = np.array([name.startswith("link") for name in self.names])
        self._links, self._boxes = np.flatnonzero(links), np.flatnonzero(~links)
        self._radii = self.model.geom_rbound.copy()

    def query(self) -> object:
        at, links, boxes = self.data.geom_xpos, self._links, self._boxes
        apart = at[links, None] - at[boxes]
        reach = self._radii[links, None] + self._radii[boxes] + geometry.RADIUS
        near = np.einsum("ijk,ijk->ij", apart, apart) <= reach * reach
        model, data, measure, results = self.model, self.data, mujoco.mj_geomDistance, []
        first, second = np.nonzero(near)
        for i, j in zip(links[first].tolist(), boxes[second].tolist(), strict=True):
            points = np.empty(6)
            distance = measure(model, data, i, j, geometry.RADIUS, points)
            if distance < geometry.RADIUS:
                results.append((i, j, distance, points))
        self.results = results
        return results

    def distances(self) -> geometry.PairDistances:
        return ((self.names[i], self.names[j], distance) for i, j, distance, _ in self.results)


def _clutter_mjcf(clutter: geometry.Clutter) -> str:
    assets, arm, world = [], "", []
    here = format_mjcf_numbers(geometry.CENTRE)
    for link in reversed(range(geometry.LINKS)):
        kind = clutter.kind(link)
        if kind == "capsule":
            radius, length = geometry.CAPSULE_SIZE
            shape = f'type="capsule" size="{radius!r} {length / 2!r}" pos="{here}"'
        else:
            corners = (
                geometry.UNIT_BOX_CORNERS * geometry.BOX_SIZE if kind == "box" else clutter.corners[link]
            )
            assets.append(
                f'<mesh name="link{link}" vertex="{format_mjcf_numbers(corners)}" maxhullvert="-1"/>'
            )
            shape = f'type="mesh" mesh="link{link}" pos="{here}"'
        axis = format_mjcf_numbers(clutter.axis(link))
        arm = (
            f'<body pos="0 0 {geometry.LINK_LENGTH if link else 0.0}"><joint axis="{axis}"/>'
            f'<geom name="link{link}" {shape} margin="{geometry.RADIUS}" contype="1" conaffinity="0"/>'
            f"{arm}</body>"
        )
    for k, (size, pose) in enumerate(zip(clutter.sizes, clutter.poses, strict=True)):
        assets.append(
            f'<mesh name="box{k}" vertex="{format_mjcf_numbers(geometry.UNIT_BOX_CORNERS * size)}"/>'
        )
        axes = f'pos="{format_mjcf_numbers(pose[:3, 3])}" xyaxes="{format_mjcf_numbers(pose[:3, :2].T)}"'
        world.append(f'<geom name="box{k}" type="mesh" mesh="box{k}" {axes} contype="0" conaffinity="1"/>')
    return make_mjcf(assets, [*world, arm])


def make_mjcf(assets: Iterable[str], world: Iterable[str]) -> str:
    return (
        '<mujoco><size memory="64M"/><compiler angle="radian"/>'
        '<option ccd_tolerance="1e-8" ccd_iterations="100"><flag multiccd="disable"/></option>'
        f"<asset>{''.join(assets)}</asset><worldbody>{''.join(world)}</worldbody></mujoco>"
    )


def format_mjcf_numbers(numbers: Any) -> str:
    return " ".join(map(repr, np.asarray(numbers, dtype=float).ravel().tolist()))


class MujocoRobotSearch(MujocoSearch):
    """Search with MuJoCo, each object of the robot a free body; see :class:`.MujocoSearch`."""

    def __init__(self, room: geometry.RobotSurroundings) -> None:
        self._room = room
        assets, world = [], []
        for k, pose in zip(room.others, room.poses(room.others), strict=True):
            asset, geom = _mjcf_geom(k, room.solid(k))
            assets.append(asset)
            at = f'pos="{format_mjcf_numbers(pose[:, 3])}" xyaxes="{format_mjcf_numbers(pose[:, :2].T)}"'
            world.append(f'<geom {geom} {at} contype="0" conaffinity="1"/>')
        for k in room.robot:
            asset, geom = _mjcf_geom(k, room.solid(k))
            assets.append(asset)
            inertia = '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
            mask = f'margin="{geometry.RADIUS}" contype="1" conaffinity="0"'
            world.append(f"<body><freejoint/>{inertia}<geom {geom} {mask}/></body>")
        self._start(make_mjcf(assets, world))
        self.names = [room.names[int(name)] for name in self.names]

    def update(self, angles: Array) -> None:
        poses = self._room.update(angles)
        self.data.qpos.reshape(-1, 7)[:] = np.hstack([poses[:, :, 3], to_wxyz(poses)])
        mujoco.mj_kinematics(self.model, self.data)


def _mjcf_geom(number: int, solid: Solid) -> tuple[str, str]:
    shape, name = solid.surface, f'name="{number}"'
    if isinstance(shape, Sphere):
        return "", f'{name} type="sphere" size="{shape.radius!r}"'
    if isinstance(shape, Ellipsoid):
        return "", f'{name} type="ellipsoid" size="{format_mjcf_numbers(shape.radii)}"'
    if isinstance(shape, Capsule | Cylinder):
        kind = type(shape).__name__.lower()
        return "", f'{name} type="{kind}" size="{shape.radius!r} {shape.length / 2!r}"'
    vertices = format_mjcf_numbers(geometry.solid_corners(solid))
    asset = f'<mesh {name} vertex="{vertices}" inertia="shell" maxhullvert="-1"/>'
    return asset, f'{name} type="mesh" mesh="{number}"'
