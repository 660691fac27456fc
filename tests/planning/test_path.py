"""Paths with times: trajectories that are free, limits, holds, and errors."""

import importlib.util
from dataclasses import replace

import numpy as np
import pytest

import kineverse as kv
from arm_and_box import ARM, INSIDE, LEFT, MOVING, RIGHT
from kineverse.compilation.toolchain import toolchain
from kineverse.errors import FormatError, InvalidValueError, ShapeError
from kineverse.planning import Planner, Trajectory, motion_limits
from kineverse.planning.path_rounding import PathSection

pytestmark = [
    pytest.mark.skipif(toolchain() is None, reason="planning needs a C compiler"),
    pytest.mark.skipif(importlib.util.find_spec("coal") is None, reason="distances need coal"),
]


@pytest.fixture(scope="module")
def model():
    return kv.load(ARM)


@pytest.fixture(scope="module")
def planner(model):
    return Planner(model, MOVING)


@pytest.fixture(scope="module")
def path(planner):
    return planner.plan(LEFT, RIGHT)


@pytest.fixture(scope="module")
def opening(model):
    """Hold of the knob, and a path along it that opens the door."""
    planner = Planner(model, [*MOVING, "hinge"])
    hold = planner.hold("tip", "knob", "xy")
    found = planner.solutions(hold, 32, seconds=0.1)
    start, *goals = found[np.argsort(found[:, 3])]
    return hold, planner.plan(start, goals[-8:], along=hold)


def _clearance(planner, points):
    values = []
    for q in points:
        planner.scene.update(planner.model.default_state().updated(dict(zip(MOVING, q, strict=True))))
        found = planner.scene.pairs_within(0.05)
        values.append(found[0].distance if len(found) else 0.05)
    return min(values)


def test_trajectory_stays_free_and_within_the_limits_from_rest_to_rest(planner, model, path):
    assert path.found
    trajectory = path.trajectory()
    times = np.linspace(0.0, trajectory.duration, 2000)
    assert _clearance(planner, trajectory.positions_at(times)) > 0
    limits, speeds = motion_limits(model, path.symbols), trajectory.velocities_at(times)
    assert (np.abs(speeds) <= limits.velocity * (1 + 1e-6)).all()
    assert (np.abs(np.diff(speeds, axis=0) / np.diff(times)[:, None]) <= limits.acceleration * 1.01).all()
    assert not trajectory.velocities[[0, -1]].any()
    assert np.allclose(trajectory.positions[[0, -1]], path.points[[0, -1]])


def test_corners_are_rounded_as_far_as_they_may(path):
    stops = path.trajectory(deviation=0.0)
    near, far = path.trajectory(deviation=0.01), path.trajectory()
    assert far.duration < near.duration < stops.duration
    for trajectory, allowed in ((near, 0.01), (far, 0.1)):
        samples = trajectory.positions_at(np.linspace(0.0, trajectory.duration, 4000))
        gaps = np.linalg.norm(samples[:, None] - path.points, axis=-1).min(axis=0)
        assert (gaps <= allowed + 1e-3).all()


def test_times_are_those_of_the_points(path):
    assert path.times.shape == (len(path),)
    assert (np.diff(path.times) > 0).all()
    trajectory = path.trajectory()
    assert (path.times[0], path.times[-1]) == (0.0, trajectory.duration)
    samples = trajectory.positions_at(np.linspace(0.0, trajectory.duration, 4000))
    nearest = np.linalg.norm(samples[:, None] - path.points, axis=-1).min(axis=0)
    gaps = np.linalg.norm(trajectory.positions_at(path.times) - path.points, axis=1)
    assert (gaps <= nearest + 2e-3).all()


def test_limits_may_be_given(path):
    slow = path.trajectory(velocity=0.5, acceleration=[1.0, 1.0, 1.0])
    assert np.abs(slow.velocities).max() <= 0.5 * (1 + 1e-9)
    assert slow.duration > path.trajectory(ramp=0.1).duration
    # A number is no leave to go faster than the model may.
    assert path.trajectory(velocity=50.0).duration == path.trajectory().duration
    assert path.trajectory(velocity=[50.0] * 3, acceleration=500.0).duration <= path.trajectory().duration


def test_trajectory_is_that_of_the_place_where_it_was_planned(planner, path):
    before, valid = path.trajectory(), planner.valid([LEFT, INSIDE, [0.5, 1.0, 0.0]])
    planner.place({"hinge": 0.8})
    try:
        assert path.trajectory() == before
        assert path.clearance() > 0
    finally:
        planner.place({"hinge": 0.0})
    assert (planner.valid([LEFT, INSIDE, [0.5, 1.0, 0.0]]) == valid).all()


