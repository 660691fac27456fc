"""Both filters on mechanisms that have no joint type: a folding door, and a garage door in both forms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kineverse.articulations import FoldingDoor, GarageDoor
from kineverse.errors import InvalidValueError
from kineverse.experiments.fig4.paper_ekf import PaperEkf
from kineverse.experiments.registry import Progress
from kineverse.lie import Array
from kineverse.model.frame import WORLD
from kineverse.model.model import Model
from kineverse.model.operation import Operation

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
"""The operation, and the coordinate that is looked at."""


@dataclass(frozen=True)
class CoordinateErrors:
    """Error of a filter in one coordinate.

    Attributes
    ----------
    mean, max
        Of |q̂ - q| [rad] or [m], over the configurations that were not lost; NaN if all were.
    nees
        The mean of (q̂ - q)²/σ² over these; 1 is right.
    lost_percent
        The share of configurations in which the filter stepped to where the model has no value.
    """

    mean: float
    max: float
    nees: float
    lost_percent: float


@dataclass(frozen=True)
class MechanismErrors:
    """Errors of both filters for a mechanism at one level of noise."""

    mechanism: str
    noise: PoseNoise
    by_filter: dict[str, CoordinateErrors]


def measure_mechanisms(configurations: int, progress: Progress) -> list[MechanismErrors]:
    """Return the errors of both filters for each mechanism at each noise level."""
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
    still = np.repeat(scene.poses(scene.configurations(rng, 1)), TRAINING, axis=0)
    truth = scene.configurations(rng, configurations)
    true = scene.poses(truth)
    seen = np.stack([add_gaussian_noise(true, noise, rng) for _ in range(OBSERVATIONS)])
    runs = {
        "published": _run_published_one_by_one(scene, seen, add_gaussian_noise(still, noise, rng)),
        "proper": run_proper(scene, seen, noise),
    }
    return MechanismErrors(
        name,
        noise,
        {filter_name: _coordinate_errors(run, truth, column) for filter_name, run in runs.items()},
    )


def _coordinate_errors(run: FilterRun, truth: Array, column: int) -> CoordinateErrors:
    kept = np.isfinite(run.q[:, column])
    lost = 100.0 * float((~kept).sum()) / len(kept)
    if not kept.any():
        return CoordinateErrors(np.nan, np.nan, np.nan, lost)
    error = np.abs(run.q - truth)[kept, column]
    nees = error**2 / run.variance[kept, column]
    return CoordinateErrors(float(error.mean()), float(error.max()), float(nees.mean()), lost)


def _run_published_one_by_one(scene: ObservedModel, seen: Array, training: Array) -> FilterRun:
    """Run the papers' filter on one configuration after the other, as a step of one may lead nowhere."""
    published = PaperEkf(scene.model, scene.frames)
    published.learn_noise(training)
    q = np.full((seen.shape[1], len(scene.symbols)), np.nan)
    variance = q.copy()
    for c in range(seen.shape[1]):
        published.reset()
        try:
            for poses in seen[:, c]:
                published.predict(DT)
                published.update(poses)
        except InvalidValueError:
            continue
        q[c], variance[c] = published.q, np.diag(published.covariance)
    return FilterRun(q, variance)
