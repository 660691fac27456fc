import socket
import sys
import threading
import urllib.request

import numpy as np
import pytest
from small_models import cabinet, dependent, with_mesh

import kineverse as kv
from kineverse.errors import InvalidValueError, MissingDependencyError, UnknownNameError
from kineverse.model.body import Body, Box, Shape
from kineverse.view import view

pytest.importorskip("viser", reason="the page needs the extra 'view'")


def sliders(viewer):
    """Label, range and value of all sliders, by name; what the page shows."""
    return {
        name: (s.label, s.min, s.max, s.value)
        for name, s in viewer._panel._sliders.items()  # the page itself is looked at in test_browser
    }


def test_the_page_is_served_to_this_computer_only(page, capfd):
    assert page.address.startswith("http://127.0.0.1:")
    with urllib.request.urlopen(page.address, timeout=10) as answer:
        assert b"<html" in answer.read().lower()
    port = int(page.address.rpartition(":")[2])
    own = socket.gethostbyname(socket.gethostname())
    if not own.startswith("127."):
        with socket.socket() as probe:
            probe.settimeout(1.0)
            assert probe.connect_ex((own, port)) != 0
    assert page._server.request_share_url() is None
    assert capfd.readouterr().out == ""


def test_each_degree_of_freedom_has_a_slider_within_its_limits(page):
    found = sliders(page)
    assert found["cabinet/drawer"] == ("drawer [m]   0 to 0.4", 0.0, 0.4, 0.0)
    assert found["cabinet/door"] == ("door [rad]   0 to 1.5", 0.0, 1.5, 0.0)
    assert found["cabinet/knob"] == ("knob [rad]   −∞ to ∞", -np.pi, np.pi, 0.0)


def test_move_and_reset(page):
    page.move({"cabinet/drawer": 0.3, kv.position("cabinet/door"): 0.5})
    assert page.settled()
    np.testing.assert_allclose(page.pose("cabinet/drawer")[:3, 3], [-0.3, 0, 0.7])
    assert sliders(page)["cabinet/door"][3] == 0.5
    page.reset()
    assert page.settled()
    np.testing.assert_allclose(page.pose("cabinet/drawer")[:3, 3], [0, 0, 0.7], atol=1e-12)
    assert sliders(page)["cabinet/door"][3] == 0.0
    with pytest.raises(UnknownNameError, match="cabinet/door"):
        page.move({"cabinet/dor": 1.0})


def test_angles_are_shown_in_degrees_on_demand_also_after_edits(page):
    page.move({"cabinet/door": 0.5, "cabinet/drawer": 0.1})
    assert page.settled()
    page._panel._convert(degrees=True)
    door = pytest.approx(np.degrees(0.5))
    assert sliders(page)["cabinet/door"] == ("door [°]   0 to 85.94", 0.0, np.degrees(1.5), door)
    assert sliders(page)["cabinet/drawer"] == ("drawer [m]   0 to 0.4", 0.0, 0.4, 0.1)
    page.move({"cabinet/door": 2.0})
    assert page.settled()
    assert sliders(page)["cabinet/door"][0] == "door [°]   0 to 85.94"
    assert "114.6 is not in [0, 85.94], by 28.65 °" in page._panel._status.content
    assert page._panel._value("cabinet/door") == pytest.approx(2.0)
    assert page._panel._sliders["cabinet/door"].hint == "cabinet/door, limits 0 to 85.94 °"
    with page.model.edit() as edit:
        edit.constrain("cabinet/knob/range", -1, kv.position("cabinet/knob"), 0.0123)
    assert page.settled()
    assert sliders(page)["cabinet/knob"][0] == "knob [°]   −57.3 to 0.7047"
    page._panel._convert(degrees=False)
    assert sliders(page)["cabinet/knob"][:3] == ("knob [rad]   −1 to 0.0123", -1.0, 0.0123)
    assert page.values["cabinet/door"] == 2.0


def test_lengths_are_shown_in_centimetres_in_sliders_hints_and_violations(page):
    page._panel._convert(centimetres=True)
    page.move({"cabinet/drawer": 0.5})
    assert page.settled()
    # The slider goes beyond the limits, which are those of the joint in its label.
    assert sliders(page)["cabinet/drawer"] == ("drawer [cm]   0 to 40", 0.0, 50.0, 50.0)
    assert page._panel._sliders["cabinet/drawer"].hint == "cabinet/drawer, limits 0 to 40 cm"
    assert "50 is not in [0, 40], by 10 cm" in page._panel._status.content


