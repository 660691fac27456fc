"""Motion checks: a cupboard that is broken in each way, sound furniture, and what nobody can say."""

import math
from dataclasses import replace

import numpy as np
import pytest

import kineverse as kv
from kineverse.articulations import Cylindrical
from kineverse.geometry import check_motion
from kineverse.geometry.motion_checks.body_checks import is_inside_out
from kineverse.geometry.motion_checks.joint_checks import (
    AXIS_GAP,
    LARGEST_PART,
    LEAST_ANGLE,
    LEAST_TRAVEL,
    MOST_TRAVEL,
    MOST_TURNS,
    SCALE,
    SMALLEST_PART,
    SYMMETRIC,
    WHOLE_TURNS,
)
from kineverse.geometry.motion_checks.moving_parts import LARGEST_TRAVEL, ROBOT_CHAIN, MovingPart, MovingParts
from kineverse.geometry.motion_checks.part_shape import PartShape
from kineverse.geometry.motion_checks.rigid_groups import RigidGroups
from kineverse.geometry.motion_checks.sweep_checks import AWAY, GAP, accepted_depth
from kineverse.lie import axis_angle, transform
from kineverse.model.basic_operations import SetBody
from kineverse.model.body import Body, Box, Inertia, Mesh, Pose, Sphere
from published_data import published_path

WIDTH, HEIGHT, DEPTH, BOARD = 0.6, 0.8, 0.5, 0.02


def shape(*size, at=(0.0, 0.0, 0.0)):
    return kv.model.body.Shape(Box(size), Pose.from_matrix(transform(np.eye(3), np.array(at, dtype=float))))


def body(*shapes, **more):
    return Body(collisions=shapes, **more)


CARCASS = body(
    shape(DEPTH, BOARD, HEIGHT, at=(DEPTH / 2, 0, HEIGHT / 2)),
    shape(DEPTH, BOARD, HEIGHT, at=(DEPTH / 2, WIDTH, HEIGHT / 2)),
    shape(DEPTH, WIDTH, BOARD, at=(DEPTH / 2, WIDTH / 2, 0)),
    shape(DEPTH, WIDTH, BOARD, at=(DEPTH / 2, WIDTH / 2, HEIGHT / 2)),
    shape(DEPTH, WIDTH, BOARD, at=(DEPTH / 2, WIDTH / 2, HEIGHT)),
    shape(BOARD, WIDTH, HEIGHT, at=(DEPTH, WIDTH / 2, HEIGHT / 2)),
)
DOOR = body(shape(BOARD, WIDTH, HEIGHT / 2 - 0.03, at=(-0.012, -WIDTH / 2, 0)))
DRAWER = body(shape(0.4, WIDTH - 0.06, HEIGHT / 2 - 0.06))
HINGE = kv.Revolute(
    name="door",
    parent="cupboard",
    child="door",
    origin=kv.translation(0, WIDTH, 0.25 * HEIGHT),
    axis=(0, 0, -1),
    lower=0.0,
    upper=1.5,
)
SLIDE = kv.Prismatic(
    name="drawer",
    parent="cupboard",
    child="drawer",
    origin=kv.translation(0.22, WIDTH / 2, 0.75 * HEIGHT),
    axis=(-1, 0, 0),
    lower=0.0,
    upper=0.35,
)


def cupboard(hinge=HINGE, slide=SLIDE, door=DOOR, drawer=DRAWER, carcass=CARCASS):
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("cupboard", "world", body=carcass)
        edit.apply(hinge)
        edit.apply(SetBody("door", door))
        edit.apply(slide)
        edit.apply(SetBody("drawer", drawer))
    return model


def kinds(report, coordinate, severity="findings"):
    return [entry.kind for entry in getattr(report[coordinate], severity)]


def test_a_sound_cupboard_is_sound():
    report = check_motion(cupboard())
    assert report.ok
    assert not report.findings
    assert not report.suspects
    assert [one.name for one in report.coordinates] == ["door", "drawer"]


