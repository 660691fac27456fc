"""A solution and its evidence in words that people use."""

from __future__ import annotations

import math

import numpy as np

from .evidence import Evidence
from .fit import Fit
from .groups import WX, GroupMotion
from .rigid import Array
from .solving import Solution

# A direction that is known no better than this is not known [rad].
_KNOWN = math.radians(20.0)


def fit_of(solution: Solution[GroupMotion], known: Evidence, log: float, probability: float) -> Fit:
    """Return the fit of a family."""
    motion = solution.motion
    names = coordinates(motion)
    covariance = known.covariance.copy()
    if motion.group.pitch:
        covariance[-1] *= math.tau
        covariance[:, -1] *= math.tau
    reason = _untold(names, covariance)
    return Fit(
        family=motion.group.name,
        probability=probability,
        log_evidence=log,
        parameters=parameters(motion),
        covariance=covariance,
        coordinates=names,
        frame=motion.left,
        joint_values=known.joint_values,
        deviations=np.sqrt(np.einsum("nii->ni", known.joint_covariances)),
        residuals=solution.residuals,
        told=not reason,
        reason=reason,
        motion=motion,
    )


def _untold(names: tuple[str, ...], covariance: Array) -> str:
    """Return what the data do not tell."""
    turns = [i for i, name in enumerate(names) if name.startswith("axis.")]
    if not turns:
        return ""
    worst = math.sqrt(float(np.linalg.eigvalsh(covariance[np.ix_(turns, turns)])[-1]))
    return "" if worst <= _KNOWN else f"its axis is known to {math.degrees(worst):.0f}° only"


def parameters(motion: GroupMotion) -> dict[str, Array | float]:
    """Return what a member of a family is, by name."""
    name = motion.group.name
    result: dict[str, Array | float] = {}
    axis, point = motion.left[:3, 2].copy(), motion.left[:3, 3].copy()
    if name == "planar":
        result["normal"] = axis
    elif name == "spherical":
        result["centre"] = point
    elif name not in ("rigid", "free"):
        result["axis"] = axis
        if name != "prismatic":
            result["point"] = point
    if motion.group.pitch:
        result["pitch"] = math.tau * motion.pitch
    result["reference"] = motion.left @ motion.right
    return result


def coordinates(motion: GroupMotion) -> tuple[str, ...]:
    """Return the names of the parameters, in their order."""
    letters = "xyz"
    left = [f"point.{letters[j]}" if j < WX else f"axis.{letters[j - WX]}" for j in motion.freedom.left]
    right = [f"child.{letters[j]}" if j < WX else f"child.r{letters[j - WX]}" for j in motion.freedom.right]
    return (*left, *right, *(["pitch"] if motion.group.pitch else []))