def test_sums_of_angles_that_are_violated_are_shown_in_degrees(page):
    door, knob, drawer = (kv.position(f"cabinet/{name}") for name in ("door", "knob", "drawer"))
    with page.model.edit() as edit:
        edit.constrain("sum", -1, door + knob, 1)
        edit.constrain("lead", -1, 3 * door, 1)  # whose factor may have a unit
        edit.constrain("mixed", -1, door + drawer, 1)
    page._panel._convert(degrees=True)
    page.move({"cabinet/door": 1.2})
    assert page.settled()
    content = page._panel._status.content
    assert "68.75 is not in [−57.3, 57.3], by 11.46 °" in content
    assert "3.6 is not in [−1, 1], by 2.6<" in content
    assert "1.2 is not in [−1, 1], by 0.2<" in content


def test_limits_that_are_zero_but_for_rounding_are_labelled_zero():
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Prismatic(name="slide", parent="world", child="box", lower=-8.8e-20, upper=0.69))
    with view(model, port=0) as page:
        assert sliders(page)["slide"][0] == "slide [m]   0 to 0.69"
        page._panel._beyond.value = True
        page._panel._widen()
        assert sliders(page)["slide"][:2] == ("slide [m]   0 to 0.69", pytest.approx(-0.1))


def test_speeds_are_shown_in_degrees_too():
    with view(kv.load("articulations/differential_drive"), port=0, degrees=True) as page:
        speeds = page._panel._speeds
        assert speeds
        turning = [s for name, s in speeds.items() if page._panel._units[name] == "rad/s"]
        assert turning
        assert all(" [°/s] " in s.label for s in turning)


def test_half_transparent_bodies_cast_no_shadows(page):
    def shadows():
        return {(node.cast_shadow, node.receive_shadow) for node, _ in page._scene._visuals}

    assert shadows() == {(True, True)}
    page._scene.show_transparent(True)
    assert shadows() == {(False, False)}
    page._scene.show_transparent(False)
    assert shadows() == {(True, True)}


def test_frames_that_differ_by_a_slash_like_character_are_two_nodes():
    model, cube = kv.Model(), Body(visuals=(Shape(Box((1.0, 1.0, 1.0))),))
    with model.edit() as edit:
        edit.add_frame("a/b", "world", kv.translation(1, 0, 0), cube)
        edit.add_frame("a∕b", "world", kv.translation(2, 0, 0), cube)
    with view(model, port=0) as page:
        assert len({node.name for node in page._scene._nodes.values()}) == 2


def test_violated_constraints_on_one_and_several_coordinates_are_shown(page):
    page.move({"cabinet/drawer": 0.4, "cabinet/door": 1.4})
    assert page.settled()
    assert "cabinet/no_clash" in page._panel._status.content
    assert "1.8 is not in [−1, 1.6], by 0.2" in page._panel._status.content
    # A value beyond its limits has a slider that reaches it.
    page.move({"cabinet/door": 2.0})
    assert page.settled()
    assert sliders(page)["cabinet/door"][2] == 2.0
    assert "cabinet/door/range" in page._panel._status.content


def test_sliders_follow_limits_that_depend_on_the_state():
    with view(dependent(), {"door": 0.2}, port=0) as page:
        assert sliders(page)["drawer"][2] == pytest.approx(0.1)
        page.move({"door": 1.0})
        assert page.settled()
        assert sliders(page)["drawer"][2] == pytest.approx(0.5)


def test_the_page_follows_edits_and_keeps_the_values_of_remaining_symbols(page):
    page.move({"cabinet/drawer": 0.25})
    with page.model.edit() as edit:
        edit.add_frame("lid", parent="world", transform=kv.translation(0, 0, kv.position("lid")))
        edit.constrain("lid/range", 0.1, kv.position("lid"), 0.5)
    assert page.settled()
    assert sliders(page)["lid"] == ("lid [m]   0.1 to 0.5", 0.1, 0.5, 0.1)
    assert sliders(page)["cabinet/drawer"][3] == 0.25
    np.testing.assert_allclose(page.pose("lid")[2, 3], 0.1)


def test_values_moved_during_a_rebuild_are_kept(page, monkeypatch):
    from kineverse.view import viewer

    def then_moved(model, freeze=viewer._freeze):
        found = freeze(model)
        if threading.current_thread() is page._worker:
            monkeypatch.setattr(viewer, "_freeze", freeze)
            other = threading.Thread(target=page.move, args=({"cabinet/door": 0.7},))
            other.start()
            other.join()
        return found

    monkeypatch.setattr(viewer, "_freeze", then_moved)
    with page.model.edit() as edit:
        # And a program may move what it is editing.
        page.move({"cabinet/drawer": 0.2})
        edit.add_frame("lid", parent="world", transform=kv.rotation_x(kv.position("lid")))
    assert page.settled()
    assert page.values == {"cabinet/door": 0.7, "cabinet/drawer": 0.2, "cabinet/knob": 0.0, "lid": 0.0}
    assert sliders(page)["cabinet/door"][3] == 0.7


