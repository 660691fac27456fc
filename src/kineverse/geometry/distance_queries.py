"""Distance queries between bodies: bounds first, exact distances for the rest."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from kineverse._names import match_names
from kineverse._runtime import one_at_a_time
from kineverse.errors import InvalidValueError, KineverseError, ShapeError, UnknownNameError, suggest
from kineverse.model.frame import WORLD
from kineverse.model.frame_dependence import FrameDependence
from kineverse.model.kinematics import ancestors
from kineverse.model.model_view import ModelView
from kineverse.symbols import Symbol

from .bindings import FacingPoints, MotionStruct, collision_library
from .broadphase import Flags, Indices, PairSelection
from .collision_world import CollisionWorld
from .mesh_files import Floats
from .narrowphase import ACCURACY
from .results import DistanceResult, DistanceResults


def find_distance(world: CollisionWorld, a: str, b: str) -> DistanceResult:
    """Return the distance of two bodies, regardless of the rules."""
    one, other = _two_bodies(world, a, b)
    members, others = world.members[one], world.members[other]
    world.prepare((*members, *others))
    pairs = _pair_product(members, others)
    radius, lows = math.inf, np.full(len(pairs), -math.inf)
    if len(pairs) > 1:
        # The distance of the most promising pair bounds the answer from above.
        lows = world.table.lower_bounds(pairs[:, 0], pairs[:, 1])
        first = np.argmin(lows)
        (promising,), _ = world.measure(pairs[[first]], np.zeros(1), math.inf)
        radius = float(promising) + ACCURACY
        near = lows <= radius
        near[first] = True  # triangles may be reported deeper than their boxes overlap
        pairs, lows = pairs[near], lows[near]
    (result,) = _nearest_pairs(world, pairs, lows, radius)
    return result if result.a == a else result.swap()


def find_pairs_within(
    world: CollisionWorld,
    radius: float,
    selection: PairSelection | None = None,
    per_shape: bool = False,
    facing: FacingPoints | None = None,
) -> DistanceResults:
    """Return the pairs of bodies within a radius [m], nearest first.

    All checked pairs are searched, or only the selected ones. If ``per_shape``, the results are all pairs of
    collision objects, else the nearest of each pair of bodies. Selected objects have solids already. With
    ``facing``, near pairs have further facing points.
    """
    check_radius(radius)
    world.prepare(None if selection is None else ())
    table, reach = world.table, radius + ACCURACY
    measured, nearest = collision_library.search(table, reach, radius, selection, per_shape, facing)
    if measured is None:
        assert nearest is not None
        return DistanceResults(world, *nearest)
    pairs, lows, distances, witnesses = measured
    world.measure_remaining(pairs, lows, radius, distances, witnesses, per_shape)
    order = collision_library.rank(table, pairs, distances, radius, per_shape)
    ranked = collision_library.gather(table, pairs, distances, witnesses, order)
    if facing is not None:
        ranked = collision_library.extend(table, ranked, facing)
    return DistanceResults(world, *ranked)


def find_first_contact(world: CollisionWorld, margin: float) -> DistanceResult | None:
    """Return the first pair within a margin [m], in the order of the objects; None if there is none."""
    check_radius(margin)
    world.prepare()
    pairs, _ = collision_library.near(world.table, margin + ACCURACY)
    pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
    distances, witnesses = collision_library.measure(world.table, pairs, margin)
    for k in np.flatnonzero(~(distances > margin)).tolist():
        only = slice(k, k + 1)
        if math.isnan(distances[k]):
            world.measure_remaining(pairs[only], np.zeros(1), margin, distances[only], witnesses[only])
        if distances[k] <= margin:
            found = collision_library.gather(world.table, pairs, distances, witnesses, np.array([k]))
            return DistanceResults(world, *found)[0]
    return None


def find_distances_to(world: CollisionWorld, body: str, radius: float) -> list[DistanceResult]:
    """Return the distances of one body to the others within a radius [m], nearest first."""
    check_radius(radius)
    one = world.body_index(body)
    world.prepare()
    table = world.table
    pairs = _pair_product(world.members[one], np.flatnonzero(table.allowed[one][table.body] == 1).tolist())
    lows = table.lower_bounds(pairs[:, 0], pairs[:, 1])
    near = lows <= radius + ACCURACY
    nearest = _nearest_pairs(world, pairs[near], lows[near], radius)
    return [result if result.a == body else result.swap() for result in nearest]


def _pair_product(members: list[int], others: list[int]) -> Indices:
    """Return all pairs (K, 2) of two lists, the smaller index first."""
    left, right = np.repeat(members, len(others)), np.tile(others, len(members))
    return np.stack([np.minimum(left, right), np.maximum(left, right)], axis=1).astype(np.int32)


def _nearest_pairs(world: CollisionWorld, pairs: Indices, lows: Floats, radius: float) -> DistanceResults:
    """Measure pairs of objects, and return the nearest of each pair of bodies within a radius [m]."""
    distances, witnesses = world.measure(pairs, lows, radius)
    order = collision_library.rank(world.table, pairs, distances, radius)
    return DistanceResults(world, *collision_library.gather(world.table, pairs, distances, witnesses, order))


def check_radius(radius: float) -> float:
    """Return a radius; raise InvalidValueError if it is negative or NaN."""
    if not radius >= 0.0:
        raise InvalidValueError(f"A radius is a distance from 0 on [m], not {radius!r}.")
    return radius


_ROOM = 64  # number of samples whose poses are kept at a time


class SampledMotion:
    """Motion of the objects that some coordinates move, at the present version of a model."""

    def __init__(self, world: CollisionWorld, selected: Flags, coordinates: Sequence[Symbol]) -> None:
        self._world, self.coordinates, self.version = world, tuple(coordinates), world.model.version
        self._selected = np.ascontiguousarray(selected, dtype=np.uint8)
        wanted, moves = {*coordinates}, np.zeros(world.table.count, dtype=bool)
        for k, item in enumerate(world.objects[: world.table.moving]):
            moves[k] = not wanted.isdisjoint(item.body_pose.symbols)
        involved = np.asarray(self._selected.any(axis=1))[world.table.body]
        self._moving, self._standing = (
            np.flatnonzero(flags & involved).astype(np.int32) for flags in (moves, ~moves)
        )
        moved_bodies = np.zeros(len(self._selected), dtype=bool)
        moved_bodies[world.table.body[self._moving]] = True
        self._has_still_pairs = bool(self._selected[np.ix_(~moved_bodies, ~moved_bodies)].any())
        place = {s: k for k, s in enumerate(world.inputs)}
        self._columns = np.array([place.get(s, -1) for s in coordinates], dtype=np.int64)
        self._moved = self._columns >= 0
        moved, still = len(self._moving), len(self._standing)
        self._placed, self._boxes = np.empty((moved, _ROOM, 22)), np.empty((7, still))
        self._inputs, self._outputs = np.zeros(len(world.inputs)), np.empty((world.table.moving, 12))
        arrays = self._moving, self._standing, self._selected, self._placed, self._boxes
        more = self._inputs, self._outputs, self._columns
        self.struct = MotionStruct(
            moved, still, _ROOM, *(a.ctypes.data for a in arrays), None, *(a.ctypes.data for a in more)
        )
        self.struct.coordinates = len(self._columns)

    def find_rows(self, Q: Floats, limit: float, first: bool) -> Iterator[int]:
        """Place the world at configurations (N, n) one after the other, and yield their indices.

        Those configurations are passed over at which C finds no pair within the limit [m]. If not ``first``,
        it passes over configurations with near pairs as well, and shrinks ``limit`` and ``least``. The world
        is placed where it was before when all configurations are done.
        """
        world, s = self._world, self.struct
        s.limit, s.least, s.first = limit, np.inf, first
        before = world.values
        values, away = before.copy(), False
        for k in self._pass_over(Q, before):
            values[self._columns[self._moved]] = Q[k, self._moved]
            world.update(values)
            away = True
            yield k
        if away:
            world.update(before)

    def _pass_over(self, Q: Floats, before: Floats) -> Iterator[int]:
        """Yield the indices of the configurations that C does not pass over."""
        code, table = collision_library.code, self._world.table
        if code is None:
            yield from range(len(Q))
            return
        address, motion = collision_library.bind(table), ctypes.addressof(self.struct)
        # Pairs that stand still are as near as at the first one everywhere.
        begin = 0
        if self._has_still_pairs and len(Q):
            yield 0
            begin = 1
        while begin < len(Q) and self.struct.moved:
            rows = np.ascontiguousarray(Q[begin : begin + _ROOM])
            count = code.settle(address, motion, self._trace(rows, before))
            if not count:
                yield begin  # the poses are not finite, and an update says so
                count = 1
            k = -1
            while (k := code.advance(address, motion, k + 1, count)) >= 0:
                yield begin + k
            begin += count

    def _trace(self, rows: Floats, before: Floats) -> int:
        """Compute the poses at some configurations, and return the number of those that have any."""
        self._inputs[:] = before
        address = self._world.kinematics_address
        if address is not None:
            self.struct.compute = address
            return int(
                collision_library.code.trace(ctypes.addressof(self.struct), rows.ctypes.data, len(rows))
            )
        for k, row in enumerate(rows):
            self._inputs[self._columns[self._moved]] = row[self._moved]
            try:
                poses = self._world.compute_poses(self._inputs)
            except KineverseError:
                return k
            self._placed[:, k, :12] = poses[self._moving].reshape(-1, 12)
        return len(rows)


PairFlags: TypeAlias = npt.NDArray[np.bool_] | Flags  # flags (B, B) of pairs of bodies, symmetric


class PreparedQuery:
    """Query for the near pairs among some pairs of bodies, created by :meth:`.Scene.watch`.

    A call returns the pairs within the radius at the scene's present state, nearest first. The pairs are
    selected again only after an edit of the model.

    Parameters
    ----------
    choose
        Function that returns the selected pairs, for the present version of the model.
    radius
        Largest distance of the results [m].
    per_shape
        True for one result for each pair of collision objects, False for the nearest of each pair of bodies.

    See Also
    --------
    kineverse.geometry.Scene.watch
    """

    def __init__(
        self, world: CollisionWorld, choose: Callable[[], PairFlags], radius: float, per_shape: bool = False
    ) -> None:
        self._world, self._choose, self._lock = world, choose, world.lock
        self.radius, self.per_shape = float(check_radius(radius)), per_shape
        self._version: int | None = None
        self._flags: Flags = np.zeros((0, 0), dtype=np.uint8)
        self._selection: PairSelection | None = None
        self._motion: SampledMotion | None = None

    def __call__(self, radius: float | None = None, facing: FacingPoints | None = None) -> DistanceResults:
        """Return the selected pairs within the radius [m], or within another one, nearest first.

        With ``facing``, near pairs of parallel faces have further points.
        """
        within = self.radius if radius is None else radius
        with self._lock:
            return find_pairs_within(self._world, within, self._select(), self.per_shape, facing)

    def at(
        self, values: Floats, radius: float | None = None, facing: FacingPoints | None = None
    ) -> DistanceResults:
        """Place the scene, and return the near pairs there: an update and a query in one.

        Parameters
        ----------
        values
            Values of the scene's ``inputs`` as a vector [m], [rad].
        radius, facing
            As for a call.

        Raises
        ------
        UnknownNameError, ShapeError, InvalidValueError
            As :meth:`.Scene.update`.
        """
        within = check_radius(self.radius if radius is None else radius)
        with self._lock:
            result = self._world.search_at(values, within, self._select(), self.per_shape, facing)
            if result is not None:
                return DistanceResults(self._world, *result)
            self._world.update(values)
            return self(within, facing)

    @one_at_a_time
    def first_within(
        self, coordinates: Sequence[Symbol | str], Q: npt.ArrayLike, radius: float | None = None
    ) -> int | None:
        """Return the index of the first configuration at which a selected pair is within the radius.

        The answer is that of an update and a query at each configuration; nothing between them is looked at.
        Everything else stands as at the scene's last update. The scene is placed at the configuration that is
        found; without any, it stays where it is.

        Parameters
        ----------
        coordinates
            The n coordinates that move, as symbols or names.
        Q
            Configurations (N, n) in the order of a motion. A pair is looked at only where it may have come
            near since it was last looked at (conservative advancement).
        radius
            Largest distance [m]; 0 for contacts, None for that of the query.

        Raises
        ------
        UnknownNameError
            If the scene was not updated yet, or the model has no such coordinate.
        InvalidValueError
            If the radius is negative or NaN, or a pose is not finite.
        """
        within = check_radius(self.radius if radius is None else radius)
        for k in self._move(coordinates).find_rows(_as_rows(Q, len(coordinates)), within, first=True):
            if len(self(within)):
                return k
        return None

    @one_at_a_time
    def least_distance(
        self, coordinates: Sequence[Symbol | str], Q: npt.ArrayLike, radius: float | None = None
    ) -> float:
        """Return the least distance of the selected pairs at configurations [m]; infinite beyond the radius.

        Parameters and errors are those of :meth:`first_within`. The scene stays where it is.
        """
        within = check_radius(self.radius if radius is None else radius)
        motion = self._move(coordinates)
        result = motion.struct
        for _ in motion.find_rows(_as_rows(Q, len(coordinates)), within, first=False):
            near = self(result.limit)
            if len(near):
                result.least = min(result.least, float(near.distances[0]))
                result.limit = max(result.least, 0.0)
        return float(result.least)

    @one_at_a_time
    def prepare(self) -> None:
        """Make what the first query makes otherwise: solids of the selected bodies, tables; without a state.

        Raises
        ------
        KineverseError
            If a solid cannot be made; the message names body and file.
        """
        self._select()
        if collision_library.is_native:
            collision_library.bind(self._world.table)

    def _select(self) -> PairSelection:
        world = self._world
        if self._selection is None or self._version != world.model.version:
            flags = self._selected()
            world.load(np.flatnonzero(np.asarray(flags.any(axis=1))[world.table.body]).tolist())
            world.table.choose_axis()
            self._selection = PairSelection(world.table, flags)
        return self._selection

    def _move(self, coordinates: Sequence[Symbol | str]) -> SampledMotion:
        """Return the motion of some coordinates, which is kept for the next call."""
        world, selection, last = self._world, self._select(), self._motion
        world.prepare(())
        symbols = tuple(s if isinstance(s, Symbol) else world.model.symbol(s) for s in coordinates)
        if last is None or last.version != world.model.version or last.coordinates != symbols:
            last = self._motion = SampledMotion(world, selection.bodies, symbols)
        return last

    @property
    def pairs(self) -> Indices:
        """Selected pairs (K, 2), by the indices of their bodies in the order of the scene's ``bodies``."""
        return np.argwhere(np.triu(self._selected())).astype(np.int32)

    def _selected(self) -> Flags:
        self._world.synchronize()
        if self._version != self._world.model.version:
            self._selection = None
            self._flags = np.asarray(self._choose(), dtype=np.uint8)
            self._version = self._world.model.version
        return self._flags

    def __repr__(self) -> str:
        what = "pairs of bodies, each pair of shapes" if self.per_shape else "pairs of bodies"
        return f"<PreparedQuery: {len(self.pairs)} {what}, within {self.radius:g} m>"


