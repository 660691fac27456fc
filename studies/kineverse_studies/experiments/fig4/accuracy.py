"""Errors of both filters, their consistency, and the Cramér-Rao bound.

The noise is Gaussian on each axis. No unbiased estimator from K poses of m frames then has a smaller
covariance than the inverse of K Σ Jᵀ W J (Cramér-Rao bound), with the Jacobians J of the frames at the true
state and the inverse covariance W of a pose. J is computed from differences of poses, independently of the
filters.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from kineverse.articulations import FoldingDoor, GarageDoor
from kineverse.errors import InvalidValueError
from kineverse.lie import Array
from kineverse.model.frame import WORLD
from kineverse.model.model import Model
from kineverse.model.operation import Operation
from kineverse_studies.experiments.registry import Progress

from .paper_ekf import PaperEkf
from .protocol import (
    DT,
    LEVELS,
    OBSERVATIONS,
    TRAINING,
    Directions,
    FilterRun,
    ObservedModel,
    PoseNoise,
    add_gaussian_noise,
    make_observed_model,
    run_proper,
    run_published,
    simulate_observations,
)

FILTERS = ("published", "proper")  # names of the papers' filter and of kineverse.estimation.Tracker
REPORTED_MEAN = (0.0067, 0.0137, 0.0201, 0.0256)
"""Mean errors of the authors' code with ten gradient steps, mean of four seeds, by level of noise."""
REPORTED_MAX = (0.065, 0.115, 0.156, 0.247)  # largest errors of one of these runs, by level of noise


@dataclass(frozen=True)
class Errors:
    noise: PoseNoise
    by_filter: dict[str, Array]  # errors of all coordinates by filter, (seeds, C, n) [m] or [rad]
    nees: dict[str, float]  # mean of (q̂ - q)²/σ² over all states by filter; 1 for a consistent filter

    def summary(self, filter_name: str, coordinates: Any = slice(None)) -> dict[str, Any]:
        errors = self.by_filter[filter_name][:, :, coordinates]
        return {
            "mean": float(errors.mean()),
            "sd": float(errors.std()),
            "max": float(errors.max()),
            "means": errors.mean(axis=(1, 2)).tolist(),
            "maxima": errors.max(axis=(1, 2)).tolist(),
        }

    def rms(self, filter_name: str, coordinates: Any) -> float:
        return float(np.sqrt((self.by_filter[filter_name][:, :, coordinates] ** 2).mean()))


@dataclass(frozen=True)
class Variant:
    name: str
    steps: int = 10
    spread: float = 0.5
    directions: Directions = "published"


VARIANTS = (
    Variant("as published"),
    Variant("start: sd = width, as in the authors' code", spread=1.0),
    Variant("directions of noise over all of the sphere", directions="uniform"),
    Variant("one gradient step, as in the authors' code", steps=1),
    Variant("no gradient steps", steps=0),
)


def measure_errors(
    scene: ObservedModel, seeds: Sequence[int], configurations: int, progress: Progress
) -> tuple[Errors, ...]:
    """Return the errors of both filters for equal observations, at the papers' levels of noise."""
    jobs = [(noise, seed) for noise in LEVELS for seed in seeds]
    errors: dict[PoseNoise, dict[str, list[Array]]] = {
        noise: {name: [] for name in FILTERS} for noise in LEVELS
    }
    nees: dict[PoseNoise, dict[str, list[Array]]] = {
        noise: {name: [] for name in FILTERS} for noise in LEVELS
    }
    for noise, seed in progress(jobs, "fig4: errors", "run"):
        truth, observations, training = simulate_observations(scene, noise, seed, configurations)
        runs = (run_published(scene, observations, training), run_proper(scene, observations, noise.on_axes))
        for name, run in zip(FILTERS, runs, strict=True):
            error = np.abs(run.q - truth)
            errors[noise][name].append(error)
            nees[noise][name].append(error**2 / run.variance)
    return tuple(
        Errors(
            noise,
            {name: np.stack(found) for name, found in errors[noise].items()},
            {name: float(np.mean(found)) for name, found in nees[noise].items()},
        )
        for noise in LEVELS
    )


