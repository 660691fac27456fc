"""Rotations and rotation vectors, many at a time, beside scipy."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

from kineverse.lie import exp_so3, inverse_right_jacobian, log_so3, right_jacobian


def test_exponentials_are_scipys():
    vectors = np.random.default_rng(4).normal(0, 1.5, (50, 3))
    vectors[:3] = [[0, 0, 0], [1e-9, 0, 0], [0, math.pi, 0]]
    np.testing.assert_allclose(exp_so3(vectors), Rotation.from_rotvec(vectors).as_matrix(), atol=1e-14)
    vectors = np.random.default_rng(0).normal(size=(50, 3)) * np.geomspace(1e-9, 3.0, 50)[:, None]
    np.testing.assert_allclose(exp_so3(vectors), Rotation.from_rotvec(vectors).as_matrix(), atol=1e-12)
    np.testing.assert_array_equal(exp_so3(np.zeros((1, 3)))[0], np.eye(3))


def test_logarithms_are_scipys_and_their_slopes_differences():
    rng = np.random.default_rng(0)
    directions = rng.standard_normal((200, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    angles = np.concatenate([[0.0, 1e-12, 1e-6, 0.019, 0.021, np.pi - 1e-6, np.pi], rng.uniform(0, 3.1, 193)])
    vectors = directions * angles[:, None]
    rotations = Rotation.from_rotvec(vectors).as_matrix()
    found = log_so3(rotations)
    assert np.allclose(np.linalg.norm(found, axis=1), angles, atol=1e-9)
    assert np.allclose(Rotation.from_rotvec(found).as_matrix(), rotations, atol=1e-12)
    for k, d in enumerate(1e-6 * np.eye(3)):
        ahead, behind = (log_so3(rotations @ Rotation.from_rotvec(s * d).as_matrix()) for s in (1, -1))
        column = inverse_right_jacobian(found)[:, :, k]
        some = angles < 3.1
        assert np.allclose(((ahead - behind) / 2e-6)[some], column[some], atol=1e-4)


def test_the_two_jacobians_are_inverse_to_each_other():
    vectors = np.random.default_rng(1).normal(0, 1.0, (4, 50, 3))
    vectors *= np.minimum(1.0, 3.1 / np.linalg.norm(vectors, axis=-1, keepdims=True))
    product = right_jacobian(vectors) @ inverse_right_jacobian(vectors)
    np.testing.assert_allclose(product, np.broadcast_to(np.eye(3), product.shape), atol=1e-12)
