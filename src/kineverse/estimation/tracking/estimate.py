"""Estimated state, its covariance and confidence."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from types import MappingProxyType

import numpy as np

from kineverse.estimation.linear_algebra import inverse_spd
from kineverse.lie import Array
from kineverse.state import State
from kineverse.symbols import Symbol

from .gaussian_sum import GaussianSum
from .step import StepResult, UpdateStep


class Estimate:
    """MAP estimate of the state inside the limits, with its uncertainty.

    Parameters
    ----------
    result, mixture, update_step, inputs, stamp
        Result of the last update, and components of the tracker.

    Attributes
    ----------
    nis, dof
        Normalised innovation squared of the last update, and its degrees of freedom. It is χ² distributed if
        the noise is as the covariances say.
    rounds
        Number of model evaluations; at 50 the iteration stopped without convergence.
    stamp
        Time [s]; None if the tracker was given none.
    """

    def __init__(
        self,
        result: StepResult,
        mixture: GaussianSum,
        update_step: UpdateStep,
        inputs: Array,
        stamp: float | None,
    ) -> None:
        self._mixture, self._belief = mixture, mixture.best
        self._result, self._update_step, self._layout, self._inputs = (
            result,
            update_step,
            update_step.layout,
            inputs,
        )
        self.nis, self.dof, self.rounds, self.stamp = result.nis, result.dof, result.rounds, stamp

    @cached_property
    def state(self) -> State:
        """Most probable state inside the limits."""
        values = dict(zip(self._layout.tangent_space.coordinates, self._belief.x.tolist(), strict=True))
        return State(values, stamp=self.stamp, source="tracker")

    @property
    def outliers(self) -> tuple[str, ...]:
        """Names of the measurements classified as outliers in the last update."""
        return tuple(self._layout.observations[i].name for i in self._result.outliers)

    @property
    def tangent(self) -> tuple[Symbol, ...]:
        """Directions of the rows and columns of the covariance, as speeds."""
        return self._layout.tangent_space.tangent

    @cached_property
    def information(self) -> Array:
        """Inverse of the covariance."""
        result = self._belief.information.copy()
        for number, group in enumerate(self._layout.groups):
            if self._belief.records[number] is not None:
                block = np.ix_(group.t, group.t)
                result[block] = inverse_spd(self.covariance[block])
        return result

    @cached_property
    def covariance(self) -> Array:
        """Covariance of the Gaussian, not truncated at limits, in the tangent space (t, t) [m²], [rad²]."""
        result = np.zeros_like(self._belief.information)
        for number, group in enumerate(self._layout.groups):
            result[np.ix_(group.t, group.t)] = self._update_step.ridge_covariance.compute(
                number, self._belief
            )
        return result

    @cached_property
    def mean(self) -> Array:
        """Mean of the Gaussian, not truncated at limits, as a tangent step from the state (t,)."""
        result = np.zeros_like(self._belief.vector)
        for group in self._layout.groups:
            information = self._belief.information[np.ix_(group.t, group.t)]
            result[group.t] = inverse_spd(information) @ self._belief.vector[group.t]
        return result

    @cached_property
    def deviation(self) -> Mapping[Symbol | str, float]:
        """Standard deviation of each coordinate, by symbol and by name [m], [rad].

        It belongs to the Gaussian that is not truncated at limits. At a limit the state varies by less.
        """
        result: dict[Symbol | str, float] = {}
        for number, group in enumerate(self._layout.groups):
            basis = self._update_step.process_model.basis(number, self._belief.x[group.x], self._inputs)
            block = self.covariance[np.ix_(group.t, group.t)]
            variances = np.einsum("ij,jk,ik->i", basis, block, basis)
            for x, variance in zip(group.coordinates, variances.tolist(), strict=True):
                result[x] = result[str(x)] = float(np.sqrt(variance))
        return MappingProxyType(result)

    @cached_property
    def confidence(self) -> Mapping[tuple[Symbol, ...], float]:
        """Probability of each group's best component among the components of the Gaussian sum."""
        result = {}
        for number, group in enumerate(self._layout.groups):
            evidence = self._mixture.evidence(number)
            result[group.coordinates] = float(np.exp(evidence[0] - np.logaddexp.reduce(evidence)))
        return MappingProxyType(result)

    @cached_property
    def log_evidence(self) -> float:
        """Log density of all measurements so far."""
        return self._mixture.log_evidence
