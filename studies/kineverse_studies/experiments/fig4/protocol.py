"""Protocol of the papers: observed frames, noise, runs of both filters, and their times."""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from time import process_time
from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from kineverse._runtime import no_collection
from kineverse.compilation import CompiledFunction, compile
from kineverse.errors import ModelError
from kineverse.estimation import ObservedPose, Tracker, pose_covariance
from kineverse.lie import Array, exp_so3, retract, transform
from kineverse.model.model_view import ModelView
from kineverse.symbols import Symbol
from kineverse_studies.experiments.registry import Progress

from .paper_ekf import SPREAD, STEPS, PaperEkf

Generator: TypeAlias = np.random.Generator
DT = 0.05  # time between two observations [s]
OBSERVATIONS = 25
CONFIGURATIONS = 300
TRAINING = 400  # number of noisy observations of one configuration from which the papers' filter estimates R
SHIFTING_FIRST = 7  # number of drawers before the first door in the papers' order


@dataclass(frozen=True)
class PoseNoise:
    position: float
    orientation: float

    @property
    def on_axes(self) -> PoseNoise:
        """Noise on each of the three axes that equals this noise along a random direction."""
        return PoseNoise(self.position / math.sqrt(3), self.orientation / math.sqrt(3))

    def __str__(self) -> str:
        return f"{100 * self.position:g} cm, {math.degrees(self.orientation):g}°"


LEVELS = tuple(PoseNoise(0.05 * k, math.radians(7.5 * k)) for k in (1, 2, 3, 4))  # of the papers


@dataclass(frozen=True)
class ObservedModel:
    model: ModelView
    frames: tuple[str, ...]  # observed frames, m, group by group
    sizes: tuple[tuple[int, int], ...]  # cumulative numbers of frames and coordinates over the groups
    symbols: tuple[Symbol, ...]  # coordinates, n, group by group
    limits: Array  # lower and upper limits, (n, 2)

    @cached_property
    def turning(self) -> npt.NDArray[np.bool_]:
        """Mask of the coordinates that rotate a frame, (n,); only their errors are angles."""
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
        m, n = self.sizes[groups - 1]
        return ObservedModel(
            self.model, self.frames[:m], self.sizes[:groups], self.symbols[:n], self.limits[:n]
        )


def make_observed_model(model: ModelView) -> ObservedModel:
    """Return a model with all moving frames observed, as in the papers.

    Groups of frames that share coordinates are in the model's order, except that up to seven groups without
    rotation come first, as in the papers, whose time per update jumps at the eighth group.
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
    published = PaperEkf(model, [name for _, names in ordered for name in names])
    sizes = tuple(map(tuple, counts.tolist()))
    return ObservedModel(model, published.frames, sizes, published.symbols, published.limits)


def _observed_frames(model: ModelView, frames: list[str], symbols: tuple[Symbol, ...]) -> list[str]:
    return [frame for frame in frames if set(model.fk(frame).symbols) & set(symbols)]


def _is_rotation(model: ModelView, frame: str, symbol: Symbol) -> bool:
    return symbol in model.fk(frame)[:3, :3].symbols


Directions: TypeAlias = Literal["published", "uniform"]


def add_published_noise(
    poses: Array, noise: PoseNoise, rng: Generator, directions: Directions = "published"
) -> Array:
    """Return poses with the papers' noise: T · translation(a d) · rotation(b about e).

    a and b are N(0, σ), d and e random directions. Each of the three axes has the variance σ²/3. The errors
    are in the axes of the frame.
    """
    lead = poses.shape[:-2]
    shift = _directions(rng, lead, directions) * rng.normal(0, noise.position, (*lead, 1))
    turn = _directions(rng, lead, directions) * rng.normal(0, noise.orientation, (*lead, 1))
    return poses @ transform(exp_so3(turn), shift)


def add_gaussian_noise(poses: Array, noise: PoseNoise, rng: Generator) -> Array:
    """Return poses (p + δp, Exp(δθ) R) with errors N(0, σ), see :mod:`kineverse.estimation.noise`."""
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


@dataclass(frozen=True)
class FilterRun:
    q: Array  # estimates, and their variances according to the filter, (C, n)
    variance: Array
    nis: float = 0.0
    dof: int = 0


def run_published(
    scene: ObservedModel, observations: Array, training: Array, steps: int = STEPS, spread: float = SPREAD
) -> FilterRun:
    """Run the papers' filter on observations (25, C, m, 4, 4), with all configurations in parallel."""
    filters = PaperEkf(scene.model, scene.frames, steps, spread, copies=observations.shape[1])
    filters.learn_noise(training)
    for poses in observations:
        filters.predict(DT)
        filters.update(poses)
    return FilterRun(filters.q, np.diagonal(filters.covariance, axis1=-2, axis2=-1))


