"""Plausibility check of a served model against recorded poses (2020 paper, III-D)."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from kineverse.errors import InvalidValueError, KineverseError
from kineverse.estimation.identification.kinematic_graph.pairwise import FamilyChoice
from kineverse.estimation.identification.observations import PosesLike, check_tracks, exact_track, pair_tracks
from kineverse.estimation.robust import Outliers, as_outliers
from kineverse.model.frame import WORLD
from kineverse.model.model import Model, Snapshot

from .alternatives import JointObservations, judge_joint
from .consistency import ConsistencyTests, TimedResiduals
from .known_motion import KnownJoint
from .known_residuals import compute_residuals
from .report import JointVerdict, Plausibility
from .sequential_test import SequentialTest
from .testability import TestableJoint, find_testable_joints

FALSE_ALARMS = 1e-3
"""The default probability of calling an articulation implausible that is as served."""


def check_plausibility(
    model: Model | Snapshot,
    observations: Mapping[str, PosesLike],
    *,
    noise: npt.ArrayLike | None = None,
    relative_to: str | None = WORLD,
    families: FamilyChoice = None,
    false_alarms: float = FALSE_ALARMS,
    outliers: Outliers | bool | None = True,
    strict: bool = False,
) -> Plausibility:
    """Return whether the articulations of a model still explain what is seen, and what would if they do not.

    Each articulation between frames that were seen is judged as it is served, with its own parameters and
    limits and unknown joint values, beside a rigid connection, none at all, and what
    :func:`~kineverse.estimation.identify` finds.

    Parameters
    ----------
    model
        The model.
    observations
        From names of frames to their poses over time, (N, 4, 4), or pairs of poses and covariance, (6, 6) or
        (N, 6, 6); a pose that was not seen is NaN throughout.
    noise
        The covariance, (6, 6), of what comes with none, see :mod:`kineverse.estimation.noise`.
    relative_to
        The frame in which poses are given. It is taken as exactly known and is compared with what is seen
        where nothing else on its part is; None for an observer that is no part of the model.
    families
        What is tried instead, see :func:`~kineverse.estimation.identify`.
    false_alarms
        The probability with which an articulation may be called implausible though it is as served.
    outliers
        How often observations are wrong altogether, see :class:`~kineverse.estimation.Outliers`; False or
        None if they never are. Then less is noticed sooner.
    strict
        Whether to raise if one is.

    Raises
    ------
    UnknownNameError
        For a frame or a family that does not exist.
    ShapeError, InvalidValueError
        For poses or covariances that are none, and if it is not known how well a frame is seen.
    ImplausibleError
        If ``strict``, and an articulation stopped explaining what is seen.
    """
    check_false_alarms(false_alarms)
    wrong = as_outliers(outliers)
    if isinstance(model, Snapshot):
        model = model.model()
    seen = check_tracks(observations, noise)
    found = find_testable_joints(model, observations, relative_to)
    if relative_to is not None:
        seen[relative_to] = exact_track(max((len(track.poses) for track in seen.values()), default=0))
    told: dict[TestableJoint, TimedResiduals] = {}
    reasons: dict[TestableJoint, JointVerdict] = {}
    judged_by: dict[TestableJoint, KnownJoint] = {}
    for link in found.links:
        parent, child = seen[link.parent], seen[link.child]
        times = np.flatnonzero(parent.seen & child.seen)
        if not len(times):
            reasons[link] = undetermined(
                link, 0, f"'{link.parent}' and '{link.child}' were never seen together"
            )
            continue
        try:
            served = KnownJoint(model, link.child, link.parent)
            told[link] = TimedResiduals(times, compute_residuals(served, pair_tracks(parent, child, times)))
            judged_by[link] = served
        except KineverseError as error:
            reasons[link] = undetermined(link, len(times), f"its pose cannot be computed. {error}")
    tied = ConsistencyTests(model, judged_by, relative_to).tied(told)
    ratings = []
    for link in found.links:
        if link in reasons:
            ratings.append(reasons[link])
            continue
        times = told[link].times
        poses = pair_tracks(seen[link.parent], seen[link.child], times)
        ratings.append(
            _test_joint(
                model,
                JointObservations(link, judged_by[link], poses, tied[link], times),
                families,
                false_alarms,
                wrong,
            )
        )
    result = Plausibility(tuple(ratings), found.left_out, false_alarms)
    if strict:
        result.raise_if_implausible()
    return result


def check_false_alarms(probability: float) -> None:
    """Look whether a probability of false alarms is one.

    Raises
    ------
    InvalidValueError
        If it is not between 0 and 1.
    """
    if not 0.0 < probability < 1.0:
        raise InvalidValueError(
            f"The probability of a false alarm is between 0 and 1, and not {probability}."
        )


def undetermined(link: TestableJoint, count: int, reason: str) -> JointVerdict:
    """Return the rating of an articulation about which nothing can be said."""
    return JointVerdict(link, {}, (math.nan, math.nan), count, reason=reason)


def _test_joint(
    model: Model,
    seen: JointObservations,
    families: FamilyChoice,
    false_alarms: float,
    outliers: Outliers | None,
) -> JointVerdict:
    watch = SequentialTest(false_alarms, outliers.fraction if outliers else 0.0)
    left = seen.misfit
    for row in zip(left.normal, left.by_place, left.against, strict=True):
        watch.add(*row)
    stopped = None if watch.stopped is None else int(seen.times[watch.stopped])
    return judge_joint(model, seen, stopped, families, outliers)
