"""Meshes of written files: references from the folder of the file, and conversion for MuJoCo."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

import mesh_bytes
import numpy as np
import pytest
from msgspec.structs import replace

import kineverse as kv
from kineverse.formats.resource_paths import locate_mesh, locate_resource
from kineverse.model.body import Body, Box, Mesh, Shape

REFERENCES = [
    "package://cups/meshes/{}",
    "model://cups/meshes/{}",
    "../meshes/{}",
    "file://{folder}/{}",
    "{folder}/{}",
]
FILES = {
    "cup.stl": mesh_bytes.tetrahedron(),
    "cup.STL": mesh_bytes.tetrahedron(),
    "text.stl": mesh_bytes.tetrahedron_as_text(),
    "cup.ply": mesh_bytes.tetrahedron_as_ply(),
    "cup.dae": mesh_bytes.tetrahedron_as_collada(),
    "inches.dae": mesh_bytes.tetrahedron_as_collada(0.0254),
}


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """Return a package of meshes, which is found from its own folder and those above it alone."""
    folder = tmp_path / "work" / "cups"
    (folder / "meshes").mkdir(parents=True)
    (folder / "urdf").mkdir()
    (folder / "package.xml").write_text("<package><name>cups</name></package>")
    for name, content in FILES.items():
        (folder / "meshes" / name).write_bytes(content)
    return folder


def robot(package: Path, *references: str) -> kv.Model:
    """Return a model whose link has these meshes."""
    visuals = "".join(
        f'<visual><geometry><mesh filename="{r}" scale="1 2 1"/></geometry></visual>' for r in references
    )
    text = f"""<robot name="r"><link name="a"/><link name="b">{visuals}</link>
