"""Linearisation of tasks and constraints over the free speeds that serve them.

The columns are found, not listed: the speeds in the gradients of the tasks (wheels included), then those of
all constraints that share a coordinate with them, until nothing is added. Equalities of the model, such as
closures of loops, are holds.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from kineverse.errors import DuplicateNameError, ExpressionError, InvalidValueError, UnknownNameError, suggest
from kineverse.expressions.expression import Expression, ExpressionLike, array, as_expression
from kineverse.expressions.functions import minimum, norm
from kineverse.expressions.gradient import stack_columns
from kineverse.model.constraint import Constraint
from kineverse.model.model_view import ModelView, find_symbols
from kineverse.model.projection import is_equality
from kineverse.model.velocity_constraints.speed_limits import is_infinite, raw_max
from kineverse.model.velocity_constraints.velocity_rows import VelocityRows, velocity_rows
from kineverse.symbols import Symbol

from .tasks import Goal, Hold, Keep, Task

ZERO = as_expression(0.0)
_SMALLEST = 1e-300


@dataclass(frozen=True)
class GoalRows:
    """Goal as rows ``jacobian @ v ≈ rate``."""

    name: str
    error: Expression  # (k,) expression minus target; of a goal about speeds, minus the target alone
    jacobian: Expression  # (k, n) over the columns
    correction: Expression  # (k,) wanted rates by the error alone
    rate: Expression  # (k,) wanted rates, those of the target included
    weight: Expression  # (k,)
    about_speeds: bool = False


@dataclass(frozen=True)
class HoldRows:
    """Equality as rows ``jacobian @ v == -gain·s·error``, s the progress.

    ``closure`` is True for an equality of the model, such as the closure of a loop.
    """

    name: str
    error: Expression
    jacobian: Expression
    gain: Expression
    closure: bool = False


class Formulation:
    """Tasks and constraints of a model over its free speeds, for the quadratic programs of controllers."""

    def __init__(
        self,
        model: ModelView,
        tasks: Iterable[Task],
        *,
        dt: ExpressionLike,
        fixed: Iterable[Symbol | str] = (),
        accelerations: Mapping[Symbol, ExpressionLike] | None = None,
    ) -> None:
        self.model = model
        self.tasks = check_tasks(tasks)
        self._names = name_tasks(self.tasks)
        self._most_gain = 1.0 / as_expression(dt)
        fixed_speeds = find_speeds(model, fixed, "fixed")
        rates = model.rates
        every = dict(model.constraints)
        errors = {task: rates.carry(task.error) for task in self.tasks if isinstance(task, Goal | Hold)}
        ranged = {self._names[task]: task.constraint for task in self.tasks if isinstance(task, Keep)}
        keeps = {
            name: Constraint(*map(rates.carry, (c.lower, c.expression, c.upper)))
            for name, c in ranged.items()
        }
        taken = [name for name in keeps if name in every]
        if taken:
            raise DuplicateNameError(f"The model has a constraint '{taken[0]}'; give the Keep another name.")
        subject = [*errors.values(), *(e for c in keeps.values() for e in _parts(c))]
        known = {s.path for s in (*model.symbols, *model.rates.dependent, *model.speeds)}
        for expression in subject:
            refuse_foreign_symbols("A task", expression, known)
        relevant = _relevant_constraints(model, subject) | keeps
        equalities = {name: c for name, c in relevant.items() if is_equality(c)}
        ranges = {name: c for name, c in relevant.items() if name not in equalities}
        held = {name: rates.carry(c.expression - c.lower) for name, c in equalities.items()}
        about_speeds = {task: error for task, error in errors.items() if any(s.order for s in error.symbols)}
        gradients, constants = self._split_speed_goals(about_speeds)
        gradients |= {
            task: rates.over_free_speeds(error.gradient(heuristic=isinstance(task, Goal) and task.heuristic))
            for task, error in errors.items()
            if task not in about_speeds
        }
        slopes = {name: error.gradient(heuristic=False) for name, error in held.items()}
        closures = {name: rates.over_free_speeds(slope) for name, slope in slopes.items()}
        first = {s for g in (*gradients.values(), *closures.values()) for s in g}
        self._limits = dict(every)
        for speed, limit in (accelerations or {}).items():
            brake = Constraint.from_expressions(-as_expression(limit), speed.derivative(), limit)
            self._limits[f"acceleration of {speed.position}"] = brake
        result = self._rows(ranges, dt, None)
        columns = (first | set(result.speeds)) - fixed_speeds
        self.speeds: tuple[Symbol, ...] = tuple(sorted(columns, key=lambda s: s.sort_key))
        unknown = [s for s in self.speeds if s not in model.speeds]
        if unknown:
            raise UnknownNameError(
                f"The tasks are about '{unknown[0]}', and nothing in the model moves with it. "
                f"{suggest(str(unknown[0]), map(str, model.speeds), 'speed')}"
            )
        self.rows = result if result.speeds == self.speeds else self._rows(ranges, dt, self.speeds)
        self._check_keeps({name: c for name, c in keeps.items() if name in ranges})
        self.keeps = tuple(name for name in keeps if name not in equalities)
        self.goals = tuple(
            self._goal_rows(task, errors[task], gradients[task], constants.get(task))
            for task in self.tasks
            if isinstance(task, Goal)
        )
        default = minimum(0.5 / as_expression(dt), 10.0)
        holds = []
        for task in self.tasks:
            if isinstance(task, Hold):
                gain = default if task.gain is None else self._limit_gain(task.gain)
                jacobian = self._matrix(task, gradients[task])
                holds.append(HoldRows(self._names[task], errors[task], jacobian, gain))
        for name, error in held.items():
            holds.append(HoldRows(name, error.ravel(), self._stack(closures[name], 1), default, True))
        self.holds = tuple(holds)

    @property
    def parts(self) -> dict[str, Expression]:
        """All values and derivatives in the rows of each task and constraint, by name, flat."""
        result: dict[str, list[Expression]] = {}
        tasks: tuple[GoalRows | HoldRows, ...] = (*self.goals, *self.holds)
        for row in tasks:
            result[row.name] = [row.error, row.jacobian.ravel()]
        rows = self.rows
        for k, name in enumerate(rows.names):
            ends = [e for e in (rows.lower[k], rows.upper[k], rows.violation[k]) if e.symbols]
            result.setdefault(name, []).extend([rows.matrix[k], *(e.ravel() for e in ends)])
        return {name: as_expression(np.concatenate(part)) for name, part in result.items()}

    def _rows(
        self, constraints: dict[str, Constraint], dt: ExpressionLike, speeds: Sequence[Symbol] | None
    ) -> VelocityRows:
        build = partial(velocity_rows, rates=self.model.rates, speeds=speeds, speed_limits=self._limits)
        return build(constraints, dt, recovery="allowed")

    def _split_speed_goals(
        self, errors: Mapping[Goal | Hold, Expression]
    ) -> tuple[dict[Goal | Hold, dict[Symbol, Expression]], dict[Goal | Hold, Expression]]:
        """Return coefficients of free speeds and constant part of goals about speeds.

        All goals are differentiated at once, since they often have parts in common.
        """
        gradients: dict[Goal | Hold, dict[Symbol, Expression]] = {}
        constants: dict[Goal | Hold, Expression] = {}
        if not errors:
            return gradients, constants
        eliminated = {task: self.model.rates.eliminate(error) for task, error in errors.items()}
        every = as_expression(np.concatenate(list(eliminated.values())))
        speeds = [s for s in every.symbols if s.order == 1]
        slopes, constant = every.partial(speeds), every.substitute(dict.fromkeys(speeds, 0.0))
        first = 0
        for task, error in eliminated.items():
            symbols, rows = set(error.symbols), slice(first, first + error.size)
            if any(s.order for s in slopes[rows].symbols) or any(s.order > 1 for s in symbols):
                raise InvalidValueError(f"{task!r} is not linear in speeds, so no goal can be made of it.")
            gradients[task] = {s: slopes[rows, i] for i, s in enumerate(speeds) if s in symbols}
            constants[task] = constant[rows]
            first = rows.stop
        return gradients, constants

    def _goal_rows(
        self, goal: Goal, error: Expression, gradient: dict[Symbol, Expression], constant: Expression | None
    ) -> GoalRows:
        jacobian = self._matrix(goal, gradient)
        weights = as_expression(goal.weight).ravel()
        weight = array([weights[k if weights.size > 1 else 0] for k in range(goal.error.size)])
        if constant is not None:
            none = as_expression(np.zeros(goal.error.size))
            return GoalRows(self._names[goal], constant, jacobian, none, -constant, weight, True)
        rate = correction = -self._limit_gain(goal.gain) * error
        if goal.speed is not None:
            speed = as_expression(goal.speed)
            # A speed of 0, of a parameter, has to be possible where the error is 0.
            size = raw_max(norm(np.concatenate([rate, [speed]])), as_expression(_SMALLEST))
            rate = correction = rate * (speed / size)
        if goal.rate is not None:
            rate = rate + (as_expression(goal.rate) + ZERO * goal.expression).ravel()
        return GoalRows(self._names[goal], error, jacobian, correction, rate, weight)

    def _limit_gain(self, gain: ExpressionLike) -> Expression:
        """Limit a gain to 1/dt; with a larger one a step exceeds its target."""
        return minimum(as_expression(gain), self._most_gain)

    def _check_keeps(self, keeps: Mapping[str, Constraint]) -> None:
        """Refuse keeps that cannot be rows, and would be ignored."""
        reasons = dict(self.rows.skipped)
        for name, constraint in keeps.items():
            if constraint.order > 1:
                reasons[name] = "it is about accelerations, whose limits are given by acceleration="
            bounded = not (is_infinite(constraint.lower) and is_infinite(constraint.upper))
            if name in reasons and bounded:
                raise InvalidValueError(f"The Keep '{name}' cannot be kept: {reasons[name]}.")

    def _matrix(self, task: Goal | Hold, gradient: dict[Symbol, Expression]) -> Expression:
        """Return the Jacobian over the columns, (k, n)."""
        if not any(s in gradient for s in self.speeds):
            named = ", ".join(f"'{s}'" for s in sorted(gradient, key=lambda s: s.sort_key))
            what = named or "no speed"
            raise InvalidValueError(f"{task!r} is moved by {what} only, which fixed= keeps in place.")
        return self._stack(gradient, task.error.size)

    def _stack(self, gradient: dict[Symbol, Expression], count: int) -> Expression:
        return stack_columns([gradient[s].ravel() if s in gradient else None for s in self.speeds], (count,))


def refuse_foreign_symbols(task: str, expression: Expression, known: Collection[str]) -> None:
    """Raise UnknownNameError for a degree of freedom whose path is not among the known ones."""
    for symbol in expression.symbols:
        if symbol.role == "dof" and symbol.path not in known:
            raise UnknownNameError(
                f"{task} is about '{symbol}', which is not in the model. "
                f"{suggest(symbol.path, known, 'symbol')}"
            )


def _parts(constraint: Constraint) -> tuple[Expression, ...]:
    """Return the expressions whose coordinates move if a constraint is to hold."""
    if constraint.order:
        return (constraint.expression,)
    return constraint.lower, constraint.expression, constraint.upper


def _relevant_constraints(model: ModelView, subject: Sequence[Expression]) -> dict[str, Constraint]:
    """Return the constraints that share a coordinate with a subject, or with a constraint of the result.

    Coordinates in bounds of positions count: each moves the others. Those in bounds of speeds, such as the
    bolt of a lock, do not.
    """
    result = model.constraints_for(subject, closure=True)
    while True:
        shared = [*subject, *(part for c in result.values() for part in _parts(c))]
        every = model.constraints_for(shared, bounds=True)
        more = [c for name, c in every.items() if name not in result and c.order == 0]
        if not more:
            return result
        result = model.constraints_for([*shared, *(part for c in more for part in _parts(c))], closure=True)


def find_speeds(model: ModelView, names: Iterable[Symbol | str], argument: str) -> frozenset[Symbol]:
    """Find the free speeds of coordinates, speeds or articulations, as symbols or names.

    A driven or dependent coordinate stands for all speeds in its row, an articulation for all of its
    coordinates.
    """
    result: set[Symbol] = set()
    for symbol in find_symbols(model, names, f"{argument}="):
        row = model.rates.row(symbol.position) if symbol.order <= 1 else None
        speeds = {symbol.derivative() if symbol.order == 0 else symbol} if row is None else set(row)
        unknown = [s for s in speeds if s not in model.speeds]
        if unknown:
            raise UnknownNameError(
                f"{argument}=: nothing in the model moves with '{unknown[0]}'. "
                f"{suggest(str(unknown[0]), map(str, model.speeds), 'speed')}"
            )
        result |= speeds
    return frozenset(result)


def check_tasks(tasks: Iterable[Task]) -> tuple[Task, ...]:
    """Check the kinds and the number of tasks."""
    if isinstance(tasks, Goal | Hold | Keep):
        tasks = (tasks,)
    checked = tuple(tasks)
    for task in checked:
        if not isinstance(task, Goal | Hold | Keep):
            raise ExpressionError(f"A task is a Goal, a Hold or a Keep, not {task!r}.")
    if not checked:
        raise InvalidValueError("Without a task there is nothing to do; give a Goal, Hold or Keep.")
    return checked


def name_tasks(tasks: Sequence[Task]) -> dict[Task, str]:
    """Name each task: by its name, by its only symbol, or by its kind and number."""
    named: dict[Task, str] = {}
    for k, task in enumerate(tasks):
        subject = str(task.expression) if isinstance(task.expression, Symbol) else ""
        kind = type(task).__name__.lower()
        named[task] = task.name or (f"{kind} {subject}" if subject else f"{kind} {k + 1}")
    twice = [name for name, count in Counter(named.values()).items() if count > 1]
    if twice:
        raise DuplicateNameError(f"Two tasks have the name {twice[0]!r}; give each a name=... of its own.")
    return named
