"""Every function of kineverse.lie on stacks, against scipy and against kineverse.spatial."""

import inspect
import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from kineverse import lie, spatial

ROTATION_VECTORS = np.random.default_rng(7).normal(0.0, 1.0, (4, 6, 3))
POSITIONS = np.random.default_rng(8).uniform(-2.0, 2.0, (4, 6, 3))
ROTATIONS = Rotation.from_rotvec(ROTATION_VECTORS.reshape(-1, 3)).as_matrix().reshape(4, 6, 3, 3)
TRANSFORMS = lie.transform(ROTATIONS, POSITIONS)
AXES = np.random.default_rng(9).normal(0.0, 1.0, (4, 6, 3))
ANGLES = np.random.default_rng(10).uniform(-3.0, 3.0, (4, 6))
TWISTS = np.concatenate([POSITIONS, 0.9 * ROTATION_VECTORS], axis=-1)

# name of a function of both modules: its arguments, as stacks with two leading axes
TWINS = {
    "skew": [POSITIONS],
    "exp_so3": [ROTATION_VECTORS],
    "log_so3": [ROTATIONS],
    "rotation_angle": [ROTATIONS],
    "rotation_x": [ANGLES],
    "rotation_y": [ANGLES],
    "rotation_z": [ANGLES],
    "axis_angle": [AXES, ANGLES],
    "rpy": [POSITIONS],
    "to_rpy": [ROTATIONS],
    "quaternion": [np.concatenate([AXES, ANGLES[..., None]], axis=-1)],
    "to_quaternion": [ROTATIONS],
    "transform": [ROTATIONS, POSITIONS],
    "translation": [POSITIONS],
    "rotation_of": [TRANSFORMS],
    "position_of": [TRANSFORMS],
    "inverse": [TRANSFORMS],
    "exp_se3": [TWISTS],
    "log_se3": [TRANSFORMS],
    "adjoint": [TRANSFORMS],
    "unit_vector": [AXES],
}
VECTORS = arrays(float, 3, elements=st.floats(-4, 4).map(lambda x: 0.0 if abs(x) < 1e-12 else x))


def public_functions(module):
    return {
        name
        for name, f in vars(module).items()
        if inspect.isfunction(f) and f.__module__ == module.__name__ and not name.startswith("_")
    }


def test_every_function_of_both_modules_is_a_twin():
    assert set(TWINS) == public_functions(lie) & public_functions(spatial)


@pytest.mark.parametrize("name", TWINS)
def test_stacks_equal_the_expressions_one_by_one(name):
    arguments = TWINS[name]
    found = getattr(lie, name)(*arguments)
    for index in np.ndindex(4, 2):
        expected = np.asarray(getattr(spatial, name)(*(stack[index] for stack in arguments))())
        if expected.shape != found[index].shape:
            np.testing.assert_array_equal(expected[:3, 3], 0.0)
            expected = expected[:3, :3]
        np.testing.assert_allclose(found[index], expected, atol=1e-12)


@pytest.mark.parametrize("name", TWINS)
def test_a_single_argument_has_no_leading_axes(name):
    arguments = TWINS[name]
    found = getattr(lie, name)(*arguments)
    one = getattr(lie, name)(*(np.asarray(stack[2, 3]) for stack in arguments))
    np.testing.assert_allclose(one, found[2, 3], atol=1e-15)


def test_exp_so3_equals_scipy():
    vectors = np.random.default_rng(4).normal(0, 1.5, (50, 3))
    vectors[:3] = [[0, 0, 0], [1e-9, 0, 0], [0, math.pi, 0]]
    np.testing.assert_allclose(lie.exp_so3(vectors), Rotation.from_rotvec(vectors).as_matrix(), atol=1e-14)
    vectors = np.random.default_rng(0).normal(size=(50, 3)) * np.geomspace(1e-9, 3.0, 50)[:, None]
    np.testing.assert_allclose(lie.exp_so3(vectors), Rotation.from_rotvec(vectors).as_matrix(), atol=1e-12)
    np.testing.assert_array_equal(lie.exp_so3(np.zeros((1, 3)))[0], np.eye(3))


