"""Collision checks of a planner against the collision scene, which computes in double precision."""

import numpy as np
import pytest
import trimesh
from planning_models import arm_among_shapes, ball_and_plate, body, contacts, is_free

import kineverse as kv
from kineverse.geometry import Scene
from kineverse.model.body import Body, Box, Cylinder, Mesh, Sphere
from kineverse.planning import Planner

pytestmark = pytest.mark.compiler


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    folder = tmp_path_factory.mktemp("meshes")
    points = np.random.default_rng(0).normal(size=(30, 3)) * 0.08
    trimesh.Trimesh(points).convex_hull.export(folder / "hull.stl")
    return Planner(arm_among_shapes(Mesh("hull.stl", folder=str(folder))), "j*")


@pytest.fixture(scope="module")
def plate():
    return Planner(ball_and_plate())


def configurations(planner, count, seed=0):
    return np.random.default_rng(seed).uniform(-2.5, 2.5, (count, len(planner.symbols)))


@pytest.mark.parametrize(("base", "tolerance"), [(0.0, 2e-6), (1000.0, 1e-3)])
def test_valid_is_true_without_contact_and_false_at_one(arm, base, tolerance):
    arm.place({"base": base, "cart": 0.6})
    Q = configurations(arm, 200, seed=int(base))
    found, distances = arm.valid(Q), contacts(arm, Q)
    assert 0.2 < found.mean() < 0.95
    assert distances[found].min() > -1e-6
    # Below 0.01 mm the narrow phase does not tell shapes apart.
    assert distances[~found].max() <= 1.1e-5 + tolerance
    np.testing.assert_array_equal(found, [arm.valid(q)[0] for q in Q])


def test_margin_keeps_bodies_apart(plate):
    wide = Planner(plate.model, margin=0.05)
    Q = np.random.default_rng(0).uniform(-0.2, 0.2, (300, 3))
    found, distances = wide.valid(Q), contacts(wide, Q)
    assert distances[found].min() > 0.05 - 1e-5
    assert distances[~found].max() < 0.05 + 2e-5


def test_place_moves_obstacles_without_compiling(arm, monkeypatch):
    monkeypatch.setattr("subprocess.Popen", None)
    monkeypatch.setattr("subprocess.run", None)
    arm.place({"base": 0.0, "cart": 0.6})
    Q = configurations(arm, 200)
    q = Q[arm.valid(Q)][0]
    assert arm.valid(q)[0]
    assert (contacts(arm, q[None]) > 0).all()
    arm.place({"cart": 0.0})
    assert not arm.valid(q)[0]
    assert (contacts(arm, q[None]) <= 0).all()
    arm.place({"cart": 0.6})
    assert arm.valid(q)[0]


def test_poses_are_those_of_the_model(arm):
    arm.place({"base": 0.3, "cart": 0.6})
    for q in configurations(arm, 20).astype(np.float32):
        poses, _ = arm.checker.outputs(q)
        state = arm.planning_scene.state.updated(
            dict(zip(arm.symbols, q.astype(float).tolist(), strict=True))
        )
        for name, pose in zip(arm.checker.groups, poses, strict=True):
            np.testing.assert_allclose(pose, arm.model.fk(name)(state)[:3], atol=1e-6)


def test_path_of_an_arm_is_free_by_the_scene_and_the_same_for_one_seed(arm):
    arm.place({"base": 0.0, "cart": 0.6})
    Q = configurations(arm, 400, seed=5) / 2.5
    free = Q[arm.valid(Q)]
    paths = [arm.plan(free[2 * k], free[2 * k + 1], seed=k, seconds=0.2) for k in range(5)]
    found = [k for k, path in enumerate(paths) if path]
    # Some goals are enclosed.
    assert len(found) >= 2
    for k in found:
        assert is_free(arm, paths[k].points)
        np.testing.assert_array_equal(paths[k].points[[0, -1]], free[2 * k : 2 * k + 2])
        again = arm.plan(free[2 * k], free[2 * k + 1], seed=k, seconds=5.0)
        np.testing.assert_array_equal(paths[k].points, again.points)


