"""Holds, conditions and closed loops of planners."""

import numpy as np
import pytest
from planning_models import body, contacts, is_free
from scipy.spatial.transform import Rotation

import kineverse as kv
from kineverse.geometry import Scene
from kineverse.model.body import Box, Capsule, Cylinder, Sphere
from kineverse.planning import Planner
from kineverse.planning.planning_scene import find_carried_bodies

pytestmark = pytest.mark.compiler


@pytest.fixture(scope="module")
def flying():
    """A hand that moves and turns freely, a bar in two parts, and a wall with a hole beside it."""
    names = ("x", "y", "z", "a", "b", "c")
    x, y, z, a, b, c = (kv.position(n) for n in names)
    model = kv.Model()
    with model.edit() as edit:
        turn = kv.rotation_z(a) @ kv.rotation_y(b) @ kv.rotation_x(c)
        edit.add_frame("hand", "world", kv.translation(x, y, z) @ turn, body(Box((0.04, 0.04, 0.06))))
        edit.add_frame("palm", "hand", kv.translation(0, 0, 0.06))
        edit.add_frame("finger", "hand", kv.translation(0, 0, 0.05), body(Sphere(0.02)))
        edit.add_frame(
            "bar", "world", kv.translation(0.5, 0, 0) @ kv.rotation_y(0.3), body(Cylinder(0.02, 0.3))
        )
        edit.add_frame("knob", "bar", kv.translation(0, 0, 0.2), body(Sphere(0.03)))
        edit.add_frame("wall", "world", kv.translation(-0.5, 0, 0), body(Box((0.05, 2, 1))))
        edit.add_frame("mark", "world", kv.translation(0, 0.5, 0.1))
        edit.add_frame("top", "wall", kv.translation(0, 0, 0.5))
    return Planner(model)


@pytest.mark.parametrize(
    "mask",
    [
        "rx",
        "ry rz",
        "xyz rx rz",
        *(pytest.param(mask, marks=pytest.mark.long) for mask in ("z", "xz", "rx ry rz", "xyz rx ry rz")),
    ],
)
def test_solutions_of_holds_are_free_and_hold_what_the_mask_says(flying, mask):
    offset = kv.translation(0.01, 0.02, 0.03) @ kv.rotation_x(0.4)
    Q = flying.solutions(flying.hold("hand", "mark", mask, offset), 8, seconds=0.1)
    # Without anything left to turn there are few.
    assert len(Q) == 8 or (mask == "xyz rx ry rz" and len(Q) > 0)
    assert flying.valid(Q).all()
    assert (contacts(flying, Q) > 0).all()
    held = flying.model.fk("mark")({}) @ np.array(offset())
    for q in Q:
        T = np.linalg.inv(held) @ flying.model.fk("hand")(dict(zip(flying.symbols, q.tolist(), strict=True)))
        for i, name in enumerate("xyz"):
            if name in mask.replace("rx", "").replace("ry", "").replace("rz", ""):
                assert abs(T[i, 3]) < 1e-8
        turns = [i for i, name in enumerate(("rx", "ry", "rz")) if name in mask]
        vector = Rotation.from_matrix(T[:3, :3]).as_rotvec()
        if len(turns) == 2:
            # The third axes agree, whatever the turn about them.
            (axis,) = {0, 1, 2}.difference(turns)
            np.testing.assert_allclose(T[:3, axis], np.eye(3)[axis], atol=1e-8)
        elif turns:
            np.testing.assert_allclose(vector[turns], 0.0, atol=1e-8)


def test_path_keeps_to_a_hold_between_its_points(flying):
    hold = flying.hold("palm", "bar", "xyz rx ry", kv.translation(0.045, 0, 0) @ kv.rotation_y(-np.pi / 2))
    (start, *_), goals = flying.solutions(hold, 4), flying.solutions(hold, 8, seed=3)
    path = flying.plan(start, goals, along=hold, seconds=3.0)
    assert path, path.why
    error = [
        flying.planning_scene.manifold((hold,)).residuals(m).max()
        for m in (path.points, (path.points[1:] + path.points[:-1]) / 2)
    ]
    assert max(error) < 1e-5


@pytest.fixture(scope="module")
def globe():
    """A ball on a unit sphere, and an obstacle half way between two of its places; planner and hold."""
    x, y, z = (kv.position(n) for n in "xyz")
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("ball", "world", kv.translation(x, y, z), body(Sphere(0.05)))
        edit.add_frame("hill", "world", kv.translation(1, 0, 0), body(Sphere(0.25)))
        for name, symbol in zip("xyz", (x, y, z), strict=True):
            edit.constrain(name, -1.5, symbol, 1.5)
    return Planner(model), kv.control.Hold(np.sqrt(x * x + y * y + z * z), 1.0)


