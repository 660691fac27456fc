"""Nine linkages: closed in every configuration, moving as their Jacobians say, on one branch."""

import functools
import itertools
import math

import linkages
import mujoco
import numpy as np
import pytest
from linkages import GALLERY, four_bar_by_circles
from loop_checks import (
    assert_closed,
    assert_moves_as_its_jacobian_says,
    configurations,
    dependent,
    function,
    loops_of,
    record,
    residual,
)
from mujoco_linkages import as_mujoco

import kineverse as kv

ENDS = {
    "four-bar": "coupler_tip",
    "slider-crank": "piston",
    "spatial four-bar": "driven_ball",
    "parallel gripper": "right_finger",
    "scissor lift": "tip",
    "desk lamp": "head",
    "folding door": "handle",
    "delta robot": "platform",
    "Jansen leg": "foot",
}
FREE = {
    "slider-crank": "crank",
    "four-bar": "crank",
    "spatial four-bar": "drive",
    "parallel gripper": "left_inner",
    "scissor lift": "bar_a0",
    "desk lamp": "lower_front upper_front",
    "folding door": "door",
    "delta robot": "motor_0 motor_1 motor_2",
    "Jansen leg": "crank",
}
GOES_ROUND = {"four-bar", "slider-crank", "spatial four-bar", "Jansen leg"}

linkage = functools.cache(lambda name: GALLERY[name]())


@pytest.fixture(params=GALLERY)
def name(request):
    return request.param


@pytest.fixture
def model(name):
    return linkage(name)


def poses(model, frame, points, relative_to="world"):
    return function(model, model.fk(frame, relative_to)).batch(points)[0]


# -- all of them -------------------------------------------------------------------------------------------


@pytest.mark.sampled(2)
def test_a_loop_is_closed_over_its_range(model):
    assert_closed(model)


@pytest.mark.parametrize("name", sorted(set(GALLERY) - GOES_ROUND))
def test_a_loop_is_closed_in_the_margin_beyond_its_limits(name):
    """Whoever oversteps a limit is told so by the limit, not by an error."""
    model = linkage(name)
    bounds = np.array([model.limits(s) for s in model.degrees_of_freedom])
    width = bounds[:, 1] - bounds[:, 0]
    beyond = np.random.default_rng(0).uniform(
        bounds[:, 0] - 0.04 * width, bounds[:, 1] + 0.04 * width, (200, len(bounds))
    )
    beyond[:2] = bounds[:, 0] - 0.04 * width, bounds[:, 1] + 0.04 * width
    assert np.abs(function(model, residual(model)).batch(beyond)[0]).max() <= 1e-10
    for values in beyond[:2]:
        broken = model.violations(dict(zip(model.degrees_of_freedom, values, strict=True)))
        assert {f"{s}/position" for s in model.degrees_of_freedom} <= {v.name for v in broken}


def test_the_free_coordinates_of_a_loop(model, name):
    free = tuple(map(kv.position, FREE[name].split()))
    assert model.degrees_of_freedom == model.symbols == free
    assert model.speeds == tuple(s.derivative() for s in free)
    assert set(model.default_state()) == set(free)
    assert set(model.fk(ENDS[name]).symbols) <= set(free)
    for loop in loops_of(model):
        known = record(model, loop.name)
        assert known["mobility"] == len(known["free"])
        assert known["branches"] >= 2
        assert known["branch"] == 0
        assert 0.05 < known["condition"] < 1


def test_its_end_moves_as_the_jacobian_says(model, name):
    assert_moves_as_its_jacobian_says(model, ENDS[name], 15 if name == "delta robot" else 40)


@pytest.mark.parametrize(
    "name", ["four-bar", "spatial four-bar", "scissor lift", "folding door", "Jansen leg"]
)
def test_second_derivatives(name):
    model = linkage(name)
    jacobian = model.jacobian(ENDS[name])
    (free,) = model.degrees_of_freedom
    first, second = function(model, jacobian), function(model, jacobian.jacobian([free])[..., 0])
    for q in configurations(model, 20, 1.0):
        wanted = (first(q + 1e-5)[0] - first(q - 1e-5)[0]) / 2e-5
        np.testing.assert_allclose(second(q)[0], wanted, rtol=1e-5, atol=2e-6)


