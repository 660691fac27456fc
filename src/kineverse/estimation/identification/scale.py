"""Length scale of the data.

The priors assume levers within a unit of length and pitches within a tenth of it. They have to hold for a
crane as well as for a cupboard, and for poses in millimetres. So observations are scaled to a unit of their
own size, and fits are scaled back. All families share the unit, so their comparison does not depend on it.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from kineverse.lie import Array

from .curve import CurveMotion
from .custom_family import FamilyMotion
from .families import WX, GroupMotion
from .observations import Observations
from .result import Fit

# For rotations of 15° or more, the lever is within four times the median distance from the middle.
_TIMES = 4.0
# Standard deviation, in units of length, that is added to all stated ones: floating point cannot hold a noise
# that is smaller beside motions of the size of the unit.
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
    by = np.outer(scale, scale)
    rounding = np.diag([_ROUNDING**2] * 3 + [0.0] * 3)
    of_parent = observations.parent_covariance
    of_parent = None if of_parent is None else of_parent * by + rounding
    rows = observations.rows
    of_child = observations.child_covariance * by[:rows, :rows] + rounding[:rows, :rows]
    return Observations(
        _scale_positions(observations.parent, 1.0 / unit),
        _scale_positions(observations.child, 1.0 / unit),
        of_parent,
        of_child,
    )


def log_density(count: float, unit: float) -> float:
    """Return the log ratio of densities of ``count`` poses, given a mean pose, in metres and in units."""
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
    if isinstance(motion, CurveMotion):
        curve = motion.scaled(unit)
        return replace(
            fit,
            parameters=curve.named_parameters(),
            covariance=unit**2 * fit.covariance,
            joint_values=unit * fit.joint_values,
            deviations=unit * fit.deviations,
            residuals=residuals,
            motion=curve,
        )
    if not isinstance(motion, GroupMotion):
        return replace(fit, residuals=residuals)
    scale = np.array([unit if _is_length(name) else 1.0 for name in fit.coordinates])
    slides = np.array([unit if j < WX else 1.0 for j in motion.parametrisation.joints])
    motion = replace(
        motion,
        left=_scale_positions(motion.left, unit),
        right=_scale_positions(motion.right, unit),
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


def _scale_positions(poses: Array, factor: float) -> Array:
    result = poses.copy()
    result[..., :3, 3] *= factor
    return result


def _is_length(coordinate: str) -> bool:
    """Return True if a coordinate of a joint is a length, or a length per revolution."""
    return coordinate == "pitch" or coordinate.rpartition(".")[0] == "point" or coordinate in _PLACES


_PLACES = ("child.x", "child.y", "child.z")
