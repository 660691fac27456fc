"""The proximity panel and its background thread, without a browser."""

import sys

import numpy as np
import pytest
import trimesh
from small_models import cabinet, with_mesh

import kineverse as kv
from kineverse.errors import InvalidValueError, MissingDependencyError
from kineverse.geometry import decomposition
from kineverse.model.body import Body, Box, Mesh, Shape, Sphere
from kineverse.view import picture, proximity_panel, view
from kineverse.view.drawables import collect_drawables
from kineverse.view.proximity import ProximityQuery

pytest.importorskip("viser", reason="the page needs the extra 'view'")
pytest.importorskip("coal", reason="distances need the extra 'geometry'")

BELOW_THE_DRAWER = {"cabinet/door": 0.5, "cabinet/drawer": 0.1}


@pytest.fixture
def page():
    with view(cabinet(), BELOW_THE_DRAWER, port=0) as viewer:
        yield viewer


def report(page):
    return page.collisions._report.content


def nodes(page):
    return set(page.collisions._drawn)


def test_decomposed_meshes_are_used_for_shapes_and_distances(tmp_path, monkeypatch):
    """A post with a beam across, and a ball between the two that touches the hull around both only."""
    boxes = [trimesh.creation.box((0.1, 0.1, 0.4)), trimesh.creation.box((0.4, 0.1, 0.1))]
    trimesh.util.concatenate(boxes).export(tmp_path / "cross.stl")
    made = {"cross.stl": tuple(np.array(box.vertices) for box in boxes)}
    monkeypatch.setattr(decomposition, "find_hulls", lambda mesh, settings=None: made.get(mesh.uri))
    model = kv.Model()
    with model.edit() as edit:
        cross = Body(collisions=(Shape(Mesh("cross.stl", folder=str(tmp_path))),))
        edit.add_frame("cross", "world", np.eye(4), cross)
        ball = Body(collisions=(Shape(Sphere(0.02)),))
        edit.add_frame("ball", "world", kv.translation(kv.position("x"), 0, 0.09), ball)
    near = {
        decomposed: ProximityQuery(model, decomposed).evaluate({"x": 0.1}, 0.1).pairs[0]
        for decomposed in (False, True)
    }
    assert near[False].touches
    assert near[True].distance == pytest.approx(0.02)
    assert [len(collect_drawables(model, "collision", decomposed)) for decomposed in (False, True)] == [2, 3]
    colors = [part.color for part in collect_drawables(model, "collision", True)[:2]]
    assert colors[0] != colors[1]
    assert (
        picture(model, size=(64, 48), collisions=True)
        != picture(model, size=(64, 48), collisions=True, decomposed=True)
    ).any()
    with view(model, {"x": 0.1}, port=0) as page:
        page.collisions.show_near(0.1)
        page.collisions.show_shapes()
        assert page.settled()
        assert page.collisions.result.touching == 1
        one = len(page._scene._collisions)
        for shown, shapes, touching in ((True, one + 1, 0), (False, one, 1)):
            page.collisions.show_decomposed(shown)
            assert page.settled()
            assert page.collisions._controls[-1].value == shown
            assert (len(page._scene._collisions), page.collisions.result.touching) == (shapes, touching)
        page.collisions.show_decomposed()
        page.collisions.show_near(0.05)  # which changes nothing about that
        assert page.settled()
        assert page.collisions.result.touching == 0


def test_no_query_runs_before_a_request(page):
    page.move({"cabinet/drawer": 0.1})
    assert page.settled()
    assert page.collisions.result is None
    assert (report(page), nodes(page)) == ("", set())
    assert page.collisions.worker._query is None


def test_the_nearest_pairs_follow_the_sliders(page):
    page.collisions.show_near(0.1)
    assert page.settled()
    (pair,) = page.collisions.result.pairs
    assert (pair.a, pair.b) == ("cabinet/drawer", "cabinet/door")
    assert pair.distance == pytest.approx(0.05)
    assert "50.0 mm" in report(page)
    assert nodes(page) == {"/near/lines", "/near/ends"}
    np.testing.assert_allclose(page.collisions._drawn["/near/lines"].points, [[pair.point_a, pair.point_b]])
    page.collisions.show_near(0.2)
    page.move({"cabinet/drawer": 0.4})
    assert page.settled()
    (pair,) = page.collisions.result.pairs
    np.testing.assert_allclose(page.collisions._drawn["/near/lines"].points, [[pair.point_a, pair.point_b]])
    page.collisions.show_near(0.01)
    assert page.settled()
    assert nodes(page) == set()
    assert "No pair is within 0.01 m." in report(page)


