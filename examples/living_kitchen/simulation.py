"""Simulation of the scene: true motion, readings, tracking and identification."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

import kineverse as kv

from .identify import JointLearner
from .sensor import MarkerReadings, MarkerSampler, SensorModel
from .track import KitchenTracker, TrackingQuality, average
from .trajectory import PeriodicTrajectory, smooth_step
from .unknown_mechanisms import MECHANISMS, UnknownMechanism

KITCHEN = "kitchen"

SWING_PERIOD, GROWTH_TIME = 5.0, 9.0
"""Period of the mechanism, and time until it moves through its whole range [s]."""

MECHANISM_TIME = 40.0
"""Time after which the next mechanism replaces the present one [s]."""

AVERAGING_TIME = 2.0
"""Time over which the quality is averaged [s]."""


class Simulation:
    """Kitchen in motion and a mechanism of unknown type, tracked and identified from noisy readings.

    Time passes only in :meth:`step`. Equal seeds and steps give equal results.

    Parameters
    ----------
    seed
        The seed of all noise.
    sensor
        The initial sensor model.
    mechanism
        The name of the first mechanism, see :data:`.unknown_mechanisms.MECHANISMS`.

    Attributes
    ----------
    kitchen
        The model of the kitchen, which the tracker knows.
    sensor
        The sensor model; it can be replaced at any time.
    time
        Since the beginning [s].
    truth
        The true values of the kitchen's coordinates, by name.
    kitchen_tracker, learner
        The tracker of the kitchen, and the identification of the mechanism.
    readings, quality
        The latest readings of the kitchen's markers, and the quality of the track after them.
    mechanism, position
        The mechanism of unknown type, and the true position of its joint.
    poses, mechanism_readings
        The true poses of the mechanism's base and part (2, 4, 4), and their readings.
    """

    def __init__(self, seed: int = 0, sensor: SensorModel | None = None, mechanism: str = "chest") -> None:
        self.kitchen = kv.load(KITCHEN)
        self.sensor = sensor or SensorModel()
        self.time = 0.0
        self._seed = seed
        self._trajectory = PeriodicTrajectory(self.kitchen)
        self.kitchen_tracker = KitchenTracker(self.kitchen, self.sensor)
        self._kitchen_sampler = MarkerSampler(len(self.kitchen_tracker.frames), seed)
        self._history: deque[tuple[float, TrackingQuality]] = deque()
        self.change_mechanism(mechanism)
        self.step(0.0)

    def change_mechanism(self, mechanism: str | None = None) -> None:
        """Replace the mechanism by another one, the next if none is named, and restart its identification.

        Raises
        ------
        UnknownNameError
            If there is no such mechanism.
        """
        names = list(MECHANISMS)
        if mechanism is None:
            mechanism = names[(names.index(self.mechanism.name) + 1) % len(names)]
        elif mechanism not in MECHANISMS:
            hint = kv.errors.suggest(mechanism, names, "stranger")
            raise kv.errors.UnknownNameError(f"There is no stranger '{mechanism}'. {hint}")
        self.mechanism: UnknownMechanism = MECHANISMS[mechanism]()
        self._arrival = self.time
        self.learner = JointLearner()
        # A generator of its own, so that readings of the kitchen do not depend on the mechanism.
        self._mechanism_sampler = MarkerSampler(2, self._seed + 1)

    def step(self, dt: float) -> None:
        """Advance time [s], observe, track and identify."""
        self.time += dt
        self.truth = self._trajectory.evaluate(self.time)
        poses = self.kitchen_tracker.poses(self.truth)
        self.readings: MarkerReadings = self._kitchen_sampler.observe(poses, self.time, self.sensor)
        self.quality = self.kitchen_tracker.step(self.readings, self.truth, dt, self.sensor)
        self._history.append((self.time, self.quality))
        while self._history[0][0] < self.time - AVERAGING_TIME:
            self._history.popleft()
        if self.time >= self._arrival + MECHANISM_TIME:
            self.change_mechanism()
        self._move_mechanism(dt)

    def _move_mechanism(self, dt: float) -> None:
        since = self.time - self._arrival
        low, high = self.mechanism.limits
        swing = smooth_step(since / GROWTH_TIME) * (0.5 - 0.5 * math.cos(math.tau * since / SWING_PERIOD))
        self.position = low + swing * (high - low)
        self.poses = np.stack(self.mechanism.poses(self.position))
        self.mechanism_readings = self._mechanism_sampler.observe(self.poses, self.time, self.sensor)
        self.learner.step(self.mechanism_readings, self.time, dt, self.sensor)

    @property
    def average_quality(self) -> TrackingQuality:
        """The quality of the kitchen track over the last two seconds."""
        return average([quality for _, quality in self._history])

    @property
    def part_error(self) -> float | None:
        """The error of the tracked position of the mechanism's part [m]; None while there is no model."""
        part = self.learner.part
        return None if part is None else float(np.linalg.norm(part[:3, 3] - self.poses[1, :3, 3]))
