"""A solution and its evidence in words that people use."""

from __future__ import annotations

import math

import numpy as np

from .evidence import Evidence
from .fit import Fit
from .groups import GroupMotion
from .motion import Member
from .rigid import Array
from .sliding import of_child
from .solving import Solution

# A direction that is known no better than this is not known [rad].
_KNOWN = math.radians(20.0)


def fit_of(solution: Solution[Member], known: Evidence, log: float, probability: float) -> Fit:
    """Return the fit of a family."""
    motion, covariance, values, covariances = of_child(
        solution.motion, known.covariance.copy(), known.joint_values, known.joint_covariances
    )
    names = motion.coordinates()
    if "pitch" in names and isinstance(motion, GroupMotion):
        covariance[-1] *= math.tau  # [m/rad] to [m/revolution]
        covariance[:, -1] *= math.tau
    reason = _untested(solution) or _untold(names, covariance)
    return Fit(
        family=motion.name,
        probability=probability,
        log_evidence=log,
        parameters=motion.named(),
        covariance=covariance,
        coordinates=names,
        frame=motion.left if isinstance(motion, GroupMotion) else np.eye(4),
        joint_values=values,
        deviations=np.sqrt(np.einsum("nii->ni", covariances)),
        residuals=solution.residuals,
        told=not reason,
        reason=reason,
        rows=solution.residuals.shape[1],
        motion=motion,
    )


def _untested(solution: Solution[Member]) -> str:
    """Return that a family of joints could not but fit, as two positions always lie on a line."""
    motion, seen = solution.motion, solution.residuals.size
    if not isinstance(motion, GroupMotion) or not motion.size or not motion.joints:
        return ""
    unknown = motion.size + solution.values.size
    return (
        "" if unknown < seen else f"{seen} numbers were seen and it has {unknown} unknowns, so it always fits"
    )


def _untold(names: tuple[str, ...], covariance: Array) -> str:
    """Return what the data do not tell."""
    turns = [i for i, name in enumerate(names) if name.startswith("axis.")]
    if not turns:
        return ""
    worst = math.sqrt(float(np.linalg.eigvalsh(covariance[np.ix_(turns, turns)])[-1]))
    return "" if worst <= _KNOWN else f"its axis is known to {math.degrees(worst):.0f}° only"
