"""Planner: paths without collisions for any coordinates of any model."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from time import perf_counter
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from kineverse._checks import as_count, as_tolerance
from kineverse.control.tasks import Goal, Hold
from kineverse.errors import InvalidValueError, NoSolutionError, ShapeError
from kineverse.expressions.expression import ExpressionLike
from kineverse.geometry import Rule, Scene
from kineverse.geometry.objects import Exclusion
from kineverse.geometry.prepared_query import flag_subtree
from kineverse.geometry.results import DistanceResult
from kineverse.lie import Array
from kineverse.model.frame import WORLD
from kineverse.model.kinematics import ancestors
from kineverse.model.model_view import ModelView
from kineverse.model.sampling import StateSamples
from kineverse.state import State, StateLike, as_state
from kineverse.symbols import Symbol

from .bindings import planning_functions
from .checker import BodyPairs, CollisionChecker
from .configuration import PlanningSpace
from .connection import connect, connect_on_manifold
from .endpoints import Endpoint, Endpoints
from .judge import SceneJudge, describe_contacts
from .manifold import FrameHold, Manifold, hold_frames, hold_targets, manifold_key
from .modes import Mode, ModeSearch
from .path import Path
from .path_checks import PathChecks
from .path_rounding import PathSection
from .roadmap import Roadmap
from .search import MOST_EDGES
from .solutions import MOST_BATCHES, find_solutions

Flags: TypeAlias = npt.NDArray[np.bool_]

_JUDGED = 0.5
"""Longest step between judged configurations of a path that is certified [rad], [m]."""
_SAMPLES = 64
_NEARLY_ALWAYS = 0.9
"""Share of configurations from which on pairs of spheres count as always touching."""
_TASK_GOALS = 32
"""Number of configurations that are looked for where tasks are the goal."""
_MOST_MANIFOLDS = 16
_NARROWINGS = 4
_LARGEST = 1e6
"""Largest coordinate of a configuration [rad], [m]; edges are computed in single precision."""
_METHODS = ("rrt-connect", "prm")


class Planner:
    """Planner of paths without collisions, for any coordinates of a model.

    Bodies that move are covered by spheres, everything else is obstacles. A generated function computes the poses of
    many configurations at once, and compiled code checks edges of trees (RRT-Connect). A path is certified between its
    samples too, and judged by the collision scene before it is returned.

    Everything is computed from the model: an edit of the model is followed at the next call. A planner is for one
    thread at a time.

    Parameters
    ----------
    model
        The model of everything: robot and surroundings.
    move
        Coordinates that move, as symbols, names or patterns (``"fetch/*"``); a name of an articulation stands for its
        coordinates. None for all that may move freely; a base on rolling wheels does not.
    rules
        Rules of the collision filter, see :class:`.Scene`, such as those of an SRDF.
    margin
        Least distance of bodies that move from everything [m]; for rounding, 0.25 mm a kilometre from the origin come
        on top.
    decomposed
        Bodies, or patterns, whose meshes are unions of convex hulls, see :class:`.Scene`.
    leave_out
        Excluded bodies, or patterns, or shapes, see :class:`.Scene`.
    protrusion
        Largest distance by which spheres stick out of the shape that they cover [m]; None for what suits the shape.

    Attributes
    ----------
    roadmap
        Roadmap of the calls of :meth:`plan` with ``method="prm"``; None before the first one.

    Raises
    ------
    CompileError
        Without a C compiler.
    UnknownNameError
        For names or patterns in ``move`` or ``rules`` that the model does not have.
    InvalidValueError
        If nothing moves, or a coordinate cannot move independently.
    """

    def __init__(
        self,
        model: ModelView,
        move: Iterable[Symbol | str] | Symbol | str | None = None,
        *,
        rules: Iterable[Rule] = (),
        margin: float = 0.0,
        decomposed: Iterable[str] = (),
        leave_out: Iterable[Exclusion] = (),
        protrusion: float | None = None,
    ) -> None:
        planning_functions()  # says at once that there is no compiler
        self.model = model
        self.margin = as_tolerance(margin, "The margin")
        self._move = move if move is None or isinstance(move, Symbol | str) else tuple(move)
        self._rules, self._protrusion = tuple(rules), protrusion
        self._options: dict[str, Any] = {"decomposed": decomposed, "leave_out": leave_out}
        self._version: int | None = None
        self._state: State | None = None
        self.roadmap: Roadmap | None = None
        self._synchronize()

    def _synchronize(self) -> None:
        """Build everything for the present version of the model."""
        if self._version == self.model.version:
            return
        model = self.model
        self.space = space = PlanningSpace(model, self._move)
        scene = Scene(model, rules=self._rules, **self._options)
        if not scene.bodies:
            raise InvalidValueError(
                "No body of the model has a shape, so nothing can collide: add collision or visual shapes."
            )
        self.excluded = self._find_overlapping(scene)
        if self.excluded:
            scene = Scene(model, rules=(*self._rules, *self.excluded), **self._options)
        self.scene = scene
        self.checker = CollisionChecker(scene, space.symbols, space.conditions, self.margin, self._protrusion)
        self._candidates = space.turning.copy()
        self._manifolds: dict[tuple[object, ...], Manifold] = {}
        self._judges: dict[BodyPairs, SceneJudge] = {}
        self._carried_bodies: dict[str, tuple[str, ...]] = {}
        self._leave_near_pairs()
        self._version = model.version
        self._place(model.default_state() if self._state is None else model.default_state() | self._state)

    def _find_overlapping(self, scene: Scene) -> tuple[Rule, ...]:
        """Return rules for pairs of bodies that touch wherever the coordinates are, those of the others as well.

        So a robot that stands in a wall by default, and is placed elsewhere, does not lose the pairs with the wall.
        """
        home = self.model.default_state()
        samples = StateSamples(self.model, count=_SAMPLES)
        columns = {s: samples.values_of(s).tolist() for s in home if s.has_derivative and not s.order}
        states = [home.updated({s: values[k] for s, values in columns.items()}) for k in range(samples.size)]
        pairs = {frozenset(pair) for pair in scene.pairs_affected_by(self.space.symbols)}
        found = scene.find_always_colliding(filter(partial(_has_poses, scene), states))
        return tuple(rule for rule in found if frozenset((rule.a, rule.b)) in pairs)

    def _leave_near_pairs(self) -> None:
        """Leave to the scene the pairs whose spheres nearly always touch where the bodies themselves do not.

        Such are the links around a wrist, a few millimetres apart. Of a pair that one coordinate moves, and whose
        bodies touch nowhere on its range, nothing is left to check.
        """
        generator = np.random.default_rng(1)
        home = self.model.default_state()
        start = home.vector(self.space.symbols)
        self.checker.place(home)
        Q = generator.uniform(*self.space.bounds(start, start[None]), (_SAMPLES, len(start)))
        counts = self.checker.count_touching(np.ascontiguousarray(Q, dtype=np.float32))
        near = [pair for pair, count in counts.items() if count >= _NEARLY_ALWAYS * _SAMPLES]
        judged = SceneJudge(self.scene, self.space.symbols, (), near)
        judged.place(home)
        touching = (
            [{frozenset((c.a, c.b)) for c in judged.uncovered_contacts(q) or ()} for q in Q] if near else []
        )
        apart = [p for p in near if sum(frozenset(p) in t for t in touching) < 0.5 * _SAMPLES]
        self.checker.leave_to_scene(apart)
        for pair in apart:
            columns = self._columns_between(*pair)
            if len(columns) == 1:
                own = SceneJudge(self.scene, self.space.symbols, (), [pair])
                own.place(home)
                low, high = self.space.bounds(start, start[None])
                ends = own.free_interval(start, columns[0], low[columns[0]], high[columns[0]])
                if ends == (low[columns[0]], high[columns[0]]):
                    self.checker.uncovered.remove(pair)

    def _columns_between(self, a: str, b: str) -> list[int]:
        """Return the columns of the coordinates that move two bodies with respect to each other."""
        moving = {*self.model.fk(a, b).symbols}
        return [k for k, s in enumerate(self.space.symbols) if s in moving]

    @property
    def symbols(self) -> tuple[Symbol, ...]:
        """The n coordinates that move, in the order of the columns of configurations."""
        return self.space.symbols

    # -- the state -----------------------------------------------------------------------------------------

    def place(self, state: StateLike) -> None:
        """Place everything that the planner does not move, and the obstacles with it.

        Parameters
        ----------
        state
            A state or a mapping; what is missing keeps its place.

        Raises
        ------
        UnknownNameError, InvalidValueError
            For unknown names and values that are not finite.
        """
        self._synchronize()
        self._place(self._whole(state))

    def _whole(self, state: StateLike) -> State:
        known = (*self.model.symbols, *self.model.speeds)
        base = self._state if self._state is not None else self.model.default_state()
        return base | (state if isinstance(state, State) else as_state(state, known))

    def _place(self, state: State) -> None:
        self._state = state
        self.space.place(state)
        self.checker.place(state)
        self.space.turning[:] = self.checker.find_periodic(self._candidates)
        self._set_bounds(self._here, self._here[None])

    def _replace(self) -> None:
        """Place the checker again where everything stands."""
        assert self._state is not None
        self.checker.place(self._state)

    @property
    def _here(self) -> Array:
        assert self._state is not None
        return self._state.vector(self.space.symbols)

    def _set_bounds(self, start: Array, points: Array, still: Flags | None = None) -> None:
        """Set the bounds of a search from a start (n,) to points (N, n); coordinates that stand still have none."""
        lower, upper = self.space.bounds(start, points)
        if still is not None:
            lower, upper = np.where(still, start, lower), np.where(still, start, upper)
        self.checker.lower[:], self.checker.upper[:] = lower, upper

    # -- configurations ------------------------------------------------------------------------------------

    def valid(self, Q: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Return flags (N,) of configurations (N, n) that are within limits and free of collisions.

        Bodies are covered by spheres, so that a configuration near a contact may count as invalid.
        """
        self._synchronize()
        points = self._configurations(Q, "Q")
        if not len(points):
            return np.zeros(0, dtype=bool)
        # Any turn of a joint without limits is allowed.
        lower, upper = self.space.bounds(self._here, points)
        self.checker.lower[:] = np.where(self.space.turning, np.minimum(lower, points.min(axis=0)), lower)
        self.checker.upper[:] = np.where(self.space.turning, np.maximum(upper, points.max(axis=0)), upper)
        return self.checker.valid(points.astype(np.float32))

    def edges(self, A: npt.ArrayLike, B: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Return flags (N,) of straight ways from A to B, (N, n) each, that are free at 32 samples a unit.

        Starts are not checked.
        """
        self._synchronize()
        starts, ends = self._configurations(A, "A"), self._configurations(B, "B")
        if starts.shape != ends.shape:
            raise ShapeError(f"A and B have the shapes {starts.shape} and {ends.shape}, which differ.")
        return self.checker.edges(starts.astype(np.float32), ends.astype(np.float32))

    def _start(self, start: Any) -> Array:
        """Return a start (n,) from a vector or a state."""
        found = self._configurations(start, "start")
        if len(found) > 1:
            raise ShapeError(
                f"start has {len(found)} configurations; there is one start. Goals may be several."
            )
        return np.asarray(found[0])

    def _configurations(self, Q: Any, name: str) -> Array:
        """Return configurations (N, n) from one or several vectors or states."""
        n = len(self.space.symbols)
        if isinstance(Q, dict | State):
            return self._whole(Q).vector(self.space.symbols)[None]
        if isinstance(Q, Sequence) and len(Q) and isinstance(Q[0], dict | State):
            return np.array([self._whole(q).vector(self.space.symbols) for q in Q])
        wanted = f"wanted are configurations of {n} coordinates, in the order of planner.symbols, or states"
        try:
            points = np.atleast_2d(np.asarray(Q, dtype=float))
        except (TypeError, ValueError):
            raise InvalidValueError(f"{name} is {Q!r:.80}; {wanted}.") from None
        if points.ndim != 2 or points.shape[1] != n:
            raise ShapeError(f"{name} has shape {np.shape(Q)}; {wanted}.")
        if not np.isfinite(points).all():
            raise InvalidValueError(f"{name} has values that are not finite.")
        if len(points) and np.abs(points).max() > _LARGEST:
            raise InvalidValueError(
                f"{name} has values beyond {_LARGEST:g}, which have no room in single precision. Choose an origin that "
                "is nearer."
            )
        return np.ascontiguousarray(points)

    # -- holds and solutions -------------------------------------------------------------------------------

    def hold(
        self, a: str, b: str, mask: str = "xyz rx ry rz", offset: ExpressionLike | None = None
    ) -> FrameHold:
        """Return the hold of a frame by another one, such as a grasp: see :func:`.hold_frames`.

        While it lasts, the bodies at and below both frames may touch each other. They may not if one frame carries
        the other, as the world carries a hand that is kept upright.
        """
        return hold_frames(self.model, a, b, mask, offset)

    def solutions(
        self,
        tasks: Hold | Goal | Iterable[Hold | Goal],
        count: int = 16,
        *,
        seconds: float = 1.0,
        seed: int = 0,
    ) -> Array:
        """Return different configurations (K, n), free of collisions, at which holds and goals are met.

        Parameters
        ----------
        tasks
            Holds and goals; targets of goals are met exactly, and their weights have no meaning.
        count
            Largest number of configurations; those near to where the coordinates are placed come first.
        seconds
            Largest time [s], spent only if there are fewer.
        seed
            Seed of the random starts.
        """
        self._synchronize()
        count, seed = as_count("count", count, 1), as_count("seed", seed, 0)
        seconds = as_tolerance(seconds, "seconds=")
        given = as_holds(tasks)
        if not given and not self.space.equalities:
            raise InvalidValueError("There is no hold and no goal, so every configuration is a solution.")
        return self._solutions(given, self._here, count, seconds, seed, self._touching(given))

    def _solutions(
        self,
        holds: Sequence[Hold],
        near: Array,
        count: int,
        seconds: float,
        seed: int,
        touching: BodyPairs,
        still: Flags | None = None,
        batches: int = MOST_BATCHES,
    ) -> Array:
        """Return solutions (K, n), those near to a configuration first; some coordinates have its values."""
        self._set_bounds(near, near[None], still)
        manifold = self._manifold(holds)
        assert manifold is not None
        with self.checker.excepting(touching):
            return find_solutions(self.checker, manifold, near, count, seconds, seed, batches)

    def _manifold(self, holds: Sequence[Hold]) -> Manifold | None:
        """Return the manifold of holds and equalities of the model, at the present place."""
        if not holds and not self.space.equalities:
            return None
        key = manifold_key(holds)
        if key not in self._manifolds:
            if len(self._manifolds) >= _MOST_MANIFOLDS:
                self._manifolds.clear()
            self._manifolds[key] = Manifold(self.checker, self.model, holds, self.space.equalities)
        manifold = self._manifolds[key]
        assert self._state is not None
        manifold.place(self._state, hold_targets(holds))
        return manifold

    def _touching(self, holds: Iterable[Hold]) -> BodyPairs:
        """Return the pairs of bodies that may touch while holds last."""
        return frozenset(
            frozenset((a, b))
            for hold in holds
            if isinstance(hold, FrameHold) and _are_apart(self.model, *hold.frames)
            for a in self._carried(hold.frames[0])
            for b in self._carried(hold.frames[1])
            if a != b
        )

    def _carried(self, frame: str) -> tuple[str, ...]:
        if frame not in self._carried_bodies:
            self._carried_bodies[frame] = find_carried_bodies(self.model, self.scene.bodies, frame)
        return self._carried_bodies[frame]

    # -- paths ---------------------------------------------------------------------------------------------

    def plan(
        self,
        start: StateLike | npt.ArrayLike | None,
        goals: StateLike | npt.ArrayLike | Sequence[StateLike] | Sequence[Hold | Goal],
        *,
        along: Hold | Iterable[Hold] = (),
        modes: Iterable[Mode] | None = None,
        seconds: float = 1.0,
        seed: int = 0,
        method: str = "rrt-connect",
    ) -> Path:
        """Return a path without collisions from a start to any of some goals.

        Parameters
        ----------
        start
            A configuration (n,) or a state; None for where the coordinates are placed.
        goals
            A configuration (n,), several (K, n), states, or holds and goals that are met together at the end.
        along
            Holds that are met all along the path. Start and goals have to meet them up to 1 cm or .01 rad.
        modes
            Ways in which the coordinates may move, see :class:`.Mode`; the path changes from one to another where
            the holds of both are met, such as from moving freely to moving a door by its handle. None for all
            coordinates moving at once.
        seconds
            Largest time of the search [s]; checks of its result come on top.
        seed
            Seed of the search: the same one leads to the same path on one machine, unless the time is up.
        method
            ``"rrt-connect"`` grows new trees for each call. ``"prm"`` keeps a :class:`.Roadmap` between
            calls, so that its paths depend on the calls before as well; it has no holds along the path.

        Raises
        ------
        InvalidValueError
            For an unknown method, or one that cannot do holds.
        """
        self._synchronize()
        begin = perf_counter()
        seconds, seed = as_tolerance(seconds, "seconds="), as_count("seed", seed, 0)
        holds = as_holds(along)
        roadmap = self._choose_roadmap(method, holds)
        q = self._here if start is None else self._start(start)
        tasks = () if not _are_tasks(goals) else as_holds(goals)
        touching = self._touching([*holds, *tasks])
        if modes is not None:
            if holds:
                raise InvalidValueError(
                    "along= is for a path of one mode; with modes= each mode has its own holds."
                )
            ends = None if tasks else self._configurations(goals, "goals")
            return self._plan_modes(ModeSearch(self, modes, tasks, ends, seconds, seed), q, begin)
        if tasks:
            ends = self._solutions([*holds, *tasks], q, _TASK_GOALS, seconds, seed, touching)
            if not len(ends):
                return self._no_path(q, self._no_solution([*holds, *tasks]), begin)
        else:
            ends = self._configurations(goals, "goals")
            if not len(ends):
                raise ShapeError("There is no goal: goals has no rows.")
        # What a goal lets touch does not touch on the way, unless there is no other one.
        for allowed in dict.fromkeys((self._touching(holds), touching)):
            path = self._between(q, ends, holds, allowed, seconds, seed, roadmap=roadmap)
            if path.found:
                break
        return path

    def _plan_modes(self, search: ModeSearch, q: Array, begin: float) -> Path:
        """Return the path through modes that a search finds."""
        found = search.run(q)
        parts, modes, sections, first = [q[None]], [], [], 0
        for segment in found.segments:
            parts.append(segment.points[1:])
            last = first + len(segment.points) - 1
            modes.append((segment.mode.name, first, last))
            checks = self._checks(segment.touching, self._manifold(segment.mode.along))
            sections.append(PathSection(first, last, checks))
            first = last
        touching = frozenset(pair for segment in found.segments for pair in segment.touching)
        whole = np.vstack(parts)
        why = found.problem or f"Found through {len(modes)} modes, after {found.iterations} searches."
        path = self._path(
            not found.problem, whole, why, begin, perf_counter() - begin, found.iterations, touching
        )
        return replace(path, modes=tuple(modes), sections=tuple(sections))

    def _between(
        self,
        q: Array,
        ends: Array,
        holds: Sequence[Hold],
        touching: BodyPairs,
        seconds: float,
        seed: int,
        still: Flags | None = None,
        edges: int = MOST_EDGES,
        roadmap: Roadmap | None = None,
    ) -> Path:
        """Return a path from a configuration (n,) to any of some ends (K, n), along holds; see :meth:`plan`.

        Bodies of the pairs ``touching`` may touch, and some coordinates may stand still.
        """
        begin = perf_counter()
        # A goal that is full turns away is the nearest one that is the same.
        ends = np.array([self.space.equivalents(end, q, most=1)[0] for end in ends])
        self._set_bounds(q, ends, still)
        manifold = self._manifold(holds)
        with self.checker.excepting(touching):
            endpoints = Endpoints(self.space, self.checker, self._judge(touching), manifold)
            first = endpoints.check("The start", q)
            if first.reason:
                return self._no_path(q, first.reason, begin)
            usable = endpoints.check_goals(ends)
            if isinstance(usable, str):
                return self._no_path(q, usable, begin)
            for _ in range(_NARROWINGS):
                path, contact = self._connect(
                    first, usable, manifold, touching, seconds, seed, begin, edges, roadmap
                )
                if contact is None or not self._narrow(contact, q, touching):
                    break
            return path

    def _narrow(self, contact: DistanceResult, q: Array, touching: BodyPairs) -> bool:
        """Narrow the bounds of a coordinate to where it keeps a pair apart that only the scene checks.

        Returns False for a pair that several coordinates move, and if the bounds are as narrow already.
        """
        pair = {contact.a, contact.b}
        if not any(pair == set(other) for other in self.checker.uncovered):
            return False
        columns = self._columns_between(contact.a, contact.b)
        if len(columns) != 1:
            return False
        (i,) = columns
        before = float(self.checker.lower[i]), float(self.checker.upper[i])
        lower, upper = self._judge(touching).free_interval(q, i, *before)
        self.checker.lower[i], self.checker.upper[i] = lower, upper
        return (lower, upper) != before

    def _choose_roadmap(self, method: str, holds: Sequence[Hold]) -> Roadmap | None:
        """Return the roadmap that a method searches; None for trees."""
        if method not in _METHODS:
            raise InvalidValueError(f"method is {method!r}; there are {', '.join(map(repr, _METHODS))}.")
        if method == "rrt-connect":
            return None
        if holds or self.space.equalities:
            reason = "holds along the path" if holds else "equalities of the model"
            raise InvalidValueError(
                f"method='prm' plans in the whole space and cannot keep {reason}; use method='rrt-connect'."
            )
        symbols, turning = self.space.symbols, self.space.turning
        if self.roadmap is None or not self.roadmap.suits(symbols, turning):
            self.roadmap = Roadmap(symbols, turning)
        return self.roadmap

    def _connect(
        self,
        first: Endpoint,
        goals: Sequence[Endpoint],
        manifold: Manifold | None,
        touching: BodyPairs,
        seconds: float,
        seed: int,
        begin: float,
        edges: int,
        roadmap: Roadmap | None,
    ) -> tuple[Path, DistanceResult | None]:
        """Return a path between checked ends, and the contact that the scene finds on it."""
        q = first.inner
        variants = [(goal, v) for goal in goals for v in self.space.equivalents(goal.inner, q)]
        targets = np.ascontiguousarray([v for _, v in variants], dtype=np.float32)
        starts = np.ascontiguousarray(q[None], dtype=np.float32)
        searched = perf_counter()
        if manifold is None:
            found = connect(self.checker, starts, targets, seconds, seed, edges, roadmap)
        else:
            found = connect_on_manifold(self.checker, manifold, starts, targets, seconds, seed, edges)
        spent = perf_counter() - searched
        if found.problem:
            return self._no_path(found.points, found.problem, begin, spent, found.iterations), None
        points = found.points
        # A roadmap may wind further than the variants do.
        turns = np.where(self.space.turning, np.round((points[-1] - targets) / math.tau), 0.0) * math.tau
        k = int(np.argmin(np.abs(targets + turns - points[-1]).max(axis=1)))
        goal, variant = variants[k][0], variants[k][1] + turns[k]
        points[0], points[-1] = q, variant
        contact = self._judge(touching).first_contact(points, _JUDGED)
        if contact is not None:
            problem = f"The scene finds a contact on the path: {describe_contacts([contact[1]])}."
            return self._no_path(points, problem, begin, spent, found.iterations), contact[1]
        shift = variant - goal.inner
        whole = np.vstack([first.way[:-1], points, (goal.way[::-1] + shift)[1:]])
        why = f"Found after {found.iterations} samples{'' if roadmap is None else roadmap.describe()}."
        path = self._path(True, whole, why, begin, spent, found.iterations, touching, manifold)
        return path, None

    def _judge(self, touching: BodyPairs = frozenset()) -> SceneJudge:
        """Return the judge of the scene in which some pairs may touch, at the present place."""
        if touching not in self._judges:
            if len(self._judges) >= _MOST_MANIFOLDS:
                self._judges.clear()
            rules = [Rule(a, b, False, "held") for a, b in map(sorted, touching)]
            self._judges[touching] = SceneJudge(self.scene, self.space.symbols, rules, self.checker.uncovered)
        judge = self._judges[touching]
        assert self._state is not None
        judge.place(self._state)
        return judge

    def _no_solution(self, tasks: Sequence[Hold]) -> str:
        names = ", ".join(repr(task) for task in tasks)
        return (
            f"No configuration without collision was found at which {names} are met. Out of reach, or always in "
            "contact? kv.control.inverse_kinematics says which; another place of the base may help."
        )

    def _no_path(
        self, points: Array, why: str, begin: float, spent: float = 0.0, iterations: int = 0
    ) -> Path:
        return self._path(False, np.atleast_2d(points), why, begin, spent, iterations)

    def _path(
        self,
        found: bool,
        points: Array,
        why: str,
        begin: float,
        spent: float,
        iterations: int,
        touching: BodyPairs = frozenset(),
        manifold: Manifold | None = None,
    ) -> Path:
        checks, seconds = self._checks(touching, manifold), perf_counter() - begin
        return Path(found, self.space.symbols, points, why, seconds, spent, iterations, checks.state, checks)

    def _checks(self, touching: BodyPairs, manifold: Manifold | None) -> PathChecks:
        """Return the checks of a path at the present place."""
        state, judge = self._state, self._judge(touching)
        assert state is not None
        return PathChecks(self.model, state, self.checker, judge, manifold, touching, self._replace)

    def __repr__(self) -> str:
        return f"<Planner: {len(self.symbols)} coordinates, {len(self.checker.moving)} bodies that move>"


def _has_poses(scene: Scene, state: State) -> bool:
    """Return True if all loops close at a state."""
    try:
        scene.update(state)
    except NoSolutionError:
        return False
    return True


def as_holds(tasks: Any) -> tuple[Hold, ...]:
    """Return holds from holds and goals, one or several."""
    given = (tasks,) if isinstance(tasks, Hold | Goal) else tuple(tasks)
    for task in given:
        if not isinstance(task, Hold | Goal):
            raise InvalidValueError(f"Expected kv.control.Hold or Goal, not {task!r}.")
    return tuple(t if isinstance(t, Hold) else Hold(t.expression, t.target, name=t.name) for t in given)


def _are_tasks(goals: Any) -> bool:
    if isinstance(goals, Hold | Goal):
        return True
    return isinstance(goals, list | tuple) and len(goals) > 0 and isinstance(goals[0], Hold | Goal)


def _are_apart(model: ModelView, a: str, b: str) -> bool:
    """Return True if no one of two frames carries the other."""
    lookup = model.frames.__getitem__
    return WORLD not in (a, b) and a != b and a not in ancestors(b, lookup) and b not in ancestors(a, lookup)


def find_carried_bodies(model: ModelView, bodies: Sequence[str], frame: str) -> tuple[str, ...]:
    """Return the bodies at and below a frame; without any, those below the next frame above that has some.

    So a tool frame between the fingers stands for the palm and the fingers.
    """
    frames = model.frames
    while frame != WORLD:
        flags = flag_subtree(model, bodies, frame)
        if flags.any():
            return tuple(body for body, flag in zip(bodies, flags, strict=True) if flag)
        frame = frames[frame].parent
    return ()