def test_saved_trajectory_is_read_again(path, model, tmp_path):
    path.save(tmp_path / "path.json")
    assert Trajectory.load(tmp_path / "path.json", model) == path.trajectory()
    with pytest.raises(FormatError):
        path.save(tmp_path / "none" / "path.json")


def test_motion_along_a_hold_keeps_it_and_does_not_stop(opening):
    hold, path = opening
    assert path.found
    trajectory = path.trajectory()
    assert len(path) > 20
    times = np.linspace(0.0, trajectory.duration, 500)
    assert np.abs(kv.compile(hold.error, path.symbols).batch(trajectory.positions_at(times))).max() <= 1e-5
    assert np.linalg.norm(trajectory.velocities[1:-1], axis=1).min() > 1e-3
    assert (np.diff(path.times) >= 0).all()


def test_motion_rests_between_sections(path):
    k = len(path) // 2
    ends = ((0, k), (k, len(path) - 1))
    parts = replace(path, sections=tuple(PathSection(i, j, path.checks) for i, j in ends))
    trajectory = parts.trajectory()
    assert parts.times[-1] == pytest.approx(trajectory.duration)
    assert np.allclose(trajectory.positions_at(parts.times[k]), path.points[k])
    assert np.allclose(trajectory.velocities_at(parts.times[k]), 0.0)


def test_time_that_is_left_shortens_the_path(planner, path):
    best = planner.plan(LEFT, RIGHT, seconds=0.1, optimize=True)
    assert best.found
    assert best.length < 0.99 * path.length
    assert _clearance(planner, best.points) > 0.0


def test_path_that_was_not_found_has_no_trajectory(planner, tmp_path):
    path = planner.plan(INSIDE, RIGHT)
    assert not path.found
    for use in (path.trajectory, lambda: path.times, lambda: path.save(tmp_path / "a.json")):
        with pytest.raises(InvalidValueError, match=r"no path to move along.*'hand' and 'box'"):
            use()


def test_wrong_limits_are_refused(path):
    with pytest.raises(ShapeError, match="3 numbers"):
        path.trajectory(velocity=[1.0, 2.0])
    with pytest.raises(InvalidValueError, match="positive"):
        path.trajectory(velocity=0.0)
    with pytest.raises(InvalidValueError, match="ramp="):
        path.trajectory(ramp=0.0)
    with pytest.raises(InvalidValueError, match="deviation="):
        path.trajectory(deviation=-1.0)


def test_edited_model_needs_another_plan(path, monkeypatch):
    monkeypatch.setattr(path.checks, "_version", -1)
    for question in (path.trajectory, lambda: replace(path).clearance()):
        with pytest.raises(InvalidValueError, match="Plan it again"):
            question()


def test_start_that_is_its_goal_takes_no_time(planner):
    path = planner.plan(LEFT, LEFT)
    assert path.trajectory().duration == 0.0
    assert not path.times.any()


@pytest.mark.parametrize(
    ("start", "goals", "options", "message"),
    [
        ([LEFT, RIGHT], RIGHT, {}, "start has 2 configurations"),
        ([1.0, 0.0], RIGHT, {}, "start has shape"),
        ("home", RIGHT, {}, "start is 'home'"),
        ([np.nan, 0.0, 0.0], RIGHT, {}, "not finite"),
        (LEFT, [], {}, "goals has shape"),
        (LEFT, [LEFT, [1.0]], {}, "goals is"),
        (LEFT, RIGHT, {"seconds": np.nan}, "seconds="),
        (LEFT, RIGHT, {"seconds": -1.0}, "seconds="),
        (LEFT, RIGHT, {"seed": -1}, "seed="),
        (LEFT, RIGHT, {"modes": (), "optimize": True}, "optimize="),
    ],
)
def test_wrong_questions_are_refused(planner, start, goals, options, message):
    with pytest.raises((InvalidValueError, ShapeError), match=message):
        planner.plan(start, goals, **options)


def test_reasons_say_what_is_in_the_way(planner):
    assert "is in collision: 'hand' and 'box' (130.0 mm deep)" in planner.plan(LEFT, INSIDE).why
    assert "'j0' is 4, and its range is -3 to 3" in planner.plan([4.0, 0.0, 0.0], LEFT).why
    short = planner.plan(LEFT, RIGHT, seconds=0.0)
    assert "The time of 0 s is up" in short.why
    assert "cannot be left" not in short.why


def test_bodies_without_shapes_need_no_planner(tmp_path):
    joint = '<joint name="j" type="continuous"><parent link="a"/><child link="b"/></joint>'
    (tmp_path / "bare.urdf").write_text(f'<robot name="r"><link name="a"/><link name="b"/>{joint}</robot>')
    with pytest.raises(InvalidValueError, match="No body of the model has a shape"):
        Planner(kv.load(tmp_path / "bare.urdf"))
