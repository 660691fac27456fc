"""Collision scene of a model: distances, contacts, ray casts and point queries at a state."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from kineverse._names import answer_foreign_names
from kineverse._runtime import one_at_a_time
from kineverse._synonyms import SCENE_SYNONYMS
from kineverse.errors import InvalidValueError, NoSolutionError
from kineverse.model.frame_dependence import FrameDependence
from kineverse.model.model_view import ModelView
from kineverse.model.sampling import StateSamples
from kineverse.model.symbolic_view import cached_for_version
from kineverse.state import StateLike
from kineverse.symbols import Symbol

from . import distance_queries, rays
from .collision_filter import Rule, apply_rules, parse_known_rules
from .collision_world import CollisionWorld
from .distance_expressions import DistanceParameters, PairDistance, distance_expression, distance_parameters
from .distance_queries import (
    PairFlags,
    PreparedQuery,
    flag_between,
    flag_matching,
    flag_pair,
    flag_relatively_moving,
    flag_subtree,
)
from .mesh_files import Floats
from .objects import Exclusion
from .results import DistanceResult, DistanceResults, NearestPoint, RayHit

_MAX_QUERIES, _SAMPLES = 256, 200


@answer_foreign_names("A scene", SCENE_SYNONYMS)
@answer_foreign_names("A scene", SCENE_SYNONYMS)
class Scene:
    """Collision scene: the bodies of a model at one state, with distance, ray and point queries.

    A scene follows its model: after an edit, the next query is about the new version. Bodies have the poses
    of the last :meth:`update`. Mesh files are read when the first query needs them. A body without collision
    shapes is represented by its visual shapes, and a mesh by its convex hull. A scene is for one thread;
    several scenes of one model are independent of each other.

    Parameters
    ----------
    model
        A model or a snapshot of one.
    rules
        Rules of the collision filter, applied after those that the model keeps under ``geometry/rules``; see
        :class:`Rule`.
    triangles
        Bodies, or patterns, whose meshes stay triangle meshes: surfaces without an inside.
    decomposed
        Bodies, or patterns, whose meshes are replaced by the convex hulls that ``kineverse decompose`` made
        of them and cached. The log names meshes that are not in the cache; each of these is its one convex
        hull. These files are read at once.
    leave_out
        Excluded bodies, or patterns; or ``(body, number)``, one excluded shape of a body.

    Raises
    ------
    MissingDependencyError
        If coal is not installed.
    UnknownNameError
        If a rule, or another argument, names a frame that does not exist.

    Examples
    --------
    >>> model = kv.load("kitchen")
    >>> scene = kv.geometry.Scene(model)
    >>> scene.update(model.default_state())
    >>> near = scene.distance("kitchen/fridge_door", "kitchen/sink_area")
    >>> round(near.distance, 3), near.touches
    (0.002, False)
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
        self._lock = self._world.lock
        self._parameters: dict[tuple[str, str], DistanceParameters] = {}
        self._queries: dict[tuple[Any, ...], PreparedQuery] = {}

    @classmethod
    def of(cls, model: ModelView) -> Scene:
        """Return the scene of a version of a model that all share who need no rules of their own.

        Others place it elsewhere: update it before each query, and use it in one thread.
        """
        return cached_for_version(model, "scene", lambda: cls(model))

    @property
    def collision_world(self) -> CollisionWorld:
        """The collision objects in tables, for callers that compute with them."""
        return self._world

    @property
    def bodies(self) -> tuple[str, ...]:
        """The bodies of the scene, in the order of the model."""
        self._world.synchronize()
        return self._world.bodies

    @property
    def inputs(self) -> tuple[Symbol, ...]:
        """The symbols that poses depend on, in the order of a vector given to :meth:`update`."""
        self._world.synchronize()
        return self._world.inputs

    def update(self, state: StateLike | Sequence[float] | Floats) -> None:
        """Compute the poses of all bodies at a state.

        Parameters
        ----------
        state
            A state, or a mapping from symbols or names to values, in which speeds may be missing; or the
            values of :attr:`inputs` as a vector, which is faster [m], [rad].

        Raises
        ------
        UnknownNameError
            If a value is missing, or the model has no symbol of that name.
        InvalidValueError
            If a value is NaN, or a pose is not finite or 1e12 m away; the message names the bodies. Then all
            poses stay as they were.

        Examples
        --------
        >>> model = kv.load("kitchen")
        >>> scene = kv.geometry.Scene(model)
        >>> scene.update(model.default_state() | {"kitchen/fridge_door": 1.0})
        >>> scene.pose("kitchen/fridge_door")[:3, 3].round(3)
        array([ 1.169, -1.936,  1.334])
        """
        with self._lock:
            self._world.update(state)

    @one_at_a_time
    def pose(self, body: str) -> npt.NDArray[np.float64]:
        """Return the pose of a body at the last update, world_T_body, (4, 4) [m].

        See Also
        --------
        kineverse.geometry.Scene.update
        """
        self._world.prepare(())
        return self._world.body_pose(body)

    # -- distances -----------------------------------------------------------------------------------------

    def distance(self, a: str, b: str) -> DistanceResult:
        """Return the signed distance of two bodies, with the nearest points, regardless of the rules.

        Raises
        ------
        UnknownNameError
            If one of them has no shapes, or :meth:`update` was not called yet.
        KineverseError
            If one of its shapes cannot be used; the message names body and file.

        See Also
        --------
        kineverse.geometry.Scene
        """
        return distance_queries.find_distance(self._world, a, b)

    def distances(self, pairs: Iterable[tuple[str, str]]) -> list[DistanceResult]:
        """Return the distance of each pair of bodies, in the order of the pairs."""
        return [distance_queries.find_distance(self._world, a, b) for a, b in pairs]

    def distances_to(self, body: str, radius: float = math.inf) -> list[DistanceResult]:
        """Return the distances of a body to all bodies within a radius [m], nearest first.

        The body is ``a`` in the results.

        Examples
        --------
        >>> model = kv.load("kitchen")
        >>> scene = kv.geometry.Scene(model)
        >>> scene.update(model.default_state())
        >>> scene.distances_to("kitchen/oven_door", radius=0.02)[0].b
        'kitchen/oven_area'
        """
        return distance_queries.find_distances_to(self._world, body, radius)

    def pairs_within(self, radius: float) -> DistanceResults:
        """Return all pairs of bodies within a radius of each other [m], nearest first.

        Bounds are carried from one state to the next, so the cost grows with the number of near pairs.

        Examples
        --------
        >>> model = kv.load("fetch")
        >>> scene = kv.geometry.Scene(model)
        >>> scene.update(model.default_state())
        >>> near = scene.pairs_within(0.05)
        >>> near[0].a, near[0].b
        ('fetch/r_gripper_finger_link', 'fetch/l_gripper_finger_link')
        """
        return distance_queries.find_pairs_within(self._world, radius)

    def pairs_between(self, one: str, other: str, radius: float) -> DistanceResults:
        """Return the pairs within a radius [m] between the subtrees of two frames, nearest first.

        Examples
        --------
        >>> model = kv.load("fetch")
        >>> tags = model.include("kitchen")
        >>> scene = kv.geometry.Scene(model)
        >>> scene.update(model.default_state())
        >>> [(near.a, near.b) for near in scene.pairs_between("fetch/base_link", "kitchen/kitchen", 1.0)][:1]
        [('fetch/r_gripper_finger_link', 'kitchen/sink_left_upper_drawer')]
        """

        def choose() -> PairFlags:
            subtrees = (flag_subtree(self.model, self.bodies, frame) for frame in (one, other))
            return self._world.table.allowed * flag_between(*subtrees)

        return self._query_pairs(("between", one, other), choose)(radius)

    def watch(
        self,
        one: str | Iterable[str] = "*",
        other: str | Iterable[str] = "*",
        radius: float = 0.1,
        *,
        moving: Symbol | str | Iterable[Symbol | str] | None = None,
        rules: Iterable[Rule] = (),
        per_shape: bool = False,
    ) -> PreparedQuery:
        """Return a prepared query: the near pairs among selected pairs of bodies, for loops.

        Each call of it, after :meth:`update`, returns what :meth:`pairs_within` does for these pairs. The
        pairs are selected once, and again after an edit of the model.

        Parameters
        ----------
        one, other
            Names of bodies or patterns, as in :class:`Rule`, or several of them; a pair has one body of each.
        radius
            Largest distance of the results [m].
        moving
            Symbols; only pairs whose distance depends on one of them are selected. All by default.
        rules
            Rules for this query, applied after those of the scene.
        per_shape
            True for one result for each pair of shapes; of a decomposed mesh, for each of its hulls. By
            default the nearest of each pair of bodies.

        Raises
        ------
        UnknownNameError
            If a name or pattern matches no body, or the model has no such symbol.
        InvalidValueError
            If the radius is negative or NaN.

        Examples
        --------
        >>> model = kv.load("kitchen")
        >>> scene = kv.geometry.Scene(model)
        >>> query = scene.watch("kitchen/fridge_door*", radius=0.05, moving="kitchen/fridge_door")
        >>> for angle in (0.0, 1.0):
        ...     scene.update(model.default_state() | {"kitchen/fridge_door": angle})
        ...     print(len(query()))
        4
        2
        """
        names, added = (one, other), parse_known_rules(rules, self.model)
        symbols = None if moving is None else _as_list(moving)

        def choose() -> PairFlags:
            bodies = self.bodies
            wanted = apply_rules(self._world.table.allowed, bodies, added)
            wanted *= flag_between(*(flag_matching(bodies, each) for each in names))
            return wanted if symbols is None else wanted * flag_relatively_moving(self.model, bodies, symbols)

        query = PreparedQuery(self._world, choose, radius, per_shape)
        _ = query.pairs  # raises for unknown names
        return query

    def self_pairs(self, frame: str, radius: float) -> DistanceResults:
        """Return the pairs within a radius [m] inside the subtree of a frame: self-collision.

        Examples
        --------
        >>> model = kv.load("fetch")
        >>> scene = kv.geometry.Scene(model)
        >>> scene.update(model.default_state())
        >>> len(scene.self_pairs("fetch/shoulder_pan_link", radius=0.0))
        0
        """
        return self.pairs_between(frame, frame, radius)

    def expression(self, a: str, b: str) -> PairDistance:
        """Return the signed distance of two bodies as an expression, exact to first order at this state.

        At other states, evaluate it with the :meth:`expression_values` of that state. Every call for the same
        pair uses the same symbols; if the model already contains a distance of the pair, those of the model.

        Examples
        --------
        >>> model = kv.load("kitchen")
        >>> scene = kv.geometry.Scene(model)
        >>> state = model.default_state() | {"kitchen/fridge_door": 0.5}
        >>> scene.update(state)
        >>> gap = scene.expression("kitchen/fridge_door_handle", "kitchen/fridge_lower_drawer")
        >>> gap.expression(state).round(3)
        np.float64(0.484)
        >>> rates = gap.expression.gradient()
        >>> rates[kv.velocity("kitchen/fridge_door")](state).round(3)
        np.float64(0.368)
        """
        closest, *poses = self._with_poses(a, b)
        if (a, b) not in self._parameters:
            self._parameters[a, b] = distance_parameters(self.model, closest, *poses)
        return distance_expression(self.model, a, b, self._parameters[a, b])

    @one_at_a_time
    def expression_values(self, pairs: PairDistance | Iterable[PairDistance]) -> dict[Symbol, float]:
        """Return the present values of the parameters of distances, for ``state | kv.State(values)``."""
        values: dict[Symbol, float] = {}
        for pair in [pairs] if isinstance(pairs, PairDistance) else pairs:
            values.update(pair.values(*self._with_poses(pair.a, pair.b)))
        return values

    @one_at_a_time
    def _with_poses(self, a: str, b: str) -> tuple[DistanceResult, Floats, Floats]:
        (closest,) = self._query_pairs(("pair", a, b), lambda: flag_pair(self._world, a, b))()
        return closest if closest.a == a else closest.swap(), self.pose(a), self.pose(b)

    @one_at_a_time
    def first_contact(self, margin: float = 0.0) -> DistanceResult | None:
        """Return a pair within a margin [m], or None; always the same pair at the same state.

        Examples
        --------
        >>> model = kv.load("fetch")
        >>> tags = model.include("kitchen")
        >>> scene = kv.geometry.Scene(model)
        >>> scene.update(model.default_state())
        >>> scene.first_contact() is None
        True
        >>> scene.update(model.default_state() | {"fetch/base/x": 0.8})
        >>> scene.first_contact().touches
        True
        """
        return distance_queries.find_first_contact(self._world, margin)

    @property
    def in_collision(self) -> bool:
        """True if any checked pair touches or penetrates."""
        return self.first_contact() is not None

    def checks_pair(self, a: str, b: str) -> bool:
        """Return True if the collision filter lets a pair be checked."""
        one, other = self._world.body_index(a), self._world.body_index(b)
        return bool(self._world.table.allowed[one, other])

    @property
    def rules(self) -> tuple[Rule, ...]:
        """The rules of the collision filter in their order: those of the model, then those of the scene."""
        return self._world.rules

    @one_at_a_time
    def find_never_colliding(
        self, states: Iterable[StateLike] | None = None, margin: float = 0.0
    ) -> tuple[Rule, ...]:
        """Return rules that except all pairs that are never within a margin [m] at some states.

        This is an observation, not a proof: choose states over the whole range. The scene stays at the last
        state.

        Parameters
        ----------
        states
            The states; by default the default state and 200 random ones within limits.

        Raises
        ------
        InvalidValueError
            If there are no states.
        """
        counts, number = self._count_within(states, margin)
        return self._except(counts == 0, f"never within {margin:g} m at {number} states")

    @one_at_a_time
    def find_always_colliding(
        self, states: Iterable[StateLike] | None = None, margin: float = 0.0
    ) -> tuple[Rule, ...]:
        """Return rules that except all pairs that are within a margin [m] at every one of some states.

        Such are the links of a robot around a joint between them, whose shapes overlap. For parameters,
        errors and the meaning see :meth:`find_never_colliding`. Of a single state, such as the default one,
        these are the pairs that overlap there.

        Examples
        --------
        >>> model = kv.load("fetch")
        >>> scene = kv.geometry.Scene(model)
        >>> rules = scene.find_always_colliding([model.default_state()])
        >>> len(kv.geometry.Scene(model, rules=rules).rules) >= len(rules)
        True
        """
        counts, number = self._count_within(states, margin)
        return self._except(counts == number, f"within {margin:g} m at all of {number} states")

    def _except(self, chosen: npt.NDArray[np.bool_], why: str) -> tuple[Rule, ...]:
        bodies, allowed = self._world.bodies, self._world.table.allowed
        pairs = np.argwhere(np.tril(allowed * chosen)).tolist()
        return tuple(Rule(bodies[b], bodies[a], False, why) for a, b in pairs)

    def _count_within(
        self, states: Iterable[StateLike] | None, margin: float
    ) -> tuple[npt.NDArray[np.int64], int]:
        """Count the states at which pairs of bodies, (B, B) below the diagonal, are within a margin; and all.

        By default, states are sampled within limits; a state at which a loop does not close is left out.
        """
        world = self._world
        world.synchronize()
        sampled: Iterable[Floats] = ()
        if states is None:
            samples = StateSamples(world.model, count=_SAMPLES)
            columns = [np.zeros(samples.size), *map(samples.values_of, world.inputs)]
            sampled = np.stack(columns, axis=1)[:, 1:]
        counts, number = np.zeros((len(world.bodies),) * 2, dtype=np.int64), 0
        for state in sampled if states is None else states:
            try:
                world.update(state)
            except NoSolutionError:
                if states is None:
                    continue
                raise
            near = distance_queries.find_pairs_within(world, margin).body_indices
            # The first body of each result precedes the second.
            counts[near[:, 1], near[:, 0]] += 1
            number += 1
        if not number:
            raise InvalidValueError("Pairs that touch never or always are found at states; there is none.")
        return counts, number

    # -- rays and points -----------------------------------------------------------------------------------

    @one_at_a_time
    def ray(self, origin: npt.ArrayLike, direction: npt.ArrayLike, length: float = math.inf) -> RayHit | None:
        """Return the first hit of a ray, or None.

        Parameters
        ----------
        origin, direction
            (3,) in the world [m]; the direction has any length but 0.
        length
            Length of the ray [m].

        Examples
        --------
        >>> model = kv.load("kitchen")
        >>> scene = kv.geometry.Scene(model)
        >>> scene.update(model.default_state())
        >>> hit = scene.ray(origin=[0, -1.6, 1.2], direction=[1, 0, 0])
        >>> hit.body, round(hit.distance, 3)
        ('kitchen/fridge_door', 1.137)
        """
        return rays.cast_ray(self._world, origin, direction, length)

    @one_at_a_time
    def point(self, point: npt.ArrayLike, radius: float = math.inf) -> NearestPoint | None:
        """Return the body nearest to a point (3,) in the world within a radius [m], or None.

        If the point is inside of bodies, it is the body in which the point is deepest. Triangles have no
        inside.

        Examples
        --------
        >>> model = kv.load("kitchen")
        >>> scene = kv.geometry.Scene(model)
        >>> scene.update(model.default_state())
        >>> nearest = scene.point([0.5, -1.6, 1.2])
        >>> nearest.body, nearest.inside
        ('kitchen/fridge_door', False)
        """
        return rays.find_nearest_point(self._world, point, radius)

    # -- symbols -------------------------------------------------------------------------------------------

    def bodies_moved_by(self, symbols: Symbol | str | Iterable[Symbol | str]) -> tuple[str, ...]:
        """Return the bodies whose pose in the world depends on some symbols, in the order of the model.

        A wheel's speed moves the whole robot; the crank of a closed loop moves all dependent links.

        Examples
        --------
        >>> model = kv.load("kitchen")
        >>> kv.geometry.Scene(model).bodies_moved_by("kitchen/fridge_door")
        ('kitchen/fridge_door', 'kitchen/fridge_door_handle')
        """
        motion = FrameDependence(self.model, _as_list(symbols))
        return tuple(body for body in self.bodies if motion.moves(body))

    def pairs_affected_by(
        self, symbols: Symbol | str | Iterable[Symbol | str]
    ) -> tuple[tuple[str, str], ...]:
        """Return the checked pairs whose distance depends on some symbols."""
        motion = FrameDependence(self.model, _as_list(symbols))
        bodies, table = self.bodies, self._world.table.allowed
        ones, others = np.nonzero(np.triu(table))
        pairs = ((bodies[i], bodies[j]) for i, j in zip(ones.tolist(), others.tolist(), strict=True))
        return tuple(pair for pair in pairs if motion.moves_between(*pair))

    def pairs_near_moving(
        self, symbols: Symbol | str | Iterable[Symbol | str], radius: float
    ) -> DistanceResults:
        """Return the pairs within a radius [m] whose distance depends on some symbols, nearest first."""
        moving = _as_list(symbols)

        def choose() -> PairFlags:
            return self._world.table.allowed * flag_relatively_moving(self.model, self.bodies, moving)

        return self._query_pairs(("moved by", *moving), choose)(radius)

    def _query_pairs(self, key: tuple[Any, ...], choose: Callable[[], PairFlags]) -> PreparedQuery:
        """Return the query about the pairs that are chosen, made once for a key."""
        if key not in self._queries:
            if len(self._queries) >= _MAX_QUERIES:
                self._queries.clear()
            self._queries[key] = PreparedQuery(self._world, choose, math.inf)
        return self._queries[key]

    def __repr__(self) -> str:
        return f"<Scene: {len(self._world.objects)} collision objects of {len(self._world.bodies)} bodies>"


def _as_list(symbols: Symbol | str | Iterable[Symbol | str]) -> list[Symbol | str]:
    return [symbols] if isinstance(symbols, Symbol | str) else list(symbols)
