"""Poses of markers over time: smoothed, with their noise, and whether they move.

A camera's poses have noise and outliers that nobody states. So a marker that rests has the running mean of
the medians of its last poses, and one that moves their median; its noise is that of second differences.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from kineverse.lie import Array, pose_difference, retract

WINDOW = 7  # poses of a median: three outliers are left out
REST = 0.5  # time without a step from which on a marker rests [s]
_NOISE_WINDOW = 32  # differences from which the noise is measured
_MEAN = 120.0  # poses that a mean of a resting marker is worth at most
_STEP = np.repeat([0.004, math.radians(0.4)], 3)  # least step of a marker that moves [m], [rad]
_DEVIATIONS = 2.8  # the same in deviations of a pose; a median of seven deviates by .48 of them
_NOISE_PERIOD = 10  # poses of a marker between two measurements of its noise
_TOGETHER = np.repeat([0.03, 0.1], 3)  # deviation of poses of a part that moves within the window [m], [rad]
_LEAST_NOISE = np.array([5e-4, 1e-3])  # [m], [rad]: no camera is exact
_UNKNOWN_NOISE = 0.05  # differences of poses that are too rare to show it [m], [rad]
_GAP = 0.2  # longest time between poses whose difference shows the noise [s]
_NORMAL = 1.4826  # standard deviation of a normal distribution by its median deviation


class MarkerTracks:
    """Tracks of markers in the world, all at once."""

    def __init__(self) -> None:
        self.names: dict[str, int] = {}
        self._recent = np.empty((0, WINDOW, 4, 4))
        self._still = np.empty((0, 4, 4))
        self._differences = np.empty((0, _NOISE_WINDOW, 6))
        self._last_step = np.empty((0, 6))
        self._median = np.empty((0, 6))  # of the recent poses, from the still one
        self._count = np.empty(0, dtype=int)
        self._weight, self._seen, self._stepped = np.empty(0), np.empty(0), np.empty(0)
        self._noise = np.empty((0, 2))

    def add(self, poses: Mapping[str, Array], stamp: float) -> None:
        """Add the poses world_T_marker (4, 4) of one picture, taken at a time [s]."""
        if not poses:
            return
        self._grow([name for name in poses if name not in self.names])
        rows = np.array([self.names[name] for name in poses])
        given = np.array(list(poses.values()))
        step = pose_difference(given, self._recent[rows, -1])
        usual = (self._count[rows] >= 2) & (stamp - self._seen[rows] < _GAP)
        slots = self._count[rows] % _NOISE_WINDOW
        self._differences[rows[usual], slots[usual]] = (step - self._last_step[rows])[usual]
        self._last_step[rows] = step
        self._recent[rows] = np.roll(self._recent[rows], -1, axis=1)
        self._recent[rows, -1] = given
        self._seen[rows], self._count[rows] = stamp, self._count[rows] + 1
        for row in rows[self._count[rows] == WINDOW].tolist():
            apart = [_spread(self._recent[row], pose) for pose in self._recent[row]]
            self._still[row], self._stepped[row] = self._recent[row][int(np.argmin(apart))], -math.inf
        known = rows[self._count[rows] >= WINDOW]
        if len(known):
            self._follow(known, stamp)

    def _grow(self, names: Sequence[str]) -> None:
        for name in names:
            self.names[name] = len(self.names)
        for field, value in vars(self).items():
            if isinstance(value, np.ndarray) and len(names):
                more = np.zeros((len(names), *value.shape[1:]), dtype=value.dtype)
                setattr(self, field, np.concatenate([value, more]))
        if names:
            self._differences[-len(names) :] = np.nan

    def _follow(self, rows: npt.NDArray[np.int_], stamp: float) -> None:
        """Follow the poses: a mean where they rest, the median where they move."""
        due = rows[self._count[rows] % _NOISE_PERIOD == WINDOW % _NOISE_PERIOD]
        if len(due):
            self._measure_noise(due)
        steps = pose_difference(self._recent[rows], self._still[rows, None])
        median = np.median(steps, axis=1)
        noise = np.repeat(self._noise[rows], 3, axis=1)
        # Once in a while most of a few poses are outliers; then they are not near each other.
        apart = np.median(np.abs(steps - median[:, None]), axis=1)
        near = (apart <= np.maximum(_TOGETHER, 3.0 * noise)).all(axis=1)
        rows, median, noise = rows[near], median[near], noise[near]
        # The still pose is uncertain, too, as long as it is the mean of a few.
        doubt = np.sqrt(1.0 + WINDOW / np.maximum(self._weight[rows], WINDOW))[:, None]
        least = np.maximum(_STEP, _DEVIATIONS * doubt * noise)
        moves = (np.abs(median) > least).any(axis=1)
        share = np.where(moves, 1.0, 1.0 / np.clip(self._weight[rows], 1.0, _MEAN))
        self._still[rows] = retract(self._still[rows], share[:, None] * median)
        self._median[rows] = (1.0 - share[:, None]) * median
        self._weight[rows] = np.where(moves, 1.0, self._weight[rows] + 1.0)
        self._stepped[rows[moves]] = stamp

    def _measure_noise(self, due: npt.NDArray[np.int_]) -> None:
        differences = np.abs(self._differences[due])
        differences[np.isnan(differences).all(axis=(1, 2))] = _UNKNOWN_NOISE
        spread = _NORMAL / math.sqrt(6.0) * np.nanmedian(differences, axis=1)
        self._noise[due] = np.maximum(spread.reshape(-1, 2, 3).mean(axis=2), _LEAST_NOISE)

    def is_known(self, name: str) -> bool:
        """Return whether a marker was seen often enough to say where it is."""
        return name in self.names and bool(self._count[self.names[name]] >= WINDOW)

    def seen(self, name: str) -> float:
        """Return the time of the last pose of a marker [s]."""
        return float(self._seen[self.names[name]]) if name in self.names else -math.inf

    def stepped(self, name: str) -> float:
        """Return the time at which a marker moved last [s]."""
        return float(self._stepped[self.names[name]]) if name in self.names else -math.inf

    def rests(self, name: str) -> bool:
        """Return whether a marker had stood still for a while when it was seen last."""
        return self.is_known(name) and self.seen(name) - self.stepped(name) > REST

    def weight(self, name: str) -> float:
        """Return the number of poses for which a marker has stood still."""
        return float(self._weight[self.names[name]])

    def smoothed(self, name: str) -> Array:
        """Return the smoothed pose world_T_marker (4, 4), of a marker that is known."""
        return np.asarray(self._still[self.names[name]])

    def median(self, name: str) -> Array:
        """Return the pose (4, 4) that is the median of the last ones, of a marker that is known."""
        row = self.names[name]
        return np.asarray(retract(self._still[row], self._median[row]))

    def latest(self, name: str) -> Array:
        """Return the last pose (4, 4) as it was seen."""
        return np.asarray(self._recent[self.names[name], -1])

    def noise(self, name: str) -> tuple[float, float]:
        """Return the standard deviations of a known marker's position [m] and orientation [rad]."""
        position, orientation = self._noise[self.names[name]].tolist()
        return position, orientation


def _spread(poses: Array, about: Array) -> float:
    """Return the median distance of poses (N, 4, 4) from one (4, 4), with rotations about 1 m away."""
    return float(np.median(np.linalg.norm(pose_difference(poses, about), axis=1)))
