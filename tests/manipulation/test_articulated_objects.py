"""Kinds of articulated objects, from their motions alone."""

import pytest

import kineverse as kv
from kineverse.errors import UnknownNameError
from kineverse.manipulation.articulated_objects import (
    find_articulated_objects,
    find_shut_value,
    select_objects,
)
from kineverse.manipulation.skill_run import choose_tolerance
from kineverse.model.basic_operations import SetBody
from kineverse.model.body import Body, Box, Shape

pytest.importorskip("coal")


def test_names_of_the_kitchen_tell_the_kinds_that_motions_tell():
    model = kv.load("hsr")
    model.include("kitchen")
    found = {one.coordinate.path: one for one in find_articulated_objects(model, "hsr")}
    assert len(found) == 23
    for path, one in found.items():
        word = path.rpartition("_")[2]
        expected = {"drawer": "drawer", "knob": "knob"}.get(word, "knob" if "knob" in path else "flap")
        assert one.kind == ("door" if "fridge_door" in path else expected), path
        assert (one.shut, one.opened) == model.limits(one.coordinate)
    assert {one.kind for one in found.values()} == {"flap", "door", "drawer", "knob"}
    assert [str(one.coordinate) for one in select_objects([*found.values()], ["*/oven_door", "*_door"])] == [
        "kitchen/oven_door",
        "kitchen/dishwasher_door",
        "kitchen/fridge_door",
    ]
    with pytest.raises(UnknownNameError, match="kitchen/oven_door"):
        select_objects([*found.values()], ["kitchen/oven_dor"])
    with pytest.raises(UnknownNameError, match="Did you mean 'hsr'"):
        find_articulated_objects(model, robot="hssr")


@pytest.mark.parametrize(("lower", "upper"), [(0.0, 1.2), (-1.2, 0.0)])
def test_kinds_do_not_depend_on_the_pose_of_the_axis(lower, upper):
    """A plate beside its axis anywhere; shut is the limit at the default value."""
    model, q = kv.Model(), kv.position("q")
    body = Body((), (Shape(Box((0.02, 0.5, 0.5))),))
    for name, turn, place in (
        ("upright", kv.rotation_z(q), kv.translation(1, 2, 3)),
        ("level", kv.rotation_y(q), kv.translation(1, 2, 3) @ kv.rotation_z(0.7)),
        ("slide", kv.translation(q, 0, 0), kv.rotation_y(0.4)),
        ("cam", kv.translation(q**2, 0, 0) @ kv.rotation_z(q), kv.rotation_x(0.2)),
    ):
        own = kv.position(f"{name}/q")
        pose = (place @ turn @ kv.translation(0.3, 0.3, 0)).substitute({q: own})
        with model.edit() as edit:
            edit.add_frame(name, parent="world", transform=pose)
            edit.apply(SetBody(name, body))
            edit.constrain(f"{name}/range", lower, own, upper)
    found = {one.coordinate.path: one for one in find_articulated_objects(model)}
    kinds = {path: one.kind for path, one in found.items()}
    assert kinds == {"upright/q": "door", "level/q": "flap", "slide/q": "drawer", "cam/q": "linkage"}
    assert all((one.shut, one.opened) == (0.0, lower + upper) for one in found.values())
    assert all(find_shut_value(model, one.coordinate) == one.shut for one in found.values())


@pytest.mark.parametrize("name", ["microwave", "latch"])
def test_locked_doors_are_found_with_their_whole_range(name):
    model = kv.load(f"articulations/{name}")
    (door,) = (one for one in find_articulated_objects(model) if one.coordinate.path.endswith("/door"))
    assert (door.shut, door.opened) == (0.0, 1.9)
    assert find_shut_value(model, door.coordinate) == 0.0
    (key,) = {*model.degrees_of_freedom} - {door.coordinate}
    for free in ({key: model.limits(key)[1]}, {door.coordinate: 0.5}):
        state = kv.State({**model.default_state(), **free})
        assert choose_tolerance(model, door.coordinate, state, door.opened) == 0.02