<joint name="j" type="continuous"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/></joint></robot>"""
    (package / "urdf" / "r.urdf").write_text(text)
    return kv.load(package / "urdf" / "r.urdf")


def said(reference: str, name: str, package: Path) -> str:
    return reference.format(name, folder=package / "meshes")


def corners(file: Path) -> np.ndarray:
    """Return the corners of a mesh as MuJoCo has them, in the frame of the file."""
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_path(str(file))
    (kind,) = {int(t) for t in model.geom_type}
    assert kind == int(mujoco.mjtGeom.mjGEOM_MESH)
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, model.mesh_quat[0])
    return np.array(model.mesh_vert @ turn.reshape(3, 3).T + model.mesh_pos[0])


@pytest.mark.parametrize("reference", REFERENCES)
@pytest.mark.parametrize("name", FILES)
def test_mujoco_loads_written_meshes(reference: str, name: str, package: Path, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    target = tmp_path / "out" / "r.xml"
    saved = robot(package, said(reference, name, package)).save(target)
    found, expected = corners(target), np.array(mesh_bytes.CORNERS) * (1, 2, 1)
    distances = np.linalg.norm(found[:, None] - expected[None], axis=-1)
    assert distances.min(axis=1).max() < 1e-6
    assert distances.min(axis=0).max() < 1e-6
    is_converted = not name.lower().startswith("cup.stl")
    assert (tmp_path / "out" / "r_meshes").exists() is is_converted
    remark = f"is converted to r_meshes/{Path(name).stem}.obj, which MuJoCo can read"
    assert any(remark in r for r in saved.remarks) is is_converted
    (shape,) = kv.load(target).bodies["b"].visuals
    assert isinstance(shape.geometry, Mesh)
    assert locate_resource(shape.geometry.uri, shape.geometry.folder).is_file()


def test_missing_and_invalid_meshes_are_left_out(package: Path, tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    (package / "meshes" / "noise.stl").write_bytes(b"\1" * 84 + os.urandom(16))
    (package / "meshes" / "noise.dae").write_bytes(b"<COLLADA")
    (package / "meshes" / "noise.obj").write_bytes(b"v 0 0\nf 1 2 9\n")
    (package / "meshes" / "notes.txt").write_text("hello")
    names = ("missing.stl", "noise.stl", "noise.dae", "noise.obj", "notes.txt", "cup.stl")
    model = robot(package, *(f"package://cups/meshes/{name}" for name in names), "https://a.b/c.stl")
    saved, again = model.save(tmp_path / "r.xml"), kv.load(tmp_path / "r.xml").bodies["b"]
    assert [Path(s.geometry.uri).name for s in again.visuals] == ["cup.stl"]  # type: ignore[union-attr]
    for name in names[:-1]:
        assert any(name in r and "is left out" in r for r in saved.remarks), name
    assert any("https://a.b/c.stl" in r and "not fetched" in r for r in saved.remarks)


def test_flat_meshes_are_written(package: Path, tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    (package / "meshes" / "flat.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nf 1 2 3\nf 2 4 3\n")
    saved = robot(package, "package://cups/meshes/flat.obj").save(tmp_path / "r.xml")
    assert len(kv.load(tmp_path / "r.xml").bodies["b"].visuals) == 1
    assert not [r for r in saved.remarks if "mesh" in r]


def test_meshes_of_one_name_do_not_overwrite_each_other(package: Path, tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    (package / "more").mkdir()
    (package / "more" / "cup.dae").write_bytes(mesh_bytes.tetrahedron_as_collada(0.5))
    references = [f"package://cups/{name}/cup.dae" for name in ("meshes", "more", "meshes")]
    robot(package, *references).save(tmp_path / "r.xml")
    assert sorted(p.name for p in (tmp_path / "r_meshes").iterdir()) == ["cup.obj"]  # equal in metres
    (package / "more" / "cup.dae").write_bytes(FILES["inches.dae"].replace(b'meter="0.0254"', b'meter="1"'))
    robot(package, *references).save(tmp_path / "r.xml")
    assert sorted(p.name for p in (tmp_path / "r_meshes").iterdir()) == ["cup.obj", "cup_2.obj"]
    kv.load(tmp_path / "r.xml").save(tmp_path / "again.xml")  # OBJ stays where it is
    assert not (tmp_path / "again_meshes").exists()


def test_existing_mesh_files_are_not_overwritten(package: Path, tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    (tmp_path / "r_meshes").mkdir()
    (tmp_path / "r_meshes" / "cup.obj").write_text("precious")
    robot(package, "../meshes/cup.dae").save(tmp_path / "r.xml")
    assert (tmp_path / "r_meshes" / "cup.obj").read_text() == "precious"
    assert 'file="r_meshes/cup_2.obj"' in (tmp_path / "r.xml").read_text()


def test_failed_save_leaves_no_converted_meshes(
    package: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("mujoco")
    (tmp_path / "out").mkdir()
    replace = os.replace

    def refuse(source: object, target: Path) -> None:
        if Path(target).suffix == ".xml":
            raise PermissionError(13, "Permission denied")
        replace(source, target)  # type: ignore[call-overload]

    monkeypatch.setattr(os, "replace", refuse)
    with pytest.raises(kv.errors.FormatError, match="Permission denied"):
        robot(package, "../meshes/cup.dae").save(tmp_path / "out" / "r.xml")
    assert not list((tmp_path / "out").iterdir())


def test_without_mesh_reader_meshes_to_convert_are_left_out(
    package: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from kineverse.geometry import mesh_files

    def missing(file: object) -> None:
        raise kv.errors.MissingDependencyError("reading meshes needs trimesh: install it")

    monkeypatch.setattr(mesh_files, "read_faces", missing)
    assert any(
        "cup.dae is left out: MuJoCo cannot read it, and reading meshes needs trimesh" in r
        for r in robot(package, "../meshes/cup.dae", "../meshes/cup.stl").save(tmp_path / "r.xml").remarks
    )
    assert len(kv.load(tmp_path / "r.xml").bodies["b"].visuals) == 1


def test_missing_textures_are_left_out_and_shapes_kept(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    from PIL import Image

    Image.new("RGB", (2, 2)).save(tmp_path / "wood.png")
    (tmp_path / "cup.stl").write_bytes(mesh_bytes.tetrahedron())
    cup = Mesh("cup.stl", folder=str(tmp_path))
    shapes = [Shape(cup, texture=name, color=(1, 0, 0, 1)) for name in ("wood.png", "no.png", "wood.jpg")]
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame(
            "cup", parent="world", transform=kv.rotation_z(kv.position("q")), body=Body(tuple(shapes))
        )
    (tmp_path / "out").mkdir()
    assert [r for r in model.save(tmp_path / "out" / "m.xml").remarks if r.startswith("the texture")] == [
        "the texture no.png is left out: it is not there",
        "the texture wood.jpg is left out: it is not there",
    ]
    assert len(kv.load(tmp_path / "out" / "m.xml").bodies["cup"].visuals) == 3


@pytest.mark.parametrize("ending", ["urdf", "xml"])
def test_save_in_another_folder_warns_of_the_root_to_give(ending: str, package: Path, tmp_path: Path) -> None:
    if ending == "xml":
        pytest.importorskip("mujoco")
    there = tmp_path / "some" / "where"
    there.mkdir(parents=True)
    model = robot(
        package, "../meshes/cup.stl", "package://cups/meshes/cup.STL", "package://cups/meshes/cup.stl"
    )
    (said,) = [r for r in model.save(there / f"r.{ending}").remarks if "outside" in r]
    assert said.endswith(f"are outside of {there}: give root='{tmp_path}' to open them from there")
    again = kv.load(there / f"r.{ending}", root=tmp_path).bodies["b"].visuals
    assert {locate_mesh(s.geometry).resolve().parent for s in again} == {package / "meshes"}  # type: ignore[arg-type]
    assert not any("outside" in r for r in model.save(package / f"r.{ending}").remarks)


def test_textures_are_not_searched_in_the_working_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("mujoco")
    from PIL import Image

    Image.new("RGB", (2, 2)).save(tmp_path / "wood.png")
    monkeypatch.chdir(tmp_path)
    shapes = [Shape(Box((1, 1, 1)), texture=name) for name in ("wood.png", str(tmp_path / "wood.png"))]
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("box", "world", kv.rotation_z(kv.position("q")), body=Body(tuple(shapes)))
    saved = model.save(tmp_path / "m.xml")
    expected = "the texture wood.png is left out: it is relative to a folder that is not known"
    assert [r for r in saved.remarks if r.startswith("the texture")] == [expected]
    assert re.findall('<texture .*file="([^"]*)"', (tmp_path / "m.xml").read_text()) == ["wood.png"]


def test_meshes_outside_of_the_root_are_not_read_for_conversion(
    package: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("mujoco")
    from PIL import Image

    for name in ("secret.stl", "secret.dae"):
        (tmp_path / name).write_bytes(FILES["cup" + Path(name).suffix])
    Image.new("RGB", (2, 2)).save(tmp_path / "secret.png")
    model = robot(package, "../../../secret.stl", f"{tmp_path}/secret.dae", "../meshes/cup.stl")
    (*_, cup) = model.bodies["b"].visuals
    with model.edit() as edit:
        edit.add_frame(
            "c", "b", kv.translation(0, 0, 1), Body((replace(cup, texture=f"{tmp_path}/secret.png"),))
        )
    opened: list[str] = []
    monkeypatch.setattr(Path, "open", _recording(Path.open, opened))
    monkeypatch.setattr(Path, "read_bytes", _recording(Path.read_bytes, opened))
    saved = model.save(tmp_path / "r.xml")
    assert not [path for path in opened if "secret" in path]
    assert "secret." not in "".join(re.findall('file="[^"]*"', (tmp_path / "r.xml").read_text()))
    assert sum("leads out of the root" in r or "secret.png is left out" in r for r in saved.remarks) == 3


def _recording(function: Any, opened: list[str]) -> Any:
    def recording(path: Path, *arguments: Any, **options: Any) -> Any:
        opened.append(str(path))
        return function(path, *arguments, **options)

    return recording


@pytest.mark.parametrize("ending", ["urdf", "kv.json"])
@pytest.mark.parametrize("reference", REFERENCES)
def test_mesh_references_are_relative_to_the_written_file(
    reference: str, ending: str, package: Path, tmp_path: Path
) -> None:
    there = tmp_path / "some" / "where"
    there.mkdir(parents=True)
    robot(package, said(reference, "cup.stl", package)).save(there / f"r.{ending}")
    (shape,) = kv.load(there / f"r.{ending}").bodies["b"].visuals
    assert isinstance(shape.geometry, Mesh)
    found = locate_resource(shape.geometry.uri, shape.geometry.folder)
    assert found.resolve() == package / "meshes" / "cup.stl"


def test_mesh_addresses_stay_if_they_lead_to_the_same_file(
    package: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = robot(package, "package://cups/meshes/cup.stl")
    saved = model.save(package / "meshes" / "beside.urdf")
    assert "package://cups/meshes/cup.stl" in (package / "meshes" / "beside.urdf").read_text()
    assert not saved.remarks
    saved = model.save(tmp_path / "far.urdf")
    assert 'filename="work/cups/meshes/cup.stl"' in (tmp_path / "far.urdf").read_text()
    assert (
        "package://cups/meshes/cup.stl is written as a path, since that package is not found"
        in saved.remarks[0]
    )
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(package.parent))
    assert not model.save(tmp_path / "far.urdf").remarks
    assert "package://cups/meshes/cup.stl" in (tmp_path / "far.urdf").read_text()


def test_missing_meshes_keep_their_reference(tmp_path: Path) -> None:
    (tmp_path / "urdf").mkdir()
    robot(tmp_path, "package://nobody/a.stl").save(tmp_path / "r.urdf")
    assert "package://nobody/a.stl" in (tmp_path / "r.urdf").read_text()