def test_pair_that_touches_at_the_default_place_only_is_checked_elsewhere():
    x, turn = kv.position("x"), kv.position("turn")
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("base", "world", kv.translation(x, 0, 0), body(Box((0.3, 0.3, 0.1))))
        edit.add_frame("arm", "base", kv.rotation_z(turn), body(Box((0.2, 0.2, 0.1))))
        edit.add_frame("cupboard", "world", np.eye(4), body(Box((1, 1, 1))))
    planner = Planner(model, "turn")
    assert not planner.excluded
    planner.place({"x": 0.55})
    assert not planner.valid([[0.0]])[0]
    planner.place({"x": 0.8})
    assert planner.valid([[0.0]])[0]


def test_pair_that_is_apart_in_a_small_gap_only_is_checked():
    x, y = kv.position("x"), kv.position("y")
    model = kv.Model()
    with model.edit() as edit:
        edit.constrain("x", -1, x, 1)
        edit.constrain("y", -1, y, 1)
        edit.add_frame("peg", "world", kv.translation(x, y, 0), body(Sphere(0.05)))
        # Below and above a slot at y = 0.7, and a stop in it.
        sides = [body(Box(size), at=at) for size, at in (
            ((9, 2, 1), (0, 1.76, 0)), ((9, 2, 1), (0, -0.36, 0)), ((0.1, 2, 1), (0.5, 0.7, 0)),
        )]  # fmt: skip
        edit.add_frame("block", "world", np.eye(4), Body(collisions=sum((s.collisions for s in sides), ())))
    planner = Planner(model)
    assert planner.excluded
    assert "'peg' and 'block'" in planner.plan([0, 0.7], [0.5, 0.7]).why
    assert not planner.excluded
    assert planner.valid([[0, 0.7], [0.5, 0.7]]).tolist() == [True, False]


def test_certificate_finds_a_plate_between_two_samples(plate):
    A, B = np.random.default_rng(0).uniform(0.02, 0.5, (2, 100, 3)).astype(np.float32)
    B[:, 0] *= -1
    A[:, 2], B[:, 2] = 0.0, 0.0
    column = [str(s) for s in plate.symbols].index("x")
    order = [column, *(k for k in range(3) if k != column)]
    A, B = (np.ascontiguousarray(m[:, np.argsort(order)]) for m in (A, B))
    turn = [str(s) for s in plate.symbols].index("turn")
    A[:, turn] = B[:, turn] = 0.0
    assert not plate.checker.edges(A, B, least=2e-4).any()
    for a, b in zip(A, B, strict=True):
        collision = plate.checker.find_collision(np.array([a, b]))
        assert collision is not None
        assert collision[0] == 0
        at = a + collision[1] * (b - a)
        assert abs(at[column]) < 0.05


@pytest.mark.long
def test_leaning_pole_and_fast_thread_are_not_slipped_through():
    x, z, lift = (kv.position(name) for name in ("x", "z", "lift"))
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("ball", "world", kv.translation(x, 0, z), body(Sphere(0.01)))
        edit.add_frame("pole", "world", kv.rotation_y(1.3e-3), body(Cylinder(0.02, 8.0)))
        # A turn for each 1/64 m, the distance of two samples.
        spindle = kv.translation(5, 0, lift) @ kv.rotation_z(128 * np.pi * lift)
        edit.add_frame("bar", "world", spindle, body(Box((0.02, 1.0, 0.02)), at=(0, 0.5, 0)))
        edit.add_frame("post", "world", kv.translation(5.4, 0, 0), body(Box((0.02, 0.02, 3.0))))
    planner = Planner(model, ["x", "z", "lift"])
    leaning = np.array([[0.034, 3.9, 0.0], [0.036, 3.9, 0.0]])
    assert contacts(planner, leaning)[0] < -1e-3
    assert planner.valid(leaning).tolist() == [False, True]
    assert not planner.plan([1, 0, 0], [1, 0, 0.5], seconds=0.01).found


