"""Files that a description may open: those below its root, and no others."""

from __future__ import annotations

import itertools
import json
import os
from pathlib import Path

import pytest

import kineverse as kv
from kineverse.formats.reader_warnings import collect_warnings
from kineverse.formats.resource_paths import RealPaths, locate_mesh, locate_resource
from kineverse.formats.root_folder import NOWHERE, find_root, is_below
from kineverse.formats.sdf.include import find_included
from kineverse.geometry.mesh_files import find_mesh_file

MESH = '<link name="l"><visual><geometry><mesh filename="{}"/></geometry></visual></link>'
MJCF = '<mujoco><include file="{}"/></mujoco>'
PART = '<mujocoinclude><worldbody><body name="b"><geom size="1"/></body></worldbody></mujocoinclude>'
SDF = '<sdf version="1.10"><model name="m"><link name="l"/><include><uri>{}</uri></include></model></sdf>'
MODEL = '<sdf version="1.10"><model name="n"><link name="k"/></model></sdf>'


@pytest.fixture(autouse=True)
def _no_variables(monkeypatch):
    for name in ("KINEVERSE_ROOT", "KINEVERSE_MODEL_PATH", "KINEVERSE_PACKAGE_PATH", "ROS_PACKAGE_PATH"):
        monkeypatch.delenv(name, raising=False)
    for name in ("AMENT_PREFIX_PATH", "GZ_SIM_RESOURCE_PATH", "GAZEBO_MODEL_PATH", "SDF_PATH"):
        monkeypatch.delenv(name, raising=False)


@pytest.fixture
def put(tmp_path):
    """Return a function that writes a file below a folder, and the folders above it."""

    def put(path: str, text: str = "") -> Path:
        file = tmp_path / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
        return file

    return put


def test_a_memory_of_folders_finds_the_real_paths_of_the_system(tmp_path, put, monkeypatch):
    put("d/d/file")
    for link, target in (
        ("d/out", "/etc"),
        ("d/up", ".."),
        ("d/f", "d/file"),
        ("d/d/loop", "loop"),
        ("d/gone", "x"),
    ):
        (tmp_path / link).symlink_to(target)
    monkeypatch.chdir(tmp_path / "d")
    real_path, parts = RealPaths(), ("d", "out", "up", "f", "loop", "gone", "file", "..", ".", "")
    for names in itertools.product(parts, repeat=3):
        for path in ("/".join(names), f"{tmp_path}/d/{'/'.join(names)}"):
            assert real_path(path) == os.path.realpath(path), path


def robot(uri: str) -> str:
    return f'<robot name="r">{MESH.format(uri)}</robot>'


def mesh_of(model: kv.Model):
    (body,) = model.bodies.values()
    return body.visuals[0].geometry


@pytest.mark.parametrize("mark", [".git/HEAD", "package.xml", "model.config", "__init__.py"])
def test_a_repository_or_package_around_a_file_is_its_root(put, tmp_path, mark):
    put(f"top/{mark}")
    assert find_root(put("top/a/b/r.urdf").parent) == str(tmp_path / "top")
    assert find_root(tmp_path) == str(tmp_path)


def test_a_repository_counts_before_a_package_and_the_nearest_before_others(put, tmp_path):
    put("repository/.git", "gitdir: elsewhere")
    put("repository/package/package.xml")
    folder = put("repository/package/inner/r.urdf").parent
    assert find_root(folder) == str(tmp_path / "repository")
    put("repository/package/inner/.git/HEAD")
    assert find_root(folder) == str(folder)


def test_the_outermost_of_nested_python_packages_counts(put, tmp_path):
    put("site/robots/__init__.py")
    put("site/robots/models/__init__.py")
    assert find_root(put("site/robots/models/assets/arm/r.xml").parent) == str(tmp_path / "site/robots")


def test_home_folder_is_no_root_even_if_it_is_a_repository(put, tmp_path, monkeypatch):
    put("home/.git/HEAD")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    folder = put("home/downloads/r.urdf").parent
    assert find_root(folder) == str(folder)


