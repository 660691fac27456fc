"""Poses, frames and scopes: the semantics of SDF, and that equal descriptions are equal models."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import kineverse as kv
from hypothesis_profiles import attempts
from kineverse.formats.sdf import SdfRoot, parse_sdf
from kineverse.formats.sdf.operations import sdf_operations
from kineverse.formats.urdf import parse_urdf
from kineverse.formats.urdf.operations import urdf_operations


def model_of(text: str, prefix: str | None = None) -> kv.Model:
    model = kv.Model()
    with model.edit() as edit:
        for operation in sdf_operations(parse_sdf(text), prefix):
            edit.apply(operation)
    return model


def sdf(*parts: str, version: str = "1.10", attributes: str = "") -> str:
    return f'<sdf version="{version}"><model name="m" {attributes}>{"".join(parts)}</model></sdf>'


def pose(text: str, attributes: str = "") -> str:
    return f"<pose {attributes}>{text}</pose>"


def link(name: str, inside: str = "") -> str:
    return f'<link name="{name}">{inside}</link>'


def at(model: kv.Model, frame: str, **positions: float) -> np.ndarray:
    return np.asarray(model.fk(frame)(positions))


def test_chained_poses_are_composed():
    text = sdf(
        pose("0 0 1 0 0 0"),
        link("a", pose("1 0 0 0 0 1.5707963267948966")),
        link("b", pose("1 0 0 0 0 0", 'relative_to="a"')),
        '<frame name="f" attached_to="b">' + pose("0 0 2 0 0 0") + "</frame>",
        '<frame name="g" attached_to="a">' + pose("0 0 5 0 0 0", 'relative_to="f"') + "</frame>",
    )
    scene = parse_sdf(text)
    assert scene.roots == (SdfRoot("a"), SdfRoot("b", free=True))
    assert {frame.name: frame.parent for frame in scene.frames} == {"f": "b", "g": "a"}
    assert at(model_of(text), "a")[:3, 3].tolist() == [1, 0, 1]
    assert scene.links[1].pose.matrix[:3, 3].tolist() == [1, 1, 1]
    assert at(model_of(text), "g")[:3, 3].tolist() == [1, 1, 8]
    assert at(model_of(text, "p"), "p/g")[:3, 3].tolist() == [1, 1, 8]


@pytest.mark.parametrize(
    "text",
    [
        pose("1 2 3 90 0 0", 'degrees="true"'),
        pose("1 2 3 0.7071067811865476 0 0 0.7071067811865476", 'rotation_format="quat_xyzw"'),
        pose("1 2 3 2 0 0 2", 'rotation_format="quat_xyzw" degrees="false"'),
        pose("1 2 3 1.5707963267948966 0 0", 'rotation_format="euler_rpy"'),
    ],
)
def test_rotation_formats_are_read(text: str):
    expected = [[1, 0, 0, 1], [0, 0, -1, 2], [0, 1, 0, 3]]
    np.testing.assert_allclose(at(model_of(sdf(link("a", text))), "a")[:3], expected, atol=1e-15)


@pytest.mark.parametrize("frame", ["l", "f", "__model__", "inner", "inner::l"])
def test_placement_frames_place_models(frame: str):
    text = sdf(
        pose("1 2 3 0.1 0.2 0.3"),
        link("l", pose("0 0 1 0.4 0 0")),
        '<frame name="f">' + pose("0 1 0 0 0.5 0", 'relative_to="l"') + "</frame>",
        '<frame name="__" attached_to="__model__"/>',
        f'<model name="inner" placement_frame="l">{pose("4 4 4 0 0 0.2")}{link("l", pose("1 0 0 0 0 1"))}</model>',
        attributes=f'placement_frame="{frame}"',
    )
    model = model_of(text.replace('name="__"', 'name="origin"'))
    name = {"__model__": "origin", "inner::l": "inner/l"}.get(frame, frame)
    expected = matrix((1, 2, 3, 0.1, 0.2, 0.3))
    np.testing.assert_allclose(model.fk(name)(dict(model.default_state())), expected, atol=1e-14)


def test_scopes_become_paths():
    text = sdf(
        link("l"),
        f'<model name="a">{pose("1 0 0 0 0 0")}{link("l")}<model name="b">{pose("1 0 0 0 0 0")}{link("l")}'
        "</model></model>",
        '<joint name="j" type="fixed"><parent>l</parent><child>a::b::__model__</child></joint>',
        '<joint name="k" type="revolute"><parent>a::b::l</parent><child>a::l</child>'
        "<axis><xyz>0 0 1</xyz></axis></joint>",
    )
    model = model_of(text)
    assert set(model.frames) == {"l", "a", "a/l", "a/b", "a/b/l"}
    assert at(model, "a/b/l", k=0.3)[:3, 3].tolist() == [2, 0, 0]
    assert [str(s) for s in model.degrees_of_freedom] == ["k"]


WORLD = f"""<sdf version="1.8"><world name="w">
<model name="table"><static>true</static>{pose("0 0 1 0 0 0")}{link("top")}
  <link name="leg"/><joint name="stuck" type="revolute"><parent>top</parent><child>leg</child>
  <axis><xyz>0 0 1</xyz></axis></joint></model>
