"""Benchmark ``geometry``: pairs within a radius with distances, points and normals, along a motion."""

from __future__ import annotations

import itertools
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any, Protocol, TypeAlias

import numpy as np

from kineverse.geometry import Rule, Scene
from kineverse.geometry.bindings import collision_library
from kineverse.geometry.shapes import Solid, import_coal
from kineverse.lie import Array
from kineverse.model.body import Body, Box, Capsule, Geometry, Mesh, Pose, Shape
from kineverse.model.model import Model
from kineverse.spatial import rotation_x, rotation_y, rotation_z, translation
from kineverse.symbols import Symbol, position

from .harness import (
    Benchmark,
    BenchmarkResult,
    BenchmarkSettings,
    Contender,
    check_equal,
    compare_speed,
    has_peer,
)
from .workloads import KitchenRobot, make_kitchen_robot

LINKS, RADIUS = 20, 0.1  # number of links of the arm, and radius of the queries [m]
KINDS = ("hull", "box", "capsule")  # shapes of the links, in cyclic order
LINK_LENGTH = 0.1
CAPSULE_SIZE = 0.03, 0.06  # radius of a capsule, and distance between the centres of its ends [m]
BOX_SIZE = 0.06, 0.07, 0.09  # edges of a link that is a box [m]

# Least distances of the first boxes and of others from the middles of links, so that nothing touches [m].
_CLEARANCE, _FAR = 0.12, 0.6
_BOXES_NEAR_ARM = 60
# Amplitude of each joint, in steps of about a tenth of it [rad].
_STEP_ANGLE = 0.02


@dataclass(frozen=True, eq=False)
class Clutter:
    """Arm of hulls, boxes and capsules that moves in small steps among static boxes."""

    corners: list[Array]  # corners of each link's hull, (24, 3) [m]; used by every third link
    sizes: Array  # edges of the boxes (N, 3) [m], and their poses (N, 4, 4)
    poses: Array
    angles: Array  # joint angles of the steps, (steps, 20) [rad]

    def kind(self, link: int) -> str:
        return KINDS[link % len(KINDS)]

    def axis(self, link: int) -> tuple[int, int, int]:
        """Return the axis of the joint of a link, at the end of the link before."""
        return ((0, 0, 1), (0, 1, 0))[link % 2]

    def model(self, folder: Path) -> Model:
        model = Model()
        with model.edit() as edit:
            parent = "world"
            for link in range(LINKS):
                turn = (rotation_z, rotation_y)[link % 2](position(f"joint{link:02}"))
                there = translation(0, 0, LINK_LENGTH if link else 0.0) @ turn
                edit.add_frame(f"link{link}", parent, there, _make_body(self._geometry(link, folder)))
                parent = f"link{link}"
            for k, (size, pose) in enumerate(zip(self.sizes.tolist(), self.poses, strict=True)):
                edit.add_frame(f"box{k}", "world", pose, Body(collisions=(Shape(Box(tuple(size))),)))
        return model

    def _geometry(self, link: int, folder: Path) -> Geometry:
        kind = self.kind(link)
        if kind == "box":
            return Box(BOX_SIZE)
        if kind == "capsule":
            return Capsule(*CAPSULE_SIZE)
        corners = self.corners[link]
        lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in corners.tolist()]
        lines += [f"f {k} {k + 1} {k + 2}" for k in range(1, len(corners) - 1)]
        (folder / f"link{link}.obj").write_text("\n".join(lines), encoding="utf-8")
        return Mesh(f"link{link}.obj", folder=str(folder))


RULES = (Rule("link*", "link*", why="only boxes are of interest here"),)
CENTRE = 0.0, 0.0, LINK_LENGTH / 2  # position of the centre of a link's shape in its frame [m]


def make_clutter(boxes: int = _BOXES_NEAR_ARM, steps: int = 200, seed: int = 0) -> Clutter:
    """Return an arm among boxes; the first 60 stand along it, others further away with a fixed density."""
    rng = np.random.default_rng(seed)
    corners = [_round_to_float32(rng.normal(size=(24, 3)) * (0.02, 0.02, 0.028)) for _ in range(LINKS)]
    home = rng.uniform(-0.35, 0.35, LINKS)
    phases = rng.uniform(0, 2 * np.pi, LINKS) + np.outer(np.arange(steps), rng.uniform(0.05, 0.15, LINKS))
    angles = home + _STEP_ANGLE * np.sin(phases)
    arm, random = _link_centres(home), np.random.default_rng(seed + 1)
    span = 1.0 + 0.2 * boxes ** (1 / 3)
    sizes, poses = np.empty((boxes, 3)), np.empty((boxes, 4, 4))
    for k in range(boxes):
        clear = _CLEARANCE if k < _BOXES_NEAR_ARM else _FAR
        while True:
            size, (yaw, roll) = (
                _round_to_float32(random.uniform(0.05, 0.2, 3)),
                random.uniform(-3, 3, 2).tolist(),
            )
            pose = (rotation_z(yaw) @ rotation_x(roll))()
            if k < _BOXES_NEAR_ARM:
                offset = random.normal(size=3)
                offset *= random.uniform(0.15, 0.28) / np.linalg.norm(offset)
                pose[:3, 3] = arm[random.integers(LINKS)] + offset
            else:
                pose[:3, 3] = arm.mean(axis=0) + random.uniform(-span, span, 3)
            if _clearance(arm, size, pose) > clear:
                break
        sizes[k], poses[k] = size, pose
    return Clutter(corners, sizes, poses, angles)


