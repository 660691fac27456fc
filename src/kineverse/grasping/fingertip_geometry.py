"""Geometry of two opposed fingers: closing motion, pads, and the gap between them.

All poses and points are in the frame of the hand [m].
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from kineverse import lie
from kineverse.geometry import DistanceResult, RayHit
from kineverse.lie import Array
from kineverse.model.model_view import ModelView
from kineverse.symbols import Symbol

from .finger_branches import Branch, path_to_root
from .hand_model import HandModel

_SAMPLES = 33
_NEAR = 4e-3  # opening at which fingers count as nearly closed: their pads face each other there [m]
_FLAT = 2e-3  # unevenness of a pad [m]
_CELLS = 14
_REACH = 0.3  # length of the rays from the middle to the pads [m]
_ALIGNED = 0.85  # cosine of the angle below which an axis is taken for the approach direction
_SLOWER = 0.4  # least motion of one finger against the other's; fingers that mirror each other have 1
_STILL_OPEN, _WIDEST = 0.45, 0.4
"""Largest gap of closed fingers as a part of that of open ones, and the largest gap at all [m]."""
_LEAST_STROKE = 5e-3  # least change of the gap of a gripper [m]


@dataclass(frozen=True, slots=True, eq=False)
class Pads:
    """Two facing surfaces on fingers, and how they close."""

    fingers: tuple[tuple[str, ...], tuple[str, ...]]  # frames of both fingers that have shapes
    frames: tuple[str, str]  # frames that carry the pads
    points: Array  # (2, 3) the middle of each in its own frame
    axes: Array  # (3, 3) rotation hand_R_grasp: x out of the hand, y from the first pad to the second
    size: tuple[float, float]  # lengths along x and z
    opened: Mapping[Symbol, float]  # values of the joints at both ends of the motion
    closed: Mapping[Symbol, float]
    stroke: Array  # (n, 5): part of the motion in [0, 1], gap [m], middle between the pads [m]

    def parts_at(self, gaps: Array) -> Array:
        """Return the parts of the motion at which the pads have gaps (n,) [m], or the nearest ends of it."""
        return np.interp(-gaps, -self.stroke[:, 1], self.stroke[:, 0])

    def values_at(self, gap: float) -> dict[Symbol, float]:
        """Return the values of the joints at which the pads have a gap [m], within what they can."""
        part = float(self.parts_at(np.array(gap)))
        return {s: self.opened[s] + part * (self.closed[s] - self.opened[s]) for s in self.opened}

    def middle_at(self, gap: float) -> Array:
        """Return the middle (3,) between the pads when they have a gap [m]."""
        part = float(self.parts_at(np.array(gap)))
        return np.array([np.interp(part, self.stroke[:, 0], self.stroke[:, k]) for k in (2, 3, 4)])


def find_pads(
    model: ModelView, alone: HandModel, a: Branch, b: Branch, root: Array
) -> tuple[Pads | None, str]:
    """Return the pads of two branches, or None with the reason why they are no opposed fingers."""
    shared = tuple(s for s in a.joints if s in b.joints)
    if len(a.joints) != len(b.joints):
        return None, f"one has {len(a.joints)} joints and the other {len(b.joints)}"
    everything = tuple(dict.fromkeys((*a.joints, *b.joints)))
    # Further joints, such as springs, move only where the fingers have none in common.
    pads, why = None, ""
    for joints in dict.fromkeys((shared, everything)):
        if pads is None and joints:
            pads, why = _find_pads(_Motion(model, alone, a, b, joints), root)
    return pads, why


def _find_pads(motion: _Motion, root: Array) -> tuple[Pads | None, str]:
    why, alone = motion.find_closing(), motion.alone
    if why:
        return None, why
    nearly = motion.nearly_closed
    motion.place(nearly)
    near = motion.nearest()
    carriers, tips = (near.a, near.b), (near.point_a, near.point_b)
    points = [_in_frame(alone.scene.pose(f), p) for f, p in zip(carriers, tips, strict=True)]
    moved = motion.track(carriers, points, (nearly, max(nearly - 0.02, 0.0)))
    opening = moved[1] - moved[0]  # motion of both points while the fingers open a little
    across = opening[1] - opening[0]
    if np.linalg.norm(across) < 1e-9:
        return None, "the fingers do not part"
    y = lie.round_exact(across / np.linalg.norm(across))
    if y[np.argmax(np.abs(y))] < 0.0:  # of two equal choices the one along an axis of the hand
        motion.exchange()
        y, opening, moved = -y, opening[::-1], moved[:, ::-1]
    speeds = sorted((float(-opening[0] @ y), float(opening[1] @ y)))
    if speeds[0] < _SLOWER * speeds[1]:
        return None, "they do not move against each other"
    outwards = moved[0].mean(axis=0) - root
    if np.linalg.norm(np.cross(outwards, y)) < 1e-4:
        return None, "their direction is undetermined"
    x = _approach(motion, y, outwards)
    axes = lie.round_exact(np.stack([x, y, np.cross(x, y)], axis=1))
    return _measure(motion, axes, float(moved[0].mean(axis=0) @ y))


def reaches_pads(alone: HandModel, branch: Branch, pads: Pads) -> bool:
    """Return True if another branch reaches as far as the pads do when these are nearly closed."""
    alone.place(pads.values_at(_NEAR))
    corners = alone.box_corners(f for f in branch.frames if f in alone.bodies)
    x = pads.axes[:, 0]
    return bool((corners @ x).max() > pads.middle_at(_NEAR) @ x - pads.size[0] / 4)


def _approach(motion: _Motion, y: Array, outwards: Array) -> Array:
    """Return the unit vector (3,) out of the hand, normal to y: along an axis of the hand if one is near."""
    axes = [*np.eye(3)]
    for frame in (*motion.a, *motion.b):
        turn = motion.turn(frame)
        if np.linalg.norm(turn) > 1e-3:
            axes.insert(0, np.cross(y, lie.unit_vector(turn)))
    outwards = lie.unit_vector(outwards - (outwards @ y) * y)
    for axis in axes:
        if abs(axis @ y) < 0.02 and abs(axis @ outwards) > _ALIGNED:
            axis = axis - (axis @ y) * y
            return lie.unit_vector(np.copysign(1.0, axis @ outwards) * axis)
    return outwards


def _measure(motion: _Motion, axes: Array, height: float) -> tuple[Pads | None, str]:
    motion.place(motion.nearly_closed)
    edges = _find_edges(motion, axes, height)
    hits = None if edges is None else motion.face(axes, height, edges.mean(axis=0))
    if edges is None or hits is None:
        return None, "they do not face each other"
    y = axes[:, 1]
    frames = (hits[0].body, hits[1].body)
    points = [_in_frame(motion.scene.pose(hit.body), hit.point) for hit in hits]
    parts = np.linspace(0.0, 1.0, _SAMPLES)
    tracked = motion.track(frames, points, parts)
    gap = (tracked[:, 1] - tracked[:, 0]) @ y
    first = int(np.argmax(gap))  # fingers that turn further than to both sides are open before their limits
    gap, tracked = gap[first:], tracked[first:]
    opened, closed = motion.values(float(parts[first])), motion.values(1.0)
    parts = np.linspace(0.0, 1.0, len(gap))
    if (np.diff(gap) > 1e-4).any() or gap[-1] > _STILL_OPEN * gap[0] or gap[0] > _WIDEST:
        return None, f"their gap goes from {gap[0] * 1e3:.0f} to {gap[-1] * 1e3:.0f} mm, as no gripper's does"
    stroke = np.column_stack([parts, gap, tracked.mean(axis=1)])
    length, width = (edges[1] - edges[0]).tolist()
    fingers = (tuple(motion.a), tuple(motion.b))
    return Pads(fingers, frames, np.array(points), axes, (length, width), opened, closed, stroke), ""


def _find_edges(motion: _Motion, axes: Array, height: float) -> Array | None:
    """Return the least and largest x and z (2, 2) of the facing surfaces; None if there are none.

    They are where the gap is nearly the least one: cells of a grid, whose borders are then bisected.
    """
    corners = [motion.alone.box_corners(frames) @ axes[:, [0, 2]] for frames in motion.tips]
    low, high = (
        np.max([c.min(axis=0) for c in corners], axis=0),
        np.min([c.max(axis=0) for c in corners], axis=0),
    )
    if (low >= high).any():
        return None
    step = (high - low) / _CELLS
    cells = [low + step * (np.array(k) + 0.5) for k in np.ndindex(_CELLS, _CELLS)]
    gaps = np.array([motion.gap_at(axes, height, cell) for cell in cells])
    if not np.isfinite(gaps).any():
        return None
    pad = np.array(cells)[gaps <= gaps.min() + _FLAT]
    middle = pad[np.argmin(np.linalg.norm(pad - pad.mean(axis=0), axis=1))]
    edges = np.stack([pad.min(axis=0), pad.max(axis=0)])
    for side, sign in ((0, -1.0), (1, 1.0)):
        for axis in (0, 1):
            inside, outside = middle.copy(), middle.copy()
            inside[axis] = edges[side, axis]
            outside[axis] = edges[side, axis] + sign * step[axis]
            if motion.gap_at(axes, height, inside) > gaps.min() + _FLAT:
                continue  # not a rectangle: the cells are all that is known
            for _ in range(8):
                between = (inside + outside) / 2
                is_pad = motion.gap_at(axes, height, between) <= gaps.min() + _FLAT
                inside, outside = (between, outside) if is_pad else (inside, between)
            edges[side, axis] = inside[axis]
    return edges


def find_finger_range(model: ModelView, joint: Symbol) -> tuple[float, float]:
    """Return the limits of a joint within those of joints that mimic it; its own if these leave nothing."""
    own = low, high = model.limits(joint)
    if not np.isfinite(own).all() or low == high:
        return own
    for c in model.constraints_for(joint).values():
        if c.order or c.symbols != (joint,):
            continue
        if c.line is not None:
            slope, offset = c.line
            ends = sorted((float(bound) - offset) / slope for bound in (c.lower, c.upper))
            low, high = max(low, ends[0]), min(high, ends[1])
    return (low, high) if low < high else own


class _Motion:
    """Closing motion of two branches, as a line through the values of their joints."""

    def __init__(
        self, model: ModelView, alone: HandModel, a: Branch, b: Branch, joints: tuple[Symbol, ...]
    ) -> None:
        self.alone, self.scene = alone, alone.scene
        self.a, self.b = ([f for f in branch.frames if f in alone.bodies] for branch in (a, b))
        # The roots of fingers are near to each other whether these are open or closed.
        self.tips = [_tips(model, frames) for frames in (self.a, self.b)]
        self.joints = joints
        self.limits = {s: find_finger_range(model, s) for s in joints}
        defaults = model.default_state()
        self._still = {s: defaults[s] for s in alone.joints if s not in joints}
        self.opened: dict[Symbol, float] = {}
        self.closed: dict[Symbol, float] = {}
        self.nearly_closed = 1.0

    def find_closing(self) -> str:
        """Find the values that open and close the fingers; return the reason if they do not."""
        # Closed is the corner of the limits with the least gap: one joint alone may not bring them nearer.
        corners = [dict(zip(self.joints, corner, strict=True)) for corner in product(*self.limits.values())]
        self.closed = min(corners, key=self.gap)
        least = self.gap(self.closed)
        for s, (low, high) in self.limits.items():
            self.opened[s] = low if self.closed[s] == high else high
            if abs(self.gap({**self.closed, s: self.opened[s]}) - least) < 1e-6:
                self.opened[s] = self.closed[s] = (low + high) / 2  # it does not matter to the gap
        parts = np.linspace(0.0, 1.0, _SAMPLES)
        gaps = np.array([self.gap(self.values(part)) for part in parts.tolist()])
        if gaps.max() - gaps.min() < _LEAST_STROKE or gaps.max() <= 0.0:
            return "the gap between them does not change"
        touch = int(np.argmax(gaps <= 0.0)) if (gaps <= 0.0).any() else int(np.argmin(gaps))
        end = float(parts[touch])
        if gaps[touch] < 0.0 and touch:
            end = self._bisect(0.0, float(parts[touch - 1]), end)
        wide = np.flatnonzero(gaps[: touch + 1] >= max(gaps[touch], 0.0) + _NEAR)
        if not len(wide):
            return "the fingers hardly open before they touch"
        k = int(wide[-1])
        self.nearly_closed = self._bisect(max(gaps[touch], 0.0) + _NEAR, float(parts[k]), end) / end
        self.closed = self.values(end)
        return ""

    def _bisect(self, gap: float, wide: float, tight: float) -> float:
        for _ in range(20):
            middle = (wide + tight) / 2
            wide, tight = (middle, tight) if self.gap(self.values(middle)) > gap else (wide, middle)
        return wide

    def exchange(self) -> None:
        self.a, self.b, self.tips = self.b, self.a, self.tips[::-1]

    def values(self, part: float) -> dict[Symbol, float]:
        """Return the values of the joints at a part of the motion from 0 (open) to 1 (closed)."""
        return {s: self.opened[s] + part * (self.closed[s] - self.opened[s]) for s in self.joints}

    def place(self, part: float) -> None:
        self.alone.place({**self._still, **self.values(part)})

    def gap(self, values: Mapping[Symbol, float]) -> float:
        self.alone.place({**self._still, **values})
        return self.nearest().distance

    def nearest(self) -> DistanceResult:
        result = self.scene.distances((f, g) for f in self.tips[0] for g in self.tips[1])
        return min(result, key=lambda pair: pair.distance)

    def track(self, frames: Sequence[str], points: Sequence[Array], parts: Iterable[float]) -> Array:
        """Return the positions (n, 2, 3) of points of two frames at parts of the motion."""
        rows = []
        for part in parts:
            self.place(part)
            rows.append([_at(self.scene.pose(f), p) for f, p in zip(frames, points, strict=True)])
        return np.array(rows)

    def face(self, axes: Array, height: float, place: Array) -> tuple[RayHit, RayHit] | None:
        """Return where rays along -y and y hit the tips of the first and second finger, or None.

        They start at a place (x, z) in the plane normal to y at a height.
        """
        x, y, z = axes.T
        origin = place[0] * x + height * y + place[1] * z
        first, second = self.scene.ray(origin, -y, _REACH), self.scene.ray(origin, y, _REACH)
        if first is None or second is None:
            return None
        faces = first.body in self.tips[0] and second.body in self.tips[1]
        return (first, second) if faces else None

    def gap_at(self, axes: Array, height: float, place: Array) -> float:
        hits = self.face(axes, height, place)
        return math.inf if hits is None else hits[0].distance + hits[1].distance

    def turn(self, frame: str) -> Array:
        """Return the rotation vector (3,) of a frame from open to closed [rad]."""
        self.place(0.0)
        start = self.scene.pose(frame)[:3, :3]
        self.place(1.0)
        return np.asarray(lie.log_so3(self.scene.pose(frame)[:3, :3] @ start.T))


def _tips(model: ModelView, frames: Sequence[str]) -> list[str]:
    """Return the frames on which none of the others moves."""
    inner = {f for g in frames for f in path_to_root(model, g) if f in frames and model.speeds_of(g, f)}
    return [f for f in frames if f not in inner]


def _at(pose: Array, point: Array) -> Array:
    return pose[:3, :3] @ point + pose[:3, 3]


def _in_frame(pose: Array, point: Array) -> Array:
    return pose[:3, :3].T @ (point - pose[:3, 3])