def test_path_on_a_manifold_is_as_short_as_a_band(globe):
    planner, hold = globe
    away, radius = np.pi / 4, 2 * np.arcsin(0.3 / 2)
    ends = np.array([[np.cos(a), np.sin(a), 0.0] for a in (-away, away)])
    # Great circles to the circle around the hill, and the way along it.
    straight = np.arccos(np.cos(away) / np.cos(radius))
    around = (np.pi - 2 * np.arccos(np.tan(radius) / np.tan(away))) * np.sin(radius)
    for seed in range(2):
        path = planner.plan(*ends, along=hold, seed=seed)
        assert path, path.why
        assert is_free(planner, path.points)
        assert path.length < 1.05 * (2 * straight + around)
        np.testing.assert_array_equal(planner.plan(*ends, along=hold, seed=seed).points, path.points)
        middle = (path.points[1:] + path.points[:-1]) / 2
        assert 2e-6 < np.abs(np.linalg.norm(middle, axis=1) - 1.0).max() < 1e-5


def test_path_on_a_manifold_from_a_start_that_nearly_touches(globe):
    planner, hold = globe
    angle = 2 * np.arcsin((0.3 + 1e-4) / 2)
    start = np.array([np.cos(angle), np.sin(angle), 0.0])
    path = planner.plan(start, [np.cos(1.0), -np.sin(1.0), 0.0], along=hold, seconds=0.5)
    assert path, path.why
    np.testing.assert_allclose(path.points[0], start, atol=1e-9)


def test_hold_with_large_numbers_is_kept_as_well(globe):
    planner, (x, y, _) = globe[0], globe[0].symbols
    path = planner.plan(
        [0, -1.4, 0], [0, 1.4, 0], along=kv.control.Hold(np.sqrt((x + 1000) ** 2 + y * y), 1000.0)
    )
    assert path, path.why
    middle = (path.points[1:] + path.points[:-1]) / 2
    assert np.abs(np.hypot(middle[:, 0] + 1000, middle[:, 1]) - 1000).max() < 1e-5


def test_only_what_both_frames_carry_may_touch(flying):
    hold = flying.hold("hand", "bar", "xyz")
    pairs = {frozenset((hand, "bar")) for hand in ("hand", "finger")}
    assert flying.planning_scene.touching_pairs([hold]) == pairs
    # A frame that is fixed stands for its body or the next above, and not for all that is fixed.
    assert find_carried_bodies(flying.model, flying.scene.bodies, "top") == ("wall",)
    assert find_carried_bodies(flying.model, flying.scene.bodies, "mark") == ()
    assert find_carried_bodies(flying.model, flying.scene.bodies, "palm") == ("hand", "finger")


@pytest.mark.parametrize("other", ["world", "mark"])
def test_hold_against_the_world_does_not_open_walls(flying, other):
    hold = flying.hold("hand", other, "z", kv.translation(0, 0, -0.1) if other == "mark" else None)
    assert not flying.planning_scene.touching_pairs([hold])
    start = dict.fromkeys(flying.symbols, 0.0)
    path = flying.plan(
        start, {**start, flying.symbols[3]: -1.0, flying.model.symbol("x"): -1.0}, along=hold, seconds=0.1
    )
    assert not path or is_free(flying, path.points)


def test_latch_is_not_slipped_through():
    model = kv.load("articulations/microwave", prefix="")
    planner = Planner(model)
    closed, open_ = {"oven/door": 0.0, "oven/button": 0.0}, {"oven/door": 1.0, "oven/button": 0.0}
    ajar = {"oven/door": 0.002, "oven/button": 0.0}
    assert planner.valid([closed, open_, ajar, {**ajar, "oven/button": 0.005}]).tolist() == [
        True,
        True,
        False,
        True,
    ]
    assert not Planner(model, move="oven/door").plan(closed, open_, seconds=0.2)
    path = planner.plan(closed, open_, seconds=5)
    assert path.found, path.why
    for fraction in np.linspace(0.0, 1.0, 1001):
        assert not model.violations(path.at(fraction), tolerance=2e-5)
    pressed = planner.plan({**closed, "oven/button": 0.006}, {**open_, "oven/button": 0.006})
    assert pressed, pressed.why


def test_door_stops_at_a_pin():
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Revolute(name="door", parent="world", child="door", axis=(0, 0, 1), lower=0, upper=2))
        edit.add_frame("leaf", "door", kv.translation(0.5, 0, 0), body(Box((0.9, 0.01, 1.5))))
        place = kv.translation(0.9 * np.cos(1), 0.9 * np.sin(1), 0)
        edit.add_frame("pin", "world", place, body(Cylinder(0.002, 0.2)))
    planner = Planner(model)
    for k in range(0, 20, 3):
        assert not planner.plan([0.002 * k], [1.5 + 0.01 * k], seconds=0.02)
    assert planner.plan([0.0], [0.9])
    assert planner.plan([1.1], [2.0])
    assert "'leaf' and 'pin'" in planner.plan([0.0], [1.0]).why


