"""Inverse kinematics: laws of its solutions, checked by forward kinematics and by all constraints."""

from __future__ import annotations

import importlib.util
import math

import numpy as np
import pytest
from control_models import garage, planar_arm

import kineverse as kv
from kineverse.control import (
    Goal,
    Hold,
    InverseKinematics,
    Keep,
    Target,
    inverse_kinematics,
    same_pose,
    same_position,
)
from kineverse.errors import (
    DuplicateNameError,
    ExpressionError,
    InvalidValueError,
    NotFiniteError,
    ShapeError,
    UnknownNameError,
)
from kineverse.formats.locate import locate_model
from kineverse.model.body import Body, Box, Pose, Shape

TOLERANCE = 1e-5


def pose_target(name: str) -> Target:
    return Target(name, np.eye(4))


def random_state(model: kv.Model, generator: np.random.Generator, spread: float = 1.0) -> kv.State:
    """Return a uniform state within limits; where there are none, within ±spread."""
    values = {}
    for s in model.degrees_of_freedom:
        low, high = model.limits(s)
        values[s] = generator.uniform(
            max(low, -spread) if low > -9 else -spread, high if high < 9 else spread
        )
    return model.default_state() | values


def is_valid(model: kv.Model, result, error: kv.expressions.Expression, values=()) -> bool:
    """Return whether a result satisfies tasks and model, independently of the solver."""
    state = result.best | kv.State(dict(values))
    return bool(np.abs(error(state)).max() <= TOLERANCE) and not model.violations(result.best)


@pytest.mark.sampled(3)
@pytest.mark.parametrize(
    ("name", "frames"),
    [
        ("pr2", ("pr2/l_gripper_tool_frame", "pr2/r_gripper_tool_frame")),
        ("fetch", ("fetch/gripper_link",)),
        ("hsr", ("hsr/hand_palm_link",)),
    ],
)
def test_robots_with_bases_reach_the_poses_of_random_states(name: str, frames: tuple[str, ...]) -> None:
    """A differential drive stands anywhere: rolling does not restrict a configuration."""
    model, generator = kv.load(name), np.random.default_rng(1)
    targets = [pose_target(f"target{k}") for k in range(len(frames))]
    errors = [same_pose(model.fk(f), t.expression) for f, t in zip(frames, targets, strict=True)]
    solver = InverseKinematics(model, [Goal(e) for e in errors])
    assert {f"{name}/base/{c}" for c in ("x", "y", "angle")} <= set(map(str, solver.coordinates))
    for _ in range(8):
        state = random_state(model, generator)
        values = {
            s: v
            for f, t in zip(frames, targets, strict=True)
            for s, v in t.values(model.fk(f)(state)).items()
        }
        result = solver.solve(values)
        assert result.solved, result.why
        assert all(is_valid(model, result, e, values) for e in errors)
        assert set(model.symbols) <= set(result.best)


def test_solution_without_motion_is_the_given_state() -> None:
    model = planar_arm()
    state = model.default_state().updated({"joint1": 0.3, "joint2": -0.4})
    result = inverse_kinematics(
        model, [Goal(same_pose(model.fk("tip"), model.fk("tip")(state)))], values=state
    )
    assert result.solved
    assert dict(result.best) == pytest.approx(dict(state), abs=1e-9)
    assert (result.starts, result.why) == (1, "All tasks are done, after 1 starts.")


def test_solutions_are_different_and_the_nearest_is_first() -> None:
    """An arm of two links has two: elbow up and elbow down."""
    model = planar_arm(2)
    start = model.default_state().updated({"joint1": 0.2, "joint2": 0.9})
    tip = model.fk("tip")[:2, 3]
    result = inverse_kinematics(model, [Goal(tip, tip(start) + 0.05)], values=start, solutions=5, starts=30)
    assert len(result.solutions) == 2
    distances = [
        np.linalg.norm(s.vector(model.symbols) - start.vector(model.symbols)) for s in result.solutions
    ]
    assert distances[0] < 0.5 < distances[1]
    assert result.best == result.solutions[0]
    for solution in result.solutions:
        assert np.allclose(tip(solution), tip(start) + 0.05, atol=TOLERANCE)


