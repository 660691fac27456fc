"""Gaussian-sum components, their pruning and merging.

Each group has its own components. They are kept until the evidence of one exceeds that of the others by far
(Alspach and Sorenson, Nonlinear Bayesian estimation using Gaussian sum approximations, 1972).

Mirror images predict the same measurements from different states and stay apart. Points along an unobservable
ridge also predict the same; the ridge covariance covers them, so they are merged.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from kineverse.estimation.linear_algebra import inverse_spd
from kineverse.lie import Array
from kineverse.symbols import Symbol

from .covariance import RidgeCovariance
from .information_state import InformationState
from .observability import Components
from .state_space import CoordinateGroup, Layout

MOST_COMPONENTS = 8  # largest number of components of a group

PRUNING_LOG_RATIO = 15.0
"""Components whose log evidence is lower than the best by more are pruned: one in three million."""


@dataclass(slots=True, eq=False)
class Candidate:
    """Candidate component for some groups."""

    belief: InformationState  # belief after the update
    predicted: Array  # predicted measurements there
    weights: Array | None  # inlier weight of each observation; None if all are 1
    nis: Array  # normalised innovation squared of each group
    dof: Array  # its degrees of freedom
    groups: Sequence[int]  # numbers of the groups
    covariances: dict[int, Array] = field(default_factory=dict)


class GaussianSum:
    """Gaussian sum with independent components for each group, the best first."""

    def __init__(
        self, layout: Layout, beliefs: Sequence[InformationState], alive: npt.NDArray[np.bool_]
    ) -> None:
        self._layout = layout
        self.beliefs, self.alive = tuple(beliefs), alive

    @property
    def best(self) -> InformationState:
        """Best component of every group."""
        return self.beliefs[0]

    def groups(self, component: int, among: Iterable[int]) -> list[int]:
        """Return those of some groups that have a component."""
        return [number for number in among if self.alive[component, number]]

    def map(self, change: Callable[[InformationState], InformationState]) -> GaussianSum:
        """Apply a function to each component."""
        return GaussianSum(self._layout, [change(b) for b in self.beliefs], self.alive)

    def evidence(self, number: int) -> Array:
        """Return the log evidence of the components of a group, the best first."""
        return np.array([belief.evidence[number] for belief in self.components(number)])

    @property
    def log_evidence(self) -> float:
        """Log evidence of all groups, summed over components."""
        count = len(self._layout.groups)
        return float(sum(np.logaddexp.reduce(self.evidence(number)) for number in range(count)))

    def select(
        self,
        candidates: Sequence[Candidate],
        should_merge: Callable[[CoordinateGroup, Candidate, Candidate], bool],
    ) -> tuple[GaussianSum, list[Candidate | None]]:
        """Prune and merge candidates to new components; also return the best candidate of each group."""
        kept: list[list[InformationState]] = []
        best: list[Candidate | None] = []
        for number, group in enumerate(self._layout.groups):
            ranked = [c for c in candidates if number in c.groups]
            ranked.sort(key=lambda c: -float(c.belief.evidence[number]))
            chosen: list[Candidate] = []
            for one in ranked:
                deficit = ranked[0].belief.evidence[number] - one.belief.evidence[number]
                if deficit > PRUNING_LOG_RATIO or len(chosen) == MOST_COMPONENTS:
                    break
                if not any(should_merge(group, one, other) for other in chosen):
                    chosen.append(one)
            kept.append([c.belief for c in chosen] or self.components(number))
            best.append(chosen[0] if chosen else None)
        return self._assemble(kept), best

    def components(self, number: int) -> list[InformationState]:
        """Return the components of a group, the best first."""
        return [b for b, alive in zip(self.beliefs, self.alive, strict=True) if alive[number]]

    def replace_groups(self, other: GaussianSum, groups: Iterable[int]) -> GaussianSum:
        """Return this sum with the components of another one for some groups."""
        sources = [self] * len(self._layout.groups)
        for number in groups:
            sources[number] = other
        return self._assemble([source.components(number) for number, source in enumerate(sources)])

    def join(self, other: GaussianSum, chosen: npt.NDArray[np.bool_]) -> GaussianSum:
        """Return this sum with chosen components of another one (components, groups), if probable."""
        components = [self.components(number) for number in range(len(self._layout.groups))]
        for n in np.flatnonzero(chosen.any(axis=0)).tolist():
            more = [other.beliefs[k] for k in np.flatnonzero(chosen[:, n] & other.alive[:, n]).tolist()]
            ranked = sorted(components[n] + more, key=lambda b: -float(b.evidence[n]))
            least = ranked[0].evidence[n] - PRUNING_LOG_RATIO
            components[n] = [b for b in ranked if b.evidence[n] >= least][:MOST_COMPONENTS]
        return self._assemble(components)

    def _assemble(self, components: Sequence[Sequence[InformationState]]) -> GaussianSum:
        beliefs, alive = [], []
        for k in range(max(map(len, components))):
            belief = self.best.copy()
            for n, (group, of_group) in enumerate(zip(self._layout.groups, components, strict=True)):
                source = of_group[min(k, len(of_group) - 1)]
                belief.x[group.x], belief.vector[group.t] = source.x[group.x], source.vector[group.t]
                belief.information[group.block] = source.information[group.block]
                belief.evidence[n] = source.evidence[n]
                belief.records[n], belief.speeds[n] = source.records[n], source.speeds[n]
            beliefs.append(belief)
            alive.append([k < len(of_group) for of_group in components])
        return GaussianSum(self._layout, beliefs, np.array(alive))


# Candidates merge if their predictions differ by fewer deviations of the noise, and each coordinate of the
# state by fewer of its own.
_SAME_PREDICTION, _NEAR = 0.3, 3.0


class MergeCriterion:
    """Criterion for two candidates that are one component."""

    def __init__(self, components: Components, ridge_covariance: RidgeCovariance) -> None:
        self._layout, self._residuals, self._process_model, self._reader, *_ = components
        self._ridge_covariance = ridge_covariance

    def should_merge(
        self,
        inputs: Array,
        periods: Mapping[Symbol, float],
        group: CoordinateGroup,
        one: Candidate,
        other: Candidate,
    ) -> bool:
        """Return True if two candidates predict the same measurements of a group from nearby states."""
        empty = self._reader.empty()
        predicted = empty._replace(values=self._reader.as_values(other.predicted), mask=~empty.mask)
        errors = self._residuals.errors(one.predicted, predicted, group.observation_indices)
        if any(float(e @ e) >= _SAME_PREDICTION**2 for e, _ in errors.values()):
            return False
        number, here = self._layout.groups.index(group), other.belief.x[group.x]
        change = one.belief.x[group.x] - here
        for k, x in enumerate(group.coordinates):
            if x in periods:
                change[k] = math.remainder(change[k], periods[x])
        # Between both states, to first order.
        step = np.linalg.pinv(self._process_model.basis(number, here, inputs)) @ change
        bound = _NEAR**2 * len(step)
        if float(step @ other.belief.information[group.block] @ step) < bound:
            return True
        record, known = one.belief.records[number], other.belief.records[number]
        if record is None or known is None:
            return False
        if min(record.count, known.count) > 1 and record.branch is not known.branch:
            return False  # separate components of earlier updates
        if number not in other.covariances:
            other.covariances[number] = self._ridge_covariance.compute(number, other.belief)
        return float(step @ inverse_spd(other.covariances[number]) @ step) < bound
