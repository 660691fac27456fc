"""Collision checks of arm paths: on the path to a handle, along the motion with it, and on the retreat."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from kineverse.geometry import Rule, Scene
from kineverse.geometry.distance_queries import PreparedQuery
from kineverse.grasping import Grasp, Gripper
from kineverse.lie import Array
from kineverse.model.model_view import ModelView
from kineverse.state import State
from kineverse.symbols import Symbol

from .cartesian_paths import CartesianPaths

OWN_MARGIN = 0.003  # least distance of the robot's own links [m]; pairs that are always nearer do not count
_BESIDE_BAR = 5e-4  # least distance of the opened fingers from the handle [m]


class PathContacts:
    """Queries of the distances of a robot along paths."""

    def __init__(
        self,
        model: ModelView,
        scene: Scene,
        gripper: Gripper,
        robot_bodies: Sequence[str],
        others: Sequence[str],
        margin: float,
    ) -> None:
        self.scene, self.gripper, self.margin = scene, gripper, margin
        self.robot_bodies, self.others = tuple(robot_bodies), tuple(others)
        self._self_watch = scene.watch(self.robot_bodies, self.robot_bodies, OWN_MARGIN)
        self.hand = {b for b in robot_bodies if b in gripper.bodies or not model.speeds_of(b, gripper.hand)}
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
    """Check of paths in one state, of one object."""

    def __init__(
        self,
        contacts: PathContacts,
        paths: CartesianPaths,
        state: State,
        grasps: Sequence[Grasp],
        values: Array,
        handles: Array,
    ) -> None:
        self.contacts, self.paths, self.state, self.grasps = contacts, paths, state, grasps
        self.values, self.handles = values, handles
        self.free: npt.NDArray[np.int_] = np.full(len(grasps), len(values) - 1)
        self.reasons = Counter[str]()
        gripper, handle = grasps[0].gripper, grasps[0].handle
        self._gripper, self._frame = gripper, handle.frame
        self._columns: tuple[Symbol, ...] = (
            *paths.moving, *paths.still, *gripper.joints, handle.coordinate,
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
            (self._rows(back, base, opened, np.full(len(back), self.values[0])), self._frame, True),
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
        lines = draw_retreats(grasp, self.handles[end], self.handles[end] @ grasp.pose, _LINE)
        count = len(lines)
        paths, reached = self.paths.follow(np.tile(Q, (count, 1)), np.tile(base, (count, 1)), lines)
        opened = self._gripper.opened
        blocked = False
        for k in np.argsort(-reached, kind="stable"):
            path = paths[k, : reached[k]]
            if len(path) < _LEAST_RETREAT:
                break
            rows = self._rows(path, base, opened, np.full(len(path), self.values[end]))
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
        """Return rows of everything that moves (N, n), with some between neighbouring ones."""
        fixed = [*base, *(fingers[s] for s in self._gripper.joints)]
        full = np.hstack([Q, np.tile(fixed, (len(Q), 1)), values[:, None]])
        share = np.arange(_BETWEEN) / _BETWEEN
        dense = full[:-1, None] + share[:, None] * (full[1:] - full[:-1])[:, None]
        return np.vstack([dense.reshape(-1, full.shape[1]), full[-1:]])

    def _find(self, rows: Array, handle: str, *, opened: bool) -> int | None:
        return self.contacts.first(self.state, self._columns, rows, handle, opened=opened)

    def _note(self) -> str:
        one, other = self.contacts.touching()
        self.reasons[f"{one} at {other}"] += 1
        return one


def draw_retreats(grasp: Grasp, world_T_handle: Array, world_T_hand: Array, count: int) -> Array:
    """Return straight retreats (N, L, 4, 4): the reversed approach of a grasp, and others along the bar."""
    out, bar = grasp.approach[:3, 3] - grasp.pose[:3, 3], grasp.handle.pose[:3, 2]
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