def test_still_coordinates_and_what_no_task_moves_keep_their_values() -> None:
    model = planar_arm(4)
    state = model.default_state().updated({"joint1": 0.7, "joint4": -0.2})
    point = model.fk("link4")[:2, 3]
    result = inverse_kinematics(model, [Goal(point, [1.5, 1.5])], values=state, fixed=["joint1"])
    assert result.solved
    assert (result.best["joint1"], result.best["joint4"]) == (0.7, -0.2)


def test_holds_keeps_and_limits_are_satisfied_where_goals_are_out_of_reach() -> None:
    model = planar_arm(3)
    tip = model.fk("tip")
    tasks = [
        Goal(tip[:2, 3], [9.0, 1.0], name="far"),
        Hold(model.symbol("joint1") + model.symbol("joint2"), 0.5, name="coupled"),
        Keep(-9.0, tip[0, 3], 1.6, name="wall"),
    ]
    result = inverse_kinematics(model, tasks)
    assert not result.solved
    assert result.residuals["coupled"] <= 1e-9
    assert float(tip[0, 3](result.best)) <= 1.6 + 1e-9
    assert not model.violations(result.best)
    assert "wall" in result.active
    assert "'far' is off by" in result.why
    assert "wall" in result.why


def test_keep_is_a_row() -> None:
    model = planar_arm(3)
    tip = model.fk("tip")
    keep = Keep(0.5, model.symbol("joint2"), 0.7, name="elbow")
    result = inverse_kinematics(model, [Goal(tip[:2, 3], [1.4, 1.2]), keep])
    assert result.solved
    assert 0.5 - 1e-9 <= result.best["joint2"] <= 0.7 + 1e-9
    assert np.allclose(tip[:2, 3](result.best), [1.4, 1.2], atol=TOLERANCE)
    equal = inverse_kinematics(model, [Goal(tip[:2, 3], [1.4, 1.2]), Keep(0.6, model.symbol("joint2"), 0.6)])
    assert equal.best["joint2"] == pytest.approx(0.6, abs=1e-9)


@pytest.mark.parametrize("distance", [3.5, 5.0, 50.0])
def test_unreachable_point_ends_with_a_stretched_arm(distance: float) -> None:
    model, direction = planar_arm(3), np.array([math.cos(0.4), math.sin(0.4)])
    start = {"joint1": -0.5, "joint2": 0.9, "joint3": -1.0}
    result = inverse_kinematics(model, [Goal(model.fk("tip")[:2, 3], distance * direction)], values=start)
    assert not result.solved
    assert result.solutions == ()
    assert result.residuals["goal 1"] == pytest.approx(distance - 3.0, rel=1e-5)
    assert "out of reach" in result.why
    assert "out of reach" not in repr(result)


@pytest.mark.parametrize("distance", [40.0, 1e3, 1e5])
def test_base_travels_to_distant_targets(distance: float) -> None:
    model = kv.load("articulations/omni_base")
    base = model.fk("omni_base/base")
    pose = kv.translation(distance, -0.5 * distance, 0) @ kv.rotation_z(2.0)
    result = inverse_kinematics(model, [Goal(same_pose(pose, base))])
    assert result.solved
    assert result.starts == 1
    assert np.allclose(base(result.best), np.array(pose()), atol=TOLERANCE)


@pytest.mark.parametrize("weight", [1e-8, 1e-6, 1.0, 1e6])
def test_goal_without_error_is_solved_whatever_its_weight(weight: float) -> None:
    model = planar_arm(3)
    goal = Goal(model.fk("tip")[:2, 3], [1.4, 1.2], name="reach", weight=weight)
    result = inverse_kinematics(model, [goal])
    assert result.solved == (result.residuals["reach"] <= TOLERANCE)
    assert result.solved or result.why


def test_errors_of_any_size_are_finite() -> None:
    model = planar_arm(2)
    result = inverse_kinematics(model, [Goal(model.fk("tip")[:2, 3], [1e200, 0.0], name="reach")])
    assert not result.solved
    assert result.residuals["reach"] == pytest.approx(1e200)


