"""Gaussian state in information form."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from kineverse.errors import InvalidValueError
from kineverse.lie import Array

if TYPE_CHECKING:
    from .static_batch import StaticRecord

TangentIndices = npt.NDArray[np.int64]


def symmetric(matrix: Array) -> Array:
    """Return the symmetric part, which rounding has not moved."""
    return (matrix + matrix.T) / 2


def inverse_spd(matrix: Array) -> Array:
    """Return the inverse of a positive definite matrix, symmetric.

    Raises
    ------
    InvalidValueError
        If rounding has left nothing of it in some direction.
    """
    try:
        np.linalg.cholesky(matrix)
        return symmetric(np.asarray(np.linalg.inv(matrix), dtype=np.float64))
    except np.linalg.LinAlgError:
        raise InvalidValueError(
            "Some directions are known so much better than others that floating point cannot hold both: a "
            "covariance that was handed in is far too small, or an uncertainty far too large."
        ) from None


@dataclass(frozen=True, eq=False)
class QuadraticCost:
    """The cost ``cost - vectorᵀ ξ + ½ ξᵀ matrix ξ`` of steps ξ in a tangent.

    Attributes
    ----------
    matrix
        Λ, positive definite (t, t).
    vector
        η (t,).
    cost
        At ξ = 0.
    """

    matrix: Array
    vector: Array
    cost: float

    @staticmethod
    def of_density(matrix: Array, vector: Array) -> QuadraticCost:
        """Return the one whose least cost is 0."""
        return QuadraticCost(matrix, vector, float(vector @ inverse_spd(matrix) @ vector) / 2)

    def with_seen(self, seen: Iterable[tuple[Array, Array, float]]) -> QuadraticCost:
        """Return it with the squares of errors e - S ξ added, given as (e, S, weight)."""
        matrix, vector, cost = self.matrix.copy(), self.vector.copy(), self.cost
        for error, slope, weight in seen:
            matrix += weight * (slope.T @ slope)
            vector += weight * (slope.T @ error)
            cost += weight * float(error @ error) / 2
        return QuadraticCost(matrix, vector, cost)

    def carried(self, step: Array, turn: Array | None) -> QuadraticCost:
        """Return the same in the tangent at the end of a step, which is turned by ``turn`` on the way."""
        moved = self.matrix @ step
        cost = self.cost - float(self.vector @ step) + float(step @ moved) / 2
        vector = self.vector - moved
        if turn is None:
            return QuadraticCost(self.matrix, vector, cost)
        back = np.linalg.inv(turn)
        return QuadraticCost(symmetric(back.T @ self.matrix @ back), back.T @ vector, cost)

    @cached_property
    def least(self) -> float:
        """The least cost."""
        return self.cost - float(self.vector @ inverse_spd(self.matrix) @ self.vector) / 2

    @cached_property
    def log_determinant(self) -> float:
        """Of the matrix."""
        return float(np.linalg.slogdet(self.matrix)[1])


class InformationState:
    """A point and a Gaussian about it, as it would be without limits.

    With ξ in the tangent at ``x``, the density is exp(-½ξᵀΛξ + ηᵀξ) up to a factor. Its mean Λ⁻¹η need not be
    0, as the point stays inside the limits and the Gaussian does not.

    Parameters
    ----------
    sizes
        How many coordinates, directions and groups there are.
    numbers
        All of it, one after the other; zeros if None.
    standing
        Of each group; None for all if not given.

    Attributes
    ----------
    x
        The coordinates (n,).
    vector, information
        η (t,), and Λ (t, t), zero between groups.
    evidence
        For each group, the logarithm of the density of all it has seen.
    standing
        For each group what was seen since it last moved, where that is kept, see :mod:`.standing`.
    """

    __slots__ = ("evidence", "information", "numbers", "sizes", "standing", "vector", "x")

    def __init__(
        self,
        sizes: tuple[int, int, int],
        numbers: Array | None = None,
        standing: Sequence[StaticRecord | None] | None = None,
    ) -> None:
        n, t, groups = sizes
        self.sizes = sizes
        self.standing: list[StaticRecord | None] = [None] * groups if standing is None else list(standing)
        self.numbers = np.zeros(n + t + groups + t * t) if numbers is None else numbers
        self.x = self.numbers[:n]
        self.vector = self.numbers[n : n + t]
        self.evidence = self.numbers[n + t : n + t + groups]
        self.information = self.numbers[n + t + groups :].reshape(t, t)

    def copy(self) -> InformationState:
        """Return one of its own."""
        return InformationState(self.sizes, self.numbers.copy(), self.standing)

    def part(self, t: TangentIndices) -> QuadraticCost:
        """Return what is believed of a group, with its places in the tangent."""
        return QuadraticCost.of_density(self.information[np.ix_(t, t)], self.vector[t])

    def put(self, t: TangentIndices, quadratic: QuadraticCost) -> None:
        """Believe something else of a group."""
        self.information[np.ix_(t, t)] = quadratic.matrix
        self.vector[t] = quadratic.vector