def _link_centres(angles: Array) -> Array:
    """Return the centres of the links at joint angles, (20, 3)."""
    pose, centres = np.eye(4), []
    for link, angle in enumerate(angles.tolist()):
        turn = (rotation_z, rotation_y)[link % 2](angle)
        pose = pose @ translation(0, 0, LINK_LENGTH if link else 0.0)() @ turn()
        centres.append(pose[:3] @ (*CENTRE, 1.0))
    return np.array(centres)


def _clearance(points: Array, size: Array, pose: Array) -> float:
    inside = (points - pose[:3, 3]) @ pose[:3, :3]
    return float(np.linalg.norm(np.maximum(np.abs(inside) - size / 2, 0.0), axis=1).min())


def _round_to_float32(numbers: Array) -> Array:
    return numbers.astype(np.float32).astype(np.float64)


def _make_body(geometry: Geometry) -> Body:
    return Body(collisions=(Shape(geometry, Pose.from_matrix(translation(*CENTRE)())),))


PairDistances: TypeAlias = Iterator[tuple[str, str, float]]


class ProximitySearch(Protocol):
    """Search for pairs of bodies within :data:`RADIUS`, with points and normals."""

    def update(self, angles: Array) -> None:
        """Set the state of the moving bodies."""

    def query(self) -> object:
        """Search for pairs within the radius."""

    def distances(self) -> PairDistances:
        """Return the pairs of the last search, with distances [m]; of a pair the least one counts."""


class KineverseSearch:
    """Search with Kineverse: all checked pairs, or those whose distance depends on some symbols."""

    def __init__(self, scene: Scene, radius: float = RADIUS, moving: Sequence[Symbol] | None = None) -> None:
        self.scene = scene
        self._query = scene.watch(radius=radius, moving=moving)
        self.results: Any = ()

    def update(self, angles: Array) -> None:
        self.scene.update(angles)

    def query(self) -> object:
        self.results = self._query()
        return self.results

    def distances(self) -> PairDistances:
        return ((near.a, near.b, near.distance) for near in self.results)


class CoalSearch:
    """Search with coal: broadphase in numpy, then a functor for each pair; poses are written in place."""

    def __init__(self, scene: Scene, radius: float = RADIUS) -> None:
        coal = import_coal()
        self._radius = radius
        self._scene, world = scene, scene.collision_world
        scene.update(np.zeros(len(scene.inputs)))
        world.prepare()
        self._table = table = world.table
        self._checked = np.triu(table.allowed[table.body[: table.moving, None], table.body] == 1)
        self._reach = (table.radius[: table.moving, None] + table.radius + radius) ** 2
        self._solids = [world.solid(k) for k in range(table.count)]
        self._names = [piece.body for piece in world.objects]
        self._transforms = [coal.Transform3s(pose[:, :3], pose[:, 3]) for pose in table.poses]
        self._make, self._functors = coal.ComputeDistance, dict[tuple[int, int], Any]()
        self._request, self._result = coal.DistanceRequest(), coal.DistanceResult()
        self.results: list[tuple[int, int, float, Array, Array, Array]] = []

    def update(self, angles: Array) -> None:
        self._scene.update(angles)
        for transform, pose in zip(self._transforms, self._table.poses[: self._table.moving], strict=False):
            transform.setTransform(pose[:, :3], pose[:, 3])

    def query(self) -> object:
        transforms, request, result = self._transforms, self._request, self._result
        functors, results = self._functors, []
        for i, j in self._broadphase():
            functor = functors.get((i, j))
            if functor is None:
                functor = functors[i, j] = self._make(self._solids[i].engine, self._solids[j].engine)
            result.clear()
            distance = functor(transforms[i], transforms[j], request, result)
            if distance <= self._radius:
                points = result.getNearestPoint1(), result.getNearestPoint2()
                results.append((i, j, distance, *points, np.array(result.normal)))
        self.results = results
        return results

    def distances(self) -> PairDistances:
        return ((self._names[i], self._names[j], distance) for i, j, distance, *_ in self.results)

    def _broadphase(self) -> Iterable[tuple[int, int]]:
        table = self._table
        moving = slice(0, table.moving)
        here = table.low[moving, None] - table.high
        apart = np.maximum(np.maximum(here, table.low - table.high[moving, None]), 0.0)
        gaps = np.einsum("ijk,ijk->ij", apart, apart)
        between = table.position[moving, None] - table.position
        centres = np.einsum("ijk,ijk->ij", between, between)
        near = (gaps <= self._radius**2) & (centres <= self._reach) & self._checked
        first, second = np.nonzero(near)
        return zip(first.tolist(), second.tolist(), strict=True)


