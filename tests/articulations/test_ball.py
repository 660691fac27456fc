"""Ball joints: a quaternion that three speeds move, a cone, a twist, a speed."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from articulation_checks import (
    ORIGIN,
    WHERE,
    assert_is_a_value,
    assert_jacobian,
    assert_motion_law,
    assert_rows_keep_limits,
    homogeneous,
    model_of,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import kineverse as kv
from hypothesis_profiles import attempts

nan, inf = float("nan"), float("inf")
FULL = kv.articulations.Ball(**WHERE, axis=(1, 2, 3), cone=0.8, twist=0.5, velocity=2)
EVERY = [kv.articulations.Ball(**WHERE), FULL]


def at(rotation: Rotation, length: float = 1.0) -> dict[str, float]:
    quaternion = rotation.as_quat() * length
    return dict(zip((f"j/q{c}" for c in "xyzw"), quaternion.tolist(), strict=True))


@settings(max_examples=attempts(30), derandomize=True)
@given(seed=st.integers(0, 10**6), length=st.sampled_from([1.0, -1.0, 0.1, 7.0]))
def test_ball_pose_is_the_rotation_of_its_quaternion(seed: int, length: float) -> None:
    rotation = Rotation.random(rng=np.random.default_rng(seed))
    pose = model_of(kv.articulations.Ball(**WHERE)).fk("c")(at(rotation, length))
    np.testing.assert_allclose(pose, ORIGIN @ homogeneous(rotation), atol=1e-14)


def test_ball_has_four_coordinates_and_three_speeds() -> None:
    model = model_of(kv.articulations.Ball(**WHERE))
    record = model.articulations["j"]
    assert [str(s) for s in record.coordinates] == ["j/qx", "j/qy", "j/qz", "j/qw"]
    assert [str(s) for s in record.speeds] == ["j/wx:velocity", "j/wy:velocity", "j/wz:velocity"]
    assert record.position is None
    np.testing.assert_allclose(model.fk("c")(model.default_state()), ORIGIN, atol=1e-15)
    body = model.jacobian("c", form="body")(at(Rotation.from_rotvec([1, -2, 0.5])))
    np.testing.assert_allclose(body, np.vstack([np.zeros((3, 3)), np.eye(3)]), atol=1e-15)


@pytest.mark.parametrize("operation", EVERY)
@pytest.mark.parametrize("seed", range(4))
def test_ball_jacobian_equals_finite_differences(operation: kv.Operation, seed: int) -> None:
    assert_jacobian(model_of(operation), "c", seed)


def test_ball_tangent_equals_motion_along_rates() -> None:
    model = model_of(FULL)
    limited = [c.expression for name, c in model.constraints.items() if name != "j/velocity"]
    assert_motion_law(model, [model.fk("c"), model.jacobian("c"), *limited], seed=3)


@settings(max_examples=attempts(60), derandomize=True)
@given(seed=st.integers(0, 10**6), length=st.sampled_from([1.0, -2.0]))
def test_cone_and_twist_constraints_equal_swing_and_twist_angles(seed: int, length: float) -> None:
    rng, axis = np.random.default_rng(seed), np.array([1, 2, 3]) / math.sqrt(14)
    across = np.cross(axis, rng.normal(size=3))
    tilt, twist = rng.uniform(0, 1.5), rng.uniform(-1.0, 1.0)
    rotation = Rotation.from_rotvec(across / np.linalg.norm(across) * tilt) * Rotation.from_rotvec(
        axis * twist
    )
    broken = {v.name for v in model_of(FULL).violations(at(rotation, length))}
    assert broken == {name for name, far in (("j/cone", tilt > 0.8), ("j/twist", abs(twist) > 0.5)) if far}


def test_cone_and_twist_are_smooth_at_rest() -> None:
    model = model_of(FULL)
    home = model.default_state()
    for name in ("j/cone", "j/twist"):
        for entry in model.constraints[name].expression.gradient().values():
            assert entry(home) == 0
            assert all(math.isfinite(second(home)) for second in entry.gradient().values())


@pytest.mark.parametrize(("cone", "twist"), [(math.pi, math.pi), (math.pi, None), (None, math.pi)])
def test_cone_of_pi_limits_nothing(cone: float | None, twist: float | None) -> None:
    model = model_of(kv.articulations.Ball(**WHERE, cone=cone, twist=twist))
    for rotation in Rotation.random(50, rng=np.random.default_rng(1)):
        assert not model.violations(at(rotation))


def test_ball_velocity_limits_the_norm_of_the_angular_velocity() -> None:
    model = model_of(kv.articulations.Ball(**WHERE, velocity=2))
    home = model.default_state()
    for direction in np.random.default_rng(1).normal(size=(20, 3)):
        unit = direction / np.linalg.norm(direction)
        for speed, broken in ((1.99, []), (2.01, ["j/velocity"])):
            omega = dict(zip((f"j/w{c}:velocity" for c in "xyz"), unit * speed, strict=True))
            found = model.violations({**{str(s): v for s, v in home.items()}, **omega})
            assert [v.name for v in found] == broken
    assert not model_of(kv.articulations.Ball(**WHERE, velocity=inf)).constraints


@pytest.mark.sampled(2)
@pytest.mark.parametrize("wish", [(1, 0, 0), (0, -1, 0), (0.3, 0.5, 1), (0, 0, -1)])
def test_velocity_rows_keep_cone_twist_and_speed(wish: tuple[float, ...]) -> None:
    model = model_of(kv.articulations.Ball(**WHERE, cone=0.8, twist=0.5, velocity=2))
    names = dict(zip((f"j/w{c}:velocity" for c in "xyz"), wish, strict=True))
    dt = 0.02
    end = assert_rows_keep_limits(model, model.default_state(), names, 60, dt, slack=(2 * dt) ** 2 / 2)
    assert Rotation.from_quat([end[kv.position(f"j/q{c}")] for c in "xyzw"]).magnitude() > 0.45


@pytest.mark.parametrize("operation", EVERY)
def test_ball_is_hashable_and_survives_a_document(operation: kv.articulations.Ball, tmp_path: Path) -> None:
    assert_is_a_value(operation, model_of(operation), tmp_path)


BROKEN: list[tuple[dict[str, Any], str]] = [
    ({"axis": (0, 0, 0)}, "axis of joint 'j' has length zero"),
    ({"cone": 0}, r"cone of the ball joint 'j' lies in \(0, π\] rad, and is not 0"),
    ({"cone": 3.2}, r"cone of the ball joint 'j' lies in \(0, π\] rad, and is not 3.2"),
    ({"cone": -0.1}, "is not -0.1"),
    ({"cone": nan}, "cone of the ball joint 'j' is a finite number, not nan"),
    ({"cone": "wide"}, "is a number, not 'wide'"),
    ({"twist": 0}, r"twist of the ball joint 'j' lies in \(0, π\] rad"),
    ({"twist": 4}, "is not 4"),
    ({"velocity": -1}, "velocity limit of the ball joint 'j' is -1; it cannot be negative"),
    ({"velocity": nan}, "is nan"),
    ({"name": "old"}, "There is an articulation 'old' already"),
    ({"child": "old"}, "There is a frame 'old' already"),
]


@pytest.mark.parametrize(("given", "words"), BROKEN)
def test_invalid_ball_error_names_articulation_and_number(given: dict[str, Any], words: str) -> None:
    model = model_of(kv.Fixed(name="old", parent="world", child="old"))
    before = model.snapshot()
    with pytest.raises(kv.KineverseError, match=words), model.edit() as edit:
        edit.apply(kv.articulations.Ball(**{**WHERE, **given}), tag="mine")
    assert model.snapshot() == before
