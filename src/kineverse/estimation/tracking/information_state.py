"""Gaussian state in information form."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from kineverse.estimation.linear_algebra import inverse_spd, symmetric
from kineverse.lie import Array

if TYPE_CHECKING:
    from .observability import StaticRecord
    from .speed_process import ConditionalSpeeds

TangentIndices = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class QuadraticCost:
    """Quadratic cost ``cost - vectorᵀ ξ + ½ ξᵀ matrix ξ`` of steps ξ in a tangent space."""

    matrix: Array  # Λ, positive definite (t, t)
    vector: Array  # η (t,)
    cost: float  # value at ξ = 0

    @staticmethod
    def from_density(matrix: Array, vector: Array) -> QuadraticCost:
        """Make the cost with matrix Λ and vector η whose minimum is 0."""
        return QuadraticCost(matrix, vector, float(vector @ inverse_spd(matrix) @ vector) / 2)

    def with_measurements(self, measurements: Iterable[tuple[Array, Array, float]]) -> QuadraticCost:
        """Add the weighted squares of errors e - S ξ, given as (e, S, weight)."""
        matrix, vector, cost = self.matrix.copy(), self.vector.copy(), self.cost
        for error, slope, weight in measurements:
            matrix += weight * (slope.T @ slope)
            vector += weight * (slope.T @ error)
            cost += weight * float(error @ error) / 2
        return QuadraticCost(matrix, vector, cost)

    def transported(self, step: Array, transport: Array | None) -> QuadraticCost:
        """Return the cost in the tangent space at the end of a step, with the given transport Jacobian."""
        moved = self.matrix @ step
        cost = self.cost - float(self.vector @ step) + float(step @ moved) / 2
        vector = self.vector - moved
        if transport is None:
            return QuadraticCost(self.matrix, vector, cost)
        back = np.linalg.inv(transport)
        return QuadraticCost(symmetric(back.T @ self.matrix @ back), back.T @ vector, cost)

    @cached_property
    def minimum(self) -> float:
        """Minimum of the cost."""
        return self.cost - float(self.vector @ inverse_spd(self.matrix) @ self.vector) / 2

    @cached_property
    def log_determinant(self) -> float:
        """Value of log |Λ|."""
        return float(np.linalg.slogdet(self.matrix)[1])


class InformationState:
    """Estimate and a Gaussian about it in information form, not truncated at limits.

    With ξ in the tangent space at ``x``, the density is exp(-½ξᵀΛξ + ηᵀξ) up to a factor. The estimate stays
    inside the limits and the Gaussian does not, so its mean Λ⁻¹η need not be 0.
    """

    __slots__ = ("evidence", "information", "numbers", "records", "sizes", "speeds", "vector", "x")

    def __init__(
        self,
        sizes: tuple[int, int, int],
        numbers: Array | None = None,
        records: Sequence[StaticRecord | None] | None = None,
        speeds: Sequence[ConditionalSpeeds | None] | None = None,
    ) -> None:
        n, t, groups = sizes
        self.sizes = sizes
        self.records: list[StaticRecord | None] = [None] * groups if records is None else list(records)
        self.speeds: list[ConditionalSpeeds | None] = [None] * groups if speeds is None else list(speeds)
        self.numbers = np.zeros(n + t + groups + t * t) if numbers is None else numbers
        self.x = self.numbers[:n]
        self.vector = self.numbers[n : n + t]
        self.evidence = self.numbers[n + t : n + t + groups]
        self.information = self.numbers[n + t + groups :].reshape(t, t)

    def copy(self) -> InformationState:
        """Return a copy with its own arrays."""
        return self.with_numbers(self.numbers.copy())

    def with_numbers(self, numbers: Array) -> InformationState:
        """Return the same records and speeds with other numbers."""
        return InformationState(self.sizes, numbers, self.records, self.speeds)

    def group_cost(self, t: TangentIndices) -> QuadraticCost:
        """Return the quadratic cost of a group with tangent indices t."""
        return QuadraticCost.from_density(self.information[np.ix_(t, t)], self.vector[t])

    def set_group_cost(self, t: TangentIndices, quadratic: QuadraticCost) -> None:
        """Replace the quadratic cost of a group with tangent indices t."""
        self.information[np.ix_(t, t)] = quadratic.matrix
        self.vector[t] = quadratic.vector
