"""Least motion of objects that keeps a robot out of them, in a world without forces.

Let g be the gaps between bodies of the robot and bodies of objects after the robot has moved for a time h,
and G their derivative by the displacement of the objects. The speeds v of the objects solve

    min  1/2 Σ w_i v_i² + 1/(2ρ) Σ s_k²    subject to    g + h G v + s >= 0,    l <= A v <= u

with the rows A of the model's limits, locks and closures. An object is pushed along the normal, and stays
where nothing touches it. A contact jams if its normal is 60° or more off all motions that the object has at
that point, as with a friction of 0.58: then it does not move the object. What was penetrated before comes
free at 0.1 m/s at most. So a contact moves an object's point there by at most twice the sum of the robot's
motion and that retreat. The slacks s are zero unless the object is blocked; then the penetration remains. The
weights w are the squares of the speeds that coordinates give to points of bodies, so rotations and
translations compare. The problem is linear in the neighbourhood of a configuration, and it is solved again
where it led, until nothing changes (sequential quadratic programming).

What the robot moves does not run through other furniture: gaps between furniture are rows of the same kind
with slacks of more weight, so that the robot penetrates an object that something else blocks, and the object
does not penetrate that.

A spring that its friction does not hold moves its coordinate with a speed u that takes the place of rest: the
cost is 1/2 Σ w_i (v_i - u_i)². So the robot is stronger than any spring, and a body in the hand follows the
hand.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Sequence
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from kineverse._extras import install_command
from kineverse.compilation import compile
from kineverse.errors import MissingDependencyError
from kineverse.expressions.expression import Expression, array, as_expression
from kineverse.geometry import Scene
from kineverse.geometry.results import DistanceResults
from kineverse.lie import Array
from kineverse.model.frame_dependence import FrameDependence
from kineverse.model.model_view import ModelView
from kineverse.symbols import Symbol

from .furniture_overlaps import FurnitureOverlaps
from .quasistatic_constraints import (
    JAM,
    FurnitureContacts,
    FurnitureGaps,
    Gaps,
    ObjectLimits,
    ObjectSprings,
    Rows,
    align_motion,
    pair_keys,
    project_twists,
)
from .robot import Robot
from .simulated_world import DEEPER

SKIN = 1e-6  # gap to which objects are pushed [m]: below, normals of nearest points are not determined
_REACH = 0.005  # distance beyond the robot's motion up to which gaps are rows [m]
_ROUNDS = 10
_STEADY = 2e-7  # change of displacements below which a solution is final [m]
_SLACK = 1e-7  # reciprocal ρ of the weight of slacks; weights of least motion are near 1 kg
_HARD = 1e-10  # reciprocal weight of exceeded limits, where solutions of curved problems are compared
_HELD = 1e-7  # weight of least motion relative to the error of a hold
_LIGHTEST = 1e-4
_DEEP = 1e-4  # penetration of what does not yield, from which on its side is remembered [m]
_RELEASE = 0.1  # largest speed out of a penetration that was there before a motion [m/s]
_FIRM = 100.0  # weight of gaps between furniture relative to the robot: so it is the robot that penetrates
Residual: TypeAlias = Callable[[], tuple[Array, Array]]  # error of a hold (6,), Jacobian (6, n)


class ObjectMotion:
    """Bodies of a robot and of objects at a configuration, and the motion of the objects."""

    def __init__(
        self,
        overlaps: FurnitureOverlaps,
        speeds: Sequence[Symbol],
        fingers: Sequence[Symbol],
        robot: Robot,
        leave_out: Collection[str] = (),
    ) -> None:
        scene: Scene = overlaps.scene
        self.scene, self.overlaps, self._daqp = scene, overlaps, _import_daqp()
        model: ModelView = scene.model
        self.symbols, self.count = model.symbols, len(speeds)
        self.columns = (*speeds, *fingers)
        self._place = {s: k for k, s in enumerate(self.symbols)}
        self.q: Array = model.default_state().vector(self.symbols)
        motion = FrameDependence(model, speeds)
        self.robot_bodies = tuple(b for b in scene.bodies if robot.owns(b))
        self.object_bodies = tuple(b for b in scene.bodies if not robot.owns(b) and motion.moves(b))
        self._penetrated: dict[tuple[int, ...], Array] = {}
        self._before: dict[tuple[int, ...], float] = {}
        self._query = scene.watch(self.robot_bodies, self.object_bodies, per_shape=True)
        self._ignored = np.zeros((len(scene.bodies),) * 2, dtype=bool)
        self._inputs = self._indices(scene.inputs)
        owners = scene.collision_world.table.body
        moving = np.array([robot.owns(b) for b in scene.bodies], dtype=bool)
        self._robot_objects = np.flatnonzero(moving[owners[: scene.collision_world.table.moving]])
        self._robot_owners = owners[self._robot_objects]
        self._compile_twists(model)
        self._integrate = model.integrator(speeds, self.symbols)
        self._limits = ObjectLimits(model, speeds, robot, leave_out)
        self.skipped = self._limits.skipped
        self.springs = ObjectSprings(model, speeds, robot)
        self._furniture = FurnitureContacts(
            overlaps, speeds, self.group, self._evaluate_twists, self._limits.link
        )
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

    def _indices(self, symbols: Iterable[Symbol]) -> npt.NDArray[np.intp]:
        return np.array([self._place[s] for s in symbols], dtype=np.intp)

    def _weigh(self) -> Array:
        """Return the squares of the largest speeds that columns give to points of bodies, at this place."""
        twists, table = self._evaluate_twists(), self.scene.collision_world.table
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

    def reset(self, q: Array) -> None:
        """Start again at a configuration."""
        self._penetrated.clear()
        self._limits.reset()
        self.springs.reset()
        self.place(q)
        self.overlaps.begin()
        self.ignore()

    def place(self, q: Array) -> None:
        """Set the configuration."""
        self.q[:] = q
        self._moved = True
        self.scene.update(self.q[self._inputs])

    def travel(self) -> Array:
        """Return the distances that shapes of the robot have moved so far, at most (K,) [m]."""
        travel: Array = self.scene.collision_world.table.travel[self._robot_objects]
        return travel

    def spring_travel(self, h: float) -> float:
        """Return the longest motion of a body by its spring in a time h [s], if nothing is in its way [m]."""
        motion = np.abs(self.springs.wish(self.q, h)) * np.sqrt(self.weights[: self.count])
        return float(motion.max(initial=0.0)) * h

    def longest_motion(self, moved: Array, radius: float) -> float | None:
        """Return the longest motion of a body in a pair within a radius [m]; None without such a pair."""
        pairs, index = self.find_near(radius)
        if not len(index):
            return None
        of_bodies = np.zeros(len(self.scene.bodies))
        np.maximum.at(of_bodies, self._robot_owners, moved)
        return float(of_bodies[pairs.body_indices[index]].max())

    def ignore(self, ones: Iterable[str] = (), others: Iterable[str] = ()) -> None:
        """Ignore pairs of one body each, in place of those that were ignored before."""
        self._ignored[:] = False
        number = {b: k for k, b in enumerate(self.scene.bodies)}
        for a in ones:
            for b in others:
                if a in number and b in number:
                    self._ignored[number[a], number[b]] = self._ignored[number[b], number[a]] = True
        self.settle()

    def settle(self) -> None:
        """End a motion: what is penetrated now comes free slowly."""
        pairs, index = self.find_near(0.0)
        keys = pair_keys(pairs) if len(index) else []
        self._before = {keys[k]: float(pairs.distances[k]) for k in index.tolist()}

    def displace(self, q: Array) -> tuple[str, str] | None:
        """Move objects to a configuration, unless that leads into a body: then return the two bodies."""
        self.settle()
        start, before = self.q.copy(), self._find_meeting()
        self.place(q)
        pairs, index = self.find_near(0.0)
        keys = pair_keys(pairs) if len(index) else []
        for k in index.tolist():
            if pairs.distances[k] < self._before.get(keys[k], 0.0) - DEEPER[0]:
                self.place(start)
                return pairs[k].a, pairs[k].b
        for pair, depth in self._find_meeting().items():
            if depth > before.get(pair, 0.0) + DEEPER[1]:
                self.place(start)
                return pair
        self.settle()
        return None

    def _find_meeting(self) -> dict[tuple[str, str], float]:
        """Return the depths of furniture in furniture by pair of bodies [m]."""
        found = reversed(self.overlaps.find_beyond(0.0))
        return {(one.a, one.b): -one.distance - allowed for one, allowed in found}

    def find_near(self, radius: float) -> tuple[DistanceResults, npt.NDArray[np.intp]]:
        """Return the pairs within a radius [m], and the indices of those that are not ignored."""
        result = self._query(radius)
        if not len(result):
            return result, np.zeros(0, dtype=np.intp)
        i, j = result.body_indices.T
        return result, np.flatnonzero(~self._ignored[i, j])

    def measure_gaps(self, radius: float) -> Gaps:
        """Return the gaps within a radius [m] with their derivatives.

        A shape that was penetrated does not separate on its other side: such pairs are left out until they
        are apart.
        """
        pairs, index = self.find_near(radius)
        if self._penetrated:
            index = self._same_side(pairs, index)
        if not len(index):
            none = np.zeros(0)
            return Gaps(pairs, index, none, np.zeros((0, len(self.columns))), none.astype(bool))
        twists = self._evaluate_twists()
        a, b = self.group[pairs.body_indices[index]].T
        normals, distances = pairs.normals[index], pairs.distances[index]
        rows = project_twists(normals, pairs.points_b[index], twists[b])
        rows -= project_twists(normals, pairs.points_a[index], twists[a])
        jammed, n = np.zeros(len(index), dtype=bool), self.count
        for k in np.flatnonzero(distances < 0.0).tolist():
            of_a, of_b = twists[a[k], :, :n], twists[b[k], :, :n]
            point, of_object = (pairs.points_b, of_b) if of_b.any() else (pairs.points_a, of_a)
            jammed[k] = align_motion(normals[k], point[index[k]], of_object) < JAM
        return Gaps(pairs, index, distances, rows, jammed)

    def _aims(self, gaps: Gaps, h: float) -> Array:
        """Return the gaps (K,) that a motion for h [s] is to reach."""
        # Shapes that nearly touch stay as they are: what is not penetrated does not move by itself.
        aims = np.where(gaps.distances < 0.0, SKIN, np.minimum(gaps.distances, SKIN))
        if self._before and len(aims):
            keys = pair_keys(gaps.pairs)
            before = np.array([self._before.get(keys[k], 0.0) for k in gaps.index.tolist()])
            np.minimum(aims, before + _RELEASE * h, out=aims, where=before < 0.0)
        return aims

    def _same_side(self, pairs: DistanceResults, index: npt.NDArray[np.intp]) -> npt.NDArray[np.intp]:
        """Return the indices of pairs without those that are penetrated beyond their middle."""
        keys = pair_keys(pairs)
        inside = {keys[k] for k in index.tolist() if pairs.distances[k] < 0.0}
        self._penetrated = {key: n for key, n in self._penetrated.items() if key in inside}
        kept = [
            k
            for k in index.tolist()
            if keys[k] not in self._penetrated or pairs.normals[k] @ self._penetrated[keys[k]] > 0.0
        ]
        return np.array(kept, dtype=np.intp)

    def _note_penetrated(self, gaps: Gaps) -> None:
        """Remember the sides from which shapes are penetrated because nothing yields."""
        deep = gaps.index[gaps.distances < -_DEEP]
        if len(deep):
            keys = pair_keys(gaps.pairs)
            for k in deep.tolist():
                self._penetrated.setdefault(keys[k], gaps.pairs.normals[k].copy())

    def _evaluate_twists(self) -> Array:
        """Return the spatial twists of groups of bodies (G, 6, all columns) at this place."""
        if self._moved:
            self._twists.input[:] = self.q[self._twist_inputs]
            self._twists()
            self._moved = False
        twists: Array = self._twists.outputs[0]
        return twists

    def _measure_furniture(
        self, v: Array, wish: Array, gaps: Gaps, pulled: tuple[Array, Array] | None
    ) -> FurnitureGaps | None:
        """Return the gaps between furniture, some of which moves; None if nothing does."""
        n = self.count
        rows = gaps.rows[:, :n] != 0.0
        driven = rows[(gaps.distances < _DEEP) & ~gaps.jammed].any(axis=0) | (wish != 0.0)
        if pulled is not None:
            driven |= (pulled[1] != 0.0).any(axis=0)
        moved = driven | rows.any(axis=0) | (v != 0.0)
        return self._furniture.measure(driven, moved) if moved.any() else None

    def resolve(self, h: float, moved: float, residual: Residual | None = None) -> Array:
        """Move the objects after the robot has moved, and return their speeds (n,)."""
        v = best = np.zeros(self.count)
        start, least, wish = self.q.copy(), math.inf, self.springs.wish(self.q, h)
        radius = moved + self.spring_travel(h) + _REACH
        if residual is None and not wish.any() and not len(self.find_near(0.0)[1]):
            return v
        rates = self._limits.begin(start, h)
        self._furniture.begin()
        for k in range(_ROUNDS + 1):
            gaps = self.measure_gaps(radius)
            pulled = None if residual is None else residual()
            limits, beyond = self._limits.position_rows(self.q, h, v)
            aims, furniture = self._aims(gaps, h), self._measure_furniture(v, wish, gaps, pulled)
            cost = self._cost(h * (v - wish), gaps, aims, furniture, pulled) + beyond / _HARD
            better = cost <= least * (1.0 + 1e-9)
            if k == _ROUNDS:
                break
            if better:
                least, best = cost, v
                self._note_penetrated(gaps)
                result = v
                if furniture is not None:
                    result = self._solve(h, v, wish, gaps, aims, furniture, rates, limits, pulled)
            else:
                # The gaps bend too much, as of bodies that are jammed: half of the motion.
                result = 0.5 * (best + v)
            change = float(np.max(np.abs(result - v) * np.sqrt(self.weights[: self.count]), initial=0.0)) * h
            v = result
            self.place(self._integrate(start, v, h))
            if change <= _STEADY:
                break
        if not better:
            v = best
            self.place(self._integrate(start, v, h))
        self._limits.finish(self.q, h)
        sprung = np.flatnonzero(wish)
        if len(sprung) and residual is None and not gaps.rows[:, sprung].any():
            if (h * np.abs(v) * np.sqrt(self.weights[: self.count]) < _STEADY).all():
                self.springs.block(self.q)
        return v

    def _cost(
        self,
        motion: Array,
        gaps: Gaps,
        aims: Array,
        furniture: FurnitureGaps | None,
        pulled: tuple[Array, Array] | None,
    ) -> float:
        """Return twice the cost of a motion of the objects (n,), relative to that by their springs."""
        depths = np.minimum(gaps.distances - np.minimum(aims, 0.0), 0.0)[~gaps.jammed]
        moved = float(self.weights[: self.count] @ motion**2)
        if pulled is not None:
            moved = _HELD * moved + float(pulled[0] @ pulled[0])
        squares = float(depths @ depths)
        if furniture is not None:
            overlaps = _FIRM * np.minimum(furniture.distances, 0.0)
            squares += float(overlaps @ overlaps)
        return moved + squares / _SLACK

    def _solve(
        self,
        h: float,
        v: Array,
        wish: Array,
        gaps: Gaps,
        aims: Array,
        furniture: FurnitureGaps,
        rates: Rows,
        limits: Rows,
        pulled: tuple[Array, Array] | None,
    ) -> Array:
        """Return the speeds of one linearisation at speeds v."""
        n = self.count
        G, d = gaps.rows[:, :n], gaps.distances
        use, *concerned = self._limits.find_linked(furniture.moved)
        H, f = np.diag(self.weights[use]), -self.weights[use] * wish[use]
        if pulled is not None:
            error, J = pulled[0] / h, pulled[1][:, use]
            mine = (J != 0.0).any(axis=0)
            H[mine, mine] *= _HELD
            f[mine] *= _HELD
            H += J.T @ J
            f += J.T @ (error - J @ v[use])
        parts = []
        for (A, low, high, _), index in zip((limits, rates), concerned, strict=True):
            # At some places nothing moves what a row limits.
            index = index[A[index[:, None], use].any(axis=1)]
            parts.append((A[index[:, None], use], low[index], high[index]))
        hard = sum(len(low) for _, low, _ in parts)
        if len(d):
            touching = (G[:, use] != 0.0).any(axis=1)
            wanted = (aims - d) / h + G @ v
            # What is jammed moves nothing, and lets nothing move into it.
            np.minimum(wanted, 0.0, out=wanted, where=gaps.jammed)
            G, wanted = G[touching][:, use], wanted[touching]
            parts.append((G, wanted, np.full(len(G), _UNBOUNDED)))
        if len(furniture.distances):
            G = furniture.rows
            wanted = G @ v - furniture.distances / h
            np.minimum(wanted, 0.0, out=wanted, where=furniture.jammed)
            concern = (G[:, use] != 0.0).any(axis=1)
            G, wanted = _FIRM * G[concern][:, use], _FIRM * wanted[concern]
            parts.append((G, wanted, np.full(len(G), _UNBOUNDED)))
        rows, least, most = (np.concatenate(each) for each in zip(*parts, strict=True))
        sense = np.full(len(rows), _SOFT, dtype=np.intc)
        sense[:hard] = 0
        np.maximum(least, -_UNBOUNDED, out=least)
        np.minimum(most, _UNBOUNDED, out=most)
        x, _, flag, _ = self._daqp.solve(
            H, f, rows, most, least, sense, rho_soft=_SLACK, primal_tol=1e-10, sing_tol=1e-14
        )
        result = np.zeros(n)
        if flag >= 1 and np.isfinite(x).all():
            _clip_to_bounds(x, rows[:hard], least[:hard], most[:hard])
            result[use] = x
        return result


_SOFT, _UNBOUNDED = 8, 1e9


def _clip_to_bounds(x: Array, rows: Array, lower: Array, upper: Array) -> None:
    """Clip values to the bounds of rows with one entry each, in place: solvers satisfy them nearly."""
    for row, low, high in zip(rows.tolist(), lower.tolist(), upper.tolist(), strict=True):
        entries = [k for k, weight in enumerate(row) if weight]
        if len(entries) == 1:
            (k,) = entries
            ends = (low / row[k], high / row[k])
            if min(ends) <= max(ends):
                x[k] = min(max(x[k], min(ends)), max(ends))


def _import_daqp() -> Any:
    try:
        import daqp
    except ImportError as error:
        raise MissingDependencyError(f"This world needs daqp: {install_command('control')}") from error
    return daqp
