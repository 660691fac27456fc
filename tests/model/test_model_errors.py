"""What one is told who writes what other libraries have, or half of what is meant here."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import kineverse as kv

q = kv.position("door")


def room() -> kv.Model:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Revolute(name="door", parent="world", child="door", lower=0, upper=1.5))
        edit.apply(
            kv.articulations.DifferentialDrive(
                name="base", parent="world", child="base", radius=0.1, track=0.4
            )
        )
        edit.write("colour", "<red>")
    return model


def edited(step: Callable[[kv.model.Edit], Any]) -> Callable[[kv.Model], Any]:
    def run(model: kv.Model) -> None:
        with model.edit() as edit:
            step(edit)

    return run


def door(**given: Any) -> Callable[[kv.Model], Any]:
    return lambda _: kv.Revolute(name="d", parent="world", child="d", **given)


REVOLUTE = (
    "It takes name=, parent=, child= and, if wanted, origin=, dynamics=, axis=, lower=, upper=, velocity=, "
    "position=."
)
MESSAGES: dict[str, tuple[Callable[[kv.Model], Any], str]] = {
    "an edit that is not opened": (
        lambda m: m.edit().add_frame("f", "world", np.eye(4)),
        "model.edit() has to be opened before .add_frame: write `with model.edit() as edit:`, and in the block "
        "edit.add_frame(...).",
    ),
    "another one": (
        lambda m: m.edit().commit(),
        "model.edit() has to be opened before .commit: write `with model.edit() as edit:`, and in the block "
        "edit.add_frame(...).",
    ),
    "editing a model itself": (
        lambda m: m.constrain("c", 0, q, 1),
        "A model is changed in an edit: write `with model.edit() as edit:`, and in the block edit.constrain(...).",
    ),
    "a model by name": (
        lambda _: kv.Model("kitchen"),
        "A model begins empty, with kv.Model(). To load one: kv.load('kitchen').",
    ),
    "a model of nothing that it is made of": (
        lambda _: kv.Model([1, 2]),  # type: ignore[list-item]
        "A model begins empty, with kv.Model(), and is not made from a list. To load one: kv.load(path).",
    ),
    "a flag that is a text": (
        edited(lambda e: e.add_frame("door", "world", np.eye(4), override="no")),  # type: ignore[arg-type]
        "override= is True or False, not 'no'.",
    ),
    "another flag": (
        lambda m: m.integrate(m.default_state(), {}, 1.0, clip=None),  # type: ignore[arg-type]
        "clip= is True or False, not None.",
    ),
    "no speeds": (
        lambda m: m.integrate(m.default_state(), None, 1.0),  # type: ignore[arg-type]
        "Speeds are given as a mapping {name: number}, not as None.",
    ),
    "a speed that is a text": (
        lambda m: m.integrate(m.default_state(), {"door:velocity": "fast"}, 1.0),  # type: ignore[dict-item]
        "The speed 'door:velocity' is 'fast'; it must be finite.",
    ),
    "a time that is a text": (
        lambda m: m.integrate(m.default_state(), {}, "soon"),  # type: ignore[arg-type]
        "The time step is a finite number of seconds, not 'soon'.",
    ),
    "a speed that leads to infinity": (
        lambda m: m.integrate(m.default_state(), {"door:velocity": 1e300}, 1e300),
        "'door' runs to inf in 1e+300 s. Take a shorter time.",
    ),
    "a tolerance that is a text": (
        lambda m: m.violations(m.default_state(), "small"),  # type: ignore[arg-type]
        "A tolerance is a finite number from 0, not 'small'.",
    ),
    "a projection with a tolerance of NaN": (
        lambda m: m.project(m.default_state(), tolerance=float("nan")),
        "A tolerance is a finite number from 0, not nan.",
    ),
    "a projection of no state": (
        lambda m: m.project("door"),  # type: ignore[arg-type]
        "Values are given as a mapping {name: number} or a state, not as str.",
    ),
    "a number that stays fixed": (
        lambda m: m.project(m.default_state(), fixed=5),  # type: ignore[arg-type]
        "fixed=: A coordinate is given by its name, a text, not by 5.",
    ),
    "a state of another model": (
        lambda m: m.violations(kv.State({"dor": 9.0})),
        "The state has no value for anything in this model. It knows 'dor'. Did you mean 'door'? "
        "model.default_state() has one for everything.",
    ),
    "a state of nothing": (
        lambda m: m.violations(kv.State()),
        "The state has no value for anything in this model. model.default_state() has one for everything.",
    ),
    "a name of a package": (
        lambda _: kv.estimation.Trackr,
        "The package kineverse.estimation has no 'Trackr'. Did you mean 'Tracker'?",
    ),
    "a mistyped name of a package below": (
        lambda _: kv.PistonRod,
        "The package kineverse has no 'PistonRod'. Did you mean 'kv.articulations.PistonAndRod' or 'kv.spatial.position_of'?",
    ),
    "what a package below imports": (
        lambda _: kv.np,
        "The package kineverse has no 'np'. dir(...) lists what there is.",
    ),
    "a mistyped name in kv.model": (
        lambda _: kv.model.AddFram,
        "The package kineverse.model has no 'AddFram'. Did you mean 'AddFrame' or 'Frame'?",
    ),
    "a mistyped name in kv.formats": (
        lambda _: kv.formats.from_byte,
        "The package kineverse.formats has no 'from_byte'. Did you mean 'from_bytes' or 'to_bytes' or 'entries_from_bytes'?",
    ),
    "a name of another package": (
        lambda _: kv.reasoning.interlock_,
        "The package kineverse.reasoning has no 'interlock_'. Did you mean 'Interlock' or 'interlocks' or 'IntervalBox'?",
    ),
    "a name of a package that is an extra": (
        lambda _: kv.geometry.Scen,
        "The package kineverse.geometry has no 'Scen'. Did you mean 'Scene'?",
    ),
    "values without keywords": (
        lambda _: kv.Revolute("d", "world", "d"),
        f"Revolute is made with keywords, and 'd' has none. {REVOLUTE}",
    ),
    "a keyword too few": (
        lambda _: kv.Revolute(name="d", parent="world"),
        f"Revolute is made without child=. {REVOLUTE}",
    ),
    "another keyword": (
        lambda _: kv.Revolute(name="d", parent="world", child="d", uper=1),
        f"Revolute has no keyword 'uper'. Did you mean 'upper'? {REVOLUTE}",
    ),
    "a mechanism without keywords": (
        lambda _: kv.articulations.ScissorLift("lift"),
        "ScissorLift is made with keywords, and 'lift' has none. It takes ",
    ),
    "a loop without keywords": (
        lambda _: kv.CloseLoop("loop"),
        "CloseLoop is made with keywords, and 'loop' has",
    ),
    "a world in capitals": (
        edited(lambda e: e.add_frame("f", "World", np.eye(4))),
        "The parent of frame 'f' is missing. There is no frame 'World'. Did you mean 'world'?",
    ),
    "another parent": (
        edited(lambda e: e.add_frame("f", "ground", np.eye(4))),
        "The parent of frame 'f' is missing. There is no frame 'ground'. Available: base, door, world.",
    ),
    "no frame": (lambda _: kv.Model().fk("ground"), "There is no frame 'ground'. Available: world."),
    "the world as a frame": (
        lambda m: m.frames["world"],
        "The frame 'world' is the root of all others, and is not listed among them.",
    ),
    "an origin of three numbers": (
        door(origin=(0.1, 0, 0)),
        "The origin of the revolute 'd' is not a pose. A pose is made from a 4×4 matrix, not from one of shape "
        "(3,). It is a 4×4 transform: kv.translation(0.1, 0, 0), a kv.model.Pose, or a 4×4 array of numbers.",
    ),
    "an origin that is none": (
        door(origin="here"),
        "The origin of the revolute 'd' is not a pose. A pose is made from a 4×4 matrix, not from one of shape "
        "(). It is a 4×4 transform: kv.translation(x, y, z) @ kv.rpy(roll, pitch, yaw) or the like, a kv.model.Pose, "
        "or a 4×4 array of numbers.",
    ),
    "a hinge": (lambda _: kv.Hinge, "The package kineverse has no 'Hinge'. Here that is kv.Revolute."),
    "a slider": (lambda _: kv.Slider, "The package kineverse has no 'Slider'. Here that is kv.Prismatic."),
    "small letters": (
        lambda _: kv.revolute,
        "The package kineverse has no 'revolute'. Did you mean 'Revolute'?",
    ),
    "nothing like it": (
        lambda _: kv.zzzz,
        "The package kineverse has no 'zzzz'. dir(...) lists what there is.",
    ),
    "a hinge among articulations": (
        lambda _: kv.articulations.Hinge,
        "The package kineverse.articulations has no 'Hinge'. Here that is kv.Revolute.",
    ),
    "a misspelt articulation": (
        lambda _: kv.articulations.Scrw,
        "The package kineverse.articulations has no 'Scrw'. Did you mean 'Screw'?",
    ),
    "joints": (
        lambda m: m.joints,
        "A model has no 'joints'. Here that is model.articulations and model.degrees_of_freedom.",
    ),
    "forward kinematics": (
        lambda m: m.forward_kinematics("door"),
        "A model has no 'forward_kinematics'. Here that is model.fk(frame).",
    ),
    "coordinates": (
        lambda m: m.snapshot().q,
        "A model has no 'q'. Here that is model.degrees_of_freedom, with values from model.default_state().",
    ),
    "a misspelt attribute": (lambda m: m.frame, "A model has no 'frame'. Did you mean 'frames' or 'rates'?"),
    "adding a joint": (
        edited(lambda e: e.add_joint("j")),
        "An edit has no 'add_joint'. Here that is edit.apply(kv.Revolute(...)) and the like.",
    ),
    "a misspelt step": (
        edited(lambda e: e.add_fram("j")),
        "An edit has no 'add_fram'. Did you mean 'add_frame'?",
    ),
}


@pytest.mark.parametrize("case", MESSAGES)
def test_messages(case: str) -> None:
    wrong, message = MESSAGES[case]
    with pytest.raises(kv.KineverseError) as error:
        wrong(room())
    assert str(error.value).startswith(message)
    assert str(error.value) == message or message[-1] != "."


def test_attributes_are_missing_as_python_has_it() -> None:
    for thing in (
        kv,
        kv.articulations,
        kv.model,
        kv.formats,
        room(),
        room().snapshot(),
        room().edit(),
        kv.State(),
    ):
        assert not hasattr(thing, "forward_kinematic")
        assert getattr(thing, "__wrapped__", None) is None
        with pytest.raises(AttributeError):
            getattr(thing, "_private_thing")  # noqa: B009 - an attribute, asked for


def test_the_end_of_a_long_chain() -> None:
    model = kv.Model()
    with model.edit() as edit:
        for i in range(500):
            edit.add_frame(f"f{i}", f"f{i - 1}" if i else "world", np.eye(4))
        for i in range(30):
            edit.add_frame(f"g{i}", "f0", np.eye(4))
    with pytest.raises(kv.errors.EditError) as error, model.edit() as edit:
        edit.remove("frame f0")
    lines = str(error.value).split("\n")
    assert lines[0] == "The edit is refused, because these operations cannot be applied:"
    assert lines[1] == (
        "  'frame f1': The parent of frame 'f1' is missing. There is no frame 'f0'. Available: world."
    )
    assert lines[11] == "  and 21 more operations."
    assert (
        lines[12]
        == "What these write is needed by 'frame f2', 'frame f3', 'frame f4', 'frame f5' and 494 more."
    )
    assert len(lines) == 13
    assert list(error.value.failures) == ["frame f1", *(f"frame g{i}" for i in range(30))]
    assert model.version == 1


# -- printing ----------------------------------------------------------------------------------------------


def test_mappings_of_a_model_print_one_line_for_each_value() -> None:
    model = room()
    texts = {
        "frames": [
            "2 frames:",
            "  door: in world, moved by door",
            "  base: in world, moved by base/angle, base/x, base/y",
        ],
        "articulations": [
            "2 articulations:",
            "  door: revolute from world to door, door",
            "  base: differentialdrive from world to base, base/x, base/y, base/angle",
        ],
        "constraints": ["1 constraint:", "  door/position: 0 <= door <= 1.5"],
        "bodies": ["0 bodies"],
        "data": ["1 datum:", "  colour: '<red>'"],
        "rates": [
            "3 rates:",
            "  base/x: (0.05*cos(base/angle)) · base/left_wheel:velocity + (0.05*cos(base/angle)) · base/right_w…",
            "  base/y: (0.05*sin(base/angle)) · base/left_wheel:velocity + (0.05*sin(base/angle)) · base/right_w…",
            "  base/angle: (-0.25) · base/left_wheel:velocity + 0.25 · base/right_wheel:velocity",
        ],
    }
    for kind, lines in texts.items():
        assert str(getattr(model, kind)).split("\n") == lines
    assert repr(model.frames) == "<2 frames: door, base>"
    assert repr(kv.Model().rates) == "0 rates"


def test_printing_is_bounded() -> None:
    model = kv.Model()
    with model.edit() as edit:
        for i in range(300):
            edit.add_frame(f"f{i}", "world", np.eye(4), body=kv.model.Body())
            edit.write(f"d{i}", "x" * 1000)
            edit.constrain(f"c{i}", 0, kv.position(f"q{i}"), 1)
            edit.set_rate(kv.position(f"q{i}"), {kv.velocity("u"): 1.0})
    for kind in ("frames", "bodies", "constraints", "data", "rates"):
        values = getattr(model, kind)
        lines = str(values).split("\n")
        assert len(lines) == 22
        assert lines[-1] == "  ... 280 more"
        assert max(map(len, lines)) <= 100
        assert len(values._repr_html_()) < 20_000
    assert len(model._repr_html_()) < 100_000


def test_notebooks_show_tables() -> None:
    model = room()
    shown = model._repr_html_()
    assert "<p>2 frames, 4 DoF, 1 constraint (version 1)</p>" in shown
    assert "<summary>3 rates</summary>" in shown
    assert "&lt;red&gt;" in shown
    assert "<red>" not in shown
    assert "door/position</td>" in model.constraints._repr_html_()
    assert ">0 &lt;= door &lt;= 1.5</td>" in model.constraints._repr_html_()
    broken = model.violations({"door": 2.0})._repr_html_()
    assert ">1 violated</caption>" in broken
    assert re.findall(">([^<]+)</td>", broken) == ["door/position", "0", "2", "1.5", "0.5"]
    assert "none violated" in model.violations({"door": 1.0})._repr_html_()


# -- what is taken -----------------------------------------------------------------------------------------


def test_lists_and_arrays_are_axes_and_origins() -> None:
    place = np.eye(4)
    place[0, 3] = 2.0
    expected = kv.Revolute(
        name="d", parent="world", child="d", axis=(0, 0, 1), origin=kv.model.Pose.from_matrix(place)
    )
    for axis in ([0, 0, 1], np.array([0, 0, 1]), (0.0, 0.0, 1.0)):
        for origin in (place, place.tolist(), kv.translation(2, 0, 0), kv.model.Pose.from_matrix(place)):
            joint = kv.Revolute(name="d", parent="world", child="d", axis=axis, origin=origin)
            assert joint.axis == expected.axis
            model = kv.Model()
            with model.edit() as edit:
                edit.apply(joint)
            assert model.fk("d")({"d": 0.0})[0, 3] == 2.0
