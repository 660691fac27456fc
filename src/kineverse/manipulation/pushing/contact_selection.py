"""Contact selection of a push: places on an object whose normals oppose its motion, ranked, and given up.

A coordinate q that is to move in direction σ moves the point p of the object at ``σ ∂p/∂q``. Pushing at p,
with outward normal n, is possible without sliding while the angle between -n and that velocity is within the
friction cone, ``-n·σ∂p/∂q >= cos(α) |∂p/∂q|``.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from kineverse.compilation import compile
from kineverse.control import Target
from kineverse.errors import InvalidValueError
from kineverse.expressions.expression import Expression, array, as_expression
from kineverse.geometry import Scene
from kineverse.geometry.gjk import smoothed_support
from kineverse.geometry.shapes import Solid
from kineverse.grasping.finger_branches import path_to_root
from kineverse.lie import Array
from kineverse.model.model_view import ModelView
from kineverse.state import State
from kineverse.symbols import Symbol

from .vectors import Vector, inner_product, length

_SPACING = 0.05  # distance of sampled points [m]
_INSET = 0.04  # distance of sampled points from edges, where the surface is that large [m]
_MOST = 7
_ROOM = 0.06  # free space in front of a point that a hand needs [m]
_OUTSIDE = 0.1
_SAME = 0.01
_FRONT = 0.004  # depth of the foremost part of a pusher [m]
CONE, CONE_END = math.cos(math.radians(25.0)), math.cos(math.radians(40.0))  # to choose, and to keep
_DISTANCE_COST, _GIVEN_UP_COST = 0.5, 0.6
"""Cost of a contact point by its distance from the tip [1/m], and by the times that it was given up."""
_SURROUNDINGS = 0.1  # distance within which other points count as given up, too [m]
_OUT_OF_REACH = 0.02
"""Distance of the tip from a point that is given up from which on points beyond are out of reach, too [m]."""
_BLOCKED_STEPS = 60
_BLOCKED_WAY = 0.004
_MOST_JAMMED = 3  # number of contact points at which the object does not move before it counts as jammed


@dataclass(frozen=True, slots=True, eq=False)
class PushContacts:
    """Contact points at one state, in the world."""

    points: Array  # (N, 3) points [m] and outward unit normals
    normals: Array
    velocities: Array  # (N, 3)
    alignment: Array  # (N,) cosine between -n and the velocity; -1 for a point that does not move
    leverage: Array  # (N,) speed of the points relative to the fastest, in [0, 1]


class PushPoint(NamedTuple):
    """One contact point at one state; see :class:`PushContacts`."""

    point: Vector
    normal: Vector
    velocity: Vector
    alignment: float


class PushSurface:
    """Sampled surface of an object that a coordinate moves, as far as a push can reach it.

    Rays that run with the object's motion find the points, so what is behind something else is left out.
    """

    def __init__(
        self,
        model: ModelView,
        coordinate: Symbol,
        bodies: Sequence[str],
        robot_bodies: Iterable[str],
        state: State,
        values: Sequence[float] | Array,
        tip: Expression,
    ) -> None:
        self.bodies = tuple(bodies)
        self._coordinate = coordinate
        speed = coordinate.derivative()
        poses = [model.fk(body)[:3, :] for body in bodies]
        twists = [model.jacobian(body, form="world", symbols=[speed]).ravel() for body in bodies]
        stacked = [array([e for pose in poses for e in pose.ravel()]), array([e for t in twists for e in t])]
        self._function = compile(stacked)
        self._evaluate = self._function.bind()
        self.sign = 1.0 if values[-1] >= values[0] else -1.0
        scene = Scene(model, leave_out=tuple(robot_bodies))
        states = [state.updated({coordinate: value}) for value in values]
        result = [point for at in states for point in self._sample(scene, at)]
        if not result:
            raise InvalidValueError(
                f"No surface of {', '.join(bodies)} opposes the motion of '{coordinate}' towards "
                f"{values[-1]:g}, so it cannot be pushed there."
            )
        result = _without_doubles(result)
        self.owner = np.array([k for k, *_ in result], dtype=np.intp)
        self._points = np.array([p for _, p, _ in result])
        self._normals = np.array([n for _, _, n in result])
        self._compile_one(poses, twists, tip)
        self.room = np.min([self._find_room(scene, at) for at in states], axis=0)

    def __len__(self) -> int:
        return len(self.owner)

    def _place(self, state: State) -> tuple[Array, Array]:
        """Return poses (B, 3, 4) and twists (B, 6) of the bodies at a state, per unit of the coordinate."""
        self._evaluate.input[:] = state.vector(self._function.inputs)
        self._evaluate()
        poses, twists = self._evaluate.outputs
        return poses.reshape(-1, 3, 4), twists.reshape(-1, 6)

    def at(self, state: State) -> PushContacts:
        """Return all points at a state."""
        poses, twists = self._place(state)
        twists = self.sign * twists
        own = poses[self.owner]
        points = np.einsum("kij,kj->ki", own[:, :, :3], self._points) + own[:, :, 3]
        normals = np.einsum("kij,kj->ki", own[:, :, :3], self._normals)
        twist = twists[self.owner]
        velocities = twist[:, :3] + np.cross(twist[:, 3:], points)
        speeds = np.sqrt((velocities**2).sum(axis=1))
        moving = speeds > 1e-9
        alignment = np.where(
            moving, -(normals * velocities).sum(axis=1) / np.where(moving, speeds, 1.0), -1.0
        )
        return PushContacts(points, normals, velocities, alignment, speeds / max(speeds.max(), 1e-9))

    def locate(self, state: State, index: int) -> tuple[Vector, PushPoint]:
        """Return the tip of the pusher and one point at a state."""
        one, symbols = self._one, self._symbols
        one.input[: len(symbols)] = state.vector(symbols)
        one.input[len(symbols) :] = self._places[index]
        one()
        t, u, v, x, y, z, a, b, c, d, e, f = one.outputs[0].tolist()
        normal, velocity = (a, b, c), (d, e, f)
        return (t, u, v), PushPoint((x, y, z), normal, velocity, find_alignment(normal, velocity))

    def _compile_one(self, poses: list[Expression], twists: list[Expression], tip: Expression) -> None:
        """Compile the tip, and a point with its normal and velocity, whose place on a body is an input."""
        sizes = {"body": len(poses), "p": 3, "n": 3}
        chosen = [Target(f"push/{name}", np.zeros(size)) for name, size in sizes.items()]
        weights, point, normal = (target.expression for target in chosen)
        nowhere, resting = as_expression(np.zeros((3, 4))), as_expression(np.zeros(6))
        pose = sum((w * pose for w, pose in zip(weights, poses, strict=True)), nowhere)
        twist = sum((w * twist for w, twist in zip(weights, twists, strict=True)), resting)
        place, direction = pose[:, :3] @ point + pose[:, 3], pose[:, :3] @ normal
        velocity = self.sign * (twist[:3] + np.cross(twist[3:], place))
        own = {s for e in (*poses, *twists, tip) for s in e.symbols}
        self._symbols = tuple(sorted(own, key=lambda s: s.sort_key))
        inputs = (*self._symbols, *(symbol for target in chosen for symbol in target.parameters))
        self._one = compile([array([*tip, *place, *direction, *velocity])], inputs).bind()
        on_body = np.eye(len(poses))[self.owner]
        self._places = np.hstack([on_body, self._points, self._normals])

    def _sample(self, scene: Scene, state: State) -> list[tuple[int, Array, Array]]:
        """Return body, point and normal in the body of the points that rays reach at a state."""
        scene.update(state)
        world = scene.collision_world
        world.prepare()
        poses, twists = self._place(state)
        twists = self.sign * twists
        result = []
        for k, body in enumerate(self.bodies):
            R, t = poses[k, :, :3], poses[k, :, 3]
            for item in world.members[world.body_index(body)]:
                solid, placed = world.solid(item), world.table.poses[item]
                for x in _grid(solid, placed, twists[k]):
                    u = twists[k, :3] + np.cross(twists[k, 3:], x)
                    speed = float(np.linalg.norm(u))
                    if speed < 1e-9:
                        continue
                    u /= speed
                    start = x - u * (_OUTSIDE + 2 * solid.radius)
                    hit = scene.ray(start, u, _OUTSIDE + 4 * solid.radius)
                    if hit is None or hit.body != body or hit.distance <= 0.0 or -hit.normal @ u < 0.5:
                        continue
                    result.append((k, R.T @ (hit.point - t), R.T @ hit.normal))
        return result

    def _find_room(self, scene: Scene, state: State) -> Array:
        """Return the free space (N,) in front of all points at a state."""
        scene.update(state)
        at = self.at(state)
        room = np.ones(len(self))
        for k, ahead in enumerate(at.points + _ROOM * at.normals):
            near = scene.point(ahead, _ROOM)
            if near is not None:
                room[k] = max(near.distance / _ROOM, 0.0)
        return room


def _without_doubles(found: list[tuple[int, Array, Array]]) -> list[tuple[int, Array, Array]]:
    kept: dict[tuple[float, ...], tuple[int, Array, Array]] = {}
    for body, point, normal in found:
        kept.setdefault(
            (body, *np.round(point / _SAME).tolist(), *np.round(normal, 1).tolist()), (body, point, normal)
        )
    return list(kept.values())


def _grid(solid: Solid, placed: Array, twist: Array) -> Array:
    """Return points (N, 3) in the middle plane of a solid's box across its motion, in the world."""
    R, t = placed[:, :3], placed[:, 3]
    centre = R @ solid.centre + t
    along = R.T @ (twist[:3] + np.cross(twist[3:], centre))
    flat = int(np.argmax(np.abs(along) * (1.0 / np.maximum(solid.half, 1e-4))))
    axes = []
    for i, half in enumerate(solid.half.tolist()):
        inner = max(half - _INSET, 0.0)
        count = 1 if i == flat or inner == 0.0 else min(2 * math.ceil(inner / _SPACING) + 1, _MOST)
        axes.append(np.linspace(-inner, inner, count) if count > 1 else np.zeros(1))
    local = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3) + solid.centre
    return np.asarray(local @ R.T + t)


