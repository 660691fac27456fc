"""Checked measurements and their whitened residuals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from kineverse.compile import CompiledFunction
from kineverse.errors import InvalidValueError, ShapeError, UnknownNameError, suggest
from kineverse.lie import Array, inverse_right_jacobian, pose_difference, transform

from .layout import Layout
from .measurements import MeasurementModel, require_covariance, wrap_difference

RIGID = 1e-4
"""How far RᵀR may be from the identity; a pose in single precision is off by 1e-6."""


class Measurements(NamedTuple):
    """What was seen, as arrays; where each observation is in them, the layout knows.

    Attributes
    ----------
    values
        Poses 4×4 row by row, and vectors; anything for what is missing.
    seen
        A mask of what was seen (m,).
    whitening
        For each a lower triangle W with Wᵀ W = R⁻¹, row by row.
    log_scale
        For each ½ log |2πR|.
    """

    values: Array
    seen: npt.NDArray[np.bool_]
    whitening: Array
    log_scale: Array


class MeasurementReader:
    """Turns what users hand in into readings.

    Parameters
    ----------
    layout
        What may be seen, and where it is put.
    """

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        observations = layout.observations
        self._index = {one.name: i for i, one in enumerate(observations)}
        self._whitening = np.concatenate([whitening(one.covariance).reshape(-1) for one in observations])
        self._log_scale = np.array([log_scale(one.covariance) for one in observations])
        self._size = layout.seen_slices[-1].stop
        self._vectors = [one.label for one in observations if not one.is_pose]
        self._all = np.ones(len(observations), dtype=bool)

    def nothing(self) -> Measurements:
        """Return a reading of which all is missing."""
        return Measurements(np.zeros(self._size), ~self._all, self._whitening, self._log_scale)

    def values_of(self, said: Array) -> Array:
        """Return what a model says, as if it had been seen."""
        values = np.zeros(self._size)
        for i, one in enumerate(self._layout.observations):
            value = said[self._layout.value_slices[i]]
            if one.is_pose:
                value = transform(value[:9].reshape(3, 3), value[9:]).reshape(-1)
            values[self._layout.seen_slices[i]] = value
        return values

    def read(self, given: Mapping[str, Any]) -> Measurements:
        """Return what was seen, from a mapping by name; what is absent is missing.

        Whether poses are rigid is not looked at yet, see :meth:`check_poses`.

        Raises
        ------
        UnknownNameError, ShapeError, InvalidValueError
            For other names, shapes, vectors that are not finite and covariances that are not positive.
        """
        if not isinstance(given, Mapping):
            raise InvalidValueError(f"What was seen is a mapping {{frame: pose}}, not {given!r:.80}.")
        values, seen, whitenings, scales = self.nothing()
        for name, value in given.items():
            i = self._index.get(name)
            if i is None:
                hint = suggest(str(name), self._index, "observation")
                raise UnknownNameError(f"'{name}' is not observed. {hint}")
            one = self._layout.observations[i]
            if _is_pair(value, one):
                value, covariance = value
                checked = require_covariance(covariance, one.size, one.label)
                if whitenings is self._whitening:
                    whitenings, scales = whitenings.copy(), scales.copy()
                whitenings[self._layout.white_slices[i]] = whitening(checked).reshape(-1)
                scales[i] = log_scale(checked)
            values[self._layout.seen_slices[i]] = (
                _pose_like(value, one.label).reshape(-1) if one.is_pose else _checked_vector(value, one)
            )
            seen[i] = True
        return Measurements(values, seen, whitenings, scales)

    def read_poses(self, poses: npt.ArrayLike, mask: npt.ArrayLike | None) -> Measurements:
        """Return what was seen, from an array of poses in the order of the observations.

        They are not looked at yet, see :meth:`check_poses`.

        Raises
        ------
        ShapeError, InvalidValueError
            If there are others than poses, or for other shapes.
        """
        if self._vectors:
            raise InvalidValueError(
                f"update_poses is for poses alone, which {', '.join(self._vectors)} is not. Use update."
            )
        given = _numbers(poses, "The poses")
        count = len(self._all)
        if given.shape != (count, 4, 4):
            raise ShapeError(f"The poses are an array of shape {(count, 4, 4)}, not {given.shape}.")
        seen = self._all if mask is None else np.ascontiguousarray(mask)
        if seen.dtype != bool or seen.shape != (count,):
            raise ShapeError(f"seen= is a mask of {count} booleans, not {mask!r:.80}.")
        values = np.ascontiguousarray(given).reshape(-1)
        return Measurements(values, seen, self._whitening, self._log_scale)

    def check_poses(self, reading: Measurements) -> None:
        """Check the poses that were seen.

        Raises
        ------
        InvalidValueError
            Naming the first that is not rigid.
        """
        for i, one in enumerate(self._layout.observations):
            if one.is_pose and reading.seen[i]:
                check_pose(reading.values[self._layout.seen_slices[i]].reshape(4, 4), one.label)


def check_pose(pose: Array, label: str) -> None:
    """Check a 4×4 matrix.

    Raises
    ------
    InvalidValueError
        If it is no rigid transform, saying by how much it is off.
    """
    if not np.isfinite(pose).all():
        raise InvalidValueError(f"The pose of '{label}' is not finite.")
    rotation = pose[:3, :3]
    off = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
    if off > RIGID:
        raise InvalidValueError(
            f"The pose of '{label}' is not rigid: RᵀR is off from the identity by {off:.3g}."
        )
    if np.linalg.det(rotation) < 0:
        raise InvalidValueError(f"The pose of '{label}' is a reflection: its rotation has determinant -1.")
    last = float(np.abs(pose[3] - [0, 0, 0, 1]).max())
    if last > RIGID:
        raise InvalidValueError(
            f"The last row of the pose of '{label}' is off from (0, 0, 0, 1) by {last:.3g}."
        )


def _is_pair(value: Any, one: MeasurementModel) -> bool:
    """Whether something is a value and its covariance, and not the two numbers of a vector."""
    if not (isinstance(value, tuple) and len(value) == 2):
        return False
    return one.size != 2 or np.ndim(value[0]) > 0


def _pose_like(given: npt.ArrayLike, label: str) -> Array:
    pose = _numbers(given, f"The pose of '{label}'")
    if pose.shape != (4, 4):
        raise ShapeError(f"The pose of '{label}' is a 4×4 transform, not of shape {pose.shape}.")
    return pose


def whitening(covariance: Array) -> Array:
    """Return the lower triangle W with Wᵀ W = R⁻¹."""
    found: Array = np.linalg.inv(np.linalg.cholesky(covariance))
    return np.tril(found)


def log_scale(covariance: Array) -> float:
    """Return ½ log |2πR|."""
    logarithms = np.log(np.diag(np.linalg.cholesky(covariance)))
    return float(logarithms.sum() + len(covariance) * np.log(2 * np.pi) / 2)


def _checked_vector(given: Any, one: MeasurementModel) -> Array:
    vector = _numbers(given, f"The value of '{one.label}'")
    if vector.shape == () and one.size == 1:
        vector = vector.reshape(1)
    if vector.shape != (one.size,):
        raise ShapeError(f"The value of '{one.label}' has shape {(one.size,)}, not {vector.shape}.")
    if not np.isfinite(vector).all():
        raise InvalidValueError(f"The value of '{one.label}' is not finite.")
    return vector


def _numbers(given: npt.ArrayLike, what: str) -> Array:
    try:
        if np.iscomplexobj(given):
            raise TypeError
        return np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError):
        raise InvalidValueError(f"{what}: these are no numbers: {given!r:.80}.") from None


class Residuals:
    """Whitened errors of observations: of a pose (p_seen - p, log(R_seen Rᵀ)), in the axes of the observer.

    Parameters
    ----------
    layout, function
        Where numbers are, and what computes them.
    """

    def __init__(self, layout: Layout, function: CompiledFunction) -> None:
        self._layout = layout
        self._function = function
        self._widths = [len(layout.groups[number].tangent) for number in layout.group_of]

    def evaluate(self, x: Array, known: Array) -> Array:
        """Return values and derivatives of everything at a state, not whitened."""
        found: Array = self._function(np.concatenate([x, known]))
        return found

    def errors(
        self, out: Array, reading: Measurements, which: Sequence[int]
    ) -> dict[int, tuple[Array, Array]]:
        """Return for each observation seen its whitened error (d,), and derivative of the model (d, t).

        Parameters
        ----------
        out
            What :meth:`evaluate` gave.
        which
            The observations that are wanted.
        """
        layout = self._layout
        seen = [i for i in which if reading.seen[i]]
        values = {i: reading.values[layout.seen_slices[i]] for i in seen}
        errors: dict[int, Array] = {}
        slopes: dict[int, Array] = {}
        for i in seen:
            size = layout.observations[i].size
            slopes[i] = out[layout.slope_slices[i]].reshape(size, self._widths[i])
        poses = [i for i in seen if layout.observations[i].is_pose]
        if poses:
            said = np.stack([out[layout.value_slices[i]] for i in poses])
            found = np.stack([values[i] for i in poses]).reshape(-1, 4, 4)
            differences = pose_difference(found, transform(said[:, :9].reshape(-1, 3, 3), said[:, 9:]))
            back = inverse_right_jacobian(differences[:, 3:])
            errors.update(zip(poses, differences, strict=True))
            for i, turn in zip(poses, back, strict=True):
                slope = slopes[i]
                slopes[i] = np.concatenate([slope[:3], turn @ slope[3:]])
        for i in seen:
            if i not in errors:
                errors[i] = wrap_difference(
                    values[i] - out[layout.value_slices[i]], layout.observations[i].period
                )
        pairs = {}
        for i in seen:
            size = layout.observations[i].size
            white = reading.whitening[layout.white_slices[i]].reshape(size, size)
            pairs[i] = white @ errors[i], white @ slopes[i]
        return pairs

    def check(self, out: Array, which: Sequence[int]) -> None:
        """Raise an error that names an observation whose value or derivative is not finite.

        Raises
        ------
        InvalidValueError
            Naming it.
        """
        for i in which:
            one = self._layout.observations[i]
            for where in (self._layout.value_slices[i], self._layout.slope_slices[i]):
                if not np.isfinite(out[where]).all():
                    raise InvalidValueError(
                        f"The model says nothing finite about '{one.label}' or its derivative at the present "
                        "estimate. Give start= a state where it does, or the model limits."
                    )