def test_goal_outside_of_the_limits_of_a_joint_names_the_limit() -> None:
    model = planar_arm(2)
    result = inverse_kinematics(model, [Goal(model.symbol("joint1"), 3.0)])
    assert not result.solved
    assert result.best["joint1"] == 2.0
    assert result.active == ("joint1/position",)
    assert "joint1/position" in result.why


def test_contradictory_holds_are_named() -> None:
    model = planar_arm(2)
    tasks = [Hold(model.symbol("joint1"), 0.5, name="one"), Hold(model.symbol("joint1"), -0.5, name="other")]
    result = inverse_kinematics(model, tasks)
    assert not result.solved
    assert result.residuals == {"one": pytest.approx(0.5), "other": pytest.approx(0.5)}
    assert "'one'" in result.why
    assert "contradict each other" in result.why


def test_goal_that_is_impossible_alone_is_named() -> None:
    model = planar_arm(2)
    tasks = [Goal(model.symbol("joint1"), 5.0, name="far"), Goal(model.fk("tip")[0, 3], 9.0, name="reach")]
    assert "Not even alone can 'far', 'reach' be done." in inverse_kinematics(model, tasks).why


def test_range_that_is_impossible_is_named_and_no_other_task() -> None:
    model = planar_arm(2)
    x, y = model.fk("tip")[:2, 3]
    result = inverse_kinematics(model, [Goal(y, 1.0, name="height"), Keep(5, x, 6, name="wall")])
    assert not result.solved
    assert "within the range of 'wall'" in result.why
    assert "alone" not in result.why


def test_start_outside_of_limits_is_allowed() -> None:
    model = planar_arm(3)
    result = inverse_kinematics(
        model, [Goal(model.fk("tip")[:2, 3], [0.5, 1.5])], values={"joint1": 40.0, "joint2": -7.0}
    )
    assert result.solved
    assert not model.violations(result.best)


def test_parameters_are_values_and_a_batch_is_its_parts() -> None:
    model, point = planar_arm(3), Target("point", [1.0, 0.0])
    weight = kv.parameter("weight", 1.0)
    solver = InverseKinematics(
        model,
        [Goal(model.fk("tip")[:2, 3], point.expression), Goal(model.symbol("joint1"), 5.0, weight=weight)],
    )
    assert not solver.solve().solved
    values = [{weight: 0.0, **point.values([x, 1.0])} for x in (0.5, 1.0, 9.0)]
    results = solver.batch(values)
    assert [r.solved for r in results] == [True, True, False]
    for value, result in zip(values, results, strict=True):
        assert dict(solver.solve(value).best) == dict(result.best)
        assert result.best["weight"] == 0.0


def test_same_seed_is_the_same_solution() -> None:
    model = kv.load("fetch")
    hand = model.fk("fetch/gripper_link")
    target = hand(random_state(model, np.random.default_rng(8)))
    solver = InverseKinematics(model, [Goal(same_pose(hand, target))], fixed=["fetch/base"])
    one, two = (solver.solve(seed=4, solutions=3) for _ in range(2))
    assert one.solutions == two.solutions
    assert not set(map(str, solver.coordinates)) & {"fetch/base/x", "fetch/base/angle"}


def test_turning_joints_end_within_their_limits() -> None:
    """A joint that turns more than once is searched without limits."""
    model = kv.Model()
    with model.edit() as edit:
        for k, (lower, upper) in enumerate([(-7.0, 1.0), (2.0, 9.0)]):
            edit.apply(
                kv.Revolute(
                    name=f"joint{k}",
                    parent=f"link{k}" if k else "world",
                    child=f"link{k + 1}",
                    origin=kv.translation(float(k), 0, 0),
                    axis=(0, 0, 1),
                    lower=lower,
                    upper=upper,
                )
            )
        edit.add_frame("tip", parent="link2", transform=kv.translation(1, 0, 0))
    tip = model.fk("tip")
    for angle in np.linspace(-3.0, 3.0, 13):
        target = [math.cos(angle) + math.cos(angle + 2.5), math.sin(angle) + math.sin(angle + 2.5)]
        result = inverse_kinematics(model, [Goal(tip[:2, 3], target)], starts=4)
        assert result.solved
        assert not model.violations(result.best)
        assert np.allclose(tip[:2, 3](result.best), target, atol=TOLERANCE)