class ContactSelection:
    """Contact point at which an object is pushed, and those that were given up."""

    def __init__(self, surface: PushSurface) -> None:
        self._surface = surface
        self.reset()

    def reset(self) -> None:
        """Forget all contact points."""
        self.chosen: int | None = None
        self.contacts = self.blocked = self.jammed = 0
        self._given_up: dict[int, int] = {}
        self._out_of_reach: list[tuple[int, Array]] = []
        self.restart()

    def restart(self) -> None:
        """Start counting progress again."""
        self._best, self._since = math.inf, 0

    @property
    def is_jammed(self) -> bool:
        """True if the object did not move at several contact points."""
        return self.jammed >= _MOST_JAMMED

    def score(self, points: PushContacts) -> Array:
        """Return how well the object can be pushed at each point (N,)."""
        inside = points.alignment > CONE
        return np.asarray(
            np.where(inside, 0.0, -3.0)
            + points.alignment
            + np.minimum(points.leverage, 0.8)
            + 0.7 * self._surface.room
        )

    def rank(self, state: State, tip: Vector, limit: float) -> list[int]:
        """Return contact points at a state, the best first, each some distance from better ones [m]."""
        points = self._surface.at(state)
        score = self.score(points) - _DISTANCE_COST * np.sqrt(
            ((points.points - np.array(tip)) ** 2).sum(axis=1)
        )
        for k, times in self._given_up.items():
            near = ((points.points - points.points[k]) ** 2).sum(axis=1) < _SURROUNDINGS**2
            score = score - np.where(near, _GIVEN_UP_COST * times, 0.0)
        for k, rest in self._out_of_reach:
            beyond = (points.points - points.points[k]) @ rest > 0.0
            score = score - np.where(beyond, _GIVEN_UP_COST, 0.0)
        ranked: list[int] = []
        while score.max() > -math.inf:
            best = int(np.argmax(score))
            ranked.append(best)
            near = ((points.points - points.points[best]) ** 2).sum(axis=1) < limit**2
            score = np.where(near, -math.inf, score)
        return ranked

    def choose(self, state: State, tip: Vector, index: int | None = None) -> PushPoint:
        """Choose a contact point, by default the best, and return it."""
        self.chosen = self.rank(state, tip, math.inf)[0] if index is None else index
        self.contacts += 1
        self.restart()
        return self._surface.locate(state, self.chosen)[1]

    def give_up(self, touching: bool, rest: Vector) -> None:
        """Leave the present contact point for another one."""
        self.jammed += touching
        if self.chosen is not None:
            if length(rest) > _OUT_OF_REACH:
                self._out_of_reach.append((self.chosen, np.array(rest)))
            self._given_up[self.chosen] = self._given_up.get(self.chosen, 0) + 1
            self.blocked += 1
        self.chosen = None
        self.restart()

    def is_stuck(self, rest: float) -> bool:
        """Return True after a while without progress of a rest [m], [rad] that has to become 0."""
        if rest < self._best - _BLOCKED_WAY:
            self._best, self._since = rest, 0
        else:
            self._since += 1
        return self._since > _BLOCKED_STEPS


