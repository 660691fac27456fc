"""Every function of kineverse.spatial against scipy: values, gradients, augmented arguments, bad input.

Where rotations are singular is the subject of ``test_spatial_singular``.
"""

from __future__ import annotations

import inspect
import math

import numpy as np
import pytest
from scipy.linalg import expm, logm
from scipy.spatial.transform import Rotation

import kineverse as kv
from kineverse import lie, spatial
from kineverse.errors import InvalidValueError, KineverseError, ShapeError
from kineverse.expressions import array

X = [kv.position(f"space/{i}") for i in range(6)]
W, W2 = kv.velocity("wheel"), kv.velocity("other wheel")


# -- numbers, by numpy and scipy alone ---------------------------------------------------------------------


def homogeneous(rotation, position=(0, 0, 0)):
    a_T_b = np.eye(4)
    a_T_b[:3, :3] = rotation.as_matrix() if isinstance(rotation, Rotation) else rotation
    a_T_b[:3, 3] = position
    return a_T_b


def cross_matrix(v):
    return np.cross(np.eye(3), v)


def twist_matrix(xi):
    m = np.zeros((4, 4))
    m[:3, :3] = cross_matrix(xi[3:])
    m[:3, 3] = xi[:3]
    return m


def pose_numbers(x):
    return homogeneous(Rotation.from_rotvec(x[:3]), x[3:])


def logarithm(a_T_b):
    m = logm(a_T_b).real
    return np.array([*m[:3, 3], m[2, 1], m[0, 2], m[1, 0]])


def adjoint_numbers(a_T_b):
    """Column by column: a twist moved along as a matrix, T ξ^ T⁻¹."""
    columns = []
    for xi in np.eye(6):
        m = a_T_b @ twist_matrix(xi) @ np.linalg.inv(a_T_b)
        columns.append([*m[:3, 3], m[2, 1], m[0, 2], m[1, 0]])
    return np.array(columns).T


def pose(x):
    return spatial.transform(spatial.exp_so3(x[:3]), x[3:])


def turned(x):
    return Rotation.from_matrix(pose_numbers(x)[:3, :3])


# name: how many numbers go in, what the library makes of them, what numpy and scipy make of them
CASES = {
    "translation": (3, lambda x: spatial.translation(*x), lambda x: homogeneous(np.eye(3), x)),
    "translation of a vector": (3, spatial.translation, lambda x: homogeneous(np.eye(3), x)),
    "rotation_x": (
        1,
        lambda x: spatial.rotation_x(x[0]),
        lambda x: homogeneous(Rotation.from_euler("x", x[0])),
    ),
    "rotation_y": (
        1,
        lambda x: spatial.rotation_y(x[0]),
        lambda x: homogeneous(Rotation.from_euler("y", x[0])),
    ),
    "rotation_z": (
        1,
        lambda x: spatial.rotation_z(x[0]),
        lambda x: homogeneous(Rotation.from_euler("z", x[0])),
    ),
    "axis_angle": (
        4,
        lambda x: spatial.axis_angle(x[:3], x[3]),
        lambda x: homogeneous(Rotation.from_rotvec(x[:3] / np.linalg.norm(x[:3]) * x[3])),
    ),
    "rpy": (3, lambda x: spatial.rpy(*x), lambda x: homogeneous(Rotation.from_euler("xyz", x))),
    "to_rpy": (6, lambda x: spatial.to_rpy(pose(x)), lambda x: turned(x).as_euler("xyz")),
    "quaternion": (4, lambda x: spatial.quaternion(*x), lambda x: homogeneous(Rotation.from_quat(x))),
    "to_quaternion": (
        6,
        lambda x: spatial.to_quaternion(pose(x)),
        lambda x: turned(x).as_quat(canonical=True),
    ),
    "log_so3": (6, lambda x: spatial.log_so3(pose(x)), lambda x: turned(x).as_rotvec()),
    "rotation_angle": (6, lambda x: spatial.rotation_angle(pose(x)), lambda x: turned(x).magnitude()),
    "exp_so3": (3, spatial.exp_so3, lambda x: homogeneous(expm(cross_matrix(x)))),
    "exp_se3": (6, spatial.exp_se3, lambda x: expm(twist_matrix(x))),
    "log_se3": (6, lambda x: spatial.log_se3(pose(x)), lambda x: logarithm(pose_numbers(x))),
    "inverse": (6, lambda x: spatial.inverse(pose(x)), lambda x: np.linalg.inv(pose_numbers(x))),
    "transform": (6, lambda x: spatial.transform(spatial.exp_so3(x[:3])[:3, :3], x[3:]), pose_numbers),
    "rotation_of": (6, lambda x: spatial.rotation_of(pose(x)), lambda x: pose_numbers(x)[:3, :3]),
    "position_of": (6, lambda x: spatial.position_of(pose(x)), lambda x: x[3:]),
    "point": (3, lambda x: spatial.point(*x), lambda x: np.append(x, 1)),
    "vector": (3, lambda x: spatial.vector(*x), lambda x: np.append(x, 0)),
    "skew": (3, spatial.skew, lambda x: np.array([np.cross(x, e) for e in np.eye(3)]).T),
    "adjoint": (6, lambda x: spatial.adjoint(pose(x)), lambda x: adjoint_numbers(pose_numbers(x))),
    "as_transform": (6, lambda x: spatial.as_transform(pose(x)), pose_numbers),
    "unit_vector": (3, spatial.unit_vector, lambda x: x / np.linalg.norm(x)),
}
ALL = pytest.mark.parametrize("name", CASES)


