"""Collision checker of a planner: bodies that move against all others, W configurations at a time."""

from __future__ import annotations

import ctypes
import itertools
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import combinations, permutations
from typing import TypeAlias

import casadi as ca
import numpy as np
import numpy.typing as npt

from kineverse.compilation.vector_program import VectorProgram
from kineverse.errors import NoSolutionError
from kineverse.expressions.expression import Expression, as_expression
from kineverse.geometry import Scene
from kineverse.geometry.bindings import ObjectPlacement
from kineverse.geometry.collision_filter import rigid_group
from kineverse.geometry.objects import CollisionObject
from kineverse.geometry.shapes import Solid
from kineverse.lie import Array
from kineverse.model.frame_dependence import FrameDependence
from kineverse.state import State
from kineverse.symbols import Symbol

from .bindings import CheckerStruct, ObstacleSetStruct, planning_functions
from .collision_geometry import Floats32, LinkTable, ObstacleSet

BodyPairs: TypeAlias = frozenset[frozenset[str]]  # pairs of bodies, {a, b} each

PairTables: TypeAlias = tuple[npt.NDArray[np.uint8], npt.NDArray[np.int32], npt.NDArray[np.int32]]
"""Checked pairs: flags of links and bodies of the world, rows of two links, and of a link and a set."""

RESOLUTION = 32.0  # samples of an edge for each unit of its length, [1/rad] and [1/m]
FINENESS = 2000.0
"""Samples of a unit of a coordinate by which a condition switches, such as that of a lock [1/rad], [1/m]."""
_SAME = 1e-4
_ROUNDING = 2.5e-7  # error of a pose in single precision, as a fraction of its distance from the origin
_SWITCHES = {ca.OP_LT, ca.OP_LE, ca.OP_EQ, ca.OP_NE, ca.OP_NOT, ca.OP_AND, ca.OP_OR, ca.OP_IF_ELSE_ZERO}
_placements = itertools.count()
LEAST_INFLATION = 2e-4  # growth of spheres below which a collision between two samples counts as one [m]


class LateCheckError(NoSolutionError):
    """The check of a found path takes longer than it may."""


