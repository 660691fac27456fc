"""Files of meshes: by digest from the server, only what its root allows, kept on disk."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path

import pytest

import kineverse as kv
from kineverse.exchange.client import LiveModel
from kineverse.exchange.server import serve
from kineverse.formats.resources import fetch_mesh, meshes_of

pytest.importorskip("zenoh")

STL = (
    b"solid\n"
    + b"facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\n"
    + b"endloop\nendfacet\n" * 1
    + b"endsolid\n"
)

URDF = """
<robot name="cup">
  <link name="cup"><visual><geometry><mesh filename="meshes/cup.stl"/></geometry></visual></link>
  <link name="lid"><visual><geometry><mesh filename="../../secret.stl"/></geometry></visual></link>
  <joint name="hinge" type="revolute"><parent link="cup"/><child link="lid"/><axis xyz="0 0 1"/>
    <limit lower="0" upper="1" velocity="1" effort="1"/></joint>
</robot>
"""


@pytest.fixture
def description(tmp_path: Path) -> Path:
    folder = tmp_path / "given" / "robot"
    (folder / "meshes").mkdir(parents=True)
    (folder / "meshes" / "cup.stl").write_bytes(STL)
    (tmp_path / "secret.stl").write_bytes(STL + b"\n")
    (folder / "cup.urdf").write_text(URDF)
    return folder / "cup.urdf"


def mesh_of(model: kv.Model, name: str) -> kv.model.Mesh:
    (mesh,) = meshes_of(model.bodies[next(n for n in model.bodies if n.endswith(name))])
    return mesh


def test_a_client_gets_the_files_of_meshes_by_their_digests(
    description: Path, tmp_path: Path, load: Callable[..., LiveModel], monkeypatch: pytest.MonkeyPatch
) -> None:
    cache = tmp_path / "cache"
    monkeypatch.setenv("KINEVERSE_CACHE_DIR", str(cache))
    store = tmp_path / "cup.db"
    for source in (description, ()):  # the second time the store knows where the file is
        with serve(source, store=store):
            model, part = load("live:cup"), load("live:cup", frames=["cup"], bodies=True)
            for one in (model, part):
                mesh = mesh_of(one, "cup")
                assert mesh.content == (hashlib.sha256(STL).hexdigest(), len(STL))
                assert not mesh.folder
                found = fetch_mesh(mesh)
                assert found is not None
                assert found.read_bytes() == STL
            assert mesh_of(model, "lid").content is None
    kept = [path for path in cache.rglob("*") if path.name == hashlib.sha256(STL).hexdigest()]
    assert [path.read_bytes() for path in kept] == [STL]
    assert not any(path.read_bytes() == STL + b"\n" for path in cache.rglob("*") if path.is_file())


def test_a_file_that_has_changed_is_not_sent(
    description: Path, tmp_path: Path, load: Callable[..., LiveModel], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("KINEVERSE_CACHE_DIR", str(tmp_path / "cache"))
    with serve(description):
        model = load("live:cup")
        digest, size = mesh_of(model, "cup").content or ("", 0)
        (description.parent / "meshes" / "cup.stl").write_bytes(os.urandom(size))
        assert model.exchange.fetch_part(digest, 0) is None
        assert model.exchange.fetch_part(hashlib.sha256(STL + b"\n").hexdigest(), 0) is None


def test_a_body_that_is_edited_keeps_the_file_of_its_mesh(
    description: Path, load: Callable[..., LiveModel]
) -> None:
    with serve(description):
        model, other = load("live:cup"), load("live:cup")
        name = next(n for n in model.bodies if n.endswith("cup"))
        body = model.bodies[name]
        tag = next(t for t in model.history.writers(f"bodies/{name}"))
        from kineverse.model.basic_operations import SetBody

        with model.edit() as edit:
            if tag.startswith("body"):
                edit.replace(tag, SetBody(name, body))
            else:
                edit.apply(SetBody(name, body), override=True)
        assert other.wait(model.version, 10.0)
        assert mesh_of(other, "cup").content == mesh_of(model, "cup").content is not None
