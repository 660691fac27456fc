"""Paths of an arm with a handle: configurations along poses of the hand, and their checks for collisions."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from kineverse.compilation import compile
from kineverse.geometry import Rule, Scene
from kineverse.geometry.distance_queries import PreparedQuery
from kineverse.grasping import Grasp, Gripper
from kineverse.grasping.hand_model import find_box_corners
from kineverse.lie import Array, inverse, log_so3
from kineverse.model.model_view import ModelView
from kineverse.state import State
from kineverse.symbols import Symbol

from .contact_phases import Way

_DAMPING = 1e-6
_CENTERING = 0.1  # share of the distance to the middle of the limits that a step takes in the null space
_LONGEST = 0.4  # largest step of a coordinate [m], [rad]
_JUMP = 0.6  # largest change of a coordinate between neighbouring poses of a sequence [m], [rad]
TOLERANCE = 1e-4  # error of a pose that counts as reached [m], [rad]


class CartesianPaths:
    """Damped Newton steps of many configurations at once, within the limits of the coordinates.

    A step is ``W Jᵀ (J W Jᵀ + λ)⁻¹ e`` with the error e of position and rotation vector, and a step to the
    middle of limits in the null space (Nakamura 1991). Coordinates outside of their limits are clipped, and
    those that a step would lead out of them rest in it.
    """

    def __init__(
        self, model: ModelView, hand: str, moving: Sequence[Symbol], still: Sequence[Symbol], ease: Array
    ) -> None:
        self.moving, self.still = tuple(moving), tuple(still)
        pose = model.fk(hand)
        jacobian = model.jacobian(hand, form="world_aligned", symbols=[s.derivative() for s in moving])
        self._f = compile([pose, jacobian], [*self.moving, *self.still])
        limits = np.array([model.limits(s) for s in moving], dtype=float).reshape(-1, 2)
        self.lower, self.upper = limits.T
        bounded = np.isfinite(limits).all(axis=1)
        self._middle = np.where(bounded, np.where(bounded[:, None], limits, 0.0).mean(axis=1), np.nan)
        self.ease = ease

    def solve(self, Q: Array, base: Array, targets: Array, iterations: int) -> tuple[Array, Array]:
        """Return configurations (N, n) near to given ones at which the hand is at poses, and errors (N,)."""
        Q = Q.copy()
        for k in range(iterations + 1):
            poses, J = self._f.batch(np.hstack([Q, base]))
            turn = log_so3(targets[:, :3, :3] @ np.swapaxes(poses[:, :3, :3], 1, 2))
            e = np.hstack([targets[:, :3, 3] - poses[:, :3, 3], turn])
            error = np.abs(e).max(axis=1)
            if k == iterations or (error < TOLERANCE / 10).all():
                break
            center = np.nan_to_num(_CENTERING * (self._middle - Q)) * self.ease
            step = self._step(J, e, center, np.tile(self.ease, (len(Q), 1)), error)
            # A coordinate at its limit takes no part: the others go on without it.
            outward = ((self.lower >= Q) & (step < 0.0)) | ((self.upper <= Q) & (step > 0.0))
            stuck = outward.any(axis=1)
            if stuck.any():
                free = np.where(outward[stuck], 0.0, self.ease)
                step[stuck] = self._step(J[stuck], e[stuck], center[stuck] * (free > 0.0), free, error[stuck])
            step *= np.minimum(1.0, _LONGEST / np.maximum(np.abs(step).max(axis=1), 1e-9))[:, None]
            Q = np.clip(Q + step, self.lower, self.upper)
        return Q, error

    @staticmethod
    def _step(J: Array, e: Array, center: Array, ease: Array, error: Array) -> Array:
        """Return damped Newton steps (N, n) for weights (N, n), centred in the null space."""
        WJt = ease[:, :, None] * np.swapaxes(J, 1, 2)
        damped = J @ WJt + (_DAMPING + 1e-3 * np.minimum(error, 0.5) ** 2)[:, None, None] * np.eye(6)
        rest = e - (J @ center[:, :, None])[:, :, 0]
        return np.asarray(center + (WJt @ np.linalg.solve(damped, rest[:, :, None]))[:, :, 0])

    def find_poses(self, Q: Array, base: Array) -> Array:
        """Return poses world_T_hand (N, 4, 4) at configurations (N, n), with values (m,) of what stands."""
        poses, _ = self._f.batch(np.hstack([Q, np.tile(base, (len(Q), 1))]))
        return np.asarray(poses)

    def find_heights(self, Q: Array, base: Array, points: Array) -> tuple[Array, Array]:
        """Return the heights (N,) of the highest of some points of the hand, and their derivatives (N, n)."""
        poses, J = self._f.batch(np.hstack([Q, np.tile(base, (len(Q), 1))]))
        heights = poses[:, 2, :3] @ points.T + poses[:, 2, 3:]
        highest = np.argmax(heights, axis=1)
        r = (poses[:, :3, :3] @ points[highest][:, :, None])[:, :, 0]
        slopes = J[:, 2] + J[:, 3] * r[:, 1:2] - J[:, 4] * r[:, :1]
        return heights.max(axis=1), np.asarray(slopes)

    def follow(self, Q: Array, base: Array, targets: Array) -> tuple[Array, Array]:
        """Return configurations (N, K, n) along poses (N, K, 4, 4), and how many (N,) are reached.

        A sequence ends where a pose is not reached, or where a coordinate jumps.
        """
        count = targets.shape[1]
        paths = np.repeat(Q[:, None], count, axis=1)
        reached = np.zeros(len(Q), dtype=int)
        going = np.arange(len(Q))
        for k in range(count):
            if not len(going):
                break
            result, error = self.solve(paths[going, max(k - 1, 0)], base[going], targets[going, k], 6)
            jump = np.abs(result - paths[going, max(k - 1, 0)]).max(axis=1, initial=0.0)
            good = (error < TOLERANCE) & (jump < _JUMP)
            going, result = going[good], result[good]
            paths[going, k] = result
            reached[going] = k + 1
        return paths, reached


def find_least_time(rows: Array, speeds: Array) -> float:
    """Return the least time [s] in which a robot passes configurations (L, n) evenly."""
    slowest = (np.abs(np.diff(rows, axis=0)) / speeds).max(initial=0.0)
    return float(slowest) * (len(rows) - 1)


def row_at(rows: Array, share: float) -> Array:
    """Return the configuration (n,) at a share of the path along some (K, n)."""
    place = share * (len(rows) - 1)
    k = min(max(int(place), 0), max(len(rows) - 2, 0))
    rest = min(max(place - k, 0.0), 1.0)
    result = (1.0 - rest) * rows[k] + rest * rows[min(k + 1, len(rows) - 1)]
    return np.asarray(result)


_ARMS = 200  # number of random arms from which the highest one is sought
_STEPS = np.geomspace(0.5, 2e-3, 60)  # largest changes of a coordinate in the steps of the ascent [m], [rad]


def find_highest_reach(scene: Scene, paths: CartesianPaths, gripper: Gripper, state: State) -> float:
    """Return the greatest height of a point of a gripper over all arms [m].

    It is sought by steepest ascent from random arms. Boxes stand for the shapes, so the height is rather too
    great than too small. Contacts are left out.
    """
    hand_T_world = inverse(np.asarray(scene.model.fk(gripper.hand)(state)))
    corners = []
    for gap in (0.0, gripper.width):
        scene.update(state.updated(gripper.values_at(gap)))
        corners.append(find_box_corners(scene, gripper.bodies))
    points = np.vstack(corners) @ hand_T_world[:3, :3].T + hand_T_world[:3, 3]
    random = np.random.default_rng(0)
    bounded = np.isfinite(paths.lower) & np.isfinite(paths.upper)
    lower, upper = np.where(bounded, paths.lower, -np.pi), np.where(bounded, paths.upper, np.pi)
    Q = random.uniform(lower, upper, (_ARMS, len(lower)))
    highest = -np.inf
    for most in _STEPS.tolist():
        heights, slopes = paths.find_heights(Q, state.vector(paths.still), points)
        highest = max(highest, float(heights.max()))
        outward = ((paths.lower >= Q) & (slopes < 0.0)) | ((paths.upper <= Q) & (slopes > 0.0))
        slopes = np.where(outward, 0.0, slopes)
        steepest = np.abs(slopes).max(axis=1, initial=1e-9)
        Q = np.clip(Q + most * slopes / steepest[:, None], paths.lower, paths.upper)
    return highest


def find_highest_passage(
    scene: Scene, bodies: Iterable[str], state: State, coordinate: Symbol, values: Array
) -> tuple[float, float]:
    """Return the one of some values at which an object is the highest, and the height of its lowest point."""
    names, lowest = tuple(bodies), []
    for value in values.tolist():
        scene.update(state.updated({coordinate: value}))
        lowest.append(find_box_corners(scene, names)[:, 2].min())
    highest = int(np.argmax(lowest))
    return float(values[highest]), float(lowest[highest])


OWN_MARGIN = 0.003  # least distance of the robot's own links [m]; pairs that are always nearer do not count
_BESIDE_BAR = 5e-4  # least distance of the opened fingers from the handle [m]


class PathContacts:
    """Queries of the distances of a robot along paths."""

    def __init__(
        self,
        scene: Scene,
        gripper: Gripper,
        robot_bodies: Sequence[str],
        others: Sequence[str],
        margin: float,
    ) -> None:
        self.scene, self.gripper, self.margin = scene, gripper, margin
        self.robot_bodies, self.others = tuple(robot_bodies), tuple(others)
        self._self_watch = scene.watch(self.robot_bodies, self.robot_bodies, OWN_MARGIN)
        speeds_of = scene.model.speeds_of
        self.hand = {b for b in robot_bodies if b in gripper.bodies or not speeds_of(b, gripper.hand)}
        self._around: dict[str, PreparedQuery] = {}
        self._beside: dict[str, PreparedQuery] = {}
        self._found: tuple[PreparedQuery, float] | None = None

    def first(
        self, state: State, columns: Sequence[Symbol], rows: Array, handle: str, *, opened: bool
    ) -> int | None:
        """Return the index of the first row of values (N, n) at which the robot comes too near to something.

        The scene is placed there.
        """
        self.scene.update(state.updated(dict(zip(columns, rows[0].tolist(), strict=True))))
        queries = [(self._watch_around(handle), self.margin), (self._self_watch, OWN_MARGIN)]
        if opened and handle:
            if handle not in self._beside:
                self._beside[handle] = self.scene.watch([*self.gripper.bodies], [handle], _BESIDE_BAR)
            queries.append((self._beside[handle], _BESIDE_BAR))
        first: int | None = None
        for query, radius in queries:
            result = query.first_within(columns, rows[:first], radius) if first != 0 else None
            if result is not None:
                first, self._found = result, (query, radius)
        if first is not None:
            self.scene.update(state.updated(dict(zip(columns, rows[first].tolist(), strict=True))))
        return first

    def touching(self) -> tuple[str, str]:
        """Return the pair of bodies that is too near in the scene, the robot's first."""
        assert self._found is not None
        query, radius = self._found
        pair = query(radius)[0]
        return (pair.b, pair.a) if pair.b in self.hand else (pair.a, pair.b)

    def _watch_around(self, handle: str) -> PreparedQuery:
        """Return the query of the robot's distance from everything else, but of the hand from the handle."""
        if handle not in self._around:
            bodies = self.gripper.bodies if handle else ()
            allowed = [Rule(b, handle, False, "grasped") for b in bodies]
            self._around[handle] = self.scene.watch(
                self.robot_bodies, self.others, self.margin, rules=allowed
            )
        return self._around[handle]


