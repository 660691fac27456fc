"""The kitchen that is believed: a tracker of everything that opens, and how well it does."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

import kineverse as kv
from kineverse.estimation import Estimate, ObservedPose, Tracker
from kineverse.model.model_view import ModelView
from kineverse.view.triangle_mesh import Floats

from .sensor import Seen, Sight

RESTLESS = 0.1
"""What may move at any time: the variance that a coordinate gains [m²/s], [rad²/s]."""

SIGMAS = 2.0
"""How many standard deviations are shown."""


@dataclass(frozen=True, slots=True)
class Figures:
    """How good a belief is.

    Attributes
    ----------
    marker
        How far markers are off: of those that were seen and are not wrong, root mean square [m].
    mean, most
        How far the tracked places of the same markers are off, the mean and the largest [m].
    nees
        The normalised estimation error squared for each coordinate: 1 where a belief is as sure as it may be.
    seconds
        What the update took.
    """

    marker: float
    mean: float
    most: float
    nees: float
    seconds: float


def average(figures: Sequence[Figures]) -> Figures:
    """Return the figures of several moments as one: means, the largest ``most``, the median time."""
    markers = [f.marker for f in figures if not math.isnan(f.marker)]
    return Figures(
        float(np.sqrt(np.mean(np.square(markers)))) if markers else math.nan,
        float(np.mean([f.mean for f in figures])),
        max(f.most for f in figures),
        float(np.mean([f.nees for f in figures])),
        float(np.median([f.seconds for f in figures])),
    )


class Following:
    """Tracks the coordinates of a model by markers on the parts that they move.

    Parameters
    ----------
    model
        Whatever has an articulation with a coordinate has a marker, on its handle if there is one.
    sight
        How well it is seen.
    """

    def __init__(self, model: ModelView, sight: Sight) -> None:
        self.model = model
        self.frames = marked(model)
        self._poses = kv.compile([model.fk(frame) for frame in self.frames])
        self._names = [str(symbol) for symbol in self._poses.inputs]
        self.tracker = self._tracker(sight)
        self.estimate: Estimate = self.tracker.estimate
        self._sight = sight

    def _tracker(self, sight: Sight, start: Estimate | None = None) -> Tracker:
        """Return a tracker that begins where another one ended."""
        return Tracker(
            self.model,
            [ObservedPose(frame, covariance=sight.covariance) for frame in self.frames],
            process_noise={symbol.derivative(): RESTLESS for symbol in self.model.degrees_of_freedom},
            outliers=True if sight.outliers else None,
            start=None if start is None else start.state,
            uncertainty=None if start is None else {s: start.deviation[s] for s in start.state},
        )

    def step(self, seen: Seen, truth: dict[str, float], dt: float, sight: Sight) -> Figures:
        """Take in what was seen after ``dt`` seconds, and say how far off it and the belief are."""
        if (sight.noise, sight.outliers) != (self._sight.noise, self._sight.outliers):
            self.tracker = self._tracker(sight, self.estimate)
        self._sight = sight
        begin = time.perf_counter()
        if dt > 0.0:
            self.tracker.predict(dt)
        self.estimate = self.tracker.update_poses(seen.poses, seen.there)
        seconds = time.perf_counter() - begin
        return self._figures(seen, truth, seconds)

    def _figures(self, seen: Seen, truth: dict[str, float], seconds: float) -> Figures:
        places = self.places(truth)
        off = np.linalg.norm(self.places(self.values) - places, axis=1)
        good = seen.there & ~seen.wrong
        marker = np.linalg.norm(seen.poses[good, :3, 3] - places[good], axis=1)
        # The Gaussian, and not the most probable state inside the limits, is what the covariance is about.
        error = np.array([truth[str(s)] - self.estimate.state[s] for s in self.tracker.symbols])
        error -= self.estimate.mean
        return Figures(
            float(np.sqrt(np.mean(marker**2))) if good.any() else float("nan"),
            float(off.mean()),
            float(off.max()),
            float(error @ self.estimate.information @ error) / len(error),
            seconds,
        )

    @property
    def values(self) -> dict[str, float]:
        """The most probable values, by name."""
        return {str(symbol): value for symbol, value in self.estimate.state.items()}

    def poses(self, values: dict[str, float]) -> Floats:
        """Return the poses of the marked frames, (m, 4, 4)."""
        return np.stack(self._poses(np.array([values[name] for name in self._names])))

    def places(self, values: dict[str, float]) -> Floats:
        """Return the positions of the marked frames, (m, 3)."""
        return self.poses(values)[:, :3, 3]

    def ways(self, points: int = 5) -> Floats:
        """Return where markers may be, ±2 standard deviations along their ways: (m, points, 3).

        Each coordinate is taken to move markers that no other one moves.
        """
        values, deviation = self.values, self.estimate.deviation
        limits = {str(s): bounds for s, bounds in self.tracker.limits.items()}
        rows = np.array(
            [
                [np.clip(values[n] + sigma * deviation[n], *limits[n]) for n in self._names]
                for sigma in np.linspace(-SIGMAS, SIGMAS, points)
            ]
        )
        return np.stack([poses[:, :3, 3] for poses in self._poses.batch(rows)])

    def doubt(self) -> Floats:
        """Return how far apart the ends of these ways are for each marked frame (m,) [m]."""
        ways = self.ways(3)
        lengths: Floats = np.linalg.norm(np.diff(ways, axis=1), axis=2).sum(axis=1)
        return lengths


def marked(model: ModelView) -> list[str]:
    """Return the frames that carry a marker: handles, and what has none itself."""
    moving = [record.child for record in model.articulations.values() if record.coordinates]
    return [f"{name}_handle" if f"{name}_handle" in model.frames else name for name in moving]