def test_door_passes_a_gap_that_is_narrower_than_the_margin_of_searches():
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Revolute(name="door", parent="world", child="door", axis=(0, 0, 1), lower=0, upper=2))
        edit.add_frame("leaf", "door", kv.translation(0.5, 0, 0), body(Box((0.9, 0.01, 1.5))))
        place = kv.translation(np.hypot(0.95, 0.005) + 0.1005, 0, 0)
        edit.add_frame("post", "world", kv.rotation_z(1.0) @ place, body(Cylinder(0.1, 0.2)))
    path = Planner(model).plan([0.0], [2.0])
    assert path, path.why
    assert not Planner(model, margin=1e-3).plan([0.0], [2.0], seconds=0.02)


@pytest.fixture(scope="module")
def four_bar():
    model = kv.Model()
    with model.edit() as edit:
        lengths = {"crank": 0.8, "coupler": 1.1, "rocker": 0.9}
        for name, parent, x in (("crank", "world", 0), ("coupler", "crank", 0.8), ("rocker", "world", 1.5)):
            limits = {"lower": -1.2, "upper": 1.2} if name == "crank" else {}
            origin = kv.model.Pose.from_matrix(kv.translation(x, 0, 0))
            edit.apply(
                kv.Revolute(name=name, parent=parent, child=name, origin=origin, axis=(0, 0, 1), **limits)
            )
            edit.add_frame(f"{name}_end", name, kv.translation(lengths[name], 0, 0))
            bar = body(Box((lengths[name] - 0.2, 0.04, 0.04)), at=(lengths[name] / 2, 0, 0))
            edit.add_frame(f"{name}_bar", name, np.eye(4), bar)
        edit.close_loop("coupler_end", "rocker_end", name="loop")
        turn = kv.rotation_z(kv.position("arm"))
        edit.add_frame(
            "arm", "world", kv.translation(-0.8, 0.5, 0) @ turn, body(Capsule(0.05, 0.2), at=(0.5, 0, 0))
        )
        for k in range(8):
            edit.add_frame(
                f"post{k}", "world", kv.translation(1.8 * np.cos(k), 1.8 * np.sin(k), 0), body(Sphere(0.1))
            )
    return Planner(model)


def test_closed_loop_has_the_poses_of_the_model_and_no_collision_is_hidden(four_bar):
    Q = np.random.default_rng(0).uniform(-3, 3, (120, 2))
    found = four_bar.valid(Q)
    assert not found[np.abs(Q[:, [str(s) for s in four_bar.symbols].index("crank")]) > 1.2].any()
    assert 0.1 < found.mean() < 0.9
    # Beyond its limits the loop does not close: lanes without poses.
    np.testing.assert_array_equal(found, [four_bar.valid(q)[0] for q in Q])
    assert (contacts(four_bar, Q[found], Scene(four_bar.model, rules=four_bar.excluded)) > -1e-6).all()
    for q in Q[found][:5].astype(np.float32):
        state = dict(zip(four_bar.symbols, q.astype(float).tolist(), strict=True))
        for name, pose in zip(four_bar.checker.groups, four_bar.checker.outputs(q)[0], strict=True):
            np.testing.assert_allclose(pose, four_bar.model.fk(name)(state)[:3], atol=2e-6)


def test_path_of_a_closed_loop_is_free(four_bar):
    Q = np.random.default_rng(1).uniform(-1.2, 1.2, (60, 2))
    free = Q[four_bar.valid(Q)]
    paths = [four_bar.plan(free[2 * k], free[2 * k + 1], seconds=0.1) for k in range(5)]
    assert any(paths)
    assert all(is_free(four_bar, path.points) for path in paths if path)


def test_full_turn_of_a_screw_is_not_the_same():
    turn, pitch = kv.position("turn"), kv.position("pitch")
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame(
            "nut",
            "world",
            kv.translation(0, 0, pitch * turn) @ kv.rotation_z(turn),
            body(Box((0.1, 0.1, 0.1))),
        )
    planner = Planner(model, "turn")
    for pitch_value in (0.0, 0.01):
        planner.place({"pitch": pitch_value})
        assert planner.plan([0.0], [7.0]).points[-1, 0] == 7.0


def test_way_to_a_grasp_goes_around_what_is_grasped():
    x, y = kv.position("x"), kv.position("y")
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("hand", "world", kv.translation(x, y, 0), body(Sphere(0.05)))
        edit.add_frame("block", "world", kv.translation(1, 0, 0), body(Box((0.5, 2.0, 1.0))))
    planner = Planner(model)
    # Behind the block, 1 cm from it.
    path = planner.plan([0, 0], [planner.hold("hand", "block", "xyz", kv.translation(0.31, 0, 0))])
    assert path, path.why
    assert is_free(planner, path.points)
