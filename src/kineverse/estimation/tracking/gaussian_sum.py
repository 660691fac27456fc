"""Gaussian-sum components, their pruning and merging.

Each group has its own, kept apart until one of them explains all that came since much better (a Gaussian sum;
Alspach and Sorenson, Nonlinear Bayesian estimation using Gaussian sum approximations, 1972).

Mirror images say the same from different states. Places on a ridge do so as well, but what they cover is one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from kineverse.lie import Array
from kineverse.symbols import Symbol

from .covariance import RidgeCovariance
from .gaussian import InformationState, inverse_spd
from .layout import CoordinateGroup, Layout
from .process_model import ProcessModel
from .residuals import MeasurementReader, Residuals

MOST_COMPONENTS = 8
"""So many explanations are kept of each group."""

PRUNING_LOG_RATIO = 15.0
"""An explanation whose log evidence is so far below the best is given up: one in three million."""


@dataclass(slots=True, eq=False)
class Candidate:
    """An explanation of some groups.

    Attributes
    ----------
    belief
        What is believed then.
    said
        What the model says there.
    weights
        How far each observation is believed; None if all are.
    nis, dof
        Of each group.
    groups
        Which groups it is about.
    covariances
        Of groups, as far as they were asked for.
    """

    belief: InformationState
    said: Array
    weights: Array | None
    nis: Array
    dof: Array
    groups: Sequence[int]
    covariances: dict[int, Array] = field(default_factory=dict)


class GaussianSum:
    """Beliefs, the best of each group first.

    Parameters
    ----------
    layout
        Where groups are.
    beliefs
        At first.
    alive
        For each belief, which groups have it (modes, groups); all have the first.

    Attributes
    ----------
    beliefs, alive
        As they are now.
    """

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
        """The best belief of every group."""
        return self.beliefs[0]

    @property
    def is_single(self) -> bool:
        """Whether all is explained in one way."""
        return len(self.beliefs) == 1

    def groups(self, mode: int, among: Iterable[int]) -> list[int]:
        """Return those of some groups that have a mode."""
        return [number for number in among if self.alive[mode, number]]

    def each(self, change: Callable[[InformationState], InformationState]) -> GaussianSum:
        """Return what becomes of them when each belief changes."""
        return GaussianSum(self._layout, [change(b) for b in self.beliefs], self.alive)

    def evidence(self, number: int) -> Array:
        """Return the log evidence of the modes of a group, its best one first."""
        return np.array(
            [b.evidence[number] for b, alive in zip(self.beliefs, self.alive, strict=True) if alive[number]]
        )

    @property
    def log_evidence(self) -> float:
        """The log evidence of all groups, whichever mode is right."""
        count = len(self._layout.groups)
        return float(sum(np.logaddexp.reduce(self.evidence(number)) for number in range(count)))

    def ranked(
        self,
        candidates: Sequence[Candidate],
        is_same: Callable[[CoordinateGroup, Candidate, Candidate], bool],
    ) -> tuple[GaussianSum, list[Candidate | None]]:
        """Return the best candidates of each group as modes, and for each group which one is best.

        Groups without candidates keep what they have.

        Parameters
        ----------
        candidates
            All explanations after a reading.
        is_same
            Whether two say the same about a group.
        """
        kept: list[list[tuple[InformationState, Candidate | None]]] = []
        for number, group in enumerate(self._layout.groups):
            own = [c for c in candidates if number in c.groups]
            own.sort(key=lambda c: -float(c.belief.evidence[number]))
            chosen: list[Candidate] = []
            for one in own:
                behind = own[0].belief.evidence[number] - one.belief.evidence[number]
                if behind > PRUNING_LOG_RATIO or len(chosen) == MOST_COMPONENTS:
                    break
                if not any(is_same(group, one, other) for other in chosen):
                    chosen.append(one)
            before: list[tuple[InformationState, Candidate | None]] = [
                (self.beliefs[mode], None) for mode in range(len(self.beliefs)) if self.alive[mode, number]
            ]
            kept.append([(c.belief, c) for c in chosen] or before)
        beliefs, alive = [], []
        for mode in range(max(map(len, kept))):
            belief = self.best.copy()
            for number, (group, own_modes) in enumerate(zip(self._layout.groups, kept, strict=True)):
                source, _ = own_modes[min(mode, len(own_modes) - 1)]
                copy_group(source, belief, number, group)
            beliefs.append(belief)
            alive.append([mode < len(own_modes) for own_modes in kept])
        after = GaussianSum(self._layout, beliefs, np.array(alive))
        return after, [own_modes[0][1] for own_modes in kept]


def copy_group(
    source: InformationState, target: InformationState, number: int, group: CoordinateGroup
) -> None:
    """Take over what is believed of a group."""
    block = np.ix_(group.t, group.t)
    target.x[group.x], target.vector[group.t] = source.x[group.x], source.vector[group.t]
    target.information[block], target.evidence[number] = source.information[block], source.evidence[number]
    target.standing[number] = source.standing[number]


# Explanations are one if predictions are fewer deviations of the noise apart, and each coordinate
# of the state fewer of its own.
_SAME, _NEAR = 0.3, 3.0


class MergeCriterion:
    """Compares explanations.

    Parameters
    ----------
    layout, residuals, reader, charted, ridge
        The parts of a tracker.
    """

    def __init__(
        self,
        layout: Layout,
        residuals: Residuals,
        reader: MeasurementReader,
        charted: ProcessModel,
        ridge: RidgeCovariance,
    ) -> None:
        self._layout, self._residuals, self._reader = layout, residuals, reader
        self._charted, self._ridge = charted, ridge

    def is_same(
        self, known: Array, turns: frozenset[Symbol], group: CoordinateGroup, one: Candidate, other: Candidate
    ) -> bool:
        """Whether two explanations predict the same of a group, and are near each other.

        Parameters
        ----------
        known
            Values of what is known.
        turns
            The coordinates that come back after a turn.
        group
            What they explain.
        one, other
            The explanations.
        """
        values = self._reader.values_of(other.said)
        nothing = self._reader.nothing()
        as_seen = nothing._replace(values=values, seen=~nothing.seen)
        errors = self._residuals.errors(one.said, as_seen, group.seen)
        if any(float(e @ e) >= _SAME**2 for e, _ in errors.values()):
            return False
        number = self._layout.groups.index(group)
        apart = self._apart(group, other.belief, one.belief, known, turns)
        most = _NEAR**2 * len(apart)
        if float(apart @ other.belief.information[np.ix_(group.t, group.t)] @ apart) < most:
            return True
        mine, theirs = one.belief.standing[number], other.belief.standing[number]
        if (
            mine is None
            or theirs is None
            or (min(mine.looks, theirs.looks) > 1 and mine.branch is not theirs.branch)
        ):
            return False  # they were told apart before
        if number not in other.covariances:
            other.covariances[number] = self._ridge.covariance(number, other.belief)
        return float(apart @ inverse_spd(other.covariances[number]) @ apart) < most

    def _apart(
        self,
        group: CoordinateGroup,
        here: InformationState,
        there: InformationState,
        known: Array,
        turns: frozenset[Symbol],
    ) -> Array:
        """Return about which step in the tangent leads from one place of a group to another."""
        change = there.x[group.x] - here.x[group.x]
        for k, x in enumerate(group.coordinates):
            if x in turns:
                change[k] = math.remainder(change[k], 2 * math.pi)
        basis = self._charted.basis(self._layout.groups.index(group), here.x[group.x], known)
        return np.linalg.pinv(basis) @ change
