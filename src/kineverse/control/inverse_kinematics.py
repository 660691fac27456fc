"""Inverse kinematics: a configuration for tasks of any kind, by Gauss-Newton steps from several starts.

Each start ends when its tasks are done, or when five steps reduce the errors by less than a tenth. The first
start is the given state, the others are random. Without a solution, the best end of all starts is continued
to the nearest point that is possible.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from time import perf_counter
from typing import NamedTuple

import numpy as np

from kineverse._checks import as_tolerance
from kineverse.errors import InvalidValueError, NoSolutionError, NotFiniteError, UnknownNameError
from kineverse.geometry import Scene
from kineverse.geometry.results import DistanceResult
from kineverse.lie import Array
from kineverse.model.model_view import ModelView
from kineverse.model.projection import TOLERANCE
from kineverse.state import State, StateLike, as_state
from kineverse.symbols import Symbol

from .clearance import Clearance
from .command import SATURATED
from .ik_result import IkResult
from .position_program import PositionProgram
from .quadratic_program import make_solver
from .tasks import Task

_STEPS, _CLEARING_STEPS, _LAST_STEPS = 40, 60, 200
_PATIENCE = 5
"""Number of steps after which the errors have to be smaller."""
_PROGRESS = 0.9**2
_SETTLED, _SHORTEST = 1 - 1e-9, 1e-7
_HALVINGS, _APPROACHES = 8, 8
_COLLIDING = 1e9
"""Smallest penalty of an overlap, beside weighted sums of squares."""
_EXACT_WEIGHT = 1e4
"""Weight of equalities and violated constraints beside goals that are out of reach."""
_DIFFERENT = 1e-3
"""Least difference of a coordinate of two solutions [m], [rad]."""
_EXPLAINING_STARTS = 8


class _End(NamedTuple):
    """End of a search: coordinates, and what is left."""

    coordinates: Array
    error: float


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
        to each other count, without those that its rules except and those that always overlap.
    still
        Coordinates that stay still, as symbols or names; a name of an articulation stands for its
        coordinates.
    margin
        Least distance of pairs of bodies [m].
    tolerance
        Largest entry of the errors of a goal that is reached, in the unit of its expression [m], [rad].
        Holds, keeps and constraints are satisfied to 1e-9.

    Attributes
    ----------
    model
        The model.
    tasks
        The tasks.
    coordinates
        The coordinates that may move, found from the tasks and the constraints that they meet.
    inputs
        The symbols whose values matter: coordinates, parameters, and others in the tasks.

    Raises
    ------
    InvalidValueError
        If there is no goal or hold, for a task about speeds, or one that nothing moves.
    UnknownNameError
        For a task about a symbol that the model does not have, or an unknown name in ``still``.
    DuplicateNameError
        For two tasks of one name.
    MissingDependencyError
        If the solver of quadratic programs is not installed.
    """

    def __init__(
        self,
        model: ModelView,
        tasks: Iterable[Task],
        *,
        scene: Scene | None = None,
        still: Iterable[Symbol | str] = (),
        margin: float = 0.0,
        tolerance: float = 1e-5,
    ) -> None:
        self.model = model
        self._program = program = PositionProgram(model, tasks, still, as_tolerance(tolerance))
        self.tasks, self.coordinates = program.tasks, program.coordinates
        self._clearance = None
        if scene is not None:
            self._clearance = Clearance(scene, program, as_tolerance(margin))
        self._home = model.default_state()
        outside = () if self._clearance is None else self._clearance.inputs
        extra = sorted({*outside} - {*program.inputs}, key=lambda s: s.sort_key)
        self.inputs = (*program.inputs, *extra)
        self._evaluate = program.function.bind()
        n, first = len(self.coordinates), len(program.inputs)
        self._x = self._evaluate.input[:n]
        self._constants = self._evaluate.input[:first]
        self._weights = self._evaluate.input[first:]
        self._solver = make_solver("daqp", n, len(program.names) - n)
        self._known = (*model.symbols, *model.speeds, *self.inputs)
        names = Counter(map(str, {*self._known}))
        self._lookup: dict[object, Symbol] = {s: s for s in self._known}
        self._lookup |= {str(s): s for s in self._known if names[str(s)] == 1}
        self._rows: dict[str, slice] = {}
        start = 0
        for part in program.parts:
            self._rows[part.name] = slice(start, start + part.error.size)
            start += part.error.size
        exact = {part.name for part in program.parts if part.exact}
        self._exact = np.ones(len(program.weights), dtype=bool)
        for name, rows in self._rows.items():
            self._exact[rows] = name in exact
        self._first_violation = start
        self._iterations = 0

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
            For values of unknown symbols, values that are not finite, or less than one start.
        """
        begin = perf_counter()
        for name, number in (("starts", starts), ("solutions", solutions)):
            if not isinstance(number, int) or number < 1:
                raise InvalidValueError(f"{name}= is a number of at least 1, not {number!r}.")
        state = self._load(values)
        home = self._x.copy()
        self._iterations = 0
        self._weights[:] = self._program.weights
        found: list[Array] = []
        obstacles: Counter[str] = Counter()
        best, blocked = _End(home, math.inf), _End(home, math.inf)
        generator: np.random.Generator | None = None
        used = 0
        for used in range(1, starts + 1):
            if used == 1:
                self._enter_limits()
            else:
                generator = generator or np.random.default_rng(seed)
                self._x[:] = self._program.draw(generator, home)
            error = self._descend(_STEPS, _PROGRESS)
            if error > 0.0:
                if error < best.error:
                    best = _End(self._x.copy(), error)
                continue
            self._program.bring_back(self._x, home)
            if not self._is_done():
                continue
            if self._clearance is not None:
                self._clearance.measure(self._x)
                pairs = self._clearance.near
                left = self._clear()
                if left > 0.0:
                    obstacles.update(f"{pair.a} and {pair.b}" for pair in pairs[:1])
                    if left < blocked.error:
                        blocked = _End(self._x.copy(), left)
                    continue
            if all(np.abs(self._x - other).max() > _DIFFERENT for other in found):
                found.append(self._x.copy())
            if len(found) == solutions:
                break
        found.sort(key=lambda x: float(np.linalg.norm(x - home)))
        if found:
            self._x[:] = found[0]
        elif blocked.error < math.inf:
            self._x[:] = blocked.coordinates
        else:
            self._approach(home, best.coordinates, generator or np.random.default_rng(seed))
            self._program.bring_back(self._x, home)
        return self._result(state, found, obstacles, used, begin)

    def batch(self, values: Iterable[StateLike], *, starts: int = 16, seed: int = 0) -> list[IkResult]:
        """Return the results of many targets, each as of :meth:`solve`.

        Targets are solved one by one: a step of one target takes some microseconds, and targets need very
        different numbers of steps.
        """
        return [self.solve(target, starts=starts, seed=seed) for target in values]

    # -- search --------------------------------------------------------------------------------------------

    def _load(self, values: StateLike | None) -> State:
        """Write the values of all inputs, and return the whole state."""
        state = self._home
        if values is not None:
            state = state | State(self._given(values))
        try:
            vector = state.vector(self.inputs)
        except UnknownNameError as error:
            raise UnknownNameError(f"{error} Give it in values=.") from None
        if not np.isfinite(vector).all():
            wrong = [str(s) for s, v in zip(self.inputs, vector, strict=True) if not math.isfinite(v)]
            raise NotFiniteError(f"There is no finite value for {', '.join(map(repr, wrong[:6]))}.", wrong)
        self._constants[:] = vector[: len(self._constants)]
        self._program.normalize(self._x)
        if self._clearance is not None:
            self._clearance.load(dict(zip(self.inputs, vector.tolist(), strict=True)))
        return state

    def _given(self, values: StateLike) -> Mapping[Symbol, float]:
        """Return values by symbol."""
        if isinstance(values, State):
            return values
        try:
            # Most names are those of one symbol, and then this is the fastest way.
            return {self._lookup[key]: value for key, value in values.items()}
        except (KeyError, TypeError, AttributeError):
            return as_state(values, self._known)

    def _try(self) -> float:
        """Evaluate the program; return the weighted sum of squares, inf where it is undefined."""
        try:
            self._evaluate()
        except NoSolutionError:
            return math.inf
        total: float = self._evaluate.outputs[6].item()
        return total if total < math.inf else math.inf

    def _is_done(self) -> bool:
        return self._try() < math.inf and self._evaluate.outputs[7].item() <= 1.0

    def _enter_limits(self) -> None:
        """Bring coordinates that are outside of their limits to the nearest one."""
        n = len(self._x)
        if self._try() < math.inf:
            away = self._evaluate.outputs[5][self._first_violation :][:n]
            self._x -= away
        program = self._program
        np.clip(
            self._x, program.lower, program.upper, out=self._x, where=program.fixed_limits & ~program.turning
        )

    def _descend(self, steps: int, ratio: float) -> float:
        """Take Gauss-Newton steps; return 0 if all tasks are done, else the weighted sum of squares.

        Ends as well when the sum is more than ``ratio`` times that of five steps ago.
        """
        x, solve, normalize = self._x, self._solver.solve, self._program.normalize
        H, f, A, lower, upper, _, _, excess = self._evaluate.outputs
        quaternions = bool(self._program.quaternions)
        recent = [math.inf] * _PATIENCE
        before, step = x.copy(), None
        total = math.inf
        for k in range(steps):
            self._iterations += 1
            total = self._try()
            if total == math.inf:
                if step is None:
                    return math.inf
                total = self._halve(before, step)
                if total == math.inf:
                    x[:] = before
                    return recent[(k - 1) % _PATIENCE]
            if excess.item() <= 1.0:
                return 0.0
            if not total <= ratio * recent[k % _PATIENCE]:
                break
            recent[k % _PATIENCE] = total
            found = solve(H, f, A, lower, upper)
            if found.status != "solved":
                break
            before[:] = x
            step = found.x
            x += step
            if quaternions:
                normalize(x)
        return total

    def _halve(self, before: Array, step: Array) -> float:
        """Halve a step that leads out of the domain of a closed loop."""
        for k in range(1, _HALVINGS + 1):
            self._x[:] = before + step / 2**k
            self._program.normalize(self._x)
            total = self._try()
            if total < math.inf:
                return total
        return math.inf

    def _approach(self, home: Array, end: Array, generator: np.random.Generator) -> None:
        """Search the best point: equalities and constraints first, then goals as far as these allow.

        It starts at the given end of a search, at the given state and at random, until two points satisfy
        the constraints. If none does, all of them have weights at the first start.
        """
        x, exact_only = self._x, np.where(self._exact, 1.0, 0.0)
        best = _End(end, math.inf)
        satisfied = 0
        for k in range(_APPROACHES):
            x[:] = end if k == 0 else home if k == 1 else self._program.draw(generator, home)
            self._enter_limits()
            self._weights[:] = exact_only
            if self._descend(_STEPS, _PROGRESS) > 0.0:
                continue
            satisfied += 1
            self._minimize_within()
            if self._descend(_STEPS, _PROGRESS) == 0.0:
                self._weights[:] = 1.0
                total = self._try()
                if total < best.error:
                    best = _End(x.copy(), total)
            if satisfied == 2:
                break
        x[:] = best.coordinates
        if best.error == math.inf:
            self._minimize_within()
        self._weights[:] = 1.0
        if self._clearance is not None:
            self._clear()

    def _minimize_within(self) -> None:
        """Minimize with large weights of equalities and violations; then leave the weights to these alone."""
        self._weights[:] = np.where(self._exact, _EXACT_WEIGHT, 1.0)
        self._minimize()
        self._weights[:] = np.where(self._exact, 1.0, 0.0)

    def _minimize(self) -> None:
        """Take steps that reduce the weighted sum of squares, with as much damping as that needs.

        Far from all solutions, curvature that a Gauss-Newton step leaves out exceeds the damping by the error
        (Levenberg-Marquardt method).
        """
        x = self._x
        H, f, A, lower, upper, *_ = self._evaluate.outputs
        best, least, damping = x.copy(), self._try(), 0.0
        for _ in range(_LAST_STEPS):
            self._iterations += 1
            if least == math.inf:
                return
            H.reshape(-1)[:: len(x) + 1] += damping
            found = self._solver.solve(H, f, A, lower, upper)
            if found.status != "solved":
                return
            x += found.x
            self._program.normalize(x)
            total = self._try()
            if total < least:
                settled = total > _SETTLED * least
                best[:], least, damping = x, total, damping / 3
                if settled:
                    return
            else:
                if np.abs(found.x).max() < _SHORTEST:
                    break
                x[:], damping = best, max(4 * damping, 0.01 * least)
                self._try()
        x[:] = best

    def _clear(self) -> float:
        """Leave collisions while the tasks are kept; return 0 if that succeeds.

        Else the weighted sum of squares if the bodies are apart, and more than that if they are not.
        """
        clearance, x = self._clearance, self._x
        assert clearance is not None
        H, f, A, lower, upper, _, _, excess = self._evaluate.outputs
        last = x.copy()
        for _ in range(_CLEARING_STEPS):
            self._iterations += 1
            if self._try() == math.inf:
                x[:] = last
                break
            depth = clearance.measure(x)
            if depth == 0.0 and excess.item() <= 1.0:
                return 0.0
            step = clearance.find_step(H, f, A, lower, upper)
            if step is None:
                break
            last[:] = x
            x += step
            self._program.normalize(x)
        depth, total = clearance.measure(x), self._try()
        if depth == 0.0:
            return 0.0 if excess.item() <= 1.0 else total
        return _COLLIDING + depth

    # -- results -------------------------------------------------------------------------------------------

    def _result(
        self, state: State, found: Sequence[Array], obstacles: Counter[str], starts: int, begin: float
    ) -> IkResult:
        """Return the result at the present coordinates."""
        residuals = self._residuals()
        best = self._state(state, self._x)
        active: tuple[str, ...] = ()
        contacts: Sequence[DistanceResult] = ()
        if not found:
            active = self._active()
            if self._clearance is not None:
                self._clearance.measure(self._x)
                contacts = self._clearance.near
        return IkResult(
            best,
            bool(found),
            (best, *(self._state(state, x) for x in found[1:])) if found else (),
            residuals,
            active,
            contacts,
            starts,
            self._iterations,
            perf_counter() - begin,
            partial(self._explain, best, bool(found), residuals, active, obstacles, starts),
        )

    def _state(self, state: State, x: Array) -> State:
        return state | State(dict(zip(self.coordinates, x.tolist(), strict=True)))

    def _residuals(self) -> dict[str, float]:
        """Return the norm of the errors of each task and equality, and the violations of keeps."""
        self._try()
        values = self._evaluate.outputs[5]
        found = {name: float(np.linalg.norm(values[rows])) for name, rows in self._rows.items()}
        violations = values[self._first_violation :]
        for keep in self._program.keeps:
            rows = [k for k, names in enumerate(self._program.names) if keep in names]
            found[keep] = max((abs(float(violations[k])) for k in rows), default=0.0)
        return found

    def _active(self) -> tuple[str, ...]:
        """Return the names of the constraints whose multipliers are not 0 at the present coordinates."""
        self._weights[:] = np.where(self._exact, _EXACT_WEIGHT, 1.0)
        if self._try() == math.inf:
            return ()
        found = self._solver.solve(*self._evaluate.outputs[:5])
        sizes = np.abs(found.multipliers)
        order = sorted(np.flatnonzero(sizes > SATURATED).tolist(), key=lambda k: -float(sizes[k]))
        return tuple(dict.fromkeys(name for k in order for name in self._program.names[k]))

    def _explain(
        self,
        best: State,
        solved: bool,
        residuals: Mapping[str, float],
        active: Sequence[str],
        obstacles: Counter[str],
        starts: int,
    ) -> str:
        """Return the text of :attr:`.IkResult.why`."""
        if solved:
            return f"All tasks are done, after {starts} starts."
        self._load(best)
        self._weights[:] = 1.0
        self._try()
        values = np.abs(self._evaluate.outputs[5])
        off = [
            part.name
            for part in self._program.parts
            if not (values[self._rows[part.name]] <= part.tolerance).all()
        ]
        off += [name for name in self._program.keeps if residuals[name] > TOLERANCE]
        tried = f"in {starts} starts" if starts > 1 else "from the given state"
        lines = []
        if obstacles:
            pairs = "; ".join(f"{pair} ({count} times)" for pair, count in obstacles.most_common(3))
            lines.append(f"Without collisions there are solutions. These bodies are in the way: {pairs}.")
        if off:
            listed = ", ".join(f"'{name}' is off by {residuals[name]:.3g}" for name in off)
            lines.append(f"No solution was found {tried}. At the best point {listed}.")
        alone: list[str] = []
        if len(off) > 1:
            alone = [name for name in off if name in self._rows and self._is_reachable(name, best)]
            if len(alone) == len(off) and not obstacles:
                lines.append("Each of these can be done alone, so they contradict each other.")
            elif len(alone) < len(off):
                rest = ", ".join(f"'{name}'" for name in off if name not in alone)
                lines.append(f"Not even alone can {rest} be done.")
        if active:
            lines.append(f"These limits and constraints stop it: {', '.join(active[:8])}.")
        elif off and len(alone) < 2 and not obstacles:
            lines.append(
                "No limit stops it: no small motion reduces the errors. The target is out of reach, or more "
                "starts are needed."
            )
        return " ".join(lines)

    def _is_reachable(self, name: str, state: State) -> bool:
        """Return whether a search for one task alone succeeds."""
        self._load(state)
        home, generator = self._x.copy(), np.random.default_rng(0)
        alone = np.zeros(len(self._weights), dtype=bool)
        alone[self._rows[name]] = alone[self._first_violation :] = True
        for part in self._program.parts:
            if part.name in self.model.constraints:
                alone[self._rows[part.name]] = True
        self._weights[:] = np.where(alone, self._program.weights, 0.0)
        for start in range(_EXPLAINING_STARTS):
            if start:
                self._x[:] = self._program.draw(generator, home)
            if self._descend(_STEPS, _PROGRESS) == 0.0:
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
    still: Iterable[Symbol | str] = (),
    margin: float = 0.0,
    tolerance: float = 1e-5,
) -> IkResult:
    """Return a configuration of a model for tasks: :class:`InverseKinematics`, built and solved once.

    Parameters
    ----------
    model, tasks, scene, still, margin, tolerance
        As for :class:`InverseKinematics`.
    values, starts, solutions, seed
        As for :meth:`InverseKinematics.solve`.
    """
    solver = InverseKinematics(model, tasks, scene=scene, still=still, margin=margin, tolerance=tolerance)
    return solver.solve(values, starts=starts, solutions=solutions, seed=seed)