_LINE = 5  # number of configurations on the straight path to the handle
_BETWEEN = 4  # number of samples between neighbouring configurations that are checked
_SHORTER = 0.15  # share of the motion by which a path is shortened where that may help
_ASIDE = tuple(math.radians(a) for a in (0.0, 25.0, -25.0, 50.0, -50.0))  # of retreats, along the bar [rad]
_LEAST_RETREAT = 3  # least number of configurations of a retreat
_SWEEP = 8  # number of gaps of the fingers that are checked while they close or open


@dataclass(slots=True, eq=False)
class CandidatePath:
    """Path of an arm that reaches, until the value with the index ``end``."""

    choice: int  # index of the grasp
    base: Array  # values of the coordinates that stand
    back: Array  # configurations (L, n) from the handle to the pose before it
    path: Array  # configurations (K, n) along the values of the object
    end: int  # index of the last value


class PathCheck:
    """Check of paths in one state, of one handle along its way."""

    def __init__(
        self,
        contacts: PathContacts,
        paths: CartesianPaths,
        state: State,
        grasps: Sequence[Grasp],
        way: Way,
        handles: Array,
    ) -> None:
        self.contacts, self.paths, self.state, self.grasps = contacts, paths, state, grasps
        self.values, self.handles = way.values, handles
        self.free: npt.NDArray[np.int_] = np.full(len(grasps), len(way) - 1)
        self.reasons = Counter[str]()
        gripper, handle = grasps[0].gripper, grasps[0].handle
        self._gripper, self._frame = gripper, handle.frame
        self._columns: tuple[Symbol, ...] = (
            *paths.moving, *paths.still, *gripper.joints, *way.coordinates,
        )  # fmt: skip

    def find_retreat(self, candidate: CandidatePath) -> Array | None:
        """Return a retreat (L, n) of a candidate without contacts; otherwise shorten its path."""
        if self._is_blocked_before(candidate) or self._is_blocked_along(candidate):
            return None
        retreat = self._retreat(candidate)
        if retreat is None:
            last = len(self.values) - 1
            candidate.end -= max(1, round(_SHORTER * last))
        return retreat

    def _is_blocked_before(self, candidate: CandidatePath) -> bool:
        """Return True, and drop the candidate, if something is in the way until the fingers are closed."""
        grasp, base, opened = self.grasps[candidate.choice], candidate.base, self._gripper.opened
        back, still = candidate.back, self.paths.still
        home = [self._rows(self.state.vector(self.paths.moving)[None], base, opened, self.values[:1])]
        parts = [
            (self._rows(back, base, opened, self.values[:1]), self._frame, True),
            (self._sweep(grasp, back[0], base, 0), self._frame, False),
            *((rows, "", True) for rows in home if still),
        ]
        for rows, frame, fingers_open in parts:
            if self._find(rows, frame, opened=fingers_open) is not None:
                if self._note() in self.contacts.hand and frame:
                    self.free[candidate.choice] = -1
                candidate.end = -1
                return True
        return False

    def _is_blocked_along(self, candidate: CandidatePath) -> bool:
        """Return True, and shorten the path of the candidate, if something is in the way."""
        grasp, end, base = self.grasps[candidate.choice], candidate.end, candidate.base
        closed = self._gripper.values_at(grasp.thickness)
        rows = self._rows(candidate.path[: end + 1], base, closed, self.values[: end + 1])
        first = self._find(rows, self._frame, opened=False)
        if first is not None:
            candidate.end = first // _BETWEEN - 1
            if self._note() in self.contacts.hand:
                self.free[candidate.choice] = min(int(self.free[candidate.choice]), candidate.end)
            return True
        return False

    def _retreat(self, candidate: CandidatePath) -> Array | None:
        """Return the first straight retreat (L, n) without contacts; the longest of them if none is whole.

        It is the reversed approach, or deviates from it along the bar, between the fingers.
        """
        grasp, end, base = self.grasps[candidate.choice], candidate.end, candidate.base
        Q = candidate.path[end]
        sweep = self._sweep(grasp, Q, base, end)
        if self._find(sweep, self._frame, opened=False) is not None:
            self._note()
            return None
        hand, out = self.handles[end] @ grasp.pose, grasp.approach[:3, 3] - grasp.pose[:3, 3]
        lines = draw_retreats(out, grasp.handle.pose[:3, 2], self.handles[end], hand, _LINE)
        count = len(lines)
        paths, reached = self.paths.follow(np.tile(Q, (count, 1)), np.tile(base, (count, 1)), lines)
        opened = self._gripper.opened
        blocked = False
        for k in np.argsort(-reached, kind="stable"):
            path = paths[k, : reached[k]]
            if len(path) < _LEAST_RETREAT:
                break
            rows = self._rows(path, base, opened, self.values[end : end + 1])
            # At its end the hand is free: a path begins there.
            parts = ((rows, self._frame), (rows[-1:], ""))
            if all(self._find(part, frame, opened=True) is None for part, frame in parts):
                return np.asarray(path)
            blocked = True
            self._note()
        if not blocked:
            self.reasons["no straight retreat"] += 1
        return None

    def _sweep(self, grasp: Grasp, Q: Array, base: Array, index: int) -> Array:
        """Return rows (N, n) of fingers that close from open to the handle at a value of the object."""
        gripper = self._gripper
        row = self._rows(Q[None], base, gripper.opened, self.values[index : index + 1])
        rows = np.tile(row, (_SWEEP, 1))
        fingers = [gripper.values_at(g) for g in np.linspace(gripper.width, grasp.thickness, _SWEEP)]
        begin = len(Q) + len(base)
        rows[:, begin : begin + len(gripper.joints)] = [[f[s] for s in gripper.joints] for f in fingers]
        return rows

    def _rows(self, Q: Array, base: Array, fingers: Mapping[Symbol, float], values: Array) -> Array:
        """Return rows of everything that moves (N, n), with some between neighbouring ones.

        Values of the handle's coordinates (1, m) stand for all configurations.
        """
        fixed = [*base, *(fingers[s] for s in self._gripper.joints)]
        values = np.broadcast_to(values, (len(Q), values.shape[1]))
        full = np.hstack([Q, np.tile(fixed, (len(Q), 1)), values])
        share = np.arange(_BETWEEN) / _BETWEEN
        dense = full[:-1, None] + share[:, None] * (full[1:] - full[:-1])[:, None]
        return np.vstack([dense.reshape(-1, full.shape[1]), full[-1:]])

    def _find(self, rows: Array, handle: str, *, opened: bool) -> int | None:
        return self.contacts.first(self.state, self._columns, rows, handle, opened=opened)

    def _note(self) -> str:
        one, other = self.contacts.touching()
        self.reasons[f"{one} at {other}"] += 1
        return one


def draw_retreats(out: Array, bar: Array, world_T_handle: Array, world_T_hand: Array, count: int) -> Array:
    """Return straight retreats (N, L, 4, 4) of a hand: out of the handle, and others aside along its bar.

    The displacement ``out`` (3,) [m] and the direction ``bar`` (3,) are in the axes of the handle.
    """
    length = float(np.linalg.norm(out))
    starts = np.repeat(world_T_hand[None], len(_ASIDE), axis=0)
    ends = starts.copy()
    for k, angle in enumerate(_ASIDE):
        away = math.cos(angle) * out + math.sin(angle) * length * bar
        ends[k, :3, 3] += world_T_handle[:3, :3] @ away
    return interpolate_poses(starts, ends, count)


def interpolate_poses(a: Array, b: Array, count: int = _LINE) -> Array:
    """Return poses (N, L, 4, 4) on the straight path between poses of one orientation, a first."""
    share = np.linspace(0.0, 1.0, count)
    poses = np.repeat(a[:, None], count, axis=1)
    poses[:, :, :3, 3] += share[:, None] * (b - a)[:, None, :3, 3]
    return poses
