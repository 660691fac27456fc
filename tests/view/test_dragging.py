"""Frames that are dragged: the model follows the gizmo by inverse kinematics, within all constraints."""

import asyncio
import math
import threading

import numpy as np
import pytest
from small_models import cabinet, dependent, held_door

import kineverse as kv
from kineverse.model.body import Body, Box, Shape
from kineverse.view import dragging, view
from kineverse.view.dragging import DragSolver, find_base, find_draggable, find_moving
from kineverse.view.poses import complete, to_wxyz

pytest.importorskip("viser", reason="the page needs the extra 'view'")
pytest.importorskip("daqp", reason="dragging needs the extra 'control'")

GIZMO = "/drag/gizmo"


def arm() -> kv.Model:
    """A mobile base (x, y, angle) with a hand on three joints about z, 0.5 m apart, within ±2 rad."""
    from kineverse.articulations import OmniBase

    model = kv.Model()
    with model.edit() as edit:
        edit.apply(OmniBase(name="base", parent="world", child="base"))
        parent, length = "base", 0.0
        for k in range(3):
            joint = kv.position(f"joint{k}")
            edit.add_frame(
                f"link{k}", parent=parent, transform=kv.translation(length, 0, 0) @ kv.rotation_z(joint)
            )
            edit.constrain(f"joint{k}/range", -2, joint, 2)
            parent, length = f"link{k}", 0.5
        edit.add_frame("hand", parent=parent, transform=kv.translation(length, 0, 0))
    return model


BENT = {"joint0": 0.4, "joint1": -0.9, "joint2": 0.7}


def solve(solver, model, values, pose, point=(0, 0, 0), turns=False, rounds=5):
    """Follow a pose until nothing moves, and return the values."""
    values = dict(values)
    for _ in range(rounds):
        changed, final = solver.solve(values, np.asarray(pose), point, turns=turns)
        values |= changed
        if final:
            break
    return values


def fk(model, frame, values):
    return np.array(model.fk(frame)(kv.State(values)))


def test_what_moves_with_a_frame():
    model = cabinet()
    assert find_draggable(model) == ["cabinet/drawer", "cabinet/door", "cabinet/knob"]
    # The drawer and the door are tied by an inequality only.
    assert find_moving(model, "cabinet/drawer") == {kv.position("cabinet/drawer")}
    with model.edit() as edit:
        edit.constrain("gear", 0, kv.position("cabinet/drawer") - kv.position("cabinet/door"), 0)
    assert find_moving(model, "cabinet/drawer") == {
        kv.position("cabinet/drawer"),
        kv.position("cabinet/door"),
    }
    assert [str(s) for s in find_base(arm(), "hand")] == ["base/angle", "base/x", "base/y"]
    assert find_base(arm(), "base") == []


@pytest.mark.parametrize("still", [True, False])
def test_a_hand_reaches_a_pose_with_and_without_its_base(still):
    model = arm()
    goal = fk(model, "hand", complete(model, {"joint0": 0.7, "joint1": -1.2, "joint2": 0.3}))
    start = complete(model, BENT)
    solver = DragSolver(model, "hand", find_base(model, "hand") if still else ())
    found = solve(solver, model, start, goal)
    np.testing.assert_allclose(fk(model, "hand", found), goal, atol=1e-6)
    assert not model.violations(kv.State(found))
    moved = {name for name in ("base/x", "base/y", "base/angle") if found[name] != start[name]}
    assert moved == (set() if still else {"base/x", "base/y", "base/angle"})


def test_on_a_base_that_stands_still_a_lift_keeps_its_orientation():
    model = arm()
    with model.edit() as edit:
        edit.add_frame("lift", parent="base", transform=kv.translation(0, 0, kv.position("height")))
    goal = np.array((kv.translation(1, 0, 0.4) @ kv.rotation_z(1))())
    found = solve(DragSolver(model, "lift", find_base(model, "lift")), model, complete(model), goal)
    assert found == {**complete(model), "height": pytest.approx(0.4, abs=1e-5)}


def test_a_wheel_of_a_base_takes_the_base_along():
    model = kv.load("articulations/differential_drive")
    wheel, start = "differential_drive/base/left_wheel", complete(model)
    assert find_base(model, wheel) == []
    goal = fk(model, wheel, start)
    goal[0, 3] += 0.5
    found = solve(DragSolver(model, wheel), model, start, goal)
    # The wheel also turns, which counts a little, and so does the base.
    assert fk(model, wheel, found)[:3, 3] == pytest.approx(goal[:3, 3], abs=0.15)


