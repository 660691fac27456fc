"""Corrections: the same geometry as expressions and as operations with numbers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import kineverse as kv
from kineverse import articulations
from kineverse.estimation.calibration.corrections import (
    corrected_operation,
    find_corrections,
    parameterised_operation,
    replace_parameters,
)

RNG = np.random.default_rng(3)


def place() -> kv.Expression:
    return kv.translation(*RNG.normal(size=3)) @ kv.rpy(*RNG.normal(size=3))


def everything() -> kv.Model:
    """Return a model with all that can be corrected, in one chain and beside it."""
    model = kv.Model()
    joints = [
        articulations.Revolute(name="a", parent="world", child="a_link", origin=place(), axis=(1, 2, 3)),
        articulations.Prismatic(name="b", parent="a_link", child="b_link", origin=place(), axis=(0, 1, 1)),
        articulations.Screw(
            name="c", parent="b_link", child="c_link", origin=place(), axis=(0, -1, 0), pitch=0.01
        ),
        articulations.Cylindrical(name="d", parent="c_link", child="d_link", origin=place()),
        articulations.Continuous(
            name="e",
            parent="d_link",
            child="e_link",
            origin=place(),
            axis=(0, 0, -2),
            position=2 * kv.position("a"),
        ),
        articulations.Fixed(name="f", parent="e_link", child="f_link", origin=place()),
    ]
    wheels = {"radius": 0.1, "track": 0.5, "speed": 1.0, "turn": 1.0}
    with model.edit() as edit:
        for joint in joints:
            edit.apply(joint)
        edit.add_frame("camera", "f_link", [place(), place()])
        edit.add_frame("moving", "camera", kv.rotation_z(kv.position("c")))
        edit.add_frame("held", "world")
        edit.attach("held", "moving", place() @ kv.rotation_x(kv.position("b")))
        edit.apply(articulations.DoorWithHandle(name="door", parent="held", origin=place()))
        edit.apply(articulations.DifferentialDrive(name="base", parent="world", child="base", **wheels))
        edit.apply(
            articulations.Mecanum(name="mecanum", parent="world", child="mecanum", wheelbase=0.3, **wheels)
        )
    return model


MODEL = everything()
WORDS = {
    "offsets": {"a", "b", "c", "e"},
    "mounts": {"a", "b", "c", "d", "e", "f", "camera", "moving", "held", "base", "mecanum", "door"},
    "lengths": {"a", "b", "c", "d", "e", "f", "camera", "door"},
    "axes": {"a", "b", "c", "d", "e"},
    "pitches": {"c"},
    "wheels": {"base", "mecanum"},
}


@pytest.mark.parametrize("word", WORDS)
def test_a_word_is_for_what_has_such_a_thing(word: str) -> None:
    assert {c.name for c in find_corrections(MODEL, [f"{word} *"])} == WORDS[word]


@pytest.mark.parametrize("words", [["axes"], ["wheels"], list(WORDS)], ids=" ".join)
def test_operations_with_numbers_equal_the_expressions(words: list[str], tmp_path: Path) -> None:
    corrections = find_corrections(MODEL, [f"{word} *" for word in words])
    rng = np.random.default_rng(len(words))
    values = {s: rng.normal(0, 0.05) for c in corrections for s in c.symbols}
    symbolic, numeric, untouched = MODEL.copy(), MODEL.copy(), MODEL.copy()
    for tag in {c.tag for c in corrections}:
        operation, own = MODEL.history.operation(tag), [c for c in corrections if c.tag == tag]
        numbers = [[values[s] for s in c.symbols] for c in own]
        with symbolic.edit() as edit:
            edit.replace(tag, parameterised_operation(operation, own))
        with numeric.edit() as edit:
            edit.replace(tag, corrected_operation(operation, own, numbers))
        with untouched.edit() as edit:
            edit.replace(tag, corrected_operation(operation, own, [[0.0] * len(c.symbols) for c in own]))
    state = {s: rng.normal() for s in MODEL.symbols if s.order == 0} | values
    numeric.save(tmp_path / "corrected.kv.json")
    read = kv.load(tmp_path / "corrected.kv.json")

    def value(expression: kv.Expression) -> np.ndarray:
        expression = kv.array(expression)
        return expression({s: state[s] for s in expression.symbols})

    moved = 0.0
    for frame in MODEL.frames:
        wanted = value(symbolic.fk(frame))
        np.testing.assert_allclose(value(numeric.fk(frame)), wanted, atol=1e-12)
        np.testing.assert_array_equal(value(read.fk(frame)), value(numeric.fk(frame)))
        np.testing.assert_allclose(value(untouched.fk(frame)), value(MODEL.fk(frame)), atol=1e-12)
        moved = max(moved, float(np.abs(wanted - value(MODEL.fk(frame))).max()))
    for coordinate, row in symbolic.rates.items():
        for speed, factor in row.items():
            np.testing.assert_allclose(value(numeric.rates[coordinate][speed]), value(factor), atol=1e-12)
    assert moved > 1e-3 or words == ["wheels"]
    assert set(numeric.constraints) == set(MODEL.constraints)


def test_an_offset_leaves_the_limits_and_an_axis_the_pose_at_zero() -> None:
    model = kv.Model()
    with model.edit() as edit:
        joint = kv.Revolute(
            name="q", parent="world", child="link", axis=(0, 2, 0), lower=-1, upper=1, velocity=1
        )
        edit.apply(joint)
    (offset,), (axis,) = (find_corrections(model, [f"{word} q"]) for word in ("offset", "axis"))
    shifted = corrected_operation(joint, [offset], [[0.2]])
    assert isinstance(shifted, kv.Revolute)
    assert (shifted.lower, shifted.upper) == (-1, 1)
    np.testing.assert_allclose(kv.array(shifted.origin.matrix)(), kv.rotation_y(0.2)(), atol=1e-15)
    tilted = corrected_operation(joint, [axis], [[0.1, -0.2]])
    assert isinstance(tilted, kv.Revolute)
    assert tilted.origin == joint.origin
    cosine = np.dot(tilted.axis, joint.axis) / 4.0
    assert np.arccos(cosine) == pytest.approx(np.hypot(0.1, 0.2))
    assert np.linalg.norm(tilted.axis) == pytest.approx(2.0)


def test_parameters_are_replaced_in_nested_fields() -> None:
    old, new = kv.parameter("p", 1.0), kv.parameter("p", 2.0)
    joint = articulations.Cylindrical(
        name="j",
        parent="world",
        child="c",
        origin=kv.translation(old, 0, 0),
        slide=kv.Limits(0, 2 * old),
    )
    replaced = replace_parameters(joint, {old: new})
    assert replaced.origin({})[0, 3] == 2.0
    assert replaced.slide.upper({}) == 4.0
    assert replace_parameters(replaced, {old: new}) is replaced


BAD = [
    ("offset", kv.errors.InvalidValueError, "'offset PATTERN'"),
    ("ofset a", kv.errors.UnknownNameError, "Did you mean 'offset'"),
    ("offset z*", kv.errors.UnknownNameError, "No joint matches 'z\\*'"),
    ("mount camra", kv.errors.UnknownNameError, "Did you mean 'camera'"),
    ("offset d", kv.errors.InvalidValueError, "'d' has no offset .* joints with one axis"),
    ("pitch a", kv.errors.InvalidValueError, "it is for screws"),
    ("wheels door", kv.errors.InvalidValueError, "differential drives and mecanum bases"),
    ("length moving", kv.errors.InvalidValueError, "'moving' has no length"),
]


@pytest.mark.parametrize(("text", "kind", "words"), BAD, ids=[text for text, *_ in BAD])
def test_wrong_texts_say_what_is_right(text: str, kind: type[Exception], words: str) -> None:
    with pytest.raises(kind, match=words):
        find_corrections(MODEL, [text])
