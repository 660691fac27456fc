"""Collision objects of a model in tables for distance computation, at one state."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from kineverse.compile.function import compile as compile_expressions
from kineverse.errors import (
    InvalidValueError,
    KineverseError,
    UnknownNameError,
    duplicate_value_error,
    suggest,
)
from kineverse.model.model_view import ModelView
from kineverse.state import State, StateLike
from kineverse.symbols import Symbol

from .bindings import collision_library
from .broadphase import FURTHEST, TRAVEL_EXCEEDED, Indices, ObjectTable
from .collision_filter import Rule, allowed_pairs, check_frame_names, parse_rules, read_rules
from .mesh_files import Floats
from .narrowphase import ACCURACY, Narrowphase
from .objects import CollisionObject, CollisionObjects, Exclusion, load_solids
from .shapes import Solid

_MOST_KNOWN = 200_000


class CollisionWorld:
    """The pieces of a model and where they are; for one thread.

    Parameters
    ----------
    model
        What is mirrored, at whatever version it is.
    rules
        Beside those that the model keeps; they come after them.
    triangles, decomposed, leave_out
        Patterns of bodies whose meshes stay triangles, of those whose meshes are the hulls that they were
        decomposed into, and of bodies that do not take part, or bodies with the number of a shape.

    Attributes
    ----------
    pieces
        In the order of the table: those that move first, each group in the order of the bodies.
    bodies
        The names of the bodies that have pieces, in the order of the model.
    members
        The numbers of the pieces of each body, in the order of :attr:`bodies`.
    table, narrow
        See there.
    """

    def __init__(
        self,
        model: ModelView,
        rules: Iterable[Rule],
        triangles: Iterable[str],
        decomposed: Iterable[str],
        leave_out: Iterable[Exclusion],
    ) -> None:
        self.model = model
        self._own_rules = parse_rules(rules)
        check_frame_names("A rule is about", (name for rule in self._own_rules for name in rule[:2]), model)
        patterns = tuple(_as_names(names) for names in (triangles, decomposed, leave_out))
        for what, names in zip(("triangles", "decomposed", "leave_out"), patterns, strict=True):
            bodies = (name if isinstance(name, str) else name[0] for name in names)
            check_frame_names(f"{what}= names", bodies, model)
        self._source = CollisionObjects(*patterns)
        self._version: int | None = None
        self._values: dict[Symbol, float] = {}
        self._unplaced = ""
        self._evaluator: Any = None
        self.inputs: tuple[Symbol, ...] = ()
        self.pieces: list[CollisionObject] = []
        self.bodies: tuple[str, ...] = ()
        self.members: list[list[int]] = []
        self._solids: list[Solid | None] = []
        self._all_loaded = False
        self.table = ObjectTable(0, np.zeros(0, dtype=np.int32), np.zeros((0, 0), dtype=np.uint8))
        collision_library.prepare()
        self.follow()

    # -- the model -----------------------------------------------------------------------------------------

    def follow(self) -> None:
        """Catch up with the model's version: what is the same keeps its solids, travel and bounds."""
        if self._version == self.model.version:
            return
        version = self.model.version
        rules = (*read_rules(self.model), *self._own_rules)
        if self._source.follow(self.model):
            try:
                self._rebuild(rules)
            except BaseException:
                self._source.forget()  # so that the next question finds a difference again
                raise
        else:
            # Other frames may have come in between, and with them other neighbours.
            self.table.allowed[:] = allowed_pairs(self.model, self.bodies, rules)
        self._version = version

    def _rebuild(self, rules: Sequence[Rule]) -> None:
        by_body = self._source.by_body
        before, old = {id(piece): k for k, piece in enumerate(self.pieces)}, self.table
        old_solids = self._solids
        everything = [piece for pieces in by_body.values() for piece in pieces]
        moving = [piece for piece in everything if piece.moves]
        same = moving == self.pieces[: old.moving]
        self.pieces = [*moving, *(piece for piece in everything if not piece.moves)]
        self.bodies = tuple(by_body)
        number = {name: k for k, name in enumerate(self.bodies)}
        body = np.array([number[piece.body] for piece in self.pieces], dtype=np.int32)
        self.members = [[] for _ in self.bodies]
        for k, owner in enumerate(body.tolist()):
            self.members[owner].append(k)
        self.table = table = ObjectTable(len(moving), body, allowed_pairs(self.model, self.bodies, rules))
        kept = [(k, before[id(piece)]) for k, piece in enumerate(self.pieces) if id(piece) in before]
        self._solids = [None] * len(self.pieces)
        for new, previous in kept:
            self._solids[new] = old_solids[previous]
        table.take_over(old, np.array(kept, dtype=int).reshape(-1, 2))
        known = {new for new, _ in kept}
        for k in range(len(moving), len(self.pieces)):
            if k not in known:
                table.poses[k] = _static_pose(self.pieces[k])
        table.put(np.arange(table.count))
        self._all_loaded = all(solid is not None for solid in self._solids)
        self.narrow = Narrowphase(self._solids, table.poses)
        self._travel = table.travel.data
        self._bounds: Any = None if table.bounds is None else table.bounds.data
        self._known: dict[tuple[int, int], tuple[float, float, float, Floats]] = {}
        if not same:
            self._compile([piece.pose for piece in moving])
        self._place_again()

    def _compile(self, poses: list[Any]) -> None:
        function = compile_expressions(np.stack(poses)) if poses else None
        self.inputs = function.inputs if function else ()
        self._evaluator = function.bind() if function else None

    # -- the state -----------------------------------------------------------------------------------------

    def update(self, state: StateLike | Sequence[float] | Floats) -> None:
        """Place everything, see :meth:`Scene.update`."""
        self.follow()
        if isinstance(state, Mapping):
            state = self._relevant(state)
        if self._evaluator is not None:
            self._evaluator(state)
            self._place()
            self._values = dict(zip(self.inputs, self._evaluator.input.tolist(), strict=True))
        elif not isinstance(state, Mapping) and len(state):
            raise InvalidValueError(f"Nothing moves in this scene, and {len(state)} values are given.")
        self._unplaced = ""

    def _relevant(self, state: StateLike) -> StateLike:
        """Return the part of a mapping that poses depend on; the rest has to be known to the model."""
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
                piece.body
                for piece, pose in zip(self.pieces, self._evaluator.outputs[0], strict=False)
                if not (np.abs(pose) <= FURTHEST).all()
            )
            raise InvalidValueError(
                f"At this state the pose of {', '.join(map(repr, names))} is not finite, or further than "
                f"{FURTHEST:g} m away; nothing was moved."
            )
        if outcome == TRAVEL_EXCEEDED:
            self.table.forget_travel()
            self._known.clear()
        self.narrow.moved(self.table.moving)

    def _place_again(self) -> None:
        """Place everything at the last state after an edit, as far as that says where things are."""
        values = {s: self._values.get(s, s.value) for s in self.inputs}
        missing = [str(s) for s, value in values.items() if value is None]
        more = f" and {len(missing) - 12} more" if len(missing) > 12 else ""
        self._unplaced = f"There is no value for {', '.join(missing[:12])}{more}" if missing else ""
        if self._evaluator is None or missing:
            return
        try:
            self._evaluator(np.array([values[s] for s in self.inputs], dtype=float))
            self._place()
        except KineverseError as error:  # a loop that does not close, a root of what is negative
            self._unplaced = f"The last state has no poses after the edit ({error})"

    # -- questions -----------------------------------------------------------------------------------------

    def ready(self, pieces: Iterable[int] | None = None) -> None:
        """Catch up with the model, and make the solids of pieces, or of all.

        Raises
        ------
        UnknownNameError
            If there is no state that says where everything is.
        KineverseError
            If a solid cannot be made.
        """
        self.follow()
        if self._unplaced:
            raise UnknownNameError(f"{self._unplaced}: call scene.update(state) first.")
        if self._all_loaded:
            return
        wanted = [
            k for k in (range(len(self.pieces)) if pieces is None else pieces) if self._solids[k] is None
        ]
        # From the first measured distance on it is C that measures, or else never: answers do not change.
        collision_library.prepare(wait=True)
        first = self.table.active.any()
        for k, solid in zip(wanted, load_solids(self.pieces[k] for k in wanted), strict=True):
            self._solids[k] = solid
            self.table.give_solid(k, solid.centre, solid.half, solid.radius, solid.core)
        if wanted and (pieces is None or not first):
            self.table.choose_axis()
        self._all_loaded = pieces is None

    def measure(self, pairs: Indices, lows: Floats, limit: float) -> tuple[Floats, Floats]:
        """Measure pairs of pieces, of each pair of bodies at least the nearest.

        Parameters
        ----------
        pairs, lows
            (K, 2), the smaller number first, and (K,) lower bounds of their distances [m].
        limit
            How far is of interest [m].

        Returns
        -------
        distances, witnesses
            (K,) [m], more than the limit for what is further apart, infinite for what is not the nearest;
            (K, 9) the nearest points of both and the normal, where the distance is within the limit.
        """
        distances, witnesses = collision_library.measure(self.table, pairs, limit)
        if np.isnan(distances).any():
            self.measure_rest(pairs, lows, limit, distances, witnesses)
        return distances, witnesses

    def measure_rest(
        self, pairs: Indices, lows: Floats, limit: float, distances: Floats, witnesses: Floats
    ) -> None:
        """Have coal measure the pairs whose distance is NaN, see :meth:`measure`."""
        owners = self.table.body[pairs]
        keys = owners.min(axis=1).astype(np.int64) * len(self.bodies) + owners.max(axis=1)
        unsolved = np.flatnonzero(np.isnan(distances))
        # Most bodies have one piece, and then there is nobody to be nearer.
        nearest = _NearestByBodies(keys, distances) if len(np.unique(keys)) < len(keys) else None
        for k in unsolved[np.argsort(lows[unsolved], kind="stable")].tolist():
            if nearest is not None and nearest.is_nearer(k, lows[k]):
                distances[k] = math.inf
                continue
            i, j = pairs[k].tolist()
            distances[k], witness = self._measured(i, j, limit)
            if witness is not None:
                witnesses[k] = witness
            if nearest is not None:
                nearest.note(k, distances[k])

    def _measured(self, i: int, j: int, limit: float) -> tuple[float, Floats | None]:
        """Return distance and witness of two pieces, i < j, from memory if neither has moved since.

        Beyond a limit the distance is infinite, and there is no witness.
        """
        one, other = self._travel[i], self._travel[j]
        known = self._known.get((i, j))
        if known is not None and known[0] == one and known[1] == other:
            return (known[2], known[3]) if known[2] <= limit else (math.inf, None)
        distance = self.narrow.distance(i, j)
        if self._bounds is not None:
            self._bounds[i, j] = distance + one + other  # as Table.remember, in a fifth of the time
        if distance > limit:
            return math.inf, None
        witness = np.concatenate(self.narrow.witness())
        if len(self._known) >= _MOST_KNOWN:
            self._known.clear()
        self._known[i, j] = one, other, distance, witness
        return distance, witness

    def number(self, body: str) -> int:
        """Return the number of a body.

        Raises
        ------
        UnknownNameError
            If it has no pieces, with similar names.
        """
        self.follow()
        try:
            return self.bodies.index(body)
        except ValueError:
            what = "has no shapes here" if body in self.model.frames else "is no frame of the model"
            raise UnknownNameError(f"'{body}' {what}. {suggest(str(body), self.bodies, 'body')}") from None

    def solid(self, piece: int) -> Solid:
        """Return the solid of a piece that is there."""
        solid = self._solids[piece]
        assert solid is not None
        return solid


