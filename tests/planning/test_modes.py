"""Planning through modes: a button that unlocks a door, pressed by a hand that then pulls the door."""

import numpy as np
import pytest

import kineverse as kv
from kineverse.errors import DuplicateNameError, InvalidValueError, UnknownNameError
from kineverse.model.body import Body, Box, Pose, Shape, Sphere
from kineverse.planning import Mode, Planner

PRESSED = 0.05


def solid(geometry):
    return Body(collisions=(Shape(geometry, Pose()),))


@pytest.fixture(scope="module")
def model():
    """A hand that moves in a plane, a button on one side, and a drawer on the other that the button unlocks."""
    x, y = kv.position("hand/x"), kv.position("hand/y")
    button, drawer = kv.position("button"), kv.position("drawer")
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("hand", "world", kv.translation(x, y, 0), solid(Sphere(0.02)))
        edit.add_frame("button", "world", kv.translation(0.5 + button, 0.4, 0), solid(Box((0.02, 0.1, 0.1))))
        edit.add_frame("drawer", "world", kv.translation(0.5 - drawer, -0.4, 0), solid(Box((0.02, 0.1, 0.1))))
        edit.add_frame("wall", "world", kv.translation(0.3, 0, 0), solid(Box((0.5, 0.1, 0.1))))
        edit.constrain("x", -0.5, x, 1.0)
        edit.constrain("y", -0.6, y, 0.6)
        edit.constrain("stroke", 0.0, button, 0.1)
        edit.constrain("travel", 0.0, drawer, 0.3)
        edit.constrain("lock", -np.inf, drawer, kv.where(kv.logic.less(PRESSED, button), 1.0, 0.0))
    return model


@pytest.fixture(scope="module")
def planner(model):
    return Planner(model)


@pytest.fixture(scope="module")
def modes(planner):
    offset = kv.translation(-0.031, 0, 0)
    press = planner.hold("hand", "button", "xy", offset)
    pull = planner.hold("hand", "drawer", "xy", offset)
    return [Mode("free"), Mode("press", press, "button"), Mode("pull", pull, "drawer")]


def test_a_locked_drawer_is_opened_after_its_button(model, planner, modes):
    drawer = model.symbol("drawer")
    path = planner.plan(None, kv.control.Hold(drawer, 0.25), modes=modes, seconds=10)
    assert path.found, path.why
    names = [name for name, _, _ in path.modes]
    assert names[0] == "free"
    assert names[-1] == "pull"
    assert "press" in names
    column = {str(s): k for k, s in enumerate(path.symbols)}
    moves = {"free": set(), "press": {"button"}, "pull": {"drawer"}}
    for name, first, last in path.modes:
        part = path.points[first : last + 1]
        for thing in ("button", "drawer"):
            if thing not in moves[name]:
                assert np.ptp(part[:, column[thing]]) < 1e-9
    assert (path.points[path.points[:, column["drawer"]] > 1e-4, column["button"]] > PRESSED).all()
    assert path.points[-1, column["drawer"]] == pytest.approx(0.25, abs=1e-8)
    held = planner.planning_scene.manifold(modes[2].along)
    _, first, last = path.modes[-1]
    assert held.residuals(path.points[first : last + 1]).max() < 1e-5


def test_a_button_out_of_reach_leaves_the_drawer_locked(model, planner, modes):
    far = Mode("press", planner.hold("hand", "button", "xy", kv.translation(-5, 0, 0)), "button")
    goal = kv.control.Hold(model.symbol("drawer"), 0.25)
    path = planner.plan(None, goal, modes=[modes[0], far, modes[2]], seconds=0.3)
    assert not path.found
    assert "free" in path.why


def test_the_same_seed_leads_to_the_same_path(model, planner, modes):
    goal = kv.control.Hold(model.symbol("drawer"), 0.2)
    one, other = (planner.plan(None, goal, modes=modes, seconds=10, seed=3) for _ in range(2))
    assert one.found
    np.testing.assert_array_equal(one.points, other.points)


def test_configurations_as_goals(planner, modes, model):
    home = model.default_state()
    goal = home.updated({"hand/x": 0.2, "hand/y": -0.3})
    path = planner.plan(home.updated({"hand/y": 0.3}), goal, modes=modes, seconds=5)
    assert path.found, path.why
    assert [name for name, _, _ in path.modes] == ["free"]


def test_mistakes(planner, modes):
    with pytest.raises(InvalidValueError, match="Mode"):
        planner.plan(None, [0.0] * 4, modes=[])
    with pytest.raises(DuplicateNameError):
        planner.plan(None, [0.0] * 4, modes=[Mode("a"), Mode("a")])
    with pytest.raises(UnknownNameError, match="button"):
        planner.plan(None, [0.0] * 4, modes=[Mode("a", (), "buton")])
    with pytest.raises(InvalidValueError, match="along"):
        planner.plan(None, [0.0] * 4, modes=modes, along=modes[1].along)
