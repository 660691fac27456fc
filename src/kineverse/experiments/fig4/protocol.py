"""Protocol of the papers: observed frames, noise, and runs of both filters."""

from __future__ import annotations

import math
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from kineverse.compile import CompiledFunction, compile  # noqa: A004
from kineverse.errors import ModelError
from kineverse.estimation import ObservedPose, Tracker, pose_covariance
from kineverse.experiments.fig4.paper_ekf import SPREAD, STEPS, PaperEkf
from kineverse.lie import Array, exp_so3, retract, transform
from kineverse.model.model_view import ModelView
from kineverse.symbols import Symbol

Generator: TypeAlias = np.random.Generator

DT = 0.05
"""Between two observations [s]."""
OBSERVATIONS = 25
CONFIGURATIONS = 300
TRAINING = 400
"""From so many noisy observations of one configuration comes the papers' R."""
SHIFTING_FIRST = 7
"""In the papers' order so many drawers come before the first door."""


@dataclass(frozen=True)
class PoseNoise:
    """The noise of a pose, its position and its orientation.

    Attributes
    ----------
    position, orientation
        Standard deviations [m], [rad]: along and about a random direction, or on each of the three axes.
    """

    position: float
    orientation: float

    @property
    def on_axes(self) -> PoseNoise:
        """Factor from noise along a random direction to noise on each of the three axes."""
        return PoseNoise(self.position / math.sqrt(3), self.orientation / math.sqrt(3))

    def __str__(self) -> str:
        return f"{100 * self.position:g} cm, {math.degrees(self.orientation):g}°"


LEVELS = tuple(PoseNoise(0.05 * k, math.radians(7.5 * k)) for k in (1, 2, 3, 4))
"""The papers' four levels."""


@dataclass(frozen=True)
class ObservedModel:
    """A model of which every frame that moves is observed, in the order in which degrees of freedom join.

    Attributes
    ----------
    model
        The model.
    frames
        The m frames, group by group.
    sizes
        How many frames and how many coordinates the first group has, the first two, and so on.
    symbols
        The n coordinates, group by group.
    limits
        Lower and upper limits, (n, 2).
    """

    model: ModelView
    frames: tuple[str, ...]
    sizes: tuple[tuple[int, int], ...]
    symbols: tuple[Symbol, ...]
    limits: Array

    @cached_property
    def turning(self) -> npt.NDArray[np.bool_]:
        """Coordinates that turn a frame: their errors are angles, those of the others lengths."""
        return np.array([any(_is_rotation(self.model, f, s) for f in self.frames) for s in self.symbols])

    @cached_property
    def _poses(self) -> CompiledFunction:
        return compile([self.model.fk(frame) for frame in self.frames], self.symbols)

    def poses(self, q: Array) -> Array:
        """Return the poses of all frames at configurations (N, n), (N, m, 4, 4)."""
        return np.stack(self._poses.batch(q), axis=1)

    def configurations(self, rng: Generator, count: int) -> Array:
        """Return configurations uniform in the limits, (count, n)."""
        lower, upper = self.limits.T
        return rng.uniform(lower, upper, (count, len(lower)))

    def first(self, groups: int) -> ObservedModel:
        """Return the scene of the first groups alone."""
        m, n = self.sizes[groups - 1]
        return ObservedModel(
            self.model, self.frames[:m], self.sizes[:groups], self.symbols[:n], self.limits[:n]
        )


def make_observed_model(model: ModelView) -> ObservedModel:
    """Return the frames of a model that the papers observe: every frame that moves.

    Groups of frames that share coordinates come in the model's order, but the first seven only shift, as in
    the papers, whose time per update jumps at the eighth.

    Raises
    ------
    ModelError
        If nothing moves.
    """
    frames = [frame for frame in model.frames if model.fk(frame).symbols]
    if not frames:
        raise ModelError("Nothing moves in this model: there is nothing to track.")
    groups = [
        (symbols, _observed_frames(model, frames, symbols)) for symbols in PaperEkf(model, frames).groups
    ]
    shifting = [g for g in groups if not any(_is_rotation(model, f, s) for f in g[1] for s in g[0])]
    first = shifting[:SHIFTING_FIRST]
    ordered = [*first, *(group for group in groups if group not in first)]
    counts = np.cumsum([(len(names), len(symbols)) for symbols, names in ordered], axis=0)
    found = PaperEkf(model, [name for _, names in ordered for name in names])
    return ObservedModel(model, found.frames, tuple(map(tuple, counts.tolist())), found.symbols, found.limits)


