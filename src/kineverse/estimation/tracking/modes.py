"""Several beliefs at once, where what was seen has several explanations: starts of angles, outliers.

Each group has its own, kept apart until one of them explains all that came since much better (a Gaussian sum;
Alspach and Sorenson, Nonlinear Bayesian estimation using Gaussian sum approximations, 1972).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from kineverse.estimation.noise import Array

from .belief import Belief
from .layout import Group, Layout

MOST_MODES = 8
"""So many explanations are kept of each group."""

UNLIKELY = 15.0
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

    belief: Belief
    said: Array
    weights: Array | None
    nis: Array
    dof: Array
    groups: Sequence[int]
    covariances: dict[int, Array] = field(default_factory=dict)


class Modes:
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
        beliefs: Sequence[Belief],
        alive: npt.NDArray[np.bool_],
    ) -> None:
        self._layout = layout
        self.beliefs, self.alive = tuple(beliefs), alive

    @property
    def best(self) -> Belief:
        """The best belief of every group."""
        return self.beliefs[0]

    @property
    def is_single(self) -> bool:
        """Whether all is explained in one way."""
        return len(self.beliefs) == 1

    def groups(self, mode: int, among: Iterable[int]) -> list[int]:
        """Return those of some groups that have a mode."""
        return [number for number in among if self.alive[mode, number]]

    def each(self, change: Callable[[Belief], Belief]) -> Modes:
        """Return what becomes of them when each belief changes."""
        return Modes(self._layout, [change(b) for b in self.beliefs], self.alive)

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
        self, candidates: Sequence[Candidate], is_same: Callable[[Group, Candidate, Candidate], bool]
    ) -> tuple[Modes, list[Candidate | None]]:
        """Return the best candidates of each group as modes, and for each group which one is best.

        Groups without candidates keep what they have.

        Parameters
        ----------
        candidates
            All explanations after a reading.
        is_same
            Whether two say the same about a group.
        """
        kept: list[list[tuple[Belief, Candidate | None]]] = []
        for number, group in enumerate(self._layout.groups):
            own = [c for c in candidates if number in c.groups]
            own.sort(key=lambda c: -float(c.belief.evidence[number]))
            chosen: list[Candidate] = []
            for one in own:
                behind = own[0].belief.evidence[number] - one.belief.evidence[number]
                if behind > UNLIKELY or len(chosen) == MOST_MODES:
                    break
                if not any(is_same(group, one, other) for other in chosen):
                    chosen.append(one)
            before: list[tuple[Belief, Candidate | None]] = [
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
        after = Modes(self._layout, beliefs, np.array(alive))
        return after, [own_modes[0][1] for own_modes in kept]


def copy_group(source: Belief, target: Belief, number: int, group: Group) -> None:
    """Take over what is believed of a group."""
    block = np.ix_(group.t, group.t)
    target.x[group.x], target.vector[group.t] = source.x[group.x], source.vector[group.t]
    target.information[block], target.evidence[number] = source.information[block], source.evidence[number]
    target.standing[number] = source.standing[number]
