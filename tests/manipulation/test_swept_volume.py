"""Law: what an object would go through is found before anything moves, and as deep as it is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import random_cupboards

import kineverse as kv
from cupboards import box
from kineverse.geometry import Scene
from kineverse.manipulation import Robot, Session, open_object, push
from kineverse.manipulation.swept_volume import find_obstacle
from kineverse.model.model import Model
from kineverse.state import State
from kineverse.worlds import KinematicWorld, TrueBelief
from robot_interface_proxy import InterfaceOnly


def cupboard(*, limits: bool = True, **solids: tuple[tuple[float, ...], tuple[float, ...]]) -> Model:
    """Build a carcass at x > 1 with a door whose hinge is at y = 0.3, a drawer below, and fixed boxes by name."""
    model, door, drawer = Model(), kv.position("door"), kv.position("drawer")
    with model.edit() as edit:
        edit.add_frame("carcass", "world", np.eye(4), body=box(0.4, 0.6, 0.5, at=(1.2, 0, 0.75)))
        turned = kv.translation(0.997, 0.3, 0.75) @ kv.rotation_z(-door)
        edit.add_frame("panel", "carcass", turned, body=box(0.02, 0.6, 0.4, at=(-0.01, -0.3, 0)))
        slid = kv.translation(0.99 - drawer, 0, 0.4)
        edit.add_frame("front", "carcass", slid, body=box(0.02, 0.6, 0.1))
        for name, (size, at) in solids.items():
            edit.add_frame(name, "world", np.eye(4), body=box(*size, at=at))
        if limits:
            edit.constrain("door/range", 0, door, 1.5)
        edit.constrain("drawer/range", 0, drawer, 0.3)
    return model


def at(model: Model, **values: float) -> State:
    return model.default_state().updated(values)


@pytest.mark.sampled(3)  # of the first and the fourth, one is blocked
@pytest.mark.parametrize("number", range(6))
def test_obstacles_are_those_that_coal_finds_along_the_way(number: int, tmp_path: Path) -> None:
    """Cupboards of a generator, with shapes, motions and distances of its own."""
    drawn, path = random_cupboards.draw_cupboard(number, seed=7), tmp_path / "cupboard.urdf"
    path.write_text(drawn.urdf(), encoding="utf-8")
    model, others = kv.load(path), {f"{name}_joint": value for name, value in drawn.values.items()}
    state = at(model, front_joint=drawn.start, **others)
    found = find_obstacle(model, model.symbol("front_joint"), state, drawn.target)
    assert (found is not None) == drawn.blocked, found
    if found is None:
        return
    judge, first = random_cupboards.Judge(drawn.links), None
    for q in np.linspace(drawn.start, drawn.target, 400).tolist():
        depths = judge.distances({"front": q} | drawn.values)
        if min(depths.values(), default=1.0) < -random_cupboards.ALLOWED:
            first = q
            break
    assert first is not None
    assert found.value == pytest.approx(first, abs=1.1 * abs(drawn.target - drawn.start) / 400)


def test_a_door_meets_a_post_where_its_edge_is() -> None:
    """The outer edge, 0.6 m from the hinge, comes to a post in the plane x = 0.65."""
    model = cupboard(post=((0.02, 0.02, 1.0), (0.65, 0.3 - 0.45, 0.75)))
    door = model.symbol("door")
    found = find_obstacle(model, door, at(model), 1.5)
    assert found is not None
    assert (found.body, found.other, found.carrier) == ("panel", "post", None)
    model_depth, first = 0.0, np.inf
    scene = Scene(model)
    for q in np.linspace(0.0, 1.5, 3001):
        scene.update(at(model, door=q))
        depth = -scene.distance("panel", "post").distance
        model_depth = max(model_depth, depth)
        first = min(first, q) if depth > 5e-4 else first
    assert found.value == pytest.approx(first, abs=2e-3)
    assert found.depth == pytest.approx(model_depth, abs=1e-3)
    assert 0.0 < found.value - found.free < 0.02
    assert find_obstacle(model, door, at(model), found.free) is None
    # From the other side as well, and not from behind the post on.
    assert find_obstacle(model, door, at(model, door=1.4), 0.0) is not None
    assert find_obstacle(model, door, at(model, door=1.4), 1.2) is None
    assert f"'panel' meets 'post' at {found.value:.3f} rad of 'door'" in str(found)


def test_a_thin_pane_is_not_passed_over() -> None:
    model = cupboard(pane=((2e-3, 1.0, 1.0), (0.80, 0.0, 0.5)))
    found = find_obstacle(model, model.symbol("drawer"), at(model), 0.3)
    assert found is not None
    assert found.value == pytest.approx(0.98 - 0.801 + 5e-4, abs=1e-3)
    assert found.unit == "m"


def test_a_door_does_not_turn_into_its_own_carcass() -> None:
    model = cupboard(limits=False)
    door = model.symbol("door")
    found = find_obstacle(model, door, at(model), -1.0)
    assert found is not None
    assert {found.body, found.other} == {"panel", "carcass"}
    assert find_obstacle(model, door, at(model), 1.5) is None


def test_furniture_that_moves_is_to_be_moved_first() -> None:
    """A drawer that is out stands under a flap that comes down."""
    model, flap = cupboard(), kv.position("flap")
    with model.edit() as edit:
        turned = kv.translation(0.97, 0, 0.7) @ kv.rotation_y(flap)
        edit.add_frame("leaf", "carcass", turned, body=box(0.02, 0.5, 0.4, at=(-0.01, 0, -0.2)))
        edit.constrain("flap/range", 0, flap, 1.6)
    state = at(model, drawer=0.3, flap=1.4)
    found = find_obstacle(model, flap, state, 0.0)
    assert found is not None
    assert (str(found.carrier), found.aside) == ("drawer", 0.0)
    assert "Move 'drawer' to 0.000 first." in str(found)
    assert find_obstacle(model, flap, state.updated({"drawer": 0.0}), 0.0) is None


def test_what_overlaps_at_the_start_may_do_so_and_no_deeper() -> None:
    """A wall reaches into the drawer's front by 5 mm as it is shut; one behind is met by closing."""
    model = cupboard(wall=((0.02, 0.1, 0.5), (1.005, 0.2, 0.4)))
    drawer = model.symbol("drawer")
    assert find_obstacle(model, drawer, at(model), 0.3) is None
    found = find_obstacle(model, drawer, at(model, drawer=0.3), 0.0)
    assert found is not None, "it was apart at the start"
    assert found.depth == pytest.approx(0.005, abs=1e-4)
    assert find_obstacle(model, drawer, at(model, drawer=0.3), 0.0, start=at(model)) is None


