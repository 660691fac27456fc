"""Distances of pairs against MuJoCo, and against what a distance is."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from convex_shapes import EXACT, KINDS, MujocoPairs, gap, random_pose, random_shape

from kineverse.geometry.narrow import Narrow

EACH = 4
PAIRS = list(itertools.combinations_with_replacement(KINDS, 2))
SAMPLES = 10_000 // len(PAIRS) + 1


@pytest.fixture(scope="module")
def shapes():
    rng = np.random.default_rng(5)
    return {kind: [random_shape(kind, rng) for _ in range(EACH)] for kind in KINDS}


@pytest.fixture(scope="module")
def mujoco_pairs(shapes):
    return MujocoPairs([shape for kind in KINDS for shape in shapes[kind]])


def measured(a, b, poses):
    narrow = Narrow([a.solid, b.solid], poses)
    return narrow.distance(0, 1), *narrow.witness()


@pytest.mark.parametrize(("one", "other"), PAIRS)
def test_signed_distances_are_those_of_mujoco(one, other, shapes, mujoco_pairs):
    rng = np.random.default_rng([KINDS.index(one), KINDS.index(other)])
    exact = one in EXACT and other in EXACT
    tolerance = 1e-6 if exact else 1e-4
    apart = 0
    for _ in range(SAMPLES):
        i, j = rng.integers(EACH, size=2)
        a, b = shapes[one][i], shapes[other][j]
        if a is b:
            b = shapes[other][j := (j + 1) % EACH]
        poses = np.stack([random_pose(rng, 0.25), random_pose(rng, 0.25)])
        distance, point_a, point_b, normal = measured(a, b, poses)
        assert np.linalg.norm(normal) == pytest.approx(1, abs=1e-9)
        assert normal @ (point_b - point_a) == pytest.approx(distance, abs=1e-9)
        # The normal shows this very gap, so the true distance is not less.
        assert gap(a, b, poses, normal) == pytest.approx(distance, abs=tolerance)
        theirs, way = mujoco_pairs.distance(EACH * KINDS.index(one) + i, EACH * KINDS.index(other) + j, poses)
        if abs(theirs - distance) > tolerance:
            # Not minimal: along its own direction MuJoCo's translation does not separate them.
            assert distance < theirs < 0, (distance, theirs)
            assert {one, other} <= {"box", "capsule", "hull", "cone", "cylinder"}
            assert gap(a, b, poses, way) < theirs - tolerance
        apart += distance > 0
    assert 0.1 * SAMPLES < apart < 0.98 * SAMPLES


@pytest.mark.parametrize(("one", "other"), PAIRS)
def test_depth_is_the_shortest_way_out(one, other, shapes):
    rng = np.random.default_rng([2, KINDS.index(one), KINDS.index(other)])
    directions = rng.normal(size=(2000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for _ in range(12):
        a, b = shapes[one][0], shapes[other][1]
        poses = np.stack([random_pose(rng, 0.03), random_pose(rng, 0.03)])
        distance, *_ = measured(a, b, poses)
        assert distance < 0
        assert gap(a, b, poses, directions).max() <= distance + 2e-5


@pytest.mark.parametrize(("one", "other"), PAIRS)
def test_in_touch_the_normal_is_still_right(one, other, shapes):
    rng = np.random.default_rng([3, KINDS.index(one), KINDS.index(other)])
    a, b = shapes[one][0], shapes[other][1]
    for wanted in (0.0, 1e-12, 1e-9, 1e-7, 2e-6, -1e-12, -1e-9, -1e-7, -2e-6):
        poses = np.stack([random_pose(rng, 0.3), random_pose(rng, 0.3)])
        distance, _, _, normal = measured(a, b, poses)
        poses[1, :, 3] += (wanted - distance) * normal
        distance, point_a, point_b, normal = measured(a, b, poses)
        assert np.linalg.norm(normal) == pytest.approx(1, abs=1e-9)
        assert distance == pytest.approx(wanted, abs=1e-5)
        assert gap(a, b, poses, normal) == pytest.approx(wanted, abs=2e-5)
        assert normal @ (point_b - point_a) == pytest.approx(distance, abs=1e-9)


@pytest.mark.parametrize(("one", "other"), PAIRS)
def test_centre_on_centre_there_is_a_way_out(one, other, shapes):
    a, b = shapes[one][0], shapes[other][1]
    poses = np.stack([np.eye(4)[:3]] * 2)
    distance, point_a, point_b, normal = measured(a, b, poses)
    assert distance < 0  # in full symmetry coal stops where it is nearly flat
    assert np.linalg.norm(normal) == pytest.approx(1, abs=1e-6)
    assert normal @ (point_b - point_a) == pytest.approx(distance, abs=1e-6)
    assert gap(a, b, poses, normal) == pytest.approx(distance, abs=3e-4)