@pytest.mark.parametrize(
    ("kind", "coordinate", "changes"),
    [
        ("degrees_for_radians", "door", {"hinge": replace(HINGE, upper=86.0)}),
        ("degrees_for_radians", "door", {"hinge": replace(HINGE, lower=-45.0, upper=45.0)}),
        ("millimetres_for_metres", "drawer", {"slide": replace(SLIDE, upper=350.0)}),
        ("millimetres_for_metres", "drawer", {"slide": replace(SLIDE, upper=3.5e-4)}),
        ("floats", "drawer", {"slide": replace(SLIDE, origin=kv.translation(-3, 0.3, 0.6))}),
        ("moves_nothing", "drawer", {"drawer": Body()}),
        (
            "impossible_inertia",
            "door",
            {"door": body(*DOOR.collisions, inertia=Inertia(5.0, (0.1, 0, 0, 0.1, 0, 1.0)))},
        ),
        (
            "center_of_mass_outside",
            "door",
            {
                "door": body(
                    *DOOR.collisions,
                    inertia=Inertia(
                        5.0, (0.1, 0, 0, 0.1, 0, 0.1), Pose.from_matrix(transform(np.eye(3), np.ones(3)))
                    ),
                )
            },
        ),
    ],
)
def test_what_is_certainly_wrong_is_a_finding(kind, coordinate, changes):
    report = check_motion(cupboard(**changes))
    assert kinds(report, coordinate) == [kind]
    assert not report.ok
    assert not report[coordinate].ok
    others = [one for one in report.coordinates if one.name != coordinate]
    assert all(one.ok and not one.suspects for one in others)
    (finding,) = report.findings
    assert finding.advice
    assert finding.joint == coordinate


NARROW = body(shape(0.01, WIDTH - 0.1, 0.3, at=(-0.012, -WIDTH / 2, 0)))


def moved_hinge(x, y, z, door=DOOR):
    """Return the cupboard whose door turns about another line, and is where it was at rest."""
    model = cupboard(door=door)
    tag = HINGE.default_tag()
    with model.edit() as edit:
        edit.replace(tag, replace(HINGE, child="line", origin=HINGE.origin @ kv.translation(x, y, z)))
        edit.insert(
            kv.model.basic_operations.AddFrame(
                "door",
                kv.model.frame.Frame("line", (Pose.from_matrix(transform(np.eye(3), -np.array([x, y, z]))),)),
            ),
            after=tag,
        )
    return model


def test_an_axis_away_from_everything_is_a_finding():
    assert kinds(check_motion(moved_hinge(-3, 0, 0)), "door") == ["axis_outside"]
    beside = 0.5 * AXIS_GAP * WIDTH
    assert kinds(check_motion(moved_hinge(-beside, 0, 0)), "door") == []


@pytest.mark.parametrize(
    ("kind", "changes"),
    [
        ("flipped_axis", {"hinge": replace(HINGE, axis=(0, 0, 1))}),
        ("flipped_axis", {"slide": replace(SLIDE, axis=(1, 0, 0))}),
        ("turned_axis", {"slide": replace(SLIDE, axis=(0, 1, 0))}),
        ("turned_axis", {"hinge": replace(HINGE, axis=(1, 0, 0))}),
        ("comes_apart", {"slide": replace(SLIDE, upper=1.5)}),
        (
            "no_limits",
            {
                "hinge": kv.Continuous(
                    **{k: getattr(HINGE, k) for k in ("name", "parent", "child", "origin", "axis")}
                )
            },
        ),
        ("gap", {"door": body(shape(BOARD, WIDTH, 0.3, at=(-0.14, -WIDTH / 2, 0)))}),
        ("radians_for_degrees", {"hinge": replace(HINGE, upper=math.radians(1.5) / 2)}),
        ("wrong_scale", {"drawer": body(shape(400.0, 500.0, 300.0))}),
        ("wrong_scale", {"drawer": body(shape(4e-4, 5e-4, 3e-4))}),
        (
            "wrong_density",
            {"drawer": body(*DRAWER.collisions, inertia=Inertia(5000.0, (10, 0, 0, 10, 0, 10)))},
        ),
        (
            "wrong_density",
            {"drawer": body(*DRAWER.collisions, inertia=Inertia(0.01, (1e-4, 0, 0, 1e-4, 0, 1e-4)))},
        ),
        ("inertia_too_large", {"drawer": body(*DRAWER.collisions, inertia=Inertia(5.0, (5, 0, 0, 5, 0, 5)))}),
    ],
)
def test_what_is_worth_a_look_is_a_suspect(kind, changes):
    report = check_motion(cupboard(**changes))
    coordinate = "door" if changes.keys() & {"hinge", "door"} else "drawer"
    assert kind in kinds(report, coordinate, "suspects")
    assert report.ok or kind == "wrong_scale"


