"""Pairwise fits of parts and their log-odds."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from kineverse.errors import InvalidValueError
from kineverse.estimation.identification.curve import CURVE
from kineverse.estimation.identification.families import Family
from kineverse.estimation.identification.joint_identification import family_weights
from kineverse.estimation.identification.model_check import without_curve
from kineverse.estimation.identification.model_selection import (
    prepare_data,
    solve_with_inliers,
    weigh_families,
)
from kineverse.estimation.identification.observations import Observations, PoseTrack, pair_tracks
from kineverse.estimation.identification.result import Fit, IdentificationResult
from kineverse.estimation.linear_algebra import squared_errors
from kineverse.estimation.noise import Outliers
from kineverse.lie import Array, skew

FamilyChoice = Iterable[str] | Mapping[str, float] | None

_LOG_ROTATION = -math.log(8.0 * math.pi**2)

LOG_ANYWHERE = _LOG_ROTATION - 3.0 * math.log(2.0)
"""Log density of a uniform pose within 2 m [1/m³]. The volume of all rotations is 8π²."""

# Log density of a uniform position within a room of 10 m.
_LOG_ROOM = -3.0 * math.log(10.0)
_TINY = 1e-300

SURPRISE_DEVIATIONS = 4.0  # largest deviation of χ² from its mean that noise explains, in standard deviations


@dataclass(frozen=True)
class PartPair:
    """Joint identified between two parts that were observed together."""

    parent: str
    child: str
    result: IdentificationResult
    times: npt.NDArray[np.int_]  # indices of the observations of both parts
    gain: float  # log evidence of a connection against none
    is_consistent: bool  # True if the residuals are as large as the noise

    @property
    def log_odds_rigid(self) -> float:
        """Log odds of one rigid body against the most probable other family."""
        probabilities = self.result.probabilities
        rigid = probabilities.pop("rigid", 0.0)
        return math.log(max(rigid, _TINY)) - math.log(max(max(probabilities.values(), default=0.0), _TINY))


def identify_pair(
    tracks: Mapping[str, PoseTrack], parent: str, child: str, families: FamilyChoice
) -> PartPair | None:
    """Identify the joint between two parts, a point as the child; None without two common observations."""
    if tracks[parent].is_point:
        parent, child = child, parent
    a, b = tracks[parent], tracks[child]
    if a.is_point:
        return None
    times = np.flatnonzero(a.observed & b.observed)
    if len(times) < 2:
        return None
    observations = pair_tracks(a, b, times)
    result = identify_observations(observations, families)
    weights = {str(getattr(f, "name", f)): w for f, w in _joint_weights(families).items()}
    best = result.best
    log = best.log_evidence + math.log(weights[best.family] / best.probability / sum(weights.values()))
    relative, of_child = _relative_covariances(observations, best)
    squares = float(squared_errors(best.residuals, relative).sum())
    expected = max(best.residuals.size - best.joint_values.size - len(best.covariance), 1)
    explained = abs(squares - expected) < SURPRISE_DEVIATIONS * math.sqrt(2.0 * expected)
    if explained:
        # The realised size of the noise must not favour another connection.
        log += 0.5 * (squares - expected)
    if a.covariances is not None:
        # The noise of the parent must not favour a connection to the world, which is exact.
        log += _log_volume(relative, best) - _log_volume(of_child, best)
    rotation = 0.0 if b.is_point else _LOG_ROTATION
    log += LOG_ANYWHERE - _LOG_ROTATION + rotation - len(times) * (_LOG_ROOM + rotation)
    return PartPair(parent, child, result, times, log, explained)


def _relative_covariances(observations: Observations, fit: Fit) -> tuple[Array, Array]:
    """Return the covariances of observed relative and of child's poses, in the parent's axes, (N, m, m)."""
    rows, turn = observations.rows, np.zeros((len(observations), 6, 6))
    turn[:, :3, :3] = turn[:, 3:, 3:] = np.swapaxes(observations.parent[:, :3, :3], 1, 2)
    of_child = turn[:, :rows, :rows]
    child = of_child @ observations.child_covariance @ np.swapaxes(of_child, 1, 2)
    if observations.parent_covariance is None:
        return child, child
    lever = np.tile(np.eye(6), (len(observations), 1, 1))
    lever[:, :3, 3:] = -skew(fit.poses[:, :3, 3])
    carried = lever[:, :rows] @ turn
    return child + carried @ observations.parent_covariance @ np.swapaxes(carried, 1, 2), child


def _log_volume(covariance: Array, fit: Fit) -> float:
    """Return the log volume of the noise across a motion, ½ log |S| |Jᵀ S⁻¹ J|, up to a constant."""
    by_joints = fit.motion.linearise(fit.joint_values).by_joints
    along = np.swapaxes(by_joints, 1, 2) @ np.linalg.solve(covariance, by_joints)
    return 0.5 * float(np.sum(np.linalg.slogdet(covariance)[1] + np.linalg.slogdet(along)[1]))


def identify_observations(
    observations: Observations, families: FamilyChoice, outliers: Outliers | None = None
) -> IdentificationResult:
    """Identify the joint between two parts by its evidence under one stated noise, without a check."""
    if observations.parent_covariance is None:
        identities = np.tile(np.eye(4), (len(observations), 1, 1))
        observations = Observations(identities, observations.relative, None, observations.child_covariance)
    weights = _joint_weights(families)
    data = prepare_data(observations, True, outliers, False)
    return weigh_families(data, solve_with_inliers(data, weights), weights)


def _joint_weights(families: FamilyChoice) -> dict[str | Family, float]:
    weights = family_weights(families)
    if families is not None and CURVE in weights:
        raise InvalidValueError(
            f"Pairs of parts are compared by their joints, and {CURVE!r} is none. kv.estimation.identify "
            "takes it for a single pair."
        )
    return without_curve(weights)
