"""Further facing points of near pairs: parallel faces have them, and nothing else."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scene_models import body

import kineverse as kv
from kineverse.geometry import Scene
from kineverse.geometry.bindings import FacingPoints
from kineverse.model.body import Box, Cylinder, Geometry, Sphere


def make_scene(*shapes: Geometry) -> Scene:
    """Return a scene of an item that moves above a table, whose top is at 0."""
    model = kv.Model()
    with model.edit() as edit:
        roll, pitch, yaw = (kv.position(name) for name in ("roll", "pitch", "yaw"))
        turn = kv.rotation_z(yaw) @ kv.rotation_y(pitch) @ kv.rotation_x(roll)
        edit.add_frame("item", "world", kv.translation(0, 0, kv.position("z")) @ turn, body(*shapes))
        edit.add_frame("table", "world", np.eye(4), body(Box((2.0, 2.0, 0.1)), at=(0, 0, -0.05)))
    return Scene(model)


def find_points(scene: Scene, **state: float):
    """Return the nearest points of item and table, and the same with further ones."""
    scene.update({"z": 0.0, "roll": 0.0, "pitch": 0.0, "yaw": 0.0} | state)
    return scene.pairs_within(0.1), extend(scene)


def extend(scene: Scene):
    """Return the nearest points of item and table with further facing ones."""
    return scene.watch()(0.1, FacingPoints(np.zeros((2, 2)), 0.0))


@pytest.fixture(scope="module")
def slab():
    return make_scene(Box((0.6, 0.4, 0.1)))


@settings(max_examples=40)
@given(st.floats(-0.008, 0.008), st.floats(-0.008, 0.008), st.floats(-3.0, 3.0))
def test_points_lie_on_both_faces_and_span_them(slab, roll, pitch, yaw):
    found, more = find_points(slab, z=0.056, roll=roll, pitch=pitch, yaw=yaw)
    assert more.distances[0] == pytest.approx(found.distances[0], abs=1e-8)  # accuracy of GJK
    assert (np.diff(more.distances) >= 0.0).all()
    item_T_world = np.linalg.inv(slab.pose("item"))
    for pair in more:
        assert (pair.a, pair.b) == ("item", "table")
        corner = (item_T_world @ [*pair.point_a, 1.0])[:3]
        assert np.abs(corner / (0.3, 0.2, 0.05)).max() == pytest.approx(1.0, abs=1e-6)
        assert pair.point_b[2] == pytest.approx(0.0, abs=1e-9)
        assert pair.distance == pytest.approx(pair.point_a[2], abs=1e-9)
    among = np.linalg.norm(more.points_a[:, None] - more.points_a, axis=2)
    assert among[~np.eye(len(more), dtype=bool)].min() > 0.1 - 1e-9
    assert among.max() > 0.5


@pytest.mark.parametrize("shape", [Sphere(0.2), Cylinder(0.05, 0.4)], ids=lambda s: type(s).__name__)
def test_round_bodies_have_no_further_points_across_their_contact(shape):
    found, more = find_points(make_scene(shape), z=0.204, yaw=0.3)
    assert len(found) == 1
    if isinstance(shape, Sphere):
        assert len(more) == 1
    else:  # it stands on its end, which is flat and narrower than the distance of points
        assert np.ptp(more.points_a[:, :2], axis=0).max() <= 0.1


def test_a_lying_cylinder_has_points_along_its_line_of_contact():
    _, more = find_points(make_scene(Cylinder(0.05, 0.4)), z=0.052, pitch=np.pi / 2, yaw=0.7)
    along = np.array([np.cos(0.7), np.sin(0.7)])
    assert np.ptp(more.points_a[:, :2] @ along) > 0.3
    assert np.ptp(more.points_a[:, :2] @ [-along[1], along[0]]) < 0.01


def test_faces_that_are_not_parallel_or_not_near_have_one_point(slab):
    assert len(find_points(slab, z=0.11, roll=0.2, pitch=0.2)[1]) == 1
    assert len(find_points(slab, z=0.08)[1]) == 1


def test_the_scene_stands_as_before(slab):
    before, _ = find_points(slab, z=0.056, roll=0.004)
    pose = slab.pose("item").copy()
    extend(slab)
    again = slab.pairs_within(0.1)
    np.testing.assert_array_equal(slab.pose("item"), pose)
    np.testing.assert_array_equal(again.witnesses, before.witnesses)
    assert slab.distance("item", "table").distance == before.distances[0]
