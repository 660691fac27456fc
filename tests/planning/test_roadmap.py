"""Roadmap of a planner: kept between queries, right after anything moves, and judged like every path."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import pytest

import kineverse as kv
from kineverse.control import Hold
from kineverse.errors import InvalidValueError
from kineverse.model.body import Body, Box, Shape, Sphere
from kineverse.planning import Path, Planner
from kineverse.planning.sampling_planners import Roadmap

LEFT, RIGHT = [-1.0, 0.0], [1.0, 0.0]
OPEN, NARROWED, CLOSED = (1.0, 1.0), (0.0, 1.0), (0.0, 0.0)


BALL = Body(collisions=(Shape(Sphere(0.1)),))


def box(*size: float) -> Body:
    x, y, z = size
    return Body(collisions=(Shape(Box((x, y, z))),))


@pytest.fixture(scope="module")
def model() -> kv.Model:
    """Return a ball in a plane, and a wall in which gates close two gaps; one is lifted by each coordinate."""
    x, y, *lifts = (kv.position(name) for name in ("x", "y", "middle", "side"))
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("ball", "world", kv.translation(x, y, 0), BALL)
        for k, (low, high) in enumerate([(-2.2, -0.3), (0.3, 1.2), (1.8, 2.2)]):
            edit.add_frame(
                f"wall{k}", "world", kv.translation(0, (low + high) / 2, 0), box(0.2, high - low, 0.6)
            )
        edit.add_frame("gate0", "world", kv.translation(0, 0, lifts[0]), box(0.1, 0.6, 0.6))
        edit.add_frame("gate1", "world", kv.translation(0, 1.5, lifts[1]), box(0.1, 0.6, 0.6))
        for name, symbol in (("x", x), ("y", y)):
            edit.constrain(f"{name}/range", -2, symbol, 2)
    return model


@pytest.fixture
def planner(model: kv.Model) -> Planner:
    planner = Planner(model, ["x", "y"])
    place(planner, OPEN)
    return planner


def place(planner: Planner, gates: tuple[float, float]) -> None:
    planner.place({"middle": gates[0], "side": gates[1]})


def plan(planner: Planner, start: object = LEFT, goal: object = RIGHT, **options: object) -> Path:
    return planner.plan(start, goal, **{"method": "prm", "seconds": 2.0} | options)  # type: ignore[arg-type]


def require_roadmap(planner: Planner) -> Roadmap:
    assert planner.roadmap is not None
    return planner.roadmap


def assert_certain(planner: Planner, path: Path, start: npt.ArrayLike, goal: npt.ArrayLike) -> None:
    assert path.found, path.why
    np.testing.assert_allclose(path.points[0], np.asarray(start), atol=1e-6)
    np.testing.assert_allclose(path.points[-1], np.asarray(goal), atol=1e-6)
    assert planner.edges(path.points[:-1], path.points[1:]).all()
    assert path.clearance() > 0.0


def test_both_methods_solve_the_same_queries(planner: Planner) -> None:
    place(planner, NARROWED)
    for method in ("rrt-connect", "prm"):
        path = plan(planner, method=method)
        assert_certain(planner, path, LEFT, RIGHT)
        # The side gap is the only one.
        assert 1.2 < path.points[np.abs(path.points[:, 0]).argmin(), 1] < 1.8
    assert "roadmap of" in path.why


def test_later_queries_check_fewer_edges_and_add_no_nodes(planner: Planner) -> None:
    place(planner, NARROWED)
    plan(planner)
    roadmap = require_roadmap(planner)
    first, nodes = roadmap.edges_checked, len(roadmap)
    for _ in range(2):
        again = plan(planner)
    assert_certain(planner, again, LEFT, RIGHT)
    assert require_roadmap(planner) is roadmap
    assert roadmap.edges_checked < first / 4
    assert (len(roadmap), roadmap.nodes_checked, again.iterations) == (nodes, 0, 0)


def test_placing_the_same_keeps_validity_and_moving_forgets_it(planner: Planner) -> None:
    start = [-1.0, -1.0]
    assert_certain(planner, plan(planner, start), start, RIGHT)
    roadmap, nodes = require_roadmap(planner), len(require_roadmap(planner))
    version = planner.checker.version
    place(planner, OPEN)
    assert planner.checker.version == version
    place(planner, NARROWED)
    assert planner.checker.version != version
    assert_certain(planner, plan(planner, start), start, RIGHT)
    place(planner, CLOSED)
    closed = plan(planner, start, seconds=0.05)
    assert not closed
    assert closed.points[:, 0].max() < 0.0
    assert "nearest pair" in closed.why
    place(planner, OPEN)
    assert_certain(planner, plan(planner, start), start, RIGHT)
    assert require_roadmap(planner) is roadmap
    assert len(roadmap) > nodes


def test_known_validity_equals_that_of_the_checker_at_each_place(planner: Planner) -> None:
    generator = np.random.default_rng(0)
    for k in range(60):
        place(planner, (OPEN, NARROWED, (1.0, 0.0))[k % 3])
        ends = generator.uniform(-1.9, 1.9, (2, 2))
        if planner.valid(ends).all():
            assert_certain(planner, plan(planner, *ends, seed=k), *ends)


def test_equal_queries_lead_to_equal_paths(model: kv.Model) -> None:
    runs = []
    for seeds in ((3, 4), (3, 4), (5, 6)):
        planner = Planner(model, ["x", "y"])
        place(planner, NARROWED)
        runs.append([plan(planner, seed=seeds[0]).points, plan(planner, [-1, 1], seed=seeds[1]).points])
    assert all(np.array_equal(a, b) for a, b in zip(runs[0], runs[1], strict=True))
    assert not np.array_equal(runs[0][0], runs[2][0])


def test_an_enclosed_goal_is_a_reason_with_the_best_partial_path(planner: Planner) -> None:
    place(planner, CLOSED)
    path = plan(planner, [-1.5, -1.5], seconds=0.1)
    assert not path.found
    assert "The time of 0.1 s is up" in path.why
    np.testing.assert_allclose(path.points[0], [-1.5, -1.5])
    # The ball cannot come nearer to the goal than the wall.
    assert np.linalg.norm(path.points[-1] - RIGHT) < np.linalg.norm(path.points[0] - RIGHT)


def test_the_nearest_of_several_goals_is_reached(planner: Planner) -> None:
    place(planner, NARROWED)
    assert_certain(planner, plan(planner, LEFT, [[1.0, 0.0], [-1.0, -1.9]]), LEFT, [-1.0, -1.9])


def test_memory_is_bounded_and_a_full_roadmap_says_so(planner: Planner) -> None:
    place(planner, CLOSED)
    planner.roadmap = roadmap = Roadmap(planner.symbols, planner.space.turning, nodes=256)
    path = plan(planner)
    assert not path
    assert path.why.startswith("The search ended")
    assert len(roadmap) <= 256
    place(planner, NARROWED)
    for end in np.random.default_rng(0).uniform(-1.5, 1.5, (200, 2)):
        if planner.valid(end)[0]:
            assert plan(planner, LEFT, end)
    assert 100 < len(roadmap) <= 256


def test_a_joint_without_limits_turns_the_short_way() -> None:
    turn, radius = kv.position("turn"), kv.position("radius")
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("ball", "world", kv.rotation_z(turn) @ kv.translation(radius, 0, 0), BALL)
        edit.add_frame("pillar", "world", kv.translation(-1, 0, 0), box(0.6, 0.1, 0.5))
        edit.constrain("radius/range", 0.5, radius, 2)
    planner = Planner(model, ["turn", "radius"])
    for turns in (0, 1, -2):
        start = [2.9 + turns * math.tau, 1.0]
        path = plan(planner, start, [-2.9, 1.0])
        assert_certain(planner, path, start, [math.tau * (1 + turns) - 2.9, 1.0])
        assert np.abs(np.diff(path.points[:, 0])).sum() < 1.5
    assert len(require_roadmap(planner)) < 400


def test_unknown_methods_and_holds_are_refused(planner: Planner) -> None:
    with pytest.raises(InvalidValueError, match="'rrt-connect', 'prm'"):
        plan(planner, method="prm*")
    with pytest.raises(InvalidValueError, match="method='rrt-connect'"):
        plan(planner, along=Hold(kv.position("x") - kv.position("y"), 0.0))
    with pytest.raises(InvalidValueError, match="at most 64"):
        Roadmap(planner.symbols, planner.space.turning, degree=65)
