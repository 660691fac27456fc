"""Queries about selected pairs of bodies, prepared once for many states."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from kineverse._threads import one_at_a_time
from kineverse.errors import InvalidValueError, ShapeError, UnknownNameError, suggest
from kineverse.model.frame import WORLD
from kineverse.model.frame_dependence import FrameDependence
from kineverse.model.kinematics import ancestors
from kineverse.model.model_view import ModelView
from kineverse.symbols import Symbol

from .bindings import FacingPoints, collision_library
from .broadphase import Flags, Indices, PairSelection
from .collision_world import CollisionWorld
from .distance_queries import check_radius, find_pairs_within
from .mesh_files import Floats
from .objects import matches_pattern
from .results import DistanceResults
from .sampled_motion import SampledMotion

PairFlags: TypeAlias = npt.NDArray[np.bool_] | Flags
"""Flags (B, B) of pairs of bodies, symmetric."""


class PreparedQuery:
    """Query for the near pairs among some pairs of bodies, created by :meth:`.Scene.watch`.

    A call returns the pairs within the radius at the scene's present state, nearest first. The pairs are
    selected again only after an edit of the model.

    Parameters
    ----------
    world
        The collision world.
    choose
        Function that returns the selected pairs, for the present version of the model.
    radius
        Largest distance of the results [m].
    per_shape
        True for one result for each pair of collision objects, False for the nearest of each pair of bodies.
    """

    def __init__(
        self, world: CollisionWorld, choose: Callable[[], PairFlags], radius: float, per_shape: bool = False
    ) -> None:
        check_radius(radius)
        self._world, self._choose, self._lock = world, choose, world.lock
        self.radius, self.per_shape = float(radius), per_shape
        self._version: int | None = None
        self._flags: Flags = np.zeros((0, 0), dtype=np.uint8)
        self._selection: PairSelection | None = None
        self._motion: SampledMotion | None = None

    def __call__(self, radius: float | None = None, facing: FacingPoints | None = None) -> DistanceResults:
        """Return the selected pairs within the radius [m], or within another one, nearest first.

        With ``facing``, pairs with parallel faces are there with further facing points.
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
        within = self.radius if radius is None else radius
        check_radius(within)
        with self._lock:
            found = self._world.search_at(values, within, self._select(), self.per_shape, facing)
            if found is not None:
                return DistanceResults(self._world, *found)
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
        ShapeError
            If Q has another shape.
        InvalidValueError
            If the radius is negative or NaN, or a pose is not finite.
        """
        within = self.radius if radius is None else radius
        check_radius(within)
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
        within = self.radius if radius is None else radius
        check_radius(within)
        motion = self._move(coordinates)
        found = motion.struct
        for _ in motion.find_rows(_as_rows(Q, len(coordinates)), within, first=False):
            near = self(found.limit)
            if len(near):
                found.least = min(found.least, float(near.distances[0]))
                found.limit = max(found.least, 0.0)
        return float(found.least)

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
        """Return the selected pairs, whose objects have solids."""
        world = self._world
        if self._selection is None or self._version != world.model.version:
            flags = self._selected()
            involved = np.asarray(flags.any(axis=1))
            world.load(np.flatnonzero(involved[world.table.body]).tolist())
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
        """Return the flags of the selected pairs at the model's present version."""
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
    one, other = world.body_index(a), world.body_index(b)
    if one == other:
        raise InvalidValueError(f"'{a}' is asked for its distance to itself.")
    flags = np.zeros_like(world.table.allowed)
    flags[one, other] = flags[other, one] = 1
    return flags


def flag_between(ones: PairFlags, others: PairFlags) -> npt.NDArray[np.bool_]:
    """Return (B, B) flags of the pairs with one body of some, (B,), and the other of others, (B,)."""
    between = np.logical_and.outer(ones, others)
    return np.asarray(between | between.T)


def flag_matching(bodies: Sequence[str], patterns: str | Iterable[str]) -> npt.NDArray[np.bool_]:
    """Return (B,) flags of the bodies that match one of some names or patterns."""
    found = np.zeros(len(bodies), dtype=bool)
    for pattern in (patterns,) if isinstance(patterns, str) else tuple(patterns):
        matching = np.array([matches_pattern(body, (pattern,)) for body in bodies], dtype=bool)
        if not matching.any():
            raise UnknownNameError(
                f"No body of the scene is named or matched by '{pattern}'. {suggest(pattern, bodies, 'body')}"
            )
        found |= matching
    return found


def flag_subtree(model: ModelView, bodies: Sequence[str], frame: str) -> npt.NDArray[np.bool_]:
    """Return (B,) flags of the bodies at or below a frame."""
    frames = model.frames
    if frame != WORLD and frame not in frames:
        raise UnknownNameError(f"There is no frame '{frame}'. {suggest(frame, frames, 'frame')}")
    lookup = frames.__getitem__
    return np.array(
        [frame in (WORLD, body) or frame in ancestors(body, lookup) for body in bodies], dtype=bool
    )


def flag_relatively_moving(
    model: ModelView, bodies: Sequence[str], symbols: Iterable[Symbol | str]
) -> npt.NDArray[np.bool_]:
    """Return (B, B) flags of the pairs whose relative pose depends on some symbols."""
    motion = FrameDependence(model, symbols)
    ancestors_of = [motion.moving_ancestors(body) for body in bodies]
    numbers = {moving: k for k, moving in enumerate(dict.fromkeys(ancestors_of))}
    number = np.array([numbers[moving] for moving in ancestors_of], dtype=int)
    return np.asarray(np.not_equal.outer(number, number))
