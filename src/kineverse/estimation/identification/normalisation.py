"""Normal form of observations and fits: unit of length, and gauge of the parameters.

The priors assume levers within a unit of length and pitches within a tenth of it. They have to hold for a
crane as well as for a cupboard, and for poses in millimetres. So observations are scaled to a unit of their
size, and fits are scaled back. All families share the unit, so their comparison does not depend on it.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from kineverse.lie import Array, exp_so3, orthonormalize, rotation_along_z, transform, translation

from .curve import CurveMotion
from .families import VZ, WX, WZ, FamilyMotion, GroupMotion
from .least_squares import Solution
from .motion_functions import FamilyMember
from .observations import Observations
from .result import Fit

# For rotations of 15° or more, the lever is within four times the median distance from the middle.
_TIMES = 4.0
# Standard deviation, in units of length, that is added to all stated ones: floating point cannot hold a
# smaller noise of motions of the size of the unit.
_ROUNDING = 1e-7


def length_scale(observations: Observations) -> float:
    """Return four times the median distance of relative positions from their median [m], at least 1."""
    positions = observations.relative[:, :3, 3]
    off = np.linalg.norm(positions - np.median(positions, axis=0), axis=1)
    return max(1.0, _TIMES * float(np.median(off)))


def convert_to_unit(observations: Observations, unit: float) -> Observations:
    """Return observations with lengths in a unit [m]."""
    if unit == 1.0:
        return observations
    scale = np.array([1.0 / unit] * 3 + [1.0] * 3)
    scaled = observations.scaled(np.outer(scale, scale))
    rounding, rows = np.diag([_ROUNDING**2] * 3 + [0.0] * 3), observations.rows
    of_parent = None if scaled.parent_covariance is None else scaled.parent_covariance + rounding
    of_child = scaled.child_covariance + rounding[:rows, :rows]
    parent, child = (_scale_positions(p, 1.0 / unit) for p in (observations.parent, observations.child))
    return Observations(parent, child, of_parent, of_child)


def log_density(count: float, unit: float) -> float:
    """Return the log ratio of densities of ``count`` poses about a mean pose, in metres and in units."""
    return 3.0 * (1 - count) * math.log(unit)


def convert_to_metres(fit: Fit, unit: float) -> Fit:
    """Return a fit with lengths in a unit [m], converted to metres."""
    if unit == 1.0:
        return fit
    residuals = fit.residuals.copy()
    residuals[:, :3] *= unit
    motion = fit.motion
    if isinstance(motion, FamilyMotion):
        return replace(fit, residuals=residuals, motion=replace(motion, unit=motion.unit / unit))
    frame = fit.frame
    if isinstance(motion, CurveMotion):
        motion = motion.scaled(unit)
        scale, slides = np.full(len(fit.covariance), unit), np.array([unit])
    elif isinstance(motion, GroupMotion):
        lengths = ("pitch", "point.x", "point.y", "point.z", "child.x", "child.y", "child.z")
        scale = np.where([name in lengths for name in fit.coordinates], unit, 1.0)
        slides = np.array([unit if j < WX else 1.0 for j in motion.parametrisation.joints])
        frame, right = _scale_positions(motion.left, unit), _scale_positions(motion.right, unit)
        motion = replace(motion, left=frame, right=right, pitch=unit * motion.pitch)
    else:
        return replace(fit, residuals=residuals)
    return replace(
        fit,
        parameters=motion.named_parameters(),
        covariance=fit.covariance * np.outer(scale, scale),
        frame=frame,
        joint_values=fit.joint_values * slides,
        deviations=fit.deviations * slides,
        residuals=residuals,
        motion=motion,
    )


def _scale_positions(poses: Array, factor: float) -> Array:
    result = poses.copy()
    result[..., :3, 3] *= factor
    return result


def fix_gauge(solution: Solution[FamilyMember]) -> Solution[FamilyMember]:
    """Return the same motion with a canonical axis and origin, and joint values with mean 0."""
    motion = solution.motion
    if not isinstance(motion, GroupMotion):
        return solution
    name = motion.group.name
    if name in ("rigid", "free", "spherical"):
        return solution
    values = np.concatenate([solution.values, solution.joint_prior.mean[None]])
    shift = solution.values.mean(axis=0)
    if name == "planar":
        shift[2:] = 0.0  # rotations and translations do not commute
    middle = np.zeros(6)
    middle[list(motion.parametrisation.joints)] = shift
    middle[VZ] += motion.pitch * middle[WZ]
    # Rotations drift under repeated multiplication in warm starts.
    left, right = orthonormalize(motion.left), orthonormalize(motion.right)
    motion = replace(motion, left=left @ transform(exp_so3(middle[3:]), middle[:3]), right=right)
    values = values - shift
    # Move the origin to the point nearest to the child.
    along = motion.right[:3, 3] * ((1, 1, 1) if name == "prismatic" else (0, 0, 1))
    left, right = motion.left @ translation(along), translation(-along) @ motion.right
    axis = left[:3, 2]
    flip = bool(axis[np.argmax(np.abs(axis))] < 0.0)
    turn = np.diag([1.0, -1.0, -1.0]) if flip else np.eye(3)
    if motion.rows == 6:
        # The orientation that depends on the axis alone.
        turn = left[:3, :3].T @ rotation_along_z(-axis if flip else axis)
    change = transform(turn, np.zeros(3))
    motion = replace(motion, left=left @ change, right=change.T @ right)
    joints, twist = list(motion.parametrisation.joints), np.zeros((len(values), 6))
    twist[:, joints] = values
    values = np.concatenate([twist[:, :3] @ turn, twist[:, 3:] @ turn], axis=1)[:, joints]
    joint_prior = replace(solution.joint_prior, mean=values[-1])
    values = values[:-1]
    return replace(
        solution, motion=motion, values=values, joint_prior=joint_prior, linear=motion.linearise(values)
    )