def test_a_hinge_in_the_middle_turns_half_of_the_door_into_the_hollow_of_the_cupboard():
    (suspect,) = check_motion(moved_hinge(0, -WIDTH / 2, 0, NARROW))["door"].suspects
    assert (suspect.kind, suspect.against, suspect.unit) == ("into_carrier", "cupboard", "1")
    assert suspect.value == pytest.approx(0.5, abs=0.05)
    assert 0.0 < suspect.state["door"] <= 1.5


def test_a_door_that_opens_inwards_without_touching_is_flipped():
    (suspect,) = check_motion(cupboard(hinge=replace(HINGE, axis=(0, 0, 1)), door=NARROW))["door"].suspects
    assert suspect.kind == "flipped_axis"
    assert not check_motion(cupboard(door=NARROW)).suspects


def test_crossed_limits_are_a_finding_by_a_second_constraint_and_by_the_remarks_of_a_reader(tmp_path):
    model = cupboard()
    with model.edit() as edit:
        edit.constrain("second", 2.0, kv.position("door"), 3.0)
        twin = kv.Revolute(
            name="twin", parent="cupboard", child="twin", axis=(0, 0, 1), position=kv.position("door")
        )
        edit.apply(twin)
        edit.apply(SetBody("twin", CARCASS))
    assert kinds(check_motion(model), "door") == ["crossed_limits"]  # and once for both parts
    text = """<robot name="r"><link name="a"/><link name="b"/><joint name="j" type="revolute"><parent link="a"/>
      <child link="b"/><axis xyz="0 0 1"/><limit lower="1" upper="0" effort="1" velocity="1"/></joint></robot>"""
    file = tmp_path / "crossed.urdf"
    file.write_text(text)
    with kv.formats.collect_warnings() as remarks:
        loaded = kv.load(file)
    assert "crossed_limits" in kinds(check_motion(loaded, remarks), "j")
    assert "crossed_limits" not in kinds(check_motion(loaded), "j")
    prefixed = check_motion(kv.load(file, prefix="home"), remarks)
    assert [(entry.kind, entry.joint) for entry in prefixed.at_rest.findings] == [("crossed_limits", "j")]


# Units


@pytest.mark.parametrize(
    ("lower", "upper", "kind"),
    [
        (0.0, MOST_TURNS * math.tau - 0.1, None),
        (0.0, MOST_TURNS * math.tau + 0.1, "degrees_for_radians"),
        (0.0, 4 * math.tau, None),  # a valve of four turns
        (0.0, 44.0, "degrees_for_radians"),  # nearly seven turns
        (-12.56, 12.56, None),  # with π as 3.14
        (0.0, 4 * math.tau + 2 * WHOLE_TURNS, "degrees_for_radians"),
        (-1e6, 1e6, None),  # no limit
    ],
)
def test_many_turns_are_degrees_unless_they_are_whole_or_no_limit(lower, upper, kind):
    knob = body(shape(0.1, 0.1, 0.1, at=(-0.05, 0, 0)))
    hinge = replace(HINGE, axis=(1, 0, 0), lower=lower, upper=upper)
    assert kinds(check_motion(cupboard(hinge=hinge, door=knob)), "door") == ([kind] if kind else [])


