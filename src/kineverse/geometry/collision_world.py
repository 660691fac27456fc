"""Collision objects of a model in tables for distance computation, at one state."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import groupby
from typing import Any

import numpy as np

from kineverse._checks import as_entries
from kineverse._runtime import CallLock
from kineverse.compilation.function import CompiledFunction
from kineverse.compilation.function import compile as compile_expressions
from kineverse.errors import (
    InvalidValueError,
    KineverseError,
    UnknownNameError,
    duplicate_value_error,
    suggest,
)
from kineverse.lie import inverse
from kineverse.model.model_view import ModelView
from kineverse.model.symbolic_view import cached_for_version
from kineverse.state import State, StateLike
from kineverse.symbols import Symbol

from .bindings import FacingPoints, RankedPairs, collision_library
from .broadphase import FURTHEST, TRAVEL_EXCEEDED, Indices, ObjectTable, PairSelection
from .collision_filter import (
    Rule,
    allowed_pairs,
    apply_rules,
    check_body_patterns,
    check_frame_names,
    parse_known_rules,
    read_rules,
)
from .mesh_files import Floats
from .narrowphase import ACCURACY, Narrowphase
from .objects import CollisionObject, CollisionObjects, Exclusion, load_solids, parse_exclusions
from .shapes import Solid

_MAX_MEASUREMENTS = 200_000


class CollisionWorld:
    """Collision objects of a model and their poses; for one thread."""

    def __init__(
        self,
        model: ModelView,
        rules: Iterable[Rule],
        triangles: Iterable[str],
        decomposed: Iterable[str],
        leave_out: Iterable[Exclusion],
    ) -> None:
        self.model = model
        self.lock = CallLock()
        self._own_rules = parse_known_rules(rules, model)
        meshes = (("triangles", triangles), ("decomposed", decomposed))
        wanted = "names or patterns of bodies"
        some, others = (as_entries(f"{what}=", entries, str, wanted) for what, entries in meshes)
        patterns = some, others, parse_exclusions(leave_out)
        for what, names in zip(("triangles", "decomposed", "leave_out"), patterns, strict=True):
            bodies = [name if isinstance(name, str) else name[0] for name in names]
            check_frame_names(f"{what}= names", bodies, model)
            check_body_patterns(f"{what}=", bodies, model)
        self._source = CollisionObjects(*patterns)
        self._version: int | None = None
        self._placed_at: tuple[tuple[Symbol, ...], Floats] = (), np.zeros(0)  # symbols and values
        self._missing_state = ""
        self.objects: list[CollisionObject] = []
        self._origins: dict[int, Floats] = {}
        self._solids: list[Solid | None] = []
        self.table = ObjectTable(0, np.zeros(0, dtype=np.int32), np.zeros((0, 0), dtype=np.uint8))
        collision_library.prepare()
        self.synchronize()

    @property
    def rules(self) -> tuple[Rule, ...]:
        """Rules of the collision filter in their order: those of the model, then the world's own."""
        return (*read_rules(self.model), *self._own_rules)

    # -- the model -----------------------------------------------------------------------------------------

    def synchronize(self) -> None:
        """Follow the model to its present version; unchanged objects keep their solids, travel and bounds."""
        if self._version == self.model.version:
            return
        version = self.model.version
        rules = self.rules
        if self._source.synchronize(self.model) or self._version is None:
            try:
                self._rebuild(rules)
            except BaseException:
                self._source.clear()  # so that the next query finds a difference again
                raise
        else:
            # Frames may have been inserted, which changes the adjacent pairs.
            self.table.allowed[:] = allowed_pairs(self.model, self.bodies, rules)
        self._version = version

    def _rebuild(self, rules: Sequence[Rule]) -> None:
        by_body = self._source.by_body
        before, old = {id(item): k for k, item in enumerate(self.objects)}, self.table
        old_solids = self._solids
        everything = [item for items in by_body.values() for item in items]
        moving = [item for item in everything if item.moves]
        is_same = self._version is not None and moving == self.objects[: old.moving]
        self.objects = [*moving, *(item for item in everything if not item.moves)]
        self.bodies = tuple(by_body)
        self._body_numbers = number = {name: k for k, name in enumerate(self.bodies)}
        self._origins.clear()
        body = np.array([number[item.body] for item in self.objects], dtype=np.int32)
        self.members: list[list[int]] = [[] for _ in self.bodies]
        self.shape_numbers: Indices = np.array([item.number for item in self.objects], dtype=np.int32)
        for k, owner in enumerate(body.tolist()):
            self.members[owner].append(k)
        self.table = table = ObjectTable(len(moving), body, allowed_pairs(self.model, self.bodies, rules))
        kept = [(k, before[id(item)]) for k, item in enumerate(self.objects) if id(item) in before]
        self._solids = [None] * len(self.objects)
        for new, previous in kept:
            self._solids[new] = old_solids[previous]
        table.inherit(old, np.array(kept, dtype=int).reshape(-1, 2))
        known = {new for new, _ in kept}
        poses: dict[str, Floats] = {}
        for k in range(len(moving), len(self.objects)):
            if k not in known:
                table.poses[k] = _static_pose(self.objects[k], poses)
        table.update_boxes(np.arange(table.count))
        self._all_loaded = all(solid is not None for solid in self._solids)
        self.narrowphase = Narrowphase(self._solids, table.poses)
        self._travel = table.travel.data
        self._bounds: Any = None if table.bounds is None else table.bounds.data
        self._measurements: dict[tuple[int, int], tuple[float, float, float, Floats]] = {}
        if not is_same:
            self._compile(moving)
        self._restore_poses()

    def _compile(self, moving: list[CollisionObject]) -> None:
        """Compile the poses of moving objects (M, 3, 4), once for all worlds of a model."""
        function = None
        if moving:
            poses = [item.body_pose for item in moving]  # kept, so that no other one has the same number
            places = ((item.body, item.shape.origin, id(item.body_pose)) for item in moving)
            key = "poses of objects", tuple(places)
            _, function = cached_for_version(self.model, key, lambda: (poses, _compile_poses(moving)))
        self._function: Any = function
        self.inputs: tuple[Symbol, ...] = function.inputs if function else ()
        self._evaluator: Any = None
        if function:
            self._evaluator = evaluator = function.bind()
            self._addresses = evaluator.input.ctypes.data, evaluator.outputs[0].ctypes.data

    def add_rules(self, rules: Iterable[Rule]) -> None:
        """Add rules behind all others, from now on."""
        added = parse_known_rules(rules, self.model)
        self._own_rules += added
        self.table.allowed[:] = apply_rules(self.table.allowed, self.bodies, added)

    # -- the state -----------------------------------------------------------------------------------------

    def update(self, state: StateLike | Sequence[float] | Floats) -> None:
        """Compute all poses at a state, see :meth:`.Scene.update`."""
        self.synchronize()
        if isinstance(state, Mapping):
            state = self._select_inputs(state)
        if self._evaluator is not None:
            self._evaluator(state)
            self._place()
            self._placed_at = self.inputs, self._evaluator.input.copy()
        elif not isinstance(state, Mapping) and len(state):
            raise InvalidValueError(f"Nothing moves in this scene, and {len(state)} values are given.")
        self._missing_state = ""

    def search_at(
        self,
        values: Floats,
        radius: float,
        selection: PairSelection,
        per_shape: bool,
        facing: FacingPoints | None,
    ) -> RankedPairs | None:
        """Update to values of :attr:`inputs` and search the selected pairs, in one call of C.

        None if this takes an update and a search, see :meth:`.CollisionLibrary.search_at`.
        """
        address = self.kinematics_address
        usable = type(values) is np.ndarray and values.dtype == np.float64
        if address is None or not usable or values.shape != self._evaluator.input.shape:
            return None
        self._evaluator.input[:] = values
        kinematics = address, *self._addresses
        result = collision_library.search_at(
            self.table, kinematics, radius + ACCURACY, radius, selection, per_shape, facing
        )
        if result is not None:
            self._placed_at, self._missing_state = (self.inputs, values.copy()), ""
            self.narrowphase.invalidate_poses(self.table.moving)
        return result

    @property
    def values(self) -> Floats:
        """Values of :attr:`inputs` at the last update; NaN for those that it did not have."""
        symbols, numbers = self._placed_at
        if symbols is self.inputs:
            return numbers.copy()
        known = dict(zip(symbols, numbers.tolist(), strict=True))
        return np.array([known.get(s, s.value) for s in self.inputs], dtype=float)

    @property
    def kinematics_address(self) -> int | None:
        """Address of the C function from :attr:`inputs` to the poses of moving objects; None without it."""
        return None if self._function is None else self._function.address

    def compute_poses(self, values: Floats) -> Floats:
        """Return the poses of the moving objects, (K, 3, 4), at values of :attr:`inputs`."""
        return np.asarray(self._function(values))

    def _select_inputs(self, state: StateLike) -> StateLike:
        """Select the values that poses depend on, after a check of all other names."""
        if isinstance(state, State):
            return state
        inputs = {key for symbol in self.inputs for key in (symbol, str(symbol))}
        others = [str(key) for key in state if key not in inputs]
        for name in others:
            self.model.symbol(name)
        if len(set(others)) < len(others):
            raise duplicate_value_error(next(name for name in others if others.count(name) > 1))
        return {key: value for key, value in state.items() if key in inputs}

    def _place(self) -> None:
        outcome = collision_library.place(self.table, self._evaluator.outputs[0])
        if outcome >= 0:
            names = dict.fromkeys(
                item.body
                for item, pose in zip(self.objects, self._evaluator.outputs[0], strict=False)
                if not (np.abs(pose) <= FURTHEST).all()
            )
            raise InvalidValueError(
                f"At this state the pose of {', '.join(map(repr, names))} is not finite, or further than "
                f"{FURTHEST:g} m away; nothing was moved."
            )
        if outcome == TRAVEL_EXCEEDED:
            self.table.reset_travel()
            self._measurements.clear()
        self.narrowphase.invalidate_poses(self.table.moving)

    def _restore_poses(self) -> None:
        """Recompute all poses at the last state after an edit, if that state still determines them."""
        values = self.values
        missing = [str(s) for s, known in zip(self.inputs, ~np.isnan(values), strict=True) if not known]
        more = f" and {len(missing) - 12} more" if len(missing) > 12 else ""
        self._missing_state = f"There is no value for {', '.join(missing[:12])}{more}" if missing else ""
        if self._evaluator is None or missing:
            return
        try:
            self._evaluator(values)
            self._place()
        except KineverseError as error:  # a loop that does not close, a root of a negative number
            self._missing_state = f"The last state has no poses after the edit ({error})"

    # -- questions -----------------------------------------------------------------------------------------

    def prepare(self, objects: Iterable[int] | None = None) -> None:
        """Update to the model's version, and make the solids of some objects, or of all."""
        self.synchronize()
        if self._missing_state:
            raise UnknownNameError(f"{self._missing_state}: call scene.update(state) first.")
        if not self._all_loaded:
            first = not self.table.active.any()
            if self.load(objects) and (first or objects is None):
                self.table.choose_axis()

    def load(self, objects: Iterable[int] | None = None) -> bool:
        """Make the solids of some objects, or of all, and return whether any were missing."""
        wanted = [
            k for k in (range(len(self.objects)) if objects is None else objects) if self._solids[k] is None
        ]
        if not wanted and objects is not None:
            return False
        # The choice between C and coal is made before the first distance, so that answers never change.
        collision_library.prepare(wait=True)
        for k, solid in zip(wanted, load_solids(self.objects[k] for k in wanted), strict=True):
            self._solids[k] = solid
            self.table.set_solid(k, solid.centre, solid.half, solid.radius, solid.core)
        self._all_loaded = objects is None
        return bool(wanted)

    def measure(self, pairs: Indices, lows: Floats, limit: float) -> tuple[Floats, Floats]:
        """Measure pairs of objects; of each pair of bodies, at least the nearest one."""
        distances, witnesses = collision_library.measure(self.table, pairs, limit)
        if np.isnan(distances).any():
            self.measure_remaining(pairs, lows, limit, distances, witnesses)
        return distances, witnesses

    def measure_remaining(
        self,
        pairs: Indices,
        lows: Floats,
        limit: float,
        distances: Floats,
        witnesses: Floats,
        per_shape: bool = False,
    ) -> None:
        """Measure by coal the pairs whose distance is NaN, see :meth:`measure`.

        If ``per_shape``, all of them are measured, even if a nearer pair of the same bodies is known.
        """
        keys = [frozenset(owners) for owners in self.table.body[pairs].tolist()]
        unsolved = np.flatnonzero(np.isnan(distances))
        nearest = dict.fromkeys(keys, math.inf)
        # Most bodies have one object; then no other pair of the same bodies can be nearer.
        several = not per_shape and len(nearest) < len(keys)
        for k in np.flatnonzero(~np.isnan(distances)).tolist() if several else ():
            nearest[keys[k]] = min(nearest[keys[k]], distances[k])
        for k in unsolved[np.argsort(lows[unsolved], kind="stable")].tolist():
            if several and lows[k] > nearest[keys[k]] + ACCURACY:
                distances[k] = math.inf
                continue
            i, j = pairs[k].tolist()
            distances[k], witness = self._measure_by_coal(i, j, limit)
            if witness is not None:
                witnesses[k] = witness
            nearest[keys[k]] = min(nearest[keys[k]], distances[k])

    def _measure_by_coal(self, i: int, j: int, limit: float) -> tuple[float, Floats | None]:
        """Return distance and witness of two objects, i < j, from memory if neither has moved since.

        Beyond the limit the distance is infinite, and there is no witness.
        """
        one, other = self._travel[i], self._travel[j]
        known = self._measurements.get((i, j))
        if known is not None and known[0] == one and known[1] == other:
            return (known[2], known[3]) if known[2] <= limit else (math.inf, None)
        distance = self.narrowphase.distance(i, j)
        if self._bounds is not None:
            self._bounds[i, j] = distance + one + other
        if distance > limit:
            return math.inf, None
        witness = np.concatenate(self.narrowphase.witness())
        if len(self._measurements) >= _MAX_MEASUREMENTS:
            self._measurements.clear()
        self._measurements[i, j] = one, other, distance, witness
        return distance, witness

    def body_index(self, body: str) -> int:
        """Return the index of a body."""
        self.synchronize()
        try:
            return self._body_numbers[body]
        except KeyError:
            what = "has no shapes here" if body in self.model.frames else "is no frame of the model"
            raise UnknownNameError(f"'{body}' {what}. {suggest(str(body), self.bodies, 'body')}") from None

    def body_pose(self, body: str) -> Floats:
        """Return the pose of a body at the last update, world_T_body, (4, 4) [m]."""
        first = self.members[self.body_index(body)][0]
        if first not in self._origins:
            self._origins[first] = inverse(self.objects[first].shape.origin.matrix)
        world_T_body = np.empty((4, 4))
        np.matmul(self.table.poses[first], self._origins[first], out=world_T_body[:3])
        world_T_body[3] = 0.0, 0.0, 0.0, 1.0
        return world_T_body

    def solid(self, index: int) -> Solid:
        """Return the solid of an object that :meth:`prepare` has made."""
        solid = self._solids[index]
        assert solid is not None
        return solid


def _compile_poses(moving: list[CollisionObject]) -> CompiledFunction[Floats]:
    """Compile the poses (M, 3, 4) of moving objects, those of a body together."""
    poses = []
    for _, group in groupby(moving, lambda item: item.body):
        items = [*group]
        rows = items[0].body_pose[:3] @ np.hstack([item.shape.origin.matrix for item in items])
        poses.append(rows.reshape(3, len(items), 4).transpose(1, 0, 2))
    return compile_expressions(np.concatenate(poses))


def _static_pose(item: CollisionObject, poses: dict[str, Floats]) -> Floats:
    """Return the (3, 4) pose of an object that never moves; ``poses`` keeps those of bodies."""
    if item.body not in poses:
        poses[item.body] = item.body_pose({})
    pose: Floats = poses[item.body][:3] @ item.shape.origin.matrix
    if not (np.abs(pose) <= FURTHEST).all():
        raise InvalidValueError(
            f"Body '{item.body}' stands further than {FURTHEST:g} m away. Correct the model, or exclude it: "
            "Scene(model, leave_out=[...])."
        )
    return pose
