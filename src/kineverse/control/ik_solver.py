"""Inverse kinematics: a configuration for tasks of any kind, by Gauss-Newton steps from several starts.

Each start ends when its tasks are done, or when five steps reduce the errors by less than a tenth. The first
start is the given state, the others are random. Without a solution, the best end of all starts is continued
to the nearest point that is possible.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from kineverse._checks import as_count, as_tolerance
from kineverse._names import answer_foreign_names
from kineverse._synonyms import IK_RESULT_SYNONYMS, IK_SYNONYMS
from kineverse.errors import NotFiniteError
from kineverse.lie import Array
from kineverse.model.constraint import TOLERANCE
from kineverse.model.model_view import ModelView
from kineverse.state import State, StateLike, as_state
from kineverse.symbols import Symbol

from .configuration_search import PROGRESS, STEPS, ConfigurationSearch, SearchEnd
from .position_program import PositionProgram
from .tasks import Task

if TYPE_CHECKING:
    from kineverse.geometry import Scene
    from kineverse.geometry.results import DistanceResult

    from .clearance import Clearance

_DIFFERENT = 1e-3  # least difference of a coordinate of two solutions [m], [rad]
_EXPLAINING_STARTS = 8


@answer_foreign_names("A solver", IK_SYNONYMS)
class InverseKinematics:
    """Solver of inverse kinematics for the tasks of a model, built once for many targets.

    A solution is a configuration: it is not restricted by rolling or speeds. Goals, holds and keeps of
    positions are those of a :class:`.Controller`; gains, speeds and rates of goals have no meaning here, and
    tasks about speeds are refused. Holds, equalities of the model and keeps are satisfied where goals are out
    of reach, if that is possible. Limits and other constraints on positions are respected for everything that
    moves; what no task moves keeps its values, and is not checked.

    A solver is about the version of the model at construction, and for one thread at a time.

    Parameters
    ----------
    model
        The model of everything that the tasks are about: robot, objects, or both.
    tasks
        Goals, holds and keeps. Their targets may contain parameters, whose values come with each target.
    scene
        Collision scene of the model; None to ignore collisions. Only pairs that the tasks move relatively
        to each other count, without those that its rules except and those that always overlap. The scene
        stays at the last configuration that was tried.
    fixed
        Coordinates that do not move, as symbols or names; a name of an articulation stands for its
        coordinates.
    margin
        Least distance of pairs of bodies [m].
    tolerance
        Largest entry of the errors of a goal that is reached, in the unit of its expression [m], [rad].
        Holds, keeps and constraints are satisfied to 1e-9.

    Attributes
    ----------
    coordinates
        The coordinates that may move, found from the tasks and the constraints that they meet.
    inputs
        The symbols whose values matter: coordinates, parameters, and others in the tasks.

    Raises
    ------
    InvalidValueError
        If there is no goal or hold, for a task about speeds, or one that nothing moves.
    UnknownNameError
        For a task about a symbol that the model does not have, an unknown name in ``fixed``, or a scene of
        another model.
    MissingDependencyError
        If the solver of quadratic programs is not installed.

    Examples
    --------
    >>> model = kv.load("fetch")
    >>> hand = model.fk("fetch/gripper_link")
    >>> reach = kv.control.Target("reach", np.eye(4))
    >>> goal = kv.control.Goal(kv.control.same_pose(reach.expression, hand))
    >>> solver = kv.control.InverseKinematics(model, [goal], fixed=["fetch/base"])
    >>> pose = kv.translation(0.7, 0.2, 0.9) @ kv.rpy(0, np.pi / 2, 0)
    >>> solver.solve(reach.values(pose)).solved
    True
    """

    def __init__(
        self,
        model: ModelView,
        tasks: Iterable[Task],
        *,
        scene: Scene | None = None,
        fixed: Iterable[Symbol | str] = (),
        margin: float = 0.0,
        tolerance: float = 1e-5,
    ) -> None:
        self.model = model
        self._program = program = PositionProgram(model, tasks, fixed, as_tolerance(tolerance))
        self.tasks, self.coordinates = program.tasks, program.coordinates
        self._clearance: Clearance | None = None
        if scene is not None:
            # For start-up time: a solver without a scene imports no geometry.
            from .clearance import Clearance

            self._clearance = Clearance(scene, program, as_tolerance(margin, "The margin"))
        self._search = ConfigurationSearch(program, self._clearance)
        others = () if self._clearance is None else self._clearance.inputs
        extra = sorted({*others} - {*program.inputs}, key=lambda s: s.sort_key)
        self.inputs = (*program.inputs, *extra)
        self._home = model.default_state()
        self._defaults = self._home.vector(self.inputs)
        self._place = {s: k for k, s in enumerate(self.inputs)}
        self._known = (*model.symbols, *model.speeds, *self.inputs)
        names = Counter(map(str, {*self._known}))
        self._lookup: dict[object, Symbol] = {s: s for s in self._known}
        self._lookup |= {str(s): s for s in self._known if names[str(s)] == 1}

    @property
    def tier(self) -> str:
        """Present kind of evaluation: ``"interpreter"``, or ``"c"`` once that is compiled."""
        return self._program.function.tier

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until the program is compiled, at most for a time [s], and return whether it is."""
        return self._program.function.wait(timeout)

    def solve(
        self, values: StateLike | None = None, *, starts: int = 16, solutions: int = 1, seed: int = 0
    ) -> IkResult:
        """Return the configuration for the tasks, from the given state and random ones.

        Parameters
        ----------
        values
            The first start and the values of parameters, by symbol or name. The start may be outside of
            limits or in collision. What is missing has its default.
        starts
            Largest number of starts, at least 1.
        solutions
            Number of different solutions to look for; the search ends when there are so many.
        seed
            Seed of the random starts.

        Raises
        ------
        UnknownNameError, InvalidValueError
            For values of unknown symbols, values that are not finite, less than one start, or a negative
            seed.

        See Also
        --------
        kineverse.control.InverseKinematics
        """
        begin = perf_counter()
        starts, solutions = as_count("starts", starts, 1), as_count("solutions", solutions, 1)
        seed = as_count("seed", seed, 0)
        assigned = self._load(values)
        search, space, clearance = self._search, self._program.space, self._clearance
        x = search.x
        home = x.copy()
        search.iterations = 0
        search.weights[:] = self._program.weights
        result: list[Array] = []
        obstacles: Counter[str] = Counter()
        best = blocked = SearchEnd(home, math.inf)
        generator: np.random.Generator | None = None
        used = 0
        for used in range(1, starts + 1):
            if used == 1:
                search.enter_limits()
            else:
                generator = generator or np.random.default_rng(seed)
                x[:] = space.draw(generator, home)
            error = search.descend(STEPS, PROGRESS)
            if error > 0.0:
                if error < best.error:
                    best = SearchEnd(x.copy(), error)
                continue
            space.bring_back(x, home)
            if not search.is_done():
                continue
            if clearance is not None:
                clearance.measure(x)
                pairs = clearance.near
                error = search.clear()
                if error > 0.0:
                    obstacles.update(f"{pair.a} and {pair.b}" for pair in pairs[:1])
                    if error < blocked.error:
                        blocked = SearchEnd(x.copy(), error)
                    continue
            if all(np.abs(x - other).max() > _DIFFERENT for other in result):
                result.append(x.copy())
            if len(result) == solutions:
                break
        result.sort(key=lambda q: float(np.linalg.norm(q - home)))
        if result:
            x[:] = result[0]
        elif blocked.error < math.inf:
            x[:] = blocked.coordinates
        else:
            search.approach(home, best.coordinates, generator or np.random.default_rng(seed))
            space.bring_back(x, home)
            # Monotone steps converge where full steps were given up, such as towards a distant target.
            if search.is_done() and (clearance is None or clearance.measure(x) == 0.0):
                result.append(x.copy())
        return self._result(assigned, result, obstacles, used, begin)

    def batch(self, values: Iterable[StateLike], *, starts: int = 16, seed: int = 0) -> list[IkResult]:
        """Return the results of many targets, each as of :meth:`solve`.

        Targets are solved one by one. Steps of all targets together, clipped to the limits, are no faster:
        they solve fewer targets, because active limits need a quadratic program for each of them.
        """
        return [self.solve(target, starts=starts, seed=seed) for target in values]

    def _load(self, values: StateLike | None) -> Mapping[Symbol, float]:
        assigned = {} if values is None else self._given(values)
        if isinstance(assigned, State):
            vector = (self._home | assigned).vector(self.inputs)
        else:
            vector = self._defaults.copy()
            for symbol, value in assigned.items():
                if symbol in self._place:
                    vector[self._place[symbol]] = value
        if not np.isfinite(vector).all():
            wrong = [str(s) for s, v in zip(self.inputs, vector, strict=True) if not math.isfinite(v)]
            raise NotFiniteError(f"There is no finite value for {', '.join(map(repr, wrong[:6]))}.", wrong)
        self._search.constants[:] = vector[: len(self._program.inputs)]
        self._program.space.normalize(self._search.x)
        if self._clearance is not None:
            self._clearance.load(dict(zip(self.inputs, vector.tolist(), strict=True)))
        return assigned

    def _given(self, values: StateLike) -> Mapping[Symbol, float]:
        """Return values by symbol; a state if they are one, or contain anything unusual."""
        if isinstance(values, State):
            return values
        try:
            # A state takes ten times as long, most of the time of an easy target.
            assigned = {self._lookup[key]: value for key, value in values.items()}
            if len(assigned) == len(values) and all(map(math.isfinite, assigned.values())):
                return assigned
        except (KeyError, TypeError, AttributeError):
            pass
        return as_state(values, self._known)

    def _result(
        self,
        assigned: Mapping[Symbol, float],
        found: Sequence[Array],
        obstacles: Counter[str],
        starts: int,
        begin: float,
    ) -> IkResult:
        search = self._search
        residuals = search.residuals()
        active: tuple[str, ...] = ()
        contacts: Sequence[DistanceResult] = ()
        ends = found or [search.x.copy()]
        if not found:
            active = search.active()
            if self._clearance is not None:
                self._clearance.measure(search.x)
                contacts = self._clearance.near

        def make_states() -> tuple[State, ...]:
            whole = self._home | State(assigned)
            moved = (dict(zip(self.coordinates, end.tolist(), strict=True)) for end in ends)
            return tuple(whole | State(values) for values in moved)

        effort, explain = (starts, search.iterations, perf_counter() - begin), self._explain
        return IkResult(bool(found), residuals, active, contacts, *effort, make_states, explain, obstacles)

    def _explain(self, result: IkResult) -> str:
        if result.solved:
            return f"All tasks are done, after {result.starts} starts."
        self._load(result.best)
        search, program = self._search, self._program
        search.weights[:] = 1.0
        search.evaluate()
        values = np.abs(search.outputs[5])
        done = {p.name: (values[search.rows[p.name]] <= p.tolerance).all() for p in program.parts}
        off = [name for name, is_done in done.items() if not is_done]
        outside = [name for name in program.keeps if result.residuals[name] > TOLERANCE]
        off += outside
        tried = f"in {result.starts} starts" if result.starts > 1 else "from the given state"
        lines = []
        if result.obstacles:
            pairs = "; ".join(f"{pair} ({n} times)" for pair, n in result.obstacles.most_common(3))
            lines.append(f"Without collisions there are solutions. These bodies are in the way: {pairs}.")
        if off:
            listed = ", ".join(f"'{name}' is off by {result.residuals[name]:.3g}" for name in off)
            lines.append(f"No solution was found {tried}. At the best point {listed}.")
        if result.contacts:
            touching = "; ".join(f"{pair.a} and {pair.b}" for pair in result.contacts[:3])
            lines.append(f"Too near to each other there are {touching}.")
        alone: list[str] = []
        if outside:
            listed = ", ".join(f"'{name}'" for name in outside)
            lines.append(f"No configuration within the range of {listed} was found, whatever the goals are.")
        elif len(off) > 1 and not result.obstacles:
            alone = [name for name in off if name in search.rows and self._is_reachable(name, result.best)]
            if len(alone) == len(off):
                lines.append("Each of these can be done alone, so they contradict each other.")
            else:
                rest = ", ".join(f"'{name}'" for name in off if name not in alone)
                lines.append(f"Not even alone can {rest} be done.")
        if result.active:
            lines.append(f"These limits and constraints stop it: {', '.join(result.active[:8])}.")
        elif off and len(alone) < 2 and not result.obstacles:
            lines.append(
                "No limit stops it: no small motion reduces the errors. The target is out of reach, or more "
                "starts are needed."
            )
        return " ".join(lines)

    def _is_reachable(self, name: str, state: State) -> bool:
        """Return whether a search for one task alone succeeds, with the constraints of the model."""
        self._load(state)
        search = self._search
        alone = np.zeros(len(search.weights), dtype=bool)
        alone[search.first_violation :] = True
        for part in self._program.parts:
            alone[search.rows[part.name]] = part.name == name or part.name in self.model.constraints
        search.weights[:] = np.where(alone, self._program.weights, 0.0)
        home, generator = search.x.copy(), np.random.default_rng(0)
        for start in range(_EXPLAINING_STARTS):
            if start:
                search.x[:] = self._program.space.draw(generator, home)
            if search.descend(STEPS, PROGRESS) == 0.0:
                return True
        return False

    def __repr__(self) -> str:
        return f"<InverseKinematics: {len(self.tasks)} tasks, {len(self.coordinates)} coordinates>"


