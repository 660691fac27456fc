"""From starts to the maximum of the likelihood, and from there to that with joint values integrated out.

Where a motion is short beside the noise, the likelihood prefers joint values that are noise: its maximum is
then several times as far from the truth as need be. So joint values are believed as wide as the motion is,
see :mod:`.evidence`, and are integrated out; how wide that is follows from what was seen, in turns with the
rest.

What is here is for families of one's own, and for those of joints where there is no C, see :mod:`.native`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np

from .evidence import evidence, overrated
from .mirrored import straightened
from .motion import Linear, Member, Prior
from .observations import Observations
from .rigid import Array
from .sliding import slid
from .solving import Belief, Solution, Start, solve, solve_first
from .widths import alone, widths

TURNS = 8
# A width that changes by less has settled.
SETTLED = 0.01
NARROWEST = 1e-4


@dataclass(frozen=True)
class Still:
    """A member of a family that stays as it is: only joint values are unknown."""

    motion: Member
    size: int = 0

    @property
    def joints(self) -> int:
        """Number of joint values."""
        return self.motion.joints

    def at(self, values: Array) -> Linear:
        """Return the poses at joint values (N, k)."""
        linear = self.motion.at(values)
        return linear._replace(by_parameters=linear.by_parameters[:, :, :0])

    def moved(self, step: Array) -> Self:
        """Return itself, whatever the step."""
        return self

    def bounded(self, values: Array, step: Array) -> Array:
        """Return joint values (N, k) after a step."""
        return self.motion.bounded(values, step)

    def prior(self) -> Prior:
        """Return nothing."""
        return Prior(np.zeros(0), np.zeros((0, 0)))


class Rated(NamedTuple):
    """A member of a family, and the logarithm of the evidence of the family around it."""

    solution: Solution[Member]
    log_evidence: float


def likeliest(seen: Observations, starts: Sequence[Start]) -> Rated:
    """Return the most likely member of a family, from the best of several starts."""
    first, *softer = [*seen.softened(), seen]
    best = solve_first(first, starts)
    for narrower in softer:
        best = solve(narrower, best.motion, best.values, best.parent)
    return _rated(slid(straightened(seen, best)))


def refined(seen: Observations, solution: Solution[Member]) -> Rated:
    """Return the solution with joint values integrated out."""
    if not solution.motion.joints or not solution.motion.size:
        return _rated(solution)
    result = _settled(seen, solution)
    softened = seen.softened()
    if solution.belief.marginal or not softened:
        return _rated(result)
    # The maximum of the likelihood is no good start where positions are that precise: it has bent the motion
    # so that each joint value has a place on it. With widths believed while the valley narrows, it has not.
    for softer in (*softened, seen):
        solution = solve(softer, solution.motion, solution.values, solution.parent, solution.belief)
        solution = _settled(softer, straightened(softer, solution))
    return _rated(max(result, solution, key=lambda each: evidence(each).log_evidence))


def continued(seen: Observations, start: Start, parent: Array, belief: Belief, known: int) -> Rated:
    """Return the solution from where it was, as it was: with joint values integrated out, or without.

    Parameters
    ----------
    seen
        What was observed.
    start, parent, belief
        Motion and joint values, true poses of the parent, and what was believed.
    known
        How many of the observations are not new. Where the new ones are is not known well, so they are first
        brought to the motion as it was.
    """
    motion, values, parent = start.motion, start.values.copy(), parent.copy()
    new = slice(known, len(seen))
    if known < len(seen):
        brought = solve(seen.at(new), Still(motion), values[new], parent[new], belief)
        values[new], parent[new] = brought.values, brought.parent
    solution = solve(seen, motion, values, parent, belief)
    return _rated(_settled(seen, solution) if belief.marginal else slid(solution))


def _settled(seen: Observations, solution: Solution[Member]) -> Solution[Member]:
    known = solution.belief
    before: Array | None = known.precision**-0.5 if known.marginal else None
    for _ in range(TURNS):
        solution = slid(solution)
        found = widths(solution.motion, alone(solution))
        wide = np.maximum(found.deviations, NARROWEST)
        if before is not None and np.all(np.abs(np.log(wide / before)) < SETTLED):
            break
        before = wide
        belief = Belief(found.mean, wide**-2.0, marginal=True)
        solution = solve(seen, solution.motion, solution.values, solution.parent, belief)
        solution = straightened(seen, solution)
    return solution


def _rated(solution: Solution[Member]) -> Rated:
    return Rated(solution, evidence(solution).log_evidence - overrated(solution))
