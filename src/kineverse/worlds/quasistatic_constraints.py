"""Constraints of a quasi-static step: gaps between bodies, limits, locks and closures of objects, springs.

What a robot moves pushes other furniture along, and stops where that cannot yield. It does not push what
its contact jams: where the normal is 60° or more off the motion that a coordinate causes there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from kineverse._checks import finite_number
from kineverse.compilation import compile
from kineverse.expressions.expression import array
from kineverse.geometry.distance_queries import PreparedQuery
from kineverse.geometry.results import DistanceResults
from kineverse.lie import Array
from kineverse.model.constraint import Constraint
from kineverse.model.frame_dependence import FrameDependence
from kineverse.model.model_view import ModelView
from kineverse.model.projection import is_equality
from kineverse.model.velocity_constraints.velocity_rows import Recovery, VelocityRows, velocity_rows
from kineverse.symbols import Symbol

from .furniture_overlaps import OVERLAP, FurnitureOverlaps
from .robot import Robot

JAM = 0.5  # cosine of the angle between a normal and the motion that it causes, below which a contact jams
_PARALLEL = 1e-3  # least eigenvalue of directions of motion that are not parallel


@dataclass(frozen=True, slots=True, eq=False)
class Gaps:
    """Gaps of near pairs of shapes and their derivatives."""

    pairs: DistanceResults  # pairs as the scene found them, nearest first
    index: npt.NDArray[np.intp]  # (K,) indices of the gaps among these pairs
    distances: Array  # (K,) gaps [m]
    rows: Array  # (K, n) derivatives by the displacement of all columns
    jammed: npt.NDArray[np.bool_]  # (K,) flags of contacts that move no object


def align_motion(normal: Array, point: Array, twists: Array) -> float:
    """Return the largest cosine of the angle between a normal and the motions of a point by twists (6, n)."""
    motions = twists[:3] + np.cross(twists[3:].T, point).T
    lengths = np.linalg.norm(motions, axis=0)
    moves = (lengths > 0.0) & np.isfinite(lengths)
    motions = motions[:, moves] / lengths[moves]
    values, directions = np.linalg.eigh(motions @ motions.T)
    return float(np.linalg.norm(normal @ directions[:, values > _PARALLEL]))


def pair_keys(pairs: DistanceResults) -> list[tuple[int, ...]]:
    """Return the numbers of bodies and shapes of pairs."""
    return [tuple(row) for row in np.hstack([pairs.body_indices, pairs.shape_indices]).tolist()]


def project_twists(normals: Array, points: Array, twists: Array) -> Array:
    """Return n·(v + ω × p) for each of K points and each column: (K, 3), (K, 3), (K, 6, n) -> (K, n)."""
    (nx, ny, nz), (px, py, pz) = normals.T, points.T
    wrench = np.empty((len(normals), 1, 6))
    wrench[:, 0, :3] = normals
    wrench[:, 0, 3] = py * nz - pz * ny
    wrench[:, 0, 4] = pz * nx - px * nz
    wrench[:, 0, 5] = px * ny - py * nx
    return np.asarray((wrench @ twists)[:, 0])


_EXACT = 1e-6  # excess of a limit that is a matter of rounding, and is taken back

_HARMLESS = ("nothing that moves changes it", "it has no bounds")
_STEP = Symbol("world/step", 0, "parameter", 0.01)

Rows: TypeAlias = tuple[Array, Array, Array, Array]  # matrix (m, n), bounds, excess (m,)


class ObjectLimits:
    """Limits of objects as rows ``lower <= A v <= upper`` in their speeds over a step.

    A limit of a position that is exceeded at first moves nothing by itself. What a motion exceeds it by is
    taken back by the next one: :meth:`begin`, then :meth:`position_rows` where the motion leads, then
    :meth:`finish`. Limits of accelerations are no rows.
    """

    def __init__(
        self,
        model: ModelView,
        speeds: Sequence[Symbol],
        robot: Robot,
        leave_out: Collection[str] = (),
    ) -> None:
        # Those of the robot alone have no entries in the columns, and are no rows.
        kept = {n: c for n, c in model.constraints.items() if n not in leave_out}
        closures = {n: c for n, c in kept.items() if is_equality(c)}
        limits = {n: c for n, c in kept.items() if c.order == 0 and n not in closures}
        rates = {n: c for n, c in kept.items() if c.order == 1}
        # A closure has to close.
        sets: list[tuple[Mapping[str, Constraint], Recovery]] = [
            (closures, "required"), (limits, "allowed"), (rates, "allowed")
        ]  # fmt: skip
        rows = [
            velocity_rows(these, _STEP, rates=model.rates, speeds=speeds, recovery=recovery)
            for these, recovery in sets
        ]
        skipped = [(n, "accelerations are not limited") for n, c in kept.items() if c.order > 1]
        skipped += [pair for each in rows for pair in each.skipped if pair[1] not in _HARMLESS]
        others = {n for n, c in kept.items() if not all(robot.moves(s) for s in c.symbols)}
        self.skipped = tuple(pair for pair in skipped if pair[0] in others)
        place = {s: k for k, s in enumerate(model.symbols)}
        self._positions, self._rates = (
            _CompiledRows(parts, len(speeds), place) for parts in (rows[:2], rows[2:])
        )
        self._linked = _link_columns(len(speeds), (self._positions.pattern, self._rates.pattern))
        self._found: dict[bytes, tuple[npt.NDArray[np.intp], ...]] = {}
        self.reset()

    def find_linked(self, moved: npt.NDArray[np.bool_]) -> tuple[npt.NDArray[np.intp], ...]:
        """Return the indices of speeds linked to flagged ones by rows, and of these rows."""
        key = moved.tobytes()
        if key not in self._found:
            linked = moved | self._linked[moved].any(axis=0)
            patterns = (self._positions.pattern, self._rates.pattern)
            rows = [np.flatnonzero(pattern[:, linked].any(axis=1)) for pattern in patterns]
            self._found[key] = np.flatnonzero(linked), *rows
        return self._found[key]

    def link(self, moved: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
        """Return the flags of speeds that share rows with flagged ones, and of these."""
        return moved | np.asarray(self._linked[moved].any(axis=0))

    def reset(self) -> None:
        """Forget what the last motion exceeded."""
        self._exceeded = np.zeros((2, len(self._positions.pattern)))

    def begin(self, q: Array, h: float) -> Rows:
        """Begin a motion at values of the model's symbols, and return the rows of speeds for h [s]."""
        below, above = self._exceeded
        excess = self._positions.evaluate(q, h)[3]
        self._excess = np.minimum(excess + below, 0.0) + np.maximum(excess - above, 0.0)
        self._excess[np.abs(self._excess) < _EXACT] = 0.0
        return self._rates.evaluate(q, h)

    def position_rows(self, q: Array, h: float, v: Array) -> tuple[Rows, float]:
        """Return the rows of positions where speeds v led, and the squares of the growth of excesses."""
        matrix, lower, upper, excess = self._positions.evaluate(q, h)
        below, above = _growth(self._excess, excess)
        shift = matrix @ v
        rows = matrix, lower + below / h + shift, upper - above / h + shift, excess
        return rows, float(below @ below + above @ above)

    def finish(self, q: Array, h: float) -> None:
        """End a motion, and remember what it exceeds."""
        self._exceeded = np.array(_growth(self._excess, self._positions.evaluate(q, h)[3]))