def inverse_kinematics(
    model: ModelView,
    tasks: Iterable[Task],
    *,
    values: StateLike | None = None,
    starts: int = 16,
    solutions: int = 1,
    seed: int = 0,
    scene: Scene | None = None,
    fixed: Iterable[Symbol | str] = (),
    margin: float = 0.0,
    tolerance: float = 1e-5,
) -> IkResult:
    """Return a configuration of a model for tasks: :class:`InverseKinematics`, built and solved once.

    Parameters
    ----------
    model, tasks, scene, fixed, margin, tolerance
        As for :class:`InverseKinematics`.
    values, starts, solutions, seed
        As for :meth:`InverseKinematics.solve`.

    Examples
    --------
    >>> model = kv.load("fetch")
    >>> hand = model.fk("fetch/gripper_link")
    >>> pose = kv.translation(0.7, 0.2, 0.9) @ kv.rpy(0, np.pi / 2, 0)
    >>> goal = kv.control.Goal(kv.control.same_pose(pose, hand), name="reach")
    >>> result = kv.control.inverse_kinematics(model, [goal], fixed=["fetch/base"])
    >>> result.solved, hand(result.best)[:3, 3].round(4)
    (True, array([0.7, 0.2, 0.9]))
    """
    solver = InverseKinematics(model, tasks, scene=scene, fixed=fixed, margin=margin, tolerance=tolerance)
    return solver.solve(values, starts=starts, solutions=solutions, seed=seed)