@pytest.mark.parametrize("inset", [0.002, 0.0])
def test_a_door_whose_edge_is_in_its_carcass_opens_within_limits(inset: float) -> None:
    """Its hinge is in the middle of the panel, so that the edge gets deeper as it turns."""
    model, door = Model(), kv.position("door")
    with model.edit() as edit:
        edit.add_frame("carcass", "world", np.eye(4), body=box(0.4, 0.6, 0.5, at=(1.2, 0, 0.75)))
        turned = kv.translation(0.991 + inset, 0.3, 0.75) @ kv.rotation_z(-door)
        edit.add_frame("panel", "carcass", turned, body=box(0.018, 0.6, 0.4, at=(0, -0.3, 0)))
        edit.constrain("door/range", -1.5, door, 1.5)
    assert find_obstacle(model, door, at(model), 1.5) is None
    # A face that only touches the carcass is no edge that is in it.
    assert (find_obstacle(model, door, at(model), -1.0) is None) == (inset > 0)


def test_skills_say_what_is_in_the_way_and_move_nothing() -> None:
    model = kv.load("hsr")
    model.include("shelf_drawers", prefix="shelf")
    with model.edit() as edit:
        edit.attach("shelf/shelf", parent="world", transform=kv.translation(1, 0, 0.7))
        edit.add_frame("bar", "world", np.eye(4), body=box(0.02, 1.0, 0.02, at=(0.75, 0, 0.9)))
    drawer = "shelf/upper_drawer"
    robot = Robot.of(model, "hsr")
    scene_free = find_obstacle(model, model.symbol(drawer), model.default_state(), 0.2, robot=robot)
    if scene_free is None:
        pytest.skip("the bar is beside the drawer")
    world = KinematicWorld(model, "hsr")
    world.reset(model.default_state().updated({"hsr/base/x": -1.5}))
    session = Session(InterfaceOnly(world), belief=TrueBelief(world))
    for outcome in (open_object(session, drawer), push(session, drawer, target=0.2)):
        assert not outcome.done
        assert outcome.steps == 0
        assert "'bar'" in outcome.reason
        assert outcome.measures["failure"] == "collision"
        assert outcome.measures["free"] < scene_free.value


@pytest.mark.parametrize("count", ["1", pytest.param("4", marks=pytest.mark.long)])
def test_robots_at_random_cupboards_go_through_nothing(
    capsys: pytest.CaptureFixture[str], count: str
) -> None:
    assert random_cupboards.main(["--count", count, "--robots", "hsr"]) == 0, capsys.readouterr().out


@pytest.mark.long
def test_robots_at_many_random_cupboards_go_through_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    assert random_cupboards.main(["--count", "24", "--seed", "1"]) == 0, capsys.readouterr().out
