"""Counting of revolutions in sequential observations.

A pose determines an angle only up to whole revolutions. In a sequence, the joint is assumed to take the
shorter way from one observation to the next. The count is right if it rotates by less than half a revolution
between them. If the lead of a screw is small compared with the noise, only the count reveals it.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from kineverse.lie import Array, inverse

from .families import WX, WY, WZ, GroupMotion
from .motion_model import FamilyMember, MotionModel
from .observations import Observations
from .optimise import InitialGuess, Solution
from .range_prior import fit_joint_ranges, solve_per_observation


def find_revolving_joint(motion: MotionModel) -> int | None:
    """Return the index of the joint value that is an angle about a fixed axis; None if there is none."""
    if not isinstance(motion, GroupMotion):
        return None
    joints = motion.parametrisation.joints
    return None if WX in joints or WY in joints or WZ not in joints else joints.index(WZ)


def unwrap_solution(solution: Solution[FamilyMember]) -> Solution[FamilyMember]:
    """Return the solution with angles unwrapped along the observations. A screw is unwrapped already."""
    joint = find_revolving_joint(solution.motion)
    if joint is None or is_screw(solution.motion):
        return solution
    values = solution.values.copy()
    values[:, joint] = np.unwrap(values[:, joint])
    mean = solution.joint_prior.mean.copy()
    mean[joint] = values[:, joint].mean()
    return replace(solution, values=values, joint_prior=replace(solution.joint_prior, mean=mean))


def unwrap_screw(observations: Observations, solution: Solution[FamilyMember]) -> InitialGuess | None:
    """Return a screw with the revolutions of the observations; None if this one has them already."""
    motion = solution.motion
    if not isinstance(motion, GroupMotion) or not is_screw(motion):
        return None
    angles = np.unwrap(solution.values[:, 0])
    if np.array_equal(angles, solution.values[:, 0]):
        return None
    along = (inverse(motion.left) @ observations.relative)[:, 2, 3]
    pitch, offset = np.polyfit(angles, along, 1)
    right = motion.right.copy()
    right[2, 3] = offset
    return InitialGuess(replace(motion, right=right, pitch=float(pitch)), angles[:, None])


def log_unwrapping_gain(solution: Solution[FamilyMember]) -> float:
    """Return the gain in log evidence of a screw whose revolutions are counted instead of unknown.

    The joint values of other families lie within one revolution. Without the correction each observation of
    a screw would pay for the choice among many revolutions.
    """
    if not is_screw(solution.motion):
        return 0.0
    known = solve_per_observation(solution)
    values = known.values
    middle = math.atan2(float(np.sin(values).mean()), float(np.cos(values).mean()))
    within = values - math.tau * np.round((values - middle) / math.tau)
    before = fit_joint_ranges(solution.motion, known)
    after = fit_joint_ranges(solution.motion, replace(known, values=within))
    gain = after.log_density - before.log_density
    # The evidence integrates over the mean, which is less certain with more revolutions.
    gain += _spread(after.deviations, known.covariances) - _spread(before.deviations, known.covariances)
    return max(0.0, gain)


def _spread(deviations: Array, covariances: Array) -> float:
    """Return the logarithm of the standard deviation of the mean joint value."""
    return -0.5 * math.log(float(np.sum(1.0 / (deviations[0] ** 2 + covariances[:, 0, 0]))))


def is_screw(motion: FamilyMember) -> bool:
    """Return True for a screw."""
    return isinstance(motion, GroupMotion) and motion.group.pitch