@answer_foreign_names("A result", IK_RESULT_SYNONYMS)
@dataclass(frozen=True, eq=False)
class IkResult:
    """Configuration found by inverse kinematics, with the state of each task.

    Attributes
    ----------
    solved
        True if all tasks are done, within the limits and without collisions.
    residuals
        Norm of the error of each task and equality at the best point, by name, in the unit of its expression;
        for a keep its violation.
    active
        Names of the limits and constraints that stop goals at the best point, the strongest first; empty if
        solved.
    contacts
        Pairs of bodies nearer than the margin at the best point, nearest first.
    obstacles
        Pairs of bodies that stopped solutions, with the number of starts.
    starts, iterations
        Numbers of starts and of Gauss-Newton steps.
    seconds
        Duration [s].

    See Also
    --------
    kineverse.control.inverse_kinematics
    """

    solved: bool
    residuals: Mapping[str, float]
    active: tuple[str, ...]
    contacts: Sequence[DistanceResult]
    starts: int
    iterations: int
    seconds: float
    make_states: Callable[[], tuple[State, ...]] = field(repr=False)
    explain: Callable[[IkResult], str] = field(repr=False)
    obstacles: Counter[str] = field(repr=False)

    @cached_property
    def best(self) -> State:
        """State of the solution that is nearest to the first start, else of the best point.

        That is the point of least weighted squared errors of goals, where holds, keeps and constraints are
        satisfied if that is possible. A state has values for everything in the model; what no task moves
        keeps its values.
        """
        return self._states[0]

    @cached_property
    def solutions(self) -> tuple[State, ...]:
        """Different solutions, the nearest to the first start first; empty if not solved."""
        return self._states if self.solved else ()

    @cached_property
    def why(self) -> str:
        """Explanation of what prevents a solution; computed on first use, by further searches."""
        return self.explain(self)

    @cached_property
    def _states(self) -> tuple[State, ...]:
        return self.make_states()

    def __repr__(self) -> str:
        state = "solved" if self.solved else "not solved"
        worst = ", ".join(f"{name}: {value:.3g}" for name, value in self.residuals.items())
        return f"<IkResult: {state} after {self.starts} starts, {self.iterations} steps; {worst}>"