def make_tracker(scene: ObservedModel, noise: PoseNoise) -> Tracker:
    covariance = pose_covariance(noise.position, noise.orientation)
    return Tracker(
        scene.model, [ObservedPose(frame, covariance=covariance) for frame in scene.frames], process="static"
    )


def run_proper(scene: ObservedModel, observations: Array, noise: PoseNoise) -> FilterRun:
    """Run the tracker on observations (25, C, m, 4, 4) with noise on each axis."""
    initial = make_tracker(scene, noise)
    initial.wait()  # until then an update takes some twenty times as long
    q, variance, nis, dof = [], [], 0.0, 0
    for c in range(observations.shape[1]):
        # A copy of the initial tracker is cheaper than a new one, which analyses the whole model.
        tracker = copy(initial)
        for k, poses in enumerate(observations[:, c]):
            tracker.predict(DT)
            estimate = tracker.update_poses(poses)
            if k > 0:
                nis, dof = nis + estimate.nis, dof + estimate.dof
        q.append([estimate.state[s] for s in scene.symbols])
        variance.append([estimate.deviation[s] ** 2 for s in scene.symbols])
    return FilterRun(np.array(q), np.array(variance), nis, dof)


Step: TypeAlias = Callable[[Array], None]
REPORTED = 4.0  # upper bound of the times in the papers, with 23 degrees of freedom [ms]


@dataclass(frozen=True)
class Duration:
    """Mean, deviation and median of processor times [ms], and number of updates."""

    mean: float
    sd: float
    median: float
    updates: int


def time_updates_by_size(
    scene: ObservedModel, configurations: int, progress: Progress
) -> list[tuple[int, dict[str, Duration]]]:
    """Return degrees of freedom and times for the first group, the first two groups, and so on."""
    times = []
    for groups in progress(range(1, len(scene.sizes) + 1), "fig4: time", "size"):
        part = scene.first(groups)
        times.append((len(part.symbols), time_updates(part, LEVELS[-1], configurations)))
    return times


def time_updates(scene: ObservedModel, noise: PoseNoise, configurations: int) -> dict[str, Duration]:
    _, observations, training = simulate_observations(scene, noise, 0, configurations)
    published = PaperEkf(scene.model, scene.frames)
    published.learn_noise(training)
    published.function.wait()
    initial = make_tracker(scene, noise.on_axes)
    initial.wait()

    def start_published() -> Step:
        published.reset()

        def step(poses: Array) -> None:
            published.predict(DT)
            published.update(poses)

        return step

    def start_tracker() -> Step:
        tracker = copy(initial)

        def step(poses: Array) -> None:
            tracker.predict(DT)
            tracker.update_poses(poses)

        return step

    return {
        "published": _time_steps(start_published, observations),
        "proper": _time_steps(start_tracker, observations),
    }


def _time_steps(start: Callable[[], Step], observations: Array) -> Duration:
    """Time steps on observations (K, C, m, 4, 4); the first of each configuration is not counted."""
    _run_step(start(), observations[:, 0])  # fills caches
    with no_collection():
        times = [t for c in range(observations.shape[1]) for t in _run_step(start(), observations[:, c])]
    milliseconds = 1e3 * np.array(times)
    return Duration(
        float(milliseconds.mean()), float(milliseconds.std()), float(np.median(milliseconds)), len(times)
    )


def _run_step(step: Step, observations: Array) -> list[float]:
    step(observations[0])
    times = []
    for poses in observations[1:]:
        before = process_time()
        step(poses)
        times.append(process_time() - before)
    return times
