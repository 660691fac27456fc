"""Iterated extended Kalman filter over poses, in numpy."""

from __future__ import annotations

from typing import Literal, TypeAlias

import numpy as np

from kineverse.compile import compile  # noqa: A004
from kineverse.lie import Array
from kineverse.model.model import Model

Form: TypeAlias = Literal["gain", "information"]

# Step in standard deviations that ends the iteration, as in the tracker.
CONVERGED = 1e-5


class NumpyFilter:
    """Iterated extended Kalman filter of all coordinates from poses of frames."""

    def __init__(
        self, model: Model, frames: list[str], covariance: Array, mean: Array, variances: Array, form: Form
    ) -> None:
        symbols = model.degrees_of_freedom
        outputs = [model.fk(f) for f in frames] + [model.jacobian(f, symbols=symbols) for f in frames]
        self._count = len(frames)
        self._evaluate = compile(
            [np.stack(outputs[: self._count]), np.stack(outputs[self._count :])], symbols, wait=True
        )
        self._covariance = np.kron(np.eye(self._count), covariance)
        self._weight = np.linalg.inv(covariance)
        self._form = form
        self.start = mean, np.diag(variances)

    def run(self, readings: list[Array]) -> list[tuple[Array, Array]]:
        """Return mean and covariance after each reading (m, 4, 4), from the initial state."""
        mean, covariance = self.start
        estimates = []
        for poses in readings:
            mean, covariance = self._update(mean, covariance, poses)
            estimates.append((mean, covariance))
        return estimates

    def _update(self, prior: Array, P: Array, poses: Array) -> tuple[Array, Array]:
        x = prior
        information = np.linalg.inv(P) if self._form == "information" else P
        while True:
            error, H = self._linearise(x, poses)
            if self._form == "gain":
                K = P @ H.T @ np.linalg.inv(H @ P @ H.T + self._covariance)
                after = prior + K @ (error - H @ (prior - x))
                covariance = (np.eye(len(x)) - K @ H) @ P
            else:
                weighted = (H.reshape(self._count, 6, -1).transpose(0, 2, 1) @ self._weight).transpose(
                    1, 0, 2
                )
                weighted = weighted.reshape(len(x), -1)
                covariance = np.asarray(np.linalg.inv(information + weighted @ H), dtype=np.float64)
                after = x + covariance @ (weighted @ error + information @ (prior - x))
            moved = (after - x) / np.sqrt(np.diag(covariance))
            x = after
            if moved @ moved < CONVERGED**2:
                return x, covariance

    def _linearise(self, x: Array, poses: Array) -> tuple[Array, Array]:
        """Return the innovations (6 m,) and the measurement Jacobian (6 m, n) at x."""
        predicted, jacobian = self._evaluate(x)
        turned = poses[:, :3, :3] @ predicted[:, :3, :3].transpose(0, 2, 1)
        sine = (
            np.stack(
                [
                    turned[:, 2, 1] - turned[:, 1, 2],
                    turned[:, 0, 2] - turned[:, 2, 0],
                    turned[:, 1, 0] - turned[:, 0, 1],
                ],
                axis=1,
            )
            / 2
        )
        length = np.linalg.norm(sine, axis=1)
        angle = np.arctan2(length, (np.trace(turned, axis1=1, axis2=2) - 1) / 2)
        vector = sine * (angle / length)[:, None]
        k = np.cross(np.eye(3), vector[:, None, :])
        factor = (1 - angle / 2 / np.tan(angle / 2)) / angle**2
        back = np.eye(3) + k / 2 + factor[:, None, None] * (k @ k)
        H = np.concatenate([jacobian[:, :3], back @ jacobian[:, 3:]], axis=1)
        error = np.concatenate([poses[:, :3, 3] - predicted[:, :3, 3], vector], axis=1)
        return error.reshape(-1), H.reshape(-1, H.shape[2])