def test_accelerations_of_the_delta_robot():
    """ẍ = J q̈ + q̇ᵀ H q̇ along a path of the motors."""
    model = linkage("delta robot")
    motors, where = model.degrees_of_freedom, model.fk("platform")[:3, 3]
    hessian = function(model, where.jacobian(motors).jacobian(motors))
    along = function(model, where)
    q, v = np.array([0.1, 0.3, 0.2]), np.array([1.0, -0.4, 0.7])
    step = 1e-4
    wanted = (along(q + step * v)[0] - 2 * along(q)[0] + along(q - step * v)[0]) / step**2
    np.testing.assert_allclose(np.einsum("ijk,j,k", hessian(q)[0], v, v), wanted, rtol=0, atol=1e-6)


def test_a_loop_stays_on_one_branch(model):
    """Along lines through the range, nothing moves further than its speed allows."""
    ends = configurations(model, 12, 3.0)
    lines = itertools.pairwise(ends) if ends.shape[1] > 1 else [(ends[0], ends[-1])]
    followers = dependent(model)
    coordinates, speeds = (
        function(model, followers),
        function(model, followers.jacobian(model.degrees_of_freedom)),
    )
    for start, end in list(lines)[:4]:
        way = np.linspace(0, 1, 1 + int(np.abs(end - start).max() / 0.02))[:, None]
        path = start + way * (end - start)
        moved = np.diff(coordinates.batch(path)[0], axis=0)
        slopes = speeds.batch(path)[0] @ (path[1] - path[0])
        largest = np.maximum(np.abs(slopes[1:]), np.abs(slopes[:-1]))
        assert (np.abs(moved) <= 1.2 * largest + 1e-3).all()


def test_a_whole_turn_changes_nothing(model):
    round_ = [s for s in model.degrees_of_freedom if not np.isfinite(model.limits(s)).all()]
    points = configurations(model, 30, 1.0)
    for s in round_:
        turn = 2 * np.pi * np.array([t is s for t in model.degrees_of_freedom])
        for frame in model.frames:
            for turns in (-1, 40):
                np.testing.assert_allclose(
                    poses(model, frame, points),
                    poses(model, frame, points + turns * turn),
                    rtol=0,
                    atol=1e-11,
                )


# -- closed forms ------------------------------------------------------------------------------------------


def test_the_four_bar_by_circles():
    model, sides = linkage("four-bar"), set()
    for q in configurations(model, 200):
        found = model.fk("rocker_tip")({"crank": q[0]})[:2, 3]
        meetings = [four_bar_by_circles(q[0], side=side) for side in (1, -1)]
        errors = [np.abs(found - m).max() for m in meetings]
        assert min(errors) < 1e-12
        sides.add(int(np.argmin(errors)))
    assert len(sides) == 1


def test_the_slider_crank_by_its_formula():
    model = linkage("slider-crank")
    piston = model.rates.carried(kv.position("piston"))
    for q in configurations(model, 200)[:, 0]:
        root = math.sqrt(0.3**2 - (0.1 * math.sin(q)) ** 2)
        assert piston({"crank": q}) == pytest.approx(0.1 * math.cos(q) + root, abs=1e-13)
        speed = -0.1 * math.sin(q) - 0.1**2 * math.sin(q) * math.cos(q) / root
        assert model.jacobian("piston")({"crank": q})[0, 0] == pytest.approx(speed, abs=1e-12)


