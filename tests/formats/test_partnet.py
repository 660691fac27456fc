"""PartNet-Mobility: files written by hand, the object's axes, limits, screws, meshes, and nonsense."""

import json
import math

import numpy as np
import pytest

import kineverse as kv
from kineverse.errors import FormatError
from kineverse.formats import collect_warnings
from kineverse.geometry import Scene, check_motion

BOX = """v -.5 -.5 -.5\nv .5 -.5 -.5\nv .5 .5 -.5\nv -.5 .5 -.5\nv -.5 -.5 .5\nv .5 -.5 .5\nv .5 .5 .5\nv -.5 .5 .5
f 1 3 2\nf 1 4 3\nf 5 6 7\nf 5 7 8\nf 1 2 6\nf 1 6 5\nf 4 8 7\nf 4 7 3\nf 2 3 7\nf 2 7 6\nf 1 5 8\nf 1 8 4\n"""


def part(number, parent, joint, name="part", origin=(0, 0, 0), direction=(0, 1, 0), parts=(), **limit):
    limit = {"a": 0.0, "b": 90.0, "noLimit": False} | limit
    data = {"axis": {"origin": list(origin), "direction": list(direction)}, "limit": limit}
    entry = {"id": number, "parent": parent, "name": name, "joint": joint, "jointData": data}
    return entry | {"parts": [{"id": one, "name": "", "children": []} for one in parts]}


BASE = part(0, -1, "free", "base", parts=[1])


@pytest.fixture
def write(tmp_path):
    def write(*parts, result=({"id": 1, "objs": ["box"]},)):
        if result is not None:
            (tmp_path / "result.json").write_text(json.dumps(list(result)))
            (tmp_path / "textured_objs").mkdir(exist_ok=True)
            (tmp_path / "textured_objs" / "box.obj").write_text(BOX)
        file = tmp_path / "mobility_v2.json"
        file.write_text(
            json.dumps(parts[0] if len(parts) == 1 and not isinstance(parts[0], dict) else list(parts))
        )
        return file

    return write


def test_a_file_and_its_folder_are_the_same_model(write):
    file = write(BASE, part(1, 0, "hinge", "door"))
    by_file, by_folder = kv.load(file), kv.load(file.parent)
    assert by_file.history.tags == by_folder.history.tags
    assert set(by_file.frames) == {"base_0", "door_1"}
    assert [str(s) for s in kv.load(file, prefix="home").degrees_of_freedom] == ["home/door_1"]


def test_a_hinge_is_in_degrees_about_an_axis_of_the_object_with_y_up(write):
    file = write(BASE, part(1, 0, "hinge", "door", (0.3, 0.2, 0.1), (0, 1, 0), a=90.0, b=-30.0))
    model = kv.load(file)
    assert np.rad2deg(model.limits("door_1")).tolist() == pytest.approx([-30, 90])
    angle = 0.7
    pose = model.fk("door_1")({"door_1": angle})
    # y up is z here, and z toward the front is -y.
    np.testing.assert_allclose(pose[:3, 3], [0.3, -0.1, 0.2], atol=1e-15)
    c, s = math.cos(angle), math.sin(angle)
    np.testing.assert_allclose(pose[:3, :3], [[c, -s, 0], [s, c, 0], [0, 0, 1]], atol=1e-15)


@pytest.mark.parametrize("direction", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, -2, 0.5)])
def test_a_point_of_the_part_moves_as_it_does_in_the_axes_of_the_object(write, direction):
    """Turn a point by Rodrigues' formula in the file's own axes, and compare it in ours."""
    origin, angle, p = np.array([0.1, -0.4, 0.2]), 0.9, np.array([0.5, 0.3, -0.2])
    model = kv.load(write(BASE, part(1, 0, "hinge", "door", origin.tolist(), direction)))
    axis = np.array(direction) / np.linalg.norm(direction)
    arm = p - origin
    turned = arm * math.cos(angle) + np.cross(axis, arm) * math.sin(angle)
    expected = origin + turned + axis * (axis @ arm) * (1 - math.cos(angle))
    up = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    rest = model.fk("door_1")({"door_1": 0.0})
    local = np.linalg.inv(rest) @ np.append(up @ p, 1)
    seen = (model.fk("door_1")({"door_1": angle}) @ local)[:3]
    np.testing.assert_allclose(seen, up @ expected, atol=1e-14)


