"""Identification of the joint between two parts."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from kineverse.errors import InvalidValueError, UnknownNameError, suggest
from kineverse.estimation.linear_algebra import singularity_named
from kineverse.estimation.noise import UNKNOWN_NOISE, Outliers, as_outliers, pose_covariance

from .curve import CURVE
from .families import Family
from .model_check import solve_joints, weigh_and_check
from .model_selection import prepare_data
from .observations import check_observations
from .result import IdentificationResult

Families: TypeAlias = "Iterable[str | Family] | Mapping[str | Family, float] | str | Family | None"
"""Names of families, or custom families. A mapping assigns prior weights."""

WEIGHTS: Mapping[str, float] = MappingProxyType(
    dict.fromkeys(("rigid", "prismatic", "revolute"), 1.0)
    | dict.fromkeys(("screw", "cylindrical", "spherical", "planar"), 0.01)
    | {"free": 0.0001, CURVE: 0.01}
)
"""Prior weights of the families. A screw, cylindrical, spherical or planar joint contains simpler joints as
special cases and is rarer, and so is a curve; a free joint is rarer still."""


@singularity_named()
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
        Covariances of their errors: one for each pose (N, 6, 6), or a common one (6, 6), also as its diagonal
        (6,) of variances, or as a pair (position, orientation) of standard deviations [m] and [rad], see
        :mod:`kineverse.estimation.noise`. For positions (N, 3, 3), (3, 3), (3,) or a pair.
    families
        Families to compare; None for all of :data:`WEIGHTS`. A mapping also assigns prior weights.
    noise
        Default covariance of both parts, such as ``(0.005, 0.02)``. Without any covariance, the sizes of
        position and orientation noise are unknown and integrated out, see :mod:`.noise_estimation`.
    outliers
        Outlier model, or True for the default :class:`.Outliers`. Fewer than half of the observations may be
        outliers.
    sequential
        True if the observations are in temporal order, with less than half a revolution from one to the
        next. Revolutions are counted then.
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

    Examples
    --------
    >>> hinge = kv.rotation_z(kv.position("q")) @ kv.translation(0.5, 0, 0)
    >>> poses = np.stack([hinge({"q": q}) for q in np.linspace(0, 1, 12)])
    >>> result = kv.estimation.identify(None, poses, noise=(0.001, 0.01))
    >>> result.best.family, result.best.parameters["axis"].round(3) + 0.0
    ('revolute', array([0., 0., 1.]))
    >>> model = kv.Model()
    >>> with model.edit() as edit:
    ...     edit.apply(result.best.operation("door", parent="world"))
    'joint door'
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
    weight = 1.0 / correlation_time
    data = prepare_data(observations, stated, as_outliers(outliers), sequential, observation_weight=weight)
    return weigh_and_check(data, solve_joints(data, weights), weights)


def resolve_noise(
    has_parent: bool,
    parent_covariance: npt.ArrayLike | None,
    child_covariance: npt.ArrayLike | None,
    noise: npt.ArrayLike | None,
) -> tuple[npt.ArrayLike, npt.ArrayLike, bool]:
    """Return the covariances of parent and child, and True if they were stated."""
    parent = noise if parent_covariance is None else parent_covariance
    child = noise if child_covariance is None else child_covariance
    if child is not None and (parent is not None or not has_parent):
        return np.eye(6) if parent is None else parent, child, True
    if parent is not None or child is not None:
        raise InvalidValueError(
            "One part has a covariance and the other has none. Give both, or the same for both as noise."
        )
    unknown = pose_covariance(*UNKNOWN_NOISE)
    return unknown, unknown, False


def family_weights(families: Families) -> dict[str | Family, float]:
    """Return the families to compare and their prior weights."""
    if families is None:
        families = WEIGHTS
    elif isinstance(families, (str, Family)):
        families = [families]
    weights = dict(families) if isinstance(families, Mapping) else dict.fromkeys(families)
    if not weights:
        raise InvalidValueError("There is no family to try.")
    result: dict[str | Family, float] = {}
    for name, weight in weights.items():
        if isinstance(name, str) and name not in WEIGHTS:
            raise UnknownNameError(f"There is no family {name!r}. {suggest(str(name), WEIGHTS, 'family')}")
        if weight is not None and not (math.isfinite(weight) and weight > 0.0):
            raise InvalidValueError(f"The weight of the family {name!r} is positive, not {weight!r}.")
        default = name.weight if isinstance(name, Family) else WEIGHTS[name]
        result[name] = default if weight is None else float(weight)
    return result
