"""Planning problems and queries: what they contain, and a tiny run of the planners."""

import json

import numpy as np
import pytest

from kineverse.errors import UnknownNameError
from kineverse.geometry import Scene
from kineverse.spatial import rotation_z, translation
from kineverse_studies.bench import kitchen_queries, planning
from kineverse_studies.bench.held_planning import HeldResults
from kineverse_studies.bench.kitchen_queries import CLEARANCE, make_kitchen_arm
from kineverse_studies.bench.planning import (
    FIGURES,
    KitchenResults,
    compare_with_vamp,
    run_kitchen_queries,
    run_published_problems,
)
from kineverse_studies.bench.planning_problems import (
    Attempt,
    AttemptSummary,
    ConfigurationCheck,
    interpolate_path,
    load_problem_sets,
)

PAIR = ("lift", "posts")


def _link(name, shape="", origin="0 0 0"):
    collision = (
        f'<collision><origin xyz="{origin}"/><geometry>{shape}</geometry></collision>' if shape else ""
    )
    return f'<link name="{name}">{collision}</link>'


def _joint(name, kind, parent, child, origin, limits="-2.5 2.5"):
    lower, upper = limits.split()
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><axis xyz="0 0 1"/>'
        f'<origin xyz="{origin}"/><limit lower="{lower}" upper="{upper}" effort="1" velocity="1"/></joint>'
    )


BALL, BAR = '<sphere radius="0.03"/>', '<sphere radius="0.01"/>'
LIFT = "".join(
    [
        '<robot name="lift">',
        _link("foot", '<sphere radius="0.1"/>', "0 0 0.1"),
        *(_link(name, BALL) for name in ("carriage", "upper", "lower", "hand")),
        _link("tool"),
        _joint("raise", "prismatic", "foot", "carriage", "0 0 0.4", "0 0.4"),
        _joint("shoulder", "revolute", "carriage", "upper", "0.15 0 0"),
        _joint("elbow", "revolute", "upper", "lower", "0.25 0 0"),
        _joint("wrist", "revolute", "lower", "hand", "0.25 0 0"),
        _joint("end", "fixed", "hand", "tool", "0.1 0 0"),
        "</robot>",
    ]
)
POSTS = "".join(
    [
        '<robot name="posts">',
        _link("room"),
        *(_link(f"{name}_handle", BAR) for name in ("left", "right")),
        _joint("left", "fixed", "room", "left_handle", "1 0.1 0.6"),
        _joint("right", "fixed", "room", "right_handle", "1 -0.1 0.7"),
        "</robot>",
    ]
)
ARM = (
    '<robot name="panda"><link name="base"><collision><geometry><sphere radius="0.1"/></geometry></collision>'
    '</link><link name="tip"><collision><origin xyz="0.5 0 0"/><geometry><sphere radius="0.05"/></geometry>'
    '</collision></link><joint name="turn" type="revolute"><parent link="base"/><child link="tip"/>'
    '<axis xyz="0 0 1"/><limit lower="-2" upper="2" effort="1" velocity="1"/></joint></robot>'
)
WALL = translation(0.0, 0.5, 0.0) @ rotation_z(0.3)


@pytest.fixture
def posts(tmp_path, monkeypatch):
    """Write a robot and a kitchen with two handles, and make them known."""
    (tmp_path / "lift.urdf").write_text(LIFT, encoding="utf-8")
    (tmp_path / "posts.urdf").write_text(POSTS, encoding="utf-8")
    arm = kitchen_queries.KitchenRobotArm(str(tmp_path / "lift.urdf"), "tool")
    monkeypatch.setattr(kitchen_queries, "ARMS", {"lift": arm})
    monkeypatch.setattr(kitchen_queries, "KITCHENS", {"posts": str(tmp_path / "posts.urdf")})


@pytest.fixture
def problems(tmp_path, monkeypatch):
    """Write a problem set of an arm with one joint, of which one goal is beyond its limit."""
    folder = tmp_path / "planning_problems" / "panda"
    folder.mkdir(parents=True)
    (folder / "panda_spherized.urdf").write_text(ARM, encoding="utf-8")
    pair = '<disable_collisions link1="base" link2="tip" reason="Adjacent"/>'
    (folder / "panda.srdf").write_text(f'<robot name="panda">{pair}</robot>', encoding="utf-8")
    entry = {"objects": [["wall", "box", WALL().tolist(), [0.1, 0.2, 0.2]]], "start": [-1.0], "goal": [-2.1]}
    other = {**entry, "objects": [["wall", "box", translation(0, 2, 0)().tolist(), [0.1, 0.2, 0.2]]]}
    content = {"joints": ["turn"], "problems": {"turns": [entry, other]}}
    (folder / "problems.json").write_text(json.dumps(content), encoding="utf-8")
    monkeypatch.setenv("KINEVERSE_MODEL_PATH", str(tmp_path))


def test_problem_sets_share_a_model_with_movable_obstacles(problems):
    (found,) = load_problem_sets("panda")
    near, far = found.problems
    pose = found.model.fk("obstacle/wall")
    np.testing.assert_allclose(pose(near.state), WALL(), atol=1e-12)
    assert pose(far.state)[1, 3] == 2.0
    assert found.model.limits(found.symbols[0]) == (-2.1, 2.0)
    scene = Scene(found.model)
    assert not scene.checks_pair("base", "tip")
    assert not ConfigurationCheck(scene, found.symbols, near.state)([np.pi / 2])
    assert ConfigurationCheck(scene, found.symbols, far.state)([np.pi / 2])


def test_problems_that_are_not_on_the_model_path_are_an_unknown_name(tmp_path, monkeypatch):
    monkeypatch.setenv("KINEVERSE_MODEL_PATH", str(tmp_path))
    with pytest.raises(UnknownNameError, match="planning_problems"):
        next(load_problem_sets("panda"))


