"""Checked measurements and their whitened residuals."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from kineverse.compilation import CompiledFunction
from kineverse.errors import InvalidValueError, ShapeError, UnknownNameError, suggest
from kineverse.estimation.noise import as_numbers, check_covariances, check_rigid
from kineverse.lie import Array, inverse_right_jacobian, pose_difference, transform

from .measurements import MeasurementModel, require_covariance, wrap_difference
from .state_space import Layout


class Measurements(NamedTuple):
    """One reading of all observations, as arrays laid out by :class:`.state_space.Layout`."""

    values: Array  # poses 4×4 row by row, and vectors; arbitrary where missing
    mask: npt.NDArray[np.bool_]  # True for each observation that was measured (m,)
    whitening: Array  # lower triangular W of each observation with Wᵀ W = R⁻¹, row by row
    log_scale: Array  # ½ log |2πR| of each observation


class MeasurementReader:
    """Checked conversion of user input into :class:`Measurements`."""

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        observations = layout.observations
        self._index = {one.name: i for i, one in enumerate(observations)}
        self._whitening = np.concatenate([whitening(one.covariance).reshape(-1) for one in observations])
        self._log_scale = np.array([log_scale(one.covariance) for one in observations])
        self._size = layout.measurement_slices[-1].stop
        self._vectors = [one.label for one in observations if not one.is_pose]
        self._all = np.ones(len(observations), dtype=bool)

    def empty(self) -> Measurements:
        """Return a reading in which every observation is missing."""
        return Measurements(np.zeros(self._size), ~self._all, self._whitening, self._log_scale)

    def as_reading(self, predicted: Array, indices: Iterable[int]) -> Measurements:
        """Return predicted values of some observations as a reading with their usual covariances."""
        reading = self.empty()
        for i in indices:
            value = predicted[self._layout.value_slices[i]]
            if self._layout.observations[i].is_pose:
                value = transform(value[:9].reshape(3, 3), value[9:]).reshape(-1)
            reading.values[self._layout.measurement_slices[i]] = value
            reading.mask[i] = True
        return reading

    def read(self, measurements: Mapping[str, Any]) -> Measurements:
        """Convert measurements by name, without :meth:`check_poses`; absent names are missing."""
        if not isinstance(measurements, Mapping):
            raise InvalidValueError(f"Measurements are a mapping {{frame: pose}}, not {measurements!r:.80}.")
        values, observed, whitenings, scales = self.empty()
        for name, value in measurements.items():
            i = self._index.get(name)
            if i is None:
                hint = suggest(str(name), self._index, "observation")
                raise UnknownNameError(f"'{name}' is not observed. {hint}")
            one = self._layout.observations[i]
            values[self._layout.measurement_slices[i]], covariance = read_value(value, one)
            if covariance is not one.covariance:
                if whitenings is self._whitening:
                    whitenings, scales = whitenings.copy(), scales.copy()
                whitenings[self._layout.whitening_slices[i]] = whitening(covariance).reshape(-1)
                scales[i] = log_scale(covariance)
            observed[i] = True
        return Measurements(values, observed, whitenings, scales)

    def read_poses(
        self, poses: npt.ArrayLike, mask: npt.ArrayLike | None, covariances: npt.ArrayLike | None = None
    ) -> Measurements:
        """Convert poses (m, 4, 4) and their covariances (m, 6, 6), without :meth:`check_poses`."""
        if self._vectors:
            raise InvalidValueError(
                f"update_poses is for poses alone, which {', '.join(self._vectors)} is not. Use update."
            )
        checked = as_numbers(poses, "The poses")
        count = len(self._all)
        if checked.shape != (count, 4, 4):
            raise ShapeError(f"The poses are an array of shape {(count, 4, 4)}, not {checked.shape}.")
        observed = self._all if mask is None else np.ascontiguousarray(mask)
        if observed.dtype != bool or observed.shape != (count,):
            raise ShapeError(f"mask= has {count} booleans, not {mask!r:.80}.")
        values = np.ascontiguousarray(checked).reshape(-1)
        if covariances is None:
            return Measurements(values, observed, self._whitening, self._log_scale)
        return Measurements(values, observed, *self._whiten_all(covariances, observed))

    def _whiten_all(self, covariances: npt.ArrayLike, observed: npt.NDArray[np.bool_]) -> tuple[Array, Array]:
        given = as_numbers(covariances, "The covariances")
        if given.shape != (shape := (len(observed), 6, 6)):
            raise ShapeError(f"The covariances are an array of shape {shape}, not {given.shape}.")
        given = np.where(observed[:, None, None], given, np.eye(6))
        try:
            roots = np.linalg.cholesky(check_covariances(given, len(given), 6, "observations"))
        except InvalidValueError:
            for i in np.flatnonzero(observed).tolist():
                require_covariance(given[i], 6, self._layout.observations[i].label)
            raise
        scales = np.log(np.diagonal(roots, axis1=1, axis2=2)).sum(axis=1) + 3.0 * np.log(2.0 * np.pi)
        return np.tril(np.linalg.inv(roots)).reshape(-1), scales

    def combine(self, before: Measurements, reading: Measurements, stamp: float) -> Measurements:
        """Return two readings of one time as one, with the latest of each observation."""
        values = reading.values.copy()
        for i in np.flatnonzero(before.mask & reading.mask).tolist():
            where = self._layout.measurement_slices[i]
            if np.array_equal(before.values[where], reading.values[where]):
                name = self._layout.observations[i].name
                raise InvalidValueError(
                    f"The same measurement of '{name}' came twice for {stamp:g} s. Counted twice, it would "
                    "seem more certain than it is."
                )
        for i in np.flatnonzero(before.mask & ~reading.mask).tolist():
            where = self._layout.measurement_slices[i]
            values[where] = before.values[where]
        return reading._replace(values=values, mask=before.mask | reading.mask)

    def check_poses(self, reading: Measurements) -> None:
        """Check that all measured poses are rigid."""
        for i, one in enumerate(self._layout.observations):
            if one.is_pose and reading.mask[i]:
                pose = reading.values[self._layout.measurement_slices[i]].reshape(1, 4, 4)
                check_rigid(pose, f"measurement '{one.label}'")


def read_value(value: Any, one: MeasurementModel) -> tuple[Array, Array]:
    """Return the checked value of a measurement, flattened, and its covariance, the default one if absent."""
    covariance = one.covariance
    if _is_pair(value, one):
        value, stated = value
        covariance = require_covariance(stated, one.size, one.label)
    return _checked_value(value, one), covariance


def _is_pair(value: Any, one: MeasurementModel) -> bool:
    """Return True for a pair of value and covariance, False for a vector of two numbers."""
    if not (isinstance(value, tuple | list) and len(value) == 2):
        return False
    if one.is_pose and np.shape(value[0]) == (3,):
        raise ShapeError(
            f"The pose of '{one.label}' is a 4×4 transform, or a pair of a transform and a covariance, not a "
            "position and an orientation: lie.transform(lie.quaternion(xyzw), position) makes a transform."
        )
    return isinstance(value, tuple) and (one.size != 2 or np.ndim(value[0]) > 0)


def whitening(covariance: Array) -> Array:
    """Return the lower triangular W with Wᵀ W = R⁻¹."""
    result: Array = np.linalg.inv(np.linalg.cholesky(covariance))
    return np.tril(result)


def log_scale(covariance: Array) -> float:
    """Return ½ log |2πR|."""
    logarithms = np.log(np.diag(np.linalg.cholesky(covariance)))
    return float(logarithms.sum() + len(covariance) * np.log(2 * np.pi) / 2)


def _checked_value(value: Any, one: MeasurementModel) -> Array:
    if one.is_pose:
        pose = as_numbers(value, f"The pose of '{one.label}'")
        if pose.shape != (4, 4):
            raise ShapeError(f"The pose of '{one.label}' is a 4×4 transform, not of shape {pose.shape}.")
        return pose.reshape(-1)
    vector = as_numbers(value, f"The value of '{one.label}'")
    if vector.shape == () and one.size == 1:
        vector = vector.reshape(1)
    if vector.shape != (one.size,):
        raise ShapeError(f"The value of '{one.label}' has shape {(one.size,)}, not {vector.shape}.")
    if not np.isfinite(vector).all():
        raise InvalidValueError(f"The value of '{one.label}' is not finite.")
    return vector


class Residuals:
    """Whitened residuals; for a pose (p_measured - p, log(R_measured Rᵀ)) in the axes of the observer."""

    def __init__(self, layout: Layout, function: CompiledFunction) -> None:
        self._layout = layout
        self._function = function
        self._widths = [len(layout.groups[number].tangent) for number in layout.group_of]

    def evaluate(self, x: Array, inputs: Array) -> Array:
        """Evaluate predicted values and Jacobians of all observations and limits at a state, not whitened."""
        return np.asarray(self._function(np.concatenate([x, inputs])))

    def errors(
        self, out: Array, reading: Measurements, indices: Sequence[int]
    ) -> dict[int, tuple[Array, Array]]:
        """Return whitened residuals (d,) and Jacobians of the prediction (d, t), by observation."""
        layout = self._layout
        measured = [i for i in indices if reading.mask[i]]
        values = {i: reading.values[layout.measurement_slices[i]] for i in measured}
        slopes = {i: out[layout.jacobian_slices[i]].reshape(-1, self._widths[i]) for i in measured}
        errors: dict[int, Array] = {}
        poses = [i for i in measured if layout.observations[i].is_pose]
        if poses:
            predicted = np.stack([out[layout.value_slices[i]] for i in poses])
            observed = np.stack([values[i] for i in poses]).reshape(-1, 4, 4)
            transforms = transform(predicted[:, :9].reshape(-1, 3, 3), predicted[:, 9:])
            differences = pose_difference(observed, transforms)
            errors.update(zip(poses, differences, strict=True))
            for i, turn in zip(poses, inverse_right_jacobian(differences[:, 3:]), strict=True):
                slopes[i] = np.concatenate([slopes[i][:3], turn @ slopes[i][3:]])
        pairs = {}
        for i in measured:
            one = layout.observations[i]
            if not one.is_pose:
                errors[i] = wrap_difference(values[i] - out[layout.value_slices[i]], one.period)
            white = reading.whitening[layout.whitening_slices[i]].reshape(one.size, one.size)
            pairs[i] = white @ errors[i], white @ slopes[i]
        return pairs

    def is_finite(self, out: Array, indices: Sequence[int]) -> bool:
        """Return True if values and Jacobians of observations are finite."""
        slices = self._layout.value_slices, self._layout.jacobian_slices
        return all(np.isfinite(out[where[i]]).all() for i in indices for where in slices)

    def check(self, out: Array, indices: Sequence[int]) -> None:
        """Check that values and Jacobians of observations are finite."""
        for i in indices:
            if not self.is_finite(out, (i,)):
                raise InvalidValueError(
                    f"'{self._layout.observations[i].label}' or its derivative is not finite at the present "
                    "estimate. Give start= a state where it is, or the model limits."
                )