UNIT_BOX_CORNERS = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))  # of a box with edges of 1 m


class RobotSurroundings:
    """Collision objects of a scene, divided into those of a robot and the static ones of a room."""

    def __init__(self, scene: Scene, values: Array, robot: str) -> None:
        self._scene, self._world = scene, scene.collision_world
        scene.update(values)
        self._world.prepare()
        self.names = [piece.body for piece in self._world.objects]
        self.robot = [k for k, name in enumerate(self.names) if name.startswith(robot)]
        self.others = [k for k, name in enumerate(self.names) if not name.startswith(robot)]

    def update(self, values: Array) -> Array:
        """Move the robot, and return the poses of its objects, (N, 3, 4)."""
        self._scene.update(values)
        return self.poses(self.robot)

    def poses(self, objects: list[int]) -> Array:
        """Return the poses of objects, (N, 3, 4)."""
        return self._world.table.poses[objects]

    def solid(self, index: int) -> Solid:
        return self._world.solid(index)


def solid_corners(solid: Solid) -> Array:
    if isinstance(solid.surface, Box):
        return UNIT_BOX_CORNERS * solid.surface.size
    assert solid.core is not None
    return np.unique(solid.core.corners.T, axis=0)


OURS, COAL = "kineverse", "coal and numpy"
SEARCH, PAIRS, BULLET = "mujoco, mj_collision", "mujoco, mj_geomDistance and numpy", "bullet"
UPDATE, QUERY = "update", "query"
_EXACT, _CURVED, _MARGINS = 1e-6, 1e-4, 3e-3
"""Tolerances of distances [m]: polytopes and capsules; all shapes of a robot; Bullet, which adds margins."""
_NEAR, _WHOLE = 0.06, " without rules, within .06 m"
"""Radius [m] of the query without rules, whose results are mostly pairs of the robot's own links."""
_WATCHED = " without rules, within .05 m, what the arm's speeds move"
_WATCH_RADIUS = 0.05  # radius [m] of the query of a controller, about the pairs that it can move
_CHECKED = 20


@dataclass(frozen=True)
class SearchEntry:
    name: str
    search: ProximitySearch
    accuracy: float


