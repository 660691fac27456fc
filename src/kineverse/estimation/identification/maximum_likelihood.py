"""Staged maximisation of the likelihood and of the marginal likelihood.

Where a motion is short beside the noise, the likelihood prefers joint values that are noise: its maximum is
then several times as far from the truth as need be. So joint values are believed as wide as the motion is,
see :mod:`.laplace_evidence`, and are integrated out; how wide that is follows from what was seen, in turns with the
rest.

What is here is for families of one's own, and for those of joints where there is no C, see :mod:`.native`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np

from kineverse.lie import Stack

from .ambiguities import choose_mirrored_values, optimise_sliding_point
from .evidence import evidence_excess, laplace_evidence
from .motion_model import FamilyMember, LinearisedPoses, ParameterPrior
from .observations import Observations
from .optimise import InitialGuess, JointValuePrior, Solution, levenberg_marquardt, solve_from_best_start
from .range_prior import fit_joint_ranges, solve_per_observation

TURNS = 8
# A width that changes by less has settled.
SETTLED = 0.01
NARROWEST = 1e-4


@dataclass(frozen=True)
class FrozenMotion:
    """A member of a family that stays as it is: only joint values are unknown."""

    motion: FamilyMember
    size: int = 0

    @property
    def joints(self) -> int:
        """Number of joint values."""
        return self.motion.joints

    def at(self, values: Stack) -> LinearisedPoses:
        """Return the poses at joint values (N, k)."""
        linear = self.motion.at(values)
        return linear._replace(by_parameters=linear.by_parameters[:, :, :0])

    def moved(self, step: Stack) -> Self:
        """Return itself, whatever the step."""
        return self

    def bounded(self, values: Stack, step: Stack) -> Stack:
        """Return joint values (N, k) after a step."""
        return self.motion.bounded(values, step)

    def prior(self) -> ParameterPrior:
        """Return nothing."""
        return ParameterPrior(np.zeros(0), np.zeros((0, 0)))


class Scored(NamedTuple):
    """A member of a family, and the logarithm of the evidence of the family around it."""

    solution: Solution[FamilyMember]
    log_evidence: float


def maximum_likelihood(seen: Observations, starts: Sequence[InitialGuess]) -> Scored:
    """Return the most likely member of a family, from the best of several starts."""
    first, *softer = [*seen.softened(), seen]
    best = solve_from_best_start(first, starts)
    for narrower in softer:
        best = levenberg_marquardt(narrower, best.motion, best.values, best.parent)
    return _rated(optimise_sliding_point(choose_mirrored_values(seen, best)))


def maximise_marginal_likelihood(seen: Observations, solution: Solution[FamilyMember]) -> Scored:
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
        solution = levenberg_marquardt(
            softer, solution.motion, solution.values, solution.parent, solution.belief
        )
        solution = _settled(softer, choose_mirrored_values(softer, solution))
    return _rated(max(result, solution, key=lambda each: laplace_evidence(each).log_evidence))


def continue_from(
    seen: Observations, start: InitialGuess, parent: Stack, belief: JointValuePrior, known: int
) -> Scored:
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
        brought = levenberg_marquardt(seen.at(new), FrozenMotion(motion), values[new], parent[new], belief)
        values[new], parent[new] = brought.values, brought.parent
    solution = levenberg_marquardt(seen, motion, values, parent, belief)
    return _rated(_settled(seen, solution) if belief.marginal else optimise_sliding_point(solution))


def _settled(seen: Observations, solution: Solution[FamilyMember]) -> Solution[FamilyMember]:
    known = solution.belief
    before: Stack | None = known.precision**-0.5 if known.marginal else None
    for _ in range(TURNS):
        solution = optimise_sliding_point(solution)
        found = fit_joint_ranges(solution.motion, solve_per_observation(solution))
        wide = np.maximum(found.deviations, NARROWEST)
        if before is not None and np.all(np.abs(np.log(wide / before)) < SETTLED):
            break
        before = wide
        belief = JointValuePrior(found.mean, wide**-2.0, marginal=True)
        solution = levenberg_marquardt(seen, solution.motion, solution.values, solution.parent, belief)
        solution = choose_mirrored_values(seen, solution)
    return solution


def _rated(solution: Solution[FamilyMember]) -> Scored:
    return Scored(solution, laplace_evidence(solution).log_evidence - evidence_excess(solution))
