"""``identification``: the joint between two parts from twenty noisy poses of both, and from one more."""

from __future__ import annotations

import importlib
import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from kineverse.estimation import Identifier, identify, pose_covariance
from kineverse.estimation.identification.solver import solver
from kineverse.lie import Array, exp_so3, inverse, log_so3, pose_difference, retract, transform, translation

from .harness import (
    BenchmarkSettings,
    Contender,
    Contenders,
    time_calls,
    time_contenders,
)
from .result import BenchmarkResult, bound_median

ALL = "kineverse, all families"
HINGE = "kineverse, a hinge alone"
ONE = "kineverse, one new pose"
SCIPY = "scipy least_squares, a hinge with all true poses as unknowns"
RIPL = "ripl-articulation, one joint"

_COUNT = 20
_POSITION, _ORIENTATION = 0.03, math.radians(3.0)
_RANGE = math.pi / 2


def measure(settings: BenchmarkSettings) -> BenchmarkResult:
    """Measure the identification of a hinge observed over a right angle."""
    solver.prepare(wait=True)
    parents, children = _recording()
    participants = Contenders([*_ours(parents, children)])
    for module, peer in (("scipy", _scipy), ("ripl_articulation", _ripl)):
        participants.add_peer(module, lambda peer=peer: [peer(parents, children)])  # type: ignore[misc]
    measured = time_contenders("identification", participants.contenders, settings.rounds, settings.progress)
    return BenchmarkResult(
        name="identification",
        work=(
            f"a hinge over 90° from {_COUNT} poses of both parts with errors of 3 cm and 3°; scipy and "
            "ripl-articulation solve for one joint and do not weigh it against others"
        ),
        measurements=tuple(measured.values()),
        comparisons=(bound_median(measured[ALL], 5e-3), bound_median(measured[ONE], 1e-3)),
        missing=tuple(participants.missing),
    )


def _recording() -> tuple[Array, Array]:
    """Return noisy poses of parent and child, one more than the batch uses."""
    random = np.random.default_rng(0)
    count = _COUNT + 1
    angles = random.uniform(-_RANGE / 2, _RANGE / 2, count)
    turns = exp_so3(angles[:, None] * (0.0, 0.0, 1.0))
    hinge = transform(exp_so3(np.array([0.3, -0.2, 0.1])), np.array([0.5, 0.0, 0.0]))
    relative = hinge @ transform(turns, np.zeros((count, 3))) @ translation(np.array([0.4, 0.0, 0.0]))
    parents = transform(exp_so3(random.normal(0.0, 1.0, (count, 3))), random.uniform(-1.0, 1.0, (count, 3)))
    return _noisy(parents, random), _noisy(parents @ relative, random)


def _noisy(poses: Array, random: np.random.Generator) -> Array:
    turned = random.normal(0.0, _ORIENTATION, (len(poses), 3))
    moved = random.normal(0.0, _POSITION, (len(poses), 3))
    return retract(poses, np.concatenate([moved, turned], axis=1))


def _ours(parents: Array, children: Array) -> Iterator[Contender]:
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


def _scipy(parents: Array, children: Array) -> Contender:
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
    return Contender(SCIPY, time_calls(lambda: optimize.least_squares(errors, first, method="lm")))


def _ripl(parents: Array, children: Array) -> Contender:
    peer: Any = importlib.import_module("ripl_articulation")
    a, b = parents[:_COUNT], children[:_COUNT]
    # It assumes that the parts coincide at joint value 0.
    aligned = b @ inverse(inverse(a[0]) @ b[0])
    return Contender(RIPL, time_calls(lambda: peer.solve_articulation_from_poses(a, aligned)))
