"""Rotations where formulas divide by nothing: at angle 0 and π, at gimbal lock, and where series take over.

The oracle of derivatives is scipy's matrix exponential along the imaginary axis, which takes no difference, and
for logarithms the inverse right Jacobian: log(R·exp(δ)) = v + J⁻¹δ.
"""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

import kineverse as kv
from hypothesis_profiles import attempts
from kineverse import spatial
from kineverse.expressions import array

X = [kv.position(f"singular/{i}") for i in range(6)]
DELTA = [kv.position(f"singular/delta{i}") for i in range(3)]
ENTRIES = [kv.position(f"singular/entry{i}") for i in range(9)]

PI = math.pi
SERIES = [2 * math.asin(math.sqrt(1e-3)), 0.1]  # where rotation_vector and the exponentials change over
ANGLES = [
    0,
    1e-300,
    1e-160,
    1e-9,
    1e-5,
    *(s + e for s in SERIES for e in (-1e-9, 1e-9)),
    1.0,
    3.1,
    PI - 1e-5,
    PI - 1e-9,
]
LARGE = [PI, PI + 1e-9, 5.0, 2 * PI, 50.0]
AXES = [
    np.array(axis) / np.linalg.norm(axis)
    for axis in (
        [1, 0, 0],
        [0, 1, 0],
        [0, 0, -1],
        [1, 1, 0],
        [1, 1, 1],
        [-1, 0.3, 0.2],
        [0.2, -1, 0.1],
        [0.5, 0.5, -2],
    )
]
EACH_AXIS = pytest.mark.parametrize("axis", AXES, ids=lambda a: str(a.round(2)))

EXPONENTIAL = kv.compile([e := spatial.exp_so3(X[:3]), e.jacobian(X[:3])], X[:3], tier="interpreter")
TWIST = kv.compile([e := spatial.exp_se3(X), e.jacobian(X)], X, tier="interpreter")


def skew(v):
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def twist_matrix(xi):
    m = np.zeros((4, 4), dtype=np.asarray(xi).dtype)
    m[:3, :3] = skew(xi[3:])
    m[:3, 3] = xi[:3]
    return m


def along_imaginary(f, x):
    """The Jacobian of an analytic function, exact to rounding."""
    return np.stack([f(x + 1e-30j * e).imag / 1e-30 for e in np.eye(len(x))], axis=-1)


def inverse_right_jacobian(v):
    """J⁻¹ = 1 + [v]/2 + (1/θ² - cot(θ/2)/(2θ))·[v]², with its limit 1/12 at 0; finite at π."""
    angle, k = np.linalg.norm(v), skew(v)
    factor = 1 / 12 if angle < 1e-3 else 1 / angle**2 - 1 / math.tan(angle / 2) / (2 * angle)
    return np.eye(3) + k / 2 + factor * k @ k


def at_matrix(function):
    """Compile a function of a rotation: its value at a matrix, and its derivative by a turn of the matrix in b."""
    e = function(array(ENTRIES).reshape(3, 3) @ spatial.exp_so3(DELTA)[:3, :3])
    f = kv.compile([e, e.jacobian(DELTA)], [*ENTRIES, *DELTA], tier="interpreter")
    return lambda numbers: f(np.append(numbers[:3, :3], [0, 0, 0]))


ROTATION_VECTOR, ROTATION_ANGLE, QUATERNION_OF, RPY_OF = map(
    at_matrix, (spatial.log_so3, spatial.rotation_angle, spatial.to_quaternion, spatial.to_rpy)
)


def matrix(v):
    return Rotation.from_rotvec(v).as_matrix()


# -- exponentials ------------------------------------------------------------------------------------------


@EACH_AXIS
def test_exp_so3(axis):
    for angle in ANGLES + LARGE:
        v = angle * axis
        value, jacobian = EXPONENTIAL(v)
        np.testing.assert_allclose(value[:3, :3], expm(skew(v)), atol=2e-14, err_msg=str(angle))
        assert value[3].tolist() == [0, 0, 0, 1]
        expected = along_imaginary(lambda x: expm(skew(x)), v)
        np.testing.assert_allclose(jacobian[:3, :3], expected, atol=1e-12, err_msg=str(angle))


