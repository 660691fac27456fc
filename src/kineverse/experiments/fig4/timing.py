"""Time of one prediction and update, by degrees of freedom and noise."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from time import perf_counter
from typing import TypeAlias

import numpy as np

from kineverse._gc import no_collection
from kineverse.experiments.fig4.paper_ekf import PaperEkf
from kineverse.experiments.registry import Progress
from kineverse.lie import Array

from .accuracy import simulate_observations
from .protocol import DT, LEVELS, ObservedModel, PoseNoise, make_tracker

Step: TypeAlias = Callable[[Array], None]

REPORTED = 4.0
"""Time reported by the papers for all 23 degrees of freedom [ms]."""


@dataclass(frozen=True)
class Duration:
    """Mean, standard deviation and median [ms], and how many updates that is.

    Mean and deviation are what the papers plot; the median knows least of what else the machine does.
    """

    mean: float
    sd: float
    median: float
    updates: int


def time_updates_by_size(
    scene: ObservedModel, configurations: int, progress: Progress
) -> list[tuple[int, dict[str, Duration]]]:
    """Return degrees of freedom and times of the first group, of the first two, and so on."""
    found = []
    for groups in progress(range(1, len(scene.sizes) + 1), "fig4: time", "size"):
        part = scene.first(groups)
        found.append((len(part.symbols), time_updates(part, LEVELS[-1], configurations)))
    return found


def time_updates(scene: ObservedModel, noise: PoseNoise, configurations: int) -> dict[str, Duration]:
    """Return the durations of both filters for the updates after the first."""
    _, seen, training = simulate_observations(scene, noise, 0, configurations)
    published = PaperEkf(scene.model, scene.frames)
    published.learn_noise(training)
    published.function.wait()
    unused = make_tracker(scene, noise.on_axes)

    def publish() -> Step:
        published.reset()

        def step(poses: Array) -> None:
            published.predict(DT)
            published.update(poses)

        return step

    def proper() -> Step:
        tracker = copy(unused)

        def step(poses: Array) -> None:
            tracker.predict(DT)
            tracker.update_poses(poses)

        return step

    return {"published": _time_steps(publish, seen), "proper": _time_steps(proper, seen)}


def _time_steps(begin: Callable[[], Step], seen: Array) -> Duration:
    """Time steps on observations (K, C, m, 4, 4); each configuration's first is not counted."""
    _run_step(begin(), seen[:, 0])  # warms caches up
    with no_collection():
        times = [t for c in range(seen.shape[1]) for t in _run_step(begin(), seen[:, c])]
    found = 1e3 * np.array(times)
    return Duration(float(found.mean()), float(found.std()), float(np.median(found)), len(found))


def _run_step(step: Step, seen: Array) -> list[float]:
    step(seen[0])
    times = []
    for poses in seen[1:]:
        before = perf_counter()
        step(poses)
        times.append(perf_counter() - before)
    return times
