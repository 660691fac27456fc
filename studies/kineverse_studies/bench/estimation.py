"""Benchmarks of estimation: ``tracking`` and ``identification``."""

from __future__ import annotations

import importlib
import math
from collections.abc import Iterator
from functools import partial
from typing import Any, Literal, TypeAlias

import numpy as np

from kineverse.compilation import compile
from kineverse.estimation import Identifier, ObservedPose, Tracker, identify, pose_covariance
from kineverse.estimation.identification.solver import solver
from kineverse.formats import load
from kineverse.lie import Array, exp_so3, inverse, log_so3, pose_difference, retract, transform, translation
from kineverse.model.model import Model

from .harness import Benchmark, BenchmarkResult, BenchmarkSettings, Contender, time_calls

ARRAY, MAPPING = "kineverse, poses as one array", "kineverse, poses by frame"
POSITION, ORIENTATION = 0.01, math.radians(1.0)
LONGEST = 1e-4  # target time of an update [s]; the papers report 4 ms
_UPDATES = 25
# Number of updates compared, and done with the textbook gain, which takes a hundred times as long.
_CHECKED = 3


def measure_tracking(settings: BenchmarkSettings) -> BenchmarkResult:
    model = load("kitchen")
    frames = [name for name in model.frames if model.speeds_of(name)]
    readings = _readings(model, frames, min(_UPDATES, settings.configurations))
    covariance = pose_covariance(POSITION, ORIENTATION)
    one = Benchmark("tracking", settings)
    arguments = model, frames, covariance, readings
    one.time([*_track(*arguments), *_track_with_numpy(*arguments)])
    one.bound(LONGEST, ARRAY)
    one.bound(3 * LONGEST, MAPPING)
    one.speed(ARRAY, "numpy, information form", "numpy, textbook gain")
    return one.result(
        f"an update of the {len(model.degrees_of_freedom)} coordinates of the shipped kitchen from the "
        f"poses of {len(frames)} frames, iterated until it stands still; mean of {len(readings)} in "
        f"a row, with the textbook gain of the first {len(readings[:_CHECKED])}"
    )


def _readings(model: Model, frames: list[str], count: int) -> list[Array]:
    """Return noisy poses of a kitchen whose coordinates are so far from limits that these have no effect."""
    rng = np.random.default_rng(0)
    symbols = model.degrees_of_freedom
    low, high = np.array([model.limits(s) for s in symbols]).T
    truth = low + rng.uniform(0.4, 0.6, len(symbols)) * (high - low)
    poses = np.array(compile([model.fk(f) for f in frames], symbols)(truth))
    return [_noisy(poses, rng, POSITION, ORIENTATION) for _ in range(count)]


def _noisy(poses: Array, random: np.random.Generator, position: float, orientation: float) -> Array:
    deviations = np.repeat([position, orientation], 3)
    return retract(poses, random.standard_normal((len(poses), 6)) * deviations)


def _track(model: Model, frames: list[str], covariance: Array, readings: list[Array]) -> Iterator[Contender]:
    first = Tracker(model, [ObservedPose(f, covariance=covariance) for f in frames])
    first.wait()
    mappings = [dict(zip(frames, seen, strict=True)) for seen in readings]

    def by_array() -> None:
        tracker = first.copy()
        for seen in readings:
            tracker.update_poses(seen)

    def by_frame() -> None:
        tracker = first.copy()
        for seen in mappings:
            tracker.update(seen)

    def results() -> list[Array]:
        tracker = first.copy()
        estimates = [tracker.update_poses(seen) for seen in readings[:_CHECKED]]
        states = np.array([[e.state[s] for s in tracker.symbols] for e in estimates])
        return [states, np.array([np.diag(e.covariance) for e in estimates])]

    yield Contender(ARRAY, time_calls(by_array, len(readings)), results)
    yield Contender(MAPPING, time_calls(by_frame, len(readings)), results)


def _track_with_numpy(
    model: Model, frames: list[str], covariance: Array, readings: list[Array]
) -> Iterator[Contender]:
    low, high = np.array([model.limits(s) for s in model.degrees_of_freedom]).T
    forms: tuple[tuple[str, Form, int], ...] = (
        ("numpy, textbook gain", "gain", _CHECKED),
        ("numpy, information form", "information", len(readings)),
    )
    for name, form, count in forms:
        other = NumpyFilter(model, frames, covariance, (low + high) / 2, (high - low) ** 2 / 4, form)

        def results(other: NumpyFilter = other) -> list[Array]:
            found = other.run(readings[:_CHECKED])
            return [np.array([x for x, _ in found]), np.array([np.diag(P) for _, P in found])]

        yield Contender(name, time_calls(partial(other.run, readings[:count]), count), results)


Form: TypeAlias = Literal["gain", "information"]
CONVERGED = 1e-5  # step in standard deviations that ends the iteration, as in the tracker


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


