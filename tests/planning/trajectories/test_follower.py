"""From a model to a motion: limits of its coordinates, and a controller that follows."""

from __future__ import annotations

import numpy as np
import pytest

import kineverse as kv
from kineverse.errors import InvalidValueError, UnknownNameError
from kineverse.planning import Trajectory, TrajectoryFollower, motion_limits, time_parameterize

NAMES = ("base/x", "base/y", "arm_lift_joint", "arm_flex_joint", "arm_roll_joint", "wrist_flex_joint")


@pytest.fixture(scope="module")
def hsr() -> kv.Model:
    return kv.load("hsr")


@pytest.fixture(scope="module")
def columns(hsr: kv.Model) -> list[kv.Symbol]:
    return [hsr.symbol(f"hsr/{name}") for name in NAMES]


def test_limits_are_those_of_the_model(hsr: kv.Model, columns: list[kv.Symbol]) -> None:
    velocity, acceleration = motion_limits(hsr, columns)
    np.testing.assert_allclose(velocity[2:], [0.2, 1.2, 2.0, 1.5])
    np.testing.assert_allclose(acceleration, velocity / 0.5)
    # Both speeds of the base together are within the limit of their norm.
    assert 0.9 < np.hypot(*velocity[:2]) <= 1.0
    assert motion_limits(hsr, columns[:1]).velocity[0] == pytest.approx(1.0, rel=0.05)


def test_stated_accelerations_and_coupled_speeds_count() -> None:
    model = kv.Model()
    a, b, c = (kv.position(name) for name in "abc")
    with model.edit() as edit:
        edit.add_frame("f", parent="world", transform=kv.translation(a, b, c))
        edit.constrain("a/speed", -2, kv.velocity("a"), 3)
        edit.constrain("a/acceleration", -5, kv.velocity("a").derivative(), 4)
        edit.constrain("sum", -1, kv.velocity("b") - 2 * kv.velocity("c"), 1)
    velocity, acceleration = motion_limits(model, [a, b, c], ramp=0.1)
    np.testing.assert_allclose(velocity, [2, 0.5, 0.25])
    np.testing.assert_allclose(acceleration, [4, 5, 2.5])
    np.testing.assert_allclose(motion_limits(model, [b]).velocity, 1)


def test_coordinates_without_limits_have_a_given_speed() -> None:
    model = kv.load("fetch")
    x = model.symbol("fetch/base/x")
    np.testing.assert_allclose(motion_limits(model, [x], speed=0.3), [[0.3], [0.6]])
    with pytest.raises(UnknownNameError, match="no coordinate 'y'"):
        motion_limits(model, [kv.position("y")])
    for options in ({"ramp": 0.0}, {"speed": -1.0}, {"ramp": np.inf}):
        with pytest.raises(InvalidValueError, match="positive number"):
            motion_limits(model, [x], **options)


def test_a_controller_follows_a_trajectory(hsr: kv.Model, columns: list[kv.Symbol]) -> None:
    state = hsr.default_state()
    points = state.vector(columns) + np.array(
        [[0, 0, 0, 0, 0, 0], [0.4, 0.3, 0.2, -0.8, 0.5, -0.5], [0.9, 0, 0.3, -1.5, 1.2, -0.2]]
    )
    trajectory = time_parameterize(points, *motion_limits(hsr, columns), columns, deviation=0.05)
    assert 2.0 < trajectory.duration < 4.0
    follower = TrajectoryFollower(trajectory)
    controller = kv.control.Controller(hsr, follower.tasks, dt=0.02)
    errors = []
    for step in range(int(trajectory.duration / controller.dt) + 5):
        follower.set(controller, step * controller.dt)
        command = controller.step(state)
        state = hsr.integrate(state, command.speeds, controller.dt)
        errors.append(
            np.abs(state.vector(columns) - trajectory.positions_at((step + 1) * controller.dt)).max()
        )
    assert max(errors) < 1e-4
    assert not hsr.violations(state, 1e-6)

    back = trajectory.reversed()
    follower.trajectory = back
    follower.set(controller, 1.0)
    assert follower.trajectory is back
    with pytest.raises(InvalidValueError, match="has the same"):
        follower.trajectory = Trajectory(columns[:1], [0], [[0]], [[0]])  # type: ignore[arg-type]