def measure_geometry(settings: BenchmarkSettings) -> BenchmarkResult:
    collision_library.prepare(wait=True)
    steps = min(settings.configurations, settings.steps)
    sizes = [settings.boxes // part for part in (30, 10, 3, 1)]
    one = Benchmark("geometry", settings)
    with tempfile.TemporaryDirectory(prefix="kineverse-bench-") as text:
        folder = Path(text)
        arm = list(_among_boxes(one, folder, steps))
        robot = make_kitchen_robot(steps)
        name, rooms = robot.name, list(_around_robot(robot))
        angles = make_clutter(steps=steps).angles
        check_distances(arm, angles)
        check_distances(rooms, robot.values)
        many = [
            SearchEntry(f"{OURS} among {boxes} boxes", KineverseSearch(_scene(folder, boxes, steps)), _EXACT)
            for boxes in sizes
        ]
        watch = KineverseSearch(robot.whole_scene(), _WATCH_RADIUS, robot.model.speeds_of(robot.gripper))
        everything = [
            SearchEntry(f"{name}: {OURS}{_WHOLE}", KineverseSearch(robot.whole_scene(), _NEAR), _CURVED),
            SearchEntry(f"{name}: {COAL}{_WHOLE}", CoalSearch(robot.whole_scene(), _NEAR), _CURVED),
            SearchEntry(f"{name}: {OURS}{_WATCHED}", watch, _CURVED),
        ]
        moved = ((arm, angles), (many, angles), (rooms, robot.values), (everything, robot.values))
        one.time(contender for entries, rows in moved for contender in _timed(entries, rows))
    peers = (SEARCH, PAIRS, BULLET, COAL)
    room = {search: f"{name}: {search}, {QUERY}" for search in (OURS, SEARCH, BULLET, COAL)}
    whole = f"{name}: {OURS}{_WHOLE}, {QUERY}"
    one.bound(40e-6, f"{OURS}, {QUERY}")
    one.speed(f"{OURS}, {QUERY}", *(f"{peer}, {QUERY}" for peer in peers), at_least=1.0)
    one.speed(f"{OURS}, {UPDATE}", *(f"{peer}, {UPDATE}" for peer in peers))
    one.speed(room[OURS], room[SEARCH])
    one.speed(room[OURS], room[BULLET], room[COAL], at_least=1.0)
    one.bound(150e-6, whole)
    one.bound(130e-6, f"{name}: {OURS}{_WATCHED}, {QUERY}")
    one.speed(whole, room[OURS])
    one.speed(whole, f"{name}: {COAL}{_WHOLE}, {QUERY}", at_least=1.0)
    few, most = (f"{OURS} among {boxes} boxes, {QUERY}" for boxes in (sizes[0], sizes[-1]))
    one.compare(
        f"{most}, over {sizes[0]}, as many near", compare_speed(one.measured, few, most).value, "x", 2.0
    )
    return one.result(
        f"an arm of {LINKS} hulls, boxes and capsules among 60 boxes: all pairs within {RADIUS} m with "
        f"distance, points and normal, {steps} steps of about 0.002 rad a joint; a query is what comes "
        "after the update of the poses"
    )


def check_distances(entries: Sequence[SearchEntry], rows: Array) -> None:
    """Compare the results of all searches at some states with those of the first.

    If a search misses a pair of another, its distance counts as the radius, so that only pairs near the
    radius may be missing. Penetration depths are not compared; they count as contact.
    """
    for row in rows[:: max(len(rows) // _CHECKED, 1)]:
        found = [_distances(entry.search, row) for entry in entries]
        pairs = sorted({pair for each in found for pair in each})
        table = [np.array([each.get(pair, RADIUS) for pair in pairs]) for each in found]
        for entry, distances in zip(entries[1:], table[1:], strict=True):
            names = [(entries[0].name, [table[0]]), (entry.name, [distances])]
            check_equal("geometry", names, entry.accuracy)


def _distances(search: ProximitySearch, row: Array) -> dict[tuple[str, str], float]:
    search.update(row)
    search.query()
    least: dict[tuple[str, str], float] = {}
    for a, b, distance in search.distances():
        pair = min(a, b), max(a, b)
        least[pair] = min(least.get(pair, RADIUS), max(distance, 0.0))
    return least


def _among_boxes(one: Benchmark, folder: Path, steps: int) -> Iterator[SearchEntry]:
    arm = make_clutter(steps=steps)
    yield SearchEntry(OURS, KineverseSearch(_scene(folder, 60, steps)), _EXACT)
    yield SearchEntry(COAL, CoalSearch(_scene(folder, 60, steps)), _EXACT)
    if one.has("mujoco"):
        from .peers.mujoco import MujocoPairSearch, MujocoSearch

        yield SearchEntry(SEARCH, MujocoSearch(arm), _EXACT)
        yield SearchEntry(PAIRS, MujocoPairSearch(arm), _EXACT)
    if one.has("pybullet"):
        from .peers.bullet import BulletSearch

        yield SearchEntry(BULLET, BulletSearch(arm), _MARGINS)


def _around_robot(robot: KitchenRobot) -> Iterator[SearchEntry]:
    yield SearchEntry(f"{robot.name}: {OURS}", KineverseSearch(robot.scene()), _CURVED)
    yield SearchEntry(f"{robot.name}: {COAL}", CoalSearch(robot.scene()), _CURVED)
    if has_peer("mujoco"):
        from .peers.mujoco import MujocoRobotSearch

        room = RobotSurroundings(robot.scene(), robot.values[0], "robot/")
        yield SearchEntry(f"{robot.name}: {SEARCH}", MujocoRobotSearch(room), _CURVED)
    if has_peer("pybullet"):
        from .peers.bullet import BulletRobotSearch

        room = RobotSurroundings(robot.scene(), robot.values[0], "robot/")
        yield SearchEntry(f"{robot.name}: {BULLET}", BulletRobotSearch(room), _MARGINS)


def _scene(folder: Path, boxes: int, steps: int) -> Scene:
    return Scene(make_clutter(boxes, steps).model(folder), rules=RULES)


def _timed(entries: Iterable[SearchEntry], rows: Array) -> Iterator[Contender]:
    for entry in entries:
        yield Contender(f"{entry.name}, {UPDATE}", _sample(entry.search, rows, queries=False))
        yield Contender(f"{entry.name}, {QUERY}", _sample(entry.search, rows, queries=True))


def _sample(search: ProximitySearch, rows: Array, queries: bool) -> Callable[[], float]:
    states = list(rows)

    def sample() -> float:
        update, query = search.update, search.query
        update_time = query_time = 0.0
        for state in states:
            start = perf_counter()
            update(state)
            updated = perf_counter()
            query()
            query_time += perf_counter() - updated
            update_time += updated - start
        return (query_time if queries else update_time) / len(states)

    return sample