class _CompiledRows:
    """Rows as a function of the model's symbols and the time of a step."""

    def __init__(self, parts: Sequence[VelocityRows], count: int, place: Mapping[Symbol, int]) -> None:
        rows = [row for part in parts for row in part.rows]
        columns = parts[0].speeds
        self.pattern = np.array([[s in row.weights for s in columns] for row in rows], dtype=bool)
        self.pattern = self.pattern.reshape(len(rows), count)
        self._values: Rows = np.zeros((0, count)), np.zeros(0), np.zeros(0), np.zeros(0)
        self._evaluator: Any = None
        if not rows:
            return
        matrix = array([row.weights.get(s, 0.0) for row in rows for s in columns])
        ends = [array([getattr(row, end) for row in rows]) for end in ("lower", "upper", "violation")]
        function = compile([matrix.reshape(len(rows), count), *ends])
        self._step = np.array([s == _STEP for s in function.inputs], dtype=bool)
        self._source = np.array([place[s] for s in function.inputs if s != _STEP], dtype=np.intp)
        self._evaluator = function.bind()

    def evaluate(self, q: Array, h: float) -> Rows:
        """Return the rows at values of the model's symbols for a step of h [s]."""
        if self._evaluator is None:
            return self._values
        self._evaluator.input[~self._step] = q[self._source]
        self._evaluator.input[self._step] = h
        self._evaluator()
        matrix, lower, upper, excess = (out.copy() for out in self._evaluator.outputs)
        return matrix, lower, upper, excess