class CollisionChecker:
    """Collision check of many configurations of some coordinates; everything else is fixed."""

    def __init__(
        self,
        scene: Scene,
        coordinates: Sequence[Symbol],
        conditions: Sequence[Expression],
        margin: float,
        protrusion: float | None = None,
    ) -> None:
        self._code = planning_functions()
        self.scene, self.coordinates = scene, tuple(coordinates)
        model, world = scene.model, scene.collision_world
        scene.update(model.default_state())
        world.prepare()
        dependence = FrameDependence(model, coordinates)
        frames = dict(model.frames)
        self.moving = tuple(body for body in scene.bodies if dependence.moves(body))
        groups = {body: rigid_group(body, frames) for body in self.moving}
        self.groups = tuple(dict.fromkeys(groups.values()))
        poses = [self.groups.index(groups[body]) for body in self.moving]
        self.program = self._make_program([model.fk(g)[:3] for g in self.groups], conditions)
        members = [self._in_group(body, groups[body]) for body in self.moving]
        self.links = LinkTable(members, poses, protrusion)
        self._planes: list[Array] = []
        self._place_static(dependence)
        self._place_moving(members, poses)
        self._choose_pairs(dependence)
        self._margin = margin
        self._objects = ObjectPlacement(world.table)
        self._solids = [world.solid(k) for k in range(len(world.objects))]  # C has pointers to them
        self.links.shapes["object"] = [k for b in self.moving for k in world.members[world.body_index(b)]]
        self._build_struct(margin)
        self._turns[:] = self._find_turns()
        self._placement: tuple[bytes, bytes] | None = None
        self._placed = next(_placements)
        self._excepted: BodyPairs = frozenset()
        self._tables = {self._excepted: (self._allowed, self.pairs, self.moving_pairs)}

    def _make_program(self, poses: list[Expression], conditions: Sequence[Expression]) -> VectorProgram:
        self._conditions = tuple(conditions)
        outputs = [*poses, *conditions]
        # Loops that do not close have no pose: the sum of all entries is NaN then, and so is no condition.
        if any(e.nodes for e in outputs):
            outputs.append(as_expression(sum((p.sum() for p in poses), as_expression(0.0)) * 0.0))
        result = {s for e in outputs for s in e.symbols} - {*self.coordinates}
        self.parameters = tuple(sorted(result, key=lambda s: s.sort_key))
        self.conditions = len(outputs) - len(poses)
        return VectorProgram(outputs, self.coordinates, self.parameters, scalar="float")

    def _in_group(self, body: str, group: str) -> list[tuple[CollisionObject, Solid, Array]]:
        """Return the objects of a body with their solids and their poses (4, 4) in its rigid group."""
        world = self.scene.collision_world
        offset = self.scene.model.fk(body, group)({})
        items = ((world.objects[k], world.solid(k)) for k in world.members[world.body_index(body)])
        return [(item, solid, offset @ item.shape.origin.matrix) for item, solid in items]

    def _place_static(self, dependence: FrameDependence) -> None:
        world = self.scene.collision_world
        static = [k for k, item in enumerate(world.objects) if not dependence.moves(item.body)]
        self._static = np.array(static, dtype=int)
        used, numbers = np.unique(world.table.body[self._static], return_inverse=True)
        self.standing = tuple(world.bodies[k] for k in used)
        moving = np.array([world.body_index(body) for body in self.moving], dtype=int)
        self._allowed = np.ascontiguousarray(world.table.allowed[np.ix_(moving, used)], dtype=np.uint8)
        solids = [world.solid(k) for k in self._static]
        poses, bodies = world.table.poses[self._static], numbers.astype(np.int32)
        self._world = ObstacleSet(
            solids, bodies, poses, self._planes, self.program.lanes, objects=self._static
        )

    def _place_moving(
        self, members: Sequence[Sequence[tuple[CollisionObject, Solid, Array]]], poses: Sequence[int]
    ) -> None:
        lanes = self.program.lanes
        self._sets: list[ObstacleSet] = []
        table = self.scene.collision_world.table
        numbers = [self.scene.collision_world.body_index(body) for body in self.moving]
        self._carried = np.flatnonzero(np.isin(table.body, numbers))
        for k, items in enumerate(members):
            solids = [solid for _, solid, _ in items]
            bodies, places = np.zeros(len(solids), dtype=np.int32), np.array([T[:3] for _, _, T in items])
            self._sets.append(ObstacleSet(solids, bodies, places, self._planes, lanes, poses[k], k))

    def _choose_pairs(self, dependence: FrameDependence) -> None:
        """Choose for each pair of moving bodies whether shapes or spheres represent the second one.

        Where spheres touch, the shapes of both are compared, unless these are spheres.
        """
        world = self.scene.collision_world
        number = [world.body_index(body) for body in self.moving]
        spheres, shapes = [len(s) for s in self.links.spheres], [s.cost for s in self._sets]
        pairs: list[tuple[int, int]] = []
        moving_pairs: list[tuple[int, int]] = []
        for (i, a), (j, b) in combinations(enumerate(self.moving), 2):
            if not world.table.allowed[number[i], number[j]] or not dependence.moves_between(a, b):
                continue
            # Shapes stick out less, but spheres have a hierarchy.
            costs = spheres[i] * spheres[j] / 2, spheres[i] * shapes[j], spheres[j] * shapes[i]
            choice = costs.index(min(costs))
            (moving_pairs if choice else pairs).append((j, i) if choice == 2 else (i, j))
        self.pairs = np.array(pairs, dtype=np.int32).reshape(-1, 2)
        self.moving_pairs = np.array(moving_pairs, dtype=np.int32).reshape(-1, 2)

    def _build_struct(self, margin: float) -> None:
        n = len(self.coordinates)
        self.lower, self.upper = np.zeros(n, dtype=np.float32), np.zeros(n, dtype=np.float32)
        switching = {s for e in self._conditions if is_switching(e) for s in e.symbols}
        self._fineness = np.array([FINENESS * (s in switching) for s in self.coordinates], dtype=np.float32)
        self._turns = np.ones(n, dtype=np.float32)
        self._plane_table = np.concatenate(self._planes or [np.zeros((1, 4))]).astype(np.float32)
        self._set_structs = (ObstacleSetStruct * max(len(self._sets), 1))(*(s.struct for s in self._sets))
        program, links = self.program, self.links
        self._kept = program.prepare(np.zeros(len(self.parameters)))
        self.struct = CheckerStruct(
            n, len(self.groups), self.conditions, program.stored, program.compute_address,
            self._kept.ctypes.data, self.lower.ctypes.data, self.upper.ctypes.data, len(links.links),
            len(self.standing), links.links.ctypes.data, links.coarse.ctypes.data, links.fine.ctypes.data,
            self._plane_table.ctypes.data, self._allowed.ctypes.data, ctypes.addressof(self._world.struct),
            ctypes.addressof(self._set_structs), self._fineness.ctypes.data, self._turns.ctypes.data,
            len(self.pairs), len(self.moving_pairs), self.pairs.ctypes.data, self.moving_pairs.ctypes.data,
            links.shapes.ctypes.data, self._objects.address, self._objects.poses.ctypes.data,
            self._objects.positions.ctypes.data, self.scene.collision_world.table.centre.ctypes.data,
            self._objects.is_within, margin,
        )  # fmt: skip

    @property
    def address(self) -> int:
        """Address of :attr:`struct`, valid as long as this object."""
        return ctypes.addressof(self.struct)

    def place(self, state: State) -> None:
        """Place the obstacles at a state, and set everything else that poses depend on."""
        self.scene.update(state)
        table, parameters = self.scene.collision_world.table, state.vector(self.parameters)
        poses = table.poses[self._static]
        self._world.place(poses)
        self._objects.poses[self._static] = poses
        self._objects.positions[self._static] = table.position[self._static]
        self._kept = self.program.prepare(parameters)
        self.struct.kept = self._kept.ctypes.data
        places = table.poses[self._carried, :, 3]
        self.struct.margin = self._margin + _ROUNDING * float(np.abs(places).max(initial=0.0))
        placement = poses.tobytes(), parameters.tobytes()
        if placement != self._placement:
            self._placement, self._placed = placement, next(_placements)

    @property
    def version(self) -> tuple[int, BodyPairs]:
        """Number of the placement, and the pairs that are left out.

        Answers stay the same as long as these, the margin and the limits do.
        """
        return self._placed, self._excepted

    @contextmanager
    def excepting(self, pairs: BodyPairs) -> Iterator[None]:
        """Leave out pairs of bodies, {a, b} each, while the context lasts."""
        self._except(pairs)
        try:
            yield
        finally:
            self._except(frozenset())

    def _except(self, pairs: BodyPairs) -> None:
        """Switch C to tables without some pairs, which are kept for the next holds."""
        if pairs not in self._tables:
            self._tables[pairs] = self._without(pairs)
        self._excepted, s = pairs, self.struct
        allowed, spheres, shapes = self._tables[pairs]
        s.allowed, s.pair, s.moving_pair = allowed.ctypes.data, spheres.ctypes.data, shapes.ctypes.data
        s.pairs, s.moving_pairs = len(spheres), len(shapes)

    def _without(self, pairs: BodyPairs) -> PairTables:
        standing = {body: k for k, body in enumerate(self.standing)}
        numbers = {body: k for k, body in enumerate(self.moving)}
        allowed = self._allowed.copy()
        for pair in pairs:
            for a, b in permutations(pair):
                if a in numbers and b in standing:
                    allowed[numbers[a], standing[b]] = 0

        def keep(rows: npt.NDArray[np.int32]) -> npt.NDArray[np.int32]:
            names = [frozenset((self.moving[i], self.moving[j])) for i, j in rows.tolist()]
            kept = np.array([name not in pairs for name in names], dtype=bool)
            return np.ascontiguousarray(rows[kept].reshape(-1, 2))

        return allowed, keep(self.pairs), keep(self.moving_pairs)

    @contextmanager
    def widened(self, by: float, ends: Floats32) -> Iterator[bool]:
        """Widen the margin [m] while the context lasts, if configurations (N, n) stay valid with it.

        The context is True if it is wider.
        """
        margin = self.struct.margin
        self.struct.margin = margin + by
        wider = by > 0.0 and bool(self.valid(np.ascontiguousarray(ends)).all())
        if not wider:
            self.struct.margin = margin
        try:
            yield wider
        finally:
            self.struct.margin = margin

    # -- configurations ------------------------------------------------------------------------------------

    def valid(self, Q: Floats32) -> npt.NDArray[np.bool_]:
        """Return flags (N,) of the configurations (N, n) that are within limits, allowed and free."""
        result = np.zeros(len(Q), dtype=np.uint8)
        self._code.kineverse_valid(self.address, Q.ctypes.data, len(Q), result.ctypes.data)
        return result.astype(bool)

    def edges(self, A: Floats32, B: Floats32, least: float = 0.0) -> npt.NDArray[np.bool_]:
        """Return flags (N,) of the straight edges between configurations (N, n) that are free."""
        result, ends = np.zeros(len(A), dtype=np.uint8), (A.ctypes.data, B.ctypes.data, len(A))
        self._code.kineverse_edges(self.address, *ends, RESOLUTION, least, result.ctypes.data)
        return result.astype(bool)

    def find_collision(self, points: Floats32, seconds: float = math.inf) -> tuple[int, float] | None:
        """Find the first edge of a polyline (N, n) that is not certainly free, and a fraction of it."""
        where = ctypes.c_double()
        result = self._code.kineverse_certify(
            self.address, points.ctypes.data, len(points), RESOLUTION, LEAST_INFLATION, seconds,
            ctypes.addressof(where),
        )  # fmt: skip
        if result == -3:
            raise LateCheckError
        if result < -1:
            raise MemoryError("There is no memory for the check of a path.")
        return None if result < 0 else (int(result), where.value)

    def outputs(self, q: Floats32) -> tuple[Floats32, Floats32]:
        """Return the poses (K, 3, 4) of the rigid groups and the conditions at a configuration (n,)."""
        count = 12 * len(self.groups)
        result = np.zeros(count + self.conditions, dtype=np.float32)
        self._code.kineverse_poses(self.address, q.ctypes.data, result.ctypes.data)
        return result[:count].reshape(-1, 3, 4), result[count:]

    def _find_turns(self) -> Array:
        """Find the largest angle by which a unit of each coordinate turns a body (n,) [rad].

        Threads and gears turn bodies so fast that two poses do not show how far they are apart.
        """
        generator, result = np.random.default_rng(0), np.zeros(len(self.coordinates))
        for q in generator.uniform(-1.0, 1.0, (2, len(result))).astype(np.float32):
            before = self.outputs(q)[0][:, :, :3]
            for i in range(len(result)):
                near = q.copy()
                near[i] += _SAME
                change = np.linalg.norm(self.outputs(near)[0][:, :, :3] - before, axis=(1, 2))
                turns = np.nan_to_num(change / math.sqrt(2.0) / float(near[i] - q[i]), nan=0.0)
                result[i] = max(result[i], turns.max(initial=0.0))
        return result

    def find_periodic(self, candidates: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
        """Return flags (n,) of the candidates whose full turns change no pose and no condition."""
        generator = np.random.default_rng(0)
        result = candidates.copy()
        # At other places too: a screw whose pitch happens to be 0 is not periodic.
        elsewhere = self.program.prepare(generator.uniform(-1.0, 1.0, len(self.parameters)))
        self.struct.kept = elsewhere.ctypes.data
        for i in np.flatnonzero(candidates).tolist():
            for q in generator.uniform(-1.0, 1.0, (3, len(candidates))).astype(np.float32):
                turned = q.copy()
                turned[i] += math.tau
                pairs = zip(self.outputs(q), self.outputs(turned), strict=True)
                result[i] &= all(np.allclose(a, b, atol=_SAME, equal_nan=True) for a, b in pairs)
        self.struct.kept = self._kept.ctypes.data
        return result


def is_switching(expression: Expression) -> bool:
    """Return True for an expression with comparisons, which may jump."""
    function = ca.Function("expression", ca.symvar(expression.casadi), [expression.casadi])
    return any(function.instruction_id(k) in _SWITCHES for k in range(function.n_instructions()))