@EACH_AXIS
def test_exp_se3(axis):
    for angle in ANGLES[::2] + LARGE[::2]:
        xi = np.array([0.3, -2.0, 0.7, *angle * axis])
        value, jacobian = TWIST(xi)
        np.testing.assert_allclose(value, expm(twist_matrix(xi)), atol=5e-14, err_msg=str(angle))
        expected = along_imaginary(lambda x: expm(twist_matrix(x)), xi)
        np.testing.assert_allclose(jacobian, expected, atol=2e-11, err_msg=str(angle))


def test_second_derivatives_at_zero():
    second = spatial.exp_so3(X[:3])[:3, :3].jacobian(X[:3]).jacobian(X[:3])
    for length in (0, 1e-9):
        found = second(dict(zip(X, length * AXES[-1], strict=False)))
        for i, j in np.ndindex(3, 3):
            x, y = skew(np.eye(3)[i]), skew(np.eye(3)[j])
            np.testing.assert_allclose(found[..., i, j], (x @ y + y @ x) / 2, atol=1e-8)


# -- logarithms --------------------------------------------------------------------------------------------


@EACH_AXIS
def test_log_so3_and_rotation_angle(axis):
    for angle in ANGLES:
        v = angle * axis
        found, jacobian = ROTATION_VECTOR(matrix(v))
        np.testing.assert_allclose(found, v, atol=2e-15 + 2e-15 * angle, err_msg=str(angle))
        np.testing.assert_allclose(jacobian, inverse_right_jacobian(v), atol=1e-12, err_msg=str(angle))
        found, slope = ROTATION_ANGLE(matrix(v))
        assert found == pytest.approx(angle, abs=2e-15)
        if angle == 0 or angle >= 1e-9:
            np.testing.assert_allclose(slope, axis if angle else [0, 0, 0], atol=1e-6, err_msg=str(angle))


@EACH_AXIS
def test_half_turns(axis):
    a_R_b = 2 * np.outer(axis, axis) - np.eye(3)
    positive = axis * np.sign(axis[np.abs(axis).argmax()])
    q, _ = QUATERNION_OF(a_R_b)
    v, jacobian = ROTATION_VECTOR(a_R_b)
    if np.sort(np.abs(axis))[-2] < 0.99 * np.abs(axis).max():  # else either of two is the largest
        np.testing.assert_allclose(q, [*positive, 0], atol=1e-15)
        np.testing.assert_allclose(v, PI * positive, atol=4e-15)
    np.testing.assert_allclose(np.linalg.norm(v), PI, atol=1e-15)
    np.testing.assert_allclose(matrix(v), a_R_b, atol=1e-15)
    np.testing.assert_allclose(jacobian, inverse_right_jacobian(v), atol=1e-12)
    angle, slope = ROTATION_ANGLE(a_R_b)
    assert angle == pytest.approx(PI, abs=1e-15)
    np.testing.assert_allclose(slope, v / PI, atol=1e-12)


def test_log_so3_of_the_identity():
    for identity in (np.eye(3), np.eye(4)):
        assert spatial.log_so3(identity)().tolist() == [0, 0, 0]
        assert spatial.rotation_angle(identity)() == 0
        assert spatial.to_quaternion(identity)().tolist() == [0, 0, 0, 1]
        assert not np.any(spatial.to_rpy(identity)())
    assert not np.any(spatial.log_se3(np.eye(4))())
    assert ROTATION_ANGLE(np.eye(3))[1].tolist() == [0, 0, 0]
    for axis in "xyz":  # one argument only, as joints are made
        e = getattr(spatial, f"rotation_{axis}")(X[0])
        for q in (0.0, PI, -PI, 2 * PI, 1e-9):
            at = {X[0]: q}
            assert np.isfinite(spatial.log_so3(e).jacobian([X[0]])(at)).all()
            assert np.isfinite(spatial.to_quaternion(e).jacobian([X[0]])(at)).all()


@EACH_AXIS
def test_to_quaternion_in_every_branch(axis):
    """Angles around π make x, y or z the largest component, small ones w."""
    for angle in (0, 1e-9, 0.7, 2.0, PI - 0.1, PI - 1e-9, -PI + 1e-9, -2.5):
        q = Rotation.from_rotvec(angle * axis).as_quat()
        q = q * np.sign(q[3])
        found, jacobian = QUATERNION_OF(matrix(angle * axis))
        np.testing.assert_allclose(found, q, atol=2e-15, err_msg=str(angle))
        x, y, z, w = q
        rate = np.array([[w, -z, y], [z, w, -x], [-y, x, w], [-x, -y, -z]]) / 2  # q∘(δ, 0)/2
        np.testing.assert_allclose(jacobian, rate, atol=1e-14, err_msg=str(angle))
        # From either sign to the rotation and back is the one with w >= 0.
        for sign in (1, -1):
            turn = spatial.quaternion(*sign * q)()
            np.testing.assert_allclose(turn[:3, :3], matrix(angle * axis), atol=2e-15)
            np.testing.assert_allclose(QUATERNION_OF(turn)[0], q, atol=2e-15)


