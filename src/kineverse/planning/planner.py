"""Planner: paths without collisions for any coordinates of any model."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from time import perf_counter
from typing import Any

import numpy as np
import numpy.typing as npt

from kineverse._checks import as_count, as_tolerance, real_number
from kineverse.errors import InvalidValueError, ShapeError
from kineverse.geometry import Rule, Scene
from kineverse.geometry.objects import Exclusion
from kineverse.lie import Array
from kineverse.model.model_view import ModelView
from kineverse.state import State, StateLike, as_state
from kineverse.symbols import Symbol

from .bindings import TIME_IS_UP
from .checker import RESOLUTION, CollisionChecker
from .configuration import PlanningSpace
from .endpoints import Endpoint, Endpoints
from .judge import FINE, SceneJudge, describe_contacts
from .path import Path, densify
from .search import RrtConnect, SearchResult

_SHORTCUTS = 60
_REPAIRS = 12
_FINER = 8.0
"""Factor of the resolution where an edge collides between its samples."""
_JUDGED = 1.0
"""Longest step between judged configurations of a path that is certified [rad], [m]."""
_SAMPLES = 64


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
        Least distance of bodies that move from everything [m].
    decomposed
        Bodies, or patterns, whose meshes are unions of convex hulls, see :class:`.Scene`.
    leave_out
        Excluded bodies, or patterns, or shapes, see :class:`.Scene`.
    protrusion
        Largest distance by which spheres stick out of the shape that they cover [m]; None for what suits the shape.

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
        self.model = model
        self.margin = as_tolerance(margin, "The margin")
        self._move = move if move is None or isinstance(move, Symbol | str) else tuple(move)
        self._rules, self._protrusion = tuple(rules), protrusion
        self._options: dict[str, Any] = {"decomposed": decomposed, "leave_out": leave_out}
        self._version: int | None = None
        self._state: State | None = None
        self._synchronize()

    def _synchronize(self) -> None:
        """Build everything for the present version of the model."""
        if self._version == self.model.version:
            return
        model = self.model
        self.space = space = PlanningSpace(model, self._move)
        scene = Scene(model, rules=self._rules, **self._options)
        self.excluded = self._find_overlapping(scene)
        if self.excluded:
            scene = Scene(model, rules=(*self._rules, *self.excluded), **self._options)
        self.scene = scene
        self.checker = CollisionChecker(scene, space.symbols, space.conditions, self.margin, self._protrusion)
        space.turning &= self.checker.find_periodic(space.turning)
        self._judge = SceneJudge(scene, space.symbols, ())
        self._search = RrtConnect(self.checker)
        self._endpoints = Endpoints(space, self.checker, self._judge)
        self._version = model.version
        self._place(model.default_state() if self._state is None else model.default_state() | self._state)

    def _find_overlapping(self, scene: Scene) -> tuple[Rule, ...]:
        """Return rules for pairs of bodies that touch wherever the coordinates are."""
        generator = np.random.default_rng(0)
        home = self.model.default_state()
        start = home.vector(self.space.symbols)
        low, high = self.space.bounds(start, start[None])
        states = [
            home.updated(dict(zip(self.space.symbols, generator.uniform(low, high).tolist(), strict=True)))
            for _ in range(_SAMPLES)
        ]
        pairs = {frozenset(pair) for pair in scene.pairs_affected_by(self.space.symbols)}
        found = scene.find_always_colliding([home, *states])
        return tuple(rule for rule in found if frozenset((rule.a, rule.b)) in pairs)

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
        self.checker.place(state)
        self._judge.place(state)
        self._set_bounds(self._here, self._here[None])

    @property
    def _here(self) -> Array:
        assert self._state is not None
        return self._state.vector(self.space.symbols)

    def _set_bounds(self, start: Array, points: Array) -> None:
        self.checker.lower[:], self.checker.upper[:] = self.space.bounds(start, points)

    # -- configurations ------------------------------------------------------------------------------------

    def valid(self, Q: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Return flags (N,) of configurations (N, n) that are within limits and free of collisions.

        Bodies are covered by spheres, so that a configuration near a contact may count as invalid.
        """
        self._synchronize()
        points = self._configurations(Q, "Q")
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

    def _configurations(self, Q: Any, name: str) -> Array:
        """Return configurations (N, n) from one or several vectors or states."""
        n = len(self.space.symbols)
        if isinstance(Q, dict | State):
            return self._whole(Q).vector(self.space.symbols)[None]
        if isinstance(Q, Sequence) and len(Q) and isinstance(Q[0], dict | State):
            return np.array([self._whole(q).vector(self.space.symbols) for q in Q])
        points = np.atleast_2d(np.asarray(Q, dtype=float))
        if points.ndim != 2 or points.shape[1] != n:
            raise ShapeError(
                f"{name} has shape {np.shape(Q)}; wanted are configurations of {n} coordinates, in the order of "
                "planner.symbols, or states."
            )
        if not np.isfinite(points).all():
            raise InvalidValueError(f"{name} has values that are not finite.")
        return np.ascontiguousarray(points)

    # -- paths ---------------------------------------------------------------------------------------------

    def plan(
        self,
        start: StateLike | npt.ArrayLike | None,
        goals: StateLike | npt.ArrayLike | Sequence[StateLike],
        *,
        seconds: float = 1.0,
        seed: int = 0,
    ) -> Path:
        """Return a path without collisions from a start to any of some goals.

        Parameters
        ----------
        start
            A configuration (n,) or a state; None for where the coordinates are placed.
        goals
            A configuration (n,), several (K, n), or states.
        seconds
            Largest time of the search [s]; checks of its result come on top.
        seed
            Seed of the search: the same one leads to the same path, unless the time is up.
        """
        self._synchronize()
        begin = perf_counter()
        seconds, seed = max(real_number(seconds), 0.0), as_count("seed", seed, 0)
        q = self._here if start is None else self._configurations(start, "start")[0]
        ends = self._configurations(goals, "goals")
        self._set_bounds(q, ends)
        first = self._endpoints.check("The start", q)
        if first.reason:
            return self._no_path(q, first.reason, begin)
        goals_checked = [
            self._endpoints.check("The goal" if len(ends) == 1 else f"Goal {k}", end)
            for k, end in enumerate(ends)
        ]
        usable = [goal for goal in goals_checked if not goal.reason]
        if not usable:
            return self._no_path(q, " ".join(goal.reason for goal in goals_checked[:3]), begin)
        return self._connect(first, usable, seconds, seed, begin)

    def _connect(
        self, first: Endpoint, goals: Sequence[Endpoint], seconds: float, seed: int, begin: float
    ) -> Path:
        q = first.inner
        variants = [(goal, v) for goal in goals for v in self.space.equivalents(goal.inner, q)]
        targets = np.ascontiguousarray([v for _, v in variants], dtype=np.float32)
        starts = np.ascontiguousarray(q[None], dtype=np.float32)
        searched = perf_counter()
        found = self._search.solve(starts, targets, seconds, seed)
        points, problem = found.points, ""
        if found.found:
            points = self._search.shorten(
                points, max(seconds - (perf_counter() - searched), 0.0), seed, _SHORTCUTS
            )
            points, problem = self._certify(points, seconds, seed, searched)
        spent = perf_counter() - searched
        whole = points.astype(float)
        if not found.found:
            return self._no_path(whole, self._why_not(found, seconds), begin, spent, found.iterations)
        if problem:
            return self._no_path(whole, problem, begin, spent, found.iterations)
        goal, variant = variants[int(np.argmin(np.abs(targets - points[-1]).max(axis=1)))]
        whole[0], whole[-1] = q, variant
        contact = self._judge.first_contact(whole, _JUDGED)
        if contact is not None:
            return self._no_path(
                whole,
                f"The scene finds a contact on the path: {describe_contacts([contact[1]])}.",
                begin,
                spent,
            )
        shift = variant - goal.inner
        points_all = np.vstack([first.way[:-1], whole, (goal.way[::-1] + shift)[1:]])
        why = f"Found after {found.iterations} samples."
        return self._path(True, points_all, why, begin, spent, found.iterations)

    def _certify(self, points: Any, seconds: float, seed: int, searched: float) -> tuple[Any, str]:
        """Return a path that is free between its samples too; edges that are not are planned anew, finer."""
        resolution = RESOLUTION
        for _ in range(_REPAIRS):
            collision = self.checker.find_collision(points)
            if collision is None:
                return points, ""
            k, _fraction = collision
            left = seconds - (perf_counter() - searched)
            resolution *= _FINER if resolution < 4000 else 1.0
            detour = self._search.solve(points[k : k + 1], points[k + 1 : k + 2], left, seed, resolution)
            if not detour.found:
                break
            points = np.ascontiguousarray(np.vstack([points[:k], detour.points, points[k + 2 :]]))
        return points, (
            "A path was found whose samples are free, but something thin lies between two of them, and no way around "
            "it was found in the time given. More seconds=, or another seed=, may find one."
        )

    def _why_not(self, found: SearchResult, seconds: float) -> str:
        nodes = (
            f"{found.nodes[0]} configurations from the start and {found.nodes[1]} from the goals were reached"
        )
        if found.status == TIME_IS_UP:
            return (
                f"The time of {seconds:g} s is up: {nodes}, and the nearest pair is {found.gap:.3g} apart. More "
                "seconds= may help; if few were reached, start or goal is enclosed."
            )
        return f"The search ended: {nodes}, and the nearest pair is {found.gap:.3g} apart."

    def _no_path(
        self, points: Array, why: str, begin: float, spent: float = 0.0, iterations: int = 0
    ) -> Path:
        return self._path(False, np.atleast_2d(points), why, begin, spent, iterations)

    def _path(
        self, found: bool, points: Array, why: str, begin: float, spent: float, iterations: int
    ) -> Path:
        state, judge = self._state, self._judge
        assert state is not None

        def measure(points: Array) -> float:
            judge.place(state)
            return judge.clearance(points, 1 / RESOLUTION)

        return Path(
            found, self.space.symbols, points, why, perf_counter() - begin, spent, iterations, state, measure
        )

    def __repr__(self) -> str:
        return f"<Planner: {len(self.symbols)} coordinates, {len(self.checker.moving)} bodies that move>"
