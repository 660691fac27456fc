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
from kineverse.lie import Stack

from .custom_family import Family, family_starts
from .gauge import fix_gauge
from .initial_guess import MotionStatistics, initial_guesses
from .maximum_likelihood import Scored
from .observations import Observations, check_observations
from .optimise import InitialGuess
from .outlier_rejection import RowIndices, find_inliers, log_inlier_prior
from .projection import complete_fit
from .result import Fit, IdentificationResult, LazyFit, build_fit
from .scale import in_metres, in_units, length_scale, log_density
from .solver import solver
from .unwrapping import log_unwrapping_gain, unwrap_screw, unwrap_solution

Families: TypeAlias = "Iterable[str | Family] | Mapping[str | Family, float] | str | Family | None"
"""Families by name or of one's own; a mapping says how probable they are beforehand."""

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
"""How probable families are beforehand, beside each other. What slides by nothing and turns is a ball in its
socket too, and a free one is rarer."""

UNKNOWN_NOISE = (0.005, math.radians(1.0))
"""What is scaled where no noise is stated: standard deviations of positions [m] and orientations [rad]."""

# What is less probable than the best by this, as a logarithm, is not refined. Where noise is large beside the
# motion and a lever bends it, what each observation says is not known better than this before.
_CHANCE, _CHANCE_EACH = 15.0, 0.5
# By what the unknown noise is multiplied, and how that is believed to be spread: a factor of 5 either way.
_SCALES = np.geomspace(0.01, 100.0, 33)
_SCALE_SPREAD = math.log(5.0)


def identify(
    a: npt.ArrayLike | None,
    b: npt.ArrayLike,
    *,
    parent_covariance: npt.ArrayLike | None = None,
    child_covariance: npt.ArrayLike | None = None,
    families: Families = None,
    noise: npt.ArrayLike | None = None,
    outliers: Outliers | bool | None = None,
    ordered: bool = False,
) -> IdentificationResult:
    """Return how part b moves against part a, judged by poses of both that were observed with noise.

    Parameters
    ----------
    a
        Poses of the parent, (N, 4, 4), in any frame, such as a camera's; None if the parent is that frame.
    b
        Poses of the child in the same frame, (N, 4, 4), or only its positions, (N, 3) [m].
    covariance_a, covariance_b
        Covariances of their errors, (6, 6) for all or (N, 6, 6) for each, see
        :mod:`kineverse.estimation.noise`; (3, 3) or (N, 3, 3) for positions.
    families
        Which families are tried, all of :data:`WEIGHTS` if None; a mapping also says how probable they are
        beforehand.
    noise
        The covariance for whichever of both has none of its own. If there is none at all, the size of the
        noise is estimated, up to the ratio of 5 mm to 1°.
    outliers
        Whether some observations may be wrong altogether: True for the usual :class:`.Outliers`, of which as
        many may be wrong as are not quite half.
    ordered
        Whether observations are in the order in which they were seen, with less than half a turn from one to
        the next: then turns are counted, see :mod:`.turning`.

    Raises
    ------
    ShapeError, InvalidValueError
        For poses or covariances that are none, see :func:`.observations.check_observations`.
    UnknownNameError
        For a family that does not exist.
    """
    weights = family_weights(families)
    of_a, of_b, stated = resolve_noise(a is not None, parent_covariance, child_covariance, noise)
    seen = check_observations(a, b, of_a, of_b)
    sight = prepare_data(seen, stated, as_outliers(outliers), ordered)
    return weigh_families(sight, solve_with_inliers(sight, weights), weights)