@pytest.mark.parametrize("distance", [0.3, 10.0, 1e5])
def test_curved_limits_hold_however_far_the_gizmo_is(distance):
    model, frame = kv.load("articulations/ball"), "ball/stick"
    solver, start = DragSolver(model, frame), complete(model)
    random = np.random.default_rng(0)
    for turns in (False, True) * 3:
        goal = fk(model, frame, start)
        goal[:3, 3] += random.normal(0, distance, 3)
        goal[:3, :3] = np.array(kv.rpy(*random.normal(0, 1, 3))())[:3, :3] @ goal[:3, :3]
        found = solve(solver, model, start, goal, random.normal(0, 0.1, 3), turns)
        assert found != start
        assert all(violation.excess < 5e-3 for violation in model.violations(kv.State(found)))


def test_a_goal_out_of_reach_ends_at_the_nearest_pose_at_rest():
    model = arm()
    solver = DragSolver(model, "hand", find_base(model, "hand"))
    goal = np.eye(4)
    goal[:3, 3] = 5.0, 0.0, 0.3
    found = solve(solver, model, complete(model, BENT), goal, rounds=20)
    np.testing.assert_allclose(fk(model, "hand", found)[:3, 3], [1.5, 0, 0], atol=1e-3)
    again = solve(solver, model, found, goal, rounds=1)
    assert max(abs(again[name] - found[name]) for name in found) < 1e-4


@pytest.mark.parametrize("pull", [-0.1, -3.0, 0.5])
def test_a_drawer_follows_along_its_axis_within_its_limits(pull):
    model = cabinet()
    solver, start = DragSolver(model, "cabinet/drawer"), complete(model, {"cabinet/drawer": 0.2})
    goal = fk(model, "cabinet/drawer", start)
    goal[:3, 3] += pull, 0.2, 0.3
    found = solve(solver, model, start, goal)
    assert found["cabinet/drawer"] == pytest.approx(min(max(0.2 - pull, 0.0), 0.4), abs=1e-5)


def test_a_point_of_a_door_is_held_and_its_orientation_gives_way():
    """The point nearest to the goal on the circle of the point, from plane geometry."""
    model = cabinet()
    solver, start = DragSolver(model, "cabinet/door"), complete(model)
    point = np.array([0.0, -0.5, 0.1])
    goal = fk(model, "cabinet/door", start)
    hinge = goal[:3, 3].copy()
    goal[:3, 3] += goal[:3, :3] @ point + [-0.3, 0.0, 0.2]
    found = solve(solver, model, start, goal, point)
    wanted = math.atan2(-(goal[0, 3] - hinge[0]), -(goal[1, 3] - hinge[1]))
    assert found["cabinet/door"] == pytest.approx(wanted, rel=0.02)
    # Turned about the point, it is the position that gives way.
    turned = fk(model, "cabinet/door", start) @ np.array(kv.rotation_z(-0.6)())
    turned[:3, 3] = hinge + fk(model, "cabinet/door", start)[:3, :3] @ point
    found = solve(solver, model, start, turned, point, turns=True)
    assert found["cabinet/door"] == pytest.approx(0.6, rel=0.02)


def test_locks_and_limits_that_depend_on_the_state_hold():
    model = held_door()
    goal = np.eye(4)
    goal[:2, :2] = [[0, -1], [1, 0]]
    shut = solve(DragSolver(model, "door"), model, complete(model), goal, turns=True)
    assert -1e-6 < shut["door"] < 0.001 + 1e-6
    free = solve(DragSolver(model, "door"), model, complete(model, {"bolt": 0.1}), goal, turns=True)
    assert free["door"] == pytest.approx(1.5, abs=1e-6)
    lifted = np.array(kv.rotation_x(0.5)())
    locked = solve(DragSolver(model, "lid"), model, complete(model), lifted, turns=True)
    assert locked["lid"] == pytest.approx(0.0, abs=1e-9)


