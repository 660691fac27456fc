"""What a type checker has to say about a user's code; ``test_types`` runs both it and the code."""

import contextlib
from typing import Any, assert_type

import numpy as np
from numpy.typing import NDArray

import kineverse as kv

a, b = kv.position("a"), kv.position("b")
Numbers = NDArray[np.float64]

# Expressions stay expressions, with numbers on either side of methods and operators.
assert_type(2 * a + np.float64(1.0) * b, kv.Expression)
assert_type(kv.array([a, b]) @ np.eye(2), kv.Expression)
assert_type(kv.array([a, b]).sum(axis=0), kv.Expression)
assert_type(kv.array([a, b]).max(), kv.Expression)
assert_type(divmod(a, 2), tuple[kv.Expression, kv.Expression])
assert_type(round(a, 2), kv.Expression)
# numpy's own declarations say array; kv.array tells the checker better, and does nothing else.
assert_type(kv.array(np.sin(a)), kv.Expression)
assert_type(kv.array(np.stack([a, b])), kv.Expression)

# Compiled functions know what they return.
one, two = kv.compile(a * b), kv.compile([a * b, kv.rotation_z(a)])
assert_type(one({"a": 1.0, "b": 2.0}), Numbers)
assert_type(two([1.0, 2.0]), tuple[Numbers, ...])
assert_type(one.batch(np.zeros((3, 2))), Numbers)
assert_type(kv.compile(kv.array([1.0, 2.0]))(), Numbers)
kept: kv.CompiledFunction = one
either: kv.CompiledFunction[Any] = two

# Whatever has three numbers is an axis, whatever is 4×4 a place.
kv.Revolute(name="d", parent="world", child="d", axis=[0, 0, 1], origin=np.eye(4))
kv.Prismatic(
    name="d", parent="world", child="d", axis=np.array([0.0, 0.0, 1.0]), origin=kv.translation(1, 0, 0)
)
kv.Planar(name="d", parent="world", child="d", axis=(0, 0, 1), origin=np.eye(4).tolist())
kv.articulations.Universal(name="d", parent="world", child="d", first=[0, 0, 1], second=[0, 1, 0])
kv.quaternion([0, 0, 0, 1])
kv.quaternion(np.array([0, 0, 0, 1.0]))
kv.rpy((0.1, 0.2, 0.3))
kv.spatial.point([1, 2, 3])
kv.axis_angle([0, 0, 1], a)
kv.axis_angle(np.array([0, 0, 1.0]), 0.3)
kv.translation([1, 2, 3])
kv.transform(np.eye(3), [1, 2, 3])
with contextlib.suppress(kv.errors.InvalidValueError):
    kv.Revolute(name="d", parent="world", child="d", axis=3.0)  # type: ignore[arg-type]