# -- there and back ----------------------------------------------------------------------------------------

LENGTHS = st.one_of(st.sampled_from(ANGLES[:-1]), st.floats(0, PI - 1e-6))
DIRECTIONS = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1).map(np.array)
POSITIONS = st.tuples(*[st.floats(-10, 10)] * 3).map(np.array)
LOGARITHM = kv.compile(
    spatial.log_se3(spatial.transform(array(ENTRIES).reshape(3, 3), X[:3])),
    [*ENTRIES, *X[:3]],
    tier="interpreter",
)


def log(a_T_b):
    """The logarithm of a matrix of numbers."""
    return LOGARITHM(np.append(a_T_b[:3, :3], a_T_b[:3, 3]))


@settings(max_examples=attempts(50))
@given(LENGTHS, DIRECTIONS, POSITIONS)
def test_log_se3_inverts_exp_se3(angle, direction, position):
    xi = np.array([*position, *angle * direction / np.linalg.norm(direction)])
    there, _ = TWIST(xi)
    np.testing.assert_allclose(log(there), xi, atol=1e-8)  # near π the position suffers
    np.testing.assert_allclose(log(there)[3:], xi[3:], atol=2e-14)
    back, _ = TWIST(log(there))
    np.testing.assert_allclose(back, there, atol=1e-12)


def test_gradients_of_inverse_functions_cancel():
    f = kv.compile(spatial.log_se3(spatial.exp_se3(X)).jacobian(X), X, tier="interpreter")
    for axis in AXES:
        for angle in (*ANGLES[:-2], 3.14):
            found = f(np.array([0.3, -2.0, 0.7, *angle * axis]))
            tolerance = 1e-10 if angle < 3.1 else 1e-8
            np.testing.assert_allclose(found, np.eye(6), atol=tolerance, err_msg=f"{angle} {axis}")


# -- gimbal lock -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "pitch", [PI / 2, -PI / 2, PI / 2 - 1e-9, -PI / 2 + 1e-9, PI / 2 + 1e-9, PI / 2 - 1e-5, 1.5]
)
def test_to_rpy_at_gimbal_lock(pitch):
    """Whatever roll and yaw come out, they are together those of the rotation."""
    for roll, yaw in [(0, 0), (0.3, 0.5), (-2.0, 1.0), (PI, -PI / 2), (0.1, 3.0)]:
        numbers = Rotation.from_euler("xyz", [roll, pitch, yaw]).as_matrix()
        exact = numbers.copy()
        if abs(abs(pitch) - PI / 2) < 1e-12:
            exact[:2, 0], exact[2] = 0, [-np.sign(pitch), 0, 0]
        noise = Rotation.from_rotvec([1e-13, -2e-13, 1.5e-13]).as_matrix()
        for a_R_b in (numbers, exact, noise @ numbers, spatial.rpy(roll, pitch, yaw)()):
            found, _ = RPY_OF(a_R_b)
            assert abs(found[1]) <= PI / 2
            assert found[1] == pytest.approx(min(pitch, PI - pitch), abs=1e-8)
            np.testing.assert_allclose(spatial.rpy(*found)()[:3, :3], a_R_b[:3, :3], atol=2e-12)


def test_to_rpy_inverts_rpy():
    e = spatial.to_rpy(spatial.rpy(*X[:3]))
    f = kv.compile([e, e.jacobian(X[:3])], X[:3], tier="interpreter")
    for roll in (-3.1, -0.4, 0, 1e-9, 2.0, PI):
        for pitch in (-1.5, -1e-9, 0, 0.8):
            for yaw in (-2.0, 0, 1e-5, 3.0):
                found, jacobian = f(np.array([roll, pitch, yaw]))
                np.testing.assert_allclose(found, [roll, pitch, yaw], atol=1e-14)
                np.testing.assert_allclose(jacobian, np.eye(3), atol=1e-13)