def _growth(before: Array, now: Array) -> tuple[Array, Array]:
    """Return the growth of signed excesses below lower and above upper bounds, (m,) each."""
    below = np.minimum(before, 0.0) - np.minimum(now, 0.0)
    above = np.maximum(now, 0.0) - np.maximum(before, 0.0)
    return np.maximum(below, 0.0), np.maximum(above, 0.0)


def _link_columns(count: int, patterns: Sequence[npt.NDArray[np.bool_]]) -> npt.NDArray[np.bool_]:
    """Return (n, n) flags of columns that share a row, directly or by others."""
    linked = np.eye(count, dtype=bool)
    for pattern in patterns:
        for row in pattern:
            linked[np.ix_(row, row)] = True
    for k in range(count):  # transitive closure (Warshall)
        linked |= np.outer(linked[:, k], linked[k])
    return linked


_UNLIMITED = 1.0  # speed of a spring whose coordinate has no limit of its speed [m/s], [rad/s]
_LIFT = (2, 3, 4)  # rows of a twist that lift something: v_z, w_x, w_y
_LIFTS = 1e-9
_RELAXED = 1e-9  # distance of a spring from its rest that counts as none [m], [rad]


class ObjectSprings:
    """Springs of objects, as the articulations state them by stiffness k, rest r and friction f.

    A spring moves its coordinate q until its force k (r - q) is at most the friction, with the limit of the
    speed. A spring whose coordinate lifts something with a stated mass carries a weight. This is not known
    here, so such a spring does nothing.
    """

    def __init__(self, model: ModelView, speeds: Sequence[Symbol], robot: Robot) -> None:
        place = {s: k for k, s in enumerate(model.symbols)}
        found: list[tuple[int, int, float, float, float]] = []
        skipped: list[str] = []
        for record in model.articulations.values():
            for q in record.coordinates:
                known, v = record.dynamics_of(q), q.derivative()
                stiffness = finite_number(known.get("spring_stiffness", known.get("stiffness")))
                rest = finite_number(known.get("spring_reference", known.get("rest", 0.0)))
                friction = finite_number(known.get("friction", 0.0))
                if v not in speeds or rest is None or friction is None:
                    continue
                if stiffness is None or not stiffness > 0.0:
                    continue
                if _carries_weight(model, v, robot):
                    skipped.append(str(q))
                    continue
                slack, fastest = friction / stiffness, float(np.abs(model.limits(v)).min())
                speed = fastest if 0.0 < fastest < math.inf else _UNLIMITED
                found.append((speeds.index(v), place[q], rest - slack, rest + slack, speed))
        self.skipped = tuple(skipped)
        self._count = len(speeds)
        columns = np.array(found, dtype=float).reshape(-1, 5).T
        self._columns, self._places = columns[0].astype(np.intp), columns[1].astype(np.intp)
        self._low, self._high, self._speeds = columns[2:]
        limits = [model.limits(model.symbols[k]) for k in self._places.tolist()]
        self._limits = np.array(limits, dtype=float).reshape(-1, 2).T
        others = [k for k, s in enumerate(model.symbols) if not robot.moves(s)]
        self._others = np.array(others, dtype=np.intp)
        self._blocked: Array | None = None

    def reset(self) -> None:
        """Forget where springs were blocked."""
        self._blocked = None

    def wish(self, q: Array, h: float) -> Array:
        """Return the speeds (n,) with which springs move objects at values of the symbols in a time h [s]."""
        result = np.zeros(self._count)
        if not len(self._columns) or (
            self._blocked is not None and np.array_equal(self._blocked, q[self._others])
        ):
            return result
        at = q[self._places]
        target = np.clip(np.clip(at, self._low, self._high), *self._limits)
        way = np.where(np.abs(target - at) < _RELAXED, 0.0, target - at)
        result[self._columns] = np.clip(way / h, -self._speeds, self._speeds)
        return result

    def block(self, q: Array) -> None:
        """Note that limits alone keep all springs where they are, until another object moves."""
        self._blocked = q[self._others].copy()