def test_root_is_that_of_the_argument_then_variable_then_surroundings(put, tmp_path, monkeypatch):
    put("top/.git/HEAD")
    folder = put("top/a/r.urdf").parent
    monkeypatch.setenv("KINEVERSE_ROOT", os.pathsep.join([str(tmp_path), str(tmp_path / "elsewhere")]))
    assert find_root(folder) == str(tmp_path)
    assert find_root(folder, folder) == str(folder)
    with pytest.raises(kv.errors.FormatError, match="is no folder"):
        kv.load(put("top/a/x.urdf", robot("a.stl")), root=tmp_path / "nothing")


def outsiders(tmp_path: Path) -> list[str]:
    """Return names of a file that lies beside the folder of the description."""
    secret = tmp_path / "secret.stl"
    return [
        str(secret),
        f"file://{secret}",
        "../secret.stl",
        "sub/../../secret.stl",
        "link.stl",
        "there/secret.stl",
    ]


@pytest.fixture
def inside(put, tmp_path):
    """Return a folder with links that lead out of it, beside a file."""
    put("secret.stl", "solid")
    folder = put("robot/sub/x").parent.parent
    (folder / "link.stl").symlink_to(tmp_path / "secret.stl")
    (folder / "there").symlink_to(tmp_path)
    return folder


@pytest.mark.parametrize("number", range(6))
@pytest.mark.parametrize("kind", ["urdf", "sdf", "xml", "kv.json"])
def test_meshes_outside_are_remarked_on_and_not_opened(inside, tmp_path, number, kind):
    uri, path = outsiders(tmp_path)[number], inside / f"r.{kind}"
    if kind == "sdf":
        shape = f"<visual><geometry><mesh><uri>{uri}</uri></mesh></geometry></visual>"
        path.write_text(f'<sdf version="1.10"><model name="m"><link name="l">{shape}</link></model></sdf>')
    elif kind == "xml":
        uri = uri.removeprefix("file://")  # which MuJoCo does not know
        geom = '<body><inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/><geom type="mesh" mesh="m"/></body>'
        path.write_text(
            f'<mujoco><asset><mesh name="m" file="{uri}"/></asset><worldbody>{geom}</worldbody></mujoco>'
        )
    else:
        path.write_text(robot(uri))
        if kind == "kv.json":
            urdf = inside / "r.urdf"
            urdf.write_text(robot(uri))
            kv.load(urdf, root=tmp_path).save(path)
    with collect_warnings() as remarks:
        model = kv.load(path)
    assert len(remarks) == 1
    assert f"leads out of the root {inside}" in remarks[0]
    for opened in (locate_mesh, find_mesh_file):
        with pytest.raises(
            kv.errors.FormatError, match=r"leads out of the root .*--root FOLDER.*KINEVERSE_ROOT"
        ):
            opened(mesh_of(model))
    with collect_warnings() as remarks:
        model = kv.load(path, root=tmp_path)
    assert remarks == []
    assert locate_mesh(mesh_of(model)).samefile(tmp_path / "secret.stl")


def test_folders_of_the_variable_are_open_to_all_files(inside, tmp_path, monkeypatch):
    (inside / "r.urdf").write_text(robot("../secret.stl"))
    model = kv.load(inside / "r.urdf")
    monkeypatch.setenv("KINEVERSE_ROOT", str(tmp_path))
    assert locate_mesh(mesh_of(model)).samefile(tmp_path / "secret.stl")


def test_root_of_a_document_is_that_of_its_own_folder(inside, put, tmp_path):
    (inside / "r.urdf").write_text(robot("a.stl"))
    (inside / "a.stl").write_text("solid")
    model = kv.load(inside / "r.urdf")
    assert locate_mesh(mesh_of(model)) == inside / "a.stl"
    model.save(inside / "r.kv.json")
    assert locate_mesh(mesh_of(kv.load(inside / "r.kv.json"))) == inside / "a.stl"
    elsewhere = put("elsewhere/x").parent / "r.kv.json"
    model.save(elsewhere)
    for unbounded in (kv.load(elsewhere), kv.formats.from_bytes(kv.formats.to_bytes(model))):
        with pytest.raises(kv.errors.FormatError, match="leads out of"):
            locate_mesh(mesh_of(unbounded))
    assert locate_mesh(mesh_of(kv.load(elsewhere, root=inside))) == inside / "a.stl"
    assert (
        locate_mesh(mesh_of(kv.formats.from_bytes(kv.formats.to_bytes(model), root=inside)))
        == inside / "a.stl"
    )