def test_axes_of_parts_on_parts_are_those_of_the_object(write):
    """The axis of a knob on a door is in the axes of the object, not of the door."""
    file = write(
        part(2, 1, "hinge", "knob", (0.5, 0.1, 0.3), (0, 0, 1)),  # children may come first
        part(1, 0, "hinge", "door", (0.4, 0.0, 0.3), (0, 1, 0)),
        BASE,
    )
    model = kv.load(file)
    still = {"door_1": 0.0, "knob_2": 0.0}
    np.testing.assert_allclose(model.fk("knob_2")(still)[:3, 3], [0.5, -0.3, 0.1], atol=1e-15)
    both = model.fk("knob_2")(still | {"knob_2": 0.5})
    np.testing.assert_allclose(both[:3, :3] @ [0, -1, 0], [0, -1, 0], atol=1e-15)


def test_no_limit_and_sliders(write):
    file = write(
        BASE,
        part(1, 0, "hinge", "wheel", noLimit=True, a=None, b=None),
        part(2, 0, "slider", "drawer", direction=(0, 0, 1), a=0.1, b=-0.2),
        part(3, 0, "slider", "rod", noLimit=True),
    )
    model = kv.load(file)
    assert model.articulations["wheel_1"].kind == "continuous"
    assert model.limits("drawer_2") == (-0.2, 0.1)
    assert model.limits("rod_3") == (-math.inf, math.inf)
    np.testing.assert_allclose(model.fk("drawer_2")({"drawer_2": 0.1})[:3, 3], [0, -0.1, 0])


@pytest.mark.parametrize("kind", ["slider", "slider+"])
def test_a_slider_that_turns_by_a_known_angle_is_a_screw(write, kind):
    more = {"rotates": True, "noRotationLimit": False, "rotationLimit": 720.0, "a": 0.0, "b": 0.05}
    model = kv.load(write(BASE, part(1, 0, kind, "cap", direction=(0, 1, 0), **more)))
    assert model.articulations["cap_1"].kind == "screw"
    lower, upper = model.limits("cap_1")
    assert (lower, upper) == pytest.approx((0.0, 4 * math.pi))
    np.testing.assert_allclose(model.fk("cap_1")({"cap_1": upper})[:3, 3], [0, 0, 0.05], atol=1e-15)


@pytest.mark.parametrize(
    "more",
    [
        {"noRotationLimit": True},
        {"noRotationLimit": False, "rotationLimit": 0.0},
        {},
        {"rotationLimit": 90.0, "noLimit": True},
    ],
)
def test_a_slider_that_turns_freely_is_cylindrical_and_said(write, more):
    file = write(BASE, part(1, 0, "slider", "cap", rotates=True, **more))
    with collect_warnings() as said:
        model = kv.load(file)
    assert {str(s) for s in model.degrees_of_freedom} == {"cap_1/slide", "cap_1/turn"}
    assert any("cylindrical" in text and "part 1" in text for text in said)
    assert not kv.load(write(BASE, part(1, 0, "slider+", "cap", rotates=False))).rates


def test_free_parts_float_and_the_only_root_stands(write):
    model = kv.load(write(BASE, part(1, -1, "free", "lid"), part(2, 0, "fixed", "foot")))
    assert {str(s) for s in model.degrees_of_freedom} >= {"base_0/x", "lid_1/qw"}
    assert not kv.load(write(BASE, part(2, 0, "fixed", "foot"))).degrees_of_freedom