def resolve_noise(
    has_parent: bool,
    parent_covariance: npt.ArrayLike | None,
    child_covariance: npt.ArrayLike | None,
    noise: npt.ArrayLike | None,
) -> tuple[npt.ArrayLike, npt.ArrayLike, bool]:
    """Return the covariances of parent and child, and whether they were stated at all.

    Raises
    ------
    InvalidValueError
        If only one of them is.
    """
    if noise is not None or (
        child_covariance is not None and (parent_covariance is not None or not has_parent)
    ):
        missing: npt.ArrayLike = np.eye(6) if noise is None else noise
        of_a, of_b = (missing if c is None else c for c in (parent_covariance, child_covariance))
        return of_a, of_b, True
    if parent_covariance is not None or child_covariance is not None:
        raise InvalidValueError(
            "One part has a covariance and the other has none. Give both, or the same for both as noise."
        )
    unknown = pose_covariance(*UNKNOWN_NOISE)
    return unknown, unknown, False


def family_weights(families: Families) -> dict[str | Family, float]:
    """Return the families that are tried and how probable they are beforehand.

    Raises
    ------
    UnknownNameError
        For a family that does not exist.
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
    """What was seen, as families are compared by it.

    Attributes
    ----------
    seen
        The observations, with lengths in the unit.
    unit
        See :mod:`.lengths` [m].
    stated
        Whether the size of the noise is known.
    outliers
        How often observations are wrong, and where they are then, with lengths in the unit; None if never.
    ordered
        Whether they are in the order in which they were seen.
    """

    seen: Observations
    unit: float
    stated: bool
    outliers: Outliers | None
    ordered: bool


@dataclass(frozen=True)
class FamilySolution:
    """What a family makes of what was seen.

    Attributes
    ----------
    known
        Its solution by the observations that are right, and how probable these are then.
    right, count
        Their numbers, and the number of all.
    log_belief
        What is added to the logarithm of the evidence: the probability that these are right, the density of
        the others, and that turns were counted.
    """

    known: Scored
    right: RowIndices
    count: int
    log_belief: float


def prepare_data(
    seen: Observations, stated: bool, outliers: Outliers | None, ordered: bool, unit: float | None = None
) -> IdentificationData:
    """Return observations in a unit of length [m]; the ordinary one of these if None."""
    unit = length_scale(seen) if unit is None else unit
    if outliers is not None and outliers != Outliers():
        outliers = replace(outliers, reach=outliers.reach / unit)
    return IdentificationData(in_units(seen, unit), unit, stated, outliers, ordered)


def solve_with_inliers(
    sight: IdentificationData, weights: Mapping[str | Family, float]
) -> dict[str | Family, FamilySolution]:
    """Return what all families make of what was seen."""
    seen, unit, count = sight.seen, sight.unit, len(sight.seen)
    found = solve_families(seen, weights, unit)
    right = dict.fromkeys(found, np.arange(count))
    if sight.outliers is not None:

        def by(some: Observations, name: str | Family) -> Scored:
            return solve_families(some, [name], unit)[name]

        right = find_inliers(seen, found, sight.outliers, sight.stated, by)
        some = {name: rows for name, rows in right.items() if len(rows) < count}
        found |= {name: by(seen.at(rows), name) for name, rows in some.items()}
    if sight.ordered:
        found = {name: _counted(seen.at(right[name]), known) for name, known in found.items()}
    return score_solutions(sight, found, right, weights)


def score_solutions(
    sight: IdentificationData,
    found: Mapping[str | Family, Scored],
    right: Mapping[str | Family, RowIndices],
    weights: Mapping[str | Family, float],
) -> dict[str | Family, FamilySolution]:
    """Return what families make of what was seen, from what was found by what is right."""
    seen, outliers, count = sight.seen, sight.outliers, len(sight.seen)
    by = {name: seen if len(rows) == count else seen.at(rows) for name, rows in right.items()}
    beliefs = dict.fromkeys(found, 0.0)
    if outliers is not None:
        beliefs = {name: log_inlier_prior(outliers, count, len(some), seen.rows) for name, some in by.items()}
    if sight.ordered:
        beliefs = {name: beliefs[name] + log_unwrapping_gain(known.solution) for name, known in found.items()}
    known = compare_families(by, found, {name: math.log(weights[name]) + beliefs[name] for name in found})
    return {name: FamilySolution(one, right[name], count, beliefs[name]) for name, one in known.items()}


def _counted(seen: Observations, known: Scored) -> Scored:
    """Return what was found, a screw as one that goes round as often as the observations do."""
    start = unwrap_screw(seen, known.solution)
    return known if start is None else solver.likeliest(seen, [start])


def solve_families(
    seen: Observations, families: Iterable[str | Family], unit: float = 1.0
) -> dict[str | Family, Scored]:
    """Return the most likely member of each family, for observations in a unit of length [m]."""
    solver.prepare()
    overview = MotionStatistics(seen)
    return {name: solver.likeliest(seen, _starts(seen, name, overview, unit)) for name in families}


def _starts(
    seen: Observations, family: str | Family, overview: MotionStatistics, unit: float
) -> list[InitialGuess]:
    if isinstance(family, Family):
        return [InitialGuess(motion, values) for motion, values in family_starts(family, seen, unit)]
    return list(initial_guesses(family, overview))


def compare_families(
    seen: Mapping[str | Family, Observations],
    found: Mapping[str | Family, Scored],
    beliefs: Mapping[str | Family, float],
) -> dict[str | Family, Scored]:
    """Return what was found, and with joint values integrated out what has a chance.

    Each family is by observations of its own, and has a belief beforehand, as a logarithm.
    """
    logs = {name: known.log_evidence + beliefs[name] for name, known in found.items()}
    least = max(logs.values()) - _CHANCE - _CHANCE_EACH * max(len(some) for some in seen.values())
    rough = [name for name, known in found.items() if logs[name] >= least and _is_rough(known)]
    return {**found, **{name: solver.refined(seen[name], found[name].solution) for name in rough}}


def _is_rough(known: Scored) -> bool:
    """Return whether there are joint values to be integrated out, and they are not."""
    solution = known.solution
    return bool(solution.motion.joints and solution.motion.size) and not solution.belief.marginal


def weigh_families(
    sight: IdentificationData,
    found: Mapping[str | Family, FamilySolution],
    weights: Mapping[str | Family, float],
) -> IdentificationResult:
    """Return the fits of all families, weighed by their evidence."""
    beforehand = {name: math.log(weights[name]) + one.log_belief for name, one in found.items()}
    if sight.stated:
        logs = {name: one.known.log_evidence for name, one in found.items()}
        scale = 1.0
    else:
        spread = -0.5 * (np.log(_SCALES) / _SCALE_SPREAD) ** 2
        spread -= np.logaddexp.reduce(spread)
        joint = {
            name: spread + solver.log_evidences(one.known.solution, _SCALES) for name, one in found.items()
        }
        logs = {name: float(np.logaddexp.reduce(j)) for name, j in joint.items()}
        best = max(logs, key=lambda name: logs[name] + beforehand[name])
        scale = float(_SCALES[int(np.argmax(joint[best]))])
    total: Stack = np.array([logs[name] + beforehand[name] for name in found])
    probabilities = np.exp(total - np.logaddexp.reduce(total)).tolist()
    offers = []
    for (name, one), p in zip(found.items(), probabilities, strict=True):
        log = logs[name] + one.log_belief + log_density(len(sight.seen), sight.unit)
        offers.append(LazyFit(one.known.solution.motion.name, p, partial(_fit, sight, one, scale, log, p)))
    return IdentificationResult(tuple(sorted(offers, key=lambda offer: -offer.probability)), scale)


def _fit(
    sight: IdentificationData, one: FamilySolution, scale: float, log_evidence: float, probability: float
) -> Fit:
    solution = fix_gauge(unwrap_solution(one.known.solution) if sight.ordered else one.known.solution)
    fit = build_fit(solution, solver.evidence(solution, scale), log_evidence, probability)
    return in_metres(complete_fit(fit, sight.seen, one.right, scale, ordered=sight.ordered), sight.unit)