def test_ten_radians_both_ways_may_be_no_limit_and_are_a_suspect():
    knob = body(shape(0.1, 0.1, 0.1, at=(-0.05, 0, 0)))
    for reach, severity in ((10.0, "suspects"), (SYMMETRIC / 2 + 1, "findings")):
        hinge = replace(HINGE, axis=(1, 0, 0), lower=-reach, upper=reach)
        report = check_motion(cupboard(hinge=hinge, door=knob))
        assert kinds(report, "door", severity) == ["degrees_for_radians"]


def test_a_screw_may_turn_as_often_as_it_likes():
    screw = kv.articulations.Screw(
        name="drawer", parent="cupboard", child="drawer", axis=(-1, 0, 0), pitch=0.002, lower=0.0, upper=100.0,
        origin=SLIDE.origin,
    )  # fmt: skip
    assert not check_motion(cupboard(slide=screw, drawer=body(shape(0.4, 0.1, 0.1)))).findings


def geared(ratio, axis=(-1, 0, 0), upper=None, square=False):
    """Return the cupboard whose drawer a crank moves."""
    crank = kv.position("crank")
    joint = {"name": "drawer", "parent": "cupboard", "child": "drawer", "axis": axis, "origin": SLIDE.origin}
    model = cupboard(slide=kv.Prismatic(**joint, position=ratio * (crank**2 if square else crank)))
    if upper is not None:
        with model.edit() as edit:
            edit.constrain("crank", 0.0, crank, upper)
    return model


@pytest.mark.parametrize("square", [False, True])
@pytest.mark.parametrize("ratio", [2e-4, 0.02, 3.0])
def test_a_part_is_swept_by_what_its_gear_makes_of_the_coordinate(ratio, square):
    """A spindle of 1 mm a turn is a gear, and a cam stands still at the default state."""
    upper = 0.35 / ratio
    upper = math.sqrt(upper) if square else upper
    report = check_motion(geared(ratio, upper=upper, square=square))
    assert not (*report.findings, *report.suspects)
    (suspect,) = check_motion(geared(ratio, (0, 1, 0), upper, square)).suspects
    assert suspect.kind == ("into_carrier" if square else "turned_axis")
    if not square:
        (suspect,) = check_motion(geared(ratio, (1, 0, 0))).suspects
        assert suspect.kind == "no_limits"


@pytest.mark.parametrize(
    ("upper", "found"),
    [
        (0.9 * LEAST_TRAVEL, True),
        (1.1 * LEAST_TRAVEL, False),
        (0.95 * MOST_TRAVEL * 0.54, False),
        (1.1 * MOST_TRAVEL * 0.54, True),
        (0.9 * LARGEST_TRAVEL, True),
        (1.1 * LARGEST_TRAVEL, False),  # no limit
    ],
)
def test_a_slider_moves_by_more_than_a_millimetre_and_less_than_many_sizes(upper, found):
    report = check_motion(cupboard(slide=replace(SLIDE, upper=upper)))
    assert ("millimetres_for_metres" in kinds(report, "drawer")) is found


def test_the_angle_of_a_door_read_as_degrees_is_below_the_least_angle():
    assert math.radians(0.9) < LEAST_ANGLE < math.radians(1.1)
    for upper, found in ((0.9 * LEAST_ANGLE, True), (1.1 * LEAST_ANGLE, False)):
        report = check_motion(cupboard(hinge=replace(HINGE, upper=upper)))
        assert ("radians_for_degrees" in kinds(report, "door", "suspects")) is found


@pytest.mark.parametrize(
    ("size", "found"),
    [
        (0.9 * SCALE * HEIGHT, False),
        (1.1 * SCALE * HEIGHT, True),
        (2 * LARGEST_PART, True),
        (0.9 * SMALLEST_PART, True),
        (1.1 * SMALLEST_PART, False),
    ],
)
def test_a_part_is_no_larger_than_a_house_and_no_smaller_than_a_grain(size, found):
    report = check_motion(cupboard(drawer=body(shape(size, size, size))))
    assert ("wrong_scale" in kinds(report, "drawer", "suspects")) is found