def test_contacts_have_arrows_with_the_depth():
    model = cabinet()
    with model.edit() as edit:
        post = Body(collisions=(Shape(Box((0.1, 0.1, 1.0))),))
        edit.add_frame("post", "world", kv.translation(-0.4, 0, 0.7), post)
    with view(model, {"cabinet/drawer": 0.17}, port=0) as page:
        page.collisions.show_near(containing="post")
        assert page.settled()
        assert nodes(page) == {"/near/lines", "/near/ends", "/near/arrows", "/near/depth0"}
        assert page.collisions._drawn["/near/depth0"].text == "20.0 mm"
        assert "20.0 mm deep" in report(page)
        page.move({"cabinet/drawer": 0.0})
        assert page.settled()
        assert "/near/arrows" not in nodes(page)


def test_bodies_are_half_transparent_while_lines_are_shown_in_them(page):
    opacities = [node.opacity for node, _ in page._scene._visuals]
    page.collisions.show_near()
    assert page.settled()
    assert all(node.opacity < 0.5 for node, _ in page._scene._visuals)
    page.collisions.show_near(None)
    assert page.settled()
    assert [node.opacity for node, _ in page._scene._visuals] == opacities
    assert (report(page), nodes(page)) == ("", set())


def test_settings_survive_edits(page):
    page.collisions.show_near(0.15, containing="lid")
    page.collisions.show_shapes()
    assert page.settled()
    assert page.collisions.result.found == 0
    with page.model.edit() as edit:
        lid = Body(collisions=(Shape(Box((0.4, 0.6, 0.02))),))
        edit.add_frame("lid", "world", kv.translation(0, 0, 1.02 + kv.position("lid")), lid)
    page.move({"lid": 0.03})
    assert page.settled()
    (pair,) = page.collisions.result.pairs
    assert {pair.a, pair.b} == {"lid", "cabinet/corpus"}
    assert pair.distance == pytest.approx(0.04)
    near, radius, only, ignored, _ = page.collisions._controls
    assert (near.value, radius.value, only.value, ignored.value) == (True, 0.15, "lid", False)
    assert page.collisions._shapes.value
    assert page._scene.collisions_shown
    assert "40.0 mm" in report(page)


def test_edits_during_a_query_leave_no_trace(page, caplog):
    page.collisions.show_near(0.3)
    for k in range(12):
        with page.model.edit() as edit:
            cube = Body(collisions=(Shape(Box((0.1, 0.1, 0.1))),))
            place = kv.translation(0.11 * k, 2, kv.position(f"lift{k}"))
            edit.add_frame(f"cube{k}", "world", place, cube)
        page.move({f"lift{k}": 0.01 * k})
        page.collisions.show_near(0.01 + 0.001 * k, containing="cube")
    assert page.settled()
    assert caplog.records == []
    assert page.collisions.result.found == 11
    assert page.collisions.status.failure == ""


def test_bodies_with_missing_meshes_are_reported_as_excluded(tmp_path):
    model = with_mesh("nowhere.stl", str(tmp_path))
    with view(model, port=0) as page:
        page.collisions.show_near()
        assert page.settled()
        assert "No distances to<" in report(page)
        assert "nowhere.stl" in report(page)
        assert page.collisions.result.found == 0


def test_a_state_without_poses_is_reported_until_the_next_state():
    model, q = kv.Model(), kv.position("q")
    cube = Body(visuals=(Shape(Box((1.0, 1.0, 1.0))),))
    with model.edit() as edit:
        edit.add_frame("hook", "world", kv.translation(1 / q, 0, 0), cube)
        edit.add_frame("post", "world", kv.translation(0, 0, 0), cube)
    with view(model, {"q": 0.95}, port=0) as page:
        page.collisions.show_near()
        assert page.settled()
        assert nodes(page)
        page.move({"q": 0.0})
        assert page.settled()
        assert "There are no distances now." in report(page)
        assert "hook" in report(page)
        assert nodes(page) == set()
        page.move({"q": 2.0})
        assert page.settled()
        assert "1 touches" in report(page)


@pytest.mark.parametrize("radius", [-0.1, float("nan"), float("inf")])
def test_invalid_radii_are_refused(page, radius):
    with pytest.raises(InvalidValueError, match="radius"):
        page.collisions.show_near(radius)
    assert page.collisions.result is None


def test_without_coal_the_folder_names_the_extra(monkeypatch):
    monkeypatch.setattr(proximity_panel, "is_installed", lambda: False)
    monkeypatch.setitem(sys.modules, "coal", None)
    with view(cabinet(), port=0) as page:
        assert "[geometry]" in report(page)
        page.collisions.show_near(None)
        page.collisions.show_shapes()
        with pytest.raises(MissingDependencyError, match="geometry"):
            page.collisions.show_near()
