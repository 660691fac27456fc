"""Excluded shapes and pairs with their reasons; surfaces of solids."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scene_models import arm_among_boxes, body

import kineverse as kv
from kineverse.geometry import RULES, Rule, Scene, rules_as_data
from kineverse.geometry.exclusions import (
    JOINED,
    RIGID,
    ExcludedPairs,
    find_unusable_shapes,
    label_unusable_shapes,
)
from kineverse.geometry.shapes import solid_from_geometry, solid_from_points, solid_surface
from kineverse.model.body import Body, Box, Mesh, Shape, Sphere

spatial = pytest.importorskip("scipy.spatial")


def with_bad_bodies(folder):
    (folder / "empty.stl").write_bytes(b"")
    model = arm_among_boxes(links=2, boxes=2)
    with model.edit() as edit:
        for name, geometry in (
            ("lost", Mesh("nowhere.stl", folder=str(folder))),
            ("empty", Mesh("empty.stl", folder=str(folder))),
            ("flat", Box((1.0, 0.0, 1.0))),
        ):
            shapes = (Shape(Sphere(0.1)), *[Shape(geometry)] * (2 if name == "flat" else 1))
            edit.add_frame(f"bad/{name}", "base", kv.translation(0, 0, 1), Body(collisions=shapes))
        edit.add_frame("bad/all", "base", np.eye(4), Body(visuals=(Shape(Mesh("nowhere.stl")),)))
    return model


def test_find_unusable_shapes_names_them_and_leave_out_excludes_them(tmp_path):
    model = with_bad_bodies(tmp_path)
    problems = find_unusable_shapes(model)
    assert set(problems) == {
        ("bad/lost", 1),
        ("bad/empty", 1),
        ("bad/flat", 1),
        ("bad/flat", 2),
        ("bad/all", 0),
    }
    assert "nowhere.stl" in problems["bad/lost", 1]
    assert "empty.stl" in problems["bad/empty", 1]
    assert "sizes" in problems["bad/flat", 1]
    assert not any("\n" in why or "Looked" in why for why in problems.values())
    assert list(label_unusable_shapes(model, problems)) == [
        "shape 1 of bad/lost",
        "shape 1 of bad/empty",
        "shape 1 of bad/flat",
        "shape 2 of bad/flat",
        "bad/all",
    ]
    scene = Scene(model, leave_out=problems)
    scene.update(model.default_state())
    assert scene.pairs_within(0.1)
    assert "bad/all" not in scene.bodies
    # The ball, at (0, 0, 1) of the base, is there, in each of them.
    for name in ("lost", "empty", "flat"):
        found = scene.distance(f"bad/{name}", "box0")
        assert f"bad/{name}" not in Scene(model, leave_out=[f"bad/{name}", *problems]).bodies
        assert found.shape_a == 0
    assert find_unusable_shapes(arm_among_boxes()) == {}


@pytest.mark.parametrize("option", ["leave_out", "triangles", "decomposed"])
def test_scene_refuses_unknown_names_in_options(option):
    model = arm_among_boxes(boxes=1)
    with pytest.raises(kv.errors.UnknownNameError, match=f"{option}=.*'hnad'.*hand"):
        Scene(model, **{option: ["hnad"]})
    with pytest.raises(kv.errors.UnknownNameError, match=f"{option}=.*'nothing\\*'"):
        Scene(model, **{option: ["nothing*"]})


def test_excluded_pairs_have_a_reason_and_checked_pairs_none():
    model = arm_among_boxes()
    with model.edit() as edit:
        edit.add_frame("hand/camera", "hand", kv.translation(0, 0, 0.1), body(Sphere(0.02)))
        rules = [
            Rule("box*", "hand", why="it reaches between them"),
            Rule("box1", "link?"),
            Rule("link1", "link0", check=True),
        ]
        edit.write(RULES, rules_as_data(rules))
    scene = Scene(model)
    ignored = ExcludedPairs(model, scene.bodies)
    pairs = list(itertools.combinations(scene.bodies, 2))
    for a, b in pairs:
        assert (ignored.reason(a, b) == "") == scene.checks_pair(a, b)
        assert ignored.reason(a, b) == ignored.reason(b, a)
    looked_at = sum(scene.checks_pair(a, b) for a, b in pairs)
    assert ignored.counts == (looked_at, len(pairs) - looked_at)
    assert ignored.reason("hand", "hand/camera") == RIGID
    assert ignored.reason("link3", "hand/camera") == JOINED
    assert ignored.reason("hand", "box3") == "excepted: it reaches between them"
    assert ignored.reason("link2", "box1") == "excepted by a rule"
    assert ignored.reason("link0", "link1") == ""


@given(st.integers(0, 2**32 - 1), st.integers(4, 60))
def test_solid_surface_of_a_hull_is_closed_and_faces_outwards(seed, count):
    points = np.random.default_rng(seed).normal(size=(count, 3))
    assert solid_surface(solid_from_geometry(Box((1, 1, 1)))) == Box((1, 1, 1))
    surface = solid_surface(solid_from_points(points))
    a, b, c = np.moveaxis(surface.vertices[surface.faces], 1, 0)
    # By the divergence theorem; a face turned inward would take its part away.
    volume = np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0
    assert volume == pytest.approx(spatial.ConvexHull(points).volume, rel=1e-9)
    np.testing.assert_allclose(np.cross(b - a, c - a).sum(axis=0), 0.0, atol=1e-9)


def test_error_for_many_missing_meshes_lists_a_few_in_short_lines(tmp_path):
    model = kv.Model()
    with model.edit() as edit:
        for k in range(20):
            mesh = Mesh(f"package://nowhere_{k}/mesh.stl", folder=str(tmp_path))
            turned = kv.rotation_z(kv.position(f"q{k}"))
            edit.add_frame(f"part_{k}", "world", turned, Body(collisions=(Shape(mesh),)))
    scene = Scene(model)
    scene.update(model.default_state())
    with pytest.raises(kv.KineverseError) as caught:
        scene.pairs_within(0.1)
    first, *lines = str(caught.value).splitlines()
    assert first.startswith("20 shapes cannot be used. Correct the model, or leave such bodies out")
    assert len(lines) == 13
    assert lines[-1] == "  and 8 more"
    assert all("Looked" not in line and len(line) < 200 for line in lines)
