"""Counting of revolutions in sequential observations.

A pose says how far something has turned, but not how often it has gone round. From one observation to the
next it takes the shorter way: a crank, a valve or a wheel is counted so as long as it turns by less than half
a turn in between. A screw has moved by its lead with every turn, and if that is little beside the noise only
the count shows it.
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
    """Return the number of the joint value that counts turns about an axis, None if there is none."""
    if not isinstance(motion, GroupMotion):
        return None
    joints = motion.parametrisation.joints
    return None if WX in joints or WY in joints or WZ not in joints else joints.index(WZ)


def unwrap_solution(solution: Solution[FamilyMember]) -> Solution[FamilyMember]:
    """Return the same with turns counted along the observations; a screw has counted them already."""
    joint = find_revolving_joint(solution.motion)
    if joint is None or is_screw(solution.motion):
        return solution
    values = solution.values.copy()
    values[:, joint] = np.unwrap(values[:, joint])
    mean = solution.joint_prior.mean.copy()
    mean[joint] = values[:, joint].mean()
    return replace(solution, values=values, joint_prior=replace(solution.joint_prior, mean=mean))


def unwrap_screw(observations: Observations, solution: Solution[FamilyMember]) -> InitialGuess | None:
    """Return a screw that goes round as often as the observations do; None if this one does."""
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
    """Return by how much a screw is more probable, as a logarithm, as its turns were counted and not drawn.

    Other joints have their joint values within one turn, and so should it: otherwise each observation would
    pay for all the turns that it could have had.
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
    # The mean is integrated over, and is the less known the more turns there are.
    gain += _spread(after.deviations, known.covariances) - _spread(before.deviations, known.covariances)
    return max(0.0, gain)


def _spread(deviations: Array, covariances: Array) -> float:
    """Return the logarithm of the standard deviation of the mean of joint values."""
    return -0.5 * math.log(float(np.sum(1.0 / (deviations[0] ** 2 + covariances[:, 0, 0]))))


def is_screw(motion: FamilyMember) -> bool:
    """Whether it moves along its axis with every turn."""
    return isinstance(motion, GroupMotion) and motion.group.pitch
