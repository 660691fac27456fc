"""Vectors of three in plain Python agree with numpy."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from kineverse.manipulation.pushing import vectors

number = st.floats(-10.0, 10.0)
vector = st.tuples(number, number, number)
pose = st.lists(st.lists(number, min_size=4, max_size=4), min_size=3, max_size=3)


@given(vector, vector, number)
def test_sums_and_products_are_those_of_numpy(a, b, factor):
    x, y = np.array(a), np.array(b)
    np.testing.assert_allclose(vectors.add(a, b, factor), x + factor * y, atol=1e-12)
    np.testing.assert_allclose(vectors.subtract(a, b), x - y)
    np.testing.assert_allclose(vectors.scale(factor, a), factor * x)
    np.testing.assert_allclose(vectors.inner_product(a, b), x @ y, atol=1e-12)
    np.testing.assert_allclose(vectors.cross_product(a, b), np.cross(x, y), atol=1e-12)
    np.testing.assert_allclose(vectors.length(a), np.linalg.norm(x))


@given(pose, vector)
def test_poses_place_and_rotate(rows, a):
    R, t = np.array(rows)[:, :3], np.array(rows)[:, 3]
    np.testing.assert_allclose(vectors.rotate(rows, a), R @ a, atol=1e-11)
    np.testing.assert_allclose(vectors.rotate_back(rows, a), R.T @ a, atol=1e-11)
    np.testing.assert_allclose(vectors.transform_point(rows, a), R @ a + t, atol=1e-11)


@given(vector, vector, vector)
def test_points_move_with_the_twist_of_their_body(linear, angular, point):
    twist = (*linear, *angular)
    moved = vectors.move_point(twist, point)
    np.testing.assert_allclose(moved, np.array(linear) + np.cross(angular, point), atol=1e-11)
