"""Iterated Gauss-Newton MAP update within bounds.

The update minimises ½ξᵀΛξ - ηᵀξ + ½ Σ |W r|² over the state. Every group takes its own steps, but the model
is evaluated once for all of them. A step that increases the cost is rejected and damped (Levenberg,
Marquardt). With outliers, residuals are reweighted at each iterate, and the cost is the negative log density
of the outlier mixture.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from kineverse.errors import InvalidValueError, ModelError
from kineverse.estimation.linear_algebra import inverse_spd
from kineverse.estimation.noise import Outliers, cauchy_weight
from kineverse.lie import Array

from .bounds import BoundRows, GroupBounds, StateBounds, solve_bounded_qp
from .information_state import InformationState, QuadraticCost
from .process_model import ProcessModel
from .residuals import Measurements, Residuals
from .state_space import Layout

# Iteration ends at steps below this many standard deviations.
_CONVERGED = 1e-5
_MOST_ROUNDS = 50
_MOST_DAMPING = 1e9
_OUTSIDE = 1e-9

Loss: TypeAlias = Outliers | Literal["gaussian", "cauchy"]
"""Loss of a residual: least squares, Cauchy, or the mixture with outliers."""


@dataclass(slots=True, eq=False)
class MapResult:
    """Result of a MAP update."""

    belief: InformationState
    nis: Array  # normalised innovation squared of each group
    dof: Array  # its degrees of freedom
    rounds: int  # number of model evaluations
    weights: Array | None = None  # weight of each observation; None if all are 1
    squares: Array | None = None  # squared norms of the whitened residuals; None if not stored
    priors: Mapping[int, QuadraticCost] | None = None


@dataclass(slots=True, eq=False)
class _GroupIterate:
    """State of the iteration of one group."""

    x: Array  # coordinates of the best iterate so far
    prior: QuadraticCost  # there, without measurements
    posterior: QuadraticCost  # with measurements
    trial: Array  # next iterate to evaluate
    trial_prior: QuadraticCost
    constrained_minimum: float = 0.0  # least cost of the prior inside the limits
    cost: float = np.inf
    excess: float = 0.0  # cost beyond that of the posterior, whose squares are weighted
    rows: BoundRows | None = None  # bounds on steps at the best iterate; None before the first
    damping: float = 0.0
    settled: QuadraticCost | None = None


class MapSolver:
    """MAP solver of one tracker."""

    def __init__(
        self, layout: Layout, residuals: Residuals, process_model: ProcessModel, limits: StateBounds
    ) -> None:
        self._layout, self._residuals, self._process_model = layout, residuals, process_model
        self.group_bounds = [GroupBounds(number, layout, limits) for number in range(len(layout.groups))]

    def constrain(self, belief: InformationState, empty: Measurements, inputs: Array) -> InformationState:
        """Return the same belief about the most probable point inside the limits."""
        return self.update(belief, empty, inputs, range(len(self._layout.groups))).belief

    def find_robust_start(
        self, belief: InformationState, reading: Measurements, inputs: Array, groups: Sequence[int]
    ) -> InformationState:
        """Return the same belief about the point of least Cauchy loss, which outliers hardly affect."""
        iterates, *_ = self._run(belief, reading, inputs, groups, "cauchy")
        moved = belief.copy()
        for number, iterate in iterates.items():
            group = self._layout.groups[number]
            moved.x[group.x] = iterate.x
            moved.set_group_cost(group.t, iterate.prior)
        return moved

    def _run(
        self,
        belief: InformationState,
        reading: Measurements,
        inputs: Array,
        groups: Sequence[int],
        loss: Loss,
    ) -> tuple[dict[int, _GroupIterate], Array, int]:
        """Iterate until all groups converge; return iterates, weights and the number of evaluations."""
        iterates = {}
        for number in groups:
            group = self._layout.groups[number]
            prior, start = belief.group_cost(group.t), belief.x[group.x]
            iterates[number] = _GroupIterate(start, prior, prior, start, prior)
        weights = np.ones(len(self._layout.observations))
        x, rounds = belief.x.copy(), 0
        while rounds < _MOST_ROUNDS and any(iterate.settled is None for iterate in iterates.values()):
            for number, iterate in iterates.items():
                x[self._layout.groups[number].x] = iterate.trial
            out = self._residuals.evaluate(x, inputs)
            rounds += 1
            for number, iterate in iterates.items():
                if iterate.settled is None:
                    self._evaluate_trial(number, iterate, out, reading, loss, weights)
                    self._propose_trial(number, iterate, inputs)
        return iterates, weights, rounds

    def _evaluate_trial(
        self,
        number: int,
        iterate: _GroupIterate,
        out: Array,
        reading: Measurements,
        loss: Loss,
        weights: Array,
    ) -> None:
        """Accept the trial as the best iterate if it is better; otherwise increase the damping."""
        group = self._layout.groups[number]
        # A trial with an infinite Jacobian is rejected.
        with np.errstate(invalid="ignore", over="ignore"):
            measured = self._residuals.errors(out, reading, group.observation_indices)
            squares = {i: float(e @ e) for i, (e, _) in measured.items()}
        weighed = {i: self._robust_cost(i, square, reading, loss) for i, square in squares.items()}
        cost = iterate.trial_prior.cost + sum(each for _, each in weighed.values())
        is_finite = np.isfinite(cost) and all(np.isfinite(s).all() for _, s in measured.values())
        if not is_finite and iterate.rows is None:
            self._residuals.check(out, group.observation_indices)
            names = ", ".join(map(str, group.coordinates))
            raise InvalidValueError(
                f"A measurement of {names} is too far away, or its covariance too small, for floating point."
            )
        rows = self.group_bounds[number].rows(iterate.trial, out)
        if not is_finite or not _is_better(iterate, cost, rows):
            iterate.damping = max(10 * iterate.damping, 1e-3)
            return
        if iterate.rows is None:
            # 0 if the limits contradict each other.
            step = solve_bounded_qp(inverse_spd(iterate.prior.matrix), -iterate.prior.vector, *rows)
            iterate.constrained_minimum = 0.0 if step is None else iterate.prior.transported(step, None).cost
        iterate.x, iterate.prior, iterate.cost, iterate.rows = iterate.trial, iterate.trial_prior, cost, rows
        weights[list(weighed)] = [weight for weight, _ in weighed.values()]
        iterate.posterior = iterate.prior.with_measurements(
            (e, s, weighed[i][0]) for i, (e, s) in measured.items()
        )
        iterate.excess = cost - iterate.posterior.cost
        iterate.damping = iterate.damping / 10 if iterate.damping > 1e-6 else 0.0

    def _robust_cost(self, i: int, square: float, reading: Measurements, loss: Loss) -> tuple[float, float]:
        if loss == "gaussian" or not np.isfinite(square):
            return 1.0, square / 2
        if loss == "cauchy":
            size = self._layout.observations[i].size
            return cauchy_weight(square, size), (1 + size) / 2 * float(np.log1p(square))
        scale = float(reading.log_scale[i])
        return loss.weigh(square, scale, loss.log_density(self._layout.observations[i], scale))

    def _propose_trial(self, number: int, iterate: _GroupIterate, inputs: Array) -> None:
        """Solve for the next trial, or mark the group as converged."""
        assert iterate.rows is not None
        matrix = iterate.posterior.matrix
        if iterate.damping:
            matrix = matrix + iterate.damping * np.diag(np.diag(matrix))
        step = solve_bounded_qp(inverse_spd(matrix), -iterate.posterior.vector, *iterate.rows)
        if step is None:
            names = ", ".join(map(str, self._layout.groups[number].coordinates))
            raise ModelError(f"The limits of {names} leave no state between them.")
        turned = float(np.abs(step[self._layout.groups[number].rate_directions]).max(initial=0.0))
        if turned > np.pi:
            step = step * (np.pi / turned)  # linearisation is useless beyond half a turn
        x, transport = self._process_model.retract(number, iterate.x, step, inputs)
        x = self.group_bounds[number].clip(x)
        if float(step @ matrix @ step) <= _CONVERGED**2 or iterate.damping > _MOST_DAMPING:
            iterate.x, iterate.settled = x, iterate.posterior.transported(step, transport)
            iterate.prior = iterate.prior.transported(step, transport)
        else:
            iterate.trial, iterate.trial_prior = x, iterate.prior.transported(step, transport)

    def update(
        self,
        belief: InformationState,
        reading: Measurements,
        inputs: Array,
        groups: Sequence[int],
        loss: Loss = "gaussian",
    ) -> MapResult:
        """Return the posterior after a reading; arguments are not changed."""
        iterates, weights, rounds = self._run(belief, reading, inputs, groups, loss)
        after = belief.copy()
        count = len(self._layout.groups)
        nis, dof = np.zeros(count), np.zeros(count)
        for number, iterate in iterates.items():
            group = self._layout.groups[number]
            measured = [i for i in group.observation_indices if reading.mask[i]]
            after.x[group.x] = iterate.x
            posterior = iterate.settled or iterate.posterior
            after.set_group_cost(group.t, posterior)
            # Least cost without limits. In the linear case this is the innovation squared in S⁻¹.
            nis[number] = max(2 * posterior.minimum, 0.0)
            dof[number] = sum(self._layout.observations[i].size for i in measured if weights[i] >= 0.5)
            gained = (iterate.prior.log_determinant - posterior.log_determinant) / 2
            gained -= posterior.cost - iterate.constrained_minimum + iterate.excess
            after.evidence[number] += gained - float(reading.log_scale[measured].sum())
        priors = {number: iterate.prior for number, iterate in iterates.items()}
        return MapResult(after, nis, dof, rounds, None if loss == "gaussian" else weights, priors=priors)


def _is_better(iterate: _GroupIterate, cost: float, rows: BoundRows) -> bool:
    if iterate.rows is not None and iterate.rows.violation > _OUTSIDE:
        if rows.violation < iterate.rows.violation / 2:
            return True
    return cost <= iterate.cost + 1e-10 * (1 + abs(iterate.cost))