@pytest.mark.compiler
def test_published_problems_are_compared_with_published_figures(problems, without):
    without("vamp")
    summaries = run_published_problems("panda", None, 2, lambda items, *_: items)
    whole, ours = summaries.values()
    assert len(ours.attempts) == len(whole.attempts) == 4
    assert ours.solved == whole.solved == 100.0
    compared = list(compare_with_vamp("panda", summaries))
    assert all("published" in c.name for c in compared)
    assert compared[0].value == ours.median / FIGURES["panda"].median


def test_sampled_paths_have_steps_below_the_density_and_contain_the_points():
    points = np.array([[0.0, 0.0], [0.3, 0.4], [0.3, 0.4], [1.0, 0.4]])
    samples = np.array(list(interpolate_path(points, 20.0)))
    assert np.linalg.norm(np.diff(samples, axis=0), axis=1).max() <= 0.05 + 1e-12
    assert all((np.abs(samples - point).max(axis=1) < 1e-12).any() for point in points)


def test_queries_are_free_of_contacts_and_the_same_for_a_seed(posts):
    arm = make_kitchen_arm(*PAIR)
    queries, scene = list(arm.queries(3)), Scene(arm.model)
    watch = scene.watch("robot/*", "kitchen/*", radius=CLEARANCE)
    lower, upper = arm.limits
    for query, again in zip(queries[:2], arm.queries(2), strict=True):
        np.testing.assert_array_equal(query.start, again.start)
        np.testing.assert_array_equal(query.goal, again.goal)
        check = ConfigurationCheck(scene, arm.symbols, query.state)
        for q in (query.start, query.goal):
            assert (lower <= q).all()
            assert (q <= upper).all()
            assert check(q)
            assert len(watch()) == 0
    assert not np.array_equal(queries[0].start, queries[1].start)


@pytest.mark.compiler
def test_paths_of_queries_are_checked(posts, tiny):
    results = run_kitchen_queries(tiny.queries, tiny.progress, [PAIR])
    assert len(results.summary.attempts) == tiny.queries
    assert results.checked == sum(a.found for a in results.summary.attempts)
    assert results.contacts == []
    names = [m.name for m in results.measurements()]
    assert len(names) == len(set(names))


def test_ompl_finds_a_way_around_an_obstacle():
    pytest.importorskip("ompl")
    from kineverse_studies.bench.peers.ompl import OmplRrtConnect

    def free(q):
        return abs(q[0]) > 0.2 or q[1] > 0.5

    planner = OmplRrtConnect(free, np.array([-1.0, -1.0]), np.array([1.0, 1.0]))
    start, goal = np.array([-0.8, -0.5]), np.array([0.8, -0.5])
    found, again = (planner.plan(start, goal, 5.0, seed=3) for _ in range(2))
    assert found.found
    np.testing.assert_array_equal(found.points, again.points)
    np.testing.assert_array_equal(found.points[[0, -1]], [start, goal])
    assert all(free(q) for q in interpolate_path(found.points, 32.0))
    assert not planner.plan(start, np.array([0.0, -0.5]), 0.05, seed=0).found


def test_summaries_count_times_of_what_is_solved():
    attempts = [Attempt(True, 1.0, 2.0), Attempt(True, 3.0, 4.0), Attempt(False, 9.0, 9.0)]
    summary = AttemptSummary("planner", attempts)
    assert (summary.median, summary.mean) == (2.0, 2.0)
    values = {m.name: m.median for m in summary.measurements()}
    assert values["planner: median, path judged"] == 3.0
    assert values["planner: solved"] == pytest.approx(200 / 3)
    nothing = AttemptSummary("planner", attempts[2:])
    assert [m.name for m in nothing.measurements()] == ["planner: solved"]
    assert np.isinf(nothing.median)


def test_shares_are_of_what_somebody_solves():
    results = KitchenResults({"a": [Attempt(True, 1e-3, 1e-3), Attempt(False, 1.0, 1.0)]}, solvable=1)
    share, median, _, contacts = results.comparisons()
    assert (share.value, share.status) == (100.0, "met")
    assert (median.value, median.status) == (1e-3, "met")
    assert contacts.status == "met"


def test_a_motion_without_grasps_has_no_value():
    results = HeldResults("fridge", tried=3)
    assert list(results.measurements()) == []
    (median,) = results.comparisons()
    assert median.status == "missing"


def test_the_planner_of_a_shipped_robot_is_built_where_no_other_is_found(tmp_path, monkeypatch, tiny):
    monkeypatch.setenv("KINEVERSE_MODEL_PATH", str(tmp_path))
    built = []
    monkeypatch.setattr(
        planning, "run_program", lambda *words, cache: built.append(words) or {"seconds": 1.0}
    )
    result = planning.measure_planning(tiny, parts=("build",))
    assert {*built} == {("build_planner", "pr2 (shipped)")}
    assert [m.name for m in result.measurements] == [
        f"pr2 (shipped): {n}" for n in (planning.FIRST, planning.AGAIN)
    ]


def test_missing_robots_and_peers_are_reported(tmp_path, monkeypatch, tiny, without):
    without("ompl", "vamp")
    monkeypatch.setenv("KINEVERSE_MODEL_PATH", str(tmp_path))
    result = planning.measure_planning(tiny, parts=("published",))
    assert any(line.startswith("vamp is not installed") for line in result.missing)
    assert any("studies[peers]' brings it" in line for line in result.missing)
    assert any("problems of panda are not on the model path" in line for line in result.missing)
    assert result.measurements == ()
    results = run_kitchen_queries(1, tiny.progress, [("fetch", "iai_kitchen")])
    assert results.missing
    assert not results.ours