def test_the_spatial_four_bar_by_a_quadratic():
    """The rod's length says where the driven ball is on its circle: A cos θ + B sin θ = C."""
    model = linkage("spatial four-bar")
    for q in configurations(model, 60)[:, 0]:
        ball = np.array([0.1 * math.cos(q), 0.1 * math.sin(q), 0.03])
        away = np.array([0.4, 0.3, 0.0]) - ball
        a, b = 2 * 0.25 * away[1], 2 * 0.25 * away[2]
        c = 0.55**2 - 0.25**2 - away @ away
        angles = math.atan2(b, a) + np.array([1, -1]) * math.acos(c / math.hypot(a, b))
        found = model.rates.carried(kv.position("driven"))({"drive": q})
        assert np.abs(np.exp(1j * found) - np.exp(1j * angles)).min() < 1e-11


def test_the_tips_of_the_gripper_stay_parallel_and_mirror():
    model = linkage("parallel gripper")
    points = configurations(model, 100)
    left, right = (poses(model, f"{side}_finger", points, "board") for side in ("left", "right"))
    np.testing.assert_allclose(left[:, :3, :3], np.broadcast_to(np.eye(3), (100, 3, 3)), rtol=0, atol=1e-12)
    np.testing.assert_allclose(right[:, :3, :3], np.broadcast_to(np.eye(3), (100, 3, 3)), rtol=0, atol=1e-12)
    np.testing.assert_allclose(left[:, :3, 3], right[:, :3, 3] * [1, -1, 1], rtol=0, atol=1e-12)
    wanted = 0.02 + 0.1 * np.sin(points[:, 0])
    np.testing.assert_allclose(left[:, 1, 3], wanted, rtol=0, atol=1e-12)


def test_the_height_of_the_scissor_lift():
    model = linkage("scissor lift")
    length, stages = 0.36, 3
    points = configurations(model, 60)
    tip = poses(model, "tip", points, "board")[:, :3, 3]
    reach, rise = length * np.cos(points), length * np.sin(points)
    np.testing.assert_allclose(tip, np.hstack([reach, stages * rise, 0.03 + 0 * rise]), rtol=0, atol=1e-12)
    slide = poses(model, "slide", points, "board")[:, 0, 3]
    np.testing.assert_allclose(slide, reach[:, 0], rtol=0, atol=1e-12)


def test_the_head_of_the_lamp_keeps_its_direction():
    model = linkage("desk lamp")
    points = configurations(model, 200)
    head = poses(model, "head", points)
    np.testing.assert_allclose(head[:, :3, :3], np.broadcast_to(np.eye(3), (200, 3, 3)), rtol=0, atol=1e-12)
    rise = 0.4 * np.cos(points[:, 0]) + 0.05 + 0.35 * np.cos(points[:, 1])
    reach = 0.4 * np.sin(points[:, 0]) + 0.35 * np.sin(points[:, 1]) + 0.1
    np.testing.assert_allclose(head[:, [0, 2], 3], np.column_stack([reach, rise]), rtol=0, atol=1e-12)


# Of the authors, (x, z) of each origin [m]; the angle between the panels [deg].
DOOR = [
    (0.00, (-0.1833, 0.1793), (-0.1816, -0.1806), (-0.1887, -0.2792), 179.51),
    (0.46, (-0.2574, 0.1956), (-0.3318, -0.1410), (-0.3301, -0.2398), 147.99),
    (0.92, (-0.3166, 0.2431), (-0.4558, -0.0326), (-0.4501, -0.1312), 119.38),
    (1.38, (-0.3485, 0.3119), (-0.5195, 0.1224), (-0.5107, 0.0240), 91.16),
    (1.84, (-0.3466, 0.3877), (-0.5057, 0.2926), (-0.4923, 0.1947), 62.15),
]


