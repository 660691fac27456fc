"""Estimated state, its covariance and confidence."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from types import MappingProxyType

import numpy as np

from kineverse.lie import Array
from kineverse.state import State
from kineverse.symbols import Symbol

from .gaussian import inverse_spd
from .gaussian_sum import GaussianSum
from .step import StepResult, UpdateStep


class Estimate:
    """The most probable state inside the limits, and how far it may be off.

    Parameters
    ----------
    outcome, filter_, known, stamp
        What it is read off.

    Attributes
    ----------
    nis, dof
        The normalised innovation squared of the last update and the number of its parts: χ² distributed, if
        noise is what the covariances say.
    rounds
        How many times the model was evaluated; at 50 it was left where it was, although it had not settled.
    stamp
        [s]; None if the tracker has not heard of time.
    """

    def __init__(
        self, outcome: StepResult, modes: GaussianSum, filter_: UpdateStep, known: Array, stamp: float | None
    ) -> None:
        self._modes, self._belief = modes, modes.best
        self._outcome, self._filter, self._layout, self._known = outcome, filter_, filter_.layout, known
        self.nis, self.dof, self.rounds, self.stamp = outcome.nis, outcome.dof, outcome.rounds, stamp

    @cached_property
    def state(self) -> State:
        """The most probable state inside the limits."""
        values = dict(zip(self._layout.chart.coordinates, self._belief.x.tolist(), strict=True))
        return State(values, stamp=self.stamp, source="tracker")

    @property
    def outliers(self) -> tuple[str, ...]:
        """The names of the observations that were not believed."""
        return tuple(self._layout.observations[i].name for i in self._outcome.outliers)

    @property
    def tangent(self) -> tuple[Symbol, ...]:
        """The rows and columns of the covariance: the directions in which the state may be off, as speeds."""
        return self._layout.chart.tangent

    @cached_property
    def information(self) -> Array:
        """The inverse of the covariance."""
        found = self._belief.information.copy()
        for number, group in enumerate(self._layout.groups):
            if self._belief.standing[number] is not None:
                block = np.ix_(group.t, group.t)
                found[block] = inverse_spd(self.covariance[block])
        return found

    @cached_property
    def covariance(self) -> Array:
        """The covariance of the Gaussian without limits, in the tangent (t, t) [m²], [rad²]."""
        found = np.zeros_like(self._belief.information)
        for number, group in enumerate(self._layout.groups):
            found[np.ix_(group.t, group.t)] = self._filter.ridge.covariance(number, self._belief)
        return found

    @cached_property
    def mean(self) -> Array:
        """The mean of the Gaussian without limits, as a step from the state in the tangent (t,)."""
        found = np.zeros_like(self._belief.vector)
        for group in self._layout.groups:
            information = self._belief.information[np.ix_(group.t, group.t)]
            found[group.t] = inverse_spd(information) @ self._belief.vector[group.t]
        return found

    @cached_property
    def deviation(self) -> Mapping[Symbol | str, float]:
        """The standard deviation of each coordinate, by symbol and by name [m], [rad].

        That of the Gaussian without limits; at a limit the state varies by less, as it stays inside.
        """
        found: dict[Symbol | str, float] = {}
        for number, group in enumerate(self._layout.groups):
            basis = self._filter.charted.basis(number, self._belief.x[group.x], self._known)
            block = self.covariance[np.ix_(group.t, group.t)]
            variances = np.einsum("ij,jk,ik->i", basis, block, basis)
            for x, variance in zip(group.coordinates, variances.tolist(), strict=True):
                found[x] = found[str(x)] = float(np.sqrt(variance))
        return MappingProxyType(found)

    @cached_property
    def confidence(self) -> Mapping[tuple[Symbol, ...], float]:
        """The probability of each group's explanation, of those that are still considered."""
        found = {}
        for number, group in enumerate(self._layout.groups):
            evidence = self._modes.evidence(number)
            found[group.coordinates] = float(np.exp(evidence[0] - np.logaddexp.reduce(evidence)))
        return MappingProxyType(found)

    @cached_property
    def log_evidence(self) -> float:
        """The log density of all that was seen."""
        return self._modes.log_evidence
