"""Pairs within a distance of an arm among boxes: Kineverse, coal, MuJoCo."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Protocol, TypeAlias

import numpy as np

from kineverse.geometry import Scene
from kineverse.geometry.shapes import import_coal
from kineverse.lie import Array
from kineverse.symbols import Symbol
from kineverse_studies.bench.geometry import (
    BOX_SIZE,
    CAPSULE_SIZE,
    CENTRE,
    LINK_LENGTH,
    LINKS,
    RADIUS,
    Clutter,
)

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
        """Set the state of the moving bodies."""
        self.scene.update(angles)

    def query(self) -> object:
        """Search for pairs within the radius."""
        self.results = self._query()
        return self.results

    def distances(self) -> PairDistances:
        """Return the pairs of the last search, with distances [m]."""
        return ((near.a, near.b, near.distance) for near in self.results)


class CoalSearch:
    """Search with coal: broadphase of boxes and spheres in numpy, then a functor for each pair.

    Poses are written in place by Kineverse's compiled function.
    """

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
        """Set the state of the moving bodies."""
        self._scene.update(angles)
        for transform, pose in zip(self._transforms, self._table.poses[: self._table.moving], strict=False):
            transform.setTransform(pose[:, :3], pose[:, 3])

    def query(self) -> object:
        """Search for pairs within the radius."""
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
        """Return the pairs of the last search, with distances [m]."""
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


class MujocoSearch:
    """Search with MuJoCo's mj_collision and a margin; contacts have distance, middle and normal.

    Boxes are modelled as meshes, because the routine for two boxes misses pairs that are near but not in
    contact. Several contacts for a pair (multiccd) are disabled, because their distances are wrong by
    centimetres.
    """

    def __init__(self, clutter: Clutter) -> None:
        self._start(_clutter_mjcf(clutter))

    def _start(self, text: str) -> None:
        import mujoco

        self._mujoco: Any = mujoco
        self.model: Any = mujoco.MjModel.from_xml_string(text)
        self.data: Any = mujoco.MjData(self.model)
        self.names = [self.model.geom(k).name for k in range(self.model.ngeom)]
        self.results: Any = None

    def update(self, angles: Array) -> None:
        """Set the state of the moving bodies."""
        self.data.qpos[:] = angles
        self._mujoco.mj_kinematics(self.model, self.data)

    def query(self) -> object:
        """Search for pairs within the radius."""
        self._mujoco.mj_collision(self.model, self.data)
        contact = self.data.contact
        self.results = contact.geom, contact.dist, contact.pos, contact.frame
        return self.results

    def distances(self) -> PairDistances:
        """Return the pairs of the last search, with distances [m]."""
        for (a, b), distance in zip(self.results[0].tolist(), self.results[1].tolist(), strict=True):
            yield self.names[a], self.names[b], distance


class MujocoPairSearch(MujocoSearch):
    """Exact search with MuJoCo's mj_geomDistance, after a broadphase of spheres in numpy."""

    def __init__(self, clutter: Clutter) -> None:
        super().__init__(clutter)
        links = np.array([name.startswith("link") for name in self.names])
        self._links, self._boxes = np.flatnonzero(links), np.flatnonzero(~links)
        self._radii = self.model.geom_rbound.copy()

    def query(self) -> object:
        """Search for pairs within the radius."""
        at, links, boxes = self.data.geom_xpos, self._links, self._boxes
        apart = at[links, None] - at[boxes]
        reach = self._radii[links, None] + self._radii[boxes] + RADIUS
        near = np.einsum("ijk,ijk->ij", apart, apart) <= reach * reach
        model, data, measure, results = self.model, self.data, self._mujoco.mj_geomDistance, []
        first, second = np.nonzero(near)
        for i, j in zip(links[first].tolist(), boxes[second].tolist(), strict=True):
            points = np.empty(6)
            distance = measure(model, data, i, j, RADIUS, points)
            if distance < RADIUS:
                results.append((i, j, distance, points))
        self.results = results
        return results

    def distances(self) -> PairDistances:
        """Return the pairs of the last search, with distances [m]."""
        return ((self.names[i], self.names[j], distance) for i, j, distance, _ in self.results)


def _clutter_mjcf(clutter: Clutter) -> str:
    """Return the MJCF of the arm as nested bodies, and of the boxes as geoms of the world."""
    assets, arm, world = [], "", []
    here = format_mjcf_numbers(CENTRE)
    for link in reversed(range(LINKS)):
        kind = clutter.kind(link)
        if kind == "capsule":
            radius, length = CAPSULE_SIZE
            shape = f'type="capsule" size="{radius!r} {length / 2!r}" pos="{here}"'
        else:
            corners = UNIT_BOX_CORNERS * BOX_SIZE if kind == "box" else clutter.corners[link]
            assets.append(
                f'<mesh name="link{link}" vertex="{format_mjcf_numbers(corners)}" maxhullvert="-1"/>'
            )
            shape = f'type="mesh" mesh="link{link}" pos="{here}"'
        axis = format_mjcf_numbers(clutter.axis(link))
        arm = (
            f'<body pos="0 0 {LINK_LENGTH if link else 0.0}"><joint axis="{axis}"/>'
            f'<geom name="link{link}" {shape} margin="{RADIUS}" contype="1" conaffinity="0"/>{arm}</body>'
        )
    for k, (size, pose) in enumerate(zip(clutter.sizes, clutter.poses, strict=True)):
        assets.append(f'<mesh name="box{k}" vertex="{format_mjcf_numbers(UNIT_BOX_CORNERS * size)}"/>')
        axes = f'pos="{format_mjcf_numbers(pose[:3, 3])}" xyaxes="{format_mjcf_numbers(pose[:3, :2].T)}"'
        world.append(f'<geom name="box{k}" type="mesh" mesh="box{k}" {axes} contype="0" conaffinity="1"/>')
    return make_mjcf(assets, [*world, arm])


def make_mjcf(assets: Iterable[str], world: Iterable[str]) -> str:
    """Return the MJCF of assets and bodies of the world, with tight tolerances of distances."""
    return (
        '<mujoco><size memory="64M"/><compiler angle="radian"/>'
        '<option ccd_tolerance="1e-8" ccd_iterations="100"><flag multiccd="disable"/></option>'
        f"<asset>{''.join(assets)}</asset><worldbody>{''.join(world)}</worldbody></mujoco>"
    )


UNIT_BOX_CORNERS = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
"""Corners of a box with edges of 1 m, (8, 3)."""


def format_mjcf_numbers(numbers: Any) -> str:
    return " ".join(map(repr, np.asarray(numbers, dtype=float).ravel().tolist()))