def measure_variants(
    scene: ObservedModel,
    seeds: Sequence[int],
    configurations: int,
    progress: Progress,
    variants: Sequence[Variant] = VARIANTS,
) -> dict[str, list[float]]:
    mean_errors = {}
    for variant in progress(variants, "fig4: variants", "variant"):
        means = []
        for noise in LEVELS:
            errors = []
            for seed in seeds:
                truth, observations, training = simulate_observations(
                    scene, noise, seed, configurations, variant.directions
                )
                run = run_published(scene, observations, training, variant.steps, variant.spread)
                errors.append(np.abs(run.q - truth).mean())
            means.append(float(np.mean(errors)))
        mean_errors[variant.name] = means
    return mean_errors


GAUSSIAN_LEVELS = (
    PoseNoise(0.01, math.radians(1.0)),
    PoseNoise(0.05, math.radians(5.0)),
    PoseNoise(0.10, math.radians(10.0)),
)
INTERIOR_DEVIATIONS = 3.0
"""Least distance of an interior state from its limits, in standard deviations of the bound."""
_STEP = 1e-5


@dataclass(frozen=True)
class FilterConsistency:
    # mean of (q̂ - q)²/σ² over interior states and over all states; 1 for a consistent filter
    nees_inside: float
    nees: float
    nis: float
    nis_band: tuple[float, float]
    over_bound: float  # root mean square of (q̂ - q) over the bound, over interior states
    # root mean square error and bound of ``"shifting"`` [m] and ``"turning"`` [rad] coordinates
    rms: dict[str, float]
    bound: dict[str, float]
    states: int  # number of interior states

    def as_data(self) -> dict[str, Any]:
        numbers: dict[str, Any] = {
            "nees_inside": self.nees_inside,
            "nees_all": self.nees,
            "rmse_over_cramer_rao": self.over_bound,
            "rms": self.rms,
            "cramer_rao": self.bound,
            "states_inside": self.states,
        }
        return numbers if math.isnan(self.nis) else numbers | {"nis": self.nis, "nis_band": self.nis_band}


def measure_consistency(
    scene: ObservedModel, seeds: Sequence[int], configurations: int, progress: Progress
) -> dict[PoseNoise, dict[str, FilterConsistency]]:
    statistics = {}
    for noise in progress(GAUSSIAN_LEVELS, "fig4: consistency", "level"):
        truths, runs = [], []
        for seed in seeds:
            rng = np.random.default_rng([seed, GAUSSIAN_LEVELS.index(noise), 1])
            truth, observations, training = _simulate_gaussian(scene, noise, rng, configurations)
            truths.append(truth)
            published = run_published(scene, observations, training)
            runs.append((published, run_proper(scene, observations, noise)))
        truth = np.concatenate(truths)
        bound = cramer_rao(scene, truth, noise)
        statistics[noise] = {
            name: _evaluate_consistency(scene, truth, bound, list(own))
            for name, own in zip(FILTERS, zip(*runs, strict=True), strict=True)
        }
    return statistics


def _simulate_gaussian(
    scene: ObservedModel, noise: PoseNoise, rng: np.random.Generator, configurations: int
) -> tuple[Array, Array, Array]:
    static_poses = np.repeat(scene.poses(scene.configurations(rng, 1)), TRAINING, axis=0)
    truth = scene.configurations(rng, configurations)
    true_poses = scene.poses(truth)
    observations = np.stack([add_gaussian_noise(true_poses, noise, rng) for _ in range(OBSERVATIONS)])
    return truth, observations, add_gaussian_noise(static_poses, noise, rng)