@pytest.mark.parametrize("folder", ["robot/secret", "robot", "elsewhere"])
def test_documents_cannot_declare_folders_as_packages(put, tmp_path, folder):
    """A document names the folder of its meshes; a foreign folder stays closed, with a manifest or not."""
    secret = put("robot/secret/a.stl", "solid")
    put("robot/secret/package.xml", "<package><name>secret</name></package>")
    document = put("downloads/x").parent / "r.kv.json"
    urdf = put("robot/secret/r.urdf", robot("package://secret/a.stl"))
    kv.load(urdf).save(document)
    said = json.loads(document.read_text().replace(str(urdf.parent), str(tmp_path / folder)))
    document.write_text(json.dumps({key: value for key, value in said.items() if key != "sha256"}))
    with collect_warnings() as remarks:
        model = kv.load(document)
    found_there = folder != "elsewhere"
    assert any("leads out of the root" in remark for remark in remarks) is found_there
    for bounded in (model, kv.formats.from_bytes(kv.formats.to_bytes(model))):
        with pytest.raises(kv.errors.FormatError, match=r"leads out of|there is no package"):
            locate_mesh(mesh_of(bounded))
    if found_there:
        for wide in (
            kv.load(document, root=tmp_path),
            kv.formats.from_bytes(kv.formats.to_bytes(model), root=secret.parent),
        ):
            assert locate_mesh(mesh_of(wide)) == secret


def test_text_without_file_has_no_package_folders(put, tmp_path, monkeypatch):
    secret = put("secret/a.stl", "solid")
    put("secret/model.sdf", MODEL)
    monkeypatch.chdir(secret.parent)
    for folder in ("", str(secret.parent), str(tmp_path), "/etc"):
        for uri in ("package://secret/a.stl", "package://etc/passwd", f"package://{tmp_path.parts[1]}/x"):
            with pytest.raises(kv.errors.FormatError):
                locate_resource(uri, folder, root=NOWHERE)
        with pytest.raises(kv.errors.FormatError):
            find_included("model://secret", folder, NOWHERE)
    assert not is_below("/etc", NOWHERE)


@pytest.mark.parametrize(("kind", "text", "part"), [("xml", MJCF, PART), ("sdf", SDF, MODEL)])
def test_includes_outside_of_the_root_are_refused(put, tmp_path, kind, text, part, monkeypatch):
    outside = put(f"part.{kind}", part)
    path = put(f"robot/r.{kind}", text.format(f"../part.{kind}"))
    with pytest.raises(
        kv.errors.FormatError, match=r"leads out of the root .*robot.*root=FOLDER.*--root.*KINEVERSE_ROOT"
    ):
        kv.load(path)
    expected = {"b"} if kind == "xml" else {"l", "n", "n/k"}
    assert set(kv.load(path, root=tmp_path).frames) == expected
    model = kv.Model()
    model.include(path, root=tmp_path)
    assert set(model.frames) == expected
    monkeypatch.setenv("KINEVERSE_ROOT", str(tmp_path))
    assert set(kv.load(path).frames) == expected
    monkeypatch.delenv("KINEVERSE_ROOT")
    put(".git/HEAD")
    assert set(kv.load(path).frames) == expected
    path.write_text(text.format(outside))
    assert set(kv.load(path).frames) == expected


def test_a_model_found_by_name_may_open_what_is_in_its_folder_of_models(put, tmp_path, monkeypatch):
    put("models/part.xml", PART)
    put("models/arm/arm.xml", MJCF.format("../part.xml"))
    monkeypatch.setenv("KINEVERSE_MODEL_PATH", str(tmp_path / "models"))
    assert "b" in kv.load("arm/arm").frames


def test_load_cache_distinguishes_root_and_strictness(inside, tmp_path):
    (inside / "r.urdf").write_text(robot("../secret.stl"))
    for _ in range(2):
        with pytest.raises(kv.errors.FormatError, match="leads out"):
            locate_mesh(mesh_of(kv.load(inside / "r.urdf")))
        assert locate_mesh(mesh_of(kv.load(inside / "r.urdf", root=tmp_path)))


