"""Grasps of a handle: poses of a hand whose open fingers enclose the bar."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from kineverse import lie
from kineverse._names import matches_pattern
from kineverse.errors import InvalidValueError
from kineverse.geometry import Scene
from kineverse.geometry.objects import collision_shapes
from kineverse.lie import Array
from kineverse.model.body import Body
from kineverse.model.frame import is_of_robot
from kineverse.model.model_view import ModelView
from kineverse.state import State

from .finger_branches import path_to_root
from .graspable_features import Part, find_parts
from .gripper_detection import Gripper
from .hand_model import HandModel, bodies_with_shapes
from .handles import Handle

RETREAT = 0.1  # distance of the pose from which the hand approaches [m]
_SLACK = 4e-3  # gap of the pads minus the thickness of the bar, before the fingers touch [m]
_MARGIN = 1e-3  # least distance of the hand from the object before the fingers touch [m]
_MOST_TILT, _MOST_TILT_OF_KNOB = math.radians(100), math.radians(20)
"""Largest angle about the bar: a hand that comes from the edge of a flap keeps its grasp while that opens."""
_DEPTHS = (0.0, 0.5, 1.0, -0.5)
"""Parts of the depth of the pads at which a bar is tried first; 1 is at their tips."""
_CANDIDATES = 6  # candidates for each grasp that is asked for
_NEAR = 0.6  # distance from the bar up to which shapes are checked [m]
_REACH = 0.05  # distance up to which the clearance of a grasp counts [m]
_CLOSING, _AWAY = 14, np.array([0.1, 0.25, 0.5, 1.0])
"""Number of gaps of fingers that close, and parts of the path to the pose before the approach."""
_ADVANCES, _TOUCHING = 20, 1e-4  # most steps in which fingers close, and distance of a touch [m]


@dataclass(frozen=True, slots=True, eq=False)
class Grasp:
    """Pose of a hand at a handle.

    Attributes
    ----------
    gripper, handle
        What holds what.
    pose
        Pose handle.frame_T_hand (4, 4) of the hand's frame while it holds [m].
    approach
        Pose handle.frame_T_hand (4, 4) before the hand approaches, outside of the handle [m].
    tilt
        Angle about the bar from its x axis to the direction from which the hand comes [rad].
    slant
        Angle from across the bar to that direction [rad].
    place
        Coordinate of the middle of the pads along the bar [m].
    thickness
        Length of the bar between the pads [m].
    clearance
        Least distance of the hand to everything but the bar, while it approaches and closes [m]: at most
        50 mm.

    See Also
    --------
    kineverse.grasping.sample_grasps
    """

    gripper: Gripper
    handle: Handle
    pose: Array
    approach: Array
    tilt: float
    place: float
    thickness: float
    clearance: float
    slant: float = 0.0

    def __str__(self) -> str:
        tilt, place = math.degrees(self.tilt), self.place * 1e3
        slant = f", slanted {math.degrees(self.slant):.0f}°" if self.slant else ""
        hand = self.gripper.hand
        return f"grasp of {self.handle.frame} by {hand}: tilted {tilt:.0f}°{slant}, at {place:.0f} mm"


def sample_grasps(
    model: ModelView,
    gripper: Gripper,
    handle: Handle,
    count: int = 64,
    seed: int = 0,
    *,
    state: State | None = None,
    slant: float = 0.0,
    decomposed: Iterable[str] = (),
) -> tuple[Grasp, ...]:
    """Return grasps across a bar, without contact of the gripper with the object, the best first.

    Grasps differ in the angle about the bar, the place along it, the depth, and by half a turn about the
    approach; around a knob also in the angle about its axis. The path from ``approach`` to ``pose`` and the
    closing fingers are free of collisions with everything that is not the robot's.
    Upright grasps at the middle of the bar and of the pads come first, of similar ones the clearer.

    Parameters
    ----------
    model
        Model of the robot and of the object.
    gripper, handle
        What holds what.
    count
        Most grasps that are returned.
    seed
        Seed of the samples: equal arguments give equal grasps.
    state
        Where everything stands while the hand approaches; default values without it.
    slant
        Largest angle by which the hand comes from along a bar, instead of from across it [rad]; an arm that
        ends below an upright bar reaches it so.
    decomposed
        Bodies, or patterns, as for :class:`kineverse.geometry.Scene`: without them a mesh is its convex hull.

    Raises
    ------
    InvalidValueError
        If the bar is thicker than the gripper opens, or too near to its panel for the fingers.

    Examples
    --------
    >>> model = kv.load("fetch")
    >>> tags = model.include("kitchen")
    >>> gripper = kv.grasping.find_gripper(model, "fetch")
    >>> handle = kv.grasping.find_handle(model, "kitchen/fridge_door")
    >>> grasps = kv.grasping.sample_grasps(model, gripper, handle, count=4)
    >>> len(grasps), grasps[0].clearance > 0
    (4, True)
    """
    if handle.thickness + _SLACK > gripper.width:
        raise InvalidValueError(
            f"The handle {handle.frame} is {handle.thickness * 1e3:.0f} mm thick, and the gripper of "
            f"{gripper.hand} opens {gripper.width * 1e3:.0f} mm. find_handles and find_grippers list others."
        )
    surroundings = _Surroundings(model, gripper, handle, tuple(decomposed), state or model.default_state())
    result: list[tuple[float, Grasp]] = []
    hits: Counter[tuple[str, str]] = Counter()
    rng = np.random.default_rng(seed)
    for grasp, cost in _candidates(gripper, handle, surroundings.bar, _CANDIDATES * count, slant, rng):
        pair = surroundings.find_contact(grasp)
        closed = None if pair else surroundings.close(grasp)
        if closed is not None:
            pair = surroundings.find_contact(closed)
        if closed is None or pair is not None:
            hits[pair or (gripper.hand, "the bar, which the fingers miss")] += 1
            continue
        clearance = surroundings.clearance(closed)
        # Edges of a bar that is not round spread the fingers, and hold it less well than its sides.
        cost += closed.thickness / handle.thickness - min(clearance, 0.02) / 0.02
        result.append((cost, replace(closed, clearance=clearance)))
        if len(result) == count:
            break
    if not result:
        raise InvalidValueError(_explain(gripper, handle, hits))
    result.sort(key=lambda entry: entry[0])
    return tuple(grasp for _, grasp in result)


def _candidates(
    gripper: Gripper, handle: Handle, bar: Part, count: int, most: float, rng: np.random.Generator
) -> Iterator[tuple[Grasp, float]]:
    """Yield grasps that close around the bar, and what they cost: centred and upright ones little."""
    length, width = gripper.pads.size
    is_knob = handle.is_knob
    along = max(handle.length / 2 - width / 2 - 5e-3, 0.0)
    overlap = min(handle.depth, max(handle.depth / 2 + 3e-3, 8e-3))  # of bar and pads, along the approach
    deep = max((length + handle.depth) / 2 - overlap, 0.0)
    frame_R_bar = handle.pose[:3, :3]
    for k in range(count):
        # First both half turns at some depths, upright at the middle: knobs leave little more.
        part = np.array([0.0, 0.0, _DEPTHS[k // 2]]) if k < 2 * len(_DEPTHS) else rng.uniform(-1.0, 1.0, 3)
        spin = rng.uniform(-math.pi / 2, math.pi / 2) if is_knob and k > 1 else 0.0
        part[0] *= abs(part[0])  # many are nearly upright, which fits where there is little room
        tilt, place, depth = part * (_MOST_TILT_OF_KNOB if is_knob else _MOST_TILT, along, deep)
        slant = rng.uniform(-most, most) if most and not is_knob else 0.0
        bar_R_grasp = lie.rotation_x(np.array(spin)) @ lie.rotation_z(np.array(tilt + math.pi))
        bar_R_grasp = bar_R_grasp @ lie.rotation_y(np.array(slant))
        if k % 2:
            bar_R_grasp = bar_R_grasp @ lie.rotation_x(np.array(math.pi))
        across = frame_R_bar @ bar_R_grasp[:, 1]
        thickness = float(bar.extent(np.stack([across, -across])).sum())
        if thickness + _SLACK > gripper.width:
            continue
        z = np.array([0.0, 0.0, 0.0 if is_knob else place])
        bar_T_grasp = lie.transform(bar_R_grasp, z - depth * bar_R_grasp[:, 0])
        pose, approach = _place_hand(gripper, handle.pose @ bar_T_grasp, thickness)
        grasp = Grasp(gripper, handle, pose, approach, float(tilt), float(z[2]), thickness, 0.0, slant)
        yield grasp, float(np.abs(part).sum())


def _place_hand(gripper: Gripper, frame_T_grasp: Array, gap: float) -> tuple[Array, Array]:
    """Return frame_T_hand of a hand with a gap of its pads at a grasp pose, and before it approaches."""
    grasp_T_hand = lie.inverse(gripper.grasp_pose_at(gap))
    back = lie.translation(np.array([-RETREAT, 0.0, 0.0]))
    return frame_T_grasp @ grasp_T_hand, frame_T_grasp @ back @ grasp_T_hand


class _Surroundings:
    """Bodies around a handle, and a hand that is tried there, all in the frame of the handle."""

    def __init__(
        self, model: ModelView, gripper: Gripper, handle: Handle, decomposed: tuple[str, ...], state: State
    ) -> None:
        robot = _frames_of_robot(model, gripper)
        scene = Scene(model, decomposed=decomposed) if decomposed else Scene.of(model)
        around = {f for f in scene.bodies if f not in robot}
        scene.update(state)
        frame_T_world = lie.inverse(scene.pose(handle.frame))
        middle = (scene.pose(handle.frame) @ handle.pose)[:3, 3]
        near: dict[str, list[int]] = {}
        pieces: list[Part] = []
        for part in find_parts(scene, middle, _NEAR, bodies=around):
            near.setdefault(part.body, []).append(part.number)
            if (part.body, part.number) == (handle.frame, handle.shape):
                pieces.append(part)
        # Of a decomposed handle, the bar is the piece in its middle.
        if not pieces:
            raise InvalidValueError(f"{handle.frame} has no shape {handle.shape}: find the handle again.")
        bar = min(pieces, key=lambda part: float(np.linalg.norm(part.middle - middle)))
        self.bar = replace(bar, pose=frame_T_world @ bar.pose)
        obstacles = {}
        for name, numbers in near.items():
            shapes, pose = collision_shapes(model.bodies[name]), frame_T_world @ scene.pose(name)
            kept = [shapes[k] for k in dict.fromkeys(numbers) if (name, k) != (handle.frame, handle.shape)]
            if kept:
                obstacles[f"{_OBJECT}{name}"] = (pose, Body(collisions=tuple(kept)))
        shape = collision_shapes(model.bodies[handle.frame])[handle.shape]
        obstacles[_BAR] = (np.eye(4), Body(collisions=(shape,)))
        whole = [_BAR] if matches_pattern(handle.frame, decomposed) else []
        whole += [name for name in obstacles if matches_pattern(name.removeprefix(_OBJECT), decomposed)]
        rigid = [f for f in robot if not model.speeds_of(f, gripper.hand)]
        bodies = bodies_with_shapes(model, dict.fromkeys((*rigid, *gripper.bodies)))
        self._hand = HandModel(model, gripper.hand, bodies, gripper.joints, obstacles, whole)
        watch = self._hand.scene.watch
        self._contacts = watch(self._hand.bodies, list(obstacles), _REACH)
        others = [name for name in obstacles if name != _BAR]
        self._others = watch(self._hand.bodies, others, _REACH) if others else None
        self._to_bar = [watch(finger, [_BAR], math.inf) for finger in gripper.fingers]
        self._closing = self._hand.row(gripper.closed) - self._hand.row(gripper.opened)

    def find_contact(self, grasp: Grasp) -> tuple[str, str] | None:
        """Return the bodies of hand and object that come too near to each other, or None."""
        rows = self._rows(grasp)
        if self._contacts.first_within(self._hand.coordinates, rows, _MARGIN) is None:
            return None
        pair = self._contacts(_MARGIN)[0]
        hand, other = (pair.b, pair.a) if pair.a.startswith(_OBJECT) else (pair.a, pair.b)
        return hand, "the bar" if other == _BAR else other.removeprefix(_OBJECT)

    def close(self, grasp: Grasp) -> Grasp | None:
        """Return a grasp moved along the closing motion so that both fingers touch at once, or None.

        Each finger advances by its distance from the bar until both touch (conservative advancement). A bar
        that is not round is not in the middle, where the hand is tilted. None means that a finger misses it.
        """
        gripper = grasp.gripper
        frame_T_grasp = grasp.pose @ gripper.grasp_pose_at(grasp.thickness)
        gap = min(grasp.thickness + 2 * _SLACK, gripper.width)
        for _ in range(_ADVANCES):
            pose, approach = _place_hand(gripper, frame_T_grasp, gap)
            row = self._hand.row(gripper.values_at(gap), pose)[None]
            one, other = (to_bar.least_distance(self._hand.coordinates, row) for to_bar in self._to_bar)
            if max(abs(one), abs(other)) < _TOUCHING:
                return replace(grasp, pose=pose, approach=approach, thickness=gap)
            gap -= one + other
            frame_T_grasp = frame_T_grasp @ lie.translation(np.array([0.0, (one - other) / 2, 0.0]))
            if not 0.0 < gap <= gripper.width:
                return None
        return None

    def clearance(self, grasp: Grasp) -> float:
        """Return the least distance of the hand to everything but the bar [m], at most 50 mm."""
        if self._others is None:
            return _REACH
        return min(self._others.least_distance(self._hand.coordinates, self._rows(grasp)), _REACH)

    def _rows(self, grasp: Grasp) -> Array:
        """Return configurations (n, m) at the hold, and then on the way there: the first ones often touch."""
        gripper = grasp.gripper
        rows = np.tile(self._hand.row(gripper.opened, grasp.pose), (_CLOSING + len(_AWAY), 1))
        gaps = np.linspace(grasp.thickness + _SLACK, gripper.width, _CLOSING)
        rows[:_CLOSING] += gripper.pads.parts_at(gaps)[:, None] * self._closing
        rows[_CLOSING:, :3] += _AWAY[:, None] * (grasp.approach - grasp.pose)[:3, 3]
        return rows


_OBJECT, _BAR = "object/", "object/the bar"


def _frames_of_robot(model: ModelView, gripper: Gripper) -> dict[str, None]:
    """Return the frames of the gripper's robot: those below its prefix, or all that stand on its base."""
    top = path_to_root(model, gripper.hand)[-1]
    if gripper.robot:
        return dict.fromkeys(f for f in model.frames if is_of_robot(f, gripper.robot))
    return dict.fromkeys(f for f in model.frames if path_to_root(model, f)[-1] == top)


def _explain(gripper: Gripper, handle: Handle, hits: Counter[tuple[str, str]]) -> str:
    others = "find_handles and find_grippers list others."
    if not hits:
        return f"The gripper of {gripper.hand} opens too little for {handle.frame} from any side. {others}"
    listed = ", ".join(f"{a} at {b} ({n}×)" for (a, b), n in hits.most_common(4))
    return (
        f"The gripper of {gripper.hand} has no room at the handle {handle.frame}, which is "
        f"{handle.thickness * 1e3:.0f} mm thick and has {handle.clearance * 1e3:.0f} mm free behind it. All "
        f"{sum(hits.values())} grasps that were tried collide: {listed}. {others} Meshes are convex hulls: "
        "decomposed= takes the bodies of which kineverse decompose has made several."
    )
