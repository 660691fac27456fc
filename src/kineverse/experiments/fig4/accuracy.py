"""Error of both filters after 25 observations of each configuration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from kineverse.experiments.registry import Progress
from kineverse.lie import Array

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
"""The papers' own, and :class:`kineverse.estimation.Tracker`."""

REPORTED_MEAN = (0.0067, 0.0137, 0.0201, 0.0256)
"""Mean errors of the authors' filter run again with ten gradient steps, mean of four seeds."""
REPORTED_MAX = (0.065, 0.115, 0.156, 0.247)
"""The largest errors of one of these runs."""


@dataclass(frozen=True)
class Errors:
    """Errors |q̂ - q| at one level of noise.

    Attributes
    ----------
    noise
        The level.
    by_filter
        By filter, (seeds, C, n): for each seed and configuration those of all coordinates [m] or [rad].
    nees
        By filter, the mean over all states of (q̂ - q)²/σ²; 1 is right.
    """

    noise: PoseNoise
    by_filter: dict[str, Array]
    nees: dict[str, float]

    def summary(self, filter_name: str, coordinates: Any = slice(None)) -> dict[str, Any]:
        """Return mean, standard deviation and maximum over all, and means and maxima by seed."""
        errors = self.by_filter[filter_name][:, :, coordinates]
        return {
            "mean": float(errors.mean()),
            "sd": float(errors.std()),
            "max": float(errors.max()),
            "means": errors.mean(axis=(1, 2)).tolist(),
            "maxima": errors.max(axis=(1, 2)).tolist(),
        }

    def rms(self, filter_name: str, coordinates: Any) -> float:
        """Return the root of the mean square of some coordinates' errors."""
        return float(np.sqrt((self.by_filter[filter_name][:, :, coordinates] ** 2).mean()))


@dataclass(frozen=True)
class Variant:
    """The published filter with something about it or about the noise changed."""

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
    """Return the errors of both filters on the same observations, at the papers' levels."""
    jobs = [(noise, seed) for noise in LEVELS for seed in seeds]
    found: dict[PoseNoise, dict[str, list[tuple[Array, Array]]]] = {
        n: {w: [] for w in FILTERS} for n in LEVELS
    }
    for noise, seed in progress(jobs, "fig4: errors", "run"):
        truth, seen, training = simulate_observations(scene, noise, seed, configurations)
        for filter_name, run in (
            ("published", run_published(scene, seen, training)),
            ("proper", run_proper(scene, seen, noise.on_axes)),
        ):
            error = np.abs(run.q - truth)
            found[noise][filter_name].append((error, error**2 / run.variance))
    return tuple(
        Errors(
            noise,
            {filter_name: np.stack([error for error, _ in runs]) for filter_name, runs in by_filter.items()},
            {
                filter_name: float(np.mean([nees for _, nees in runs]))
                for filter_name, runs in by_filter.items()
            },
        )
        for noise, by_filter in found.items()
    )


def measure_variants(
    scene: ObservedModel, seeds: Sequence[int], configurations: int, progress: Progress
) -> dict[str, list[float]]:
    """Return the mean error of each variant at the papers' levels."""
    found = {}
    for variant in progress(VARIANTS, "fig4: variants", "variant"):
        means = []
        for noise in LEVELS:
            errors = []
            for seed in seeds:
                truth, seen, training = simulate_observations(
                    scene, noise, seed, configurations, variant.directions
                )
                run = run_published(scene, seen, training, variant.steps, variant.spread)
                errors.append(np.abs(run.q - truth).mean())
            means.append(float(np.mean(errors)))
        found[variant.name] = means
    return found


def simulate_observations(
    scene: ObservedModel,
    noise: PoseNoise,
    seed: int,
    configurations: int,
    directions: Directions = "published",
) -> tuple[Array, Array, Array]:
    """Return the truth (C, n), what is seen of it (25, C, m, 4, 4), and what R is learnt from (400, …)."""
    rng = np.random.default_rng([seed, LEVELS.index(noise)])
    still = scene.poses(scene.configurations(rng, 1))
    training = add_published_noise(np.repeat(still, TRAINING, axis=0), noise, rng, directions)
    truth = scene.configurations(rng, configurations)
    true = scene.poses(truth)
    seen = [add_published_noise(true, noise, rng, directions) for _ in range(OBSERVATIONS)]
    return truth, np.stack(seen), training
