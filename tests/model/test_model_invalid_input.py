"""Bad input: one clear error of the project's own, and the model is what it was."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from history_operations import Next, Place, Put, state_of

import kineverse as kv

q = kv.position("door")
NAN = float("nan")


def room() -> kv.Model:
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("door", "world", kv.rotation_z(q))
        edit.add_frame("door/handle", "door", kv.translation(0.8, 0, 1))
        edit.constrain("door/range", 0, q, 1.5)
        edit.write("colour", "red")
        edit.apply(
            kv.articulations.DifferentialDrive(
                name="base", parent="world", child="base", radius=0.1, track=0.4
            )
        )
    return model


def effects(**given: Any) -> kv.Operation:
    class Wrong(kv.Operation):
        def apply(self, model: kv.model.ReadRecorder) -> kv.model.Writes:
            return kv.model.Writes(**given)

    return Wrong()


class Returns(kv.Operation):
    def __init__(self, value: Any) -> None:
        self.value = value

    def apply(self, model: kv.model.ReadRecorder) -> Any:
        return self.value


class Reads(kv.Operation):
    def __init__(self, read: Callable[[kv.model.ReadRecorder], Any]) -> None:
        self.read = read

    def apply(self, model: kv.model.ReadRecorder) -> kv.model.Writes:
        self.read(model)
        return kv.model.Writes()


EDITS: dict[str, tuple[Callable[[kv.model.Edit], Any], str]] = {
    # names
    "parent unknown": (lambda e: e.add_frame("f", "dor", np.eye(4)), "Did you mean 'door'"),
    "own parent": (lambda e: e.add_frame("f", "f", np.eye(4)), "Cyclic frames"),
    "world": (lambda e: e.add_frame("world", "door", np.eye(4)), "root of everything"),
    "empty name": (lambda e: e.add_frame("", "world", np.eye(4)), "not a name"),
    "empty part": (lambda e: e.add_frame("a//b", "world", np.eye(4)), "not a name"),
    "slash in front": (lambda e: e.add_frame("/a", "world", np.eye(4)), "not a name"),
    "slash behind": (lambda e: e.constrain("a/", 0, q, 1), "not a name"),
    "name that is none": (lambda e: e.add_frame(3, "world", np.eye(4)), "not a name"),
    "parent that is no name": (lambda e: e.add_frame("f", ["door"], np.eye(4)), "by its name"),
    "data with an empty part": (lambda e: e.write("a//b", 1), "not a name"),
    "constraint twice": (
        lambda e: e.constrain("door/range", 0, q, 1, tag="other"),
        "already, made by 'constraint door/range'",
    ),
    # tags
    "tag twice": (lambda e: e.write("colour", "blue"), "'data colour' is taken"),
    "tag given twice": (lambda e: e.write("x", 1, tag="frame door"), "is taken"),
    "empty tag": (lambda e: e.write("x", 1, tag=""), "A tag is"),
    "tag that is none": (lambda e: e.write("x", 1, tag=3), "A tag is"),
    "unknown tag removed": (lambda e: e.remove("frame dor"), "Did you mean 'frame door'"),
    "unknown tag replaced": (lambda e: e.replace("door", Put("x")), "no operation 'door'"),
    "unhashable tag": (lambda e: e.remove(["door"]), "no operation"),
    "no place to insert": (lambda e: e.insert(Put("x")), "exactly one of"),
    "two places to insert": (
        lambda e: e.insert(Put("x"), before="frame door", after="frame door"),
        "exactly one of",
    ),
    "insert at an unknown tag": (lambda e: e.insert(Put("x"), before="nowhere"), "no operation 'nowhere'"),
    "insert to affect nothing": (lambda e: e.insert(Put("x"), to_affect="nowhere"), "no operation 'nowhere'"),
    "insert before what is needed": (
        lambda e: e.insert(Place("x", "door"), before="frame door"),
        "parent of frame 'x' is missing",
    ),
    # operations
    "no operation": (lambda e: e.apply("door"), "not an operation"),
    "a class": (lambda e: e.apply(Put, "t"), "not an operation"),
    "no operation as a replacement": (lambda e: e.replace("frame door", None), "not an operation"),
    "nothing returned": (lambda e: e.apply(Returns(None)), "kv.model.Writes"),
    "something else returned": (lambda e: e.apply(Returns({"frames": {}})), "kv.model.Writes"),
    "missing datum": (lambda e: e.apply(Next("x", "color")), "Did you mean 'colour'"),
    "missing frame": (lambda e: e.apply(Reads(lambda m: m.fk("handle"))), "Did you mean 'door/handle'"),
    "missing relative frame": (
        lambda e: e.apply(Reads(lambda m: m.fk("door", "nowhere"))),
        "no frame 'nowhere'",
    ),
    "frame that is no name": (lambda e: e.apply(Reads(lambda m: m.frames[3])), "by its name"),
    "missing constraint": (
        lambda e: e.apply(Reads(lambda m: m.constraints["range"])),
        "Did you mean 'door/range'",
    ),
    "attach something missing": (lambda e: e.attach("dor", "world", np.eye(4)), "Did you mean 'door'"),
    "attach to something missing": (
        lambda e: e.attach("door", "wall", np.eye(4)),
        "parent of frame 'door' is missing",
    ),
    # shapes and numbers
    "transform 3×3": (lambda e: e.add_frame("f", "world", np.eye(3)), "4×4"),
    "transform a vector": (lambda e: e.add_frame("f", "world", [1, 2, 3]), "4×4"),
    "transform a number": (lambda e: e.add_frame("f", "world", 1.0), "4×4"),
    "transform a text": (lambda e: e.add_frame("f", "world", "here"), ""),
    "transform nothing": (lambda e: e.add_frame("f", "world", None), ""),
    "transform NaN": (lambda e: e.add_frame("f", "world", np.full((4, 4), NAN)), "NaN"),
    "transform scaled": (lambda e: e.add_frame("f", "world", np.diag([2.0, 2, 2, 1])), "rigid"),
    "transform mirrored": (lambda e: e.add_frame("f", "world", np.diag([1.0, 1, -1, 1])), "rigid"),
    "transform projective": (lambda e: e.add_frame("f", "world", np.diag([1.0, 1, 1, 2])), "rigid"),
    "transforms of which one is wrong": (
        lambda e: e.add_frame("f", "world", [kv.rotation_z(q), np.eye(3)]),
        "",
    ),
    "infinite": (lambda e: e.add_frame("f", "world", kv.translation(float("inf"), 0, 0)), "rigid"),
    "frame of a raw tuple": (lambda e: e.apply(effects(frames={"f": ("world",)})), "pair"),
    "frame of something": (lambda e: e.apply(effects(frames={"f": 3})), "pair"),
    "frame with raw factors": (
        lambda e: e.apply(effects(frames={"f": kv.model.Frame("world", (np.eye(3),))})),
        "4×4",
    ),
    "constraint NaN": (lambda e: e.constrain("c", NAN, q, 1), "NaN"),
    "constraint empty": (lambda e: e.constrain("c", 2, q, 1), "No value lies between"),
    "constraint of a vector": (lambda e: e.constrain("c", 0, kv.translation(q), 1), "scalar"),
    "constraint of numbers": (lambda e: e.constrain("c", 0, 1, 2), "depends on no symbol"),
    "constraint a pair": (lambda e: e.apply(effects(constraints={"c": (0, q)})), "triple"),
    "body of something": (lambda e: e.apply(effects(bodies={"door": "wood"})), "kv.model.Body"),
    "articulation of something": (
        lambda e: e.apply(effects(articulations={"door": 1})),
        "kv.model.Articulation",
    ),
    "data that can change": (lambda e: e.write("x", {"a": [1]}), "changed from outside"),
    "data of arrays": (lambda e: e.write("x", (np.zeros(3),)), "changed from outside"),
    "rates of something": (lambda e: e.apply(effects(rates={"x": {"u": 1}})), "Only positions"),
    "rates in a circle": (lambda e: e.set_rate(q, {q.derivative(): 1.0}), "Cyclic rates"),
    "names of something": (lambda e: e.apply(effects(data=3)), ""),
}


@pytest.mark.parametrize("case", EDITS)
def test_an_edit_that_is_wrong(case: str) -> None:
    step, words = EDITS[case]
    model = room()
    before = state_of(model)
    with pytest.raises(kv.KineverseError, match=words or None), model.edit() as edit:
        edit.write("from before the mistake", 1)
        step(edit)
    assert state_of(model) == before
    # the same inside of an edit that goes on
    with model.edit() as edit:
        edit.write("before", 1)
        try:
            step(edit)
        except kv.KineverseError:
            pass
        else:
            assert case == "rates in a circle"  # found when somebody looks
            edit.remove("rate door")
        edit.write("after", 2)
    assert dict(model.data) == {"colour": "red", "before": 1, "after": 2}
    assert set(model.frames) == {"door", "door/handle", "base"}
    with model.edit() as edit:
        edit.remove("data before")
        edit.remove("data after")
    assert model.snapshot() == before[0]


QUESTIONS: dict[str, tuple[Callable[[kv.Model], Any], str]] = {
    "frame": (lambda m: m.frames["dor"], "Did you mean 'door'"),
    "frame by its last part": (lambda m: m.fk("handle"), "Did you mean 'door/handle'"),
    "frame that is none": (lambda m: m.fk(3), ""),
    "relative frame": (lambda m: m.fk("door", "dor"), "Did you mean 'door'"),
    "jacobian": (lambda m: m.jacobian("dor"), "Did you mean 'door'"),
    "jacobian relative": (lambda m: m.jacobian("door", "dor"), "Did you mean 'door'"),
    "speeds": (lambda m: m.speeds_of("dor"), "Did you mean 'door'"),
    "form": (lambda m: m.jacobian("door", form="spatial"), "'world_aligned'"),
    "constraint": (lambda m: m.constraints["rnge"], "There is no constraint 'rnge'"),
    "datum": (lambda m: m.data["color"], "Did you mean 'colour'"),
    "body": (lambda m: m.bodies["door"], "no body"),
    "articulation": (lambda m: m.articulations["bse"], "Did you mean 'base'"),
    "unhashable": (lambda m: m.frames[["door"]], "by its name"),
    "symbol": (lambda m: m.symbol("dor"), "Did you mean 'door'"),
    "symbol of a wrong order": (lambda m: m.symbol("door:speed"), "is not an order"),
    "limits": (lambda m: m.limits("dor"), "Did you mean 'door'"),
    "path": (lambda m: m.history.writers("door"), "begins with one of frames, bodies"),
    "path without a name": (lambda m: m.history.readers("frames/"), "begins with one of"),
    "entry": (lambda m: m.history.entry("frame dor"), "Did you mean 'frame door'"),
    "place": (lambda m: m.history.index("frame dor"), "Did you mean 'frame door'"),
}


@pytest.mark.parametrize("case", QUESTIONS)
def test_a_question_that_is_wrong(case: str) -> None:
    question, words = QUESTIONS[case]
    model = room()
    for asked in (model, model.snapshot()) if "history" not in question.__code__.co_names else (model,):
        with pytest.raises(kv.KineverseError, match=words or None):
            question(asked)


def test_a_missing_name_is_not_in_a_mapping_and_has_a_default() -> None:
    model = room()
    assert "dor" not in model.frames
    assert 3 not in model.frames
    assert model.frames.get("dor") is None
    assert model.data.get("dor", 5) == 5
    assert "world" not in model.frames
    assert len(model.frames) == len(list(model.frames.values())) == 3
    assert model.frames == dict(model.frames.items())
    assert repr(model.frames) == "<3 frames: door, door/handle, base>"
    assert str(model) == "3 frames, 4 DoF, 1 constraint (version 1)"
