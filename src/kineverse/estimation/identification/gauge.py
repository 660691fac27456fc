"""Gauge fixing of motion parameters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from kineverse.lie import Array, exp_so3, orthonormalize, rotation_along_z, transform, translation

from .families import VZ, WZ, GroupMotion
from .motion_model import FamilyMember
from .optimise import Solution


def fix_gauge(solution: Solution[FamilyMember]) -> Solution[FamilyMember]:
    """Return the same motion in a unique parametrisation.

    The largest component of the axis is positive and the mean of the joint values is 0. The origin of the
    joint's frame is the point of the axis nearest to the child at 0. For a prismatic joint it is the origin
    of the child.
    """
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
    motion = _fix_origin(motion)
    axis = motion.left[:3, 2]
    flip = bool(axis[np.argmax(np.abs(axis))] < 0.0)
    if motion.rows == 6:
        motion, values = _fix_rotation(motion, values, flip)
    elif flip:
        motion, values = _rotate_frame(motion, values, np.diag([1.0, -1.0, -1.0]))
    joint_prior = replace(solution.joint_prior, mean=values[-1])
    values = values[:-1]
    return replace(
        solution, motion=motion, values=values, joint_prior=joint_prior, linear=motion.linearise(values)
    )


def _fix_origin(motion: GroupMotion) -> GroupMotion:
    """Move the origin of the joint's frame along the gauge freedom to the point nearest to the child."""
    place = motion.right[:3, 3]
    free = (1, 1, 1) if motion.group.name == "prismatic" else (0, 0, 1)
    way = place * free
    return replace(motion, left=motion.left @ translation(way), right=translation(-way) @ motion.right)


def _fix_rotation(motion: GroupMotion, values: Array, flip: bool) -> tuple[GroupMotion, Array]:
    """Rotate the joint's frame about its axis to the orientation that depends on the axis alone."""
    canonical = rotation_along_z(-motion.left[:3, 2] if flip else motion.left[:3, 2])
    return _rotate_frame(motion, values, motion.left[:3, :3].T @ canonical)


def _rotate_frame(motion: GroupMotion, values: Array, turn: Array) -> tuple[GroupMotion, Array]:
    change = transform(turn, np.zeros(3))
    joints = list(motion.parametrisation.joints)
    twist = np.zeros((len(values), 6))
    twist[:, joints] = values
    twist[:, :3], twist[:, 3:] = twist[:, :3] @ turn, twist[:, 3:] @ turn
    left, right = motion.left @ change, change.T @ motion.right
    return replace(motion, left=left, right=right), twist[:, joints]
