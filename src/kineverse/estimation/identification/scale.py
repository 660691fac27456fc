"""Length scale of the data.

What is believed beforehand, that levers are within a unit and pitches within a tenth of it, should be as true
of a crane as of a cupboard, and of poses in millimetres. So observations are looked at in units of their
size, and what comes out is said in theirs again. All families share the unit, so it is no reason for one of
them.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from kineverse.lie import Array

from .custom_family import FamilyMotion
from .families import WX, GroupMotion
from .observations import Observations
from .result import Fit

# A part turns by 15° or more, as a rule: the lever is within four times of how far it is from the middle.
_TIMES = 4.0


def length_scale(observations: Observations) -> float:
    """Return the unit: four times how far relative positions are from their middle, by the median; or 1."""
    positions = observations.relative[:, :3, 3]
    off = np.linalg.norm(positions - np.median(positions, axis=0), axis=1)
    return max(1.0, _TIMES * float(np.median(off)))


def in_units(observations: Observations, unit: float) -> Observations:
    """Return observations with lengths in a unit."""
    if unit == 1.0:
        return observations
    scale = np.array([1.0 / unit] * 3 + [1.0] * 3)
    by = np.outer(scale, scale)
    of_parent = None if observations.parent_covariance is None else observations.parent_covariance * by
    of_child = observations.child_covariance * by[: observations.rows, : observations.rows]
    return Observations(
        _placed(observations.parent, 1.0 / unit), _placed(observations.child, 1.0 / unit), of_parent, of_child
    )


def log_density(count: int, unit: float) -> float:
    """Return what the logarithm of a density of so many poses, given a mean pose, has to be changed by."""
    return 3.0 * (1 - count) * math.log(unit)


def in_metres(fit: Fit, unit: float) -> Fit:
    """Return a fit in units with the lengths that the observations had."""
    if unit == 1.0:
        return fit
    residuals = fit.residuals.copy()
    residuals[:, :3] *= unit
    motion = fit.motion
    if isinstance(motion, FamilyMotion):
        return replace(fit, residuals=residuals, motion=replace(motion, unit=motion.unit / unit))
    if not isinstance(motion, GroupMotion):
        return replace(fit, residuals=residuals)
    scale = np.array([unit if _is_length(name) else 1.0 for name in fit.coordinates])
    slides = np.array([unit if j < WX else 1.0 for j in motion.parametrisation.joints])
    motion = replace(
        motion,
        left=_placed(motion.left, unit),
        right=_placed(motion.right, unit),
        pitch=unit * motion.pitch,
    )
    return replace(
        fit,
        parameters=motion.named_parameters(),
        covariance=fit.covariance * np.outer(scale, scale),
        frame=motion.left,
        joint_values=fit.joint_values * slides,
        deviations=fit.deviations * slides,
        residuals=residuals,
        motion=motion,
    )


def _placed(poses: Array, factor: float) -> Array:
    result = poses.copy()
    result[..., :3, 3] *= factor
    return result


def _is_length(coordinate: str) -> bool:
    """Whether a coordinate of a joint is a length, or one per turn."""
    return coordinate == "pitch" or coordinate.rpartition(".")[0] == "point" or coordinate in _PLACES


_PLACES = ("child.x", "child.y", "child.z")
