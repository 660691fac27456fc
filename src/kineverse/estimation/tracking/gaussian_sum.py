"""Gaussian-sum components, their pruning and merging.

Each group has its own components. They are kept until the evidence of one exceeds that of the others by far
(Alspach and Sorenson, Nonlinear Bayesian estimation using Gaussian sum approximations, 1972).

Mirror images predict the same measurements from different states and stay apart.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from kineverse.lie import Array

from .information_state import InformationState
from .state_space import Layout

if TYPE_CHECKING:
    from .gaussian_sum_filter import UpdateStep

MOST_COMPONENTS = 8  # largest number of components of a group

PRUNING_LOG_RATIO = 15.0
"""Components whose log evidence is lower than the best by more are pruned: one in three million."""


@dataclass(slots=True, eq=False)
class Candidate:
    """Candidate component for some groups."""

    belief: InformationState  # belief after the update
    weights: Array  # inlier weight of each observation
    nis: Array  # normalised innovation squared of each group
    dof: Array  # its degrees of freedom
    groups: Sequence[int]  # numbers of the groups


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
        self, candidates: Sequence[Candidate], step: UpdateStep, inputs: Array
    ) -> tuple[GaussianSum, list[Candidate | None]]:
        """Prune and merge candidates to new components; also return the best candidate of each group."""
        kept: list[list[InformationState]] = []
        best: list[Candidate | None] = []
        for number in range(len(self._layout.groups)):
            ranked = [c for c in candidates if number in c.groups]
            ranked.sort(key=lambda c: -float(c.belief.evidence[number]))
            chosen: list[Candidate] = []
            for one in ranked:
                deficit = ranked[0].belief.evidence[number] - one.belief.evidence[number]
                if deficit > PRUNING_LOG_RATIO or len(chosen) == MOST_COMPONENTS:
                    break
                if not any(_are_one(one.belief, other.belief, number, step, inputs) for other in chosen):
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
_EQUAL = 1e-3  # states that differ by fewer deviations predict the same


def _are_one(
    one: InformationState, other: InformationState, number: int, step: UpdateStep, inputs: Array
) -> bool:
    """Return True if two beliefs predict the same measurements of a group from nearby states."""
    group, here = step.layout.groups[number], other.x[step.layout.groups[number].x]
    change = one.x[group.x] - here
    for k, x in enumerate(group.coordinates):
        if x in step.periods:
            change[k] = math.remainder(change[k], step.periods[x])
    # Between both states, to first order.
    between = (
        np.linalg.pinv(step.process_model.basis(number, here, inputs)) @ change if group.by_speeds else change
    )
    squared = float(between @ other.information[group.block] @ between)
    if squared < _EQUAL**2 or squared >= _NEAR**2 * len(between):
        return squared < _EQUAL**2
    here, there = (step.residuals.evaluate(belief.x, inputs) for belief in (other, one))
    reading = step.reader.as_reading(here, group.observation_indices)
    errors = step.residuals.errors(there, reading, group.observation_indices)
    return all(float(e @ e) < _SAME_PREDICTION**2 for e, _ in errors.values())