def _carries_weight(model: ModelView, speed: Symbol, robot: Robot) -> bool:
    """Return whether a speed lifts a body of the objects with a stated mass."""
    motion, home = FrameDependence(model, [speed]), model.default_state()
    for name, body in model.bodies.items():
        if body.inertia is None or not body.inertia.mass > 0.0 or robot.owns(name) or not motion.moves(name):
            continue
        twist = compile(model.jacobian(name, form="world", symbols=[speed]), tier="interpreter")(home)
        if (np.abs(twist[_LIFT, 0]) > _LIFTS).any():
            return True
    return False


RESTING = OVERLAP / 2  # depth beyond the allowance at which furniture stops [m]: resting shapes slide freely
_REACH = 0.001  # largest gap of pairs that have met [m]

Flags = npt.NDArray[np.bool_]


class FurnitureGaps(NamedTuple):
    """Gaps of pairs of shapes of furniture that meet."""

    distances: Array  # (K,) distances to where the shapes stop [m]
    rows: Array  # (K, n) derivatives by the displacement of objects
    jammed: Flags  # (K,) flags of contacts that move nothing
    moved: Flags  # (n,) flags of coordinates that move, those that are pushed along included


class FurnitureContacts:
    """Search of the gaps of furniture that moves."""

    def __init__(
        self,
        overlaps: FurnitureOverlaps,
        speeds: Sequence[Symbol],
        group: npt.NDArray[np.intp],
        twists: Callable[[], Array],
        link: Callable[[Flags], Flags],
    ) -> None:
        self._overlaps, self._speeds, self._group = overlaps, tuple(speeds), group
        self._twists, self._link = twists, link
        self._queries: dict[bytes, PreparedQuery] = {}
        self._met: set[int] = set()

    def begin(self) -> None:
        """Begin a motion, in which nothing has met anything so far."""
        self._met.clear()

    def measure(self, driven: Flags, moved: Flags) -> FurnitureGaps:
        """Return the gaps of what moves, and of what it pushes, to all that it has met in this motion."""
        n, moved = len(self._speeds), self._link(moved)
        while True:
            pairs = self._query(moved)(_REACH)
            index = self._select(pairs)
            if not len(index):
                return FurnitureGaps(np.zeros(0), np.zeros((0, n)), np.zeros(0, dtype=bool), moved)
            distances = (pairs.distances + self._overlaps.allowances(pairs))[index] + RESTING
            twists = self._twists()[:, :, :n]
            a, b = self._group[pairs.body_indices[index]].T
            normals, of_a, of_b = pairs.normals[index], twists[a], twists[b]
            rows = project_twists(normals, pairs.points_b[index], of_b)
            rows -= project_twists(normals, pairs.points_a[index], of_a)
            jammed, driven = np.zeros(len(index), dtype=bool), self._link(driven)
            for k in np.flatnonzero(distances < 0.0).tolist():
                relative, point = of_b[k] - of_a[k], pairs.points_b[index[k]]
                motions = np.linalg.norm(relative[:3] + np.cross(relative[3:].T, point).T, axis=0)
                yields = driven | (np.abs(rows[k]) >= JAM * motions)
                jammed[k] = not rows[k, yields].any()
                if not jammed[k]:
                    rows[k, ~yields] = 0.0
            pushed = (rows[distances < 0.0] != 0.0).any(axis=0) & ~moved
            if not pushed.any():
                rows[:, ~moved] = 0.0
                return FurnitureGaps(distances, rows, jammed, moved)
            moved = self._link(moved | pushed)

    def _select(self, pairs: DistanceResults) -> npt.NDArray[np.intp]:
        """Return the indices of the pairs that have met in this motion."""
        if not len(pairs):
            return np.zeros(0, dtype=np.intp)
        meets = pairs.distances + self._overlaps.allowances(pairs) < -RESTING
        if not self._met and not meets.any():
            return np.zeros(0, dtype=np.intp)
        codes = self._overlaps.encode(pairs).tolist()
        self._met.update(code for code, new in zip(codes, meets.tolist(), strict=True) if new)
        return np.array([k for k, code in enumerate(codes) if code in self._met], dtype=np.intp)

    def _query(self, moved: Flags) -> PreparedQuery:
        """Return the query for what some coordinates move, and counts since the start."""
        key = moved.tobytes() + self._overlaps.counting.tobytes()
        if key not in self._queries:
            speeds = [v for v, flag in zip(self._speeds, moved.tolist(), strict=True) if flag]
            self._queries[key] = self._overlaps.watch(speeds)
        return self._queries[key]
