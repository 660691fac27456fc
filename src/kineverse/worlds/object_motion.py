"""Least motion of objects that keeps a robot out of them, in a world without forces.

Let g be the gaps between bodies of the robot and bodies of objects after the robot has moved for a time h,
and G their derivative by the displacement of the objects. The speeds v of the objects solve

    min  1/2 Σ w_i v_i² + 1/(2ρ) Σ s_k²    subject to    g + h G v + s >= 0,    l <= A v <= u

with the rows A of the model's limits, locks and closures. There is no friction: an object is pushed along the
normal, and stays where nothing touches it. The slacks s are zero unless the object is blocked; then the
penetration remains. The weights w are the squares of the speeds that coordinates give to points of bodies, so
rotations and translations compare. The problem is linear in the neighbourhood of a configuration, and it is
solved again where it led, until nothing changes (sequential quadratic programming).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from kineverse._extras import install_command
from kineverse.compile import compile  # noqa: A004
from kineverse.errors import MissingDependencyError
from kineverse.expressions.expression import Expression, array, as_expression
from kineverse.geometry import Scene
from kineverse.geometry.results import DistanceResults
from kineverse.lie import Array
from kineverse.model.constraint import Constraint
from kineverse.model.frame_dependence import FrameDependence
from kineverse.model.model_view import ModelView
from kineverse.model.projection import is_equality
from kineverse.model.velocity_rows import Recovery, VelocityRows, velocity_rows
from kineverse.symbols import Symbol

SKIN = 1e-6
"""Gap to which objects are pushed [m]: below, normals of nearest points are not determined."""

_REACH = 0.005
"""Distance beyond the robot's motion up to which gaps are rows [m]."""
_ROUNDS = 8
_STEADY = 1e-8
"""Change of displacements below which a solution is final [m]."""
_SLACK = 1e-7
"""Reciprocal ρ of the weight of slacks, beside weights near 1 kg of least motion."""
_HELD = 1e-7
"""Weight of least motion beside the error of a hold."""
_LIGHTEST = 1e-4
_STEP = Symbol("world/step", 0, "parameter", 0.01)

Residual = Callable[[], tuple[Array, Array]]
"""Function that returns the error of a hold at the present configuration, (6,), and its Jacobian (6, n)."""


@dataclass(frozen=True, slots=True, eq=False)
class Gaps:
    """Gaps of near pairs of shapes and their derivatives.

    Attributes
    ----------
    pairs
        The pairs as the scene found them, nearest first.
    index
        (K,) indices of the gaps among these pairs.
    distances
        (K,) gaps [m].
    rows
        (K, n) derivatives by the displacement of all columns.
    """

    pairs: DistanceResults
    index: npt.NDArray[np.intp]
    distances: Array
    rows: Array

    @property
    def least(self) -> float:
        """Least gap [m]; infinite without any."""
        return float(self.distances.min(initial=np.inf))


