"""Both filters on the same observations of many configurations."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass

import numpy as np

from kineverse.estimation import ObservedPose, Tracker, pose_covariance
from kineverse.estimation.tracking.published import SPREAD, STEPS, PublishedFilter

from .protocol import DT, Array, Noise, Scene


@dataclass(frozen=True)
class Run:
    """Where a filter ended with C configurations.

    Attributes
    ----------
    q, variance
        The estimates and what the filter thinks their variances are, (C, n).
    nis, dof
        Normalised innovation squared and its degrees of freedom, sums of all updates but the first of each
        configuration, whose prior is no distribution of truths; 0 if not counted.
    """

    q: Array
    variance: Array
    nis: float = 0.0
    dof: int = 0


def run_published(
    scene: Scene, seen: Array, training: Array, steps: int = STEPS, spread: float = SPREAD
) -> Run:
    """Run the papers' filter on observations (25, C, m, 4, 4), all configurations side by side.

    Parameters
    ----------
    scene
        What is tracked.
    seen, training
        The observations, and those of which R is learnt (400, m, 4, 4).
    steps, spread
        See :class:`~kineverse.estimation.tracking.published.PublishedFilter`.
    """
    filters = PublishedFilter(scene.model, scene.frames, steps, spread, copies=seen.shape[1])
    filters.learn_noise(training)
    for poses in seen:
        filters.predict(DT)
        filters.update(poses)
    return Run(filters.q, np.diagonal(filters.covariance, axis1=-2, axis2=-1))


def tracker_of(scene: Scene, noise: Noise) -> Tracker:
    """Return the proper filter for a scene with noise of that much on each axis."""
    covariance = pose_covariance(noise.position, noise.orientation)
    return Tracker(scene.model, [ObservedPose(frame, covariance=covariance) for frame in scene.frames])


def run_proper(scene: Scene, seen: Array, noise: Noise) -> Run:
    """Run the proper filter on observations (25, C, m, 4, 4) with noise of that much on each axis."""
    unused = tracker_of(scene, noise)
    q, variance, nis, dof = [], [], 0.0, 0
    for c in range(seen.shape[1]):
        # Making a tracker looks at the whole model; a copy begins where that one did.
        tracker = copy(unused)
        for k, poses in enumerate(seen[:, c]):
            tracker.predict(DT)
            estimate = tracker.update_poses(poses)
            if k > 0:
                nis, dof = nis + estimate.nis, dof + estimate.dof
        q.append([estimate.state[s] for s in scene.symbols])
        variance.append([estimate.deviation[s] ** 2 for s in scene.symbols])
    return Run(np.array(q), np.array(variance), nis, dof)