class Browser:
    """Events of one browser, sent through the handlers of the server."""

    def __init__(self, page, client=7):
        self.page, self.scene, self.client = page, page.server.scene, client

    def start(self):
        from viser import _messages as messages

        message = messages.TransformControlsDragStartMessage(name=GIZMO)
        asyncio.run(self.scene._handle_transform_controls_drag_start(self.client, message))

    def update(self, pose):
        wxyz, position = to_wxyz(np.asarray(pose)[None])[0], np.asarray(pose)[:3, 3]
        self.send(wxyz, position)

    def send(self, wxyz, position):
        from viser import _messages as messages

        numbers = tuple(map(float, wxyz)), tuple(map(float, position))
        message = messages.TransformControlsUpdateMessage(GIZMO, *numbers)
        asyncio.run(self.scene._handle_transform_controls_updates(self.client, message))
        assert self.page.settled()

    def end(self):
        from viser import _messages as messages

        message = messages.TransformControlsDragEndMessage(name=GIZMO)
        asyncio.run(self.scene._handle_transform_controls_drag_end(self.client, message))
        assert self.page.settled()


def gizmo_pose(page):
    return page._drag._gizmo.position


@pytest.fixture
def arm_page():
    with view(arm(), BENT, port=0) as page:
        page._drag.choose("hand")
        yield page


def test_an_event_of_the_gizmo_moves_the_frame_to_its_goal(arm_page):
    page, browser = arm_page, Browser(arm_page)
    goal = fk(page.model, "hand", complete(page.model, {"joint0": 0.5, "joint1": -1.0, "joint2": 0.5}))
    browser.start()
    browser.update(goal)
    np.testing.assert_allclose(fk(page.model, "hand", page.values)[:3, 3], goal[:3, 3], atol=1e-3)
    np.testing.assert_allclose(page.pose("hand"), fk(page.model, "hand", page.values), atol=1e-12)
    for name in ("joint0", "joint1", "joint2"):
        assert page._panel._value(name) == pytest.approx(page.values[name], abs=1e-3)
    browser.end()
    page.reset()
    assert page.settled()
    assert page.values["joint1"] == BENT["joint1"]
    np.testing.assert_allclose(gizmo_pose(page), page.pose("hand")[:3, 3])


def test_the_distance_is_shown_until_the_gizmo_is_released(arm_page):
    page, browser = arm_page, Browser(arm_page)
    far = page.pose("hand")
    far[:3, 3] = 4.0, 0.0, 0.0
    browser.start()
    for _ in range(20):
        browser.update(far)
    assert "2.5 m" in page._drag._note.content
    page._panel._convert(centimetres=True)
    assert page.settled()
    assert "250 cm" in page._drag._note.content
    assert len(page._drag._marks) == 2
    browser.end()
    assert page._drag._marks == []
    np.testing.assert_allclose(gizmo_pose(page), page.pose("hand")[:3, 3])
    assert "away" not in page._drag._note.content


def test_poses_that_are_none_are_ignored(arm_page):
    page, browser = arm_page, Browser(arm_page)
    before = page.values
    browser.start()
    for wxyz, position in (
        ((math.nan, 0, 0, 0), (1, 0, 0)),
        ((0, 0, 0, 0), (1, 0, 0)),
        ((1, 0, 0, 0), (math.inf, 0, 0)),
        ((1, 0, 0, 0), (1e300, 0, 0)),
        ((1, 0, 0, 0), (math.nan, 0, 0)),
    ):
        browser.send(wxyz, position)
    browser.end()
    assert all(math.isfinite(value) for value in page.values.values())
    assert set(page.values) == set(before)
    np.testing.assert_allclose(gizmo_pose(page), page.pose("hand")[:3, 3])


def test_of_two_browsers_the_first_one_drags(arm_page):
    page, one, other = arm_page, Browser(arm_page, 1), Browser(arm_page, 2)
    ends = [complete(page.model, {**BENT, "joint0": angle}) for angle in (0.5, -0.5)]
    goals = [fk(page.model, "hand", end) for end in ends]
    one.start()
    other.start()
    one.update(goals[0])
    other.update(goals[1])
    other.end()
    np.testing.assert_allclose(page.pose("hand")[:3, 3], goals[0][:3, 3], atol=1e-3)
    one.end()
    other.start()
    other.update(goals[1])
    np.testing.assert_allclose(page.pose("hand")[:3, 3], goals[1][:3, 3], atol=1e-3)