# -- bases and loops -------------------------------------------------------------------------------------------


def test_floating_base_keeps_its_quaternion_of_unit_length() -> None:
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Floating(name="base", parent="world", child="base"))
        edit.apply(kv.Revolute(name="arm", parent="base", child="arm", axis=(0, 0, 1), lower=-1, upper=1))
        edit.add_frame("tip", parent="arm", transform=kv.translation(1, 0, 0))
    generator, target = np.random.default_rng(2), pose_target("target")
    solver = InverseKinematics(model, [Goal(same_pose(model.fk("tip"), target.expression))])
    for _ in range(10):
        q = generator.standard_normal(4)
        q /= np.linalg.norm(q)
        place = np.eye(4)
        place[:3, :3], place[:3, 3] = kv.quaternion(*q)[:3, :3]({}), generator.uniform(-3, 3, 3)
        result = solver.solve(target.values(place))
        assert result.solved
        assert sum(result.best[f"base/q{c}"] ** 2 for c in "xyzw") == pytest.approx(1.0, abs=1e-12)
        assert np.allclose(model.fk("tip")(result.best), place, atol=1e-5)


def test_loop_that_is_solved() -> None:
    model = kv.load("articulations/four_bar")
    rocker, place = model.fk("four_bar/rocker_end"), pose_target("place")
    solver = InverseKinematics(model, [Goal(same_pose(rocker, place.expression))])
    for crank in np.random.default_rng(5).uniform(-3, 3, 6):
        target = rocker({"four_bar/crank": float(crank)})
        result = solver.solve(place.values(target))
        assert result.solved
        assert [str(s) for s in result.best if s.role == "dof"] == ["four_bar/crank"]
        assert np.allclose(rocker(result.best), target, atol=1e-4)


def test_loop_kept_as_a_constraint_is_closed() -> None:
    model = planar_arm(4)
    with model.edit() as edit:
        tip = model.fk("tip")[:2, 3]
        edit.constrain("closure/x", 2.0, tip[0], 2.0)
        edit.constrain("closure/y", 1.0, tip[1], 1.0)
    elbow = model.fk("link3")[:2, 3]
    result = inverse_kinematics(model, [Goal(elbow, [0.5, 1.5])])
    assert result.solved
    assert len(result.best) == 4
    assert not model.violations(result.best)
    far = inverse_kinematics(model, [Goal(elbow, [-4.0, 0.0])])
    assert not far.solved
    assert not model.violations(far.best)


def test_start_that_leaves_the_domain_of_a_loop_is_halved() -> None:
    """An expression that is defined up to a = 1 only, with its target near the end."""
    model, a = kv.Model(), kv.position("a")
    with model.edit() as edit:
        edit.add_frame("f", parent="world", transform=kv.translation(np.sqrt(1 - a * a), 0, 0))
        edit.constrain("a/range", -3, a, 3)
    result = inverse_kinematics(model, [Goal(model.fk("f")[0, 3], 0.02)], values={"a": 0.1})
    assert result.solved
    assert result.best["a"] ** 2 == pytest.approx(1 - 0.02**2, abs=1e-4)


def test_singular_pose_of_the_garage_door() -> None:
    model = garage()
    pose = model.fk("door")
    closed = inverse_kinematics(model, [Goal(same_position(pose, np.eye(4)))])
    assert closed.residuals["goal 1"] <= TOLERANCE
    for start in (2.0, 0.0, 1.0):
        result = inverse_kinematics(model, [Goal(pose[2, 3], 1.25)], values={"door": start})
        assert result.solved
        assert result.best["door"] == pytest.approx(0.75, abs=TOLERANCE)
        turned = inverse_kinematics(model, [Goal(pose[:3, 0], [1.0, 0, 0])], values={"door": start})
        assert all(math.isfinite(v) for v in turned.best.values())


# -- collisions ------------------------------------------------------------------------------------------------


