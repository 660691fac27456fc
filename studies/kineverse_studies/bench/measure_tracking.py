"""``tracking``: the 23 coordinates of the shipped kitchen from noisy poses of all moving frames."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from kineverse.compilation import compile
from kineverse.estimation import ObservedPose, Tracker, pose_covariance
from kineverse.formats import load
from kineverse.lie import Array, retract
from kineverse.model.model import Model

from .harness import BenchmarkSettings, Contender, Contenders, time_calls, time_contenders
from .peers.kalman_filter import Form, NumpyFilter
from .result import BenchmarkResult, bound_median, compare_speed

ARRAY, MAPPING = "kineverse, poses as one array", "kineverse, poses by frame"
GAIN, INFORMATION = "numpy, textbook gain", "numpy, information form"

POSITION, ORIENTATION = 0.01, math.radians(1.0)
LONGEST = 1e-4
"""Target time of an update [s]; the papers report 4 ms."""

_UPDATES = 25
# Number of updates compared, and done with the textbook gain, which takes a hundred times as long.
_CHECKED = 3


def measure(settings: BenchmarkSettings) -> BenchmarkResult:
    """Measure updates of a tracker beside filters written in numpy."""
    model = load("kitchen")
    frames = [name for name in model.frames if model.speeds_of(name)]
    readings = _readings(model, frames, min(_UPDATES, settings.configurations))
    covariance = pose_covariance(POSITION, ORIENTATION)
    participants = Contenders(
        [*_ours(model, frames, covariance, readings), *_theirs(model, frames, covariance, readings)]
    )
    measured = time_contenders("tracking", participants.contenders, settings.rounds, settings.progress)
    return BenchmarkResult(
        name="tracking",
        work=(
            f"an update of the {len(model.degrees_of_freedom)} coordinates of the shipped kitchen from the "
            f"poses of {len(frames)} frames, iterated until it stands still; mean of {len(readings)} in "
            f"a row, with the textbook gain of the first {len(readings[:_CHECKED])}"
        ),
        measurements=tuple(measured.values()),
        comparisons=(
            bound_median(measured[ARRAY], LONGEST),
            bound_median(measured[MAPPING], 3 * LONGEST),
            compare_speed(measured, ARRAY, INFORMATION),
            compare_speed(measured, ARRAY, GAIN),
        ),
    )


def _readings(model: Model, frames: list[str], count: int) -> list[Array]:
    """Return noisy poses of a kitchen whose coordinates are so far from limits that these have no effect."""
    rng = np.random.default_rng(0)
    symbols = model.degrees_of_freedom
    low, high = np.array([model.limits(s) for s in symbols]).T
    truth = low + rng.uniform(0.4, 0.6, len(symbols)) * (high - low)
    poses = np.array(compile([model.fk(f) for f in frames], symbols)(truth))
    return [_noisy(poses, rng) for _ in range(count)]


def _noisy(poses: Array, rng: np.random.Generator) -> Array:
    moved = POSITION * rng.standard_normal((len(poses), 3))
    turned = ORIENTATION * rng.standard_normal((len(poses), 3))
    return retract(poses, np.concatenate([moved, turned], axis=1))


def _ours(model: Model, frames: list[str], covariance: Array, readings: list[Array]) -> Iterator[Contender]:
    first = Tracker(model, [ObservedPose(f, covariance=covariance) for f in frames])
    first.wait()
    mappings = [dict(zip(frames, seen, strict=True)) for seen in readings]

    def by_array() -> None:
        tracker = first.copy()
        for seen in readings:
            tracker.update_poses(seen)

    def by_frame() -> None:
        tracker = first.copy()
        for seen in mappings:
            tracker.update(seen)

    def results() -> list[Array]:
        tracker = first.copy()
        estimates = [tracker.update_poses(seen) for seen in readings[:_CHECKED]]
        states = np.array([[e.state[s] for s in tracker.symbols] for e in estimates])
        return [states, np.array([np.diag(e.covariance) for e in estimates])]

    yield Contender(ARRAY, time_calls(by_array, len(readings)), results)
    yield Contender(MAPPING, time_calls(by_frame, len(readings)), results)


def _theirs(model: Model, frames: list[str], covariance: Array, readings: list[Array]) -> Iterator[Contender]:
    low, high = np.array([model.limits(s) for s in model.degrees_of_freedom]).T
    forms: tuple[tuple[str, Form, int], ...] = (
        (GAIN, "gain", _CHECKED),
        (INFORMATION, "information", len(readings)),
    )
    for name, form, count in forms:
        other = NumpyFilter(model, frames, covariance, (low + high) / 2, (high - low) ** 2 / 4, form)
        some = readings[:count]

        def results(other: NumpyFilter = other) -> list[Array]:
            found = other.run(readings[:_CHECKED])
            return [np.array([x for x, _ in found]), np.array([np.diag(P) for _, P in found])]

        def run(other: NumpyFilter = other, some: list[Array] = some) -> None:
            other.run(some)

        yield Contender(name, time_calls(run, len(some)), results)
