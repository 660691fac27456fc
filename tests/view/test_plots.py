"""Plots of identified joints: views along and across the axis, and the uncertainty of the fit."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import kineverse as kv
from kineverse.estimation import Family, FamilyParameter, identify, pose_covariance
from kineverse.estimation.identification.joint_identification import WEIGHTS
from kineverse.view.plots import SIZE, FitProjection, draw_fit

AXIS, POINT = np.array([0.0, 0.6, 0.8]), np.array([0.5, 0.1, -0.2])
NOISE = pose_covariance(0.005, 0.02)


def hinge(count=25):
    rng, poses = np.random.default_rng(0), np.tile(np.eye(4), (count, 1, 1))
    turns = Rotation.from_rotvec(np.outer(np.linspace(0, 1.2, count), AXIS)).as_matrix()
    poses[:, :3, :3] = Rotation.from_rotvec(0.02 * rng.standard_normal((count, 3))).as_matrix() @ turns
    poses[:, :3, 3] = POINT + turns @ np.cross(AXIS, [0.5, 0, 0]) + 0.005 * rng.standard_normal((count, 3))
    return poses


@pytest.fixture(scope="module")
def found():
    return identify(None, hinge(), noise=NOISE)


def test_fit_projection_looks_along_the_axis(found):
    fit = found["revolute"]
    projection = FitProjection.from_fit(fit, hinge())
    np.testing.assert_allclose(projection.axes.T @ projection.axes, np.eye(3), atol=1e-12)
    assert np.linalg.det(projection.axes) == pytest.approx(1)
    np.testing.assert_allclose(projection.axes[:, 2], fit.parameters["axis"])
    # The fitted way is an arc about the origin, at its height.
    radii = np.linalg.norm(projection.path[:, :2], axis=1)
    np.testing.assert_allclose(radii, radii[0])
    np.testing.assert_allclose(projection.path[:, 2], 0, atol=1e-9)
    # The middle of the way is to the right.
    assert projection.path[100, 0] == pytest.approx(radii[0], rel=0.02)


def test_fit_projection_of_a_prismatic_joint_moves_along_its_axis():
    rng = np.random.default_rng(1)
    points = np.linspace(0, 0.4, 20)[:, None] * AXIS + POINT + 0.002 * rng.standard_normal((20, 3))
    fit = identify(None, points, noise=pose_covariance(0.002, 1))["prismatic"]
    projection = FitProjection.from_fit(fit, points)
    np.testing.assert_allclose(projection.path[:, :2], 0, atol=1e-9)
    assert np.ptp(projection.path[:, 2]) == pytest.approx(0.4, abs=0.01)


@pytest.mark.parametrize("height", [0.0, 0.7, -2.0])
def test_axis_covariances_of_a_projection_are_those_of_sampled_axes(found, height):
    fit = found["revolute"]
    projection = FitProjection.from_fit(fit, hinge())
    names = ["axis.x", "axis.y", "point.x", "point.y"]
    chosen = [fit.coordinates.index(name) for name in names]
    covariance = fit.covariance[np.ix_(chosen, chosen)]
    draws = np.random.default_rng(2).multivariate_normal(np.zeros(4), covariance, 20_000)
    turns = Rotation.from_rotvec(np.column_stack([draws[:, :2], np.zeros(len(draws))])).as_matrix()
    directions = turns[:, :, 2] @ fit.frame[:3, :3].T
    points = fit.frame[:3, 3] + draws[:, 2:] @ fit.frame[:3, :2].T
    # Where these axes cross the plane at that height.
    plane = projection.origin + height * projection.axes[:, 2]
    ways = ((plane - points) @ projection.axes[:, 2]) / (directions @ projection.axes[:, 2])
    crossings = (points + ways[:, None] * directions - plane) @ projection.axes[:, :2]
    expected = np.cov(crossings.T)
    np.testing.assert_allclose(
        projection.axis_covariances(np.array([height]))[0], expected, atol=0.05 * np.abs(expected).max()
    )


@pytest.mark.parametrize(
    ("family", "whole"),
    [*((family, True) for family in sorted(WEIGHTS)), ("prismatic", False), ("spherical", False)],
)
def test_every_family_is_drawn(family, whole):
    figure = pytest.importorskip("matplotlib.figure").Figure(figsize=SIZE, layout="constrained")
    seen = hinge() if whole else hinge()[:, :3, 3]
    draw_fit(figure, identify(None, seen, noise=NOISE, families=[family]).best, seen, "a title")
    figure.canvas.draw()
    assert figure.get_suptitle() == "a title"
    assert {"joint values, ±2 σ", "left over"} <= {axes.get_title() for axes in figure.axes}


@pytest.mark.parametrize("family", ["revolute", "prismatic"])
def test_outliers_are_ringed(found, family):
    figure = pytest.importorskip("matplotlib.figure").Figure(figsize=SIZE, layout="constrained")
    draw_fit(figure, replace(found[family], outliers=(3, 8)), hinge(), "a title")
    projection = FitProjection.from_fit(found[family], hinge())
    side = next(axes for axes in figure.axes if axes.get_title() == "from the side")
    ringed = np.asarray(side.collections[-1].get_offsets())
    expected = projection.observed[[3, 8]][:, [2, 0] if family == "prismatic" else [0, 2]]
    np.testing.assert_allclose(ringed, expected)


def test_a_custom_family_is_drawn():
    figure = pytest.importorskip("matplotlib.figure").Figure(figsize=SIZE, layout="constrained")
    q, radius = kv.position("q"), kv.parameter("radius", 0.5)
    circle = kv.rotation_z(q) @ kv.translation(radius, 0, 0)
    family = Family(
        "circle", circle, {q.symbols[0]: (-1.0, 2.0)}, {radius.symbols[0]: FamilyParameter(0.5, 0.2)}
    )
    angles = np.linspace(0, 1.2, 20)
    points = np.column_stack([0.4 * np.cos(angles), 0.4 * np.sin(angles), 0 * angles])
    fit = identify(None, points, noise=NOISE, families=[family]).best
    draw_fit(figure, fit, points, "a circle")
    figure.canvas.draw()
    assert fit.parameters["radius"] == pytest.approx(0.4, abs=0.02)