# Groups


def test_groups_are_moved_by_one_or_more_coordinates_and_by_couplings():
    model = cupboard()
    with model.edit() as edit:
        twin = {"name": "twin", "parent": "cupboard", "child": "twin", "axis": (1, 0, 0)}
        edit.apply(kv.Prismatic(**twin, position=2 * kv.position("drawer")))
        rod = {"name": "rod", "parent": "door", "child": "rod", "axis": (0, 0, 1)}
        edit.apply(Cylindrical(**rod))
    groups = RigidGroups(model)
    by = {group.frame: [str(s) for s in group.coordinates] for group in groups}
    assert by == {
        "world": [],
        "door": ["door"],
        "drawer": ["drawer"],
        "twin": ["drawer"],
        "rod": ["rod/slide", "rod/turn"],
    }
    assert [group.frame for group in groups.moved_by(kv.position("drawer"))] == ["drawer", "twin"]
    rod, twin = groups[4], groups[3]
    assert {str(s) for s in groups.coordinates_between(rod, twin)} == {
        "door",
        "rod/slide",
        "rod/turn",
        "drawer",
    }
    assert {str(s) for s in groups.coordinates_between(twin, groups[2])} == {"drawer"}
    assert groups.coordinates_between(rod, rod) == set()


@pytest.mark.parametrize("axis", [(0, 0, 1), (1, 2, -0.5), (0, -1, 0)])
def test_an_axis_is_that_of_the_joint(axis):
    point = np.array([0.3, -0.2, 0.5])
    hinge = kv.Revolute(name="q", parent="world", child="b", origin=kv.translation(*point), axis=axis)
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(hinge)
    groups = RigidGroups(model)
    found = groups.axis(groups[1], model.symbol("q"), model.default_state().updated({"q": 0.4}))
    assert found is not None
    unit = np.array(axis) / np.linalg.norm(axis)
    np.testing.assert_allclose(found.direction, unit, atol=1e-7)
    np.testing.assert_allclose(np.cross(found.point - point, unit), 0, atol=1e-7)
    assert (found.turn, found.shift) == (pytest.approx(1.0), pytest.approx(0.0, abs=1e-9))


def test_a_drawer_that_only_meets_another_moving_part_is_no_suspect():
    """The drawer slides through the closed door, which other coordinates move as well."""
    drawer = body(shape(0.4, WIDTH - 0.06, HEIGHT - 0.1, at=(0, 0, -0.2)))
    carcass = Body(
        collisions=tuple(s for k, s in enumerate(CARCASS.collisions) if k != 3)
    )  # without the shelf
    assert not check_motion(cupboard(drawer=drawer, carcass=carcass)).suspects


def test_a_coupled_part_is_looked_at_by_its_group():
    """A twin that the drawer moves: taken away, its joint moves nothing, though the coordinate does."""
    model = cupboard()
    joint = {"name": "twin", "parent": "cupboard", "child": "twin", "axis": (-1, 0, 0)}
    with model.edit() as edit:
        edit.apply(kv.Prismatic(**joint, position=kv.position("drawer")))
    (finding,) = check_motion(model).findings
    assert (finding.kind, finding.joint) == ("moves_nothing", "twin")
    assert check_motion(model)["drawer"].findings == (finding,)


def test_links_of_robots_are_suspects_where_their_shapes_say_little():
    def chain(count):
        model = kv.Model()
        with model.edit() as edit:
            edit.add_frame("base", "world", body=body(shape(0.2, 0.2, 0.2)))
            parent = "base"
            for k in range(count):
                step = kv.translation(0, 0, 0.3)
                names = {"name": f"q{k}", "parent": parent, "child": f"link{k}", "origin": step}
                edit.apply(kv.Revolute(**names, axis=(0, 1, 0), lower=-0.1, upper=0.1))
                edit.apply(SetBody(f"link{k}", body(shape(0.05, 0.05, 0.05))))
                parent = f"link{k}"
        return check_motion(model)

    short, long = chain(ROBOT_CHAIN - 1), chain(ROBOT_CHAIN)
    assert {entry.kind for entry in short.findings} == {"floats"}
    assert long.ok
    assert "floats" in {entry.kind for entry in long.suspects}