def test_log_so3_equals_scipy_and_inverse_right_jacobian_its_difference_quotient():
    rng = np.random.default_rng(0)
    directions = rng.standard_normal((200, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    angles = np.concatenate([[0.0, 1e-12, 1e-6, 0.019, 0.021, np.pi - 1e-6, np.pi], rng.uniform(0, 3.1, 193)])
    rotations = Rotation.from_rotvec(directions * angles[:, None]).as_matrix()
    found = lie.log_so3(rotations)
    assert np.allclose(np.linalg.norm(found, axis=1), angles, atol=1e-9)
    assert np.allclose(Rotation.from_rotvec(found).as_matrix(), rotations, atol=1e-12)
    for k, d in enumerate(1e-6 * np.eye(3)):
        ahead, behind = (lie.log_so3(rotations @ Rotation.from_rotvec(s * d).as_matrix()) for s in (1, -1))
        column, some = lie.inverse_right_jacobian(found)[:, :, k], angles < 3.1
        assert np.allclose(((ahead - behind) / 2e-6)[some], column[some], atol=1e-4)


def test_right_jacobian_and_its_inverse_are_inverse_to_each_other():
    vectors = np.random.default_rng(1).normal(0, 1.0, (4, 50, 3))
    vectors *= np.minimum(1.0, 3.1 / np.linalg.norm(vectors, axis=-1, keepdims=True))
    product = lie.right_jacobian(vectors) @ lie.inverse_right_jacobian(vectors)
    np.testing.assert_allclose(product, np.broadcast_to(np.eye(3), product.shape), atol=1e-12)


@given(VECTORS, VECTORS)
def test_exp_se3_equals_the_matrix_exponential_and_log_se3_inverts_it(v, omega):
    twist = np.concatenate([v, omega * min(1.0, 3.0 / max(np.linalg.norm(omega), 1.0))])
    matrix = np.zeros((4, 4))
    matrix[:3, :3], matrix[:3, 3] = lie.skew(twist[3:]), twist[:3]
    found = lie.exp_se3(twist)
    np.testing.assert_allclose(found, expm(matrix), atol=1e-11)
    np.testing.assert_allclose(lie.log_se3(found), twist, atol=1e-9)


@given(VECTORS)
@example(np.array([0.0, math.pi / 2, 0.0]))
@example(np.array([0.3, -math.pi / 2, 0.2]))
def test_rpy_and_to_rpy_describe_the_same_rotation(angles):
    rotation = lie.rpy(angles)
    np.testing.assert_allclose(rotation, Rotation.from_euler("xyz", angles).as_matrix(), atol=1e-14)
    found = lie.to_rpy(rotation)
    assert abs(found[1]) <= math.pi / 2
    np.testing.assert_allclose(lie.rpy(found), rotation, atol=1e-14)


def test_to_rpy_at_gimbal_lock_has_no_yaw():
    for pitch in (math.pi / 2, -math.pi / 2):
        found = lie.to_rpy(lie.rpy(np.array([0.1, pitch, 0.3])))
        assert found[2] == 0.0
        assert found[1] == pytest.approx(pitch)


@given(arrays(float, 4, elements=st.floats(-3, 3)).filter(lambda q: np.linalg.norm(q) > 1e-3))
@example(np.array([1.0, 0.0, 0.0, 0.0]))
@example(np.array([1.0, -1.0, 1.0, 0.0]))
def test_quaternion_equals_scipy_and_to_quaternion_inverts_it(xyzw):
    rotation = lie.quaternion(xyzw)
    np.testing.assert_allclose(rotation, Rotation.from_quat(xyzw).as_matrix(), atol=1e-14)
    found = lie.to_quaternion(rotation)
    assert found[3] >= 0.0
    assert abs(found @ xyzw) == pytest.approx(np.linalg.norm(xyzw), rel=1e-12)


@given(VECTORS, VECTORS, VECTORS, VECTORS)
def test_pose_difference_inverts_retract(turn, p, moved, turned):
    a_T_b = lie.transform(lie.exp_so3(turn), p)
    turned = turned * min(1.0, 3.0 / max(np.linalg.norm(turned), 1.0))
    error = np.concatenate([moved, turned])
    np.testing.assert_allclose(lie.pose_difference(lie.retract(a_T_b, error), a_T_b), error, atol=1e-9)


def test_orthonormalize_squares_the_distance_to_the_nearest_rotation():
    noisy = TRANSFORMS.copy()
    noisy[..., :3, :3] += 1e-5 * np.random.default_rng(0).normal(size=ROTATIONS.shape)
    found = lie.orthonormalize(noisy)
    u, _, vt = np.linalg.svd(noisy[..., :3, :3])
    np.testing.assert_allclose(found[..., :3, :3], u @ vt, atol=1e-8)
    np.testing.assert_array_equal(found[..., :3, 3], POSITIONS)


def test_mean_rotation_equals_scipy():
    rotations = lie.exp_so3(0.3 * ROTATION_VECTORS[0])
    np.testing.assert_allclose(
        lie.mean_rotation(rotations), Rotation.from_matrix(rotations).mean().as_matrix(), atol=1e-12
    )


@given(VECTORS.filter(lambda v: np.linalg.norm(v) > 1e-3))
@example(np.array([0.0, 0.0, 1.0]))
@example(np.array([0.0, 0.0, -2.0]))
@example(np.array([1e-7, 0.0, -1.0]))
def test_rotations_from_z_map_z_to_the_direction(direction):
    z = lie.unit_vector(direction)
    for rotation in (lie.rotation_along_z(direction), lie.smallest_rotation_from_z(z)):
        np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-13)
        assert np.linalg.det(rotation) == pytest.approx(1.0)
        np.testing.assert_allclose(rotation[:, 2], z, atol=1e-13)
    angle = lie.rotation_angle(lie.smallest_rotation_from_z(z))
    assert angle == pytest.approx(math.atan2(math.hypot(z[0], z[1]), z[2]), abs=1e-7)


def test_snap_makes_quarter_turns_exact():
    assert [lie.snap(x) for x in (6e-17, -6e-17, 1 + 2e-16, -1 + 1e-16)] == [0.0, 0.0, 1.0, -1.0]
    assert math.copysign(1.0, lie.snap(-6e-17)) == 1.0
    assert lie.snap(1e-14) == 1e-14
    assert math.isnan(lie.snap(math.nan))
    quarter = lie.round_exact(lie.rotation_z(np.array([math.pi / 2, math.pi])))
    assert quarter[0].tolist() == [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
