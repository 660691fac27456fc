"""Collision scene of a model: distances, contacts, ray casts and point queries at a state."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from kineverse.errors import InvalidValueError, UnknownNameError, suggest
from kineverse.lie import inverse
from kineverse.model.frame import WORLD
from kineverse.model.kinematics import ancestors
from kineverse.model.model_view import ModelView
from kineverse.state import StateLike
from kineverse.symbols import Symbol

from . import distance_queries, rays
from .broadphase import Flags
from .collision_filter import Rule
from .collision_world import CollisionWorld
from .dependence import FrameDependence
from .distance_expressions import DistanceParameters, PairDistance, distance_expression, distance_parameters
from .mesh_files import Floats
from .objects import Exclusion
from .results import DistanceResult, DistanceResults, NearestPoint, RayHit

_MAX_SELECTIONS = 32


class Scene:
    """The bodies of a model and where they are, for one thread; as many side by side as wanted.

    It follows the model: after an edit the next question is about the new version. Bodies stand where the
    last :meth:`update` put them. Files are read when the first question needs them. A body without collision
    shapes is there as what is seen of it, a mesh as its convex hull.

    Parameters
    ----------
    model
        A model or a snapshot of one.
    rules
        Which pairs of bodies are looked at, beside those that the model keeps under ``geometry/rules``; see
        :class:`Rule`.
    triangles
        Bodies, or patterns, whose meshes stay as they are: surfaces without an inside.
    decomposed
        Bodies, or patterns, whose meshes are the convex hulls that ``kineverse decompose`` made of them, as
        far as they are in the cache; the log names the others, which are their one hull. Their files are read
        at once.
    leave_out
        Bodies, or patterns, that do not take part; or ``(body, number)``, the shape of a body that does not.

    Raises
    ------
    MissingDependencyError
        If coal is not installed.
    UnknownNameError
        If a rule, or another argument, is about a frame that does not exist.
    """

    def __init__(
        self,
        model: ModelView,
        *,
        rules: Iterable[Rule] = (),
        triangles: Iterable[str] = (),
        decomposed: Iterable[str] = (),
        leave_out: Iterable[Exclusion] = (),
    ) -> None:
        self.model = model
        self._world = CollisionWorld(model, rules, triangles, decomposed, leave_out)
        self._parameters: dict[tuple[str, str], DistanceParameters] = {}
        self._chosen: dict[tuple[Any, ...], Flags] = {}
        self._version: int | None = None

    @property
    def bodies(self) -> tuple[str, ...]:
        """The bodies that take part, in the order of the model."""
        self._world.follow()
        return self._world.bodies

    @property
    def inputs(self) -> tuple[Symbol, ...]:
        """The symbols that poses depend on: the order of a vector given to :meth:`update`."""
        self._world.follow()
        return self._world.inputs

    def update(self, state: StateLike | Sequence[float] | Floats) -> None:
        """Put everything where it is at a state.

        Parameters
        ----------
        state
            A state or a mapping from symbols or names to values, of which speeds are not needed; or the
            values of :attr:`inputs` as a vector, which is faster [m], [rad].

        Raises
        ------
        UnknownNameError
            If a value is missing or one is for a symbol that the model does not know.
        ShapeError
            If a vector has another length.
        InvalidValueError
            If a value is NaN or a pose is not finite or 1e12 m away, naming the bodies; then everything stays
            where it was.
        """
        self._world.update(state)

    def pose(self, body: str) -> npt.NDArray[np.float64]:
        """Return where a body was put, world_T_body, (4, 4) [m]."""
        mirror = self._world
        mirror.ready(())
        piece = mirror.members[mirror.number(body)][0]
        world_T_piece = np.vstack([mirror.table.poses[piece], [0.0, 0.0, 0.0, 1.0]])
        return np.asarray(world_T_piece @ inverse(mirror.pieces[piece].shape.origin.matrix))

    # -- distances -----------------------------------------------------------------------------------------

    def distance(self, a: str, b: str) -> DistanceResult:
        """Return how near two bodies are, whatever the rules say.

        Raises
        ------
        UnknownNameError
            If one of them has no shapes, or there was no :meth:`update` yet.
        KineverseError
            If one of its shapes cannot be used, naming body and file.
        """
        return distance_queries.find_distance(self._world, a, b)

    def distances(self, pairs: Iterable[tuple[str, str]]) -> list[DistanceResult]:
        """Return how near the two bodies of each pair are, in the order of the pairs."""
        return [distance_queries.find_distance(self._world, a, b) for a, b in pairs]

    def around(self, body: str, radius: float = math.inf) -> list[DistanceResult]:
        """Return how near others are to a body, ``a`` in the results, nearest first, within a radius [m]."""
        return distance_queries.find_distances_to(self._world, body, radius)

    def within(self, radius: float) -> DistanceResults:
        """Return all pairs of bodies within a radius of each other [m], nearest first.

        Bounds are carried from one state to the next, so that the cost follows what is near.
        """
        return distance_queries.find_pairs_within(self._world, radius)

    def between(self, one: str, other: str, radius: float) -> DistanceResults:
        """Return the pairs within a radius [m] of which one body is at or below each of two frames."""
        return distance_queries.find_pairs_within(
            self._world, radius, self._wanted(("between", one, other), self._both_below)
        )

    def inside(self, frame: str, radius: float) -> DistanceResults:
        """Return the pairs within a radius [m] that are both at or below a frame: self-collision."""
        return self.between(frame, frame, radius)

    def expression(self, a: str, b: str) -> PairDistance:
        """Return the signed distance of two bodies as an expression, exact to first order at the state now.

        At other states give it :meth:`expression_values` of there. The symbols are the same every time, and
        those that the model has, if it keeps a distance of these two.
        """
        closest, *poses = self._with_poses(a, b)
        if (a, b) not in self._parameters:
            self._parameters[a, b] = distance_parameters(self.model, closest, *poses)
        return distance_expression(self.model, a, b, self._parameters[a, b])

    def expression_values(self, pairs: PairDistance | Iterable[PairDistance]) -> dict[Symbol, float]:
        """Return the values that the parameters of distances have now, for ``state | kv.State(values)``."""
        values: dict[Symbol, float] = {}
        for pair in [pairs] if isinstance(pairs, PairDistance) else pairs:
            values.update(pair.values(*self._with_poses(pair.a, pair.b)))
        return values

    def _with_poses(self, a: str, b: str) -> tuple[DistanceResult, Floats, Floats]:
        return self.distance(a, b), self.pose(a), self.pose(b)

    def first_contact(self, margin: float = 0.0) -> DistanceResult | None:
        """Return the first pair found within a margin [m], always the same at a state; None if none is."""
        return distance_queries.find_first_contact(self._world, margin)

    @property
    def in_collision(self) -> bool:
        """Whether any pair touches."""
        return self.first_contact() is not None

    def checks_pair(self, a: str, b: str) -> bool:
        """Return whether a pair is looked at, by adjacency and rules."""
        one, other = self._world.number(a), self._world.number(b)
        return bool(self._world.table.allowed[one, other])

    def find_never_colliding(self, states: Iterable[StateLike], margin: float = 0.0) -> tuple[Rule, ...]:
        """Return rules that except the pairs which are within a margin [m] at none of some states.

        That is an observation and no proof: choose states over the whole range. The scene stays at the last.

        Raises
        ------
        InvalidValueError
            If there are no states.
        """
        met: set[frozenset[str]] = set()
        every = list(states)
        if not every:
            raise InvalidValueError("What never touches is seen at states, and none is given.")
        for state in every:
            self.update(state)
            met.update(frozenset((found.a, found.b)) for found in self.within(margin))
        bodies, table = self.bodies, self._world.table.allowed
        pairs = [(a, b) for k, a in enumerate(bodies) for m, b in enumerate(bodies[:k]) if table[k, m]]
        why = f"never within {margin:g} m at {len(every)} states"
        return tuple(Rule(b, a, False, why) for a, b in pairs if frozenset((a, b)) not in met)

    # -- rays and points -----------------------------------------------------------------------------------

    def ray(self, origin: npt.ArrayLike, direction: npt.ArrayLike, length: float = math.inf) -> RayHit | None:
        """Return what a ray meets first, None if nothing.

        Parameters
        ----------
        origin, direction
            (3,) in the world [m]; the direction has any length but 0.
        length
            How far to look [m].
        """
        return rays.cast_ray(self._world, origin, direction, length)

    def point(self, point: npt.ArrayLike, radius: float = math.inf) -> NearestPoint | None:
        """Return what is nearest to a point (3,) in the world within a radius [m], None if nothing is.

        Of what the point is inside of, that is where it is deepest. Triangles have no inside.
        """
        return rays.find_nearest_point(self._world, point, radius)

    # -- symbols -------------------------------------------------------------------------------------------

    def moved_by(self, symbols: Symbol | str | Iterable[Symbol | str]) -> tuple[str, ...]:
        """Return the bodies that move in the world with some symbols, in the order of the model.

        A wheel's speed moves the whole robot, the crank of a loop all that follows it.

        Raises
        ------
        UnknownNameError
            For a symbol that the model does not know.
        """
        motion = FrameDependence(self.model, _as_list(symbols))
        return tuple(body for body in self.bodies if motion.moves(body))

    def pairs_affected_by(
        self, symbols: Symbol | str | Iterable[Symbol | str]
    ) -> tuple[tuple[str, str], ...]:
        """Return the pairs that are looked at whose distance depends on some symbols."""
        motion = FrameDependence(self.model, _as_list(symbols))
        bodies, table = self.bodies, self._world.table.allowed
        ones, others = np.nonzero(np.triu(table))
        pairs = ((bodies[i], bodies[j]) for i, j in zip(ones.tolist(), others.tolist(), strict=True))
        return tuple(pair for pair in pairs if motion.moves_between(*pair))

    def pairs_near_moving(
        self, symbols: Symbol | str | Iterable[Symbol | str], radius: float
    ) -> DistanceResults:
        """Return the pairs within a radius [m] whose distance depends on some symbols, nearest first."""
        return distance_queries.find_pairs_within(
            self._world, radius, self._wanted(("moved by", *_as_list(symbols)), self._moving_apart)
        )

    def _wanted(self, key: tuple[Any, ...], choose: Callable[..., npt.NDArray[np.bool_]]) -> Flags:
        """Return the pairs that are looked at and chosen, (B, B); kept for this version of the model."""
        self._world.follow()
        if self._version != self.model.version or len(self._chosen) > _MAX_SELECTIONS:
            self._chosen.clear()
            self._version = self.model.version
        if key not in self._chosen:
            self._chosen[key] = np.ascontiguousarray(self._world.table.allowed * choose(*key[1:]))
        return self._chosen[key]

    def _both_below(self, one: str, other: str) -> npt.NDArray[np.bool_]:
        there = np.logical_and.outer(self._below(one), self._below(other))
        return np.asarray(there | there.T)

    def _moving_apart(self, *symbols: Symbol | str) -> npt.NDArray[np.bool_]:
        motion = FrameDependence(self.model, symbols)
        ways = [motion.way(body) for body in self.bodies]
        numbers = {way: k for k, way in enumerate(dict.fromkeys(ways))}
        number = np.array([numbers[way] for way in ways], dtype=int)
        return np.asarray(np.not_equal.outer(number, number))

    def _below(self, frame: str) -> npt.NDArray[np.bool_]:
        frames = self.model.frames
        if frame != WORLD and frame not in frames:
            raise UnknownNameError(f"There is no frame '{frame}'. {suggest(frame, frames, 'frame')}")
        lookup = frames.__getitem__
        return np.array(
            [frame in (WORLD, body) or frame in ancestors(body, lookup) for body in self.bodies], dtype=bool
        )

    def __repr__(self) -> str:
        return f"<Scene: {len(self._world.pieces)} pieces of {len(self._world.bodies)} bodies>"


def _as_list(symbols: Symbol | str | Iterable[Symbol | str]) -> list[Symbol | str]:
    return [symbols] if isinstance(symbols, Symbol | str) else list(symbols)
