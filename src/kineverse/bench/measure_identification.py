"""``identification``: what connects two parts, from twenty noisy poses of both, and from one more."""

from __future__ import annotations

import importlib
import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from kineverse.estimation import Identifier, identify, pose_covariance
from kineverse.estimation.identification.native import solver
from kineverse.estimation.identification.rigid import pose
from kineverse.estimation.rotations import exponential, logarithm

from .agreement import Array
from .peers import Field, advice, installed
from .result import Result, at_most
from .settings import Settings
from .timing import Contender, race, timed

ALL = "kineverse, all families"
HINGE = "kineverse, a hinge alone"
ONE = "kineverse, one new pose"
SCIPY = "scipy least_squares, a hinge with all true poses as unknowns"
RIPL = "ripl-articulation, one joint"

_COUNT = 20
_POSITION, _ORIENTATION = 0.03, math.radians(3.0)
_RANGE = math.pi / 2


def measure(settings: Settings) -> Result:
    """Measure the identification of a hinge that was seen over a right angle."""
    solver.prepare(wait=True)
    parents, children = _recording()
    field = Field([*_ours(parents, children)])
    for module, peer in (("scipy", _scipy), ("ripl_articulation", _ripl)):
        if installed(module):
            field.contenders.append(peer(parents, children))
        else:
            field.missing.append(advice(module))
    measured = race("identification", field.contenders, settings.rounds, settings.progress)
    return Result(
        name="identification",
        work=(
            f"a hinge over 90° from {_COUNT} poses of both parts with errors of 3 cm and 3°; scipy and "
            "ripl-articulation solve for one joint and do not weigh it against others"
        ),
        measurements=tuple(measured.values()),
        comparisons=(at_most(measured[ALL], 5e-3), at_most(measured[ONE], 1e-3)),
        missing=tuple(field.missing),
    )


def _recording() -> tuple[Array, Array]:
    """Return poses of parent and child as they were seen, one more than are used at once."""
    random = np.random.default_rng(0)
    count = _COUNT + 1
    angles = random.uniform(-_RANGE / 2, _RANGE / 2, count)
    turns = exponential(angles[:, None] * (0.0, 0.0, 1.0))
    hinge = pose(exponential(np.array([0.3, -0.2, 0.1])), np.array([0.5, 0.0, 0.0]))
    relative = hinge @ pose(turns, np.zeros((count, 3))) @ pose(np.eye(3), np.array([0.4, 0.0, 0.0]))
    parents = pose(exponential(random.normal(0.0, 1.0, (count, 3))), random.uniform(-1.0, 1.0, (count, 3)))
    return _noisy(parents, random), _noisy(parents @ relative, random)


def _noisy(poses: Array, random: np.random.Generator) -> Array:
    turns = exponential(random.normal(0.0, _ORIENTATION, (len(poses), 3)))
    return pose(turns @ poses[:, :3, :3], poses[:, :3, 3] + random.normal(0.0, _POSITION, (len(poses), 3)))


def _ours(parents: Array, children: Array) -> Iterator[Contender]:
    noise = pose_covariance(_POSITION, _ORIENTATION)
    a, b = parents[:_COUNT], children[:_COUNT]
    yield Contender(ALL, timed(lambda: identify(a, b, noise=noise)))
    yield Contender(HINGE, timed(lambda: identify(a, b, noise=noise, families=["revolute"])))

    def known() -> Identifier:
        identifier = Identifier(noise=noise)
        for parent, child in zip(a, b, strict=True):
            identifier.add(parent, child)
        assert identifier.found
        return identifier

    def one_more(identifier: Identifier) -> None:
        identifier.add(parents[_COUNT], children[_COUNT])
        assert identifier.found

    yield Contender(ONE, timed(one_more, prepare=known))


def _scipy(parents: Array, children: Array) -> Contender:
    """Return what one would write with scipy: frames on both sides of the hinge, angles, and true poses."""
    optimize: Any = importlib.import_module("scipy.optimize")
    a, b = parents[:_COUNT], children[:_COUNT]
    scale = np.array([1.0 / _POSITION] * 3 + [1.0 / _ORIENTATION] * 3)
    start = identify(a, b, noise=pose_covariance(_POSITION, _ORIENTATION), families=["revolute"]).best

    def apart(seen: Array, true: Array) -> Array:
        turned = logarithm(seen[:, :3, :3] @ np.swapaxes(true[:, :3, :3], 1, 2))
        off: Array = np.concatenate([seen[:, :3, 3] - true[:, :3, 3], turned], axis=1) * scale
        return off

    def errors(unknown: Array) -> Array:
        left = pose(exponential(unknown[:3]), unknown[3:6])
        right = pose(exponential(unknown[6:9]), unknown[9:12])
        turns = exponential(unknown[12 : 12 + _COUNT, None] * (0.0, 0.0, 1.0))
        moved = unknown[12 + _COUNT :].reshape(_COUNT, 6)
        true = pose(exponential(moved[:, 3:]) @ a[:, :3, :3], a[:, :3, 3] + moved[:, :3])
        there = true @ left @ pose(turns, np.zeros((_COUNT, 3))) @ right
        return np.concatenate([apart(a, true), apart(b, there)]).ravel()

    left, right = start.frame, np.linalg.inv(start.frame) @ start.parameters["reference"]
    sides = [np.concatenate([logarithm(side[:3, :3]), side[:3, 3]]) for side in (left, right)]
    first = np.concatenate([*sides, start.joint_values[:, 0], np.zeros(6 * _COUNT)])
    return Contender(SCIPY, timed(lambda: optimize.least_squares(errors, first, method="lm")))


def _ripl(parents: Array, children: Array) -> Contender:
    peer: Any = importlib.import_module("ripl_articulation")
    a, b = parents[:_COUNT], children[:_COUNT]
    # It takes the parts to coincide at joint value 0.
    aligned = b @ np.linalg.inv(np.linalg.inv(a[0]) @ b[0])
    return Contender(RIPL, timed(lambda: peer.solve_articulation_from_poses(a, aligned)))
