"""Wrong input of planners, sizes at their bounds, threads."""

from __future__ import annotations

import itertools
import pickle
from concurrent.futures import ThreadPoolExecutor
from time import perf_counter

import numpy as np
import pytest
from planning_models import body

import kineverse as kv
from kineverse.errors import CompileError, InvalidValueError, KineverseError, ShapeError, UnknownNameError
from kineverse.model.body import Box, Capsule, Cone, Cylinder, Sphere
from kineverse.planning import Mode, Planner, bindings
from kineverse.planning.collision_checker import CollisionChecker
from kineverse.planning.sampling_planners import RrtConnect

pytestmark = pytest.mark.compiler


def points(count: int, obstacles: int = 0) -> kv.Model:
    """Return a ball that many coordinates move in turn along the three axes, among boxes."""
    q = [kv.position(f"q{k:02}") for k in range(count)]
    model = kv.Model()
    with model.edit() as edit:
        place = kv.translation(*(sum(q[axis::3], kv.expressions.as_expression(0.0)) for axis in range(3)))
        edit.add_frame("ball", "world", place, body(Sphere(0.05)))
        for k in range(obstacles):
            at = (k % 20 - 10.0, k // 20 - 10.3, 0.0)
            edit.add_frame(f"box{k}", "world", kv.translation(*at), body(Box((0.2, 0.2, 0.2))))
    return model


@pytest.fixture(scope="module")
def ball():
    return Planner(points(2))


def test_nothing_around_is_no_obstacle(ball):
    assert ball.valid([[0, 0], [1, 1]]).all()
    assert ball.edges([[0, 0]], [[1, 1]]).all()
    assert ball.valid(np.zeros((0, 2))).shape == ball.edges(np.zeros((0, 2)), np.zeros((0, 2))).shape == (0,)
    assert ball.plan([0, 0], [0, 0]).length == 0.0
    assert ball.plan([0, 0], np.random.default_rng(0).uniform(-5, 5, (500, 2)))
    assert np.isinf(ball.plan([0, 0], [1, 1]).clearance())


@pytest.mark.parametrize(
    ("given", "error"),
    [
        ([[np.nan, 0]], InvalidValueError),
        ([[np.inf, 0]], InvalidValueError),
        ([[1e30, 0]], InvalidValueError),
        ("abc", InvalidValueError),
        ([[1, 2, 3]], ShapeError),
        (np.zeros((2, 2, 2)), ShapeError),
        ({"nothing": 1.0}, UnknownNameError),
        ({"q00": np.inf}, InvalidValueError),
        ({"q00": -1e9}, InvalidValueError),
    ],
)
def test_wrong_configurations_are_refused(ball, given, error):
    for call in (
        ball.valid,
        lambda Q: ball.edges(Q, Q),
        lambda Q: ball.plan(Q, [0, 0]),
        lambda Q: ball.plan([0, 0], Q),
    ):
        with pytest.raises(error):
            call(given)


def test_wrong_arguments_are_refused(ball):
    for wrong in (
        {"margin": -1},
        {"margin": np.nan},
        {"protrusion": 0.0},
        {"protrusion": "1"},
        {"move": []},
        {"move": "nothing*"},
        {"move": 5},
        {"rules": None},
        {"decomposed": [5]},
        {"leave_out": [("ball",)]},
    ):
        with pytest.raises(KineverseError):
            Planner(ball.model, **wrong)
    with pytest.raises(InvalidValueError, match="takes a model"):
        Planner("kitchen")
    for wrong in (
        {"along": None},
        {"modes": 5},
        {"goals": None},
        {"goals": [kv.control.Goal(ball.symbols[0], 1.0), 5]},
    ):
        with pytest.raises(InvalidValueError, match=f"{next(iter(wrong))}(=| takes| is)"):
            ball.plan(**({"start": [0, 0], "goals": [0, 0]} | wrong))
    with pytest.raises(InvalidValueError, match="tasks takes"):
        ball.solutions(5)
    with pytest.raises(InvalidValueError, match="mask="):
        ball.hold("ball", "world", None)
    for wrong in ({"along": 5}, {"moves": 5}, {"name": None}):
        with pytest.raises(InvalidValueError):
            Mode(**({"name": "free"} | wrong))
    with pytest.raises(InvalidValueError, match="number from 0 to 1"):
        ball.plan([0, 0], [1, 1]).at("half")
    for goals in ([], np.zeros((0, 2))):
        with pytest.raises(ShapeError):
            ball.plan([0, 0], goals)
    for mask in ("", "xx", "xq", "rx rx"):
        with pytest.raises(InvalidValueError, match="mask="):
            ball.hold("ball", "world", mask)
    with pytest.raises(UnknownNameError):
        ball.hold("ball", "nothing")
    with pytest.raises(InvalidValueError, match="no goal"):
        ball.solutions([])
    with pytest.raises(InvalidValueError, match="seconds="):
        ball.solutions(kv.control.Hold(ball.symbols[0], 0.5), seconds=float("nan"))
    with pytest.raises(UnknownNameError):
        ball.place({"nothing": 1.0})
    with pytest.raises(ShapeError, match="differ"):
        ball.edges(np.zeros((2, 2)), np.zeros((3, 2)))


def test_goals_out_of_reach_differ_from_blocked_ones():
    planner = Planner(points(2, 30), margin=0.01)
    why = planner.plan([0, 0], kv.control.Hold(planner.symbols[0], 50.0, name="far"), seconds=0.05).why
    assert why.startswith("Out of reach")
    assert "'far'" in why
    assert "searched within 32 m or rad of the start: 'q00', 'q01'" in why
    blocked = [kv.control.Hold(s, target) for s, target in zip(planner.symbols, (0.0, -10.3), strict=True)]
    why = planner.plan([0, -9], blocked, seconds=0.05).why
    assert "In reach" in why
    assert "'ball' and 'box10' (1" in why


def test_planners_and_paths_are_pickled():
    planner = Planner(points(2, 30), "q00", margin=0.01, leave_out=["box3"])
    planner.place({"q01": -10.0})
    found = planner.plan([0.0], [0.5])
    copied, path = pickle.loads(pickle.dumps((planner, found)))
    again = copied.plan([0.0], [0.5])
    assert (again.points == found.points).all()
    assert (copied.margin, copied.planning_scene.state) == (0.01, planner.planning_scene.state)
    assert "box3" not in copied.scene.bodies
    assert (path.found, path.at(0.5), path.why) == (True, found.at(0.5), found.why)
    assert found.clearance() == again.clearance()
    with pytest.raises(InvalidValueError, match="pickled"):
        path.trajectory()


def test_states_that_stand_elsewhere_are_refused():
    planner = Planner(points(2), "q00")
    elsewhere = {"q00": 0.5, "q01": 1.0}
    for call in (planner.valid, lambda q: planner.plan(q, [0.0]), lambda q: planner.plan([0.0], [q])):
        with pytest.raises(InvalidValueError, match=r"'q01' is 1 and not 0.*place"):
            call(elsewhere)
    planner.place(elsewhere)
    assert planner.plan(elsewhere, [0.0]).at(0.0)["q01"] == 1.0


def test_lack_of_memory_is_no_answer(ball):
    with pytest.raises(MemoryError):
        bindings.planning_functions().kineverse_valid.errcheck(-1, None, ())


def test_single_solution_does_not_take_the_whole_time(ball):
    x, y = ball.symbols
    begin = perf_counter()
    path = ball.plan([0, 0], [kv.control.Hold(x, 0.5), kv.control.Hold(y, -0.5)], seconds=60)
    assert path.found, path.why
    assert perf_counter() - begin < 30
    np.testing.assert_allclose(path.points[-1], [0.5, -0.5], atol=1e-6)


def test_gap_that_is_filled_is_named():
    model = points(2)
    x, y = sorted(model.symbols, key=str)
    with model.edit() as edit:
        edit.add_frame("plate", "world", np.eye(4), body(Box((0.2, 4.0, 1.0))))
        edit.constrain("low", -1.8, y, 1.8)
    planner = Planner(model, [x, y])
    assert "every path leads through 'q00'" in planner.plan([-1, 0], [1, 0], seconds=0.05).why
    assert "every way" not in planner.plan([-1, 0], [-1, 1], seconds=0.05).why


def test_rolling_base_is_not_moved():
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(
            kv.articulations.DifferentialDrive(
                name="base", parent="world", child="base", radius=0.1, track=0.4
            )
        )
        edit.add_frame("box", "base", np.eye(4), body(Box((0.2, 0.2, 0.2))))
        edit.add_frame("head", "base", kv.rotation_z(kv.position("neck")), body(Sphere(0.1)))
    assert [str(s) for s in Planner(model).symbols] == ["neck"]
    with pytest.raises(InvalidValueError, match="cannot move independently"):
        Planner(model, "base")


def test_64_coordinates_are_planned_and_65_refused():
    path = Planner(points(64)).plan(np.zeros(64), np.full(64, 0.2))
    assert path, path.why
    with pytest.raises(InvalidValueError, match="65 coordinates"):
        Planner(points(65))


def test_many_obstacles_are_all_seen():
    planner = Planner(points(2, 400))
    Q = np.random.default_rng(0).uniform(-12, 12, (3000, 2))
    column = [str(s) for s in planner.symbols].index("q00")
    x, y = Q[:, column], Q[:, 1 - column]
    nearest = np.clip(np.round(x), -10, 9), np.clip(np.round(y + 0.3), -10, 9) - 0.3
    gap = np.hypot(np.maximum(abs(x - nearest[0]) - 0.1, 0), np.maximum(abs(y - nearest[1]) - 0.1, 0))
    np.testing.assert_array_equal(planner.valid(Q), gap > 0.05)


def test_path_longer_than_its_room_is_an_answer(ball, monkeypatch):
    monkeypatch.setattr("kineverse.planning.sampling_planners.PATH_ROOM", 3)
    ball.place({"q00": 0.0, "q01": 0.0})
    path = ball.plan([0, 0], [40, 0])
    assert not path
    assert path.why


def test_search_from_several_starts_is_the_same_each_time(ball):
    checker: CollisionChecker = ball.checker
    starts = np.array([[0, 0], [5, 5], [9, 9]], dtype=np.float32)
    goals = np.array([[5.5, 5.5]], dtype=np.float32)
    found = [RrtConnect(checker).solve(starts, goals, 1.0, 3) for _ in range(3)]
    assert all(f.found for f in found)
    for f in found[1:]:
        np.testing.assert_array_equal(f.points, found[0].points)


def test_planners_in_two_threads_do_not_meet(ball):
    def work(seed: int) -> list[float]:
        planner = Planner(points(2, 100))
        planner.place({"q00": 0.0})
        Q = np.random.default_rng(seed).uniform(-12, -6, (20, 2))
        Q = Q[planner.valid(Q)]
        return [planner.plan(a, b, seed=seed, seconds=5.0).length for a, b in itertools.pairwise(Q)]

    alone = [work(k) for k in range(2)]
    with ThreadPoolExecutor(2) as pool:
        assert list(pool.map(work, range(2))) == alone


def test_threads_share_a_planner_and_its_roadmap():
    planner = Planner(points(2, 100))
    Q = np.random.default_rng(0).uniform(-12, -6, (12, 2))
    Q = Q[planner.valid(Q)]

    def work(k: int) -> None:
        method = "prm" if k % 2 else "rrt-connect"
        for a, b in itertools.pairwise(np.roll(Q, k, axis=0)):
            path = planner.plan(a, b, method=method, seconds=30.0, seed=k)
            assert path, path.why
            np.testing.assert_array_equal(path.points[[0, -1]], [a, b])
            assert path.trajectory(velocity=1.0, acceleration=1.0).duration > 0.0
            assert path.clearance() > 0.0
            assert planner.valid(path.points).all()

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(work, range(4)))