<model name="cup">{pose("0 0 2 0 0 0", 'relative_to="table"')}{link("body")}</model>
<model name="lamp">{link("foot")}<joint name="screwed" type="fixed"><parent>world</parent><child>foot</child></joint>
</model><frame name="mark" attached_to="cup">{pose("1 0 0 0 0 0")}</frame></world></sdf>"""


def test_first_world_is_read():
    scene, model = parse_sdf(WORLD), model_of(WORLD)
    assert set(model.frames) == {
        "table",
        "table/top",
        "table/leg",
        "cup",
        "cup/body",
        "lamp",
        "lamp/foot",
        "mark",
    }
    assert {str(s).rpartition("/")[0] for s in model.degrees_of_freedom} == {"cup/body/free"}
    assert len(model.articulations["cup/body/free"].speeds) == 6
    assert at(model, "lamp/foot")[2, 3] == 0
    assert at(model, "table/leg")[2, 3] == 1
    assert model.fk("mark")(dict(model.default_state()))[:3, 3].tolist() == [1, 0, 3]
    assert any("stuck" in remark and "rigidly" in remark for remark in scene.remarks)


def test_several_models_have_their_own_prefixes():
    one, two = (
        f'<model name="a">{link("l")}</model>',
        f'<model name="b">{pose("1 0 0 0 0 0")}{link("l")}</model>',
    )
    model = model_of(f'<sdf version="1.7">{one}{two}</sdf>', "p")
    assert set(model.frames) == {"p/a", "p/a/l", "p/b", "p/b/l"}
    assert at(model, "p/b/l")[0, 3] == 1


def test_axes_before_version_1_5_are_in_the_model_frame():
    joint = '<joint name="j" type="revolute"><parent>a</parent><child>b</child><axis><xyz>1 0 0</xyz>{}</axis></joint>'
    turned = link("a") + link("b", pose("0 0 0 0 0 1.5707963267948966"))
    own, models = [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]
    for version, said, axis in [
        ("1.4", "", models),
        ("1.5", "", own),
        ("1.6", "<use_parent_model_frame>1</use_parent_model_frame>", models),
        ("1.7", "", own),
    ]:
        model = model_of(sdf(turned, joint.format(said), version=version))
        np.testing.assert_allclose(model.jacobian("b")({"j": 0.2})[3:, 0], axis, atol=1e-15)


FRAMES = sdf(
    link("a", pose("1 0 0 0.3 0 0")),
    link("b", pose("1 0 0 0 0 1.5", 'relative_to="a"') + "<visual name='v'>" + pose("0 0 5 0 0 0", 'relative_to="a"')
         + "<geometry><sphere><radius>0.1</radius></sphere></geometry></visual>"),
    link("c", pose("0 2 0 0 0 0", 'relative_to="inner::l"')),
    '<frame name="f" attached_to="b">' + pose("0 0 1 0.2 0 0") + "</frame>",
    '<model name="inner" placement_frame="l">'
    + pose("4 4 4 0 0 0.2", 'relative_to="a"')
    + link("l", pose("1 0 0 0 0 1"))
    + "</model>",
    '<joint name="j" type="revolute">' + pose("0 1 0 0 0 0", 'relative_to="a"') + "<parent>a</parent><child>b</child>"
    '<axis><xyz expressed_in="f">1 0 0</xyz></axis></joint>',
)  # fmt: skip


@pytest.mark.parametrize("version", ["1.2", "1.4", "1.5", "1.6", "1.7", "1.12"])
def test_references_to_frames_are_obeyed_in_files_of_every_version(version: str):
    text = FRAMES.replace('version="1.10"', f'version="{version}"')
    if version < "1.5" and not version.startswith("1.1"):  # older ones give axes in the frame of the model
        text = text.replace("</xyz>", "</xyz><use_parent_model_frame>0</use_parent_model_frame>")
    scene, expected = parse_sdf(text), parse_sdf(FRAMES)
    for found, wanted in zip(scene.links, expected.links, strict=True):
        assert (found.name, found.pose, found.body) == (wanted.name, wanted.pose, wanted.body)
    assert [f.pose for f in scene.frames] == [f.pose for f in expected.frames]
    assert [(j.pose_in_parent, j.axes) for j in scene.joints] == [
        (j.pose_in_parent, j.axes) for j in expected.joints
    ]
    said = [r for r in scene.remarks if "SDF does not define before 1.7" in r]
    assert len(said) == (3 if version in ("1.2", "1.4", "1.5", "1.6") else 0)  # once for each attribute


def test_a_pose_of_1_6_is_relative_to_its_frame_attribute_first():
    links = link("a", pose("1 0 0 0 0 0")) + link("b", pose("0 2 0 0 0 0"))
    for attributes, x in [
        ('frame="a"', 1),
        ('frame="a" relative_to="b"', 1),
        ('frame="" relative_to="a"', 0),
    ]:
        scene = parse_sdf(sdf(links, link("c", pose("0 0 0 0 0 0", attributes)), version="1.6"))
        assert scene.links[2].pose.matrix[:2, 3].tolist() == [x, 0]
    scene = parse_sdf(sdf(links, link("c", pose("0 0 3 0 0 0", 'frame="a"')), version="1.7"))
    assert scene.links[2].pose.matrix[:3, 3].tolist() == [0, 0, 3]
    assert any("has frame, which is relative_to since SDF 1.7" in r for r in scene.remarks)


def test_unknown_frames_of_attributes_that_came_with_1_7_are_passed_over_before():
    joint = '<joint name="j" type="revolute"><parent>a</parent><child>b</child><axis><xyz expressed_in="x">0 1 0</xyz></axis></joint>'
    text = sdf(link("a"), link("b", pose("0 0 3 0 0 0", 'relative_to="nothing"')), joint, version="1.6")
    scene = parse_sdf(text)
    assert scene.links[1].pose.matrix[:3, 3].tolist() == [0, 0, 3]
    assert scene.joints[0].axes[0].xyz == (0.0, 1.0, 0.0)
    assert sum("it is passed over" in r for r in scene.remarks) == 2
    with pytest.raises(kv.errors.FormatError, match='refers to "nothing"'):
        parse_sdf(text, strict=True)


def test_what_a_version_no_longer_has_is_ignored_with_a_remark():
    joint = '<joint name="j" type="revolute"><parent>a</parent><child>b</child><axis><xyz>1 0 0</xyz>{}</axis></joint>'
    turned = link("a") + link("b", pose("0 0 0 0 0 1.5707963267948966"))
    scene = parse_sdf(sdf(turned, joint.format("<use_parent_model_frame>1</use_parent_model_frame>")))
    assert scene.joints[0].axes[0].xyz == (1.0, 0.0, 0.0)
    assert any("use_parent_model_frame" in r for r in scene.remarks)
    inertia = "<inertial>" + pose("1 0 0 0 0 0", 'relative_to="a"') + "<mass>2</mass></inertial>"
    scene = parse_sdf(sdf(link("a", pose("0 5 0 0 0 0")), link("b", inertia)))
    assert scene.links[1].body.inertia.origin.matrix[:3, 3].tolist() == [1, 0, 0]
    assert any("an inertia is always given in its link" in r for r in scene.remarks)


NUMBER = st.floats(-2, 2).map(lambda x: round(x, 6))
POSE = st.tuples(*[NUMBER] * 6)


def matrix(numbers: tuple[float, ...]) -> np.ndarray:
    return parse_sdf(sdf(link("l", pose(" ".join(map(repr, numbers)))))).links[0].pose.matrix


def rpy(m: np.ndarray) -> tuple[float, ...]:
    """Return six numbers of a pose that is away from gimbal lock."""
    r = m[:3, :3]
    angles = np.arctan2(r[2, 1], r[2, 2]), -np.arcsin(np.clip(r[2, 0], -1, 1)), np.arctan2(r[1, 0], r[0, 0])
    return (*map(float, m[:3, 3]), *map(float, angles))


TREE = st.lists(
    st.tuples(st.integers(0, 99), POSE, POSE, st.tuples(NUMBER, NUMBER, NUMBER)), min_size=1, max_size=5
)


def said(m: np.ndarray, relative: str) -> str:
    return pose(" ".join(map(repr, rpy(m))), f'relative_to="{relative}"')


def written(tree: list, about: list[int]) -> str:
    """Write a tree of hinges, each pose relative to the frame that ``about`` returns."""
    places = {"__model__": np.eye(4), "l0": np.eye(4)}
    parts, names = [link("l0")], ["__model__", "l0"]
    for n, (above, joint, child, axis) in enumerate(tree, start=1):
        parent = f"l{above % n}"
        j = places[f"j{n}"] = places[parent] @ matrix(joint)
        c = places[f"l{n}"] = j @ matrix(child)
        pick, other = names[about[2 * n] % len(names)], names[about[2 * n + 1] % len(names)]
        names += [f"l{n}"]
        a = np.array(axis) if np.linalg.norm(axis) > 0.1 else np.array([0, 0, 1.0])
        expressed = places[other][:3, :3].T @ j[:3, :3] @ a
        parts += [
            link(f"l{n}", said(np.linalg.inv(places[pick]) @ c, pick)),
            f'<joint name="j{n}" type="revolute">{said(np.linalg.inv(places[other]) @ j, other)}'
            f'<parent>{parent}</parent><child>l{n}</child><axis><xyz expressed_in="{other}">'
            f"{' '.join(map(repr, map(float, expressed)))}</xyz></axis></joint>",
        ]
        names += [f"j{n}"]
    return sdf(*parts)


@settings(max_examples=attempts(25), deadline=None)
@given(TREE, st.lists(st.integers(0, 99), min_size=12, max_size=12), st.lists(NUMBER, min_size=5, max_size=5))
def test_relative_to_does_not_change_world_poses(tree, about, q):
    state = {f"j{n}": q[n - 1] for n in range(1, len(tree) + 1)}
    first, second = model_of(written(tree, [0] * 12)), model_of(written(tree, about))
    for n in range(len(tree) + 1):
        a, b = first.fk(f"l{n}"), second.fk(f"l{n}")
        assert a.symbols == b.symbols
        values = {str(s): state[str(s)] for s in a.symbols}
        np.testing.assert_allclose(a(values), b(values), atol=1e-7)  # angles from matrices near gimbal lock


@settings(max_examples=attempts(25), deadline=None)
@given(TREE, st.lists(NUMBER, min_size=5, max_size=5))
def test_urdf_and_equivalent_sdf_move_alike(tree, q):
    urdf, parts = ['<robot name="r"><link name="l0"/>'], [link("l0")]
    for n, (above, joint, _, axis) in enumerate(tree, start=1):
        xyz, angles = " ".join(map(repr, joint[:3])), " ".join(map(repr, joint[3:]))
        a = " ".join(map(repr, axis if np.linalg.norm(axis) > 0.1 else (0.0, 0.0, 1.0)))
        parent, kind = f"l{above % n}", ("revolute", "prismatic", "continuous")[n % 3]
        limits = '<limit lower="-1" upper="1" effort="2" velocity="3"/>'
        urdf.append(
            f'<link name="l{n}"/><joint name="j{n}" type="{kind}"><parent link="{parent}"/><child link="l{n}"/>'
            f'<origin xyz="{xyz}" rpy="{angles}"/><axis xyz="{a}"/>{limits}</joint>'
        )
        limits = "<limit><lower>-1</lower><upper>1</upper><effort>2</effort><velocity>3</velocity></limit>"
        parts += [
            link(f"l{n}", pose(f"{xyz} {angles}", f'relative_to="{parent}"')),
            f'<joint name="j{n}" type="{kind}"><parent>{parent}</parent><child>l{n}</child>'
            f"<axis><xyz>{a}</xyz>{limits}</axis></joint>",
        ]
    first = kv.Model()
    with first.edit() as edit:
        for operation in urdf_operations(parse_urdf("".join([*urdf, "</robot>"]))):
            edit.apply(operation)
    second = model_of(sdf(*parts))
    assert set(first.frames) == set(second.frames)
    assert dict(first.articulations) == dict(second.articulations)
    assert set(first.constraints) == set(second.constraints)
    for n in range(len(tree) + 1):
        pose_of = first.fk(f"l{n}")
        values = {str(s): q[int(str(s)[1:]) - 1] for s in pose_of.symbols}
        np.testing.assert_allclose(second.fk(f"l{n}")(values), pose_of(values), atol=1e-12)
