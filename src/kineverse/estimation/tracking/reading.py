"""What was seen at one step, checked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from kineverse.errors import ShapeError, UnknownNameError, ValueRejectedError, suggest
from kineverse.estimation.noise import Array

from .observed import Observation, checked_covariance

RIGID = 1e-4
"""How far RᵀR may be from the identity; a pose in single precision is off by 1e-6."""


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """What was seen.

    Attributes
    ----------
    values
        For each observation its (12,) rotation row by row and position, or its vector; None if it is missing.
    whitening
        For each the matrix that makes errors independent and of deviation 1.
    log_scale
        For each ½ log |2πR|.
    """

    values: list[Array | None]
    whitening: list[Array]
    log_scale: Array


class Reader:
    """Turns what users hand in into readings.

    Parameters
    ----------
    observations
        What may be seen.
    """

    def __init__(self, observations: tuple[Observation, ...]) -> None:
        self._observations = observations
        self._index = {one.name: i for i, one in enumerate(observations)}
        self.whitening = [whitening(one.covariance) for one in observations]
        self.log_scale = np.array([log_scale(one.covariance) for one in observations])

    def read(self, seen: Mapping[str, Any]) -> Reading:
        """Return what was seen, from a mapping by name; what is absent is missing.

        Raises
        ------
        UnknownNameError, ShapeError, ValueRejectedError
            For other names, shapes, numbers that are not finite, poses that are not rigid and covariances
            that are not positive.
        """
        if not isinstance(seen, Mapping):
            raise ValueRejectedError(f"What was seen is a mapping {{frame: pose}}, not {seen!r:.80}.")
        values: list[Array | None] = [None] * len(self._observations)
        whitenings, scales = list(self.whitening), self.log_scale.copy()
        for name, given in seen.items():
            i = self._index.get(name)
            if i is None:
                raise UnknownNameError(
                    f"'{name}' is not observed. {suggest(str(name), self._index, 'observation')}"
                )
            one = self._observations[i]
            if isinstance(given, tuple) and len(given) == 2:
                given, covariance = given
                if covariance is not None:
                    checked = checked_covariance(covariance, one.size, one.label)
                    whitenings[i], scales[i] = whitening(checked), log_scale(checked)
            values[i] = pose_of(given, one.label) if one.is_pose else _vector_of(given, one)
        return Reading(values, whitenings, scales)

    def read_poses(self, poses: npt.ArrayLike, seen: npt.ArrayLike | None) -> Reading:
        """Return what was seen, from an array of poses in the order of the observations."""
        if not all(one.is_pose for one in self._observations):
            others = ", ".join(one.label for one in self._observations if not one.is_pose)
            raise ValueRejectedError(
                f"update_poses is for poses alone; of these none is seen: {others}. Use update."
            )
        given = _numbers(poses, "The poses")
        count = len(self._observations)
        if given.shape != (count, 4, 4):
            raise ShapeError(f"The poses are an array of shape {(count, 4, 4)}, not {given.shape}.")
        mask = np.ones(count, dtype=bool) if seen is None else np.asarray(seen)
        if mask.dtype != bool or mask.shape != (count,):
            raise ShapeError(f"seen= is a mask of {count} booleans, not {seen!r:.80}.")
        values = [
            pose_of(pose, one.label) if is_seen else None
            for pose, one, is_seen in zip(given, self._observations, mask.tolist(), strict=True)
        ]
        return Reading(values, self.whitening, self.log_scale)


def pose_of(given: npt.ArrayLike, label: str) -> Array:
    """Return a pose as (12,), rotation row by row, then position.

    Raises
    ------
    ShapeError, ValueRejectedError
        If it is no rigid transform; by how much it is off.
    """
    pose = _numbers(given, f"The pose of '{label}'")
    if pose.shape != (4, 4):
        raise ShapeError(f"The pose of '{label}' is a 4×4 transform, not of shape {pose.shape}.")
    if not np.isfinite(pose).all():
        raise ValueRejectedError(f"The pose of '{label}' is not finite.")
    rotation = pose[:3, :3]
    off = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
    if off > RIGID:
        raise ValueRejectedError(
            f"The pose of '{label}' is not rigid: RᵀR is off from the identity by {off:.3g}."
        )
    if np.linalg.det(rotation) < 0:
        raise ValueRejectedError(
            f"The pose of '{label}' is a reflection: the determinant of its rotation is -1."
        )
    last = float(np.abs(pose[3] - [0, 0, 0, 1]).max())
    if last > RIGID:
        raise ValueRejectedError(
            f"The pose of '{label}' has a last row that is off from (0, 0, 0, 1) by {last:.3g}."
        )
    return np.concatenate([rotation.reshape(9), pose[:3, 3]])


def whitening(covariance: Array) -> Array:
    """Return W with Wᵀ W = R⁻¹."""
    found: Array = np.linalg.inv(np.linalg.cholesky(covariance))
    return found


def log_scale(covariance: Array) -> float:
    """Return ½ log |2πR|."""
    return float(
        np.log(np.diag(np.linalg.cholesky(covariance))).sum() + len(covariance) * np.log(2 * np.pi) / 2
    )


def _vector_of(given: Any, one: Observation) -> Array:
    vector = _numbers(given, f"The value of '{one.label}'")
    if vector.shape == () and one.size == 1:
        vector = vector.reshape(1)
    if vector.shape != (one.size,):
        raise ShapeError(f"The value of '{one.label}' has shape {(one.size,)}, not {vector.shape}.")
    if not np.isfinite(vector).all():
        raise ValueRejectedError(f"The value of '{one.label}' is not finite.")
    return vector


def _numbers(given: npt.ArrayLike, what: str) -> Array:
    try:
        return np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueRejectedError(f"{what} are not numbers: {given!r:.80}.") from None
