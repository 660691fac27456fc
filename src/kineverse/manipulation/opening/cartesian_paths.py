"""Batched inverse kinematics of a hand along sequences of poses, and the configurations that it gives."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kineverse.compilation import compile
from kineverse.lie import Array, log_so3
from kineverse.model.model_view import ModelView
from kineverse.symbols import Symbol

_DAMPING = 1e-6
_CENTERING = 0.1  # share of the distance to the middle of the limits that a step takes in the null space
_LONGEST = 0.4  # largest step of a coordinate [m], [rad]
_JUMP = 0.6  # largest change of a coordinate between neighbouring poses of a sequence [m], [rad]
TOLERANCE = 1e-4  # error of a pose that counts as reached [m], [rad]


class CartesianPaths:
    """Damped Newton steps of many configurations at once, within the limits of the coordinates.

    A step is ``W Jᵀ (J W Jᵀ + λ)⁻¹ e`` with the error e of position and rotation vector, and a step to the
    middle of limits in the null space (Nakamura 1991). Coordinates outside of their limits are clipped, and
    those that a step would lead out of them rest in it.
    """

    def __init__(
        self, model: ModelView, hand: str, moving: Sequence[Symbol], still: Sequence[Symbol], ease: Array
    ) -> None:
        self.moving, self.still = tuple(moving), tuple(still)
        pose = model.fk(hand)
        jacobian = model.jacobian(hand, form="world_aligned", symbols=[s.derivative() for s in moving])
        self._f = compile([pose, jacobian], [*self.moving, *self.still])
        limits = np.array([model.limits(s) for s in moving], dtype=float).reshape(-1, 2)
        self.lower, self.upper = limits.T
        bounded = np.isfinite(limits).all(axis=1)
        self._middle = np.where(bounded, np.where(bounded[:, None], limits, 0.0).mean(axis=1), np.nan)
        self.ease = ease

    def solve(self, Q: Array, base: Array, targets: Array, iterations: int) -> tuple[Array, Array]:
        """Return configurations (N, n) near to given ones at which the hand is at poses, and errors (N,)."""
        Q = Q.copy()
        for k in range(iterations + 1):
            poses, J = self._f.batch(np.hstack([Q, base]))
            turn = log_so3(targets[:, :3, :3] @ np.swapaxes(poses[:, :3, :3], 1, 2))
            e = np.hstack([targets[:, :3, 3] - poses[:, :3, 3], turn])
            error = np.abs(e).max(axis=1)
            if k == iterations or (error < TOLERANCE / 10).all():
                break
            center = np.nan_to_num(_CENTERING * (self._middle - Q)) * self.ease
            step = self._step(J, e, center, np.tile(self.ease, (len(Q), 1)), error)
            # A coordinate at its limit takes no part: the others go on without it.
            outward = ((self.lower >= Q) & (step < 0.0)) | ((self.upper <= Q) & (step > 0.0))
            stuck = outward.any(axis=1)
            if stuck.any():
                free = np.where(outward[stuck], 0.0, self.ease)
                step[stuck] = self._step(J[stuck], e[stuck], center[stuck] * (free > 0.0), free, error[stuck])
            step *= np.minimum(1.0, _LONGEST / np.maximum(np.abs(step).max(axis=1), 1e-9))[:, None]
            Q = np.clip(Q + step, self.lower, self.upper)
        return Q, error

    @staticmethod
    def _step(J: Array, e: Array, center: Array, ease: Array, error: Array) -> Array:
        """Return damped Newton steps (N, n) for weights (N, n), centred in the null space."""
        WJt = ease[:, :, None] * np.swapaxes(J, 1, 2)
        damped = J @ WJt + (_DAMPING + 1e-3 * np.minimum(error, 0.5) ** 2)[:, None, None] * np.eye(6)
        rest = e - (J @ center[:, :, None])[:, :, 0]
        return np.asarray(center + (WJt @ np.linalg.solve(damped, rest[:, :, None]))[:, :, 0])

    def find_poses(self, Q: Array, base: Array) -> Array:
        """Return poses world_T_hand (N, 4, 4) at configurations (N, n), with values (m,) of what stands."""
        poses, _ = self._f.batch(np.hstack([Q, np.tile(base, (len(Q), 1))]))
        return np.asarray(poses)

    def find_heights(self, Q: Array, base: Array, points: Array) -> tuple[Array, Array]:
        """Return the heights (N,) of the highest of some points of the hand, and their derivatives (N, n)."""
        poses, J = self._f.batch(np.hstack([Q, np.tile(base, (len(Q), 1))]))
        heights = poses[:, 2, :3] @ points.T + poses[:, 2, 3:]
        highest = np.argmax(heights, axis=1)
        r = (poses[:, :3, :3] @ points[highest][:, :, None])[:, :, 0]
        slopes = J[:, 2] + J[:, 3] * r[:, 1:2] - J[:, 4] * r[:, :1]
        return heights.max(axis=1), np.asarray(slopes)

    def follow(self, Q: Array, base: Array, targets: Array) -> tuple[Array, Array]:
        """Return configurations (N, K, n) along poses (N, K, 4, 4), and how many (N,) are reached.

        A sequence ends where a pose is not reached, or where a coordinate jumps.
        """
        count = targets.shape[1]
        paths = np.repeat(Q[:, None], count, axis=1)
        reached = np.zeros(len(Q), dtype=int)
        going = np.arange(len(Q))
        for k in range(count):
            if not len(going):
                break
            result, error = self.solve(paths[going, max(k - 1, 0)], base[going], targets[going, k], 6)
            jump = np.abs(result - paths[going, max(k - 1, 0)]).max(axis=1, initial=0.0)
            good = (error < TOLERANCE) & (jump < _JUMP)
            going, result = going[good], result[good]
            paths[going, k] = result
            reached[going] = k + 1
        return paths, reached


def find_least_time(rows: Array, speeds: Array) -> float:
    """Return the least time [s] in which a robot passes configurations (L, n) evenly."""
    slowest = (np.abs(np.diff(rows, axis=0)) / speeds).max(initial=0.0)
    return float(slowest) * (len(rows) - 1)


def row_at(rows: Array, share: float) -> Array:
    """Return the configuration (n,) at a share of the path along some (K, n)."""
    place = share * (len(rows) - 1)
    k = min(max(int(place), 0), max(len(rows) - 2, 0))
    rest = min(max(place - k, 0.0), 1.0)
    result = (1.0 - rest) * rows[k] + rest * rows[min(k + 1, len(rows) - 1)]
    return np.asarray(result)