@pytest.mark.parametrize(("q", "upper", "lower", "handle", "angle"), DOOR)
def test_the_folding_door_is_where_the_authors_have_it(q, upper, lower, handle, angle):
    model = linkage("folding door")
    found_upper = (model.fk("door")({"door": q}) @ [0.00229, 0, -0.16637, 1])[[0, 2]]
    np.testing.assert_allclose(found_upper, upper, rtol=0, atol=1e-4)
    for frame, where in (("lower_panel", lower), ("handle", handle)):
        np.testing.assert_allclose(model.fk(frame)({"door": q})[[0, 2], 3], where, rtol=0, atol=1e-4)
    between = float(model.rates.carried(kv.position("between"))({"door": q}))
    assert 180 - abs(math.degrees(between)) == pytest.approx(angle, abs=0.03)


def test_the_delta_robot_by_spheres():
    model = linkage("delta robot")
    points = configurations(model, 100)
    platform = poses(model, "platform", points, "frame")
    wanted = [linkages.delta_by_spheres(q) for q in points]
    np.testing.assert_allclose(platform[:, :3, 3], wanted, rtol=0, atol=1e-11)
    np.testing.assert_allclose(platform[:, :3, :3], np.broadcast_to(np.eye(3), (100, 3, 3)), rtol=0, atol=0)


def test_the_bars_of_the_jansen_leg_keep_their_lengths():
    model = linkage("Jansen leg")
    points = configurations(model, 100)
    where = {f: poses(model, f, points, "board")[:, :2, 3] for f in model.frames}
    # Theo Jansen's numbers, at a scale of 1:2 [m].
    s = dict(b=41.5, c=39.3, d=40.1, e=55.8, f=39.4, g=36.7, h=65.7, i=49.0, j=50.0, k=61.9)  # noqa: C408
    s = {name: length / 200 for name, length in s.items()}
    for first, second, length in (
        ("crank_end", "top", s["j"]), ("pin", "top", s["b"]), ("pin", "bottom", s["c"]),
        ("crank_end", "bottom", s["k"]), ("pin", "outer", s["d"]), ("top", "outer", s["e"]),
        ("outer", "knee", s["f"]), ("bottom", "knee", s["g"]), ("knee", "foot", s["h"]), ("bottom", "foot", s["i"]),
    ):  # fmt: skip
        apart = np.linalg.norm(where[first] - where[second], axis=1)
        np.testing.assert_allclose(apart, length, rtol=0, atol=1e-11, err_msg=f"{first} to {second}")
    steps = poses(model, "foot", np.linspace(0, 2 * np.pi, 400)[:, None], "board")[:, 1, 3]
    # The leg walks: its foot is near the ground for a good part of each turn.
    assert np.mean(steps < steps.min() + 0.06 * np.ptp(steps)) > 0.25


# -- and by somebody else ----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [n for n in GALLERY if n != "parallel gripper"])
def test_mujoco_finds_it_closed_and_moving_along(name):
    """The open tree and its pins, told to MuJoCo: no gap at our coordinates, nor any speed of it at ours."""
    model = linkage(name)
    their, data, joints, frames = as_mujoco(model)
    coordinates = kv.array([model.rates.carry(kv.position(j)) for j in joints])
    at = function(model, coordinates, coordinates.jacobian(model.degrees_of_freedom))
    for q in configurations(model, 12, 1.0):
        data.qpos[:], speeds = at(q)
        mujoco.mj_forward(their, data)
        assert data.nefc > 0
        assert np.abs(data.efc_pos).max() < 1e-10
        pins = np.zeros((data.nefc, their.nv))
        pins[:] = np.reshape(data.efc_J, (data.nefc, their.nv))
        assert np.abs(pins @ speeds).max() < 1e-9
        # What does not keep them closed is felt.
        assert np.abs(pins @ (speeds + 0.1 * np.cos(np.arange(their.nv))[:, None])).max() > 1e-4
        for i, frame in enumerate(frames):
            pose = model.fk(frame)(dict(zip(model.degrees_of_freedom, q, strict=True)))
            np.testing.assert_allclose(data.site_xpos[i], pose[:3, 3], rtol=0, atol=1e-10)
            np.testing.assert_allclose(data.site_xmat[i].reshape(3, 3), pose[:3, :3], rtol=0, atol=1e-10)
