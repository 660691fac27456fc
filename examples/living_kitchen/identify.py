"""Online identification of a joint: poses are stored, and the best family becomes a model that is tracked."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

import kineverse as kv
from kineverse.estimation import Fit, IdentificationResult, ObservedPose, Outliers, Tracker, identify
from kineverse.model.frame import WORLD
from kineverse.view.plots import AXIAL_FAMILIES
from kineverse.view.rendering.triangle_mesh import Floats

from .gating import OutlierGate
from .sensor import MarkerReadings, SensorModel
from .unknown_mechanisms import BASE, PART

LEARNED = "stranger/learned"
"""Name of the joint in the identified model."""

SAMPLE_PERIOD, IDENTIFICATION_PERIOD = 0.25, 1.0
"""Periods of storing a pose, and of identification [s]."""

FEWEST_POSES, MOST_POSES = 4, 96
"""Number of poses at which identification begins, and above which every other one is dropped."""

PROCESS_NOISE = 0.06
"""Variance that a coordinate of the identified joint gains [m²/s], [rad²/s]."""

MODELLED_FAMILIES = ("revolute", "prismatic", "screw", "cylindrical", "rigid")
"""Families that become a model; others are only reported."""

DIRECTED_FAMILIES = (*AXIAL_FAMILIES, "prismatic")
"""Families with a direction."""


@dataclass(frozen=True, slots=True)
class FamilyProbabilities:
    """Probability of each family at a time [s]."""

    time: float
    probabilities: dict[str, float]


class JointLearner:
    """Identification and tracking of the joint between a base and a part, from poses of both.

    Attributes
    ----------
    result
        The latest identification; None as long as there are too few poses.
    history
        The probabilities of all identifications so far.
    model
        Base and part, connected by the identified joint; None as long as the result is ambiguous.
    tracker
        The tracker of the identified joint, if it can move.
    """

    def __init__(self) -> None:
        self.result: IdentificationResult | None = None
        self.history: list[FamilyProbabilities] = []
        self.model: kv.Model | None = None
        self.tracker: Tracker | None = None
        self._base: list[Floats] = []
        self._part: list[Floats] = []
        self._covariances: list[Floats] = []
        self._fk: Callable[[dict[str, float]], Floats] | None = None
        self._sampled = self._identified = -np.inf
        self._gate = OutlierGate()
        self._sample_period = SAMPLE_PERIOD

    def step(self, readings: MarkerReadings, time: float, dt: float, sensor: SensorModel) -> None:
        """Process readings of base and part, in this order, ``dt`` after the previous ones [s]."""
        inliers = self._gate.find_inliers(readings, dt, sensor)
        if inliers.all() and time >= self._sampled + self._sample_period:
            self._sampled = time
            self._store(readings, sensor)
        if time >= self._identified + IDENTIFICATION_PERIOD and len(self._part) >= FEWEST_POSES:
            self._identified = time
            self._identify(time, sensor)
        if self.tracker is not None:
            self.tracker.predict(dt)
            if readings.visible[1]:
                self.tracker.update({PART: (readings.poses[1], sensor.covariance)})

    def _store(self, readings: MarkerReadings, sensor: SensorModel) -> None:
        """Store poses, and drop every other one if there are many: old ones are worth as much as new ones."""
        self._base.append(readings.poses[0])
        self._part.append(readings.poses[1])
        self._covariances.append(sensor.covariance)
        if len(self._part) > MOST_POSES:
            self._base, self._part = self._base[::2], self._part[::2]
            self._covariances = self._covariances[::2]
            self._sample_period *= 2.0

    def _identify(self, time: float, sensor: SensorModel) -> None:
        covariances = np.array(self._covariances)
        base, part = np.array(self._base), np.array(self._part)
        self.result = identify(base, part, parent_covariance=covariances, child_covariance=covariances)
        self.history.append(FamilyProbabilities(time, {fit.family: fit.probability for fit in self.result}))
        best = self.result.best
        if self.result.is_ambiguous or best.family not in MODELLED_FAMILIES:
            self.model = self.tracker = self._fk = None
            return
        # The pose of the base is identified in the same way.
        stands = identify(None, base, child_covariance=covariances, families=["rigid"]).best
        model = kv.Model()
        with model.edit() as edit:
            edit.apply(stands.operation(BASE, WORLD))
            edit.apply(best.operation(LEARNED, BASE, PART))
        self._start_tracker(model, best, sensor)

    def _start_tracker(self, model: kv.Model, fit: Fit, sensor: SensorModel) -> None:
        """Track the identified joint, from the last pose of the part."""
        self.model, self.tracker, self._fk = model, None, kv.compile(model.fk(PART))
        names = [str(s) for s in model.degrees_of_freedom]
        if names:
            self.tracker = Tracker(
                model,
                [ObservedPose(PART)],
                start=dict(zip(names, fit.joint_values[-1].tolist(), strict=True)),
                process_noise={s.derivative(): PROCESS_NOISE for s in model.degrees_of_freedom},
                outliers=Outliers(sensor.outliers) if sensor.outliers else None,
            )

    @property
    def values(self) -> dict[str, float]:
        """The values of the coordinates of the identified model, by name."""
        if self.tracker is None:
            return {}
        return {str(symbol): value for symbol, value in self.tracker.estimate.state.items()}

    @property
    def part(self) -> Floats | None:
        """The estimated pose of the part, 4×4; None as long as there is no model."""
        return None if self._fk is None else self._fk(self.values)

    @property
    def part_positions(self) -> Floats:
        """The stored positions of the part (N, 3) [m]."""
        return np.array(self._part).reshape(-1, 4, 4)[:, :3, 3]

    @property
    def base(self) -> Floats:
        """The estimated pose of the base; the last observed one as long as there is no model."""
        if self.model is not None:
            return np.asarray(self.model.fk(BASE)({}))
        return self._base[-1] if self._base else np.eye(4)


def axis_error(fit: Fit, point: Floats, direction: Floats) -> tuple[float, float, float]:
    """Return the error of a fit with respect to the true axis, which is given in the parent.

    Returns ------- The angle between them [rad], the distance of the true axis from the point of the fit [m]
    (0 for a prismatic joint), and both as a multiple of what the covariance predicts: 1 on average.
    """
    rotation, origin = fit.frame[:3, :3], fit.frame[:3, 3]
    way = rotation.T @ direction
    way = way if way[2] > 0.0 else -way
    off = [-way[1], way[0]]
    names = ["axis.x", "axis.y"]
    distance = 0.0
    if fit.family in AXIAL_FAMILIES:
        start = rotation.T @ (point - origin)
        crossing = start - way * (start[2] / way[2])
        off, names = [*crossing[:2], *off], ["point.x", "point.y", *names]
        distance = float(np.linalg.norm(crossing[:2]))
    index = [fit.coordinates.index(name) for name in names]
    delta = np.array(off)
    square = float(delta @ np.linalg.solve(fit.covariance[np.ix_(index, index)], delta)) / len(delta)
    return float(np.arccos(np.clip(way[2], -1.0, 1.0))), distance, float(np.sqrt(square))
