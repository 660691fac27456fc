"""What an operation writes belongs to it: nothing is written over that it does not know about."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from history_operations import state_of

import kineverse as kv
from kineverse.formats.document import from_bytes, to_bytes

q = kv.position("door")
UP = kv.translation(0, 0, 5)


def room() -> kv.Model:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Revolute(name="door", parent="world", child="door", axis=(0, 0, 1)))
        edit.add_frame("handle", "door", kv.translation(0.4, 0, 0), body=kv.model.Body())
        edit.apply(
            kv.articulations.DifferentialDrive(
                name="base", parent="world", child="base", radius=0.1, track=0.4
            )
        )
        edit.write("colour", "red")
    return model


@dataclass(frozen=True)
class Written(kv.Operation):
    """Writes effects, over whatever there is."""

    effects: kv.model.Writes
    name: str = "x"

    def apply(self, model: kv.model.ReadRecorder) -> kv.model.Writes:
        return self.effects


BODY = kv.model.Body(inertia=kv.model.Inertia(1.0, (1.0, 1.0, 1.0, 0.0, 0.0, 0.0)))
RECORD = kv.model.Articulation("revolute", "world", "door")
OVERWRITTEN: dict[str, tuple[Callable[[kv.model.Edit], object], str]] = {
    "a frame": (
        lambda e: e.add_frame("door", "world", UP),
        "There is a frame 'door' already, written by 'joint door', and 'frame door' would write over it. Choose "
        "another name, or replace that operation. To put it into another parent, attach it; to write over it on "
        "purpose, pass override=True to the method of the edit.",
    ),
    "a frame, by a joint": (
        lambda e: e.apply(kv.Prismatic(name="slide", parent="world", child="handle")),
        "There is a frame 'handle' already, written by 'frame handle', and 'joint slide' would write over it. ",
    ),
    "an articulation": (
        lambda e: e.apply(kv.Revolute(name="door", parent="world", child="other"), tag="again"),
        "There is an articulation 'door' already, written by 'joint door', and 'again' would write over it. ",
    ),
    "a body": (
        lambda e: e.apply(Written(kv.model.Writes(bodies={"handle": BODY}))),
        "There is a body of 'handle' already, written by 'frame handle', and 'written x' would write over it. "
        "Choose another name, or replace that operation. To write over it on purpose, pass override=True to the "
        "method of the edit.",
    ),
    "a rate": (
        lambda e: e.set_rate(kv.position("base/x"), {kv.velocity("u"): 1.0}),
        "There is a rate of 'base/x' already, written by 'joint base', and 'rate base/x' would "
        "write over it. ",
    ),
    "a constraint": (
        lambda e: (e.constrain("c", 0, q, 1), e.constrain("c", 0, q, 2, tag="again")),
        "There is a constraint 'c' already, made by 'constraint c'; choose another name or replace that "
        "operation.",
    ),
}


@pytest.mark.parametrize("case", OVERWRITTEN)
def test_overwriting_another_operation_is_refused(case: str) -> None:
    step, message = OVERWRITTEN[case]
    model = room()
    before = state_of(model)
    with pytest.raises(kv.errors.DuplicateNameError) as error, model.edit() as edit:
        step(edit)
    assert str(error.value).startswith(message)
    assert state_of(model) == before


def test_an_operation_that_comes_before_does_not_hide_behind_a_later_one() -> None:
    model = room()
    before = state_of(model)
    with pytest.raises(kv.errors.EditError) as error, model.edit() as edit:
        edit.insert(kv.Fixed(name="post", parent="world", child="handle"), before="joint door")
    assert "  'frame handle': There is a frame 'handle' already, written by 'joint post'" in str(error.value)
    assert list(error.value.failures) == ["frame handle"]
    with pytest.raises(kv.errors.DuplicateNameError), model.edit() as edit:
        edit.replace("frame handle", kv.Fixed(name="h", parent="world", child="door"))
    assert state_of(model) == before
    with model.edit() as edit:  # it is the end of the edit that counts
        edit.insert(kv.Fixed(name="post", parent="world", child="handle"), before="joint door")
        edit.remove("frame handle")
    assert model.frames["handle"].parent == "world"


def test_on_purpose() -> None:
    model = room()
    with model.edit() as edit:
        edit.add_frame("door", "world", UP, override=True)
        edit.set_rate(kv.position("base/x"), {kv.velocity("u"): 1.0}, override=True)
        edit.apply(
            Written(kv.model.Writes(bodies={"handle": BODY}, articulations={"door": RECORD})), override=True
        )
        edit.add_frame("shelf", "world", UP, override=True)  # there is nothing to write over
        edit.attach("handle", "base", np.eye(4))
        edit.write("colour", "blue", tag="again")
    assert model.fk("door")()[2, 3] == 5
    assert list(model.rates["base/x"]) == [kv.velocity("u")]
    assert (model.bodies["handle"], model.articulations["door"]) == (BODY, RECORD)
    assert model.frames["handle"].parent == "base"
    assert model.data["colour"] == "blue"  # of data, the last one counts
    for copied in (
        model.copy(),
        from_bytes(to_bytes(model)),
        from_bytes(to_bytes(from_bytes(to_bytes(model)))),
    ):
        assert copied.snapshot() == model.snapshot()
        with copied.edit() as edit:
            edit.remove("override frame door")
        assert copied.fk("door")({"door": 0})[2, 3] == 0
        with pytest.raises(kv.errors.DuplicateNameError), copied.edit() as edit:
            edit.add_frame("door", "world", UP)


def test_an_operation_may_overwrite_a_value_that_it_has_read() -> None:
    @dataclass(frozen=True)
    class Raised(kv.Operation):
        frame: str
        looks: bool

        def apply(self, model: kv.model.ReadRecorder) -> kv.model.Writes:
            parent = model.frames[self.frame].parent if self.looks else "world"
            return kv.model.Writes(frames={self.frame: (parent, UP)})

    model = room()
    with model.edit() as edit:
        edit.apply(Raised("handle", looks=True))
    assert model.fk("handle")({"door": 0})[2, 3] == 5
    with (
        pytest.raises(kv.errors.DuplicateNameError, match="'raised' would write over it"),
        model.edit() as edit,
    ):
        edit.replace("raised", Raised("door", looks=False))
    assert model.history.writers("frames/handle") == ["frame handle", "raised"]


def test_two_models_with_the_same_links(tmp_path: Path) -> None:
    links = '<link name="a"/><link name="b"/>'
    for name, joint in (("one", "j"), ("two", "k")):
        (tmp_path / f"{name}.urdf").write_text(
            f'<robot name="{name}">{links}<joint name="{joint}" type="continuous"><parent link="a"/>'
            '<child link="b"/><axis xyz="0 0 1"/></joint></robot>'
        )
    room().save(tmp_path / "room.kv.json")
    for second in ("two.urdf", "one.urdf"):
        model = kv.load(tmp_path / "one.urdf")
        before = model.snapshot()
        with pytest.raises(kv.errors.DuplicateNameError) as error:
            model.include(tmp_path / second)
        assert str(error.value).endswith("include(source, prefix=...) puts a prefix in front of all names.")
        assert model.snapshot() == before
        model.include(tmp_path / second, prefix="second")
        assert {"b", "second/b"} <= set(model.frames)
    model = room()
    with pytest.raises(kv.errors.DuplicateNameError, match="puts a prefix in front of all names"):
        model.include(tmp_path / "room.kv.json")
