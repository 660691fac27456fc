"""The broad phase: no pair is missed, bounds hold, and C agrees with numpy."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hypothesis_profiles import attempts
from kineverse.geometry import broadphase
from kineverse.geometry.bindings import CollisionLibrary
from kineverse.geometry.broadphase import TREE_WIDTH, ObjectTable, build_static_tree


@pytest.fixture(scope="module")
def library():
    library = CollisionLibrary()
    assert library.prepare(wait=True)
    return library


class Cloud:
    """Objects of random points, with brute-force distances between their nearest points."""

    def __init__(self, seed: int, count: int, moving: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.points = self.rng.normal(size=(count, 6, 3)) * self.rng.uniform(0.02, 0.4, (count, 1, 3))
        body = self.rng.integers(max(count // 2, 1), size=count).astype(np.int32)
        allowed = (self.rng.random((count, count)) < 0.9).astype(np.uint8)
        allowed &= allowed.T
        np.fill_diagonal(allowed, 0)
        self.table = ObjectTable(moving, body, allowed)
        self.table.poses[:] = self.random_poses(count)
        for k, points in enumerate(self.points):
            low, high = points.min(axis=0), points.max(axis=0)
            centre = (low + high) / 2
            radius = np.linalg.norm(points - centre, axis=1).max()
            self.table.set_solid(k, centre, (high - low) / 2, radius)
        self.table.choose_axis()

    def random_poses(self, count: int) -> np.ndarray:
        rotation = Rotation.from_quat(self.rng.normal(size=(count, 4))).as_matrix()
        return np.concatenate([rotation, self.rng.normal(size=(count, 3, 1))], axis=2)

    def step(self, size: float) -> np.ndarray:
        """Return new poses of the moving objects, a little further on."""
        old = self.table.poses[: self.table.moving]
        turn = Rotation.from_rotvec(self.rng.normal(size=(len(old), 3)) * size).as_matrix()
        shift = self.rng.normal(size=(len(old), 3, 1)) * size
        return np.concatenate([old[:, :, :3] @ turn, old[:, :, 3:] + shift], axis=2)

    def distance(self, i: int, j: int) -> float:
        a, b = (self.points[k] @ self.table.poses[k, :, :3].T + self.table.poses[k, :, 3] for k in (i, j))
        return float(np.linalg.norm(a[:, None] - b[None], axis=2).min())

    def looked_at(self) -> list[tuple[int, int]]:
        count, allowed, body = self.table.count, self.table.allowed, self.table.body
        moving = range(self.table.moving)
        return [(i, j) for i in moving for j in range(i + 1, count) if allowed[body[i], body[j]]]


@settings(max_examples=attempts(40))
@given(
    seed=st.integers(0, 10**6),
    count=st.integers(2, 14),
    reach=st.sampled_from([0.0, 0.1, 0.5, 2.0]),
    step=st.sampled_from([0.001, 0.03, 0.4]),
)
def test_find_near_pairs_misses_none_and_bounds_hold(seed, count, reach, step):
    cloud = Cloud(seed, count, moving=count // 2 + 1)
    table = cloud.table
    for _ in range(6):
        assert broadphase.place_objects(table, cloud.step(step)) == -1
        pairs, lows = broadphase.find_near_pairs(table, reach)
        said = {tuple(pair): low for pair, low in zip(pairs.tolist(), lows.tolist(), strict=True)}
        for i, j in cloud.looked_at():
            distance = cloud.distance(i, j)
            if distance <= reach - 1e-9:
                assert (i, j) in said
            if (i, j) in said:
                assert said[i, j] <= distance + 1e-9
                table.bounds[i, j] = distance + table.travel[i] + table.travel[j]


@pytest.mark.compiler
@settings(max_examples=attempts(40))
@given(seed=st.integers(0, 10**6), count=st.integers(2, 60), reach=st.sampled_from([0.0, 0.1, 0.5, 9.0]))
def test_find_near_pairs_agrees_in_numpy_and_c(library, seed, count, reach):
    one, other = Cloud(seed, count, count // 2), Cloud(seed, count, count // 2)
    one.table.active[1] = other.table.active[1] = 0
    for _ in range(4):
        fresh = one.step(0.05)
        assert (
            broadphase.place_objects(one.table, fresh)
            == library.place(other.table, np.ascontiguousarray(fresh))
            == -1
        )
        for name in ("poses", "travel", "position", "low", "high"):
            np.testing.assert_allclose(getattr(one.table, name), getattr(other.table, name), atol=1e-12)
        lists = [
            _sorted(*way(cloud.table, reach))
            for way, cloud in ((broadphase.find_near_pairs, one), (library.near, other))
        ]
        (pairs, lows), (same_pairs, same_lows) = lists
        np.testing.assert_array_equal(pairs, same_pairs)
        np.testing.assert_allclose(lows, same_lows, atol=1e-12)
        for i, j in pairs[::2].tolist():
            for table in (one.table, other.table):
                table.bounds[i, j] = one.distance(i, j) + table.travel[i] + table.travel[j]


def _sorted(pairs, lows):
    order = np.lexsort(pairs.T[::-1])
    return pairs[order].copy(), lows[order].copy()


@pytest.mark.compiler
def test_place_objects_refuses_poses_that_are_not_finite(library):
    cloud = Cloud(3, 5, 4)
    fresh = np.ascontiguousarray(cloud.step(0.1))
    fresh[2, 1, 3] = np.nan
    before = cloud.table.poses.copy()
    assert broadphase.place_objects(cloud.table, fresh) == library.place(cloud.table, fresh) == 2
    np.testing.assert_array_equal(cloud.table.poses, before)
    assert not cloud.table.travel.any()


def test_recorded_distances_bound_later_ones():
    """Two discs a metre wide, half a metre apart: boxes and spheres overlap, the recorded distance does not."""
    table = ObjectTable(2, np.arange(2, dtype=np.int32), 1 - np.eye(2, dtype=np.uint8))
    for k in range(2):
        table.set_solid(k, np.zeros(3), np.array([1.0, 1.0, 1.0]), 1.8)
    poses = table.poses.copy()
    poses[1, 0, 3] = 0.5
    broadphase.place_objects(table, poses)
    assert len(broadphase.find_near_pairs(table, 0.1)[0]) == 1
    table.bounds[0, 1] = 0.5 + table.travel[:2].sum()
    assert len(broadphase.find_near_pairs(table, 0.1)[0]) == 0
    poses[1, 0, 3] += 0.3
    broadphase.place_objects(table, poses)
    assert len(broadphase.find_near_pairs(table, 0.1)[0]) == 0
    poses[1, 0, 3] -= 0.3  # back where it was, but that is not known
    broadphase.place_objects(table, poses)
    assert len(broadphase.find_near_pairs(table, 0.1)[0]) == 1


@settings(max_examples=attempts(60))
@given(seed=st.integers(0, 10**6), count=st.integers(0, 70))
def test_static_tree_contains_every_object_once_in_enclosing_boxes(seed, count):
    rng = np.random.default_rng(seed)
    low = rng.normal(size=(80, 3)).round(1)  # with some in the same place
    high = low + rng.uniform(0, 1, (80, 3))
    pieces = rng.permutation(80)[:count].astype(np.int32)
    boxes, leaves = build_static_tree(low, high, pieces)
    assert boxes.shape[1:] == (6, TREE_WIDTH)
    assert leaves.shape[1] == TREE_WIDTH
    assert sorted(leaves[leaves >= 0].tolist()) == sorted(pieces.tolist())
    for number, leaf in enumerate(leaves):
        assert (np.diff((leaf < 0).astype(int)) >= 0).all()  # those that are none come last
        for child, piece in enumerate(leaf[leaf >= 0]):
            node = len(boxes) - len(leaves) + number
            while True:
                assert (boxes[node, :3, child] <= low[piece]).all()
                assert (boxes[node, 3:, child] >= high[piece]).all()
                if node == 0:
                    break
                node, child = divmod(node - 1, TREE_WIDTH)


@pytest.mark.compiler
def test_find_near_pairs_sees_static_objects_at_their_last_pose(library):
    cloud = Cloud(5, 12, 2)
    table = cloud.table
    for _ in range(3):
        standing = np.arange(2, 12)
        table.poses[standing] = cloud.random_poses(10)
        table.update_boxes(standing)
        found, expected = (_sorted(*way(table, 0.3))[0] for way in (library.near, broadphase.find_near_pairs))
        np.testing.assert_array_equal(found, expected)


def test_static_tree_of_no_objects_is_empty():
    """A scene may have no usable shape."""
    corners = np.empty((0, 3))
    boxes, leaves = build_static_tree(corners, corners, np.empty(0, dtype=np.int32))
    assert (leaves == -1).all()
    assert (boxes[:, :3] > boxes[:, 3:]).all()