def test_junk_is_left_out_and_said_and_its_children_go_up(write):
    file = write(BASE, part(1, 0, "junk", "dust"), part(2, 1, "hinge", "door"))
    with collect_warnings() as said:
        model = kv.load(file)
    assert set(model.frames) == {"base_0", "door_2"}
    assert model.frames["door_2"].parent == "base_0"
    assert any("junk" in text for text in said)


def test_meshes_are_those_of_the_leaves_and_turned_upright(write):
    result = [
        {"id": 7, "objs": [], "children": [{"id": 1, "objs": ["box"]}, {"id": 2, "objs": ["box", "gone"]}]}
    ]
    file = write(
        part(0, -1, "fixed", "base", parts=[7, 1]), part(1, 0, "hinge", "door", parts=[1]), result=result
    )
    with collect_warnings() as said:
        model = kv.load(file)
    assert [s.geometry.uri for s in model.bodies["base_0"].visuals] == [
        "textured_objs/box.obj",
        "textured_objs/gone.obj",
    ]
    assert any("gone.obj is missing" in text for text in said)
    scene = Scene(model, leave_out=[("base_0", 1)])
    scene.update({"door_1": 0.0})
    assert scene.distance("base_0", "door_1").distance == pytest.approx(-1.0)  # two cubes at one place


def test_a_mesh_is_placed_in_the_axes_with_z_up(write):
    """The lid is 2 above in y, so it is 2 above in z, wherever its joint is."""
    result = [{"id": 1, "objs": ["box"]}, {"id": 2, "objs": ["lid"]}]
    file = write(
        part(0, -1, "fixed", "base", parts=[1]),
        part(1, 0, "hinge", "lid", origin=(0.3, -0.7, 0.2), parts=[2]),
        result=result,
    )
    lines = (
        f"v {a} {float(b) + 2} {c}" if kind == "v" else f"{kind} {a} {b} {c}"
        for kind, a, b, c in (line.split() for line in BOX.splitlines())
    )
    (file.parent / "textured_objs" / "lid.obj").write_text("\n".join(lines))
    model = kv.load(file)
    scene = Scene(model)
    scene.update(model.default_state())
    found = scene.distance("base_0", "lid_1")
    assert found.distance == pytest.approx(1.0)
    np.testing.assert_allclose(found.normal, [0, 0, 1], atol=1e-9)


def test_missing_files_of_the_drawing_are_said(write):
    file = write(part(0, -1, "fixed", "base", parts=[1]), result=None)
    with collect_warnings() as said:
        assert not kv.load(file).bodies
    assert any("result.json is missing" in text for text in said)
    file = write(part(0, -1, "fixed", "base", parts=[99]))
    with collect_warnings() as said:
        assert not kv.load(file).bodies
    assert any("no part 99" in text for text in said)


def test_sizes_are_no_metres_so_that_densities_and_millimetres_are_not_checked(write):
    file = write(
        part(0, -1, "fixed", "base", parts=[1]), part(1, 0, "slider", "drawer", parts=[1], a=0.0, b=1e-4)
    )
    model = kv.load(file, prefix="home")
    assert model.data["home/geometry/normalized"]
    assert not check_motion(model).findings


CYCLE = [BASE, part(1, 2, "hinge"), part(2, 1, "hinge")]


