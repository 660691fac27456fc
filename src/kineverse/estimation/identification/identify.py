"""Identification of the joint between two parts."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from kineverse.errors import InvalidValueError, UnknownNameError, suggest
from kineverse.estimation.noise import pose_covariance
from kineverse.estimation.robust import Outliers, as_outliers
from kineverse.lie import Array

from .custom_family import Family, family_starts
from .gauge import fix_gauge
from .initial_guess import MotionStatistics, initial_guesses
from .maximum_likelihood import Scored
from .observations import Observations, check_observations
from .optimise import InitialGuess
from .outlier_rejection import RowIndices, find_inliers, log_inlier_prior
from .projection import complete_fit
from .result import Fit, IdentificationResult, LazyFit, build_fit
from .scale import convert_to_metres, convert_to_unit, length_scale, log_density
from .solver import solver
from .unwrapping import log_unwrapping_gain, unwrap_screw, unwrap_solution

Families: TypeAlias = "Iterable[str | Family] | Mapping[str | Family, float] | str | Family | None"
"""Names of families, or custom families. A mapping assigns prior weights."""

WEIGHTS: Mapping[str, float] = MappingProxyType(
    {
        "rigid": 1.0,
        "prismatic": 1.0,
        "revolute": 1.0,
        "screw": 0.01,
        "cylindrical": 0.01,
        "spherical": 0.01,
        "planar": 0.01,
        "free": 0.0001,
    }
)
"""Prior weights of the families. A screw, cylindrical, spherical or planar joint contains simpler joints as
special cases and is rarer; a free one is rarer still."""

UNKNOWN_NOISE = (0.005, math.radians(1.0))
"""Standard deviations of positions [m] and orientations [rad] that are scaled where no noise is stated."""

# A family is not refined if its log evidence is below that of the best by more than a constant and a term for
# each observation. With noise that is large beside the motion, the unrefined evidence is this inaccurate.
_NEGLIGIBLE, _NEGLIGIBLE_EACH = 15.0, 0.5
# Candidate scales of the unknown noise, and the standard deviation of their log-normal prior: a factor of 5.
_SCALES = np.geomspace(0.01, 100.0, 33)
_SCALE_SPREAD = math.log(5.0)


def identify(
    parent_poses: npt.ArrayLike | None,
    child_poses: npt.ArrayLike,
    *,
    parent_covariance: npt.ArrayLike | None = None,
    child_covariance: npt.ArrayLike | None = None,
    families: Families = None,
    noise: npt.ArrayLike | None = None,
    outliers: Outliers | bool | None = None,
    sequential: bool = False,
    correlation_time: float = 1.0,
) -> IdentificationResult:
    """Identify the joint between a parent and a child from noisy poses of both.

    Parameters
    ----------
    parent_poses
        Poses of the parent, (N, 4, 4), in any common frame, such as a camera's. None if the parent is that
        frame.
    child_poses
        Poses of the child in the same frame, (N, 4, 4), or only its positions, (N, 3) [m].
    parent_covariance, child_covariance
        Covariances of their errors, one (6, 6) or one for each pose (N, 6, 6), see
        :mod:`kineverse.estimation.noise`. For positions (3, 3) or (N, 3, 3).
    families
        Families to compare; None for all of :data:`WEIGHTS`. A mapping also assigns prior weights.
    noise
        Covariance of the parts that have none of their own. If no covariance is given at all, the size of
        the noise is estimated, at a ratio of 5 mm to 1°.
    outliers
        Outlier model, or True for the default :class:`.Outliers`. Fewer than half of the observations may be
        outliers.
    sequential
        True if the observations are in temporal order, with less than half a revolution from one to the
        next. Revolutions are counted then, see :mod:`.unwrapping`.
    correlation_time
        Number of observations τ that are worth one independent observation. The log likelihood is divided
        by it, and the covariances of parameters are multiplied by it. 1 stands for independent errors.

    Returns
    -------
    result
        A fit of every family, the most probable first.

    Raises
    ------
    ShapeError, InvalidValueError
        For invalid poses or covariances, see :func:`.observations.check_observations`.
    UnknownNameError
        For an unknown family.
    """
    weights = family_weights(families)
    parent_covariance, child_covariance, stated = resolve_noise(
        parent_poses is not None, parent_covariance, child_covariance, noise
    )
    observations = check_observations(parent_poses, child_poses, parent_covariance, child_covariance)
    if not 1.0 <= correlation_time < math.inf:
        raise InvalidValueError(
            f"The correlation time is a number of observations, at least 1, not {correlation_time!r}."
        )
    data = prepare_data(
        observations, stated, as_outliers(outliers), sequential, observation_weight=1.0 / correlation_time
    )
    return weigh_families(data, solve_with_inliers(data, weights), weights)


def resolve_noise(
    has_parent: bool,
    parent_covariance: npt.ArrayLike | None,
    child_covariance: npt.ArrayLike | None,
    noise: npt.ArrayLike | None,
) -> tuple[npt.ArrayLike, npt.ArrayLike, bool]:
    """Return the covariances of parent and child, and True if they were stated.

    Raises
    ------
    InvalidValueError
        If only one of the two is stated.
    """
    if noise is not None or (
        child_covariance is not None and (parent_covariance is not None or not has_parent)
    ):
        missing: npt.ArrayLike = np.eye(6) if noise is None else noise
        parent, child = (missing if c is None else c for c in (parent_covariance, child_covariance))
        return parent, child, True
    if parent_covariance is not None or child_covariance is not None:
        raise InvalidValueError(
            "One part has a covariance and the other has none. Give both, or the same for both as noise."
        )
    unknown = pose_covariance(*UNKNOWN_NOISE)
    return unknown, unknown, False


def family_weights(families: Families) -> dict[str | Family, float]:
    """Return the families to compare and their prior weights.

    Raises
    ------
    UnknownNameError
        For an unknown family.
    InvalidValueError
        For a weight that is not positive, or if there is no family.
    """
    if families is None:
        families = WEIGHTS
    elif isinstance(families, (str, Family)):
        families = [families]
    given = dict(families) if isinstance(families, Mapping) else dict.fromkeys(families)
    if not given:
        raise InvalidValueError("There is no family to try.")
    for name, weight in given.items():
        if isinstance(name, str) and name not in WEIGHTS:
            raise UnknownNameError(f"There is no family {name!r}. {suggest(str(name), WEIGHTS, 'family')}")
        if weight is not None and not (math.isfinite(weight) and weight > 0.0):
            raise InvalidValueError(f"The weight of the family {name!r} is positive, not {weight!r}.")
    result: dict[str | Family, float] = {}
    for name, weight in given.items():
        usual = name.weight if isinstance(name, Family) else WEIGHTS[name]
        result[name] = usual if weight is None else float(weight)
    return result


@dataclass(frozen=True)
class IdentificationData:
    """Observations and the assumptions under which families are compared.

    Attributes
    ----------
    observations
        The observations, with lengths in the unit.
    unit
        The length scale [m], see :mod:`.scale`.
    stated
        True if the size of the noise is known.
    outliers
        Outlier model, with lengths in the unit; None if all observations are inliers.
    sequential
        True if the observations are in temporal order.
    observation_weight
        Factor on the log likelihood of each observation, below 1 for correlated errors.
    """

    observations: Observations
    unit: float
    stated: bool
    outliers: Outliers | None
    sequential: bool
    observation_weight: float = 1.0


@dataclass(frozen=True)
class FamilySolution:
    """Solution of a family by its inliers.

    Attributes
    ----------
    scored
        The solution and the logarithm of its evidence.
    inliers
        Indices of the inliers.
    count
        Number of all observations.
    log_prior
        Sum of the log probability of these inliers, the log density of the outliers, and the gain by counted
        revolutions. It is added to the log evidence.
    """

    scored: Scored
    inliers: RowIndices
    count: int
    log_prior: float


def prepare_data(
    observations: Observations,
    stated: bool,
    outliers: Outliers | None,
    sequential: bool,
    unit: float | None = None,
    observation_weight: float = 1.0,
) -> IdentificationData:
    """Return observations in a unit of length [m], by default their own length scale."""
    unit = length_scale(observations) if unit is None else unit
    if outliers is not None and outliers != Outliers():
        outliers = replace(outliers, reach=outliers.reach / unit)
    scaled = convert_to_unit(observations, unit)
    return IdentificationData(scaled, unit, stated, outliers, sequential, observation_weight)


def solve_with_inliers(
    data: IdentificationData, weights: Mapping[str | Family, float]
) -> dict[str | Family, FamilySolution]:
    """Return the solution of each family by its inliers."""
    observations, unit, count = data.observations, data.unit, len(data.observations)
    solutions = solve_families(observations, weights, unit)
    inliers = dict.fromkeys(solutions, np.arange(count))
    if data.outliers is not None:

        def solve(some: Observations, name: str | Family) -> Scored:
            return solve_families(some, [name], unit)[name]

        inliers = find_inliers(observations, solutions, data.outliers, data.stated, solve)
        some = {name: rows for name, rows in inliers.items() if len(rows) < count}
        solutions |= {name: solve(observations.select(rows), name) for name, rows in some.items()}
    if data.sequential:
        solutions = {
            name: _unwrap(observations.select(inliers[name]), scored) for name, scored in solutions.items()
        }
    return score_solutions(data, solutions, inliers, weights)


def score_solutions(
    data: IdentificationData,
    solutions: Mapping[str | Family, Scored],
    inliers: Mapping[str | Family, RowIndices],
    weights: Mapping[str | Family, float],
) -> dict[str | Family, FamilySolution]:
    """Return the solutions of families, scored against each other, from solutions of their inliers."""
    observations, outliers, count = data.observations, data.outliers, len(data.observations)
    observations_of = {
        name: observations if len(rows) == count else observations.select(rows)
        for name, rows in inliers.items()
    }
    log_priors = dict.fromkeys(solutions, 0.0)
    if outliers is not None:
        log_priors = {
            name: log_inlier_prior(outliers, count, len(some), observations.rows)
            for name, some in observations_of.items()
        }
    if data.sequential:
        log_priors = {
            name: log_priors[name] + log_unwrapping_gain(scored.solution)
            for name, scored in solutions.items()
        }
    # The threshold is on evidence in which each observation has its weight.
    logs = {name: math.log(weights[name]) / data.observation_weight + log_priors[name] for name in solutions}
    compared = compare_families(observations_of, solutions, logs, data.observation_weight)
    return {
        name: FamilySolution(one, inliers[name], count, log_priors[name]) for name, one in compared.items()
    }


def _unwrap(observations: Observations, scored: Scored) -> Scored:
    """Return the solution; a screw is solved again with the revolutions of the observations."""
    start = unwrap_screw(observations, scored.solution)
    return scored if start is None else solver.maximum_likelihood(observations, [start])


def solve_families(
    observations: Observations, families: Iterable[str | Family], unit: float = 1.0
) -> dict[str | Family, Scored]:
    """Return the most likely member of each family, for observations in a unit of length [m]."""
    solver.prepare()
    statistics = MotionStatistics(observations)
    return {
        name: solver.maximum_likelihood(observations, _starts(observations, name, statistics, unit))
        for name in families
    }


def _starts(
    observations: Observations, family: str | Family, statistics: MotionStatistics, unit: float
) -> list[InitialGuess]:
    if isinstance(family, Family):
        return [InitialGuess(motion, values) for motion, values in family_starts(family, observations, unit)]
    return list(initial_guesses(family, statistics))


def compare_families(
    observations: Mapping[str | Family, Observations],
    solutions: Mapping[str | Family, Scored],
    log_priors: Mapping[str | Family, float],
    observation_weight: float = 1.0,
) -> dict[str | Family, Scored]:
    """Return the solutions, those of competitive families with their joint values integrated out.

    Each family has its own observations and a log prior.
    """
    logs = {name: scored.log_evidence + log_priors[name] for name, scored in solutions.items()}
    threshold = (
        max(logs.values())
        - _NEGLIGIBLE / observation_weight
        - _NEGLIGIBLE_EACH * max(len(some) for some in observations.values())
    )
    rough = [name for name, scored in solutions.items() if logs[name] >= threshold and _is_rough(scored)]
    return {
        **solutions,
        **{
            name: solver.maximise_marginal_likelihood(observations[name], solutions[name].solution)
            for name in rough
        },
    }


def _is_rough(scored: Scored) -> bool:
    """Return True if there are joint values that are not integrated out yet."""
    solution = scored.solution
    return bool(solution.motion.joints and solution.motion.size) and not solution.joint_prior.marginal


def weigh_families(
    data: IdentificationData,
    solutions: Mapping[str | Family, FamilySolution],
    weights: Mapping[str | Family, float],
) -> IdentificationResult:
    """Return the fits of all families with their posterior probabilities."""
    weight = data.observation_weight
    log_priors = {name: math.log(weights[name]) + weight * one.log_prior for name, one in solutions.items()}
    if data.stated:
        logs = {name: _weighted_log_evidence(one.scored, weight) for name, one in solutions.items()}
        scale = 1.0
    else:
        spread = -0.5 * (np.log(_SCALES) / _SCALE_SPREAD) ** 2
        spread -= np.logaddexp.reduce(spread)
        joint = {
            name: spread + solver.log_evidences(one.scored.solution, _SCALES, weight)
            for name, one in solutions.items()
        }
        logs = {name: float(np.logaddexp.reduce(j)) for name, j in joint.items()}
        best = max(logs, key=lambda name: logs[name] + log_priors[name])
        scale = float(_SCALES[int(np.argmax(joint[best]))])
    total: Array = np.array([logs[name] + log_priors[name] for name in solutions])
    probabilities = np.exp(total - np.logaddexp.reduce(total)).tolist()
    lazy_fits = []
    for (name, one), p in zip(solutions.items(), probabilities, strict=True):
        log = logs[name] + weight * one.log_prior + log_density(weight * len(data.observations), data.unit)
        lazy_fits.append(LazyFit(one.scored.solution.motion.name, p, partial(_fit, data, one, scale, log, p)))
    return IdentificationResult(tuple(sorted(lazy_fits, key=lambda lazy_fit: -lazy_fit.probability)), scale)


def _weighted_log_evidence(scored: Scored, weight: float) -> float:
    """Return the log evidence if each observation's log likelihood counts with a weight."""
    if weight == 1.0:
        return scored.log_evidence
    predicted, weighted = (solver.log_evidences(scored.solution, np.ones(1), w)[0] for w in (1.0, weight))
    # Steps that did not converge reach less than the quadratic approximation predicts.
    return float(weighted + weight * (scored.log_evidence - predicted))


def _fit(
    data: IdentificationData, one: FamilySolution, scale: float, log_evidence: float, probability: float
) -> Fit:
    solution = fix_gauge(unwrap_solution(one.scored.solution) if data.sequential else one.scored.solution)
    fit = build_fit(
        solution, solver.evidence(solution, scale, data.observation_weight), log_evidence, probability
    )
    return convert_to_metres(
        complete_fit(fit, data.observations, one.inliers, scale, sequential=data.sequential), data.unit
    )
