import logging
import zipfile

import numpy as np
import pytest
from small_models import with_mesh

from kineverse.geometry import mesh_files
from kineverse.model.body import Body, Box, Mesh, Shape
from kineverse.view.drawables import MISSING, collect_drawables, load_hull
from kineverse.view.meshes import load_mesh

trimesh = pytest.importorskip("trimesh", reason="reading meshes needs the extra 'view'")

OBJ = """\
mtllib two.mtl
v 0 0 0
v 1 0 0
v 0 1 0
v 0 0 1
usemtl red
f 1 3 2
f 1 2 4
usemtl green
f 1 4 3
f 2 3 4
"""
MTL = "newmtl red\nKd 1 0 0\nnewmtl green\nKd 0 1 0\n"


@pytest.fixture
def tetrahedron(tmp_path):
    (tmp_path / "two.obj").write_text(OBJ)
    (tmp_path / "two.mtl").write_text(MTL)
    trimesh.load_mesh(tmp_path / "two.obj").export(tmp_path / "two.stl")
    return tmp_path


@pytest.mark.parametrize("name", ["two.obj", "two.stl"])
def test_meshes_are_loaded_in_size_and_scale(tetrahedron, name):
    surface = load_mesh(Mesh(name, scale=(1.0, 2.0, 0.001), folder=str(tetrahedron))).surface
    np.testing.assert_allclose(surface.bounds, [[0, 0, 0], [1, 2, 0.001]], atol=1e-7)
    assert len(surface.faces) == 4


def test_materials_of_an_obj_become_colours(tetrahedron):
    colors = load_mesh(Mesh("two.obj", folder=str(tetrahedron))).surface.colors
    assert {tuple(color) for color in colors.tolist()} == {(1.0, 0.0, 0.0, 1.0), (0.0, 1.0, 0.0, 1.0)}


def test_equal_files_are_read_once(tetrahedron):
    (tetrahedron / "copy.stl").write_bytes((tetrahedron / "two.stl").read_bytes())
    one, other = (load_mesh(Mesh(name, folder=str(tetrahedron))) for name in ("two.stl", "copy.stl"))
    assert one.surface is other.surface


def test_the_unit_of_a_collada_file_is_applied(tmp_path):
    pytest.importorskip("collada")
    data = trimesh.exchange.dae.export_collada(trimesh.creation.box())
    data = data if isinstance(data, bytes) else data.encode()
    start = data.index(b"<asset>") + len(b"<asset>")
    inches = data[:start] + b'<unit name="inch" meter="0.0254"/>' + data[start:]
    (tmp_path / "box.dae").write_bytes(data)
    (tmp_path / "inches.dae").write_bytes(inches)
    for name, edge in (("box.dae", 1.0), ("inches.dae", 0.0254)):
        low, high = load_mesh(Mesh(name, folder=str(tmp_path))).surface.bounds
        np.testing.assert_allclose(high - low, edge, rtol=1e-6)


@pytest.mark.parametrize("content", [None, b"", b"this is no mesh", b"\x00\x01" * 400])
@pytest.mark.parametrize("suffix", ["stl", "dae", "obj", "xyz123"])
def test_an_unreadable_mesh_is_a_placeholder_and_logged_once(tmp_path, caplog, content, suffix):
    uri = f"broken_{suffix}_{len(content or b'')}.{suffix}"
    if content is not None:
        (tmp_path / uri).write_bytes(content)
    caplog.set_level(logging.DEBUG)
    for scale in (1.0, 2.0):
        (part,) = collect_drawables(with_mesh(uri, str(tmp_path), scale=(scale, scale, scale)))
        assert part.placeholder
        assert part.problem
        assert "\n" not in part.problem
        assert part.color == MISSING
    warnings = [r for r in caplog.records if r.levelno >= logging.WARNING]
    assert len(warnings) == 1
    assert uri in warnings[0].getMessage()


def test_a_body_whose_meshes_are_missing_is_shown_by_its_collision_shapes(tmp_path):
    model = with_mesh("missing.stl", str(tmp_path))
    with model.edit() as edit:
        body = Body(
            visuals=(Shape(Mesh("gone.stl", folder=str(tmp_path))),), collisions=(Shape(Box((1, 2, 3))),)
        )
        edit.add_frame("other", parent="world", transform=np.eye(4), body=body)
    by_frame = {part.frame: part for part in collect_drawables(model)}
    assert by_frame["part"].placeholder
    assert not by_frame["other"].placeholder
    assert "gone.stl" in by_frame["other"].problem
    np.testing.assert_allclose(by_frame["other"].surface.bounds[1], [0.5, 1.0, 1.5])


def test_a_model_without_visual_shapes_is_shown_by_its_collision_shapes():
    import kineverse as kv

    model = kv.Model()
    with model.edit() as edit:
        body = Body(collisions=(Shape(Box((1, 2, 3))),))
        edit.add_frame("stone", parent="world", transform=np.eye(4), body=body)
    assert [part.kind for part in collect_drawables(model)] == ["visual"]
    assert [part.kind for part in collect_drawables(model, "collision")] == ["collision"]


def test_a_mesh_reads_files_inside_of_its_root_only(tetrahedron, tmp_path):
    inside = tmp_path / "in"
    (inside / "materials").mkdir(parents=True)
    (inside / "two.obj").write_text(OBJ.replace("two.mtl", "materials/two.mtl"))
    (inside / "materials" / "two.mtl").write_text(MTL)
    assert load_mesh(Mesh("two.obj", folder=str(inside))).surface.colors is not None
    (inside / "link.mtl").symlink_to(tetrahedron / "two.mtl")
    for k, name in enumerate(("../two.mtl", str(tetrahedron / "two.mtl"), "link.mtl")):
        (inside / f"{k}.obj").write_text(OBJ.replace("two.mtl", name))
        colors = load_mesh(Mesh(f"{k}.obj", folder=str(inside))).surface.colors
        assert colors is None or len({tuple(color) for color in colors.tolist()}) == 1
    for name, content in trimesh.creation.box().export(file_type="gltf").items():
        (tmp_path / name).write_bytes(content)
        if name.endswith(".gltf"):
            (inside / name).write_bytes(content.replace(b'"uri":"', b'"uri":"../'))
            named = name
    assert not load_mesh(Mesh(named, folder=str(tmp_path))).problem
    assert load_mesh(Mesh(named, folder=str(inside))).problem


def test_the_unpacked_size_of_archives_is_bounded(tetrahedron, monkeypatch):
    with zipfile.ZipFile(tetrahedron / "two.zip", "w", zipfile.ZIP_DEFLATED) as packed:
        packed.write(tetrahedron / "two.stl", "two.stl")
    (tetrahedron / "two.zae").write_bytes((tetrahedron / "two.zip").read_bytes())
    assert "is an archive" in load_mesh(Mesh("two.zip", folder=str(tetrahedron))).problem
    monkeypatch.setattr(mesh_files, "LARGEST_FILE", (tetrahedron / "two.stl").stat().st_size - 1)
    assert "unpacks to" in load_mesh(Mesh("two.zae", folder=str(tetrahedron))).problem


def test_meshes_of_one_root_are_not_shared_with_another(tetrahedron, tmp_path):
    (tmp_path / "in").mkdir()
    own = Mesh("two.stl", folder=str(tetrahedron))
    other = Mesh("two.stl", folder=str(tetrahedron), root=str(tmp_path / "in"))
    assert own == other
    for opened in (load_mesh, load_hull):
        assert not opened(own).problem
        assert "leads out of the root" in opened(other).problem
