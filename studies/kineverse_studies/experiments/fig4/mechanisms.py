"""Tracking of mechanisms other than joints: a folding door, and a garage door in both forms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kineverse.articulations import FoldingDoor, GarageDoor
from kineverse.errors import InvalidValueError
from kineverse.lie import Array
from kineverse.model.frame import WORLD
from kineverse.model.model import Model
from kineverse.model.operation import Operation
from kineverse_studies.experiments.fig4.paper_ekf import PaperEkf
from kineverse_studies.experiments.registry import Progress

from .consistency import LEVELS
from .protocol import (
    DT,
    OBSERVATIONS,
    TRAINING,
    FilterRun,
    ObservedModel,
    PoseNoise,
    add_gaussian_noise,
    make_observed_model,
    run_proper,
)

MECHANISMS: dict[str, tuple[Operation, str]] = {
    "folding door": (FoldingDoor(name="door", parent=WORLD), "door"),
    "garage door, by its angle": (GarageDoor(name="garage", parent=WORLD), "garage/door"),
    "garage door, by a as published": (
        GarageDoor(name="garage", parent=WORLD, form="published"),
        "garage/door",
    ),
}
"""Operation and evaluated coordinate of each mechanism."""


@dataclass(frozen=True)
class CoordinateErrors:
    """Error of a filter in one coordinate."""

    # mean and maximum of |q̂ - q| [rad] or [m] over the configurations not lost; NaN if all are lost
    mean: float
    max: float
    nees: float  # mean of (q̂ - q)²/σ² over these; 1 for a consistent filter
    lost_percent: float  # share of configurations in which the filter left the domain of the model [%]


@dataclass(frozen=True)
class MechanismErrors:
    """Errors of both filters for a mechanism at one level of noise."""

    mechanism: str
    noise: PoseNoise
    by_filter: dict[str, CoordinateErrors]


def measure_mechanisms(configurations: int, progress: Progress) -> list[MechanismErrors]:
    """Return the errors of both filters for each mechanism at each level of noise."""
    jobs = [(name, noise) for name in MECHANISMS for noise in LEVELS]
    return [
        _track_mechanism(name, noise, configurations)
        for name, noise in progress(jobs, "fig4: mechanisms", "run")
    ]


def _track_mechanism(name: str, noise: PoseNoise, configurations: int) -> MechanismErrors:
    operation, coordinate = MECHANISMS[name]
    model = Model()
    with model.edit() as edit:
        edit.apply(operation)
    scene = make_observed_model(model)
    column = [str(s) for s in scene.symbols].index(coordinate)
    rng = np.random.default_rng([list(MECHANISMS).index(name), LEVELS.index(noise)])
    static_poses = np.repeat(scene.poses(scene.configurations(rng, 1)), TRAINING, axis=0)
    truth = scene.configurations(rng, configurations)
    true_poses = scene.poses(truth)
    observations = np.stack([add_gaussian_noise(true_poses, noise, rng) for _ in range(OBSERVATIONS)])
    runs = {
        "published": _run_published_sequentially(
            scene, observations, add_gaussian_noise(static_poses, noise, rng)
        ),
        "proper": run_proper(scene, observations, noise),
    }
    return MechanismErrors(
        name,
        noise,
        {filter_name: _coordinate_errors(run, truth, column) for filter_name, run in runs.items()},
    )


def _coordinate_errors(run: FilterRun, truth: Array, column: int) -> CoordinateErrors:
    finite = np.isfinite(run.q[:, column])
    lost = 100.0 * float((~finite).sum()) / len(finite)
    if not finite.any():
        return CoordinateErrors(np.nan, np.nan, np.nan, lost)
    error = np.abs(run.q - truth)[finite, column]
    nees = error**2 / run.variance[finite, column]
    return CoordinateErrors(float(error.mean()), float(error.max()), float(nees.mean()), lost)


def _run_published_sequentially(scene: ObservedModel, observations: Array, training: Array) -> FilterRun:
    """Run the papers' filter on each configuration separately, as a step may leave the model's domain."""
    published = PaperEkf(scene.model, scene.frames)
    published.learn_noise(training)
    q = np.full((observations.shape[1], len(scene.symbols)), np.nan)
    variance = q.copy()
    for c in range(observations.shape[1]):
        published.reset()
        try:
            for poses in observations[:, c]:
                published.predict(DT)
                published.update(poses)
        except InvalidValueError:
            continue
        q[c], variance[c] = published.q, np.diag(published.covariance)
    return FilterRun(q, variance)