class _NearestByBodies:
    """How near the nearest pieces are that are known, by the key of their bodies."""

    def __init__(self, keys: npt.NDArray[np.int64], distances: Floats) -> None:
        self._keys = keys.tolist()
        self._least: dict[int, float] = {}
        for k in np.flatnonzero(~np.isnan(distances)).tolist():
            self.note(k, distances[k])

    def note(self, k: int, distance: float) -> None:
        """Take notice of a distance."""
        key = self._keys[k]
        self._least[key] = min(self._least.get(key, math.inf), distance)

    def is_nearer(self, k: int, low: float) -> bool:
        """Whether others are nearer; within the accuracy a pair that comes later may still be the nearest."""
        return low > self._least.get(self._keys[k], math.inf) + ACCURACY


def _static_pose(piece: CollisionObject) -> Floats:
    """Return the (3, 4) pose of a piece that never moves."""
    pose: Floats = piece.pose({})
    if not (np.abs(pose) <= FURTHEST).all():
        raise InvalidValueError(
            f"Body '{piece.body}' stands further than {FURTHEST:g} m away. Mend the model, or leave it out: "
            "Scene(model, leave_out=[...])."
        )
    return pose


def _as_names(names: Iterable[Any]) -> tuple[Any, ...]:
    return (names,) if isinstance(names, str) else tuple(names)