@dataclass(frozen=True, slots=True, eq=False)
class PushTool:
    """Foremost point of a group of bodies."""

    frame: str  # frame that carries the group
    tip: Array  # point in this frame (3,) [m]
    axis: Array  # unit vector in this frame in which the group points (3,)

    def locate_tip(self, model: ModelView) -> Expression:
        """Return the point in the world (3,), as an expression [m]."""
        world_T_hand = model.fk(self.frame)
        return world_T_hand[:3, :3] @ self.tip + world_T_hand[:3, 3]

    def point_axis(self, model: ModelView) -> Expression:
        """Return the axis in the world (3,), as an expression."""
        return model.fk(self.frame)[:3, :3] @ self.axis


def find_push_tool(model: ModelView, bodies: Sequence[str], state: State) -> PushTool:
    """Return the foremost point of a group of bodies, away from what carries the group."""
    chains = [path_to_root(model, body) for body in bodies]
    common = [frame for frame in chains[0] if all(frame in chain for chain in chains)]
    frame = common[0]
    scene = Scene.of(model)
    scene.update(state)
    world = scene.collision_world
    world.prepare()
    placed: list[tuple[Solid, npt.NDArray[np.float64], npt.NDArray[np.float64]]] = []
    for body in bodies:
        for item in world.members[world.body_index(body)]:
            pose = world.table.poses[item]
            placed.append((world.solid(item), pose[:, :3].copy(), pose[:, 3].copy()))
    centres = np.array([R @ solid.centre + t for solid, R, t in placed])
    carrier = next((f for f in common if f in world.bodies and f not in bodies), frame)
    fk = {name: np.asarray(model.fk(name)(state)) for name in {frame, carrier}}
    axis = centres.mean(axis=0) - fk[carrier][:3, 3]
    if np.linalg.norm(axis) < _SAME:
        axis = fk[frame][:3, 0]
    axis = axis / np.linalg.norm(axis)
    # The frame's own axis, if it is about the same: shapes are seldom exactly symmetric.
    nearest = fk[frame][:3, :3] * np.sign(axis @ fk[frame][:3, :3])
    k = int(np.argmax(axis @ nearest))
    if axis @ nearest[:, k] > 0.9:
        axis = nearest[:, k]
    tips = np.array([_front(one, axis) for one in placed])
    heights = tips @ axis
    tip = tips[heights > heights.max() - _FRONT].mean(axis=0)
    R, t = fk[frame][:3, :3], fk[frame][:3, 3]
    return PushTool(frame, R.T @ (tip - t), R.T @ axis)


def _front(placed: tuple[Solid, Array, Array], axis: Array) -> Array:
    """Return the foremost point (3,) of a solid along an axis."""
    solid, R, t = placed
    if solid.core is not None:
        return np.asarray(smoothed_support(placed, axis))
    half = np.abs(R.T @ axis) @ solid.half
    return np.asarray(R @ solid.centre + t + axis * half)


def find_alignment(normal: Vector, velocity: Vector) -> float:
    """Return the cosine between -n and a velocity; -1 for a point that does not move."""
    speed = length(velocity)
    return -inner_product(normal, velocity) / speed if speed > 1e-9 else -1.0
