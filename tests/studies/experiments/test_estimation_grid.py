"""Estimation grid: noise of samples, Cramér-Rao bound, report."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import norm

from kineverse_studies.experiments.estimation_grid import (
    SAMPLES,
    CellResult,
    fit_cell,
    make_grid,
    make_quick_grid,
    report_grid,
    summarize_cells,
)
from kineverse_studies.experiments.estimation_grid.cramer_rao import (
    LEVER,
    TO_AXIS,
    Cell,
    compute_attainable_bound,
    compute_bound,
    draw_samples,
    orthonormal_complement,
)

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
def test_the_noise_has_the_stated_deviation(cell):
    many = Cell(cell.joint, cell.position, cell.orientation, 400, cell.range)
    samples = draw_samples(many, 5, np.random.default_rng(0))
    seen, true = samples.seen_parents.reshape(-1, 4, 4), samples.parents.reshape(-1, 4, 4)
    offset = seen[:, :3, 3] - true[:, :3, 3]
    turned = Rotation.from_matrix(seen[:, :3, :3] @ true[:, :3, :3].swapaxes(1, 2)).as_rotvec()
    assert np.cov(offset.T) == pytest.approx(cell.position**2 * np.eye(3), abs=0.1 * cell.position**2)
    assert np.cov(turned.T) == pytest.approx(cell.orientation**2 * np.eye(3), abs=0.1 * cell.orientation**2)


@by_cell
def test_without_noise_the_child_moves_about_the_axis(cell):
    samples = draw_samples(Cell(cell.joint, 0.0, 0.0, 7, cell.range), 4, np.random.default_rng(1))
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
    """Return the measurements as a function of all unknowns: axis, point, zero pose, joint values, parents."""
    axis, point, zero = unknown[:3] / np.linalg.norm(unknown[:3]), unknown[3:6], pose(unknown[6:12])
    values, seen = unknown[12 : 12 + cell.count], []
    for k, value in enumerate(values):
        start = 12 + cell.count + 6 * k
        parent, moved = pose(unknown[start : start + 6]), np.eye(4)
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
    """The pseudo-inverse of the dense information matrix in redundant unknowns is independent of the gauge."""
    samples = draw_samples(cell, 1, np.random.default_rng(2))
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
    sides, found = orthonormal_complement(samples.axis)[0], compute_bound(samples)
    np.testing.assert_allclose(found.direction[0], sides.T @ covariance[:3, :3] @ sides, rtol=1e-3)
    if cell.joint == "revolute":
        # The true point is in the plane across the axis in which the places of the axes are compared.
        np.testing.assert_allclose(found.point[0], sides.T @ covariance[3:6, 3:6] @ sides, rtol=1e-3)


def test_attainable_bound_equals_that_of_gaussian_joint_values():
    """The principal direction of N Gaussian points has the variance σ²(s² + σ²)/(N s⁴)."""
    # Only positions matter where orientations are exact; the errors of both poses add up.
    samples = draw_samples(Cell("prismatic", 0.05, 1e-7, 50, 0.1), 2, np.random.default_rng(4))
    spread, noise = samples.joint_values[0].var(), 2 * 0.05**2
    expected = noise * (spread + noise) / (50 * spread**2)
    np.testing.assert_allclose(
        compute_attainable_bound(samples).direction, [expected * np.eye(2)] * 2, rtol=1e-3, atol=1e-6
    )
    np.testing.assert_allclose(
        compute_bound(samples).direction, [noise / spread / 50 * np.eye(2)] * 2, rtol=1e-3, atol=1e-6
    )


@by_cell
def test_the_attainable_bound_is_cramer_rao_for_small_noise(cell):
    exact = Cell(cell.joint, 1e-5, 1e-5, cell.count, cell.range)
    samples = draw_samples(exact, 3, np.random.default_rng(5))
    np.testing.assert_allclose(
        compute_attainable_bound(samples).degrees, compute_bound(samples).degrees, rtol=1e-4
    )
    noisy = draw_samples(cell, 3, np.random.default_rng(5))
    assert (compute_attainable_bound(noisy).degrees > compute_bound(noisy).degrees).all()


def test_bound_falls_with_count_and_range():
    def degrees(count, reach):
        cell = Cell("revolute", 0.01, 3 * DEG, count, reach * DEG)
        return compute_bound(draw_samples(cell, 3, np.random.default_rng(3))).degrees.mean()

    assert degrees(40, 45) < degrees(20, 45) < degrees(20, 15)
    assert degrees(160, 45) == pytest.approx(degrees(40, 45) / 2, rel=0.05)


def test_fit_cell_is_deterministic():
    cell = Cell("revolute", 0.001, 1 * DEG, 10, 90 * DEG)
    first, again = fit_cell(cell, 3), fit_cell(cell, 3)
    # Up to rounding: once it is compiled, the estimator computes in another order.
    np.testing.assert_allclose(first.degrees, again.degrees, rtol=1e-5)
    assert first.right.all()
    assert (first.degrees < 5 * first.bound_degrees).all()
    assert (first.metres < 5 * first.bound_metres).all()


def test_the_grid_has_18900_fits():
    assert len(make_grid()) * SAMPLES == 18_900
    assert set(make_quick_grid()) <= set(make_grid())


def made_up(cell, ratio, right=True, count=40):
    """Return a result with a given ratio of errors to the attainable bound, which is 1.2 times the other."""
    bounds = np.full(count, 2.0)
    errors, turns = ratio * 1.2 * bounds, cell.joint == "revolute"
    return CellResult(
        cell=cell,
        degrees=errors,
        metres=errors / 100 if turns else np.full(count, np.nan),
        bound_degrees=bounds,
        bound_metres=bounds / 100 if turns else np.full(count, np.nan),
        attainable_degrees=1.2 * bounds,
        attainable_metres=1.2 * bounds / 100,
        spread=1 / count,
        right=np.full(count, right),
        told=np.full(count, True),
        called=(cell.joint if right else "rigid",) * count,
    )


def test_ratios_are_compared_with_chance():
    hinge, slider = CELLS[0], CELLS[2]
    good = summarize_cells([made_up(hinge, 1.0), made_up(slider, 1.0)])
    assert good.attainable.direction == pytest.approx(1.0)
    assert good.attainable.place == pytest.approx(1.0)
    assert good.bound.direction == pytest.approx(1.2)
    assert (good.attainable.over, good.bound.over, good.right, good.told_wrong) == (0, 2, 1.0, 0)
    # A Gaussian of 40 samples, two components each, exceeds 1.21 times its mean square so often.
    assert good.over_by_chance == pytest.approx(2 * norm.sf(0.21 * np.sqrt(40)))
    bad = summarize_cells([made_up(hinge, 1.3, right=False), made_up(slider, 1.0)])
    assert (bad.attainable.over, bad.right, bad.told_wrong) == (1, 0.5, 40)


def test_divergences_count_large_errors_and_missing_axes():
    far = made_up(CELLS[0], 1.0)
    far.degrees[3] = 60.0
    far.degrees[4] = np.nan
    assert far.diverged == 2
    assert made_up(CELLS[0], 1.0).diverged == 0


def test_report_says_which_targets_are_met(tmp_path):
    made = report_grid([made_up(CELLS[0], 1.0), made_up(CELLS[2], 1.0)])
    holds = {row[0]: row[3] for row in made.tables[0].rows}
    assert holds["RMS of the direction over what can be attained, that below 10 deg"] == "yes"
    assert holds["RMS of the direction over the Cramér-Rao bound, that below 10 deg"] == "no"
    assert json.loads(json.dumps(made.numbers, allow_nan=False)) == made.numbers
    pytest.importorskip("matplotlib")
    made.figure.save(tmp_path / "grid.png")
    assert (tmp_path / "grid.png").stat().st_size > 10_000
