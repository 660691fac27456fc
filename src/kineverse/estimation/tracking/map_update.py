"""Iterated Gauss-Newton MAP update within bounds.

The update of a group minimises ½ξᵀΛξ - ηᵀξ + ½ Σ |W r|² over its state. A step that increases the cost is
rejected and damped (Levenberg, Marquardt). With outliers, residuals are reweighted at each iterate, and the
cost is the negative log density of the outlier mixture.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
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

Loss: TypeAlias = Literal["gaussian", "cauchy", "mixture"]
"""Loss of a residual: least squares, Cauchy, or the mixture with outliers."""


@dataclass(slots=True, eq=False)
class MapResult:
    """Result of a MAP update."""

    belief: InformationState
    prior_numbers: Array  # numbers of the belief before, about the same state
    nis: Array  # normalised innovation squared of each group
    dof: Array  # its degrees of freedom
    rounds: int  # number of model evaluations
    squares: Array  # squared norms of the whitened residuals; 0 if not measured
    weights: Array  # weight of each observation

    @property
    def prior(self) -> InformationState:
        """Belief before the update, about the state after it."""
        return self.belief.with_numbers(self.prior_numbers)


@dataclass(frozen=True, slots=True, eq=False)
class _Iterate:
    """Linearisation of a group at a point."""

    x: Array
    prior: QuadraticCost
    posterior: QuadraticCost
    cost: float  # of all residuals, whose squares are weighted in the posterior
    rows: BoundRows  # bounds on steps
    squares: Array  # of its measured residuals, and their weights
    weights: Array

    def is_better_than(self, other: _Iterate) -> bool:
        if not math.isfinite(self.cost):
            return False
        if other.rows.violation > _OUTSIDE and self.rows.violation < other.rows.violation / 2:
            return True
        return self.cost <= other.cost + 1e-10 * (1 + abs(other.cost))


class MapSolver:
    """MAP solver of one tracker."""

    def __init__(
        self,
        layout: Layout,
        residuals: Residuals,
        process_model: ProcessModel,
        limits: StateBounds,
        outliers: Outliers | None = None,
    ) -> None:
        self.layout, self.limits, self.process_model, self.outliers = layout, limits, process_model, outliers
        self._residuals = residuals
        self.group_bounds = [GroupBounds(number, layout, limits) for number in range(len(layout.groups))]
        if outliers is not None:
            self._log_outlier = np.array([outliers.log_density(one, 0.0) for one in layout.observations])

    def outlier_densities(self, reading: Measurements) -> Array:
        """Return the log densities of outliers, relative to the peak density of the noise (m,)."""
        assert self.outliers is not None
        return self._log_outlier + (reading.log_scale if self.outliers.gate is None else 0.0)

    def update(
        self,
        belief: InformationState,
        reading: Measurements,
        inputs: Array,
        groups: Sequence[int],
        loss: Loss = "gaussian",
    ) -> MapResult:
        """Return the posterior of some groups after a reading; arguments are not changed."""
        layout, after, prior = self.layout, belief.copy(), belief.copy()
        nis, dof = np.zeros((2, len(layout.groups)))
        squares, weights = np.zeros(len(layout.observations)), np.ones(len(layout.observations))
        most = 0
        for number in groups:
            group = layout.groups[number]
            measured = [i for i in group.observation_indices if reading.mask[i]]
            least, last, x, step, transport, rounds = self._iterate(number, belief, reading, inputs, loss)
            posterior = last.posterior.transported(step, transport)
            before = last.prior.transported(step, transport)
            after.x[group.x] = prior.x[group.x] = x
            after.set_group_cost(group.t, posterior)
            prior.set_group_cost(group.t, before)
            squares[measured], weights[measured] = last.squares, last.weights
            # Least cost without limits. In the linear case this is the innovation squared in S⁻¹.
            nis[number] = max(2 * posterior.minimum, 0.0)
            dof[number] = sum(layout.observations[i].size for i in measured if weights[i] >= 0.5)
            gained = (before.log_determinant - posterior.log_determinant) / 2
            gained -= posterior.cost + last.cost - last.posterior.cost - least
            after.evidence[number] += gained - float(reading.log_scale[measured].sum())
            most = max(most, rounds)
        return MapResult(after, prior.numbers, nis, dof, most, squares, weights)

    def _iterate(
        self, number: int, belief: InformationState, reading: Measurements, inputs: Array, loss: Loss
    ) -> tuple[float, _Iterate, Array, Array, Array | None, int]:
        """Return the least cost of the prior inside the limits, and the end of the iteration.

        That is the best iterate, the state after a last step from it, this step and its transport, and the
        number of evaluations.
        """
        group, bounds = self.layout.groups[number], self.group_bounds[number]
        names = ", ".join(map(str, group.coordinates))
        best = self._linearise(
            number, belief, belief.x[group.x], belief.group_cost(group.t), reading, inputs, loss
        )
        if not math.isfinite(best.cost):
            self._residuals.check(self._residuals.evaluate(belief.x, inputs), group.observation_indices)
            raise InvalidValueError(
                f"A measurement of {names} is too far away, or its covariance too small, for floating point."
            )
        # 0 if the limits contradict each other.
        inside = solve_bounded_qp(inverse_spd(best.prior.matrix), -best.prior.vector, *best.rows)
        least = 0.0 if inside is None else best.prior.transported(inside, None).cost
        damping = 0.0
        for rounds in range(1, _MOST_ROUNDS + 1):
            matrix = best.posterior.matrix
            if damping:
                matrix = matrix + damping * np.diag(np.diag(matrix))
            step = solve_bounded_qp(inverse_spd(matrix), -best.posterior.vector, *best.rows)
            if step is None:
                raise ModelError(f"The limits of {names} leave no state between them.")
            turned = float(np.abs(step[group.rate_directions]).max(initial=0.0))
            if turned > np.pi:
                step = step * (np.pi / turned)  # linearisation is useless beyond half a turn
            x, transport = self.process_model.retract(number, best.x, step, inputs)
            x = bounds.clip(x)
            if float(step @ matrix @ step) <= _CONVERGED**2 or damping > _MOST_DAMPING:
                return least, best, x, step, transport, rounds
            if rounds < _MOST_ROUNDS:
                prior = best.prior.transported(step, transport)
                trial = self._linearise(number, belief, x, prior, reading, inputs, loss)
                if trial.is_better_than(best):
                    best, damping = trial, damping / 10 if damping > 1e-6 else 0.0
                else:
                    damping = max(10 * damping, 1e-3)
        return least, best, best.x, np.zeros(len(group.t)), None, _MOST_ROUNDS

    def _linearise(
        self,
        number: int,
        belief: InformationState,
        x: Array,
        prior: QuadraticCost,
        reading: Measurements,
        inputs: Array,
        loss: Loss,
    ) -> _Iterate:
        """Linearise at a point; the cost is infinite where the model or its Jacobian is not finite."""
        group, there = self.layout.groups[number], belief.x.copy()
        there[group.x] = x
        out = self._residuals.evaluate(there, inputs)
        with np.errstate(invalid="ignore", over="ignore"):
            measured = self._residuals.errors(out, reading, group.observation_indices)
            squares = np.array([float(e @ e) for e, _ in measured.values()])
        weighed = [self._weigh(i, s, reading, loss) for i, s in zip(measured, squares.tolist(), strict=True)]
        weights, cost = [weight for weight, _ in weighed], prior.cost + sum(cost for _, cost in weighed)
        if not (math.isfinite(cost) and all(np.isfinite(s).all() for _, s in measured.values())):
            cost, posterior = math.inf, prior
        else:
            triples = ((e, s, w) for (e, s), w in zip(measured.values(), weights, strict=True))
            posterior = prior.with_measurements(triples)
        rows = self.group_bounds[number].rows(x, out)
        return _Iterate(x, prior, posterior, cost, rows, squares, np.array(weights))

    def _weigh(self, i: int, square: float, reading: Measurements, loss: Loss) -> tuple[float, float]:
        """Return the weight of a residual and its cost."""
        observation = self.layout.observations[i]
        if loss == "gaussian" or not math.isfinite(square):
            return 1.0, square / 2
        if loss == "cauchy":
            size = observation.size
            return cauchy_weight(square, size), (1 + size) / 2 * float(np.log1p(square))
        assert self.outliers is not None
        scale = float(reading.log_scale[i])
        return self.outliers.weigh(square, scale, self.outliers.log_density(observation, scale))
