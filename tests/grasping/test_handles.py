"""Handles: of doors made of boxes, of the shipped kitchen, and of published furniture."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import kineverse as kv
from kineverse import lie
from kineverse.articulations.mechanisms import FoldingDoor
from kineverse.errors import UnknownNameError
from kineverse.grasping import find_handle, find_handles
from kineverse.model.body import Body, Box, Cylinder, Pose, Shape, Sphere

HANDLE_POSE = st.tuples(st.floats(-3, 3), st.floats(-1.5, 1.5), st.floats(-3, 3))


def shape(geometry: Box | Cylinder | Sphere, pose: np.ndarray) -> Shape:
    return Shape(geometry, Pose.from_matrix(lie.orthonormalize(pose)))


def at(x: float, y: float, z: float) -> np.ndarray:
    return np.asarray(lie.translation(np.array([x, y, z])))


def cupboard(
    kind: str, tilt: float, world_T_body: np.ndarray, door_T_frame: np.ndarray
) -> tuple[kv.Model, np.ndarray]:
    """Return a cupboard with a door, and door_T_bar of its handle. The door opens towards -x of the body.

    The frame of the door's shapes is turned by any pose: nothing may depend on it.
    """
    bar_R = lie.rotation_x(np.array(tilt)) @ np.diag([-1.0, -1.0, 1.0])  # x out of the door, z along the bar
    door_T_bar = lie.transform(bar_R, np.array([-0.055, 0.17, 0.05]))
    if kind == "knob":
        shapes = [
            shape(
                Cylinder(0.015, 0.03),
                door_T_bar @ lie.transform(lie.rotation_y(np.array(np.pi / 2)), np.zeros(3)),
            )
        ]
    elif kind == "none":
        shapes = []
    else:
        bar = Cylinder(0.006, 0.16) if kind == "round" else Box((0.012, 0.02, 0.16))
        shapes = [shape(bar, door_T_bar)]
        if kind == "D":
            mount = Box((0.055, 0.01, 0.012))  # their fronts are even with that of the bar
            shapes += [shape(mount, door_T_bar @ at(0.006 - 0.0275, 0, z)) for z in (-0.074, 0.074)]
    panel = [
        shape(Box((0.02, 0.4, 0.6)), at(0, 0, 0)),
        shape(Box((0.06, 0.3, 0.006)), at(0.04, 0, -0.1)),
    ]  # and a shelf
    frame_T_door = lie.inverse(door_T_frame)
    everything = [shape(s.geometry, frame_T_door @ s.origin.matrix) for s in (*panel, *shapes)]
    case = [shape(Box((0.3, 0.02, 0.6)), at(0.17, y, 0)) for y in (-0.2, 0.2)]
    case += [shape(Box((0.3, 0.4, 0.02)), at(0.17, 0, z)) for z in (-0.3, 0.3)]
    model, q = kv.Model(), kv.position("door")
    with model.edit() as edit:
        edit.add_frame("case", "world", world_T_body, Body(collisions=tuple(case)))
        hinge = kv.translation(0, -0.2, 0) @ kv.rotation_z(q) @ kv.translation(0, 0.2, 0)
        edit.add_frame("panel", "case", hinge @ door_T_frame, Body(collisions=tuple(everything)))
        edit.constrain("range", 0, q, 1.5)
    return model, frame_T_door @ door_T_bar


@settings(max_examples=8)
@given(
    kind=st.sampled_from(["round", "D", "knob"]),
    tilt=st.floats(-np.pi / 2, np.pi / 2),
    body=HANDLE_POSE,
    frame=HANDLE_POSE,
)
def test_handles_of_any_cupboard(
    kind: str, tilt: float, body: tuple[float, ...], frame: tuple[float, ...]
) -> None:
    poses = [
        lie.transform(Rotation.from_euler("xyz", angles).as_matrix(), np.array(angles))
        for angles in (body, frame)
    ]
    model, frame_T_bar = cupboard(kind, tilt, *poses)
    handle, *others = find_handles(model, "door")
    assert not others  # neither the shelf in the door nor the mounts
    assert handle.frame == "panel"
    assert np.allclose(handle.pose[:3, 3], frame_T_bar[:3, 3], atol=1e-6)
    assert np.allclose(handle.pose[:3, 0], frame_T_bar[:3, 0], atol=1e-6)
    sizes = {"round": (0.16, 0.012, 0.012), "D": (0.16, 0.02, 0.012), "knob": (0.03, 0.03, 0.03)}[kind]
    assert (handle.length, handle.thickness, handle.depth) == pytest.approx(sizes, abs=1e-6)
    assert handle.clearance == pytest.approx(0.045 - sizes[2] / 2, abs=1e-4)
    if kind != "knob":
        assert abs(handle.pose[:3, 2] @ frame_T_bar[:3, 2]) == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize("every", [4, pytest.param(1, marks=pytest.mark.long)])
def test_handles_of_the_shipped_kitchen(every: int) -> None:
    model = kv.load("kitchen")
    state = model.default_state()
    for coordinate in model.degrees_of_freedom[::every]:
        handle, name = find_handle(model, coordinate), str(coordinate)
        assert handle.frame == (name if "knob" in name else f"{name}_handle")
        assert handle.clearance > 0.005
        # The bar points into the room, which lies between the fronts at x = 1.2 and the island at x = -0.9.
        out = np.asarray(model.fk(handle.frame)(state))[:3, :3] @ handle.pose[:3, 0]
        assert np.allclose(out, [1.0 if "island" in name or "stove" in name else -1.0, 0, 0])


@pytest.mark.parametrize("width", [0.05, 0.2])
def test_a_knob_is_the_ball_and_not_its_shaft_also_on_a_narrow_front(width: float) -> None:
    """The front, its tray, the shaft of 8 mm and the ball of 14 mm are all slim if the front is narrow."""
    model, q = kv.Model(), kv.position("drawer")
    shapes = (
        shape(Box((0.01, width, width)), at(0.005, 0, 0)),
        shape(Box((0.05, 0.8 * width, 0.005)), at(0.035, 0, -0.4 * width)),
        shape(Cylinder(0.004, 0.02), at(-0.01, 0, 0) @ kv.rotation_y(np.pi / 2)({})),
        shape(Sphere(0.007), at(-0.024, 0, 0)),
    )
    with model.edit() as edit:
        edit.add_frame(
            "case", "world", body=Body(collisions=(shape(Box((0.1, 0.3, 0.016)), at(0.07, 0, -0.15)),))
        )
        edit.add_frame("drawer", "case", kv.translation(-q, 0, 0), body=Body(collisions=shapes))
        edit.constrain("drawer/range", 0, q, 0.05)
    handle = find_handle(model, q)
    assert handle.shape == 3
    assert (handle.length, handle.thickness) == (pytest.approx(0.014), pytest.approx(0.014))
    np.testing.assert_allclose(handle.pose[:3, 0], [-1, 0, 0], atol=1e-9)
    assert handle.clearance == pytest.approx(0.017, abs=1e-4)


def test_handle_of_the_folding_door() -> None:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(FoldingDoor(name="door", parent="world"))
    handle = find_handle(model, "door")
    assert handle.frame == "door/handle"
    assert (handle.length, handle.thickness, handle.depth) == pytest.approx((0.16, 0.012, 0.05), abs=1e-6)
    assert np.allclose(
        model.fk(handle.frame)(model.default_state())[:3, :3] @ handle.pose[:3, 0], [-1, 0, 0], atol=0.02
    )


def test_objects_without_a_handle_are_told_why() -> None:
    model, _ = cupboard("round", 0.0, np.eye(4), np.eye(4))
    with pytest.raises(UnknownNameError, match=r"'door' moves no handle at 'case'\. Its handles: 'panel'"):
        find_handle(model, "door", "case")
    model, _ = cupboard("none", 0.0, np.eye(4), np.eye(4))
    assert find_handles(model, "door") == ()
    with pytest.raises(UnknownNameError, match=r"'door' moves no handle\. It moves panel: no slim shape"):
        find_handle(model, "door")
    with pytest.raises(UnknownNameError, match=r"'doer'.*'door'"):
        find_handle(model, "doer")


@pytest.mark.parametrize(
    ("path", "frames"),
    [
        ("furniture_sim/furniture_sim/microwave.xml", {"micro0joint": "microdoorroot"}),
        ("furniture_sim/furniture_sim/slidecabinet.xml", {"slidedoor_joint": "slidelink"}),
        ("furniture_sim/furniture_sim/hingecabinet.xml", {"leftdoorhinge": "hingeleftdoor"}),
        ("articulated_objects/drake_bsd3/cupboard.sdf", {"left_door_hinge": "left_door"}),
        (
            "articulated_objects/robosuite_mit/objects/door_lock.xml",
            {"hinge": "latch", "latch_joint": "latch"},
        ),
        (
            "articulated_objects/sektion_cabinet_model/urdf/sektion_cabinet.urdf",
            {"door_left_joint": "door_left_nob_link", "drawer_top_joint": "drawer_handle_top"},
        ),
        ("kineverse_shelf_objects/urdf/small_shelf_door.urdf", {"door_joint": "handle"}),
        (
            "iai_kitchen/iai_kitchen/urdf_obj/IAI_kitchen.urdf",
            {
                "iai_fridge_door_joint": "iai_fridge_door_handle",
                "kitchen_island_left_upper_drawer_main_joint": "kitchen_island_left_upper_drawer_handle",
                "oven_area_oven_knob_oven_joint": "oven_area_oven_knob_oven",
            },
        ),
    ],
)
def test_handles_of_published_furniture(
    path: str, frames: dict[str, str], monkeypatch: pytest.MonkeyPatch, published: Callable[..., Path]
) -> None:
    file = published(*path.split("/"))
    monkeypatch.setenv("KINEVERSE_PACKAGE_PATH", str(published("iai_kitchen")))
    model = kv.load(str(file), prefix="o")
    for coordinate, frame in frames.items():
        handle = find_handle(model, f"o/{coordinate}")
        assert handle.frame == f"o/{frame}"
        assert handle.is_visual == (not model.bodies[handle.frame].collisions)