def box(size: tuple[float, float, float], at: float = 0.0) -> Body:
    return Body(collisions=(Shape(Box(size), Pose.from_matrix(np.array(kv.translation(at, 0, 0)()))),))


def arm_with_obstacle(x: float, y: float) -> kv.Model:
    model = planar_arm(2)
    with model.edit() as edit:
        for link in ("link1", "link2"):
            edit.add_frame(f"{link}/body", link, np.eye(4), box((0.8, 0.04, 0.04), at=0.5))
        edit.add_frame("obstacle", "world", kv.translation(x, y, 0), box((0.2, 0.2, 0.2)))
    return model


@pytest.mark.skipif(importlib.util.find_spec("coal") is None, reason="distances need coal")
def test_collisions_are_avoided_and_named() -> None:
    from kineverse.geometry import Scene

    elbow_up = {"joint1": 0.9, "joint2": -1.2}
    model = arm_with_obstacle(1.0, 0.8)
    scene, tip = Scene(model), model.fk("tip")[:2, 3]
    target = tip(elbow_up)
    free = inverse_kinematics(model, [Goal(tip, target)], values=elbow_up)
    scene.update(free.best)
    assert scene.in_collision
    result = inverse_kinematics(model, [Goal(tip, target)], values=elbow_up, scene=scene, margin=0.01)
    assert result.solved, result.why
    scene.update(result.best)
    assert not scene.pairs_within(0.01 - 1e-9)
    assert np.allclose(tip(result.best), target, atol=TOLERANCE)
    blocked = inverse_kinematics(model, [Goal(tip, [1.0, 0.8])], scene=scene)
    assert not blocked.solved
    assert "link2/body and obstacle" in blocked.why or "obstacle and link2/body" in blocked.why
    scene.update(blocked.best)
    assert not scene.in_collision


@pytest.mark.skipif(importlib.util.find_spec("coal") is None, reason="distances need coal")
def test_scene_of_another_model_and_a_margin_below_0_are_refused() -> None:
    from kineverse.geometry import Scene

    model = arm_with_obstacle(1.0, 0.8)
    with pytest.raises(UnknownNameError, match=r"scene= is the scene of a model without 'joint1'"):
        solve(model, scene=Scene(kv.load("articulations/omni_base")))
    with pytest.raises(InvalidValueError, match="The margin"):
        solve(model, scene=Scene(model), margin=-0.1)


# -- bad input -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("build", "error", "message"),
    [
        (lambda m: inverse_kinematics(m, []), InvalidValueError, "Without a task"),
        (lambda m: inverse_kinematics(m, [3]), ExpressionError, "Goal, a Hold or a Keep"),
        (lambda m: inverse_kinematics(m, [Keep(0, m.symbol("joint1"), 1)]), InvalidValueError, "no goal"),
        (lambda m: inverse_kinematics(m, [Goal(kv.position("jiont1"))]), UnknownNameError, "joint1"),
        (
            lambda m: inverse_kinematics(m, [Goal(m.symbol("joint1").derivative())]),
            InvalidValueError,
            "speeds",
        ),
        (
            lambda m: inverse_kinematics(
                m, [Goal(m.symbol("joint1")), Keep(-1, m.symbol("joint1").derivative(), 1)]
            ),
            InvalidValueError,
            "speeds",
        ),
        (lambda m: solve(m, fixed=["jiont1"]), UnknownNameError, "joint1"),
        (lambda m: solve(m, fixed=[3]), ExpressionError, "fixed"),
        (lambda m: solve(m, fixed=["joint1"]), InvalidValueError, "fixed= keeps in place"),
        (lambda m: solve(m, values={"jiont1": 0.0}), UnknownNameError, "joint1"),
        (lambda m: solve(m, values={"joint1": math.inf}), NotFiniteError, "joint1"),
        (lambda m: solve(m, values={"joint1": math.nan}), InvalidValueError, "joint1"),
        (lambda m: solve(m, starts=0), InvalidValueError, "starts"),
        (lambda m: solve(m, starts=True), InvalidValueError, "starts"),
        (lambda m: solve(m, seed=-1), InvalidValueError, "seed"),
        (lambda m: solve(m, seed=None), InvalidValueError, "seed"),
        (lambda m: solve(m, solutions=0.5), InvalidValueError, "solutions"),
        (lambda m: solve(m, tolerance=-1.0), InvalidValueError, "tolerance"),
        (lambda m: inverse_kinematics(m, [Goal(m.fk("tip"), np.eye(4))]), ShapeError, "same_pose"),
        (
            lambda m: inverse_kinematics(m, [Goal(same_position(m.fk("rack"), np.eye(4)))]),
            InvalidValueError,
            "nothing that moves",
        ),
        (
            lambda m: inverse_kinematics(
                m, [Goal(m.symbol("joint1"), name="a"), Hold(m.symbol("joint2"), name="a")]
            ),
            DuplicateNameError,
            "'a'",
        ),
    ],
)
def test_wrong_input_is_refused(build, error, message) -> None:
    model = planar_arm(2)
    with model.edit() as edit:
        edit.add_frame("rack", parent="world", transform=kv.translation(1, 2, 3))
    with pytest.raises(error, match=message):
        build(model)


