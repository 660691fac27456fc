"""Error of both filters after 25 observations of each configuration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from kineverse.lie import Array
from kineverse_studies.experiments.registry import Progress

from .protocol import (
    LEVELS,
    OBSERVATIONS,
    TRAINING,
    Directions,
    ObservedModel,
    PoseNoise,
    add_published_noise,
    run_proper,
    run_published,
)

FILTERS = ("published", "proper")
"""Names of the papers' filter and of :class:`kineverse.estimation.Tracker`."""

REPORTED_MEAN = (0.0067, 0.0137, 0.0201, 0.0256)
"""Mean errors of the authors' code with ten gradient steps, mean of four seeds, by level of noise."""
REPORTED_MAX = (0.065, 0.115, 0.156, 0.247)
"""Largest errors of one of these runs, by level of noise."""


@dataclass(frozen=True)
class Errors:
    """Errors |q̂ - q| at one level of noise."""

    noise: PoseNoise
    by_filter: dict[str, Array]  # errors of all coordinates by filter, (seeds, C, n) [m] or [rad]
    nees: dict[str, float]  # mean of (q̂ - q)²/σ² over all states by filter; 1 for a consistent filter

    def summary(self, filter_name: str, coordinates: Any = slice(None)) -> dict[str, Any]:
        """Return mean, standard deviation and maximum of errors, and means and maxima by seed."""
        errors = self.by_filter[filter_name][:, :, coordinates]
        return {
            "mean": float(errors.mean()),
            "sd": float(errors.std()),
            "max": float(errors.max()),
            "means": errors.mean(axis=(1, 2)).tolist(),
            "maxima": errors.max(axis=(1, 2)).tolist(),
        }

    def rms(self, filter_name: str, coordinates: Any) -> float:
        """Return the root mean square error of some coordinates."""
        return float(np.sqrt((self.by_filter[filter_name][:, :, coordinates] ** 2).mean()))


@dataclass(frozen=True)
class Variant:
    """Variant of the published filter or of the noise."""

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
    errors: dict[PoseNoise, dict[str, list[tuple[Array, Array]]]] = {
        level: {filter_name: [] for filter_name in FILTERS} for level in LEVELS
    }
    for noise, seed in progress(jobs, "fig4: errors", "run"):
        truth, observations, training = simulate_observations(scene, noise, seed, configurations)
        for filter_name, run in (
            ("published", run_published(scene, observations, training)),
            ("proper", run_proper(scene, observations, noise.on_axes)),
        ):
            error = np.abs(run.q - truth)
            errors[noise][filter_name].append((error, error**2 / run.variance))
    return tuple(
        Errors(
            noise,
            {filter_name: np.stack([error for error, _ in runs]) for filter_name, runs in by_filter.items()},
            {
                filter_name: float(np.mean([nees for _, nees in runs]))
                for filter_name, runs in by_filter.items()
            },
        )
        for noise, by_filter in errors.items()
    )


def measure_variants(
    scene: ObservedModel,
    seeds: Sequence[int],
    configurations: int,
    progress: Progress,
    variants: Sequence[Variant] = VARIANTS,
) -> dict[str, list[float]]:
    """Return the mean error of each variant at the papers' levels of noise."""
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


def simulate_observations(
    scene: ObservedModel,
    noise: PoseNoise,
    seed: int,
    configurations: int,
    directions: Directions = "published",
) -> tuple[Array, Array, Array]:
    """Return true states (C, n), observations (25, C, m, 4, 4), and others to learn R (400, m, 4, 4)."""
    rng = np.random.default_rng([seed, LEVELS.index(noise)])
    static_poses = scene.poses(scene.configurations(rng, 1))
    training = add_published_noise(np.repeat(static_poses, TRAINING, axis=0), noise, rng, directions)
    truth = scene.configurations(rng, configurations)
    true_poses = scene.poses(truth)
    observations = [add_published_noise(true_poses, noise, rng, directions) for _ in range(OBSERVATIONS)]
    return truth, np.stack(observations), training
