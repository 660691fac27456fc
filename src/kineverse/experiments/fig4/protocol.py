"""What both papers do to measure a tracker: what is observed, and with which noise."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from kineverse.compile import CompiledFunction, compile  # noqa: A004
from kineverse.errors import ModelError
from kineverse.estimation.rotations import exponential
from kineverse.estimation.tracking.published import PublishedFilter
from kineverse.model.view import ModelView
from kineverse.symbols import Symbol

Array: TypeAlias = npt.NDArray[np.float64]
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
class Noise:
    """The noise of a pose, its position and its orientation.

    Attributes
    ----------
    position, orientation
        Standard deviations [m], [rad]: along and about a random direction, or on each of the three axes.
    """

    position: float
    orientation: float

    @property
    def on_axes(self) -> Noise:
        """What noise along a random direction is on each of the three axes."""
        return Noise(self.position / math.sqrt(3), self.orientation / math.sqrt(3))

    def __str__(self) -> str:
        return f"{100 * self.position:g} cm, {math.degrees(self.orientation):g}°"


LEVELS = tuple(Noise(0.05 * k, math.radians(7.5 * k)) for k in (1, 2, 3, 4))
"""The papers' four levels."""


@dataclass(frozen=True)
class Scene:
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
        """Which coordinates turn a frame: their errors are angles, those of the others lengths."""
        return np.array([any(_turns(self.model, f, s) for f in self.frames) for s in self.symbols])

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

    def first(self, groups: int) -> Scene:
        """Return the scene of the first groups alone."""
        m, n = self.sizes[groups - 1]
        return Scene(self.model, self.frames[:m], self.sizes[:groups], self.symbols[:n], self.limits[:n])


def scene_of(model: ModelView) -> Scene:
    """Return what the papers observe of a model: every frame that moves.

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
        (symbols, _frames_of(model, frames, symbols)) for symbols in PublishedFilter(model, frames).groups
    ]
    shifting = [g for g in groups if not any(_turns(model, f, s) for f in g[1] for s in g[0])]
    first = shifting[:SHIFTING_FIRST]
    ordered = [*first, *(group for group in groups if group not in first)]
    counts = np.cumsum([(len(names), len(symbols)) for symbols, names in ordered], axis=0)
    found = PublishedFilter(model, [name for _, names in ordered for name in names])
    return Scene(model, found.frames, tuple(map(tuple, counts.tolist())), found.symbols, found.limits)


def _frames_of(model: ModelView, frames: list[str], symbols: tuple[Symbol, ...]) -> list[str]:
    return [frame for frame in frames if set(model.fk(frame).symbols) & set(symbols)]


def _turns(model: ModelView, frame: str, symbol: Symbol) -> bool:
    return symbol in model.fk(frame)[:3, :3].symbols


Directions: TypeAlias = Literal["published", "uniform"]


def published_noise(
    poses: Array, noise: Noise, rng: Generator, directions: Directions = "published"
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
    moved = poses.copy()
    shift = _directions(rng, lead, directions) * rng.normal(0, noise.position, (*lead, 1))
    turn = _directions(rng, lead, directions) * rng.normal(0, noise.orientation, (*lead, 1))
    moved[..., :3, 3] += (poses[..., :3, :3] @ shift[..., None])[..., 0]
    moved[..., :3, :3] = poses[..., :3, :3] @ exponential(turn)
    return moved


def gaussian_noise(poses: Array, noise: Noise, rng: Generator) -> Array:
    """Return poses (p + δp, Exp(δθ) R), all six N(0, σ): see :mod:`kineverse.estimation.noise`."""
    lead = poses.shape[:-2]
    moved = poses.copy()
    moved[..., :3, 3] += rng.normal(0, noise.position, (*lead, 3))
    moved[..., :3, :3] = exponential(rng.normal(0, noise.orientation, (*lead, 3))) @ poses[..., :3, :3]
    return moved


def _directions(rng: Generator, lead: tuple[int, ...], how: Directions) -> Array:
    around, up = rng.random(lead) * np.pi, rng.random(lead)
    if how == "uniform":
        around, up = 2 * around, 2 * up - 1
    across = np.sqrt(1 - up**2)
    return np.stack([np.cos(around) * across, np.sin(around) * across, up], axis=-1)
