"""From poses of two parts to the model of what connects them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

from kineverse.errors import UnknownNameError, ValueRejectedError, suggest
from kineverse.estimation.noise import pose_covariance

from .canonical import canonical
from .evidence import Evidence, evidence
from .fit import Fit, Found
from .groups import WX, GroupMotion
from .native import solver
from .observations import Observations, observations
from .rigid import Array
from .solving import Solution
from .starts import Overview, starts

WEIGHTS: Mapping[str, float] = MappingProxyType(
    {
        "rigid": 1.0,
        "prismatic": 1.0,
        "revolute": 1.0,
        "screw": 0.05,
        "cylindrical": 0.05,
        "spherical": 0.1,
        "planar": 0.1,
        "free": 0.1,
    }
)
"""How probable families are beforehand, beside each other."""

_UNKNOWN_NOISE = (0.005, math.radians(1.0))
# By what the unknown noise is multiplied, and how that is believed to be spread: a factor of 5 either way.
_SCALES = np.geomspace(0.01, 100.0, 33)
_SCALE_SPREAD = math.log(5.0)
# A direction that is known no better than this is not known [rad].
_KNOWN = math.radians(20.0)


def identify(
    a: npt.ArrayLike | None,
    b: npt.ArrayLike,
    *,
    covariance_a: npt.ArrayLike | None = None,
    covariance_b: npt.ArrayLike | None = None,
    families: Iterable[str] | Mapping[str, float] | None = None,
    noise: npt.ArrayLike | None = None,
) -> Found:
    """Return how part b moves against part a, judged by poses of both that were observed with noise.

    Parameters
    ----------
    a
        Poses of the parent, (N, 4, 4), in any frame, such as a camera's; None if the parent is that frame
        itself.
    b
        Poses of the child in the same frame, (N, 4, 4), or only its positions, (N, 3) [m].
    covariance_a, covariance_b
        Covariances of their errors, (6, 6) for all or (N, 6, 6) for each, see
        :mod:`kineverse.estimation.noise`.
    families
        Which families are tried, all of :data:`WEIGHTS` if None; a mapping also says how probable they are
        beforehand.
    noise
        The covariance for whichever of both has none of its own. If there is none at all, the size of the
        noise is estimated, up to the ratio of 5 mm to 1°.

    Raises
    ------
    ShapeError, ValueRejectedError
        For poses or covariances that are none, see :func:`.observations.observations`.
    UnknownNameError
        For a family that does not exist.
    """
    weights = family_weights(families)
    stated = not (covariance_a is None and covariance_b is None and noise is None)
    if noise is None:
        if stated and (covariance_b is None or (a is not None and covariance_a is None)):
            raise ValueRejectedError(
                "One part has a covariance and the other has none. Give both, or the same for both as noise."
            )
        noise = pose_covariance(*_UNKNOWN_NOISE)
    seen = observations(
        a,
        b,
        noise if covariance_a is None else covariance_a,
        noise if covariance_b is None else covariance_b,
    )
    solver.prepare()
    overview = Overview(seen)
    solutions = {name: _best(seen, name, overview) for name in weights}
    return weighed(solutions, weights, stated)


def family_weights(families: Iterable[str] | Mapping[str, float] | None) -> dict[str, float]:
    """Return the families that are tried and how probable they are beforehand.

    Raises
    ------
    UnknownNameError
        For a family that does not exist.
    """
    if families is None:
        return dict(WEIGHTS)
    if isinstance(families, str):
        families = [families]
    for name in families:
        if name not in WEIGHTS:
            raise UnknownNameError(f"There is no family {name!r}. {suggest(str(name), WEIGHTS, 'family')}")
    if isinstance(families, Mapping):
        return {name: float(weight) for name, weight in families.items()}
    return {name: WEIGHTS[name] for name in families}


def _best(seen: Observations, name: str, overview: Overview) -> Solution[GroupMotion]:
    found = [solver.solve(seen, start.motion, start.values) for start in starts(name, overview)]
    best = min(found, key=lambda solution: solution.cost)
    return canonical(best)


def weighed(
    solutions: Mapping[str, Solution[GroupMotion]], weights: Mapping[str, float], stated: bool
) -> Found:
    """Return the fits of all families, weighed by their evidence."""
    if stated:
        evidences = {name: evidence(solution) for name, solution in solutions.items()}
        logs = {name: e.log_evidence for name, e in evidences.items()}
        scale = 1.0
    else:
        grid = {name: [evidence(s.scaled(c)) for c in _SCALES] for name, s in solutions.items()}
        beforehand = -0.5 * (np.log(_SCALES) / _SCALE_SPREAD) ** 2
        beforehand -= np.log(np.sum(np.exp(beforehand)))
        joint = {name: np.array([e.log_evidence for e in es]) + beforehand for name, es in grid.items()}
        logs = {name: float(np.logaddexp.reduce(j)) for name, j in joint.items()}
        best = max(logs, key=lambda name: logs[name] + math.log(weights[name]))
        top = int(np.argmax(joint[best]))
        scale = float(_SCALES[top])
        evidences = {name: es[top] for name, es in grid.items()}
    total = np.array([logs[name] + math.log(weights[name]) for name in logs])
    probabilities = np.exp(total - np.logaddexp.reduce(total))
    fits = [
        _fit(solutions[name], evidences[name], logs[name], float(p))
        for name, p in zip(logs, probabilities, strict=True)
    ]
    return Found(tuple(sorted(fits, key=lambda fit: -fit.probability)), scale)


def _fit(solution: Solution[GroupMotion], known: Evidence, log: float, probability: float) -> Fit:
    motion = solution.motion
    names = coordinates(motion)
    covariance = known.covariance.copy()
    if motion.group.pitch:
        covariance[-1] *= math.tau
        covariance[:, -1] *= math.tau
    reason = ""
    turns = [i for i, name in enumerate(names) if name.startswith("axis.")]
    if turns:
        worst = math.sqrt(float(np.linalg.eigvalsh(covariance[np.ix_(turns, turns)])[-1]))
        if worst > _KNOWN:
            reason = f"its axis is known to {math.degrees(min(worst, math.pi)):.0f}° only"
    deviations = np.sqrt(np.einsum("nii->ni", known.value_covariances))
    return Fit(
        family=motion.group.name,
        probability=probability,
        log_evidence=log,
        parameters=parameters(motion),
        covariance=covariance,
        coordinates=names,
        frame=motion.left,
        joint_values=solution.values,
        deviations=deviations,
        residuals=solution.residuals,
        told=not reason,
        reason=reason,
        motion=motion,
    )


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