class ObjectMotion:
    """Bodies of a robot and of objects at a configuration, and the motion of the objects.

    Parameters
    ----------
    scene
        Collision scene of the model; its poses are those of the last configuration.
    speeds
        Speeds of objects.
    fingers
        Speeds of the robot's fingers, columns after those of the objects.
    is_robot
        Function that tells frames of the robot.
    leave_out
        Names of constraints that do not hold here.

    Attributes
    ----------
    q
        Values of the model's symbols, in their order; changed in place.
    columns
        Speeds of objects, then those of fingers.
    robot_bodies, object_bodies
        Bodies with shapes: those of the robot, and those that objects move.
    skipped
        Constraints of objects that cannot be enforced, as pairs (name, reason).
    """

    def __init__(
        self,
        scene: Scene,
        speeds: Sequence[Symbol],
        fingers: Sequence[Symbol],
        is_robot: Callable[[str], bool],
        leave_out: Collection[str] = (),
    ) -> None:
        self.scene, self._daqp = scene, _import_daqp()
        model: ModelView = scene.model
        self.symbols, self.count = model.symbols, len(speeds)
        self.columns = (*speeds, *fingers)
        self._place = {s: k for k, s in enumerate(self.symbols)}
        self.q: Array = model.default_state().vector(self.symbols)
        motion = FrameDependence(model, speeds)
        self.robot_bodies = tuple(b for b in scene.bodies if is_robot(b))
        self.object_bodies = tuple(b for b in scene.bodies if not is_robot(b) and motion.moves(b))
        self._query = scene.watch(self.robot_bodies, self.object_bodies, per_shape=True)
        self._ignored = np.zeros((len(scene.bodies),) * 2, dtype=bool)
        self._inputs = self._indices(scene.inputs)
        owners = scene.collision_world.table.body
        moving = np.array([is_robot(b) for b in scene.bodies], dtype=bool)
        self._robot_objects = np.flatnonzero(moving[owners[: scene.collision_world.table.moving]])
        self._compile_twists(model)
        self._integrate = model.integrator(speeds, self.symbols)
        self.skipped: tuple[tuple[str, str], ...] = ()
        self._compile_rows(model, speeds, frozenset(leave_out))
        self.place(self.q)
        self.weights = self._weigh()

    def _compile_twists(self, model: ModelView) -> None:
        """Compile the spatial twists of groups of bodies that move together, over all columns."""
        motion, bodies = FrameDependence(model, self.columns), self.scene.bodies
        concerned = {*self.robot_bodies, *self.object_bodies}
        moved = [motion.moving_ancestors(b) if b in concerned else () for b in bodies]
        groups = {group: k for k, group in enumerate(dict.fromkeys(((), *moved)))}
        self.group = np.array([groups[group] for group in moved], dtype=np.intp)
        members = dict(zip(moved, bodies, strict=True))
        n = len(self.columns)
        twists: list[Expression] = [as_expression(np.zeros((6, n)))]
        twists += [model.jacobian(members[g], form="world", symbols=self.columns) for g in groups if g]
        stacked = array([e for t in twists for e in t.ravel()]).reshape(len(twists), 6, n)
        function = compile([stacked])
        self._twist_inputs, self._twists = self._indices(function.inputs), function.bind()

    def _compile_rows(self, model: ModelView, speeds: Sequence[Symbol], leave_out: frozenset[str]) -> None:
        """Compile the rows of positions, and those of speeds."""
        found = model.constraints_for(speeds) if speeds else {}
        kept = {n: c for n, c in found.items() if n not in leave_out}
        closures = {n: c for n, c in kept.items() if is_equality(c)}
        limits = {n: c for n, c in kept.items() if c.order == 0 and n not in closures}
        rates = {n: c for n, c in kept.items() if c.order == 1}
        # A limit that is exceeded already moves nothing by itself. A closure has to close.
        sets: list[tuple[dict[str, Constraint], Recovery]] = [
            (closures, "required"), (limits, "allowed"), (rates, "allowed")
        ]  # fmt: skip
        rows = [
            velocity_rows(these, _STEP, rates=model.rates, speeds=speeds, recovery=recovery)
            for these, recovery in sets
        ]
        self.skipped = tuple((n, "accelerations are not limited") for n, c in kept.items() if c.order > 1)
        self.skipped += tuple(pair for each in rows for pair in each.skipped)
        self._positions, self._rates = (
            _CompiledRows(parts, len(speeds), self._indices) for parts in (rows[:2], rows[2:])
        )
        self._linked = _link_columns(len(speeds), (self._positions.pattern, self._rates.pattern))

    def _indices(self, symbols: Iterable[Symbol]) -> npt.NDArray[np.intp]:
        return np.array([self._place[s] for s in symbols], dtype=np.intp)

    def _weigh(self) -> Array:
        """Return the squares of the largest speeds that columns give to points of bodies, at this place."""
        self._evaluate_twists()
        twists, table = self._twists.outputs[0], self.scene.collision_world.table
        weights = np.full(len(self.columns), _LIGHTEST)
        self._query(0.0)  # Sizes are known from the first query on.
        for k, body in enumerate(table.body.tolist()):
            v, w = twists[self.group[body], :3], twists[self.group[body], 3:]
            at = table.position[k]
            speed = (
                np.linalg.norm(v + np.cross(w.T, at).T, axis=0) + np.linalg.norm(w, axis=0) * table.radius[k]
            )
            np.maximum(weights, speed**2, out=weights)
        return weights

    def place(self, q: Array) -> None:
        """Set the configuration."""
        self.q[:] = q
        self.scene.update(self.q[self._inputs])

    def travel(self) -> Array:
        """Return the way that each shape of the robot has gone so far, at most [m]."""
        found: Array = self.scene.collision_world.table.travel[self._robot_objects]
        return found

    def ignore(self, ones: Iterable[str] = (), others: Iterable[str] = ()) -> None:
        """Ignore pairs of one body each, in place of those that were ignored before."""
        self._ignored[:] = False
        number = {b: k for k, b in enumerate(self.scene.bodies)}
        for a in ones:
            for b in others:
                if a in number and b in number:
                    self._ignored[number[a], number[b]] = self._ignored[number[b], number[a]] = True

    def find_near(self, radius: float) -> tuple[DistanceResults, npt.NDArray[np.intp]]:
        """Return the pairs within a radius [m], and the indices of those that are not ignored."""
        found = self._query(radius)
        if not len(found):
            return found, np.zeros(0, dtype=np.intp)
        i, j = found.body_indices.T
        return found, np.flatnonzero(~self._ignored[i, j])

    def measure_gaps(self, radius: float) -> Gaps:
        """Return the gaps within a radius [m] with their derivatives."""
        pairs, index = self.find_near(radius)
        if not len(index):
            return Gaps(pairs, index, np.zeros(0), np.zeros((0, len(self.columns))))
        self._evaluate_twists()
        twists = self._twists.outputs[0]
        a, b = self.group[pairs.body_indices[index]].T
        normals = pairs.normals[index]
        rows = _project(normals, pairs.points_b[index], twists[b])
        rows -= _project(normals, pairs.points_a[index], twists[a])
        return Gaps(pairs, index, pairs.distances[index], rows)

    def twist(self, body: str) -> Array:
        """Return the spatial twist of a body by the speeds of objects, (6, n)."""
        self._evaluate_twists()
        found: Array = self._twists.outputs[0][self.group[self.scene.bodies.index(body)], :, : self.count]
        return found

    def _evaluate_twists(self) -> None:
        self._twists.input[:] = self.q[self._twist_inputs]
        self._twists()

    def resolve(self, h: float, moved: float, residual: Residual | None = None) -> Array:
        """Move the objects after the robot has moved, and return their speeds (n,).

        Parameters
        ----------
        h
            Time of the motion [s].
        moved
            Largest way of a shape of the robot [m].
        residual
            Error of a hold, which the objects that reduce it follow.
        """
        n, start = self.count, self.q.copy()
        v, radius = np.zeros(n), moved + _REACH
        limits = self._rates.evaluate(start, h)
        for _ in range(_ROUNDS):
            gaps = self.measure_gaps(radius)
            if residual is None and not v.any() and gaps.least >= 0.0:
                break
            pulled = None if residual is None else residual()
            found = self._solve(h, v, gaps, limits, pulled)
            change = float(np.max(np.abs(found - v) * np.sqrt(self.weights[:n]), initial=0.0)) * h
            v = found
            self.place(self._integrate(start, v, h))
            if change <= _STEADY:
                break
        return v

    def _solve(
        self,
        h: float,
        v: Array,
        gaps: Gaps,
        limits: tuple[Array, Array, Array],
        pulled: tuple[Array, Array] | None,
    ) -> Array:
        """Return the speeds of one linearisation at speeds v."""
        n = self.count
        G, d = gaps.rows[:, :n], gaps.distances
        active = (G != 0.0).any(axis=0) | (v != 0.0)
        if pulled is not None:
            active |= (pulled[1] != 0.0).any(axis=0)
        active = self._linked[active].any(axis=0)
        use = np.flatnonzero(active)
        if not len(use):
            return v
        weight = self.weights[use]
        H, f = np.diag(weight), np.zeros(len(use))
        if pulled is not None:
            error, J = pulled[0] / h, pulled[1][:, use]
            mine = (J != 0.0).any(axis=0)
            H[mine, mine] *= _HELD
            H += J.T @ J
            f += J.T @ (error - J @ v[use])
        A, low, high = self._positions.evaluate(self.q, h)
        shift = A @ v
        B, slow, fast = limits
        matrix, lower, upper = (
            np.concatenate(parts) for parts in ((A, B), (low + shift, slow), (high + shift, fast))
        )
        concerned = (matrix[:, use] != 0.0).any(axis=1)
        touching = (G != 0.0).any(axis=1)
        G, d = G[touching], d[touching]
        # Shapes that nearly touch stay as they are: what is not penetrated does not move by itself.
        aim = np.where(d < 0.0, SKIN, np.minimum(d, SKIN))
        rows = np.concatenate([matrix[concerned][:, use], G[:, use]])
        least = np.concatenate([lower[concerned], (aim - d) / h + G @ v])
        most = np.concatenate([upper[concerned], np.full(len(d), _UNBOUNDED)])
        sense = np.zeros(len(rows), dtype=np.intc)
        sense[len(rows) - len(d) :] = _SOFT
        np.clip(least, -_UNBOUNDED, _UNBOUNDED, out=least)
        np.clip(most, -_UNBOUNDED, _UNBOUNDED, out=most)
        x, _, flag, _ = self._daqp.solve(
            H, f, np.ascontiguousarray(rows), most, least, sense,
            rho_soft=_SLACK, primal_tol=1e-10, sing_tol=1e-14,
        )  # fmt: skip
        found = np.zeros(n)
        if flag >= 1 and np.isfinite(x).all():
            found[use] = x
        return found