def test_play_moves_limited_coordinates(page):
    page.play()
    before = page.pose("cabinet/drawer")
    for _ in range(200):
        with page._change:
            page._change.wait(timeout=0.5)
        if np.abs(page.pose("cabinet/drawer") - before).max() > 0.01:
            break
    else:
        pytest.fail("nothing moves")
    assert page.values["cabinet/knob"] == 0.0
    page.play(False)
    assert page.settled()
    page.reset()
    assert page.values["cabinet/drawer"] == 0.0


def test_an_empty_model_has_a_page():
    with view(kv.Model(), port=0) as page:
        assert page.settled()
        assert page.values == {}


def test_snapshots_have_a_page():
    with view(cabinet().snapshot(), {"cabinet/door": 0.1}, port=0) as page:
        assert page.values["cabinet/door"] == 0.1


def test_switches_do_not_fail(page):
    scene = page._scene
    scene.show_frames(True, True, "door")
    page.move({"cabinet/door": 0.3})
    assert page.settled()
    assert "This state cannot be shown" not in page._panel._status.content
    scene.show_collisions(True)
    scene.show_visuals(False)
    scene.show_ground(False)
    scene.show_frames(False)


def test_missing_meshes_are_reported(tmp_path):
    with view(with_mesh("nowhere.stl", str(tmp_path)), port=0) as page:
        (line,) = page.problems
        assert "nowhere.stl" in line


def test_taken_and_invalid_ports_are_refused(page):
    taken = int(page.address.rpartition(":")[2])
    with pytest.raises(InvalidValueError, match="taken"):
        view(cabinet(), port=taken)
    with pytest.raises(InvalidValueError, match="65535"):
        view(cabinet(), port=70_000)


def test_stop_is_idempotent_and_frees_the_port():
    page = view(cabinet(), port=0)
    page.stop()
    page.stop()
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        probe.bind(("127.0.0.1", int(page.address.rpartition(":")[2])))


def test_the_error_without_viser_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(MissingDependencyError, match=r"pip install -e '.*\[view\]'"):
        view(cabinet(), port=0)


def test_an_unknown_name_in_the_state_leaves_no_server_behind():
    with pytest.raises(UnknownNameError):
        view(cabinet(), {"nothing": 1.0}, port=0)


def test_frames_without_finite_poses_are_hidden_and_named():
    model, q = kv.Model(), kv.position("q")
    cube = Body(visuals=(Shape(Box((1.0, 1.0, 1.0))),))
    with model.edit() as edit:
        edit.add_frame("hook", "world", kv.translation(1 / q, 0, 0), cube)
        edit.add_frame("post", "world", kv.translation(0, 0, 1), cube)
    with view(model, port=0) as page:
        assert page.settled()
        hook, post = (page._scene._nodes[name] for name in ("hook", "post"))
        assert (page.unplaced, hook.visible, post.visible) == (["hook"], False, True)
        assert "Not finite, and hidden: hook" in page._panel._status.content
        page.move({"q": 0.5})
        assert page.settled()
        assert (page.unplaced, hook.visible) == ([], True)
        np.testing.assert_allclose(page.pose("hook")[:3, 3], [2, 0, 0])
        page.move({"q": 0.0})
        assert page.settled()
        assert (page.unplaced, hook.visible) == (["hook"], False)
        np.testing.assert_allclose(page.pose("hook")[:3, 3], [2, 0, 0])


def test_overlaid_parts_move_with_their_frames_and_survive_edits():
    from kineverse.geometry.shapes import solid_from_geometry
    from kineverse.planning.spheres import cover_solid
    from kineverse.view.drawables import draw_cover

    model = cabinet()
    frame = next(iter(model.bodies))
    cover = cover_solid(solid_from_geometry(Box((0.1, 0.1, 0.1))), 0.03)
    with view(model, port=0) as page:
        page.show_overlay([draw_cover(frame, cover), draw_cover("gone", cover)])
        (node,) = page._scene._overlay_nodes
        assert node.name.startswith(page._scene._nodes[frame].name)
        page.refresh()
        assert page.settled()
        assert len(page._scene._overlay_nodes) == 1
        page.show_overlay([])
        assert not page._scene._overlay_nodes