# What nobody can say


def test_missing_shapes_say_nothing_and_never_that_a_joint_moves_nothing():
    lost = Body(collisions=(kv.model.body.Shape(Mesh("lost.stl")),))
    report = check_motion(cupboard(door=lost))
    assert report.ok
    assert kinds(report, "door", "cannot_say") == ["missing_shapes"]


def test_a_model_without_shapes_cannot_be_judged():
    report = check_motion(cupboard(door=Body(), drawer=Body(), carcass=Body()))
    assert report.ok
    assert kinds(report, "door", "cannot_say") == ["no_shapes"]


def test_a_carrier_without_shapes_holds_what_nobody_sees():
    report = check_motion(cupboard(carcass=Body()))
    assert report.ok
    assert kinds(report, "door", "cannot_say") == ["no_shapes"]


def test_an_empty_model_and_speeds_are_no_error():
    assert check_motion(kv.Model()).coordinates == ()
    report = check_motion(kv.load("articulations/differential_drive"))
    assert kinds(report, "differential_drive/base/x", "cannot_say") == ["no_sweep"]
    free = cupboard(slide=kv.articulations.Floating(name="drawer", parent="cupboard", child="drawer"))
    assert not check_motion(free).suspects
    assert kinds(check_motion(free), "drawer/x", "cannot_say") == ["no_sweep"]


def test_a_report_says_everything_as_data():
    report = check_motion(cupboard(hinge=replace(HINGE, upper=86.0)))
    data = report["door"].to_json()
    assert data["name"] == "door"
    assert data["ok"] is False
    (finding,) = data["findings"]
    assert finding.keys() == {
        "kind",
        "text",
        "advice",
        "joint",
        "bodies",
        "against",
        "value",
        "limit",
        "unit",
        "state",
    }
    assert finding["bodies"] == ["door"]
    assert (finding["value"], finding["unit"]) == (pytest.approx(86.0), "rad")
    assert data["suspects"] == data["cannot_say"] == []
    with pytest.raises(kv.errors.UnknownNameError, match="door"):
        report["dor"]


# Shapes


def cube(tmp_path, name, faces=slice(None), order=slice(None)):
    corners = [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]
    squares = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    triangles = [t for a, b, c, d in squares for t in ((a, b, c), (a, c, d))][faces]
    lines = [f"v {x} {y} {z}" for x, y, z in corners]
    lines += ["f " + " ".join(str(k + 1) for k in triangle[order]) for triangle in triangles]
    path = tmp_path / f"{name}.obj"
    path.write_text("\n".join(lines))
    return str(path)