_SOFT, _UNBOUNDED = 8, 1e9


class _CompiledRows:
    """Rows as a function of the model's symbols and the time of a step."""

    def __init__(
        self,
        parts: Sequence[VelocityRows],
        count: int,
        indices: Callable[[Iterable[Symbol]], npt.NDArray[np.intp]],
    ) -> None:
        rows = [row for part in parts for row in part.rows]
        columns = parts[0].speeds
        self.pattern = np.array([[s in row.weights for s in columns] for row in rows], dtype=bool)
        self.pattern = self.pattern.reshape(len(rows), count)
        self._values = np.zeros((0, count)), np.zeros(0), np.zeros(0)
        self._evaluator: Any = None
        if not rows:
            return
        matrix = array([row.weights.get(s, 0.0) for row in rows for s in columns])
        ends = (array([row.lower for row in rows]), array([row.upper for row in rows]))
        function = compile([matrix.reshape(len(rows), count), *ends])
        self._step = np.array([s == _STEP for s in function.inputs], dtype=bool)
        self._source = indices(s for s in function.inputs if s != _STEP)
        self._evaluator = function.bind()

    def evaluate(self, q: Array, h: float) -> tuple[Array, Array, Array]:
        """Return matrix, lower and upper bounds at values of the model's symbols for a step of h [s]."""
        if self._evaluator is None:
            return self._values
        self._evaluator.input[~self._step] = q[self._source]
        self._evaluator.input[self._step] = h
        self._evaluator()
        matrix, lower, upper = (out.copy() for out in self._evaluator.outputs)
        return matrix, lower, upper


def _link_columns(count: int, patterns: Iterable[npt.NDArray[np.bool_]]) -> npt.NDArray[np.bool_]:
    """Return (n, n) flags of columns that share a row, directly or by others."""
    linked = np.eye(count, dtype=bool)
    for pattern in patterns:
        for row in pattern:
            linked[np.ix_(row, row)] = True
    for k in range(count):  # transitive closure (Warshall)
        linked |= np.outer(linked[:, k], linked[k])
    return linked


def _project(normals: Array, points: Array, twists: Array) -> Array:
    """Return n·(v + ω × p) for each of K points and each column: (K, 3), (K, 3), (K, 6, n) -> (K, n)."""
    wrenches = np.concatenate([normals, np.cross(points, normals)], axis=1)
    return np.asarray(np.einsum("ki,kij->kj", wrenches, twists))


def _import_daqp() -> Any:
    try:
        import daqp
    except ImportError as error:
        raise MissingDependencyError(
            f"The kinematic world needs daqp: {install_command('control')}"
        ) from error
    return daqp