def _observed_frames(model: ModelView, frames: list[str], symbols: tuple[Symbol, ...]) -> list[str]:
    return [frame for frame in frames if set(model.fk(frame).symbols) & set(symbols)]


def _is_rotation(model: ModelView, frame: str, symbol: Symbol) -> bool:
    return symbol in model.fk(frame)[:3, :3].symbols


Directions: TypeAlias = Literal["published", "uniform"]


def add_published_noise(
    poses: Array, noise: PoseNoise, rng: Generator, directions: Directions = "published"
) -> Array:
    """Return poses with the papers' noise: T · translation(a d) · rotation(b about e).

    a and b are N(0, σ), d and e random directions. So each of three axes has a variance of σ²/3, and the
    errors are in the frame's own axes.

    Parameters
    ----------
    poses
        True poses, (..., 4, 4).
    noise
        σ of a and b.
    rng
        Where the numbers come from.
    directions
        ``"published"`` draws d and e like the authors' code, over a quarter of the sphere: with signs that is
        half of it, on which y and z have a correlation of 2/π. ``"uniform"`` draws over all of it.
    """
    lead = poses.shape[:-2]
    shift = _directions(rng, lead, directions) * rng.normal(0, noise.position, (*lead, 1))
    turn = _directions(rng, lead, directions) * rng.normal(0, noise.orientation, (*lead, 1))
    return poses @ transform(exp_so3(turn), shift)


def add_gaussian_noise(poses: Array, noise: PoseNoise, rng: Generator) -> Array:
    """Return poses (p + δp, Exp(δθ) R), all six N(0, σ): see :mod:`kineverse.estimation.noise`."""
    lead = poses.shape[:-2]
    moved = rng.normal(0, noise.position, (*lead, 3))
    turned = rng.normal(0, noise.orientation, (*lead, 3))
    return retract(poses, np.concatenate([moved, turned], axis=-1))


def _directions(rng: Generator, lead: tuple[int, ...], how: Directions) -> Array:
    around, up = rng.random(lead) * np.pi, rng.random(lead)
    if how == "uniform":
        around, up = 2 * around, 2 * up - 1
    across = np.sqrt(1 - up**2)
    return np.stack([np.cos(around) * across, np.sin(around) * across, up], axis=-1)


@dataclass(frozen=True)
class FilterRun:
    """Final estimates of a filter for C configurations.

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
    scene: ObservedModel, seen: Array, training: Array, steps: int = STEPS, spread: float = SPREAD
) -> FilterRun:
    """Run the papers' filter on observations (25, C, m, 4, 4), all configurations side by side.

    Parameters
    ----------
    scene
        What is tracked.
    seen, training
        The observations, and those of which R is learnt (400, m, 4, 4).
    steps, spread
        See :class:`~kineverse.experiments.fig4.paper_ekf.PaperEkf`.
    """
    filters = PaperEkf(scene.model, scene.frames, steps, spread, copies=seen.shape[1])
    filters.learn_noise(training)
    for poses in seen:
        filters.predict(DT)
        filters.update(poses)
    return FilterRun(filters.q, np.diagonal(filters.covariance, axis1=-2, axis2=-1))


def make_tracker(scene: ObservedModel, noise: PoseNoise) -> Tracker:
    """Return the proper filter for a scene with noise of that much on each axis."""
    covariance = pose_covariance(noise.position, noise.orientation)
    return Tracker(scene.model, [ObservedPose(frame, covariance=covariance) for frame in scene.frames])


def run_proper(scene: ObservedModel, seen: Array, noise: PoseNoise) -> FilterRun:
    """Run the proper filter on observations (25, C, m, 4, 4) with noise of that much on each axis."""
    unused = make_tracker(scene, noise)
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
    return FilterRun(np.array(q), np.array(variance), nis, dof)
