"""Trackers on streams: errors, lost time, consistency and CPU time, beside a textbook filter."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from kineverse.compile import compile  # noqa: A004
from kineverse.estimation import ObservedPose, Tracker, pose_covariance
from kineverse.estimation.tracking.process_noise import Process
from kineverse.expressions.expression import array
from kineverse.lie import Array
from kineverse.model.model import Model
from kineverse_studies.experiments.registry import Progress

from .gated_filter import run_gated_filter
from .observations import DOOR, FRAMES, ORIENTATION, POSITION, RATE, Stream, hand_motion, simulate_stream

DURATION = 60.0
"""Length of a stream [s]."""

ACCELERATIONS = (0.03, 0.1, 0.3, 1.0, 3.0)
"""Noise of the textbook filter [rad²/s³]; that with the least error while moving counts."""

PROCESSES: tuple[Process, ...] = ("position", "velocity")

_SETTLED = 1.0
_WRONG = 5.0


@dataclass(frozen=True, eq=False)
class TrackedStream:
    """Estimates of the door in one stream."""

    stream: Stream
    angles: Array  # estimates and their variances (N,)
    variances: Array
    lost: Array  # true where the filter says that it is lost (N,)
    seconds: Array  # CPU time of each update (N,) [s]; empty if it was not measured

    @property
    def errors(self) -> Array:
        """Errors of the angle (N,) [rad]."""
        return self.angles - self.stream.angles

    @property
    def longest_silently_lost(self) -> float:
        """Longest time with errors beyond five stated deviations that is not said to be lost [s]."""
        wrong = (np.abs(self.errors) > _WRONG * np.sqrt(self.variances)) & ~self.lost.astype(bool)
        longest = run = 0
        for each in wrong.tolist():
            run = run + 1 if each else 0
            longest = max(longest, run)
        return longest / RATE


@dataclass(frozen=True)
class TrackingSummary:
    """Results of a filter over all streams."""

    name: str
    moving: float  # root mean square error while the door moves, and at rest after the first second [rad]
    resting: float
    nees: float  # mean normalised estimation error squared after the first second, over each whole stream
    worst_nees: float  # the same of the stream where it is farthest from 1
    silently_lost: float  # longest time that a filter was lost without saying so [s]
    lost: float  # share of the time that it said to be lost
    mean_time: float  # CPU time of an update: mean, and what one in a hundred exceeds [s]
    high_time: float


def make_streams(
    model: Model, seeds: Iterable[int], progress: Progress, duration: float = DURATION
) -> list[Stream]:
    """Return a stream of the door for each seed, of a duration [s]."""
    angles = hand_motion(np.arange(round(duration * RATE)) / RATE)
    seeds = progress(list(seeds), "stream: observations", "seed")
    return [simulate_stream(model, angles, np.random.default_rng(seed)) for seed in seeds]


def make_door_tracker(model: Model, process: Process) -> Tracker:
    """Return a tracker of the door that is told nothing but the noise."""
    noise = pose_covariance(POSITION, ORIENTATION)
    tracker = Tracker(
        model, [ObservedPose(frame, covariance=noise) for frame in FRAMES], process=process, outliers=True
    )
    tracker.wait()
    return tracker


def track_stream(tracker: Tracker, stream: Stream) -> TrackedStream:
    """Return the estimates of a tracker, which does not change."""
    tracker = tracker.copy()
    looks = [stream.look(k) for k in range(len(stream.times))]
    angles, variances, lost, seconds = [], [], [], []
    for look, at in zip(looks, stream.times.tolist(), strict=True):
        began = time.process_time()
        estimate = tracker.update(look, at=at)
        angles.append(estimate.state[DOOR])
        seconds.append(time.process_time() - began)
        variances.append(estimate.deviation[DOOR] ** 2)
        lost.append(estimate.lost)
    return TrackedStream(stream, np.array(angles), np.array(variances), np.array(lost), np.array(seconds))


def run_trackers(
    model: Model, streams: Sequence[Stream], progress: Progress
) -> dict[str, list[TrackedStream]]:
    """Return the estimates of trackers and of the textbook filter, by name."""
    results: dict[str, list[TrackedStream]] = {}
    for process in PROCESSES:
        tracker = make_door_tracker(model, process)
        results[process] = [
            track_stream(tracker, stream) for stream in progress(streams, f"stream: {process}", "stream")
        ]
    results["textbook"] = run_textbook_filter(model, streams, progress)
    return results


def run_textbook_filter(model: Model, streams: Sequence[Stream], progress: Progress) -> list[TrackedStream]:
    """Return the estimates of the textbook filter with the best of its noises."""
    poses = compile(
        array([entry for frame in FRAMES for entry in model.fk(frame).reshape(16)]), [model.symbol(DOOR)]
    )

    def markers(angle: float) -> Array:
        return np.asarray(poses(np.array([angle]))).reshape(len(FRAMES), 4, 4)

    tried = []
    for acceleration in progress(ACCELERATIONS, "stream: textbook filter", "noise"):
        found = []
        for stream in streams:
            angles, variances = run_gated_filter(stream, markers, acceleration)
            found.append(TrackedStream(stream, angles, variances, np.zeros(len(angles)), np.empty(0)))
        tried.append(found)
    return min(tried, key=lambda found: summarize_tracking("", found).moving)


def summarize_tracking(name: str, results: Sequence[TrackedStream]) -> TrackingSummary:
    """Return the summary of a filter over all streams."""
    moving = np.concatenate([r.errors[r.stream.moving] for r in results])
    resting = np.concatenate([r.errors[~r.stream.moving & (r.stream.times > _SETTLED)] for r in results])
    nees = [float(np.mean((r.errors**2 / r.variances)[r.stream.times > _SETTLED])) for r in results]
    seconds = np.concatenate([r.seconds for r in results])
    return TrackingSummary(
        name,
        float(np.sqrt(np.mean(moving**2))),
        float(np.sqrt(np.mean(resting**2))),
        float(np.mean(nees)),
        max(nees, key=lambda each: abs(np.log(each))),
        max(r.longest_silently_lost for r in results),
        float(np.mean([r.lost.mean() for r in results])),
        float(seconds.mean()) if len(seconds) else np.nan,
        float(np.percentile(seconds, 99)) if len(seconds) else np.nan,
    )


def summarize_trackers(results: Mapping[str, Sequence[TrackedStream]]) -> list[TrackingSummary]:
    """Return the summary of each filter."""
    return [summarize_tracking(name, found) for name, found in results.items()]
