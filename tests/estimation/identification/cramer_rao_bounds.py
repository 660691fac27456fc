"""Cramér-Rao bounds of joint parameters by finite differences, independent of the estimator.

Seen are both poses. Unknown are the axis and its place, the child's pose, and for each observation the parent's true
pose (6) and the joint value (1), last. With joint values as further unknowns this is the Cramér-Rao bound. Where
a motion is short beside the noise nobody reaches it, as there are as many unknowns as observations: the bound of joint
values drawn from a Gaussian of known width is attainable then.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation
from synthetic_recordings import Array, Recording, transform

STEP = 1e-5


def direction_bound(data: Recording, family: str, width: float | None = None) -> float:
    """Return the least root mean square angle of the axis [rad]; joint values have that width, or any."""
    covariance = covariance_bound(data, family, width)
    return float(np.sqrt(covariance[0, 0] + covariance[1, 1]))


def covariance_bound(data: Recording, family: str, width: float | None = None) -> Array:
    """Return the least covariance: two turns of the axis, two shifts of it, the child's pose in the joint's frame."""
    shared = 10 if family == "revolute" else 8
    deviation = np.sqrt(np.tile(np.diag(data.covariance), 2))
    information = np.zeros((shared, shared))
    for k, parent in enumerate(data.true_parent):
        value = float(data.values[k, 0])
        truth = _poses(data, family, parent, value, np.zeros(shared + 7))
        columns = []
        for i in range(shared + 7):
            change = np.zeros(shared + 7)
            change[i] = STEP
            there, back = (_poses(data, family, parent, value, sign * change) for sign in (1, -1))
            columns.append((_apart(there, truth) - _apart(back, truth)) / (2 * STEP))
        whitened = np.column_stack(columns) / deviation[:, None]
        if width is not None:
            # The information that a value from a Gaussian carries, at the value that noise leaves of it.
            whitened = np.vstack([whitened, np.eye(shared + 7)[-1] / width])
        full = whitened.T @ whitened
        common, mixed, own = full[:shared, :shared], full[:shared, shared:], full[shared:, shared:]
        left = common - mixed @ np.linalg.solve(own, mixed.T)
        if width is not None:
            blind, alone = whitened[:-1, shared:-1], whitened[:-1, -1]
            alone = alone - blind @ np.linalg.lstsq(blind, alone, rcond=None)[0]
            known = float(alone @ alone)
            left = left * known / (known + width**-2)
        information += left
    # The joint's zero is a matter of choice; a little information about it changes nothing else.
    return np.linalg.inv(information + 1e-9 * np.eye(shared))


def _poses(data: Recording, family: str, parent: Array, value: float, change: Array) -> Array:
    """Return both poses if the unknowns are off by so much, (2, 4, 4)."""
    turn = Rotation.from_rotvec([change[0], change[1], 0.0])
    shift, rest = (change[2:4], change[4:]) if family == "revolute" else (np.zeros(2), change[2:])
    joint = transform(turn, [*shift, 0.0])
    moved = np.zeros(6)
    moved[5 if family == "revolute" else 2] = value + rest[12]
    motion = transform(Rotation.from_rotvec(moved[3:]), moved[:3])
    child = transform(Rotation.from_rotvec(rest[3:6]), rest[:3]) @ data.right
    there = parent.copy()
    there[:3, 3] += rest[6:9]
    there[:3, :3] = Rotation.from_rotvec(rest[9:12]).as_matrix() @ parent[:3, :3]
    return np.stack([there, there @ data.left @ joint @ motion @ child])


def _apart(poses: Array, others: Array) -> Array:
    turned = Rotation.from_matrix(poses[:, :3, :3] @ np.swapaxes(others[:, :3, :3], 1, 2)).as_rotvec()
    return np.concatenate([poses[:, :3, 3] - others[:, :3, 3], turned], axis=1).ravel()