def test_meshes_are_inside_out_if_they_are_closed_and_not_mirrored(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    right = cube(tmp_path, "right")
    wrong = cube(tmp_path, "wrong", order=slice(None, None, -1))
    opened = cube(tmp_path, "opened", faces=slice(2, None), order=slice(None, None, -1))
    for path, expected in ((right, False), (wrong, True), (opened, False)):
        oracle = trimesh.load(path)
        assert is_inside_out(Mesh(path)) is expected
        assert expected is bool(oracle.is_watertight and oracle.volume < 0)
        assert is_inside_out(Mesh(path, scale=(-1.0, 1.0, 1.0))) is expected
    report = check_motion(cupboard(door=Body(collisions=(kv.model.body.Shape(Mesh(wrong)),))))
    assert "inside_out" in kinds(report, "door")


def test_distances_from_a_hull_agree_with_scipy():
    spatial = pytest.importorskip("scipy.spatial")
    rng = np.random.default_rng(4)
    seen = []
    for _ in range(30):
        part, point, direction = (
            PartShape(rng.normal(size=(12, 3))),
            rng.normal(size=3) * 2,
            rng.normal(size=3),
        )
        direction /= np.linalg.norm(direction)
        # Along the line, the hull is a polygon, and the line a point.
        plane = np.linalg.svd(direction[None])[2][1:]
        across = (part.points - point) @ plane.T
        hull = spatial.ConvexHull(across)
        ring = across[hull.vertices]
        steps = np.roll(ring, -1, axis=0) - ring
        along = np.clip(-(ring * steps).sum(axis=1) / (steps * steps).sum(axis=1), 0.0, 1.0)
        distance = np.linalg.norm(ring + along[:, None] * steps, axis=1).min()
        inside = (hull.equations[:, 2] <= 0.0).all()
        seen.append(inside)
        expected = 0.0 if inside else distance
        assert part.distance_to_line(point, direction) == pytest.approx(expected, rel=1e-3, abs=1e-9)
        solid = spatial.ConvexHull(part.points)
        beyond = max(0.0, (solid.equations @ np.append(point, 1.0)).max())
        assert part.distance_to(point) == pytest.approx(beyond, abs=1e-9)
    assert any(seen)
    assert not all(seen)


def test_the_least_principal_extent_is_the_thickness_of_a_tilted_plate():
    corners = np.array([[x, y, z] for x in (0, 2) for y in (0, 1) for z in (0, 0.1)], dtype=float)
    turned = corners @ axis_angle(np.array([1.0, 2.0, 3.0]), np.array(0.7)).T
    assert PartShape(turned).principal_extents[1] == pytest.approx([2, 1, 0.1], rel=0.2)
    assert PartShape(turned).thickness == pytest.approx(0.1, rel=1e-6)


def test_accepted_depths_grow_with_the_part_and_with_the_depth_at_rest():
    assert accepted_depth(0.0, 1.0) < accepted_depth(0.01, 1.0) < accepted_depth(0.02, 1.0)
    assert accepted_depth(1.0, 1.0) == accepted_depth(2.0, 1.0)
    assert accepted_depth(0.0, 0.01) > 0.0
    assert GAP < AWAY


def test_a_range_without_limits_is_half_a_turn_or_the_size_of_the_part():
    model = cupboard(hinge=replace(HINGE, lower=None, upper=None), slide=replace(SLIDE, lower=None))
    parts = MovingParts(model)
    door, drawer = (MovingPart(parts, parts.groups[k], parts.groups[k].coordinates[0]) for k in (1, 2))
    assert door.range == pytest.approx((-math.pi, math.pi))
    assert drawer.range == (pytest.approx(-0.54), 0.35)
    report = check_motion(cupboard(slide=replace(SLIDE, lower=-1e300, upper=1e300)))
    assert kinds(report, "drawer", "suspects") == ["no_limits"]


def test_a_sphere_has_points_around_it():
    model = cupboard(drawer=body(kv.model.body.Shape(Sphere(0.1))))
    assert MovingParts(model).body_shape("drawer").size == pytest.approx(0.2)


# Furniture

SOUND = ["kitchen", "kitchens/3", "shelf_drawers", "articulations/microwave", "articulations/garage_door"]


@pytest.mark.parametrize("name", SOUND)
def test_furniture_that_ships_is_sound(name):
    report = check_motion(kv.load(name))
    assert [(e.kind, e.joint, e.text) for e in (*report.findings, *report.suspects)] == []


@pytest.mark.parametrize("name", ["pr2", "hsr", "fetch"])
def test_robots_that_ship_have_no_findings(name):
    assert check_motion(kv.load(name)).findings == ()


@pytest.mark.data
def test_furniture_of_other_people_has_the_mistakes_that_are_known():
    folder = published_path("furniture_sim", "furniture_sim")
    found = {
        file.stem: [(entry.kind, entry.bodies) for entry in check_motion(kv.load(file)).findings]
        for file in sorted(folder.glob("*.xml"))
    }
    assert found.pop("oven") == [("center_of_mass_outside", ("lightswitchroot",))]
    assert found.pop("microwave") == [("inside_out", ("microdoorroot",))]
    assert not any(found.values())
