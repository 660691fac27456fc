"""Quadratic program of one Gauss-Newton step towards tasks, as one compiled function of the coordinates.

The unknowns are steps δ of the coordinates q themselves, not of speeds: a configuration is not restricted by
rolling, so a differential drive may be placed anywhere. With the errors e of goals, holds and equalities of
the model, the violations x of other constraints φ on positions, and row weights w::

    minimise    ½ Σ w (e + J δ)² + ½ Σ w (x + A δ)² + ½ λ |δ|²,    λ = 0.03 min(Σ w (e² + x²), 10) + 1e-6
    subject to  lower - φ <= A δ <= upper - φ,    outside of a bound: not further away

The damping λ is that of Sugihara, Solvability-unconcerned inverse kinematics by the Levenberg-Marquardt
method, IEEE Transactions on Robotics 27, 2011.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import reduce

import casadi as ca
import numpy as np

from kineverse.compilation import compile
from kineverse.errors import DuplicateNameError, InvalidValueError, NoSolutionError
from kineverse.expressions.expression import Expression, ExpressionLike, array, as_expression, binary
from kineverse.expressions.gradient import stack_columns
from kineverse.lie import Array
from kineverse.model.constraint import TOLERANCE, Constraint
from kineverse.model.model_view import ModelView
from kineverse.model.projection import is_equality
from kineverse.model.rates import Rates, to_plain
from kineverse.model.velocity_constraints.speed_limits import INFINITE, ZERO, raw_max, raw_min
from kineverse.model.velocity_constraints.velocity_rows import velocity_rows
from kineverse.symbols import Symbol, parameter

from .configuration_space import ConfigurationSpace, find_coordinates
from .formulation import check_tasks, name_tasks, refuse_foreign_symbols
from .tasks import Hold, Keep, Task

_DAMPING, _LEAST_DAMPING = 0.03, 1e-6
_FAR = 10.0
"""Largest sum of squares that counts for the damping, so that a base takes long steps to a distant target."""
_SAMPLES = 12
_SAME = 1e-9


@dataclass(frozen=True)
class ErrorRows:
    """Rows of one task, or of an equality of the model."""

    name: str
    error: Expression  # (k,), in plain independent coordinates
    weights: Expression  # (k,), of the squares
    tolerance: float  # largest error of a task that is done
    exact: bool  # True for holds and equalities, which are kept where goals are out of reach


class PositionProgram:
    """Compiled quadratic program of a Gauss-Newton step."""

    def __init__(
        self, model: ModelView, tasks: Iterable[Task], fixed: Iterable[Symbol | str], tolerance: float
    ) -> None:
        self.model = model
        self.tasks = check_tasks(tasks)
        still = find_coordinates(model, fixed)
        parts, ranges = self._collect(tolerance)
        self.parts, ranges = self._close(parts, ranges)
        errors = as_expression(np.concatenate([part.error for part in self.parts]))
        subjects = [errors, *(e for c in ranges.values() for e in (c.lower, c.expression, c.upper))]
        moving = {s.position for e in subjects for s in e.gradient(heuristic=False)} - still
        self._check_moved(still)
        self.coordinates = tuple(sorted(moving, key=lambda s: s.sort_key))
        self.space = ConfigurationSpace(model, self.coordinates, ranges)
        self._compile(errors, ranges)

    def make_plain(self, expression: ExpressionLike) -> Expression:
        """Return an expression in independent plain coordinates."""
        return self.model.rates.resolve(to_plain(as_expression(expression)))

    def _collect(self, tolerance: float) -> tuple[list[ErrorRows], dict[str, Constraint]]:
        """Return the rows of goals and holds, and the ranges of keeps."""
        parts: list[ErrorRows] = []
        ranges: dict[str, Constraint] = {}
        for task, name in name_tasks(self.tasks).items():
            ones = as_expression(np.ones(task.expression.size))
            if isinstance(task, Keep):
                c = task.constraint
                whole = Constraint(*map(self.make_plain, (c.lower, c.expression, c.upper)))
                subject = [whole.lower, whole.expression, whole.upper]
                if is_equality(whole):
                    error = (whole.expression - whole.lower).ravel()
                    parts.append(ErrorRows(name, error, ones, TOLERANCE, True))
                elif name in self.model.constraints:
                    raise DuplicateNameError(f"The model has a constraint '{name}'; rename the Keep.")
                else:
                    ranges[name] = whole
            else:
                error = self.make_plain(task.error)
                subject = [error]
                if isinstance(task, Hold):
                    parts.append(ErrorRows(name, error, ones, TOLERANCE, True))
                else:
                    weights = self.make_plain(task.weight).ravel()
                    weights = weights * ones if weights.size == 1 else weights
                    parts.append(ErrorRows(name, error, weights, tolerance, False))
            for expression in subject:
                self._check_symbols(task, expression)
        self.keeps = tuple(ranges)
        return parts, ranges

    def _close(
        self, parts: list[ErrorRows], ranges: dict[str, Constraint]
    ) -> tuple[tuple[ErrorRows, ...], dict[str, Constraint]]:
        """Add the constraints on positions that share a coordinate with the tasks, repeatedly."""
        waiting = {}
        for name, c in self.model.plain_constraints().items():
            if not any(s.order for s in c.symbols):
                if not self.model.rates.is_empty:
                    c = Constraint(*map(self.make_plain, (c.lower, c.expression, c.upper)))
                waiting[name] = c
        symbols = {name: {s for s in c.symbols if s.has_derivative} for name, c in waiting.items()}
        result = {s for part in parts for s in part.error.symbols}
        result |= {s for c in ranges.values() for s in c.symbols}
        while named := [name for name in waiting if not result.isdisjoint(symbols[name])]:
            for name in named:
                c = waiting.pop(name)
                result |= symbols[name]
                if is_equality(c):
                    error = (c.expression - c.lower).ravel()
                    parts.append(ErrorRows(name, error, as_expression(np.ones(error.size)), TOLERANCE, True))
                else:
                    ranges[name] = c
        if not parts:
            raise InvalidValueError("There is no goal and no hold, so there is nothing to reach.")
        return tuple(parts), ranges

    def _check_moved(self, still: frozenset[Symbol]) -> None:
        for part in self.parts:
            moved = {s.position for s in part.error.gradient(heuristic=False)}
            if part.name not in self.model.constraints and moved and moved <= still:
                named = ", ".join(f"'{s}'" for s in sorted(moved, key=lambda s: s.sort_key))
                what = f"'{part.name}' is moved by {named} only"
                raise InvalidValueError(f"{what}, which fixed= keeps in place.")

    def _check_symbols(self, task: Task, expression: Expression) -> None:
        """Refuse speeds, and degrees of freedom that the model does not have."""
        if any(s.order for s in expression.symbols):
            raise InvalidValueError(
                f"{task!r} is about speeds, and inverse kinematics about positions. A Controller serves it."
            )
        refuse_foreign_symbols(repr(task), expression, {s.path for s in self.model.symbols})

    def _compile(self, errors: Expression, ranges: dict[str, Constraint]) -> None:
        n = len(self.coordinates)
        gradient = errors.gradient(heuristic=False)
        speeds = [s.derivative() for s in self.coordinates]
        jacobian = stack_columns([gradient.get(s) for s in speeds], errors.shape)
        table = velocity_rows(ranges, 1.0, rates=Rates({}), speeds=speeds, recovery="allowed")
        bounds, general = table.bounds, table.general
        count = len(general.names)
        scales = self._sample(errors, jacobian, ranges)
        self.names = (*bounds.names, *((name,) for name in general.names))
        free = self.space.turning
        lower = [-INFINITE if free[i] else bounds.lower[i] for i in range(n)]
        upper = [INFINITE if free[i] else bounds.upper[i] for i in range(n)]
        away = [ZERO if free[i] else bounds.violation[i] for i in range(n)]
        away += [general.violation[k] for k in range(count)]
        lower += [general.lower[k] for k in range(count)]
        upper += [general.upper[k] for k in range(count)]
        identity = np.eye(n)
        rows = [as_expression(identity[i]) for i in range(n)] + [general.matrix[k] for k in range(count)]

        size = errors.size + len(away)
        self.weights = np.concatenate([scales, np.ones(len(away))])
        numbers = [parameter(f"inverse kinematics/weight/{k}", 1.0) for k in range(size)]
        factors = [weight for part in self.parts for weight in part.weights]
        w = [numbers[k] * factors[k] for k in range(errors.size)]
        # A row within its bounds is no error; outside of them it is.
        w += [numbers[errors.size + k] * binary(ca.OP_NE, violation, 0) for k, violation in enumerate(away)]
        weighted = jacobian * array(w[: errors.size]).reshape(errors.size, 1)
        H, f = weighted.T @ jacobian, weighted.T @ errors
        for k, violation in enumerate(away):
            if violation.symbols:
                pull = w[errors.size + k] * rows[k]
                H = H + pull.reshape(n, 1) @ rows[k].reshape(1, n)
                f = f + violation * pull
        values = array([*(errors[k] for k in range(errors.size)), *away])
        total = sum((w[k] * values[k] * values[k] for k in range(size)), ZERO)
        damping = _DAMPING * raw_min(total, as_expression(_FAR)) + _LEAST_DAMPING
        H = H + damping * np.eye(n)
        A = general.matrix if count else as_expression(np.zeros((0, n)))
        tolerances = [part.tolerance for part in self.parts for _ in range(part.error.size)]
        tolerances += [TOLERANCE] * len(away)
        sizes = [abs(values[k]) * binary(ca.OP_NE, w[k], 0) / tolerances[k] for k in range(size)]
        outputs = [H, f, A, array(lower), array(upper), values, total, reduce(raw_max, sizes, ZERO)]
        used = {s for output in outputs for s in output.symbols} - {*numbers, *self.coordinates}
        self.inputs = (*self.coordinates, *sorted(used, key=lambda s: s.sort_key))
        self.function = compile(outputs, (*self.inputs, *numbers))

    def _sample(self, errors: Expression, jacobian: Expression, ranges: Mapping[str, Constraint]) -> Array:
        """Return the weight of each error row, and flag the coordinates with the period 2π.

        The weight is the inverse mean square of the row's derivatives over random states, within one task at
        most that of a row with 5 % of the largest derivatives.
        """
        n = len(self.coordinates)
        limits = {name for name, c in ranges.items() if isinstance(c.expression, Symbol)}
        parts = [jacobian.ravel(), errors]
        parts += [c.expression.ravel() for name, c in ranges.items() if name not in limits]
        parts += [end.ravel() for c in ranges.values() for end in (c.lower, c.upper) if end.symbols]
        stacked = as_expression(np.concatenate(parts))
        others = sorted({*stacked.symbols} - {*self.coordinates}, key=lambda s: s.sort_key)
        function = compile([stacked], (*self.coordinates, *others), tier="interpreter").bind()
        home = self.model.default_state()
        function.input[n:] = home.vector(others)
        start = home.vector(self.coordinates)
        turning = self.space.find_turning_candidates(ranges)

        def evaluate(q: Array) -> Array | None:
            function.input[:n] = q
            try:
                function()
            except NoSolutionError:
                return None
            result: Array = function.outputs[0].copy()
            return result if np.isfinite(result).all() else None

        squares: list[Array] = []
        generator = np.random.default_rng(0)
        for _ in range(_SAMPLES):
            q = self.space.draw(generator, start)
            value = evaluate(q)
            if value is None:
                continue
            for i in np.flatnonzero(turning).tolist() if len(squares) < 3 else ():
                turned = q.copy()
                turned[i] += math.tau
                other = evaluate(turned)
                turning[i] = other is not None and np.allclose(other, value, rtol=_SAME, atol=_SAME)
            squares.append((value[: jacobian.size].reshape(-1, n) ** 2).sum(axis=1))
        if not squares:
            return np.ones(errors.size)
        self.space.turning = turning
        mean, first = np.mean(squares, axis=0), 0
        for part in self.parts:
            rows = slice(first, first + part.error.size)
            mean[rows] = np.maximum(mean[rows], 0.05**2 * mean[rows].max())
            first = rows.stop
        return np.asarray(1.0 / np.where(mean > 0, mean, 1.0))
