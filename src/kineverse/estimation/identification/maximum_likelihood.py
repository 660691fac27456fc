"""Staged maximisation of the likelihood and of the marginal likelihood.

Where a motion is short compared with the noise, the joint values of the maximum of the likelihood follow the
noise. The error of its parameters is then several times larger than necessary. So the joint values get a
Gaussian prior as wide as the motion, see :mod:`.range_prior`, and are integrated out. The width is estimated
from the observations, in alternation with the parameters.

This is the numpy path: for custom families, and for all families without a compiler, see :mod:`.solver`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from kineverse.lie import Array

from .ambiguities import choose_mirrored_values, optimise_sliding_point
from .evidence import evidence_excess, laplace_evidence
from .motion_model import FamilyMember, FixedMotion
from .observations import Observations
from .optimise import InitialGuess, JointValuePrior, Solution, levenberg_marquardt, solve_from_best_start
from .range_prior import fit_joint_ranges, solve_per_observation

TURNS = 8
# Relative change of a width at convergence.
SETTLED = 0.01
NARROWEST = 1e-4


class Scored(NamedTuple):
    """Solution of a family and the logarithm of the evidence of the family."""

    solution: Solution[FamilyMember]
    log_evidence: float


def maximum_likelihood(observations: Observations, starts: Sequence[InitialGuess]) -> Scored:
    """Return the maximum of the likelihood in a family, from the best of several starts."""
    first, *softer = [*observations.softened(), observations]
    best = solve_from_best_start(first, starts)
    for narrower in softer:
        best = levenberg_marquardt(narrower, best.motion, best.values, best.parent)
    return _score(optimise_sliding_point(choose_mirrored_values(observations, best)))


def maximise_marginal_likelihood(observations: Observations, solution: Solution[FamilyMember]) -> Scored:
    """Return the maximum of the marginal likelihood, in which the joint values are integrated out."""
    if not solution.motion.joints or not solution.motion.size:
        return _score(solution)
    result = _iterate_ranges(observations, solution)
    softened = observations.softened()
    if solution.joint_prior.marginal or not softened:
        return _score(result)
    # With positions this precise the maximum of the likelihood is a poor start: its motion is distorted to
    # fit each joint value. A prior on the ranges during the continuation prevents that.
    for softer in (*softened, observations):
        solution = levenberg_marquardt(
            softer, solution.motion, solution.values, solution.parent, solution.joint_prior
        )
        solution = _iterate_ranges(softer, choose_mirrored_values(softer, solution))
    return _score(max(result, solution, key=lambda each: laplace_evidence(each).log_evidence))


def continue_from(
    observations: Observations, start: InitialGuess, parent: Array, joint_prior: JointValuePrior, known: int
) -> Scored:
    """Return the solution of more observations, starting from an earlier solution.

    The joint values are integrated out if they were in the earlier solution.
    """
    motion, values, parent = start.motion, start.values.copy(), parent.copy()
    new = slice(known, len(observations))
    if known < len(observations):
        projected = levenberg_marquardt(
            observations.select(new), FixedMotion(motion), values[new], parent[new], joint_prior
        )
        values[new], parent[new] = projected.values, projected.parent
    solution = levenberg_marquardt(observations, motion, values, parent, joint_prior)
    return _score(
        _iterate_ranges(observations, solution) if joint_prior.marginal else optimise_sliding_point(solution)
    )


def _iterate_ranges(observations: Observations, solution: Solution[FamilyMember]) -> Solution[FamilyMember]:
    """Alternate between the ranges of the joint values and the other unknowns until the ranges converge."""
    prior = solution.joint_prior
    before: Array | None = prior.precision**-0.5 if prior.marginal else None
    for _ in range(TURNS):
        solution = optimise_sliding_point(solution)
        ranges = fit_joint_ranges(solution.motion, solve_per_observation(solution))
        widths = np.maximum(ranges.deviations, NARROWEST)
        if before is not None and np.all(np.abs(np.log(widths / before)) < SETTLED):
            break
        before = widths
        joint_prior = JointValuePrior(ranges.mean, widths**-2.0, marginal=True)
        solution = levenberg_marquardt(
            observations, solution.motion, solution.values, solution.parent, joint_prior
        )
        solution = choose_mirrored_values(observations, solution)
    return solution


def _score(solution: Solution[FamilyMember]) -> Scored:
    return Scored(solution, laplace_evidence(solution).log_evidence - evidence_excess(solution))