def cramer_rao(scene: ObservedModel, q: Array, noise: PoseNoise, observations: int = OBSERVATIONS) -> Array:
    """Return the Cramér-Rao bound of the variance of each coordinate at configurations (C, n), (C, n)."""
    information = np.zeros((*q.shape, q.shape[1]))
    jacobian = np.stack([_derivative(scene, q, i) for i in range(q.shape[1])], axis=-1)
    for rows, sigma in ((slice(0, 3), noise.position), (slice(3, 6), noise.orientation)):
        scaled = jacobian[:, :, rows] / sigma
        information += observations * np.einsum("cmri,cmrj->cij", scaled, scaled)
    bound: Array = np.diagonal(np.linalg.inv(information), axis1=-2, axis2=-1)
    return bound


def _derivative(scene: ObservedModel, q: Array, i: int) -> Array:
    """Return the twists (C, m, 6) of all frames per unit of a coordinate."""
    ahead, behind = q.copy(), q.copy()
    ahead[:, i] += _STEP
    behind[:, i] -= _STEP
    after, before = scene.poses(ahead), scene.poses(behind)
    turned = after[..., :3, :3] @ np.swapaxes(before[..., :3, :3], -1, -2)
    rotation = np.stack([turned[..., a, b] - turned[..., b, a] for a, b in ((2, 1), (0, 2), (1, 0))], axis=-1)
    shifted = after[..., :3, 3] - before[..., :3, 3]
    twists: Array = np.concatenate([shifted, rotation / 2], axis=-1) / (2 * _STEP)
    return twists


def _evaluate_consistency(
    scene: ObservedModel, truth: Array, bound: Array, runs: list[FilterRun]
) -> FilterConsistency:
    lower, upper = scene.limits.T
    error = np.concatenate([run.q for run in runs]) - truth
    nees = error**2 / np.concatenate([run.variance for run in runs])
    inside = np.minimum(truth - lower, upper - truth) >= INTERIOR_DEVIATIONS * np.sqrt(bound)
    kinds = {"shifting": inside & ~scene.turning, "turning": inside & scene.turning}
    dof = sum(run.dof for run in runs)
    # χ² with many degrees of freedom is approximately Gaussian.
    margin = 1.96 * math.sqrt(2 / dof) if dof else math.nan
    return FilterConsistency(
        nees_inside=float(nees[inside].mean()),
        nees=float(nees.mean()),
        nis=sum(run.nis for run in runs) / dof if dof else math.nan,
        nis_band=(1 - margin, 1 + margin),
        over_bound=float(np.sqrt((error**2 / bound)[inside].mean())),
        rms={kind: _root_mean(error**2, where) for kind, where in kinds.items() if where.any()},
        bound={kind: _root_mean(bound, where) for kind, where in kinds.items() if where.any()},
        states=int(inside.sum()),
    )


def _root_mean(squares: Array, mask: npt.NDArray[np.bool_]) -> float:
    return float(np.sqrt(squares[mask].mean()))


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
    # mean and maximum of |q̂ - q| [rad] or [m] over the configurations not lost; NaN if all are lost
    mean: float
    max: float
    nees: float  # mean of (q̂ - q)²/σ² over these; 1 for a consistent filter
    lost_percent: float  # share of configurations in which the filter left the domain of the model [%]


@dataclass(frozen=True)
class MechanismErrors:
    mechanism: str
    noise: PoseNoise
    by_filter: dict[str, CoordinateErrors]


def measure_mechanisms(configurations: int, progress: Progress) -> list[MechanismErrors]:
    jobs = [(name, noise) for name in MECHANISMS for noise in GAUSSIAN_LEVELS]
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
    rng = np.random.default_rng([list(MECHANISMS).index(name), GAUSSIAN_LEVELS.index(noise)])
    truth, observations, training = _simulate_gaussian(scene, noise, rng, configurations)
    runs = {
        "published": _run_published_sequentially(scene, observations, training),
        "proper": run_proper(scene, observations, noise),
    }
    errors = {name: _coordinate_errors(run, truth, column) for name, run in runs.items()}
    return MechanismErrors(name, noise, errors)


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