def test_files_in_declared_folders_may_be_named_by_path(put, tmp_path, monkeypatch):
    """Launch files of ROS 2 name file:// and the folder where a package is installed."""
    mesh = put("install/share/arm/meshes/a.stl")
    path = put("elsewhere/r.urdf", robot(f"file://{mesh}"))
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path / "install"))
    assert locate_mesh(mesh_of(kv.load(path))) == mesh


@pytest.mark.parametrize("name", ["etc", "home", "tmp"])
def test_common_folders_are_no_packages(put, tmp_path, name, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path / "home/me"))
    file, folder = put("home/me/secret"), str(put("home/me/robot/r.urdf").parent)
    uris = [
        f"package://{tmp_path.parts[1]}/x",
        "package://etc/hostname",
        "package://home/me/secret",
        "package://me/secret",
    ]
    for uri in uris:
        with pytest.raises(kv.errors.FormatError):
            locate_resource(uri, folder, root=folder)
    assert file.is_file()


def test_packages_around_a_description_are_found_without_a_manifest(put, tmp_path):
    mesh, beside = put("arm/meshes/a.stl"), put("hand/meshes/h.stl")
    folder = put("arm/urdf/r.urdf").parent
    assert locate_resource("package://arm/meshes/a.stl", folder, root=str(folder)) == mesh
    assert locate_resource("package://hand/meshes/h.stl", folder, root=str(folder)) == beside


def test_symbolic_links_do_not_lead_out_of_a_package(put, tmp_path):
    secret, folder = put("secret.stl"), put("arm/urdf/r.urdf").parent
    (tmp_path / "arm" / "a.stl").symlink_to(secret)
    with pytest.raises(kv.errors.FormatError, match="leads out of the root"):
        locate_resource("package://arm/a.stl", folder, root=str(folder))


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("door.stl", "is a mesh, and no model"),
        ("scene.usdz", "is a package of USD"),
        ("robot.mjb", "Load the MJCF it was made of"),
        ("robot.srdf", "Load the URDF"),
        ("model.config", "Load the .sdf that it names"),
        ("notes.txt", "this version reads URDF"),
        ("run.sh", "not '.sh'. Recordings of runs (.mcap) are for kineverse view"),
        ("run.mcap", "Play it with kineverse view"),
    ],
)
def test_error_for_other_files_suggests_a_remedy(put, name, expected):
    with pytest.raises(kv.errors.FormatError) as info:
        kv.load(put(name, "<robot/>"))
    assert expected in str(info.value)


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ('{"format": "kineverse"}', "text of a document"),
        ("<robot/>", "text of a description"),
        (b"\x82\xa6" * 1000, "Bytes are read by kv.formats.from_bytes"),
    ],
)
def test_invalid_model_name_error_suggests_a_remedy(given, expected):
    with pytest.raises(kv.KineverseError, match=expected) as info:
        kv.load(given)
    assert len(str(info.value)) < 400


def test_error_for_a_folder_lists_its_models(put, tmp_path):
    put("robots/arm.urdf", robot("a.stl"))
    with pytest.raises(kv.errors.UnknownNameError, match=r"It is a folder; models in it: arm.urdf"):
        kv.load(tmp_path / "robots")


@pytest.mark.parametrize("root", ["", "nope", "a\0b", 5, b"nope", ["/"], Path("nope")])
def test_invalid_root_is_refused(put, root):
    shown = str(root) if isinstance(root, Path) else root
    with pytest.raises(kv.errors.FormatError) as info:
        kv.load(put("r.urdf", robot("a.stl")), root=root)
    assert str(info.value) == f"root={shown!r} is no folder; give one below which files may be opened."


@pytest.mark.parametrize(
    "uri", ["package://{}/a.stl", "model://{}/a.stl", "package://a/{}", "{}.stl", "file:///{}"]
)
@pytest.mark.parametrize("name", ["x" * 5000, "a\0b"])
def test_impossible_file_names_are_not_found(put, uri, name):
    folder = put("robot/r.urdf").parent
    for root in (None, NOWHERE, str(folder)):
        with pytest.raises(kv.errors.FormatError):
            locate_resource(uri.format(name), folder, root=root)