def points(count, size):
    """Numbers whose first three are a rotation by 0.3 to 2.9 rad."""
    result = np.random.default_rng(11).uniform(-1.5, 1.5, (count, size))
    if size == 6:
        result[:, :3] *= (np.linspace(0.3, 2.9, count) / np.linalg.norm(result[:, :3], axis=1))[:, None]
    return result


def slopes(f, x, step=1e-4):
    """Central differences of fourth order along the last axis."""
    columns = []
    for e in np.eye(len(x)) * step:
        near, far = f(x + e) - f(x - e), f(x + 2 * e) - f(x - 2 * e)
        columns.append((8 * near - far) / (12 * step))
    return np.stack(columns, axis=-1)


def test_every_public_function_has_a_case():
    public = {
        name
        for name, f in vars(spatial).items()
        if inspect.isfunction(f) and f.__module__ == spatial.__name__ and not name.startswith("_")
    }
    recognised = {"rotation_about", "translation_along", "as_one_axis_transform"}
    assert public == {name.split(" ")[0] for name in CASES} | recognised


@ALL
def test_values_and_gradients(name):
    size, function, numbers = CASES[name]
    symbols = X[:size]
    e = function(array(symbols))
    jacobian = e.jacobian(symbols)
    for x in points(4, size):
        at, expected = dict(zip(symbols, x, strict=True)), numbers(x)
        assert e.shape == np.shape(expected)
        np.testing.assert_allclose(e(at), expected, atol=1e-13, err_msg=str(x))
        np.testing.assert_allclose(jacobian(at), slopes(numbers, x), atol=1e-9, err_msg=str(x))


@ALL
def test_arrays_lists_and_expressions_are_accepted(name):
    size, function, numbers = CASES[name]
    for x in points(2, size):
        for given in (x, x.tolist(), array(x)):
            e = function(given)
            assert e.is_constant
            np.testing.assert_allclose(e(), numbers(x), atol=1e-13)


@ALL
def test_augmented_arguments_keep_their_entries(name):
    size, function, _ = CASES[name]
    symbols, share = X[:size], np.linspace(-1, 2, size)
    given = array([s.augment({W: k, s.derivative(): 3}) for s, k in zip(symbols, share, strict=True)])
    plain, e = function(array(symbols)).jacobian(symbols), function(given)
    at = dict(zip(symbols, points(2, size)[1], strict=True))
    np.testing.assert_allclose(e(at), function(array(symbols))(at), atol=1e-15)
    np.testing.assert_allclose(e.gradient()[W](at), plain(at) @ share, atol=1e-12)
    np.testing.assert_allclose(e.jacobian(symbols)(at), 3 * plain(at), atol=1e-12)


@ALL
def test_constants_with_a_gradient_keep_it(name):
    size, function, numbers = CASES[name]
    x = points(3, size)[2]
    e = function(array(x).augment({W2: np.ones(size)}))
    assert e.symbols == ()
    assert not e.is_constant
    np.testing.assert_allclose(e(), numbers(x), atol=1e-13)
    np.testing.assert_allclose(e.gradient()[W2](), slopes(numbers, x).sum(axis=-1), atol=1e-9)


def test_quaternions_and_axes_of_any_length():
    q, axis = np.array([0.3, -0.2, 0.7, 0.4]), np.array([1.0, -2.0, 0.5])
    for length in (1e-200, 1e-9, 0.5, 1, 3, 1e9, 1e200, -1, -1e-200):
        np.testing.assert_allclose(
            spatial.quaternion(*length * q)(), homogeneous(Rotation.from_quat(q)), atol=1e-15
        )
        np.testing.assert_allclose(
            spatial.unit_vector(length * axis)(), np.sign(length) * spatial.unit_vector(axis)(), atol=1e-15
        )
        expected = homogeneous(Rotation.from_rotvec(spatial.unit_vector(axis)() * 0.6 * np.sign(length)))
        np.testing.assert_allclose(spatial.axis_angle(length * axis, 0.6)(), expected, atol=1e-15)


