"""Screw, cylindrical and universal joints against their formulas."""

from __future__ import annotations

import dataclasses
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
    model_of,
    slid,
    turned,
)

import kineverse as kv

AXES = [(0, 0, 1), (0, -1, 0), (2.0, 0, 0), (1, 2, 3)]
PERPENDICULAR = [((1, 0, 0), (0, 1, 0)), ((0, 0, -2), (1, 1, 0)), ((1, 2, 3), (3, 0, -1))]
nan, inf = float("nan"), float("inf")

EVERY: list[Any] = [
    kv.articulations.Screw(**WHERE, axis=(1, 2, 3), pitch=0.3, lower=-1, upper=2, velocity=3),
    kv.articulations.Screw(**WHERE, pitch=-0.01, position=2 * kv.position("wheel")),
    kv.articulations.Cylindrical(
        **WHERE, axis=(1, 2, 3), slide=kv.Limits(0, kv.position("stop"), 0.5), turn=kv.Limits(-1, 1)
    ),
    kv.articulations.Universal(**WHERE, first_limits=kv.Limits(-1, 1, 2), second_limits=kv.Limits(-0.5, 0.5)),
]


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("pitch", [0.02, -0.5])
def test_screw_moves_by_its_pitch_in_a_revolution(axis: Any, pitch: float) -> None:
    pose = model_of(kv.articulations.Screw(**WHERE, axis=axis, pitch=pitch)).fk("c")
    for q in (0.0, 0.7, -2.0, 9.0, math.tau):
        expected = ORIGIN @ slid(axis, pitch * q / math.tau) @ turned(axis, q)
        np.testing.assert_allclose(pose({"j": q}), expected, atol=1e-14)
    assert np.linalg.norm(pose({"j": math.tau}) - pose({"j": 0.0})) == pytest.approx(abs(pitch))


@pytest.mark.parametrize("axis", AXES)
def test_cylindrical_joint_slides_and_rotates(axis: Any) -> None:
    pose = model_of(kv.articulations.Cylindrical(**WHERE, axis=axis)).fk("c")
    for s, angle in ((0, 0), (0.3, -2), (-1, 7)):
        expected = ORIGIN @ slid(axis, s) @ turned(axis, angle)
        np.testing.assert_allclose(pose({"j/slide": s, "j/turn": angle}), expected, atol=1e-14)


@pytest.mark.parametrize(("first", "second"), PERPENDICULAR)
def test_universal_joint_rotates_about_first_then_second_axis(first: Any, second: Any) -> None:
    pose = model_of(kv.articulations.Universal(**WHERE, first=first, second=second)).fk("c")
    for a, b in ((0, 0), (0.3, -2), (-1, 7)):
        expected = ORIGIN @ turned(first, a) @ turned(second, b)
        np.testing.assert_allclose(pose({"j/first": a, "j/second": b}), expected, atol=1e-14)


@pytest.mark.parametrize("operation", EVERY, ids=lambda o: type(o).__name__)
@pytest.mark.parametrize("seed", range(4))
def test_joint_jacobians_equal_finite_differences(operation: kv.Operation, seed: int) -> None:
    assert_jacobian(model_of(operation), "c", seed, reach=3.0)


@pytest.mark.parametrize("operation", EVERY, ids=lambda o: type(o).__name__)
def test_joint_tangents_equal_motion_along_rates(operation: kv.Operation) -> None:
    model = model_of(operation)
    assert_motion_law(model, [model.fk("c"), model.jacobian("c")], seed=3)


@pytest.mark.parametrize("operation", EVERY, ids=lambda o: type(o).__name__)
def test_joints_are_hashable_and_survive_a_document(operation: Any, tmp_path: Path) -> None:
    assert_is_a_value(operation, model_of(operation), tmp_path)


def test_each_coordinate_of_a_joint_has_its_limits() -> None:
    cylinder = model_of(
        kv.articulations.Cylindrical(
            **WHERE, slide=kv.Limits(0, 0.2, 0.5), turn=kv.Limits(upper=1, velocity=2)
        )
    )
    assert cylinder.limits("j/slide") == (0, 0.2)
    assert cylinder.limits("j/turn") == (-inf, 1)
    assert cylinder.limits("j/slide:velocity") == (-0.5, 0.5)
    assert cylinder.limits("j/turn:velocity") == (-2, 2)
    cross = model_of(
        kv.articulations.Universal(
            **WHERE, first_limits=kv.Limits(-1, 2), second_limits=kv.Limits(velocity=3)
        )
    )
    assert cross.limits("j/first") == (-1, 2)
    assert cross.limits("j/second:velocity") == (-3, 3)
    assert not model_of(kv.articulations.Cylindrical(**WHERE)).constraints
    assert not model_of(kv.articulations.Universal(**WHERE)).constraints
    screw = model_of(kv.articulations.Screw(**WHERE, pitch=1, lower=0, upper=9, velocity=0.5))
    assert screw.limits("j") == (0, 9)
    assert [v.name for v in screw.violations({"j": 10, "j:velocity": -0.6})] == ["j/position", "j/velocity"]


