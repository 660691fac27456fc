"""Checked observations and tracks of poses with covariances and gaps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from kineverse.errors import InvalidValueError, ShapeError
from kineverse.estimation.noise import as_numbers, check_covariances, check_finite, check_rigid
from kineverse.lie import Array, inverse, translation

_THIN = 4.0  # factor between successive levels of the continuation


@dataclass(frozen=True, eq=False)
class Observations:
    """Poses of a parent and a child in one frame, with the covariances of their errors."""

    parent: Array  # world_T_parent, (N, 4, 4); identities if the parent is the world
    child: Array  # world_T_child, (N, 4, 4). If only positions were observed, the rotations are arbitrary
    parent_covariance: Array | None  # (N, 6, 6), see kineverse.estimation.noise
    child_covariance: Array  # (N, m, m) with m = 6, or m = 3 if only positions were observed

    def __len__(self) -> int:
        return len(self.child)

    @property
    def rows(self) -> int:
        """6, or 3 if only positions of the child were observed."""
        return int(self.child_covariance.shape[-1])

    @cached_property
    def relative(self) -> Array:
        """Observed parent_T_child, (N, 4, 4)."""
        return inverse(self.parent) @ self.child

    def select(self, rows: slice | npt.NDArray[np.int_]) -> Observations:
        """Return the observations of some rows."""
        of_parent = None if self.parent_covariance is None else self.parent_covariance[rows]
        return Observations(self.parent[rows], self.child[rows], of_parent, self.child_covariance[rows])

    def scaled(self, factor: float | Array) -> Observations:
        """Return the same observations with covariances times a factor, a number or (..., 6, 6)."""
        rows, of_child = self.rows, np.asarray(factor)
        if of_child.shape[-1:] == (6,):
            of_child = of_child[..., :rows, :rows]
        of_parent = None if self.parent_covariance is None else factor * self.parent_covariance
        return Observations(self.parent, self.child, of_parent, of_child * self.child_covariance)

    @cached_property
    def softened(self) -> tuple[Observations, ...]:
        """The same observations with less precise positions, the least precise first.

        They are the levels of a continuation. If positions are much more precise than orientation errors
        times the lever, the likelihood is a narrow and curved valley, which Gauss-Newton steps do not enter.
        """
        if self.parent_covariance is None:
            return ()
        lever = float(np.sqrt(np.mean(np.sum(self.relative[:, :3, 3] ** 2, axis=1))))
        turned = lever * float(np.sqrt(np.mean(np.einsum("nii->ni", self.parent_covariance)[:, 3:])))
        place = float(np.sqrt(np.mean(np.einsum("nii->ni", self.child_covariance)[:, :3])))
        levels, factor = [], 0.5 * turned / place
        # The margin keeps rounding from adding a level to observations that are softened already.
        while factor > _THIN * (1.0 + 1e-9):
            factors = np.array([factor] * 3 + [1.0] * 3)
            levels.append(self.scaled(np.outer(factors, factors)))
            factor /= _THIN
        return tuple(levels)


def check_observations(
    parent: npt.ArrayLike | None,
    child: npt.ArrayLike,
    parent_covariance: npt.ArrayLike | None,
    child_covariance: npt.ArrayLike,
    fewest: int = 2,
) -> Observations:
    """Check poses and covariances and return them as observations."""
    b = as_numbers(child, "The poses of the child")
    positions = b.ndim == 2 and b.shape[1:] == (3,)
    if not positions and b.shape[1:] != (4, 4):
        raise ShapeError(
            f"The poses of the child are an array of shape (N, 4, 4), or (N, 3) for positions, not {b.shape}."
        )
    if len(b) < fewest:
        raise InvalidValueError(
            f"There {'is one pose' if len(b) else 'are no poses'} of the child. A motion takes at least two."
        )
    if positions:
        check_finite(b, "child")
        b = translation(b)
    else:
        check_rigid(b, "child")
    if parent is None:
        a = np.tile(np.eye(4), (len(b), 1, 1))
    else:
        a = as_numbers(parent, "The poses of the parent")
        if a.shape == (4, 4):
            a = np.tile(a, (len(b), 1, 1))
        if a.shape[1:] != (4, 4):
            raise ShapeError(f"The poses of the parent are an array of shape (N, 4, 4), not {a.shape}.")
        if len(a) != len(b):
            raise ShapeError(
                f"There are {len(a)} poses of the parent and {len(b)} of the child. They come in pairs."
            )
        check_rigid(a, "parent")
    of_parent = None
    if parent is not None and parent_covariance is not None:
        of_parent = check_covariances(parent_covariance, len(b), 6, "parent")
    of_child = check_covariances(child_covariance, len(b), 3 if positions else 6, "child")
    return Observations(np.ascontiguousarray(a), np.ascontiguousarray(b), of_parent, of_child)


PosesLike: TypeAlias = "npt.ArrayLike | tuple[npt.ArrayLike, npt.ArrayLike]"
"""Poses (N, 4, 4), or a pair of poses and covariance: a common one, see :mod:`.noise`, or (N, 6, 6) of
each pose. Where points are accepted, positions (N, 3)."""


@dataclass(frozen=True)
class PoseTrack:
    """Poses of one frame over time."""

    poses: Array  # (N, 4, 4). The rotations of a point are arbitrary
    covariances: Array | None  # (N, 6, 6), or (N, 3, 3) of a point; None for exact poses
    observed: npt.NDArray[np.bool_]  # mask of the times with an observation, (N,)

    @property
    def is_point(self) -> bool:
        """True if only positions were observed."""
        return self.covariances is not None and self.covariances.shape[-1] == 3


def check_tracks(
    observations: Mapping[str, PosesLike], noise: npt.ArrayLike | None, points: bool = False
) -> dict[str, PoseTrack]:
    """Check the observations of frames over time and return them as tracks."""
    if not isinstance(observations, Mapping):
        raise ShapeError("Observations are a mapping from names of frames to poses of shape (N, 4, 4).")
    tracks = {name: _track(name, poses, noise, points) for name, poses in observations.items()}
    counts = {name: len(track.poses) for name, track in tracks.items()}
    if len(set(counts.values())) > 1:
        listed = ", ".join(f"{count} of '{name}'" for name, count in counts.items())
        raise ShapeError(
            f"There are poses at different numbers of times: {listed}. A pose that was not observed is NaN."
        )
    return tracks


def _track(name: str, observed: Any, noise: npt.ArrayLike | None, points: bool) -> PoseTrack:
    covariance = noise
    if isinstance(observed, tuple) and len(observed) == 2:
        observed, covariance = observed
    poses = as_numbers(observed, f"The poses of '{name}'").copy()
    is_point = points and poses.ndim == 2 and poses.shape[1] == 3
    if is_point:
        is_missing = np.isnan(poses).all(axis=1)
        poses = translation(poses)
        poses[is_missing] = np.nan
    if poses.ndim != 3 or poses.shape[1:] != (4, 4):
        also = ", or (N, 3) of a point" if points else ""
        raise ShapeError(f"The poses of '{name}' are an array of shape (N, 4, 4){also}, not {poses.shape}.")
    if covariance is None:
        raise InvalidValueError(
            f"The noise of '{name}' is unknown: give a pair of poses and their covariance, or "
            "noise=kv.estimation.pose_covariance(position, orientation)."
        )
    rows = 3 if is_point else 6
    if not len(poses):
        return PoseTrack(poses, np.zeros((0, rows, rows)), np.zeros(0, dtype=bool))
    mask: npt.NDArray[np.bool_] = np.logical_not(np.isnan(poses).all(axis=(1, 2)))
    poses[~mask] = np.eye(4)
    check_rigid(poses, f"frame '{name}'")
    spread = np.array(covariance, dtype=np.float64)
    if spread.ndim == 3 and len(spread) == len(mask):
        spread[~mask] = np.eye(spread.shape[-1])
    return PoseTrack(poses, check_covariances(spread, len(poses), rows, f"frame '{name}'"), mask)


def exact_track(count: int) -> PoseTrack:
    """Return the exact track of the observer's frame."""
    return PoseTrack(np.tile(np.eye(4), (count, 1, 1)), None, np.ones(count, dtype=bool))


def pair_tracks(parent: PoseTrack, child: PoseTrack, rows: npt.NDArray[Any]) -> Observations:
    """Return the observations of two frames at some times."""
    assert child.covariances is not None  # only the observer is exact, and it is never a child
    of_parent = None if parent.covariances is None else parent.covariances[rows]
    return Observations(parent.poses[rows], child.poses[rows], of_parent, child.covariances[rows])


def concatenate_tracks(parts: Sequence[PoseTrack]) -> PoseTrack:
    """Return tracks joined in time."""
    known = [part.covariances for part in parts if part.covariances is not None]
    poses = np.concatenate([part.poses for part in parts])
    observed = np.concatenate([part.observed for part in parts])
    return PoseTrack(poses, np.concatenate(known) if known else None, observed)
