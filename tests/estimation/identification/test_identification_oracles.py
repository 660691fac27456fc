"""Identification compared with scipy on the same residuals and with published results."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from synthetic_recordings import noisy

import kineverse as kv
from kineverse.estimation import Family, FamilyParameter, identify, pose_covariance
from kineverse.estimation.identification.solver import solver
from kineverse_studies.experiments.estimation_grid.cramer_rao import Cell, compute_bound, draw_samples

Array = npt.NDArray[np.float64]


def garage() -> tuple[Family, dict[str, float], Array]:
    """Return a door that slides up along one edge and in along the other, its length, and joint values."""
    a, length = kv.position("a"), kv.parameter("length", 2.0)
    door = kv.translation(0, 0, length * np.cos(a)) @ kv.rotation_y(a)
    family = Family("garage", door, {a: (0.0, 1.5)}, {length: FamilyParameter(2.0, 0.5, 0.5, 4.0)})
    return family, {"length": 1.4}, np.linspace(0.1, 1.2, 15)


def four_bar() -> tuple[Family, dict[str, float], Array]:
    """Return the coupler of a four-bar with unknown pivots, by the law of cosines."""
    a = kv.position("a")
    x, y, coupler, rocker = (kv.parameter(name, 0.5) for name in ("x", "y", "coupler", "rocker"))
    pin = 0.2 * np.cos(a), 0.2 * np.sin(a)
    way = x - pin[0], y - pin[1]
    apart = np.sqrt(way[0] ** 2 + way[1] ** 2)
    bent = np.arccos((coupler**2 + apart**2 - rocker**2) / (2 * coupler * apart))
    turned = np.arctan2(way[1], way[0]) + bent
    pose = kv.translation(*pin, 0) @ kv.rotation_z(turned) @ kv.translation(0.3, 0.05, 0)
    starts = {x: 0.62, y: 0.04, coupler: 0.75, rocker: 0.55}
    unknowns = {s: FamilyParameter(start, 0.2) for s, start in starts.items()}
    truth = {"x": 0.7, "y": 0.0, "coupler": 0.8, "rocker": 0.6}
    return Family("four-bar", pose, {a: (-0.5, 2.6)}, unknowns), truth, np.linspace(0.0, 2.2, 25)


@pytest.mark.parametrize("make", [garage, four_bar])
def test_custom_parameters_agree_with_scipys_least_squares(
    make: Callable[[], tuple[Family, dict[str, float], Array]],
) -> None:
    position, orientation = 0.002, 0.005
    family, truth, values = make()
    names = [str(s) for s in family.parameters]
    function = kv.compile(family.transform, [*family.joints, *family.parameters])

    def poses(parameters: Array, joints: Array) -> Array:
        rows = np.column_stack([joints, np.tile(parameters, (len(joints), 1))])
        return np.asarray(function.batch(rows))

    true = np.array([truth[name] for name in names])
    data = noisy(poses(true, values), position, orientation, np.random.default_rng(3))
    fit = identify(None, data, noise=pose_covariance(position, orientation), families=[family]).best
    start, spread = np.array([(u.start, u.deviation) for u in family.unknowns.values()]).T

    def errors(unknown: Array) -> Array:
        model = poses(unknown[: len(names)], unknown[len(names) :])
        turned = Rotation.from_matrix(data[:, :3, :3] @ np.swapaxes(model[:, :3, :3], 1, 2)).as_rotvec()
        off = (data[:, :3, 3] - model[:, :3, 3]) / position
        return np.concatenate(
            [off.ravel(), turned.ravel() / orientation, (unknown[: len(names)] - start) / spread]
        )

    best = least_squares(errors, np.concatenate([true, values]), x_scale="jac", xtol=1e-12, ftol=1e-12)
    covariance = np.linalg.inv(best.jac.T @ best.jac)[: len(names), : len(names)]
    deviations = np.sqrt(np.diag(covariance))
    result = np.array([fit.parameters[name] for name in names])
    # Joint values are integrated out instead of being estimated, which moves the optimum a little.
    assert np.all(np.abs(result - best.x[: len(names)]) < 0.1 * deviations)
    np.testing.assert_allclose(fit.joint_values[:, 0], best.x[len(names) :], atol=0.2 * orientation)
    assert fit.covariance == pytest.approx(covariance, abs=0.05 * float(np.max(covariance)))
    assert [fit.deviation(name) for name in names] == pytest.approx(deviations, rel=0.05)
    off = result - true
    assert float(off @ np.linalg.solve(covariance, off)) < 18.5  # χ² of four, once in a thousand


POSITION, ORIENTATION = 0.03, math.radians(3.0)
HINGE = Cell("revolute", POSITION, ORIENTATION, count=20, range=math.pi / 2)


def test_hinge_agrees_with_scipys_maximum_likelihood() -> None:
    """Compared with scipy with all true poses as unknowns: 152 of them, and 240 observed numbers."""
    samples = draw_samples(HINGE, 1, np.random.default_rng(1))
    noise = pose_covariance(POSITION, ORIENTATION)
    scale = np.array([1.0 / POSITION] * 3 + [1.0 / ORIENTATION] * 3)
    for parents, children in zip(samples.seen_parents, samples.seen_children, strict=True):
        fit = identify(parents, children, noise=noise, families=["revolute"]).best

        def errors(unknown: Array, data: tuple[Array, Array] = (parents, children)) -> Array:
            parents, children = data
            left, right = as_pose(unknown[:6]), as_pose(unknown[6:12])
            turns = as_pose(np.column_stack([np.zeros((20, 5)), unknown[12:32]]))
            true = parents @ as_pose(unknown[32:].reshape(20, 6))
            there = true @ left @ turns @ right
            return np.concatenate([apart(parents, true) * scale, apart(children, there) * scale]).ravel()

        mount = np.linalg.inv(fit.frame) @ fit.parameters["reference"]
        start = np.concatenate(
            [as_vector(fit.frame), as_vector(mount), fit.joint_values[:, 0], np.zeros(120)]
        )
        best = least_squares(errors, start, method="lm")
        frame = as_pose(best.x[:6])
        axis = frame[:3, 2] * np.sign(frame[:3, 2] @ fit.parameters["axis"])
        assert np.linalg.norm(axis - fit.parameters["axis"]) < 0.2 * fit.deviation("axis.x")
        across = np.cross(axis, frame[:3, 3] - fit.parameters["point"])
        assert np.linalg.norm(across) < 0.2 * fit.deviation("point.x")
        # Two gauges on either side and one of the joint values leave 5 unknowns of no size.
        covariance = np.linalg.pinv(best.jac.T @ best.jac, rcond=1e-10)
        step = np.zeros((3, len(start)))
        for k in range(6):
            change = np.zeros(6)
            change[k] = 1e-6
            step[:, k] = (as_pose(best.x[:6] + change)[:3, 2] - frame[:3, 2]) / 1e-6
        told = fit.frame[:3, :2].T @ step @ covariance @ step.T @ fit.frame[:3, :2]
        assert np.sqrt(np.trace(told)) == pytest.approx(
            math.hypot(fit.deviation("axis.x"), fit.deviation("axis.y")), rel=0.05
        )


def as_pose(vectors: Array) -> Array:
    """Return transforms (..., 4, 4) of positions and rotation vectors (..., 6)."""
    poses = np.tile(np.eye(4), (*vectors.shape[:-1], 1, 1))
    poses[..., :3, 3] = vectors[..., :3]
    poses[..., :3, :3] = Rotation.from_rotvec(vectors[..., 3:]).as_matrix()
    return poses


def as_vector(pose: Array) -> Array:
    return np.concatenate([pose[:3, 3], Rotation.from_matrix(pose[:3, :3]).as_rotvec()])


def apart(poses: Array, others: Array) -> Array:
    turned = Rotation.from_matrix(poses[:, :3, :3] @ np.swapaxes(others[:, :3, :3], 1, 2)).as_rotvec()
    return np.concatenate([poses[:, :3, 3] - others[:, :3, 3], turned], axis=1)


def lines_apart(axis: Array, point: Array, other_axis: Array, other_point: Array) -> float:
    """Return the shortest distance between two lines."""
    across = np.cross(axis, other_axis)
    return abs(float(across @ (other_point - point))) / float(np.linalg.norm(across))


def turned_by(axis: Array, other: Array) -> float:
    """Return the angle between two axes [deg]."""
    return math.degrees(math.atan2(float(np.linalg.norm(np.cross(axis, other))), abs(float(axis @ other))))


@pytest.mark.compiler
@pytest.mark.parametrize("count", [100, pytest.param(400, marks=pytest.mark.long)])
def test_hinge_errors_agree_with_published_maximum_likelihood(count: int) -> None:
    """Means of 1.74° and of 13 mm between the axes, with one of both poses known exactly.

    Of 3000 samples ours are 1.67 ± .02° and 13.1 ± .2 mm. Of 400 the means scatter by .044° and .5 mm, so a
    limit of 5 % more holds with 99.9 % for the angle and with 88 % for the distance, if the seed is drawn anew.
    Of the first 100 they scatter by twice as much.
    """
    solver.prepare(wait=True)
    samples = draw_samples(HINGE, count, np.random.default_rng(1))
    relative = np.linalg.inv(samples.parents) @ samples.seen_children
    noise = pose_covariance(POSITION, ORIENTATION)
    degrees, metres = [], []
    for data, axis, point in zip(relative, samples.axis, samples.point, strict=True):
        result = identify(None, data, noise=noise, families=["revolute"]).best.parameters
        degrees.append(turned_by(axis, result["axis"]))
        metres.append(lines_apart(axis, point, result["axis"], result["point"]))
    assert np.mean(degrees) < 1.05 * 1.74
    assert np.mean(metres) < 1.05 * 0.013


@pytest.mark.long
@pytest.mark.compiler
def test_hinge_between_noisy_poses_reaches_the_bound() -> None:
    """The squares of 300 errors in two directions are known to 6 %, so their root is to 3 %: 5 % is 95 %.

    With wider limits, the short tests of the quality of identification say the same.
    """
    solver.prepare(wait=True)
    samples = draw_samples(HINGE, 300, np.random.default_rng(1))
    noise = pose_covariance(POSITION, ORIENTATION)
    squares = [
        turned_by(axis, identify(a, b, noise=noise, families=["revolute"]).best.parameters["axis"]) ** 2
        for a, b, axis in zip(samples.seen_parents, samples.seen_children, samples.axis, strict=True)
    ]
    assert np.mean(squares) < 1.05**2 * np.mean(compute_bound(samples).degrees ** 2)
