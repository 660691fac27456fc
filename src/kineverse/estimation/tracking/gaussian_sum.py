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
from .process_model import ProcessModel
from .residuals import MeasurementReader, Residuals
from .state_space import CoordinateGroup, Layout

MOST_COMPONENTS = 8
"""Largest number of components of a group."""

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
        self,
        layout: Layout,
        beliefs: Sequence[InformationState],
        alive: npt.NDArray[np.bool_],
    ) -> None:
        self._layout = layout
        self.beliefs, self.alive = tuple(beliefs), alive

    @property
    def best(self) -> InformationState:
        """Best component of every group."""
        return self.beliefs[0]

    @property
    def is_single(self) -> bool:
        """True if there is one component only."""
        return len(self.beliefs) == 1

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
        """Prune and merge candidates to new components; also return the best candidate of each group.

        Groups without candidates keep their components.
        """
        kept: list[list[tuple[InformationState, Candidate | None]]] = []
        for number, group in enumerate(self._layout.groups):
            own = [c for c in candidates if number in c.groups]
            own.sort(key=lambda c: -float(c.belief.evidence[number]))
            chosen: list[Candidate] = []
            for one in own:
                deficit = own[0].belief.evidence[number] - one.belief.evidence[number]
                if deficit > PRUNING_LOG_RATIO or len(chosen) == MOST_COMPONENTS:
                    break
                if not any(should_merge(group, one, other) for other in chosen):
                    chosen.append(one)
            before: list[tuple[InformationState, Candidate | None]] = [
                (belief, None) for belief in self.components(number)
            ]
            kept.append([(c.belief, c) for c in chosen] or before)
        after = self._assemble([[belief for belief, _ in components] for components in kept])
        return after, [components[0][1] for components in kept]

    def components(self, number: int) -> list[InformationState]:
        """Return the components of a group, the best first."""
        return [b for b, alive in zip(self.beliefs, self.alive, strict=True) if alive[number]]

    def replace_groups(self, other: GaussianSum, groups: Iterable[int]) -> GaussianSum:
        """Return this sum with the components of another one for some groups."""
        sources = [self] * len(self._layout.groups)
        for number in groups:
            sources[number] = other
        return self._assemble([source.components(number) for number, source in enumerate(sources)])

    def _assemble(self, components: Sequence[Sequence[InformationState]]) -> GaussianSum:
        """Return the sum of the components of each group, the best first."""
        beliefs, alive = [], []
        for k in range(max(map(len, components))):
            belief = self.best.copy()
            for number, (group, own) in enumerate(zip(self._layout.groups, components, strict=True)):
                copy_group(own[min(k, len(own) - 1)], belief, number, group)
            beliefs.append(belief)
            alive.append([k < len(own) for own in components])
        return GaussianSum(self._layout, beliefs, np.array(alive))


def copy_group(
    source: InformationState, target: InformationState, number: int, group: CoordinateGroup
) -> None:
    """Copy the belief about one group."""
    block = group.block
    target.x[group.x], target.vector[group.t] = source.x[group.x], source.vector[group.t]
    target.information[block], target.evidence[number] = source.information[block], source.evidence[number]
    target.records[number], target.speeds[number] = source.records[number], source.speeds[number]


# Candidates merge if their predictions differ by fewer deviations of the noise, and each coordinate of the
# state by fewer of its own.
_SAME_PREDICTION, _NEAR = 0.3, 3.0


class MergeCriterion:
    """Criterion for two candidates that are one component."""

    def __init__(
        self,
        layout: Layout,
        residuals: Residuals,
        reader: MeasurementReader,
        process_model: ProcessModel,
        ridge_covariance: RidgeCovariance,
    ) -> None:
        self._layout, self._residuals, self._reader = layout, residuals, reader
        self._process_model, self._ridge_covariance = process_model, ridge_covariance

    def should_merge(
        self,
        inputs: Array,
        periods: Mapping[Symbol, float],
        group: CoordinateGroup,
        one: Candidate,
        other: Candidate,
    ) -> bool:
        """Return True if two candidates predict the same measurements of a group from nearby states."""
        values = self._reader.as_values(other.predicted)
        nothing = self._reader.empty()
        as_seen = nothing._replace(values=values, mask=~nothing.mask)
        errors = self._residuals.errors(one.predicted, as_seen, group.observation_indices)
        if any(float(e @ e) >= _SAME_PREDICTION**2 for e, _ in errors.values()):
            return False
        number = self._layout.groups.index(group)
        apart = self._difference(group, other.belief, one.belief, inputs, periods)
        most = _NEAR**2 * len(apart)
        if float(apart @ other.belief.information[group.block] @ apart) < most:
            return True
        mine, theirs = one.belief.records[number], other.belief.records[number]
        if (
            mine is None
            or theirs is None
            or (min(mine.count, theirs.count) > 1 and mine.branch is not theirs.branch)
        ):
            return False  # separate components of earlier updates
        if number not in other.covariances:
            other.covariances[number] = self._ridge_covariance.compute(number, other.belief)
        return float(apart @ inverse_spd(other.covariances[number]) @ apart) < most

    def _difference(
        self,
        group: CoordinateGroup,
        here: InformationState,
        there: InformationState,
        inputs: Array,
        periods: Mapping[Symbol, float],
    ) -> Array:
        """Return the tangent step between the states of two beliefs, to first order."""
        change = there.x[group.x] - here.x[group.x]
        for k, x in enumerate(group.coordinates):
            if x in periods:
                change[k] = math.remainder(change[k], periods[x])
        basis = self._process_model.basis(self._layout.groups.index(group), here.x[group.x], inputs)
        return np.linalg.pinv(basis) @ change
