"""The search for the files of a description: packages, models and paths."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

import kineverse as kv
from kineverse.errors import FormatError
from kineverse.formats import resource_paths
from kineverse.formats.reader_warnings import collect_warnings
from kineverse.formats.resource_paths import locate_mesh, locate_resource
from kineverse.formats.urdf import read_urdf
from kineverse.model.body import Mesh

VARIABLES = (
    *resource_paths._WORKSPACES,
    *resource_paths._PREFIXES,
    *resource_paths._MODELS,
    "ROBOT_DESCRIPTIONS_CACHE",
)


@pytest.fixture(autouse=True)
def _no_variables(monkeypatch, tmp_path):
    for name in VARIABLES:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("ROBOT_DESCRIPTIONS_CACHE", str(tmp_path / "no_cache"))


@pytest.fixture
def make(tmp_path):
    """Return a function that makes a file and the folders above it."""

    def make(path: str, text: str = "") -> str:
        file = tmp_path / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
        return file

    return make


def test_folders_above_the_description_are_searched(make):
    file = make("ws/arm/meshes/a.stl")
    assert locate_resource("package://arm/meshes/a.stl", file.parent.parent / "urdf") == file
    assert locate_resource("package://arm/meshes/a.stl", make("ws/other/urdf/x.urdf").parent) == file


def test_the_name_in_a_manifest_counts(make):
    make("checkout/package.xml", "<package>\n<name> arm </name></package>")
    file = make("checkout/a.stl")
    assert locate_resource("package://arm/a.stl", make("checkout/urdf/x.urdf").parent) == file


def test_explicit_folders_come_first(make, tmp_path):
    make("arm/a.stl")
    file = make("mine/arm/a.stl")
    assert locate_resource("package://arm/a.stl", tmp_path, search=[tmp_path / "mine"]) == file
    assert locate_resource("package://arm/a.stl", tmp_path, search=[tmp_path / "mine" / "arm"]) == file


@pytest.mark.parametrize("variable", resource_paths._WORKSPACES)
def test_workspaces_are_searched_in_depth_but_not_endlessly(make, tmp_path, monkeypatch, variable):
    file = make("ws/src/stack/arm/a.stl")
    make("ws/src/stack/arm/package.xml", "<name>arm</name>")
    make("ws/1/2/3/4/5/deep/package.xml")
    make("ws/1/2/3/4/5/deep/a.stl")
    monkeypatch.setenv(variable, os.pathsep.join([str(tmp_path / "nothing"), str(tmp_path / "ws")]))
    elsewhere = tmp_path / "elsewhere"
    assert locate_resource("package://arm/a.stl", elsewhere) == file
    with pytest.raises(FormatError, match="no package"):
        locate_resource("package://deep/a.stl", elsewhere)


def test_a_package_made_later_is_found(make, tmp_path, monkeypatch):
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(tmp_path / "ws"))
    with pytest.raises(FormatError):
        locate_resource("package://arm/a.stl", tmp_path / "x")
    file = make("ws/src/arm/a.stl")
    make("ws/src/arm/package.xml")
    assert locate_resource("package://arm/a.stl", tmp_path / "x") == file


def test_the_number_of_folders_is_bounded(make, tmp_path, monkeypatch):
    monkeypatch.setattr(resource_paths, "MAX_FOLDERS", 3)
    for name in "abcdef":
        make(f"ws/{name}/package.xml")
        make(f"ws/{name}/m.stl")
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(tmp_path / "ws"))
    assert locate_resource("package://a/m.stl", tmp_path / "x")
    with pytest.raises(FormatError):
        locate_resource("package://f/m.stl", tmp_path / "x")


@pytest.mark.parametrize("variable", resource_paths._PREFIXES)
@pytest.mark.parametrize("layout", ["install/share/arm/a.stl", "install/arm/share/arm/a.stl"])
def test_installed_workspaces_are_searched(make, tmp_path, monkeypatch, variable, layout):
    file = make(layout)
    monkeypatch.setenv(variable, str(tmp_path / "install"))
    assert locate_resource("package://arm/a.stl", tmp_path / "x") == file


@pytest.mark.parametrize("variable", resource_paths._MODELS)
def test_model_addresses_are_found_in_gazebo_paths(make, tmp_path, monkeypatch, variable):
    file = make("models/arm/a.stl")
    monkeypatch.setenv(variable, str(tmp_path / "models"))
    assert locate_resource("model://arm/a.stl", tmp_path / "x") == file


def test_the_cache_of_robot_descriptions(make, tmp_path, monkeypatch):
    file = make("cache/repository/arm/a.stl")
    monkeypatch.setenv("ROBOT_DESCRIPTIONS_CACHE", str(tmp_path / "cache"))
    assert locate_resource("package://arm/a.stl", tmp_path / "x") == file


def test_packages_installed_for_this_python(make, tmp_path, monkeypatch):
    file = make("site/cmeel.prefix/share/example-robot-data/a.stl")
    monkeypatch.syspath_prepend(tmp_path / "site")
    assert locate_resource("package://example-robot-data/a.stl", tmp_path / "x") == file


def test_the_next_folder_is_tried_when_the_first_lacks_the_file(make, tmp_path):
    make("mine/arm/other.stl")
    file = make("arm/a.stl")
    assert locate_resource("package://arm/a.stl", tmp_path / "urdf", search=[tmp_path / "mine"]) == file


def test_percent_escapes_are_decoded(make, tmp_path):
    file = make("arm/a b.stl")
    assert locate_resource("package://arm/a%20b.stl", tmp_path) == file
    literal = make("arm/50%25.stl")
    assert locate_resource("package://arm/50%25.stl", tmp_path) == literal


def test_paths_and_file_uris_are_found(make, tmp_path):
    file = make("arm/meshes/a b.stl")
    make("arm/urdf/x.urdf")
    assert locate_resource("../meshes/a b.stl", tmp_path / "arm" / "urdf").samefile(file)
    assert locate_resource(str(file)) == file
    assert locate_resource(f"file://{file}") == file
    assert locate_resource(file.as_uri()) == file
    assert locate_resource(f"file://localhost{file}".replace(" ", "%20")) == file
    assert locate_resource("meshes/a b.stl", tmp_path, search=[tmp_path / "arm"]) == file


@pytest.mark.parametrize(
    "path",
    ["../secret", "meshes/../../secret", "%2e%2e/secret", "..\\secret", "a/..%2f../secret", "./../secret"],
)
def test_paths_do_not_leave_their_package(make, tmp_path, path):
    make("secret")
    make("arm/meshes/a.stl")
    with pytest.raises(FormatError, match="leads out of its package"):
        locate_resource(f"package://arm/{path}", tmp_path)


def test_an_absolute_path_inside_a_package_is_one_inside_the_package(make, tmp_path):
    make("arm/a.stl")
    with pytest.raises(FormatError, match="has no file"):
        locate_resource("package://arm//etc/passwd", tmp_path)


def test_dots_that_stay_inside_of_a_package_are_allowed(make, tmp_path):
    file = make("arm/meshes/a.stl")
    make("arm/urdf/x.urdf")
    assert locate_resource("package://arm/urdf/../meshes/./a.stl", tmp_path).samefile(file)


def test_a_miss_says_where_it_looked_and_what_to_set(tmp_path):
    with pytest.raises(FormatError) as info:
        locate_resource("package://arm/a.stl", tmp_path / "urdf")
    first, *places = str(info.value).splitlines()
    assert first == (
        '"package://arm/a.stl": there is no package "arm". '
        "Set KINEVERSE_PACKAGE_PATH or ROS_PACKAGE_PATH to the folder that holds it. Looked in:"
    )
    assert places[0] == f"  {tmp_path / 'urdf'} and the folders above it"
    assert len(places) <= 3


def test_a_miss_names_three_places_at_most(tmp_path, monkeypatch):
    monkeypatch.setenv("ROS_PACKAGE_PATH", os.pathsep.join(str(tmp_path / name) for name in "abcdef"))
    with pytest.raises(FormatError) as info:
        locate_resource("package://arm/a.stl", tmp_path)
    _, *places = str(info.value).splitlines()
    assert len(places) == 3
    assert places[-1].startswith("  and ")


def test_a_package_without_the_file_is_named(make, tmp_path):
    make("arm/b.stl")
    with pytest.raises(FormatError, match=r'package "arm" has no file "a.stl". It is at:\n  .*arm$'):
        locate_resource("package://arm/a.stl", tmp_path)


@pytest.mark.parametrize(
    ("uri", "expected"),
    [
        ("https://example.org/a.stl", "https:// is not fetched"),
        ("package:///a.stl", "names no package"),
        ("package://../a.stl", "names no package"),
        ("package://", "names no package"),
        ("package://..\\x/a.stl", "names no package"),
        ("file://meshes/a.stl", "three slashes"),
        ("a.stl", "Paths are relative to the folder of the description"),
        ("/no/such/a.stl", "there is no such file"),
        ("", "there is no such file"),
        ("package://arm/\0", "no package"),
        ("\0", "there is no such file"),
    ],
)
def test_missing_resources_are_errors(tmp_path, uri, expected):
    with pytest.raises(FormatError, match=expected):
        locate_resource(uri, tmp_path)


@pytest.mark.parametrize(
    "file", ["pr2/pr2_description/robots/pr2.urdf", "iai_kitchen/iai_kitchen/urdf_obj/kitchen.urdf"]
)
def test_all_meshes_of_large_descriptions_are_found(file, published):
    description = read_urdf(published(*file.split("/")))
    meshes = [
        shape.geometry
        for link in description.links
        for shape in (*link.body.visuals, *link.body.collisions)
        if isinstance(shape.geometry, Mesh)
    ]
    assert len(meshes) > 80
    assert all(locate_resource(mesh.uri, mesh.folder).is_file() for mesh in meshes)


def robot_beside_meshes(folder: Path, mesh: str) -> Path:
    """Return a URDF in ``robot/urdf``, beside ``robot/meshes`` and ``robot/secrets``, without a package."""
    for name in ("urdf", "meshes", "secrets"):
        (folder / "robot" / name).mkdir(parents=True)
    for name in ("meshes", "secrets"):
        (folder / "robot" / name / "a.stl").touch()
    (folder / "a.stl").touch()
    path = folder / "robot" / "urdf" / "r.urdf"
    shape = f'<visual><geometry><mesh filename="{mesh}"/></geometry></visual>'
    path.write_text(f'<robot name="r"><link name="l">{shape}</link></robot>')
    return path


@pytest.mark.parametrize(
    "uri", ["../meshes/a.stl", "package://some_robot/meshes/a.stl", "package://robot/meshes/a.stl"]
)
def test_meshes_beside_the_folder_of_a_description_are_found(uri: str, tmp_path: Path):
    path = robot_beside_meshes(tmp_path, uri)
    with collect_warnings() as said:
        mesh = kv.load(path).bodies["l"].visuals[0].geometry
        assert locate_mesh(mesh).samefile(tmp_path / "robot" / "meshes" / "a.stl")
    expected = (
        f'there is no package "some_robot"; {tmp_path / "robot"}, which has its files, is taken for it.'
    )
    assert said == ([expected] if "some_robot" in uri else [])


@pytest.mark.parametrize(
    "uri",
    [
        "../secrets/a.stl",
        "../../a.stl",
        "../meshes/../secrets/a.stl",
        "package://some_robot/secrets/a.stl",
        "package://x/a.stl",
    ],
)
def test_other_folders_beside_a_description_stay_closed(uri: str, tmp_path: Path):
    mesh = kv.load(robot_beside_meshes(tmp_path, uri)).bodies["l"].visuals[0].geometry
    with pytest.raises(FormatError):
        locate_mesh(mesh)


def test_a_link_is_no_folder_of_meshes(tmp_path: Path):
    path = robot_beside_meshes(tmp_path, "../mesh/a.stl")
    (tmp_path / "robot" / "mesh").symlink_to(tmp_path / "robot" / "secrets")
    with pytest.raises(FormatError, match="leads out of the root"):
        locate_mesh(kv.load(path).bodies["l"].visuals[0].geometry)


def test_meshes_of_an_mjcf_may_lie_beside_its_folder(tmp_path: Path):
    pytest.importorskip("mujoco")
    path = robot_beside_meshes(tmp_path, "").with_name("r.xml")
    (tmp_path / "robot" / "meshes" / "a.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    )
    path.write_text(
        '<mujoco><compiler meshdir="../meshes"/><asset><mesh name="m" file="a.obj"/></asset><worldbody>'
        '<body name="b"><joint/><geom type="mesh" mesh="m"/></body></worldbody></mujoco>'
    )
    assert kv.load(path).bodies["b"].inertia.mass == pytest.approx(1000 / 6)


def test_a_document_opens_no_meshes_beside_a_folder_that_it_states(tmp_path: Path):
    mesh = kv.load(robot_beside_meshes(tmp_path, "../meshes/a.stl")).bodies["l"].visuals[0].geometry
    (tmp_path / "elsewhere").mkdir()
    for uri in ("../meshes/a.stl", "package://some_robot/meshes/a.stl"):
        with pytest.raises(FormatError):
            locate_resource(uri, mesh.folder, root=str(tmp_path / "elsewhere"))
