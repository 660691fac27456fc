"""Start of a calibration: free mounts in closed form, from any present ones.

The pose of a frame with free mounts X and Y in its chain is L X B Y R, with known transforms L, B, R. One
mount is then the mean of L⁻¹ S R⁻¹ over the seen poses S. Two are the solution of A = X B Y (robot-world and
hand-eye calibration): the rotations by the singular vectors of Σ R_A ⊗ R_B (Shah, 2013, Eq. 20), then the
positions by linear least squares. Weights of a Cauchy density keep gross errors from both.

The transforms come from the values and derivatives of the compiled poses alone, so a mount may be anywhere in
a chain, also of the observing camera, whose inverse it enters.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from kineverse.estimation.noise import cauchy_weight
from kineverse.lie import (
    Array,
    exp_so3,
    inverse,
    log_so3,
    mean_rotation,
    pose_difference,
    transform,
)

from .observations import CompiledBlock

_ROUNDS = 4  # of weights
_PROBE = np.array([0.3, -0.2, 0.4, 0.5, 0.7, -0.6])  # any mount far from the identity [m], [rad]
_AGREES = 1e-6  # difference of two forms of one pose, which rounding explains [m], [rad]


class _Place(NamedTuple):
    """Place of a mount in a chain: the transforms before it, and whether its inverse stands there."""

    before: Array  # (N, 4, 4)
    sign: int


def start_mounts(
    blocks: Sequence[tuple[CompiledBlock, Sequence[int]]],  # of poses, with columns of their parameters
    mounts: Sequence[Sequence[int]],  # columns of the six numbers of each
    values: Array,  # of all parameters, 0 for mounts
) -> Array:
    """Return values with mounts in closed form where seen poses tell them, the others as they are."""
    values, open_mounts = values.copy(), [list(mount) for mount in mounts]
    progress = True
    while open_mounts and progress:
        progress = False
        # Blocks with a single unknown mount first: those with two may then have one.
        for wanted in (1, 2):
            for block, columns in blocks:
                here = [mount for mount in open_mounts if set(mount) <= set(columns)]
                if len(here) != wanted:
                    continue
                found = _solve_block(block, list(columns), here, values)
                for mount, numbers in zip(here, found or (), strict=False):
                    values[mount] = numbers
                if found is not None:
                    open_mounts = [mount for mount in open_mounts if mount not in here]
                    progress = True
                    break
            if progress:
                break
    return values


def _solve_block(
    block: CompiledBlock, columns: list[int], mounts: list[list[int]], values: Array
) -> list[Array] | None:
    """Return the numbers of one or two mounts from the poses of a block; None if they stand otherwise."""
    poses = block.poses(values[columns])
    twists = block.twists(values[columns], poses)
    places = [_find_place(poses, twists[:, :, [columns.index(c) for c in mount]]) for mount in mounts]
    seen = np.broadcast_to(np.eye(4), poses.shape).copy()
    seen[:, :3] = block.seen.reshape(-1, 3, 4)
    probe = values.copy()
    for mount in mounts:
        probe[mount] = _PROBE
    probed = block.poses(probe[columns])
    for order in ([0], [0, 1], [1, 0]):
        if len(order) != len(mounts):
            continue
        first, last = places[order[0]], places[order[-1]]
        rest = inverse(last.before) @ poses
        between = inverse(first.before) @ last.before
        moved = [_power(_mount(_PROBE), places[k].sign) for k in order]
        chain = first.before @ moved[0]
        chain = chain @ between @ moved[1] @ rest if len(order) == 2 else chain @ rest
        if np.abs(chain - probed).max() > _AGREES:
            continue
        left = inverse(first.before) @ seen @ inverse(rest)
        solved = _average(left) if len(order) == 1 else _align(left, between)
        numbers: list[Array] = [np.zeros(6)] * len(order)
        for k, pose in zip(order, solved, strict=True):
            solution = _power(pose, places[k].sign)
            numbers[k] = np.concatenate([solution[:3, 3], log_so3(solution[:3, :3])])
        return numbers
    return None


def _find_place(poses: Array, twists: Array) -> _Place:
    """Return the place of a mount from the twists (N, 6, 6) of the poses by its six numbers."""
    turned = twists[:, :3, :3]  # ±R of the chain before the mount
    sign = 1 if np.linalg.det(turned).mean() > 0 else -1
    # The column of a rotation about axis k is u_k × a, with u_k of above and the arm a of the pose.
    arm = -0.5 * np.cross(turned, twists[:, :3, 3:], axis=1).sum(axis=2)
    return _Place(transform(sign * turned, poses[:, :3, 3] - arm), sign)


def _mount(numbers: Array) -> Array:
    return transform(exp_so3(numbers[3:]), numbers[:3])


def _power(pose: Array, sign: int) -> Array:
    return pose if sign > 0 else inverse(pose)


def _average(poses: Array) -> list[Array]:
    """Return the robust mean of poses (N, 4, 4)."""
    weights = np.ones(len(poses))
    for _ in range(_ROUNDS):
        rotation = mean_rotation(poses[:, :3, :3] * weights[:, None, None])
        mean = transform(rotation, weights @ poses[:, :3, 3] / weights.sum())
        weights = _weights(pose_difference(poses, mean))
    return [mean]


def _align(left: Array, middle: Array) -> list[Array]:
    """Return X and Y with A = X B Y for poses A and B, (N, 4, 4)."""
    weights = np.ones(len(left))
    for _ in range(_ROUNDS):
        products = np.einsum("n,nki,nlj->ijkl", weights, left[:, :3, :3], middle[:, :3, :3])
        u, _, vt = np.linalg.svd(products.reshape(9, 9))
        z, x = u[:, 0].reshape(3, 3), vt[0].reshape(3, 3)
        turn = 1.0 if np.linalg.det(x) > 0 else -1.0
        rotation, back = mean_rotation(turn * x[None]), mean_rotation(turn * z[None])
        # p_A = R_X R_B t_Y + R_X p_B + t_X
        rows = np.concatenate(
            [rotation @ middle[:, :3, :3], np.broadcast_to(np.eye(3), (len(left), 3, 3))], axis=2
        )
        wanted = left[:, :3, 3] - middle[:, :3, 3] @ rotation.T
        root = np.sqrt(weights)[:, None, None]
        solution = np.linalg.lstsq((root * rows).reshape(-1, 6), (root[..., 0] * wanted).ravel(), rcond=None)[
            0
        ]
        first, second = transform(rotation, solution[3:]), transform(back.T, solution[:3])
        weights = _weights(pose_difference(left, first @ middle @ second))
    return [first, second]


def _weights(errors: Array) -> Array:
    """Return Cauchy weights of pose errors (N, 6) at the scale of their medians."""
    square = np.zeros(len(errors))
    for part in (errors[:, :3], errors[:, 3:]):
        norms = np.square(part).sum(axis=1)
        square += 3.0 * norms / max(float(np.median(norms)), 1e-20)
    return np.asarray(cauchy_weight(square, 6))  # type: ignore[arg-type]
