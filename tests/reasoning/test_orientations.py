"""Limits of orientations: decided by the eigenvalues of quadratic forms of a unit quaternion."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import kineverse as kv
from kineverse import reasoning
from kineverse.reasoning import Interlock, Interlocks, Undecided, interlocks

Q = [kv.position(f"ball/q{c}") for c in "xyzw"]
DOOR = kv.position("door")


def ball(**fields) -> kv.Model:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.articulations.Ball(name="ball", parent="world", child="ball", **fields))
    return model


def limited(lower, expression, upper) -> kv.Model:
    model = ball()
    with model.edit() as edit:
        edit.constrain("limit", lower, expression, upper)
    return model


@pytest.mark.parametrize("cone", [0.05, 0.7, math.pi])
@pytest.mark.parametrize("axis", [(0, 0, 1), (1, 2, 3)])
def test_cone_and_twist_are_no_interlocks(cone: float, axis: tuple[float, float, float]) -> None:
    """They are limits of one joint, like those of a hinge, and lock nothing."""
    model = ball(cone=cone, twist=1.0, axis=axis)
    assert interlocks(model) == Interlocks([])
    assert reasoning.contradictions(model, Interlocks([])) == []


def leaning(axis: int = 2) -> kv.Expression:
    """The vertical component of the z axis: an entry of the rotation matrix, quadratic in q."""
    return kv.quaternion(*Q)[axis, axis]


def test_limits_beyond_rotation_matrix_entries_have_no_value() -> None:
    assert interlocks(limited(-1 - 1e-6, leaning(), 1 + 1e-6)) == Interlocks([])
    model = limited(1.001, leaning(), 2)
    (lock,) = interlocks(model)
    assert (lock.hold, lock.constraints, lock.is_permanent) == ("has no value", ("limit",), True)
    assert reasoning.contradictions(model, interlocks(model)) == []
    assert reasoning.contradictions(model, Interlocks([])) == [f"{leaning()} is never within its limits"]
    nearly = interlocks(limited(1, leaning(), 2)).undecided
    assert [str(u) for u in nearly] == [
        "limit: unknown, as it leaves next to no room to the orientation of "
        "ball/qw, ball/qx, ball/qy, ball/qz: always"
    ]


def test_contradictions_reports_a_wrong_void() -> None:
    model = limited(0.5, leaning(), 2)
    assert interlocks(model) == Interlocks([])
    wrong = Interlock(leaning(), "has no value", ("limit",), (reasoning.IntervalBox({}),))
    assert reasoning.contradictions(model, Interlocks([wrong]))


def test_form_range_matches_random_rotations() -> None:
    """The sum of two entries of a rotation matrix, beside many rotations of scipy."""
    pose = kv.quaternion(*Q)
    expression = pose[0, 1] + 0.5 * pose[1, 0]
    turns = Rotation.random(200_000, rng=np.random.default_rng(0)).as_matrix()
    highest = (turns[:, 0, 1] + 0.5 * turns[:, 1, 0]).max()
    (lock,) = interlocks(limited(1.5 + 1e-6, expression, 9))
    assert lock.hold == "has no value"
    assert 1.45 < highest < 1.5
    assert interlocks(limited(highest, expression, 9)) == Interlocks([])


def test_conditions_on_orientations() -> None:
    """What an orientation always is decides; what it may be is named."""
    model = ball()
    with model.edit() as edit:
        edit.constrain("always", -1, DOOR.derivative(), leaning() < 1.5)
        edit.constrain("never", -1, DOOR.derivative(), leaning() < -1.5)
        edit.constrain("sometimes", -1, DOOR.derivative(), leaning() < 0.5)
    found = interlocks(model)
    assert [str(lock) for lock in found] == ["door:velocity cannot increase: always (never)"]
    reason = "ball/qx and ball/qy occur together in a condition that is not linear"
    assert found.undecided == (Undecided("sometimes", reason),)
    assert reasoning.contradictions(model, found) == []


def test_limit_of_higher_degree_on_an_orientation_is_undecided() -> None:
    (unknown,) = interlocks(limited(-1, leaning() * leaning(0) + leaning(1) ** 3, 0.3)).undecided
    assert "more than products of two of these" in unknown.reason


def test_find_orientations_ignores_wheels() -> None:
    """A differential drive has two wheels for three coordinates, whose squares add up to nothing fixed."""
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(
            kv.articulations.DifferentialDrive(
                name="base", parent="world", child="base", radius=0.1, track=0.4
            )
        )
        x, y = kv.position("base/x"), kv.position("base/y")
        edit.constrain("fence", 0, x * x + y * y, 4)
    (unknown,) = interlocks(model).undecided
    assert unknown.reason == "it limits several coordinates at once, and they are not just added"
