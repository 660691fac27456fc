"""Consistency of a filter (NEES, NIS), and its error relative to the Cramér-Rao bound.

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

from kineverse.lie import Array
from kineverse_studies.experiments.registry import Progress

from .protocol import (
    OBSERVATIONS,
    TRAINING,
    FilterRun,
    ObservedModel,
    PoseNoise,
    add_gaussian_noise,
    run_proper,
    run_published,
)

LEVELS = (
    PoseNoise(0.01, math.radians(1.0)),
    PoseNoise(0.05, math.radians(5.0)),
    PoseNoise(0.10, math.radians(10.0)),
)
INTERIOR_DEVIATIONS = 3.0
"""Least distance of an interior state from its limits, in standard deviations of the bound."""

_STEP = 1e-5


@dataclass(frozen=True)
class FilterConsistency:
    """Statistics of a filter at one level of noise."""

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

    def as_json(self) -> dict[str, Any]:
        """Return the statistics as JSON data."""
        numbers: dict[str, Any] = {
            "nees_inside": self.nees_inside,
            "nees_all": self.nees,
            "rmse_over_cramer_rao": self.over_bound,
            "rms": self.rms,
            "cramer_rao": self.bound,
            "states_inside": self.states,
        }
        if not math.isnan(self.nis):
            numbers |= {"nis": self.nis, "nis_band": list(self.nis_band)}
        return numbers


def measure_consistency(
    scene: ObservedModel, seeds: Sequence[int], configurations: int, progress: Progress
) -> dict[PoseNoise, dict[str, FilterConsistency]]:
    """Return the statistics of both filters at each level of noise."""
    statistics = {}
    for noise in progress(LEVELS, "fig4: consistency", "level"):
        truths, runs = [], []
        for seed in seeds:
            rng = np.random.default_rng([seed, LEVELS.index(noise), 1])
            static_poses = np.repeat(scene.poses(scene.configurations(rng, 1)), TRAINING, axis=0)
            truth = scene.configurations(rng, configurations)
            true_poses = scene.poses(truth)
            observations = np.stack([add_gaussian_noise(true_poses, noise, rng) for _ in range(OBSERVATIONS)])
            truths.append(truth)
            training = add_gaussian_noise(static_poses, noise, rng)
            runs.append(
                {
                    "published": run_published(scene, observations, training),
                    "proper": run_proper(scene, observations, noise),
                }
            )
        truth = np.concatenate(truths)
        bound = cramer_rao(scene, truth, noise)
        statistics[noise] = {
            filter_name: _evaluate_consistency(scene, truth, bound, [run[filter_name] for run in runs])
            for filter_name in runs[0]
        }
    return statistics


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
