"""Included models: the search for their files, their poses, and refused addresses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from test_sdf_pose_graph import at, link, pose, sdf
from urdf_texts import LIMIT, joint, robot

import kineverse as kv
from kineverse.formats.sdf import read_sdf

ARM = sdf(
    pose("9 9 9 0 0 0"),
    link("base"),
    link("tip", pose("1 0 0 0 0 0")),
    '<joint name="j" type="revolute"><parent>base</parent><child>tip</child><axis>'
    '<xyz expressed_in="__model__">0 0 1</xyz></axis></joint>',
)
MANIFEST = '<model><sdf version="1.5">old.sdf</sdf><sdf version="1.10">arm.sdf</sdf><sdf version="9.9">n</sdf></model>'


def include(uri: str, inside: str = "", attributes: str = "") -> str:
    return f"<include {attributes}><uri>{uri}</uri>{inside}</include>"


@pytest.fixture(autouse=True)
def models(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder with a model on the search path."""
    folder = tmp_path / "models" / "arm"
    folder.mkdir(parents=True)
    (folder / "model.config").write_text(MANIFEST)
    (folder / "arm.sdf").write_text(ARM)
    for variable in ("IGN_GAZEBO_RESOURCE_PATH", "GAZEBO_MODEL_PATH", "SDF_PATH"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setenv("GZ_SIM_RESOURCE_PATH", str(folder.parent))
    return folder.parent


def file(folder: Path, text: str) -> Path:
    place = folder / "here"
    place.mkdir(exist_ok=True)
    path = place / "x.sdf"
    path.write_text(text)
    return path


@pytest.mark.parametrize("uri", ["model://arm", "arm", "model://arm/arm.sdf", "package://arm"])
def test_included_models_are_read(tmp_path, uri):
    inside = "<name>left</name>" + pose("0 2 0 0 0 0", 'relative_to="f"')
    text = sdf(link("l"), '<frame name="f">' + pose("1 0 0 0 0 0") + "</frame>", include(uri, inside))
    assert set(kv.load(file(tmp_path, text)).frames) == {"l", "f", "left", "left/base", "left/tip"}
    scene = read_sdf(file(tmp_path, text))
    assert {known.name: known.pose.matrix[:3, 3].tolist() for known in scene.links} == {
        "l": [0, 0, 0],
        "left/base": [1, 2, 0],
        "left/tip": [2, 2, 0],
    }


def test_the_pose_of_the_file_counts_where_the_include_has_none(tmp_path):
    (base, _) = read_sdf(file(tmp_path, f'<sdf version="1.10">{include("arm")}</sdf>')).links
    assert base.pose.matrix[:3, 3].tolist() == [9, 9, 9]


def test_static_and_placement_frame(tmp_path):
    inside = pose("0 0 0 0 0 0") + "<placement_frame>tip</placement_frame><static>true</static>"
    world = f'<sdf version="1.10"><world name="w">{include("arm", inside)}</world></sdf>'
    model = kv.load(file(tmp_path, world), prefix="p")
    assert model.degrees_of_freedom == ()
    assert at(model, "p/m/base")[:3, 3].tolist() == [-1, 0, 0]


def test_merged_includes_have_the_names_of_their_parent(tmp_path):
    inside = pose("0 0 0 0 0 1.5707963267948966") + "<name>n</name>"
    text = sdf(link("l"), include("arm", inside, 'merge="true"')).replace(
        "</model>", '<joint name="k" type="fixed"><parent>l</parent><child>base</child></joint></model>'
    )
    model = kv.load(file(tmp_path, text))
    assert set(model.frames) == {"l", "base", "tip"}
    np.testing.assert_allclose(at(model, "tip", j=0.0)[:3, 3], [0, 1, 0], atol=1e-15)


def test_changed_included_files_are_read_again(tmp_path, models):
    path = file(tmp_path, sdf(link("l"), include("arm")))
    assert len(kv.load(path).frames) == 4
    (models / "arm" / "arm.sdf").write_text(sdf(link("only")))
    assert set(kv.load(path).frames) == {"l", "m", "m/only"}


@pytest.mark.parametrize(
    ("uri", "reason"),
    [
        ("../models/arm", "leads out"),
        ("model://../arm", "leads out"),
        ("model://arm/../../here", "leads out"),
        ("model://arm/%2e%2e/x.sdf", "leads out"),
        ("/etc/hostname", "leads out of the root"),
        ("file:///etc/passwd", "leads out of the root"),
        ("https://fuel.gazebosim.org/1.0/x", "is not fetched"),
        ("model://nothing", "is not there"),
        ("", "has no <uri>"),
    ],
)
def test_network_addresses_are_refused(tmp_path, uri, reason):
    with pytest.raises(kv.errors.FormatError, match=reason) as info:
        kv.load(file(tmp_path, sdf(link("l"), include(uri))))
    assert str(info.value).startswith("x.sdf, line 1, <include>: ")


def test_absolute_include_paths_stay_inside_the_root(tmp_path):
    outside = tmp_path / "outside.sdf"
    outside.write_text(ARM)
    for uri in (str(outside), f"file://{outside}"):
        with pytest.raises(kv.errors.FormatError, match="leads out of the root"):
            kv.load(file(tmp_path, sdf(link("l"), include(uri))))
    (tmp_path / "here" / "link.sdf").symlink_to(outside)
    with pytest.raises(kv.errors.FormatError, match="leads out of the root"):
        kv.load(file(tmp_path, sdf(link("l"), include("link.sdf"))))


def test_cyclic_includes_are_refused(tmp_path, models):
    (models / "arm" / "arm.sdf").write_text(sdf(link("l"), include("model://arm")))
    with pytest.raises(kv.errors.FormatError, match="includes itself"):
        kv.load(file(tmp_path, sdf(link("l"), include("model://arm"))))
    with pytest.raises(kv.errors.FormatError, match="includes itself"):
        kv.load(file(tmp_path, sdf(link("l"), include("x.sdf", "<name>again</name>"))))


def test_errors_name_the_included_file(tmp_path, models):
    (models / "arm" / "arm.sdf").write_text(sdf(link("l"), '<frame name="f" attached_to="nothing"/>'))
    with pytest.raises(kv.errors.FormatError) as info:
        kv.load(file(tmp_path, sdf(link("l"), include("arm"))))
    assert str(info.value).startswith("arm.sdf, line 1, <frame name=")


FRAMES = f"""<sdf version="1.8"><model name="test_model_with_frames">
<frame name="F1">{pose("0 0 0 1.570796 0 0")}</frame>
<frame name="F2">{pose("0 0 0 0 0.785398 0", 'relative_to="F1"')}</frame>
{link("L1", pose("", 'relative_to="F1"'))}{link("L2", pose("1 0 0 0 0 0", 'relative_to="F1"'))}
{link("L3", pose("0 1 0 0 0 0", 'relative_to="L2"'))}{link("L4", pose("0 0 1 0 0 0"))}
<joint name="J2" type="fixed"><pose>0 0 1 0 0 0</pose><parent>L2</parent><child>L3</child></joint></model></sdf>"""


def test_placement_frames_of_sdformat(models, monkeypatch, published):
    path = published("sdf_joint_types", "sdformat_test", "placement_frame.sdf")
    folder = models / "test_model_with_frames"
    folder.mkdir()
    (folder / "model.sdf").write_text(FRAMES)
    scene = read_sdf(path)
    places = {thing.name: thing.pose.matrix for thing in scene.links}
    expected = np.eye(4)
    c, s = np.cos(1.570796326794895), np.sin(1.570796326794895)
    expected[1:3, 1:3] = [[c, -s], [s, c]]
    expected[1, 3] = 10
    for name in ("placement_frame_using_link", "parent_model_include/placement_frame_using_link"):
        np.testing.assert_allclose(places[f"{name}/L4"], expected, atol=1e-14)
    for name in ("include_with_placement_frame_and_pose_relative_to", "model_with_link_placement_frame"):
        np.testing.assert_allclose(places[f"{name}/L4"], expected, atol=1e-14)


BODY = (
    '<inertial><origin xyz="0.1 0 0" rpy="0 0 0.3"/><mass value="2"/>'
    '<inertia ixx="1" ixy="0.1" ixz="0" iyy="2" iyz="0" izz="2.5"/></inertial>'
    '<visual name="seen"><origin xyz="0 0 1" rpy="0.1 0 0"/><geometry><box size="1 2 3"/></geometry>'
    '<material name="m"><color rgba="0.1 0.2 0.3 1"/></material></visual>'
    '<collision><geometry><mesh filename="package://robot/a.stl" scale="1 2 3"/></geometry></collision>'
    '<collision><geometry><cylinder radius="0.5" length="2"/></geometry></collision>'
)


@pytest.mark.parametrize("root", ["base", "world"])
def test_an_included_urdf_moves_as_the_urdf_itself(tmp_path: Path, root: str):
    urdf = robot(
        f'<link name="{root}"/><link name="arm">{BODY}</link><link name="tip"/><link name="grip"/>',
        joint(
            "arm",
            root,
            "arm",
            "revolute",
            '<origin xyz="1 2 3" rpy="0.1 0.2 0.3"/><axis xyz="1 2 3"/>' + LIMIT,
        ),
        joint("slide", "arm", "tip", "prismatic", '<axis xyz="0 1 0"/><dynamics damping="3"/>' + LIMIT),
        joint("follows", "tip", "grip", "continuous", '<mimic joint="arm" multiplier="-2" offset="0.1"/>'),
    )
    place = file(tmp_path, sdf(link("l"), include("r.urdf", "<name>r</name>" + pose("0 0 5 0 0 1"))))
    place.with_name("r.urdf").write_text(urdf)
    model, alone = kv.load(place), kv.load(place.with_name("r.urdf"), prefix="r")
    placed = np.eye(4) if root == "base" else kv.translation(0, 0, 5)() @ kv.rotation_z(1.0)()
    values = {"arm": 0.4, "slide": -0.3}
    for name in ("r/arm", "r/tip", "r/grip"):
        there = model.fk(name, relative_to="r/base") if root == "base" else model.fk(name)
        here = alone.fk(name)
        names = {s.path: s for s in there.symbols}
        moved = there(
            {s: values[path.rpartition("/")[2].removesuffix("_joint")] for path, s in names.items()}
        )
        np.testing.assert_allclose(
            moved, placed @ here({s: values[s.path.rpartition("/")[2]] for s in here.symbols}), atol=1e-14
        )
    # A joint cannot have the name of a link in an SDF.
    assert set(model.articulations) >= {"r/arm_joint", "r/slide", "r/follows"}
    for ours, known in (("r/arm_joint", "r/arm"), ("r/slide", "r/slide")):
        assert model.limits(ours) == alone.limits(known)
        assert (
            dict(model.articulations[ours].dynamics).items()
            >= dict(alone.articulations[known].dynamics).items()
        )
    assert [s.geometry for s in model.bodies["r/arm"].collisions][1] == alone.bodies["r/arm"].collisions[
        1
    ].geometry
    seen, known = model.bodies["r/arm"].visuals[0], alone.bodies["r/arm"].visuals[0]
    assert (seen.geometry, seen.color, seen.name) == (known.geometry, known.color, "seen")
    np.testing.assert_allclose(seen.origin.matrix, known.origin.matrix, atol=1e-15)
    assert model.bodies["r/arm"].inertia.tensor == alone.bodies["r/arm"].inertia.tensor
    mesh = model.bodies["r/arm"].collisions[0].geometry
    assert (mesh.uri, mesh.scale, mesh.folder) == ("package://robot/a.stl", (1, 2, 3), str(place.parent))


def test_floating_joints_of_an_included_urdf_leave_the_link_free(tmp_path: Path):
    urdf = robot(joint("fly", "l0", "l1", "floating", '<origin xyz="1 0 0"/>'), links=2)
    place = file(tmp_path, sdf(link("l"), include("r.urdf")))
    place.with_name("r.urdf").write_text(urdf)
    model = kv.load(place)
    assert model.articulations["r/l1/free"].kind == "floating"
    np.testing.assert_allclose(model.fk("r/l1")(model.default_state())[:3, 3], [1, 0, 0])
    place.with_name("r.urdf").write_text(urdf.replace("floating", "planar"))
    with pytest.raises(kv.errors.FormatError, match=r'r.urdf, line 4, <joint name="fly">: is planar'):
        kv.load(place)


def test_models_that_include_each_other_without_end_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("kineverse.formats.sdf.reader.MAX_INCLUDED", 200)
    place = file(tmp_path, sdf(link("l"), include("0.sdf")))
    for k in range(40):
        both = include(f"{k + 1}.sdf", "<name>a</name>") + include(f"{k + 1}.sdf", "<name>b</name>")
        place.with_name(f"{k}.sdf").write_text(sdf(link("l"), both))
    place.with_name("40.sdf").write_text(sdf(link("l")))
    with pytest.raises(kv.errors.FormatError, match="there are more than 200 elements"):
        kv.load(place)