@pytest.mark.parametrize("matrix", [np.diag([1.0, 1.0, -1.0, 1.0]), 2 * np.eye(4), np.ones((4, 4))])
def test_target_that_is_no_transform_is_refused(matrix) -> None:
    with pytest.raises(InvalidValueError, match="transform"):
        Target("pose", matrix)


def test_target_takes_constant_expressions_and_no_other() -> None:
    pose = kv.translation(1, 2, 3) @ kv.rotation_z(0.5)
    target = Target("pose", pose)
    assert list(target.values(pose).values()) == list(np.array(pose()).ravel()[:12])
    with pytest.raises(InvalidValueError, match="array of numbers"):
        target.values(kv.translation(kv.position("x"), 0, 0))
    with pytest.raises(InvalidValueError, match="array of numbers"):
        Target("point", "abc")


def test_messages_stay_short() -> None:
    hand = kv.load("fetch").fk("fetch/gripper_link")
    with pytest.raises(ShapeError) as caught:
        Goal(hand, np.eye(4))
    assert len(str(caught.value)) < 300


def solve(model: kv.Model, **options):
    return inverse_kinematics(model, [Goal(model.symbol("joint1"), 0.5)], **options)


# -- oracle ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("file", "frame"),
    [
        ("panda_description/urdf/panda.urdf", "panda_hand"),
        ("ur_description/urdf/ur5_robot.urdf", "tool0"),
        ("tiago_description/robots/tiago_no_hand.urdf", "wrist_ft_tool_link"),
    ],
)
def test_solutions_of_arms_are_confirmed_by_pinocchio(file: str, frame: str) -> None:
    pin = pytest.importorskip("pinocchio")
    try:
        path = str(locate_model(file).path)
    except UnknownNameError as error:
        pytest.skip(str(error))
    model, theirs = kv.load(path), pin.buildModelFromUrdf(path)
    buffer, identifier = theirs.createData(), theirs.getFrameId(frame)
    target = pose_target("target")
    solver = InverseKinematics(model, [Goal(same_pose(model.fk(frame), target.expression))])
    generator = np.random.default_rng(6)

    def place(values) -> np.ndarray:
        q = pin.neutral(theirs)
        for k, name in enumerate(theirs.names[1:], 1):
            joint, value = theirs.joints[k], values.get(name, 0.0)
            q[joint.idx_q : joint.idx_q + joint.nq] = (
                value if joint.nq == 1 else (math.cos(value), math.sin(value))
            )
        pin.framesForwardKinematics(theirs, buffer, q)
        return buffer.oMf[identifier].homogeneous.copy()

    for _ in range(10):
        wanted = place({str(s): v for s, v in random_state(model, generator, 3.0).items()})
        result = solver.solve(target.values(np.vstack([wanted[:3], [0, 0, 0, 1]])), starts=20)
        assert result.solved
        assert not model.violations(result.best)
        assert np.abs(place({str(s): v for s, v in result.best.items()}) - wanted).max() < 1e-4
