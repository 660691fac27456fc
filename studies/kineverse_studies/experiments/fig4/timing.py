"""Processor time of one prediction and update, by degrees of freedom and noise."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from time import process_time
from typing import TypeAlias

import numpy as np

from kineverse._runtime import no_collection
from kineverse.lie import Array
from kineverse_studies.experiments.registry import Progress

from .accuracy import simulate_observations
from .paper_ekf import PaperEkf
from .protocol import DT, LEVELS, ObservedModel, PoseNoise, make_tracker

Step: TypeAlias = Callable[[Array], None]

REPORTED = 4.0
"""Upper bound of the times in the papers, with 23 degrees of freedom [ms]."""


@dataclass(frozen=True)
class Duration:
    """Mean, standard deviation and median of processor times [ms], and number of updates.

    The papers plot mean and deviation.
    """

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
    """Return the times of both filters for all updates except the first."""
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