ALL, HINGE = "kineverse, all families", "kineverse, a hinge alone"
ONE = "kineverse, one new pose"
_COUNT = 20
_POSITION, _ORIENTATION = 0.03, math.radians(3.0)
_RANGE = math.pi / 2


def measure_identification(settings: BenchmarkSettings) -> BenchmarkResult:
    solver.prepare(wait=True)
    parents, children = _recording()
    one = Benchmark("identification", settings)
    peers = {"scipy": _identify_with_scipy, "ripl_articulation": _identify_with_ripl}
    others = [peer(parents, children) for module, peer in peers.items() if one.has(module)]
    one.time([*_identify(parents, children), *others])
    one.bound(5e-3, ALL)
    one.bound(1e-3, ONE)
    return one.result(
        f"a hinge over 90° from {_COUNT} poses of both parts with errors of 3 cm and 3°; scipy and "
        "ripl-articulation solve for one joint and do not weigh it against others"
    )


def _recording() -> tuple[Array, Array]:
    random = np.random.default_rng(0)
    count = _COUNT + 1
    angles = random.uniform(-_RANGE / 2, _RANGE / 2, count)
    turns = exp_so3(angles[:, None] * (0.0, 0.0, 1.0))
    hinge = transform(exp_so3(np.array([0.3, -0.2, 0.1])), np.array([0.5, 0.0, 0.0]))
    relative = hinge @ transform(turns, np.zeros((count, 3))) @ translation(np.array([0.4, 0.0, 0.0]))
    parents = transform(exp_so3(random.normal(0.0, 1.0, (count, 3))), random.uniform(-1.0, 1.0, (count, 3)))
    noise = random, _POSITION, _ORIENTATION
    return _noisy(parents, *noise), _noisy(parents @ relative, *noise)


def _identify(parents: Array, children: Array) -> Iterator[Contender]:
    noise = pose_covariance(_POSITION, _ORIENTATION)
    a, b = parents[:_COUNT], children[:_COUNT]
    yield Contender(ALL, time_calls(lambda: identify(a, b, noise=noise)))
    yield Contender(HINGE, time_calls(lambda: identify(a, b, noise=noise, families=["revolute"])))

    def make_identifier() -> Identifier:
        identifier = Identifier(noise=noise)
        for parent, child in zip(a, b, strict=True):
            identifier.add(parent, child)
        assert identifier.result
        return identifier

    def add_pose(identifier: Identifier) -> None:
        identifier.add(parents[_COUNT], children[_COUNT])
        assert identifier.result

    yield Contender(ONE, time_calls(add_pose, prepare=make_identifier))


def _identify_with_scipy(parents: Array, children: Array) -> Contender:
    """Return the fit with scipy; unknowns are the frames on both sides, the angles and the true poses."""
    optimize: Any = importlib.import_module("scipy.optimize")
    a, b = parents[:_COUNT], children[:_COUNT]
    scale = np.array([1.0 / _POSITION] * 3 + [1.0 / _ORIENTATION] * 3)
    start = identify(a, b, noise=pose_covariance(_POSITION, _ORIENTATION), families=["revolute"]).best

    def weighted_difference(measured: Array, true: Array) -> Array:
        weighted: Array = pose_difference(measured, true) * scale
        return weighted

    def errors(unknown: Array) -> Array:
        left = transform(exp_so3(unknown[:3]), unknown[3:6])
        right = transform(exp_so3(unknown[6:9]), unknown[9:12])
        turns = exp_so3(unknown[12 : 12 + _COUNT, None] * (0.0, 0.0, 1.0))
        moved = unknown[12 + _COUNT :].reshape(_COUNT, 6)
        true = retract(a, moved)
        child = true @ left @ transform(turns, np.zeros((_COUNT, 3))) @ right
        return np.concatenate([weighted_difference(a, true), weighted_difference(b, child)]).ravel()

    left, right = start.frame, inverse(start.frame) @ start.parameters["reference"]
    sides = [np.concatenate([log_so3(side[:3, :3]), side[:3, 3]]) for side in (left, right)]
    first = np.concatenate([*sides, start.joint_values[:, 0], np.zeros(6 * _COUNT)])
    name = "scipy least_squares, a hinge with all true poses as unknowns"
    return Contender(name, time_calls(lambda: optimize.least_squares(errors, first, method="lm")))


def _identify_with_ripl(parents: Array, children: Array) -> Contender:
    peer: Any = importlib.import_module("ripl_articulation")
    a, b = parents[:_COUNT], children[:_COUNT]
    # It assumes that the parts coincide at joint value 0.
    aligned = b @ inverse(inverse(a[0]) @ b[0])
    return Contender(
        "ripl-articulation, one joint", time_calls(lambda: peer.solve_articulation_from_poses(a, aligned))
    )
