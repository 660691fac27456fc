"""Models that are broken on purpose: each break is real, whatever the checks say of it."""

import inspect

import numpy as np
import pytest

import kineverse as kv
from kineverse.errors import FormatError
from kineverse.geometry import check_motion
from kineverse.geometry.motion_checks.moving_parts import MovingParts
from kineverse_studies.experiments import Options, reproduce
from kineverse_studies.experiments.checks import break_models, breaks, load_models
from kineverse_studies.experiments.checks.breaks import BREAKS, find_joints, scale_geometry

BY_NAME = {one.name: one for one in BREAKS}


@pytest.fixture(scope="module")
def joints():
    return {name: tuple(find_joints(kv.load(name))) for name in ("shelf_door", "shelf_drawers")}


@pytest.fixture(scope="module")
def door(joints):
    (door,) = joints["shelf_door"]
    return door


@pytest.fixture(scope="module")
def drawer(joints):
    return joints["shelf_drawers"][0]


def make(name, joint, tmp_path, seed=0):
    assert BY_NAME[name].applies(joint)
    return BY_NAME[name].make(joint, np.random.default_rng(seed), tmp_path)


def test_the_breaks_know_nothing_of_the_limits_of_the_checks():
    source = inspect.getsource(breaks)
    assert "joint_checks" not in source
    assert "sweep_checks" not in source
    assert "body_checks" not in source


@pytest.mark.parametrize(
    "name", ["axis outside", "hinge in the middle", "axis flipped", "axis turned", "crossed limits"]
)
def test_a_part_with_another_axis_is_where_it_was_at_rest(name, door, tmp_path):
    broken = make(name, door, tmp_path)
    child = door.joint.child
    at = {str(door.part.coordinate): 0.0}
    np.testing.assert_allclose(broken.fk(child)(at), door.model.fk(child)(at), atol=1e-12)


def test_an_axis_outside_is_outside_of_the_ball_around_everything(door, tmp_path):
    for seed in range(5):
        broken = make("axis outside", door, tmp_path, seed)
        record = broken.articulations[door.joint.name]
        line = broken.fk(record.child)({str(door.part.coordinate): 0.0})
        axis = line[:3, :3] @ door.axis
        points = door.all_points(list(door.part.parts.scene.bodies)) - line[:3, 3]
        distances = np.linalg.norm(np.cross(points, axis), axis=1)
        assert distances.min() > 0.5 * door.part.size


def test_a_part_that_floats_is_out_of_reach_in_all_states(drawer, tmp_path):
    for seed in range(5):
        parts = MovingParts(make("floats", drawer, tmp_path, seed))
        scene, symbol = parts.scene, drawer.part.coordinate
        for value in np.linspace(*drawer.part.limits, 7).tolist():
            scene.update(parts.default.updated({symbol: value}))
            others = [b for b in scene.bodies if b not in drawer.part.solids]
            distances = [scene.distance(a, b).distance for a in drawer.part.solids for b in others]
            assert min(distances) > 0.4 * drawer.part.size


def test_a_joint_that_moves_nothing_moves_nothing(drawer, tmp_path):
    broken = make("moves nothing", drawer, tmp_path)
    poses = [
        [
            broken.fk(name)(broken.default_state().updated({drawer.part.coordinate: value}))
            for name in broken.bodies
        ]
        for value in (0.0, 0.1)
    ]
    np.testing.assert_array_equal(*poses)


def test_limits_are_crossed_and_units_changed(door, drawer, tmp_path):
    lower, upper = make("crossed limits", door, tmp_path).limits(door.part.coordinate)
    assert lower > upper
    lower, upper = make("degrees for radians", door, tmp_path).limits(door.part.coordinate)
    assert upper - lower == pytest.approx(np.rad2deg(door.span))
    spans = {
        round(
            np.ptp(make("mm for m", drawer, tmp_path, seed).limits(drawer.part.coordinate)) / drawer.span, 9
        )
        for seed in range(8)
    }
    assert spans == {1e-3, 1e3}


@pytest.mark.parametrize("break_", BREAKS, ids=lambda one: one.name)
def test_each_break_of_a_shelf_is_a_model_that_can_be_checked(break_, joints, tmp_path):
    joint = next((one for some in joints.values() for one in some if break_.applies(one)), None)
    assert joint is not None
    report = check_motion(break_.make(joint, np.random.default_rng(1), tmp_path))
    if break_.is_certain:
        assert break_.kinds[0] in {entry.kind for entry in report[joint.coordinate].findings}


def test_geometries_of_all_kinds_are_scaled():
    body = kv.model.body
    doubled = {
        body.Box((1, 2, 3)): body.Box((2, 4, 6)),
        body.Ellipsoid((1, 2, 3)): body.Ellipsoid((2, 4, 6)),
        body.Sphere(1): body.Sphere(2),
        body.Cylinder(1, 2): body.Cylinder(2, 4),
        body.Capsule(1, 2): body.Capsule(2, 4),
        body.Cone(1, 2): body.Cone(2, 4),
        body.Mesh("x.stl"): body.Mesh("x.stl", scale=(2.0, 2.0, 2.0)),
    }
    assert {geometry: scale_geometry(geometry, 2) for geometry in doubled} == doubled


def test_a_seed_breaks_the_same_models_again(joints):
    sound = {name: check_motion(kv.load(name)) for name in joints}
    once, again = (break_models(3, joints, sound) for _ in range(2))
    assert once == again
    assert [one.break_ for one in once] == [one.name for one in BREAKS]
    assert once != break_models(4, joints, sound)


def test_folders_of_models_are_added_and_a_missing_one_is_refused(tmp_path):
    (tmp_path / "broken.urdf").write_text("<robot")
    (tmp_path / "door.urdf").write_bytes((kv.shipped.FOLDER / "shelf_door.urdf").read_bytes())
    assert f"{tmp_path.name}/door.urdf" in load_models([tmp_path])
    with pytest.raises(FormatError, match="no folder"):
        load_models([tmp_path / "gone"])
    with pytest.raises(kv.errors.InvalidValueError, match="takes no --robot"):
        reproduce("checks", options=Options(robot=("pr2",)))
