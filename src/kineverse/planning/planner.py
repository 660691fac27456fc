"""Planner: paths without collisions for any coordinates of any model."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from time import perf_counter
from typing import Any

import numpy as np
import numpy.typing as npt

from kineverse._checks import as_count, as_entries, as_tolerance
from kineverse._names import answer_foreign_names
from kineverse._runtime import CallLock, no_collection, one_at_a_time
from kineverse._synonyms import PLANNER_SYNONYMS
from kineverse.control.tasks import Goal, Hold
from kineverse.errors import InvalidValueError, ShapeError
from kineverse.expressions.expression import ExpressionLike
from kineverse.geometry import Rule, Scene
from kineverse.geometry.collision_filter import parse_rules
from kineverse.geometry.objects import Exclusion, parse_exclusions
from kineverse.lie import Array
from kineverse.model.model_view import ModelView
from kineverse.state import State, StateLike
from kineverse.symbols import Symbol

from .bindings import planning_functions
from .collision_checker import BodyPairs, CollisionChecker
from .manifold import FrameHold, hold_frames
from .modes import Mode, ModeSearch
from .path import Path
from .path_rounding import PathSection
from .planning_scene import PlanningScene
from .planning_space import PlanningSpace, read_configurations, read_state
from .sampling_planners import Roadmap
from .start_goal import describe_barrier
from .state_validity import describe_contacts

_TASK_GOALS = 32  # number of configurations that are looked for where tasks are the goal
_TRIES = 2048  # number of random configurations that say whether tasks are out of reach
_METHODS = ("rrt-connect", "prm")


@answer_foreign_names("A planner", PLANNER_SYNONYMS)
class Planner:
    """Planner of paths without collisions, for any coordinates of a model.

    Bodies that move are covered by spheres, everything else is obstacles. A generated function computes the
    poses of many configurations at once, and compiled code checks edges of trees (RRT-Connect): spheres
    against obstacles, then the shapes themselves where spheres touch. A path is
    certified between its samples too, and judged by the collision scene before it is returned.

    Everything is computed from the model: an edit of the model is followed at the next call. Calls of several
    threads wait for each other: a planner for each thread is faster. Pickled, a planner is built again in the
    other process, without its roadmap.

    Parameters
    ----------
    model
        The model of everything: robot and surroundings.
    move
        Coordinates that move, as symbols, names or patterns (``"fetch/*"``); a name of an articulation
        stands for its coordinates. None for all that may move freely; a base on rolling wheels does not.
    rules
        Rules of the collision filter, see :class:`.Scene`, such as those of an SRDF.
    margin
        Least distance of bodies that move from everything [m]; for rounding, 0.25 mm a kilometre from the
        origin come on top.
    decomposed
        Bodies, or patterns, whose meshes are unions of convex hulls, see :class:`.Scene`.
    leave_out
        Excluded bodies, or patterns, or shapes, see :class:`.Scene`.
    protrusion
        Largest distance by which spheres stick out of the shape that they cover [m], a matter of speed alone;
        None for what suits the shape.

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

    Examples
    --------
    >>> model = kv.load("shelf_door")
    >>> planner = kv.planning.Planner(model, move=["shelf_door/door"])
    >>> path = planner.plan({"shelf_door/door": 0.0}, {"shelf_door/door": 1.0})
    >>> path.found, path.points[-1]
    (True, array([1.]))
    >>> path.trajectory().duration > 0
    True
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
        if not isinstance(model, ModelView):
            raise InvalidValueError(f"A planner takes a model, such as kv.load(...), not {model!r:.80}.")
        planning_functions()  # raises at once if there is no compiler
        self._lock = CallLock()
        self.model = model
        self.margin = as_tolerance(margin, "The margin")
        wanted = "coordinates, as symbols, names or patterns"
        self._move = None if move is None else as_entries("move=", move, (Symbol, str), wanted)
        self._rules = parse_rules(rules)
        self._protrusion = None if protrusion is None else as_tolerance(protrusion, "protrusion=")
        bodies = as_entries("decomposed=", decomposed, str, "names or patterns of bodies")
        self._options: dict[str, Any] = {"decomposed": bodies, "leave_out": parse_exclusions(leave_out)}
        self.roadmap: Roadmap | None = None
        self._separate: BodyPairs = frozenset()
        self.planning_scene = self._build(model.default_state())

    def _build(self, state: State) -> PlanningScene:
        with no_collection():
            return PlanningScene(
                self.model, self._move, self._rules, self.margin, self._protrusion, self._options, state,
                self._separate, self._lock,
            )  # fmt: skip

    def _check_separate_pairs(self, Q: Array) -> PlanningScene:
        """Check pairs from now on that are apart at one of the configurations (N, n); return the scene."""
        result = self.planning_scene.find_separate_pairs(Q)
        if result:
            self._separate |= result
            self.planning_scene = self._build(self.planning_scene.state)
        return self.planning_scene

    def __reduce__(self) -> tuple[Any, ...]:
        """Make the planner again in another process, with everything at its present place."""
        options = {"rules": self._rules, "margin": self.margin, "protrusion": self._protrusion}
        return _restore, (self.model, self._move, {**options, **self._options}, self.planning_scene.state)

    def _synchronize(self) -> PlanningScene:
        """Return the scene of the present version of the model, built again after an edit."""
        if self.planning_scene.version != self.model.version:
            self.planning_scene = self._build(self.model.default_state() | self.planning_scene.state)
        return self.planning_scene

    @property
    def space(self) -> PlanningSpace:
        """Coordinates that move, with their limits."""
        return self.planning_scene.space

    @property
    def scene(self) -> Scene:
        """Collision scene that judges paths."""
        return self.planning_scene.scene

    @property
    def excluded(self) -> tuple[Rule, ...]:
        """Rules for pairs of bodies that touch at all samples of the coordinates; these are not checked.

        A pair that is apart where things are placed, or at a start or goal, is checked from then on.
        """
        return self.planning_scene.excluded

    @property
    def checker(self) -> CollisionChecker:
        """Compiled collision check."""
        return self.planning_scene.checker

    @property
    def symbols(self) -> tuple[Symbol, ...]:
        """The n coordinates that move, in the order of the columns of configurations."""
        return self.space.symbols

    # -- the state -----------------------------------------------------------------------------------------

    @one_at_a_time
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
        scene = self._synchronize()
        scene.place(scene.state | read_state(self.model, state))
        self._check_separate_pairs(self.planning_scene.here[None])

    # -- configurations ------------------------------------------------------------------------------------

    @one_at_a_time
    def valid(self, Q: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Return flags (N,) of configurations (N, n) that are within limits and free of collisions.

        Bodies that are nearer than 0.01 mm may count as touching.

        Examples
        --------
        >>> planner = kv.planning.Planner(kv.load("shelf_door"), move=["shelf_door/door"])
        >>> planner.valid([[0.5], [5.0]])
        array([ True, False])
        """
        self._synchronize()
        points = self._configurations(Q, "Q")
        if not len(points):
            return np.zeros(0, dtype=bool)
        # Any turn of a joint without limits is allowed.
        lower, upper = self.space.bounds(self.planning_scene.here, points)
        self.checker.lower[:] = np.where(self.space.turning, np.minimum(lower, points.min(axis=0)), lower)
        self.checker.upper[:] = np.where(self.space.turning, np.maximum(upper, points.max(axis=0)), upper)
        return self.checker.valid(points.astype(np.float32))

    @one_at_a_time
    def edges(self, A: npt.ArrayLike, B: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Return flags (N,) of straight lines from A to B, (N, n) each, that are free at 32 samples a unit.

        Starts and limits are not checked.
        """
        self._synchronize()
        starts, ends = self._configurations(A, "A"), self._configurations(B, "B")
        if starts.shape != ends.shape:
            raise ShapeError(f"A and B have the shapes {starts.shape} and {ends.shape}, which differ.")
        return self.checker.edges(starts.astype(np.float32), ends.astype(np.float32))

    def _start(self, start: Any) -> Array:
        result = self._configurations(start, "start")
        if len(result) != 1:
            raise ShapeError(
                f"start has {len(result)} configurations; there is one start. Goals may be several."
            )
        return np.asarray(result[0])

    def _configurations(self, Q: Any, name: str) -> Array:
        return read_configurations(self.space, self.planning_scene.state, Q, name)

    # -- holds and solutions -------------------------------------------------------------------------------

    def hold(
        self, a: str, b: str, mask: str = "xyz rx ry rz", offset: ExpressionLike | None = None
    ) -> FrameHold:
        """Return the hold of a frame by another one, such as a grasp: see :func:`.hold_frames`.

        While it lasts, the bodies at and below both frames may touch each other; of a frame that never moves,
        only the body at it, or the next one above. They may not if one frame carries the other, as the world
        carries a hand that is kept upright.

        Examples
        --------
        >>> model = kv.load("shelf_door")
        >>> planner = kv.planning.Planner(model, move=["shelf_door/door"])
        >>> hold = planner.hold("shelf_door/door_handle", "world", mask="x")
        >>> hold.frames
        ('shelf_door/door_handle', 'world')
        """
        for what, text in (("a", a), ("b", b), ("mask=", mask)):
            if not isinstance(text, str):
                raise InvalidValueError(f"{what} of a hold is a text, not {text!r:.80}.")
        return hold_frames(self.model, a, b, mask, offset)

    @one_at_a_time
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
        holds = as_holds("tasks", tasks)
        if not holds and not self.space.equalities:
            raise InvalidValueError("There is no hold and no goal, so every configuration is a solution.")
        scene = self.planning_scene
        return scene.solutions(holds, scene.here, count, seconds, seed, scene.touching_pairs(holds))

    # -- paths ---------------------------------------------------------------------------------------------

    @one_at_a_time
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
        optimize: bool = False,
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
            Ways in which the coordinates may move, see :class:`.Mode`; the path changes from one to another
            where the holds of both are met, such as from moving freely to moving a door by its handle. None
            for all coordinates moving at once.
        seconds
            Largest time of the search [s]; checks of its result come on top.
        seed
            Seed of the search: the same one leads to the same path on one machine, unless the time is up.
        method
            ``"rrt-connect"`` grows new trees for each call. ``"prm"`` keeps a :class:`.Roadmap` between
            calls, so that its paths depend on the calls before as well; it has no holds along the path.
        optimize
            False for the first path, shortened. True to use all ``seconds``: searches with other seeds go
            on, and the shortest path is returned. It depends on the time, so the same seed may lead to
            another path.

        Raises
        ------
        InvalidValueError
            For an unknown method, or one that cannot do holds; for modes that are optimized.

        See Also
        --------
        kineverse.planning.Planner
        """
        begin = perf_counter()
        scene = self._synchronize()
        seconds, seed = as_tolerance(seconds, "seconds="), as_count("seed", seed, 0)
        holds = as_holds("along=", along)
        roadmap = self._choose_roadmap(method, holds)
        q = self.planning_scene.here if start is None else self._start(start)
        first = goals[0] if isinstance(goals, list | tuple) and goals else goals
        tasks = as_holds("goals", goals) if isinstance(first, Hold | Goal) else ()
        ends = q[None] if tasks else self._configurations(goals, "goals")
        scene = self._check_separate_pairs(np.vstack([q, ends]))
        touching = scene.touching_pairs([*holds, *tasks])
        if modes is not None:
            if holds:
                raise InvalidValueError(
                    "along= is for a path of one mode; with modes= each mode has its own holds."
                )
            if optimize:
                raise InvalidValueError("optimize= is for a path of one mode; leave it out with modes=.")
            search = ModeSearch(scene, modes, tasks, None if tasks else ends, seconds, seed)
            return self._plan_modes(search, q, begin)
        if tasks:
            ends = scene.solutions([*holds, *tasks], q, _TASK_GOALS, seconds, seed, touching)
            if not len(ends):
                return scene.no_path(q, self._no_solution([*holds, *tasks], touching), begin)
            scene = self._check_separate_pairs(ends)
        elif not len(ends):
            raise ShapeError("There is no goal: goals has no rows.")
        # Pairs that may touch at the goal may touch along the path only if there is no other one.
        for allowed in dict.fromkeys((scene.touching_pairs(holds), touching)):
            path = scene.between(q, ends, holds, allowed, seconds, seed, roadmap=roadmap, optimize=optimize)
            if path.found:
                return path
        if path.search_seconds:
            with self.checker.excepting(touching):
                barrier = describe_barrier(self.space, self.checker, q, ends)
            path = replace(path, why=path.why + barrier)
        return path

    def _plan_modes(self, search: ModeSearch, q: Array, begin: float) -> Path:
        scene, result = self.planning_scene, search.run(q)
        parts, modes, sections, first = [q[None]], [], [], 0
        for segment in result.segments:
            parts.append(segment.points[1:])
            last = first + len(segment.points) - 1
            modes.append((segment.mode.name, first, last))
            checks = scene.checks(segment.touching, scene.manifold(segment.mode.along))
            sections.append(PathSection(first, last, checks))
            first = last
        touching = frozenset(pair for segment in result.segments for pair in segment.touching)
        whole = np.vstack(parts)
        why = result.problem or f"Found through {len(modes)} modes, after {result.iterations} searches."
        path = scene.path(
            not result.problem, whole, why, begin, perf_counter() - begin, result.iterations, touching
        )
        return replace(path, modes=tuple(modes), sections=tuple(sections))

    def _choose_roadmap(self, method: str, holds: Sequence[Hold]) -> Roadmap | None:
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

    def _no_solution(self, tasks: Sequence[Hold], touching: BodyPairs) -> str:
        """Explain why no configuration was found that meets tasks: out of reach, or in contact."""
        scene, checker = self.planning_scene, self.checker
        manifold = scene.manifold(tasks)
        assert manifold is not None
        tries = np.random.default_rng(0).uniform(checker.lower, checker.upper, (_TRIES, len(self.symbols)))
        rows = tries.astype(np.float32)
        rows = rows[manifold.project(rows)]
        labels = (f"'{task.name}'" if task.name else "goals without names" for task in tasks)
        names = " and ".join(dict.fromkeys(labels))
        if not len(rows):
            why = f"Out of reach: no configuration within limits was found that meets {names}."
            if self.space.unlimited:
                named = ", ".join(f"'{s}'" for s in self.space.unlimited)
                why += f" Without limits, so searched within 32 m or rad of the start: {named}."
            return why
        judge = scene.judge(touching)
        result = [judge.contacts(row.astype(float), checker.struct.margin) for row in rows[:_TASK_GOALS]]
        least = max((c for c in result if len(c)), key=lambda c: float(c[0].distance), default=None)
        example = "" if least is None else f", at least of {describe_contacts(least)}"
        return (
            f"No configuration without collision was found that meets {names}. In reach, but with contacts "
            f"or violated constraints{example}."
        )

    def __repr__(self) -> str:
        return f"<Planner: {len(self.symbols)} coordinates, {len(self.checker.moving)} bodies that move>"


def _restore(
    model: ModelView, move: tuple[Symbol | str, ...] | None, options: dict[str, Any], state: State
) -> Planner:
    planner = Planner(model, move, **options)
    planner.place(state)
    return planner


def as_holds(argument: str, tasks: Any) -> tuple[Hold, ...]:
    """Turn holds and goals, one or several, into holds."""
    entries = as_entries(argument, tasks, (Hold, Goal), "kv.control.Hold or Goal, or planner.hold(a, b)")
    return tuple(t if isinstance(t, Hold) else Hold(t.expression, t.target, name=t.name) for t in entries)
