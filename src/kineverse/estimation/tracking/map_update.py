"""Iterated Gauss-Newton MAP update within bounds.

The update of a group minimises ½ξᵀΛξ - ηᵀξ + ½ Σ |W r|² over its state. A step that increases the cost is
rejected and damped (Levenberg, Marquardt). With outliers, residuals are reweighted at each iterate, and the
cost is the negative log density of the outlier mixture.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np

from kineverse.errors import InvalidValueError, ModelError
from kineverse.estimation.noise import Outliers, cauchy_weight
from kineverse.lie import Array

from .bounds import BoundRows, GroupBounds, StateBounds, solve_bounded_qp
from .process_model import ProcessModel
from .residuals import Measurements, Residuals
from .state_space import InformationState, Layout, QuadraticCost

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
    posterior: QuadraticCost  # with the weighted squares of the residuals
    excess: float  # cost of the residuals beyond; infinite where the model or its Jacobian is not finite
    rows: BoundRows  # bounds on steps
    residuals: Mapping[int, tuple[float, float]]  # square and weight of each measured residual

    def is_better_than(self, other: _Iterate) -> bool:
        if other.rows.violation > _OUTSIDE and self.rows.violation < other.rows.violation / 2:
            return math.isfinite(self.excess)
        cost = other.posterior.cost + other.excess
        return self.posterior.cost + self.excess <= cost + 1e-10 * (1 + abs(cost))


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
            last, least, rounds = self._iterate(number, belief, reading, inputs, loss)
            after.x[group.x] = prior.x[group.x] = last.x
            after.set_group_cost(group.t, last.posterior)
            prior.set_group_cost(group.t, last.prior)
            # Least cost without limits. In the linear case this is the innovation squared in S⁻¹.
            nis[number] = max(2 * last.posterior.minimum, 0.0)
            gained = (last.prior.log_determinant - last.posterior.log_determinant) / 2
            after.evidence[number] += gained - (last.posterior.cost + last.excess - least)
            for i, (square, weight) in last.residuals.items():
                squares[i], weights[i] = square, weight
                dof[number] += layout.observations[i].size * (weight >= 0.5)
                after.evidence[number] -= reading.log_scale[i]
            most = max(most, rounds)
        return MapResult(after, prior.numbers, nis, dof, most, squares, weights)

    def _iterate(
        self, number: int, belief: InformationState, reading: Measurements, inputs: Array, loss: Loss
    ) -> tuple[_Iterate, float, int]:
        """Return the last iterate, the least cost of the prior inside the limits, and the evaluations."""
        group, bounds, place = self.layout.groups[number], self.group_bounds[number], belief.x.copy()
        names = ", ".join(map(str, group.coordinates))

        def linearise(x: Array, prior: QuadraticCost) -> _Iterate:
            place[group.x] = x
            out = self._residuals.evaluate(place, inputs)
            with np.errstate(invalid="ignore", over="ignore"):
                measured = self._residuals.errors(out, reading, group.observation_indices)
                squares = {i: float(e @ e) for i, (e, _) in measured.items()}
            weighed = {i: self._weigh(i, square, reading, loss) for i, square in squares.items()}
            residuals = {i: (square, weighed[i][0]) for i, square in squares.items()}
            rows, cost = bounds.rows(x, out), prior.cost + sum(each for _, each in weighed.values())
            if not (math.isfinite(cost) and all(np.isfinite(s).all() for _, s in measured.values())):
                return _Iterate(x, prior, prior, math.inf, rows, residuals)
            posterior = prior.with_measurements((e, s, weighed[i][0]) for i, (e, s) in measured.items())
            return _Iterate(x, prior, posterior, cost - posterior.cost, rows, residuals)

        best = linearise(belief.x[group.x], belief.group_cost(group.t))
        if not math.isfinite(best.excess):
            self._residuals.check(self._residuals.evaluate(belief.x, inputs), group.observation_indices)
            raise InvalidValueError(
                f"A measurement of {names} is too far away, or its covariance too small, for floating point."
            )
        # 0 if the limits contradict each other.
        inside = solve_bounded_qp(best.prior.matrix, best.prior.vector, *best.rows)
        least = 0.0 if inside is None else best.prior.transported(inside, None).cost
        damping = 0.0
        for rounds in range(1, _MOST_ROUNDS + 1):
            matrix = best.posterior.matrix + damping * np.diag(np.diag(best.posterior.matrix))
            step = solve_bounded_qp(matrix, best.posterior.vector, *best.rows)
            if step is None:
                raise ModelError(f"The limits of {names} leave no state between them.")
            turned = float(np.abs(step[group.rate_directions]).max(initial=0.0))
            if turned > np.pi:
                step = step * (np.pi / turned)  # linearisation is useless beyond half a turn
            x, transport = self.process_model.retract(number, best.x, step, inputs)
            x, prior = bounds.clip(x), best.prior.transported(step, transport)
            if float(step @ matrix @ step) <= _CONVERGED**2 or damping > _MOST_DAMPING:
                posterior = best.posterior.transported(step, transport)
                return replace(best, x=x, prior=prior, posterior=posterior), least, rounds
            if rounds < _MOST_ROUNDS:
                trial = linearise(x, prior)
                if trial.is_better_than(best):
                    best, damping = trial, damping / 10 if damping > 1e-6 else 0.0
                else:
                    damping = max(10 * damping, 1e-3)
        return best, least, _MOST_ROUNDS

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