def test_velocity_rows_keep_joint_limits() -> None:
    model = model_of(
        kv.articulations.Cylindrical(**WHERE, slide=kv.Limits(0, 0.2, 0.5), turn=kv.Limits(-1, 1, 2))
    )
    end = assert_rows_keep_limits(
        model, model.default_state(), {"j/slide:velocity": 1, "j/turn:velocity": -1}, 30, 0.1
    )
    assert end[kv.position("j/slide")] == pytest.approx(0.2)
    assert end[kv.position("j/turn")] == pytest.approx(-1)


def test_pitch_may_be_an_expression(tmp_path: Path) -> None:
    pitch = kv.parameter("pitch", 0.02)
    screw = kv.articulations.Screw(**WHERE, axis=(0, 0, 1), pitch=pitch, lower=-1, upper=1)
    model = model_of(screw)
    assert_is_a_value(screw, model, tmp_path)
    pose = model.fk(WHERE["child"])
    for value in (0.02, -0.5):
        numeric = model_of(dataclasses.replace(screw, pitch=value)).fk(WHERE["child"])
        wanted = numeric({kv.position("j"): 0.7})
        np.testing.assert_allclose(pose({kv.position("j"): 0.7, pitch: value}), wanted, rtol=1e-14)
    model.save(tmp_path / "screw.xml")
    read = kv.load(tmp_path / "screw.xml")
    (frame,) = (name for name in read.frames if name.split("/")[-1] == WHERE["child"])
    at = {kv.position("j"): 0.7}
    expression = read.fk(frame)
    written = expression({s: at[kv.position(str(s).split("/")[-1])] for s in expression.symbols})
    np.testing.assert_allclose(written, pose({**at, pitch: 0.02}), atol=1e-9)


BROKEN: list[tuple[type[Any], dict[str, Any], str]] = [
    (kv.articulations.Screw, {"pitch": nan}, "pitch of the screw 'j' is a finite number, not nan"),
    (kv.articulations.Screw, {"pitch": inf}, "pitch of the screw 'j' is a finite number, not inf"),
    (kv.articulations.Screw, {"pitch": "fine"}, "pitch of the screw 'j' is a number, not 'fine'"),
    (kv.articulations.Screw, {"pitch": 0}, "pitch of the screw 'j' is 0"),
    (kv.articulations.Screw, {"pitch": kv.parameter("p", 0.0)}, "pitch of the screw 'j' is 0"),
    (kv.articulations.Screw, {"pitch": kv.velocity("p")}, "pitch of the screw 'j' is about positions"),
    (kv.articulations.Screw, {"pitch": 1, "axis": (0, 0, 0)}, "axis of joint 'j' has length zero"),
    (kv.articulations.Screw, {"pitch": 1, "lower": 2, "upper": 1}, "limits of 'j' are no range.*bound 2 and the upper bound 1"),
    (kv.articulations.Screw, {"pitch": 1, "velocity": -1}, "velocity limit of 'j' is -1; it cannot be negative"),
    (kv.articulations.Screw, {"pitch": 1, "position": kv.velocity("v")}, "position of the screw 'j' is about positions"),
    (kv.articulations.Screw, {"pitch": 1, "position": 3}, "position of the screw 'j' is an expression, not 3"),
    (kv.articulations.Screw, {"pitch": 1, "position": kv.array([kv.position("x")] * 2)}, r"scalar, not of shape \(2,\)"),
    (kv.articulations.Cylindrical, {"axis": (0, 0, 0)}, "axis of joint 'j' has length zero"),
    (kv.articulations.Cylindrical, {"slide": (0, 1)}, r"'slide' of the cylindrical joint 'j' is kv.Limits\(.*not \(0, 1\)"),
    (kv.articulations.Cylindrical, {"slide": kv.Limits(1, 0)}, "limits of 'j/slide' are no range"),
    (kv.articulations.Cylindrical, {"turn": kv.Limits(velocity=nan)}, "velocity limit of 'j/turn' is nan"),
    (kv.articulations.Cylindrical, {"turn": kv.Limits(lower=nan)}, "limits of 'j/turn' are no range.*NaN"),
    (kv.articulations.Universal, {"first": (0, 0, 0)}, "axis of joint 'j' has length zero"),
    (kv.articulations.Universal, {"first": (1, 1, 0)}, r"universal joint 'j' are perpendicular, and not 0.785398 rad apart"),
    (kv.articulations.Universal, {"second": (-1, 0, 0)}, "not 3.14159 rad apart"),
    (kv.articulations.Universal, {"second_limits": None}, "'second_limits' of the universal joint 'j' is"),
    (kv.articulations.Universal, {"second_limits": kv.Limits(2, 1)}, "limits of 'j/second' are no range"),
    *(
        (kind, {**given, name: "old"}, f"There is {what} 'old' already, so the {kind.__name__.lower()} '{j}'")
        for kind, given in ((kv.articulations.Screw, {"pitch": 1}), (kv.articulations.Cylindrical, {}), (kv.articulations.Universal, {}))
        for name, what, j in (("name", "an articulation", "old"), ("child", "a frame", "j"))
    ),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "given", "words"), BROKEN)
def test_invalid_joint_error_names_articulation_and_number(
    kind: type[Any], given: dict[str, Any], words: str
) -> None:
    model = model_of(kv.Fixed(name="old", parent="world", child="old"))
    before = model.snapshot()
    with pytest.raises(kv.KineverseError, match=words), model.edit() as edit:
        edit.apply(kind(**{**WHERE, **given}), tag="mine")
    assert model.snapshot() == before
