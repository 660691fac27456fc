"""What a document says an operation was made with makes an equal one, for every kind that ships."""

from __future__ import annotations

import inspect
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pytest
from scenes import SCENES, build_scene

import kineverse as kv
from kineverse.formats.document import read_operations, to_json
from kineverse.model.basic_operations import SetBody, SetRate
from kineverse.model.body import Box, Cylinder, Mesh, Sphere

KINDS: dict[str, type[kv.Operation]] = {
    name: kind
    for space in (kv, kv.articulations)
    for name, kind in inspect.getmembers(space)  # faces are lazy: vars() has what was used so far
    if inspect.isclass(kind) and issubclass(kind, kv.Operation) and not inspect.isabstract(kind)
}


def hand_made() -> kv.Model:
    """Return a model of the operations that no scene has, and of values that they seldom are given."""
    q, v = kv.position("q"), kv.velocity("v")
    body = kv.model.Body(
        (
            kv.model.Shape(
                Box((1, 2, 3)), kv.model.Pose.from_matrix(kv.rotation_x(0.3)), "box", (1, 0, 0, 1)
            ),
            kv.model.Shape(Mesh("package://a/b.stl", (1, 1, 2), "/somewhere")),
        ),
        (kv.model.Shape(Cylinder(0.1, 0.2)), kv.model.Shape(Sphere(0.5), texture="wood.png")),
        kv.model.Inertia(1.5, (1, 0, 0, 1, 0, 1)),
    )
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(SetRate(q, ((v, 2 * q),)))
        edit.add_frame("a", parent="world", transform=kv.translation(q, 0, 0), body=body)
        edit.add_frame("b", parent="a", transform=kv.translation(0, 0, 1))
        edit.attach("b", "world", kv.translation(0, q, 1))
        edit.constrain("range", -1, q, 1)
        edit.write("colour", ("red", 1.5, (q, None, -np.inf)))
        limits = kv.articulations.Limits(-q, q + 2, 1.5)
        edit.apply(kv.articulations.Cylindrical(name="rod", parent="a", child="rod", slide=limits))
        edit.apply(kv.loops.LoopConstraint(name="tie", frame="rod", to="b", mask=("x",)))
        edit.add_frame("b", "world", kv.translation(0, 0, q), override=True)
    # What carries a rate is written plainly, so these are not among the writes as they were given.
    carried = model.fk("a")[:3, 3]
    with model.edit() as edit:
        edit.constrain("carried", 0, carried[0], 3)
        edit.add_frame("c", parent="world", transform=kv.translation(*carried), body=kv.model.Body())
    return model


LARGE = ("delta_robot", "jansen_leg", "parallel_gripper", "scissor_linkage", "spatial_four_bar")
"""Scenes that take long, of the same kinds of operations as ``four_bar``."""

MODELS = (hand_made, *(partial(build_scene, name) for name in SCENES if name not in LARGE))


def made_anew() -> dict[str, int]:
    """Check all operations of all scenes; return how many there were of each kind."""
    count: dict[str, int] = {}
    for make in MODELS:
        model = make()
        read = dict(read_operations(to_json(model)))
        for tag in model.history.tags:
            operation = model.history.operation(tag)
            kind = type(operation)
            again = kind(**read[tag].parameters)
            assert again == operation, tag
            assert hash(again) == hash(operation), tag
            count[kind.__name__] = count.get(kind.__name__, 0) + 1
    return count


def test_every_kind_of_operation_is_rebuilt_from_its_parameters() -> None:
    count = made_anew()
    assert not set(KINDS) - set(count), "a kind that ships is in no scene: add it to hand_made()"
    assert {"SetRate", "CloseLoop", "Ratchet", "Attach", SetBody.__name__} <= set(count)


def test_limits_follow_a_prefix_only_where_they_are_expressions() -> None:
    rod = dict(read_operations(to_json(hand_made()), prefix="left"))["left/joint rod"]
    q = kv.position("left/q")
    assert rod.parameters["slide"] == kv.articulations.Limits(-q, q + 2, 1.5)
    assert rod.parameters["name"] == "rod"


def test_record_of_an_unknown_class_stays_opaque() -> None:
    @dataclass(frozen=True)
    class Limits:
        colour: str

    @dataclass(frozen=True)
    class Paint(kv.Operation):
        limits: Limits
        more: tuple[kv.articulations.Limits, ...]

        def apply(self, model: kv.model.ReadRecorder) -> kv.model.Writes:
            return kv.model.Writes(data={"paint": self.limits.colour})

    model = kv.Model()
    with model.edit() as edit:
        edit.apply(Paint(Limits("red"), (kv.articulations.Limits(0, 1),)), "paint")
    text = to_json(model)
    ((_, paint),) = read_operations(text)
    assert paint.parameters["limits"].kind == "Limits"
    assert paint.parameters["limits"].fields == (("colour", "red"),)
    assert paint.parameters["more"] == (kv.articulations.Limits(0, 1),)
    again = kv.Model()
    with again.edit() as edit:
        edit.apply(paint, "paint")
    assert to_json(again) == text


def test_joint_from_a_document_is_replaced_by_a_rebuilt_one() -> None:
    model, tag = build_scene("scissor_lift"), "scissor lift lift"
    read = kv.Model()
    with read.edit() as edit:
        for name, operation in read_operations(to_json(model)):
            edit.apply(operation, name)
    recorded = read.history.operation(tag)
    kind = KINDS.get(recorded.kind)  # type: ignore[attr-defined]
    if kind is None:
        pytest.fail(f"{tag} is of a kind {recorded.kind} that does not ship")  # type: ignore[attr-defined]
    before = read.snapshot()
    with read.edit() as edit:
        edit.replace(tag, kind(**recorded.parameters))  # type: ignore[attr-defined]
    assert read.fk(list(read.frames)[-1]) == model.fk(list(model.frames)[-1])
    assert list(read.frames) == list(before.frames)


@dataclass(frozen=True, eq=False)
class Anything(kv.Operation):
    given: Any

    def apply(self, model: kv.model.ReadRecorder) -> kv.model.Writes:
        return kv.model.Writes(data={"x": 1})


def nested(depth: int) -> tuple[Any, ...]:
    return (nested(depth - 1),) if depth else ()


@pytest.mark.parametrize(
    "given",
    [
        nested(100),
        nested(130),
        {frozenset({1}): 1, frozenset({2}): 2},
        {float("nan"): 1},
        {2: (-0.0, 1, None)},
    ],
)
def test_parameters_that_cannot_be_written_leave_what_is_read_and_written_again(given: Any) -> None:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(Anything(given), "t")
    blob = kv.formats.operation_to_bytes(model, "t")
    again = kv.Model()
    with again.edit() as edit:
        edit.apply(kv.formats.operation_from_bytes(blob).operation, "t")
    assert kv.formats.operation_to_bytes(again, "t") == blob