def test_the_smallest_quaternion():
    assert spatial.quaternion(5e-324, 0, 0, 0)().tolist() == np.diag([1, -1, -1, 1]).tolist()
    assert spatial.quaternion(0, 0, 1e308, 1e308)()[1, 0] == 1


def test_quaternion_has_no_derivative_along_its_length():
    e = spatial.quaternion(*X[:4])
    q = np.array([0.3, -0.2, 0.7, 0.4])
    jacobian = e.jacobian(X[:4])(dict(zip(X, q, strict=False)))
    np.testing.assert_allclose(jacobian @ q, np.zeros((4, 4)), atol=1e-15)


def test_exact_zeros_and_ones():
    assert lie.normalize([3, 0, -4]) == (0.6, 0.0, -0.8)
    assert lie.normalize((0, -1e-300, -0.0)) == (0, -1, 0)
    assert lie.normalize([1, 1e-16, -0.0]) == (1.0, 0.0, 0.0)
    assert all(math.copysign(1, c) > 0 for c in lie.normalize([1, -1e-16, -0.0]))
    for nothing in ([0, 0, 0], [math.inf, 0, 0], [1, math.nan, 0], [math.nan, 1, 1]):
        assert lie.normalize(nothing) is None
    turn = lie.round_exact(spatial.rotation_z(math.pi / 2)())
    assert turn.tolist() == [[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    assert lie.round_exact(np.array([0.5, 1 - 1e-14, math.inf])).tolist() == [0.5, 1 - 1e-14, math.inf]


# -- bad input ---------------------------------------------------------------------------------------------

FLAT, TALL = np.zeros((3, 4)), np.zeros((4, 4, 1))
BAD = [
    (lambda: spatial.translation([1, 2]), r"not by something of shape \(2,\)"),
    (lambda: spatial.translation([1, 2], 3, 4), r"not by something of shape \(2,\)"),
    (lambda: spatial.translation([1, 2, 3], 4), r"one vector of shape \(3,\) alone"),
    (lambda: spatial.translation([1, 2, 3], z=4), r"one vector of shape \(3,\) alone"),
    (lambda: spatial.translation(0, [[1]]), r"of shape \(1, 1\)"),
    (lambda: spatial.rotation_x([1, 2]), r"angle is a scalar, not of shape \(2,\)"),
    (lambda: spatial.rotation_y([0.0]), r"angle is a scalar, not of shape \(1,\)"),
    (lambda: spatial.rotation_z(FLAT), r"angle is a scalar, not of shape \(3, 4\)"),
    (lambda: spatial.rpy([1, 2], 0, 0), "3 numbers roll, pitch, yaw"),
    (lambda: spatial.axis_angle([1, 2], 0), r"axis of a rotation has shape \(3,\), not \(2,\)"),
    (lambda: spatial.axis_angle([1, 0, 0], [1, 2]), r"\(2,\)|Ragged"),
    (lambda: spatial.quaternion(0, 0, [0, 1], 1), r"\(2,\)|Ragged"),
    (lambda: spatial.exp_so3([1, 2, 3, 4]), r"rotation vector has shape \(3,\), not \(4,\)"),
    (lambda: spatial.exp_so3([[1, 2, 3]]), r"not \(1, 3\)"),
    (lambda: spatial.exp_se3([1, 2, 3]), r"twist has shape \(6,\), linear part first, not \(3,\)"),
    (lambda: spatial.transform(np.eye(3), [1, 2]), r"position has shape \(3,\), not \(2,\)"),
    (lambda: spatial.transform(np.eye(2), [1, 2, 3]), r"4×4 matrix, not of shape \(2, 2\)"),
    (lambda: spatial.skew(1.0), r"vector has shape \(3,\), not \(\)"),
    (lambda: spatial.unit_vector([[1.0, 0, 0]]), r"vector has shape \(3,\), not \(1, 3\)"),
    (lambda: spatial.point([1, 2], 0, 0), r"A point .* \(2,\) among others"),
    (lambda: spatial.vector([1, 2], 0, 0), r"A direction .* \(2,\) among others"),
]  # fmt: skip
OF_A_TRANSFORM = [
    spatial.to_rpy, spatial.to_quaternion, spatial.log_so3, spatial.rotation_angle, spatial.rotation_of,
    spatial.log_se3, spatial.inverse, spatial.position_of, spatial.adjoint, spatial.as_transform,
]  # fmt: skip


@pytest.mark.parametrize(("bad", "message"), BAD)
def test_wrong_shapes_are_refused(bad, message):
    with pytest.raises(ShapeError, match=message):
        bad()


@pytest.mark.parametrize("function", OF_A_TRANSFORM)
def test_matrices_that_are_no_transforms_are_refused(function):
    for given in (FLAT, TALL, 1.0, np.zeros(16), array(X[:3])):
        with pytest.raises(ShapeError, match=r"A transform is a 4×4 matrix, not of shape"):
            function(given)
    with pytest.raises(InvalidValueError, match="NaN"):
        function(np.full((4, 4), math.nan))
    with pytest.raises(KineverseError, match="is not an expression or a number"):
        function("pose")


def test_zero_vectors_are_refused():
    with pytest.raises(InvalidValueError, match="The axis of a rotation has length zero"):
        spatial.axis_angle([0, 0, 0], X[0])
    with pytest.raises(InvalidValueError, match="The vector has length zero"):
        spatial.unit_vector(np.zeros(3))
    with pytest.raises(InvalidValueError, match="The lever has length zero"):
        spatial.unit_vector(array([0.0, 0, 0]).augment({W: [1, 0, 0]}), "The lever")
    for q in ([0, 0, 0, 0], [0, 0, 0, math.inf]):
        with pytest.raises(InvalidValueError, match=r"quaternion .* has no direction"):
            spatial.quaternion(*q)
    with pytest.raises(InvalidValueError, match="quaternion of length zero has no direction"):
        spatial.quaternion(*array([0.0, 0, 0, 0]).augment({W: 1}))
    assert np.isnan(
        spatial.unit_vector(X[:3])(dict.fromkeys(X[:3], 0.0))
    ).all()  # and not some direction or other


@pytest.mark.parametrize("name", [n for n in CASES if n not in ("transform_like", "rotation_of")])
def test_nan_is_refused(name):
    size, function, _ = CASES[name]
    for i in range(size):
        x: list[float] = [1.0] * size
        x[i] = math.nan
        with pytest.raises(InvalidValueError, match="NaN"):
            function(x)


def test_components_as_one_vector():
    """What takes numbers one by one takes them as one vector too: list, tuple, array or expression."""
    a, b = kv.position("spatial/a"), kv.position("spatial/b")
    at = {a: 0.3, b: -0.4}
    for function, numbers in (
        (kv.translation, [a, 2.0, b]), (kv.spatial.point, [a, 2.0, b]), (kv.spatial.vector, [1.0, b, 3.0]), (kv.rpy, [a, 0.1, b]),
        (kv.quaternion, [a, b, 0.5, 1.0]),
    ):  # fmt: skip
        apart = function(*numbers)
        for together in (
            numbers,
            tuple(numbers),
            kv.array(numbers),
            *([np.array(numbers)] if a not in numbers and b not in numbers else []),
        ):
            assert function(together) == apart
        np.testing.assert_array_equal(
            function(np.arange(len(numbers)) + 1.0)(), function(*range(1, len(numbers) + 1))()
        )
        assert apart(at).shape in ((4,), (4, 4))
    assert kv.translation(1.0)()[:3, 3].tolist() == [1, 0, 0]


@pytest.mark.parametrize(("call", "message"), [
    (lambda: kv.quaternion([1, 2, 3]), r"A quaternion is given as 4 numbers x, y, z, w or as one vector of shape \(4,\) alone, not by something of shape \(3,\)"),
    (lambda: kv.quaternion(0, 0, 1), r"4 numbers x, y, z, w or as one vector of shape \(4,\) alone, not as 3"),
    (lambda: kv.quaternion([0, 0, 0, 1], 1, 2, 3), r"alone, not by something of shape \(4,\) among others"),
    (lambda: kv.rpy(0.1, 0.2), "3 numbers roll, pitch, yaw .* not as 2"), (lambda: kv.rpy(np.eye(3)), r"shape \(3, 3\)"),
    (lambda: kv.spatial.point([1, 2]), r"A point .* shape \(2,\)"), (lambda: kv.spatial.vector(1), "A direction .* not as 1"),
    (lambda: kv.translation([1, 2, 3, 4]), r"A translation .* shape \(4,\)"),
])  # fmt: skip
def test_a_wrong_number_of_components_is_refused(call, message):
    with pytest.raises(kv.errors.ShapeError, match=message):
        call()