def test_missing_compiler_is_said_with_what_works_without(ball, monkeypatch):
    class Missing:
        error = None

        def prepare(self, wait: bool) -> bool:
            return False

    monkeypatch.setattr(bindings, "_library", Missing())
    with pytest.raises(CompileError, match="Inverse kinematics"):
        Planner(ball.model)


@pytest.mark.parametrize("method", ["rrt-connect", "prm"])
def test_coordinates_that_move_no_shape_are_planned_within_limits_and_locks(method):
    x, y = kv.position("x"), kv.position("y")
    model = points(1, 3)
    with model.edit() as edit:
        edit.add_frame("needle", "world", kv.translation(x, y, 0))
        edit.constrain("x/range", -1, x, 1)
        edit.constrain("y/range", -1, y, 1)
        # Between x = -.1 and .1 there is a way at y > .5 only.
        edit.constrain("x/lock", 0.5 * ((x > -0.1) & (x < 0.1)) - 2, y, 2)
        edit.constrain("x/gate", -2 + 2.5 * ((x > -0.1) & (x < 0.1)), y, 2)
    planner = Planner(model, [x, y])
    assert planner.valid([[0.0, 0.7], [0.0, 0.0], [0.5, 0.0], [2.0, 0.0]]).tolist() == [
        True,
        False,
        True,
        False,
    ]
    path = planner.plan([-0.5, 0.0], [0.5, 0.0], method=method, seconds=30.0)
    assert path, path.why
    assert planner.valid(np.vstack([path.at(t).vector([x, y]) for t in np.linspace(0, 1, 200)])).all()
    assert np.isinf(path.clearance())
    assert "range is -1 to 1" in planner.plan([-0.5, 0.0], [2.0, 0.0], method=method).why


@pytest.mark.parametrize(
    "solid",
    [
        Cylinder(1, 1e-6),
        Capsule(1e-6, 100),
        *(pytest.param(solid, marks=pytest.mark.long) for solid in (Cone(1, 1e-6), Cylinder(1e3, 1e-3))),
    ],
)
def test_plates_and_needles_are_planned_with(solid):
    model = points(2)
    with model.edit() as edit:
        edit.add_frame("plate", "ball", kv.rotation_x(0.3), body(solid))
        edit.add_frame("post", "world", kv.translation(0, 0, 3000), body(Sphere(0.1)))
    assert Planner(model).plan([0, 0], [1, 0.5], seconds=30.0)