@pytest.mark.parametrize(
    ("parts", "said"),
    [
        (CYCLE, "part 1 hangs on itself: 1 → 2 → 1"),
        ([part(1, 1, "hinge")], "part 1 hangs on itself"),
        ([part(1, 1, "junk"), BASE, part(2, 1, "hinge")], "part 2 hangs on part 1"),
        ([BASE, part(1, 8, "hinge")], "part 1 hangs on part 8, which is not there"),
        ([BASE, part(0, -1, "fixed")], "two parts with the id 0"),
        ([BASE, part(1, 0, "hinge", a=math.nan)], "part 1: its limit a is a finite number, not nan"),
        ([BASE, part(1, 0, "hinge", a="0")], "limit a is a finite number, not '0'"),
        ([BASE, part(1, 0, "hinge", a=True)], "limit a is a finite number"),
        ([BASE, part(1, 0, "hinge", b=None)], "limit b is a finite number"),
        ([BASE, part(1, 0, "hinge", noLimit="no")], "noLimit is true or false"),
        ([BASE, part(1, 0, "hinge", direction=(0, 0, 0))], "direction of its axis is 0"),
        ([BASE, part(1, 0, "hinge", direction=(1, 0))], "direction of its axis is three numbers"),
        ([BASE, part(1, 0, "hinge", origin=(1e400, 0, 0))], "axis origin is a finite number"),
        ([BASE, part(1, 0, "hinges")], "Did you mean 'hinge'"),
        ([BASE, part(1, 0, None)], "its joint is None"),
        ([BASE, part("1", 0, "hinge")], "its id is a whole number, not '1'"),
        ([BASE, part(True, 0, "hinge")], "its id is a whole number"),
        ([BASE, part(-4, 0, "hinge")], "its id is -4"),
        ([BASE, part(1, None, "hinge")], "its parent is a whole number"),
        ([BASE, part(1, 0, "hinge", 5)], "its name is a text"),
        ([BASE, part(1, 0, "hinge") | {"jointData": []}], "jointData is an object"),
        ([BASE, part(1, 0, "hinge") | {"jointData": {}}], "its axis is an object"),
        ([BASE, part(1, 0, "hinge") | {"parts": 3}], "its parts are a list"),
        ([BASE, part(1, 0, "hinge") | {"parts": ["x"]}], "its parts is an object"),
        ([BASE, part(1, 0, "hinge") | {"parts": [{"id": []}]}], "the id of one of its parts"),
        ([BASE, 5], "entry 2"),
        ([part(0, -1, "junk")], "all its parts are junk"),
    ],
)
def test_nonsense_is_refused_with_the_part_and_the_reason(write, parts, said):
    with pytest.raises(FormatError) as error:
        kv.load(write(*parts) if len(parts) > 1 else write(parts))
    assert said in str(error.value)
    assert "mobility_v2.json" in str(error.value)


@pytest.mark.parametrize("text", ["", "{", "{}", "[]", "3", "[" * 100_000])
def test_other_text_is_refused(tmp_path, text):
    file = tmp_path / "mobility_v2.json"
    file.write_text(text)
    with pytest.raises(FormatError, match=r"mobility_v2\.json"):
        kv.load(file)


@pytest.mark.parametrize(
    "result",
    [[], [3], [{"id": "1"}], [{"id": 1, "objs": 5}], [{"id": 1, "objs": [3]}], [{"id": 1, "children": {}}]],
)
def test_a_broken_drawing_is_refused(write, result):
    with pytest.raises(FormatError, match=r"result\.json"):
        kv.load(write(BASE, part(1, 0, "hinge"), result=result))


def test_a_mesh_outside_of_the_folder_is_not_opened(write, tmp_path):
    (tmp_path.parent / "secret.obj").write_text(BOX)
    file = write(
        part(0, -1, "fixed", "base", parts=[1]),
        part(1, 0, "hinge", "door", parts=[1]),
        result=[{"id": 1, "objs": ["../../secret"]}],
    )
    model = kv.load(file)
    scene = Scene(model)
    scene.update({"door_1": 0.0})
    with pytest.raises(FormatError, match="secret"):
        scene.distance("base_0", "door_1")


def test_names_become_paths_of_the_model(write):
    names = set(kv.load(write(BASE, part(1, 0, "hinge", "/a//b\n/"), part(2, 0, "hinge", ""))).frames)
    assert names == {"base_0", "a/b__1", "part_2"}
