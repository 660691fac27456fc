"""Noisy synthetic poses of frames of a model."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

import kineverse as kv
from kineverse.estimation import pose_covariance

Array = npt.NDArray[np.float64]

POSITION, ORIENTATION = 0.01, 0.02
NOISE = pose_covariance(POSITION, ORIENTATION)


def observe_frames(
    model: kv.Model, frames: Iterable[str], values: Mapping[str, npt.ArrayLike], seed: int
) -> dict[str, Array]:
    """Return noisy poses (N, 4, 4) of frames at N values of some coordinates."""
    random = np.random.default_rng(seed)
    symbols = [model.symbol(name) for name in values]
    points = np.column_stack([np.asarray(v, dtype=np.float64) for v in values.values()])
    result = {}
    for frame in frames:
        poses = kv.compile(model.fk(frame), symbols).batch(points)
        poses[:, :3, 3] += random.normal(0.0, POSITION, (len(poses), 3))
        turns = Rotation.from_rotvec(random.normal(0.0, ORIENTATION, (len(poses), 3)))
        poses[:, :3, :3] = turns.as_matrix() @ poses[:, :3, :3]
        result[frame] = poses
    return result


def shift_origin(joint: kv.Joint, x: float = 0.0, y: float = 0.0) -> kv.model.Pose:
    matrix = np.array(joint.origin.matrix)
    matrix[:2, 3] += (x, y)
    return kv.model.Pose.from_matrix(matrix)
