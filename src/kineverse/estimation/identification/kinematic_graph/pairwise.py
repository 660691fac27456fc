"""Pairwise fits of parts and their log-odds."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import numpy.typing as npt

from kineverse.estimation.identification.identify import family_weights, identify
from kineverse.estimation.identification.observations import Observations, PoseTrack, pair_tracks
from kineverse.estimation.identification.result import Fit, IdentificationResult
from kineverse.estimation.robust import Outliers
from kineverse.lie import Array, skew

FamilyChoice = Iterable[str] | Mapping[str, float] | None

_LOG_TURNED = -math.log(8.0 * math.pi**2)

LOG_ANYWHERE = _LOG_TURNED - 3.0 * math.log(2.0)
"""Logarithm of the density of a pose of which nothing is known, within 2 m [1/m³]; all turns have 8π²."""

# That of a position by itself, somewhere in a room of 10 m.
_LOG_ROOM = -3.0 * math.log(10.0)
_TINY = 1e-300

SURPRISE_DEVIATIONS = 4.0
"""What is left is no noise if χ² is off by so many standard deviations."""


@dataclass(frozen=True)
class PartPair:
    """Two parts that were seen together.

    Attributes
    ----------
    parent, child
        Their names.
    found
        What was identified between them.
    times
        The numbers of the observations in which both were seen.
    gain
        By how much the logarithm of the density of what was seen is larger than if each pose of the child
        were anywhere in a room, all families taken together.
    explained
        Whether what is left is as large as the noise.
    """

    parent: str
    child: str
    result: IdentificationResult
    times: npt.NDArray[np.int_]
    gain: float
    is_consistent: bool

    @property
    def log_odds_rigid(self) -> float:
        """The logarithm of the odds of being one rigid body against the likeliest other family."""
        rigid = sum(fit.probability for fit in self.result if fit.family == "rigid")
        other = max((fit.probability for fit in self.result if fit.family != "rigid"), default=0.0)
        return math.log(max(rigid, _TINY)) - math.log(max(other, _TINY))


def identify_pair(
    tracks: Mapping[str, PoseTrack], parent: str, child: str, families: FamilyChoice
) -> PartPair | None:
    """Return what is between two parts; None if they were not seen together at least twice.

    What was seen as a point is the child, and between two points there is nothing to see.
    """
    if tracks[parent].is_point:
        parent, child = child, parent
    a, b = tracks[parent], tracks[child]
    if a.is_point:
        return None
    times = np.flatnonzero(a.seen & b.seen)
    if len(times) < 2:
        return None
    observations = pair_tracks(a, b, times)
    found = identify_observations(observations, families)
    weights = {str(getattr(f, "name", f)): w for f, w in family_weights(families).items()}
    best = found.best
    log = best.log_evidence + math.log(weights[best.family] / best.probability / sum(weights.values()))
    squares = squared_error(observations, best)
    expected = max(best.residuals.size - best.joint_values.size - len(best.covariance), 1)
    explained = abs(squares - expected) < SURPRISE_DEVIATIONS * math.sqrt(2.0 * expected)
    if explained:
        # How large the noise happened to be is no reason to hang on something else.
        log += 0.5 * (squares - expected)
    if a.covariances is not None:
        # A part on a joint is better known than it is seen: its noise is no reason to hang on the world.
        log += _log_volume(relative_covariance(observations, best), best) - _log_volume(
            child_covariance(observations), best
        )
    turned = 0.0 if b.is_point else _LOG_TURNED
    log += LOG_ANYWHERE - _LOG_TURNED + turned - len(times) * (_LOG_ROOM + turned)
    return PartPair(parent, child, found, times, log, explained)


def squared_error(observations: Observations, fit: Fit) -> float:
    """Return χ²: the squares of what a fit leaves, in units of its covariance."""
    weighted = np.linalg.solve(relative_covariance(observations, fit), fit.residuals[:, :, None])[:, :, 0]
    return float(np.sum(fit.residuals * weighted))


def relative_covariance(observations: Observations, fit: Fit) -> Array:
    """Return the covariances of observed relative poses, or positions, in the parent's axes, (N, m, m)."""
    covariance = child_covariance(observations)
    if observations.parent_covariance is not None:
        lever = np.tile(np.eye(6), (len(observations), 1, 1))
        lever[:, :3, 3:] = -skew(fit.poses[:, :3, 3])
        carried = lever[:, : observations.rows] @ _turned(observations, 6)
        covariance = covariance + carried @ observations.parent_covariance @ np.swapaxes(carried, 1, 2)
    return covariance


def child_covariance(observations: Observations) -> Array:
    """Return the covariances of the child's pose or position in the parent's axes, (N, m, m)."""
    turned = _turned(observations, observations.rows)
    covariance: Array = turned @ observations.child_covariance @ np.swapaxes(turned, 1, 2)
    return covariance


def _turned(observations: Observations, rows: int) -> Array:
    p_R_w = np.swapaxes(observations.parent[:, :3, :3], 1, 2)
    turned = np.zeros((len(p_R_w), 6, 6))
    turned[:, :3, :3] = turned[:, 3:, 3:] = p_R_w
    return turned[:, :rows, :rows]


def _log_volume(covariance: Array, fit: Fit) -> float:
    """Return the logarithm of the volume of noise across a motion, up to a constant: ½ log |S| |Jᵀ S⁻¹ J|."""
    by_joints = fit.motion.linearise(fit.joint_values).by_joints
    along = np.swapaxes(by_joints, 1, 2) @ np.linalg.solve(covariance, by_joints)
    return 0.5 * float(np.sum(np.linalg.slogdet(covariance)[1] + np.linalg.slogdet(along)[1]))


def identify_observations(
    observations: Observations, families: FamilyChoice, outliers: Outliers | None = None
) -> IdentificationResult:
    """Return what is between two parts that were seen."""
    exact = observations.parent_covariance is None
    child = observations.relative if exact else observations.child
    return identify(
        None if exact else observations.parent,
        child if observations.rows == 6 else child[:, :3, 3],
        parent_covariance=observations.parent_covariance,
        child_covariance=observations.child_covariance,
        families=families,
        outliers=outliers,
    )


def identify_pairs(
    tracks: Mapping[str, PoseTrack],
    families: FamilyChoice,
    progress: Callable[[int, int], object] | None,
) -> dict[frozenset[str], PartPair]:
    """Return what is between all parts, those that were seen together."""
    names = list(combinations(tracks, 2))
    found: dict[frozenset[str], PartPair] = {}
    for done, (a, b) in enumerate(names):
        if progress is not None:
            progress(done, len(names))
        if (known := identify_pair(tracks, a, b, families)) is not None:
            found[frozenset((a, b))] = known
    if progress is not None:
        progress(len(names), len(names))
    return found