def test_no_path_crosses_a_plate(plate):
    for k in range(3):
        start, goal = {"x": 0.1, "y": 0.3 * k, "turn": 0.0}, {"x": -0.1, "y": 0.2, "turn": 0.0}
        path = plate.plan(start, goal, seed=k, seconds=3.0)
        assert path, path.why
        assert is_free(plate, path.points, 1000.0)


@pytest.mark.parametrize("goal", [10.0, 3.0, -2.0, 315.0, 2 * np.pi + 1, 1000.0])
def test_turning_joint_goes_the_short_way(plate, goal):
    q = plate.model.default_state().updated({"x": 0.5})
    path = plate.plan(q, q.updated({"turn": goal}), seconds=1.0)  # half of it for the way that is blocked
    assert path, path.why
    column = [str(s) for s in plate.symbols].index("turn")
    turned = path.points[-1, column]
    assert np.cos(turned - goal) == pytest.approx(1.0)
    assert is_free(plate, path.points)
    # The post is at -π + 0.2, and the way around it is the other one.
    assert abs(turned) <= np.pi + 0.3


def test_goal_behind_full_turns_is_checked_where_it_is(plate):
    q = plate.model.default_state().updated({"x": 0.5})
    for turns in (0, 2, -3):
        path = plate.plan(q, q.updated({"turn": 0.2 - np.pi + 2 * np.pi * turns}))
        assert not path
        assert "'arm' and 'post'" in path.why


def test_edits_of_the_model_are_followed():
    x, model = kv.position("x"), kv.Model()
    with model.edit() as edit:
        edit.add_frame("hand", "world", kv.translation(x, 0, 0), body(Sphere(0.05)))
        edit.add_frame("post", "world", kv.translation(0.5, 0.3, 0), body(Sphere(0.05)))
    planner = Planner(model)
    assert planner.valid([[0.5], [1.0]]).tolist() == [True, True]
    with model.edit() as edit:
        edit.add_frame("cup", "hand", kv.translation(0, 0.2, 0), body(Sphere(0.06)))
        edit.add_frame("box", "world", kv.translation(1.0, 0, 0), body(Box((0.1, 0.1, 0.1))))
    assert planner.valid([[0.5], [1.0], [-1.0]]).tolist() == [False, False, True]
    assert Scene(model).bodies == planner.scene.bodies


@pytest.fixture(scope="module")
def turnstile():
    """An arm that turns fully, up and down a little, and a wall on one side of it."""
    turn, lift = kv.position("turn"), kv.position("lift")
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("arm", "world", kv.rotation_z(turn) @ kv.translation(0.5, 0, lift), body(Sphere(0.1)))
        edit.add_frame(
            "wall", "world", kv.rotation_z(0.8) @ kv.translation(0.5, 0, 0), body(Box((0.3, 0.05, 4)))
        )
        edit.constrain("lift/range", -0.5, lift, 0.5)
    return Planner(model, ["turn", "lift"])


@pytest.mark.parametrize("goal", [1.6, 1.6 - 2 * np.pi, 1.6 + 2 * np.pi])
def test_joint_goes_the_long_way_round_where_the_short_one_is_blocked(turnstile, goal):
    path = turnstile.plan([0.0, 0.0], [goal, 0.1], seconds=1.0)
    assert path, path.why
    np.testing.assert_allclose(path.points[-1], [1.6 - 2 * np.pi, 0.1], atol=1e-9)
    assert is_free(turnstile, path.points)


@pytest.mark.parametrize("goal", [-4.0, -5.2, -2.0])
def test_goal_more_than_half_a_turn_away_is_reached_at_its_value(turnstile, goal):
    path = turnstile.plan([0.0, 0.0], [goal, 0.1], seconds=2.0)
    assert path, path.why
    np.testing.assert_array_equal(path.points[-1], [goal, 0.1])
    assert is_free(turnstile, path.points)