def _as_rows(Q: npt.ArrayLike, columns: int) -> Floats:
    rows = np.ascontiguousarray(Q, dtype=float)
    if rows.ndim != 2 or rows.shape[1] != columns:
        raise ShapeError(f"Expected configurations of shape (N, {columns}), not {rows.shape}.")
    return rows


def flag_pair(world: CollisionWorld, a: str, b: str) -> Flags:
    """Return (B, B) flags of one pair of bodies."""
    one, other = _two_bodies(world, a, b)
    flags = np.zeros_like(world.table.allowed)
    flags[one, other] = flags[other, one] = 1
    return flags


def _two_bodies(world: CollisionWorld, a: str, b: str) -> tuple[int, int]:
    one, other = world.body_index(a), world.body_index(b)
    if one == other:
        raise InvalidValueError(f"'{a}' is asked for its distance to itself.")
    return one, other


def flag_between(ones: PairFlags, others: PairFlags) -> npt.NDArray[np.bool_]:
    """Return (B, B) flags of the pairs with one body of some, (B,), and the other of others, (B,)."""
    between = np.logical_and.outer(ones, others)
    return np.asarray(between | between.T)


def flag_matching(bodies: Sequence[str], patterns: str | Iterable[str]) -> npt.NDArray[np.bool_]:
    """Return (B,) flags of the bodies that match one of some names or patterns."""
    matching = {*match_names(patterns, bodies, "body of the scene")}
    return np.array([body in matching for body in bodies], dtype=bool)


def flag_subtree(model: ModelView, bodies: Sequence[str], frame: str) -> npt.NDArray[np.bool_]:
    """Return (B,) flags of the bodies at or below a frame."""
    frames = model.frames
    if frame != WORLD and frame not in frames:
        raise UnknownNameError(f"There is no frame '{frame}'. {suggest(frame, frames, 'frame')}")
    lookup, always = frames.__getitem__, frame == WORLD
    return np.array([always or frame == b or frame in ancestors(b, lookup) for b in bodies], dtype=bool)


def flag_relatively_moving(
    model: ModelView, bodies: Sequence[str], symbols: Iterable[Symbol | str]
) -> npt.NDArray[np.bool_]:
    """Return (B, B) flags of the pairs whose relative pose depends on some symbols."""
    motion = FrameDependence(model, symbols)
    ancestors_of = [motion.moving_ancestors(body) for body in bodies]
    numbers = {moving: k for k, moving in enumerate(dict.fromkeys(ancestors_of))}
    number = np.array([numbers[moving] for moving in ancestors_of], dtype=int)
    return np.asarray(np.not_equal.outer(number, number))