def test_a_frame_that_is_removed_while_it_is_dragged_is_let_go(page):
    page._drag.choose("cabinet/knob")
    browser = Browser(page)
    browser.start()
    browser.update(page.pose("cabinet/knob"))
    with page.model.edit() as edit:
        edit.remove("frame cabinet/knob")
    assert page.settled()
    assert page._drag._gizmo is None
    assert "cabinet/knob cannot be dragged any more" in page._drag._note.content
    browser.update(np.eye(4))
    browser.end()
    # The next one is another gizmo, also after an edit of its own joint.
    page._drag.choose("cabinet/drawer", (-0.2, 0.0, 0.0))
    with page.model.edit() as edit:
        edit.constrain("cabinet/drawer/narrow", 0, kv.position("cabinet/drawer"), 0.1)
    assert page.settled()
    goal = page.pose("cabinet/drawer")
    goal[:3, 3] += -0.5, 0, 0
    browser.start()
    browser.update(goal)
    assert page.values["cabinet/drawer"] == pytest.approx(0.1, abs=1e-6)


def test_a_click_chooses_the_body_in_front_and_the_point_on_it(page):
    class Click:
        ray_origin, ray_direction = (-5.0, 0.1, 0.75), (2.0, 0.0, 0.0)

    page._drag._pick(Click)
    grip = page._drag._grip
    assert grip.frame == "cabinet/drawer"
    np.testing.assert_allclose(grip.point, [-0.22, 0.1, 0.05], atol=1e-5)
    assert page._drag._controls[0].value == "cabinet/drawer"
    # What does not move, empty space and nonsense let go.
    for origin in ((0.0, 0.0, 9.0), (-5.0, 9.0, 0.0), (math.nan, 0.0, 0.0)):
        page._drag.choose("cabinet/drawer")
        Click.ray_origin = origin
        Click.ray_direction = (0.0, 0.0, -1.0) if origin[2] == 9.0 else (1.0, 0.0, 0.0)
        page._drag._pick(Click)
        assert page._drag._grip is None


@pytest.mark.parametrize("error", [kv.errors.KineverseError("no way"), ZeroDivisionError("no way")])
def test_a_frame_without_a_solver_stays_and_says_why(page, monkeypatch, error):
    made = []

    def fail(*arguments):
        made.append(arguments)
        raise error

    monkeypatch.setattr(dragging, "DragSolver", fail)
    page._drag.choose("cabinet/drawer")
    assert "no way" in page._drag._note.content
    browser, before = Browser(page), page.values
    browser.start()
    browser.update(np.eye(4))
    browser.end()
    page.move({"cabinet/door": 0.3})
    assert page.settled()
    assert page.values == {**before, "cabinet/door": 0.3}
    assert "no way" in page._drag._note.content
    assert len(made) == 1


def test_a_drag_stops_an_animation(page):
    page.play()
    page._drag.choose("cabinet/drawer")
    browser = Browser(page)
    browser.start()
    browser.update(page.pose("cabinet/drawer"))
    assert page._animation is None
    assert not page._panel.playing.value


def test_without_degrees_of_freedom_nothing_can_be_dragged():
    model = kv.Model()
    with model.edit() as edit:
        body = Body(visuals=(Shape(Box((1, 1, 1))),))
        edit.add_frame("block", parent="world", transform=kv.translation(0, 0, 0), body=body)
    with view(model, port=0) as page:
        assert page._drag._controls is None

        class Click:
            ray_origin, ray_direction = (-5.0, 0.0, 0.0), (1.0, 0.0, 0.0)

        page._drag._pick(Click)
        assert page._drag._gizmo is None
        with model.edit() as edit:
            edit.add_frame("lid", parent="block", transform=kv.rotation_x(kv.position("lid")))
        assert page.settled()
        assert page._drag._controls[0].options == ("–", "lid")
        page._drag.choose("lid")
        page.hide_sliders()
        assert page.settled()
        assert page._drag._controls is page._drag._gizmo is None


def test_without_the_solver_a_line_names_the_extra(monkeypatch):
    monkeypatch.setattr(dragging, "find_spec", lambda name: None)
    with view(dependent(), port=0) as page:
        assert page._drag._controls is None
        assert "extra <b>control</b>" in page._drag._note.content
        assert page._drag._gizmo is None


def test_choosing_and_editing_from_several_threads_ends_in_one_gizmo(page):
    def choose(frame):
        for _ in range(5):
            page._drag.choose(frame)

    threads = [threading.Thread(target=choose, args=(f"cabinet/{name}",)) for name in ("drawer", "door")]
    for thread in threads:
        thread.start()
    with page.model.edit() as edit:
        edit.add_frame("flag", parent="world", transform=kv.translation(0, 0, kv.position("flag")))
    for thread in threads:
        thread.join()
    assert page.settled()
    assert page._drag._grip.frame in ("cabinet/drawer", "cabinet/door")
    assert page._drag._gizmo is page.server.scene._handle_from_node_name[GIZMO]
