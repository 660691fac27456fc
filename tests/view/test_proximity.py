"""Proximity queries as numbers, markers, text and pixels, in models of known distances."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from small_models import cabinet, with_mesh

import kineverse as kv
from kineverse.errors import KineverseError
from kineverse.geometry import RULES, Rule, rules_as_data
from kineverse.geometry.exclusions import JOINED
from kineverse.model.body import Body, Box, Mesh, Shape, Sphere
from kineverse.view import Camera, picture
from kineverse.view.drawables import COLLISION, MISSING, STAND_IN, collect_drawables
from kineverse.view.proximity import (
    CONTACT,
    IGNORED,
    MOST_PAIRS,
    ProximityMarkers,
    ProximityQuery,
    create_marker_drawables,
    distance_color,
    format_millimetres,
)
from kineverse.view.proximity_panel import LINES, format_proximity

pytest.importorskip("coal", reason="distances need the extra 'geometry'")


def two_balls() -> kv.Model:
    """Two balls of radius 0.1 m that meet at ``gap`` = 0, one of which hangs on a rail by a third one."""
    model, gap = kv.Model(), kv.position("gap")
    ball = Body(visuals=(Shape(Sphere(0.1), color=(0.5, 0.5, 0.5, 1.0)),))
    with model.edit() as edit:
        edit.add_frame("left", "world", kv.translation(0, 0, 0), ball)
        edit.add_frame("rail", "world", kv.translation(0, 0, 0.5), ball)
        edit.add_frame("right", "rail", kv.translation(0.2 + gap, 0, -0.5), ball)
        edit.constrain("gap/range", -0.1, gap, 1)
    return model


def row(count: int) -> kv.Model:
    """As many balls one behind the other, all on slides of their own, 1 mm apart."""
    model = kv.Model()
    with model.edit() as edit:
        for k in range(count):
            pose = kv.translation(kv.position(f"x{k}"), 0.201 * k, 0)
            edit.add_frame(f"ball{k}", "world", pose, Body(collisions=(Shape(Sphere(0.1)),)))
    return model


@given(st.floats(1e-3, 1.0), st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_distance_color_is_redder_for_smaller_distances(radius, one, other):
    near, far = sorted((one, other))
    (r0, g0, _), (r1, g1, _) = distance_color(near * radius, radius), distance_color(far * radius, radius)
    assert r0 - g0 >= r1 - g1 - 1e-12
    assert distance_color(-near, radius) == CONTACT == distance_color(0.0, 0.0)


@pytest.mark.parametrize(
    ("metres", "text"),
    [(0.1, "100 mm"), (0.0123, "12.3 mm"), (0.00089, "0.89 mm"), (-0.002, "−2.0 mm"), (-1e-9, "0.00 mm")],
)
def test_format_millimetres(metres, text):
    assert format_millimetres(metres) == text


@pytest.mark.parametrize("gap", [0.05, -0.0004, -0.03])
def test_markers_join_nearest_points_and_arrows_point_along_the_normal(gap):
    found = ProximityQuery(two_balls()).evaluate({"gap": gap}, 0.1)
    assert (found.found, found.touching) == (1, int(gap <= 0))
    marks = ProximityMarkers.from_result(found, length=0.2)
    np.testing.assert_allclose(marks.lines, [[[0.1, 0, 0], [0.1 + gap, 0, 0]]], atol=1e-6)
    np.testing.assert_allclose(marks.colors, [distance_color(gap, 0.1)])
    if gap > 0:
        assert (len(marks.arrows), marks.depths) == (0, ())
    else:
        # Out of the left ball, from its point that is deepest in the other: there the other one has to go.
        np.testing.assert_allclose(marks.arrows, [[[0.1, 0, 0], [0.3, 0, 0]]], atol=1e-5)
        assert marks.depths == (format_millimetres(-gap),)
    surfaces = [part.surface.vertices for part in create_marker_drawables(marks, 0.2)]
    assert np.isfinite(np.concatenate(surfaces)).all()


def test_pairs_are_filtered_by_name_and_ignored_ones_have_a_reason():
    model = two_balls()
    near = ProximityQuery(model)
    assert [(p.a, p.b) for p in near.evaluate({"gap": 0.0}, 0.4).pairs] == [("left", "right")]
    assert near.evaluate({"gap": 0.0}, 0.4, containing=" RIGHT ").found == 1
    assert near.evaluate({"gap": 0.0}, 0.4, containing="rail").found == 0
    found = near.evaluate({"gap": 0.0}, 0.4, ignored=True)
    assert [(p.a, p.b, why) for p, why in found.ignored] == [("rail", "right", JOINED)]
    assert (found.checked_pairs, found.unchecked_pairs) == (1, 2)
    assert tuple(ProximityMarkers.from_result(found, 0.1).colors[-1]) == IGNORED
    with model.edit() as edit:
        edit.write(RULES, rules_as_data([Rule("left", "right", why="<soft>")]))
    near.refresh()
    found = near.evaluate({"gap": 0.0}, 0.4, ignored=True)
    assert [why for _, why in found.ignored] == ["excepted: <soft>", JOINED]
    text = format_proximity(found, near.problems)
    assert "No pair is within 0.4 m." in text
    assert "excepted: &lt;soft&gt;" in text


def test_pairs_beyond_the_limit_are_counted():
    model = row(MOST_PAIRS + 6)
    found = ProximityQuery(model).evaluate({f"x{k}": 0.0 for k in range(MOST_PAIRS + 6)}, 0.01)
    assert (found.found, len(found.pairs), found.touching) == (MOST_PAIRS + 5, MOST_PAIRS, 0)
    text = format_proximity(found, {})
    assert text.count("1.0 mm") == LINES
    assert f"and {MOST_PAIRS + 5 - LINES} more" in text
    assert f"{MOST_PAIRS + 5} pairs within 0.01 m, none touches" in text


def test_bodies_without_distances_are_excluded_and_reported(tmp_path):
    model = two_balls()
    with model.edit() as edit:
        lost = Body(visuals=(Shape(Mesh("lost.stl", folder=str(tmp_path))),))
        edit.add_frame("part", "left", kv.translation(0, 0, 0), lost)
    near = ProximityQuery(model)
    found = near.evaluate({"gap": 0.05})
    assert [(p.a, p.b) for p in found.pairs] == [("left", "right")]
    text = format_proximity(found, near.problems)
    assert "No distances to<" in text
    assert "part: mesh lost.stl" in text
    with model.edit() as edit:
        edit.remove("frame part")
        edit.add_frame("part", "left", kv.translation(0, 0, 0), Body(visuals=(Shape(Sphere(0.11)),)))
    near.refresh()
    assert near.problems == {}
    assert "part" in {near.evaluate({"gap": 0.05}).pairs[0].a, near.evaluate({"gap": 0.05}).pairs[0].b}


def test_a_state_without_poses_has_no_distances_and_the_next_one_has():
    model, q = kv.Model(), kv.position("q")
    ball = Body(collisions=(Shape(Sphere(0.1)),))
    with model.edit() as edit:
        edit.add_frame("hook", "world", kv.translation(1 / q, 0, 0), ball)
        edit.add_frame("post", "world", kv.translation(0, 0, 0), ball)
    near = ProximityQuery(model)
    with pytest.raises(KineverseError, match="hook"):
        near.evaluate({"q": 0.0})
    assert near.evaluate({"q": 4.0}).pairs[0].distance == pytest.approx(0.05)


def test_drawn_collision_shapes_are_those_of_distances(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    cross = trimesh.util.concatenate(
        [trimesh.creation.box((1, 0.2, 0.2)), trimesh.creation.box((0.2, 1, 0.2))]
    )
    cross.export(tmp_path / "cross.stl")
    model = with_mesh("cross.stl", str(tmp_path))
    with model.edit() as edit:
        both = Body(visuals=(Shape(Box((1, 1, 1))),), collisions=(Shape(Sphere(0.5)),))
        edit.add_frame("both", "world", kv.translation(0, 0, 2), both)
        lost = Body(collisions=(Shape(Mesh("lost.stl", folder=str(tmp_path))),))
        edit.add_frame("lost", "world", kv.translation(0, 0, 4), lost)
    hull, ball, gone = collect_drawables(model, "collision")
    assert (hull.color, ball.color, gone.color) == (STAND_IN, COLLISION, MISSING)
    assert gone.placeholder
    # The hull of a cross is an octagon, whose slanting sides cut the corners of the square around it.
    a, b, c = np.moveaxis(hull.surface.vertices[hull.surface.faces], 1, 0)
    volume = np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0
    assert volume == pytest.approx(0.2 * (1.0 - 4 * 0.4 * 0.4 / 2), rel=1e-6)


def test_pictures_show_nearest_pairs_through_bodies():
    camera, model = Camera((0.1, -1.0, 0.2), (0.1, 0.0, 0.1)), two_balls()

    def colorful(gap):
        image = picture(model, {"gap": gap}, (320, 240), camera, near=0.1).astype(int)
        red, green, blue = np.moveaxis(image, -1, 0)
        return (red > 2 * np.maximum(green, blue)).sum(), (green > 1.5 * np.maximum(red, blue)).sum()

    assert colorful(0.2) == (0, 0)
    red, green = colorful(0.099)
    assert red == 0
    assert green > 10
    red, green = colorful(-0.03)
    assert red > 30
    assert green == 0


def test_no_lines_unless_asked_for():
    model = cabinet()
    still = picture(model, size=(64, 48))
    np.testing.assert_array_equal(still, picture(model, size=(64, 48), near=None))
    assert (still != picture(model, size=(64, 48), near=1.0)).any()
