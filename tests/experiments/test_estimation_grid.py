"""The estimation grid: its samples are what they claim to be, and its bound is that of the whole problem."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from kineverse.experiments.estimation_grid.bound import across, bound
from kineverse.experiments.estimation_grid.samples import LEVER, TO_AXIS, Cell, draw

DEG = np.pi / 180
CELLS = [
    Cell("revolute", 0.03, 3 * DEG, 6, 90 * DEG),
    Cell("revolute", 0.001, 10 * DEG, 5, 15 * DEG),
    Cell("prismatic", 0.03, 3 * DEG, 6, 0.4),
    Cell("prismatic", 0.1, 1 * DEG, 5, 0.05),
]
by_cell = pytest.mark.parametrize("cell", CELLS, ids=lambda c: f"{c.joint}-{c.position:g}-{c.range:.2f}")


def relative(parents, children):
    return np.linalg.inv(parents) @ children


@by_cell
def test_the_noise_is_what_it_is_said_to_be(cell):
    many = Cell(cell.joint, cell.position, cell.orientation, 400, cell.range)
    samples = draw(many, 5, np.random.default_rng(0))
    seen, true = samples.seen_parents.reshape(-1, 4, 4), samples.parents.reshape(-1, 4, 4)
    offset = seen[:, :3, 3] - true[:, :3, 3]
    turned = Rotation.from_matrix(seen[:, :3, :3] @ true[:, :3, :3].swapaxes(1, 2)).as_rotvec()
    assert np.cov(offset.T) == pytest.approx(cell.position**2 * np.eye(3), abs=0.1 * cell.position**2)
    assert np.cov(turned.T) == pytest.approx(cell.orientation**2 * np.eye(3), abs=0.1 * cell.orientation**2)


@by_cell
def test_without_noise_the_child_moves_about_the_axis(cell):
    exact = Cell(cell.joint, 0.0, 0.0, 7, cell.range)
    samples = draw(exact, 4, np.random.default_rng(1))
    poses = relative(samples.seen_parents, samples.seen_children)
    np.testing.assert_allclose(poses[:, 0], samples.zero, atol=1e-12)
    since = poses @ np.linalg.inv(poses[:, :1])
    for sample in range(4):
        axis, point = samples.axis[sample], samples.point[sample]
        if cell.joint == "prismatic":
            np.testing.assert_allclose(
                since[sample, :, :3, 3], samples.joint_values[sample, :, None] * axis, atol=1e-12
            )
            continue
        vectors = Rotation.from_matrix(since[sample, :, :3, :3]).as_rotvec()
        np.testing.assert_allclose(vectors, samples.joint_values[sample, :, None] * axis, atol=1e-12)
        np.testing.assert_allclose(
            since[sample, :, :3, :3] @ point + since[sample, :, :3, 3], [point] * 7, atol=1e-12
        )
        off = samples.zero[sample, :3, 3] - point
        assert np.linalg.norm(point - (point @ axis) * axis) == pytest.approx(TO_AXIS)
        assert np.linalg.norm(off) == pytest.approx(LEVER)
        assert off @ axis == pytest.approx(0, abs=1e-12)


def everything_seen(cell, unknown):
    """All twelve numbers of all observations, by all unknowns: axis, a point on it, zero pose, values, parents."""
    axis, point, zero = unknown[:3] / np.linalg.norm(unknown[:3]), unknown[3:6], pose(unknown[6:12])
    values = unknown[12 : 12 + cell.count]
    seen = []
    for k, value in enumerate(values):
        start = 12 + cell.count + 6 * k
        parent = pose(unknown[start : start + 6])
        moved = np.eye(4)
        if cell.joint == "prismatic":
            moved[:3, 3] = value * axis
        else:
            moved[:3, :3] = Rotation.from_rotvec(value * axis).as_matrix()
            moved[:3, 3] = point - moved[:3, :3] @ point
        seen.append(np.stack([parent, parent @ moved @ zero]))
    return np.array(seen)


def pose(numbers):
    made = np.eye(4)
    made[:3, 3], made[:3, :3] = numbers[:3], Rotation.from_rotvec(numbers[3:]).as_matrix()
    return made


def numbers_of(made):
    return np.concatenate([made[:3, 3], Rotation.from_matrix(made[:3, :3]).as_rotvec()])


def errors(seen, true):
    turned = seen[..., :3, :3] @ true[..., :3, :3].swapaxes(-1, -2)
    vectors = Rotation.from_matrix(turned.reshape(-1, 3, 3)).as_rotvec().reshape(*turned.shape[:-1])
    return np.concatenate([seen[..., :3, 3] - true[..., :3, 3], vectors], axis=-1)


@by_cell
def test_the_bound_is_that_of_all_unknowns_at_once(cell):
    """The dense information matrix, in redundant unknowns: its pseudo-inverse takes no account of the gauge."""
    samples = draw(cell, 1, np.random.default_rng(2))
    truth = np.concatenate(
        [
            samples.axis[0],
            samples.point[0],
            numbers_of(samples.zero[0]),
            samples.joint_values[0],
            *(numbers_of(parent) for parent in samples.parents[0]),
        ]
    )
    true = everything_seen(cell, truth)
    weights = np.tile([1 / cell.position] * 3 + [1 / cell.orientation] * 3, 2 * cell.count)
    columns = []
    for k in range(len(truth)):
        step = np.zeros(len(truth))
        step[k] = 1e-6
        there, back = (errors(everything_seen(cell, truth + s * step), true) for s in (1, -1))
        columns.append((there - back).ravel() / 2e-6 * weights)
    covariance = np.linalg.pinv(np.array(columns) @ np.array(columns).T, rcond=1e-12, hermitian=True)
    sides = across(samples.axis)[0]
    found = bound(samples)
    np.testing.assert_allclose(found.direction[0], sides.T @ covariance[:3, :3] @ sides, rtol=1e-3)
    if cell.joint == "revolute":
        # The true point is in the plane across the axis in which the places of the axes are compared.
        np.testing.assert_allclose(found.point[0], sides.T @ covariance[3:6, 3:6] @ sides, rtol=1e-3)


def test_more_observations_and_longer_ways_tell_more():
    def degrees(count, reach):
        cell = Cell("revolute", 0.01, 3 * DEG, count, reach * DEG)
        return bound(draw(cell, 3, np.random.default_rng(3))).degrees.mean()

    assert degrees(40, 45) < degrees(20, 45) < degrees(20, 15)
    assert degrees(160, 45) == pytest.approx(degrees(40, 45) / 2, rel=0.05)
