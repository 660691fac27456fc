"""Files of meshes: by digest from the server, only what its root allows, kept on disk."""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import kineverse as kv
from kineverse.exchange.client import LiveModel
from kineverse.exchange.server import serve
from kineverse.formats.resources import fetch_mesh, meshes_of
from kineverse.model.basic_operations import SetData

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
    kept = [path.read_bytes() for path in cache.rglob("*") if path.stem == hashlib.sha256(STL).hexdigest()]
    assert [STL in content for content in kept] == [True]
    assert not any(STL + b"\n" in path.read_bytes() for path in cache.rglob("*") if path.is_file())


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


# -- doors ---------------------------------------------------------------------------------------------------

SECRET = b"secret"
DOORS: dict[str, Callable[[Path], str]] = {
    "an absolute path": lambda folder: str(folder / "secret"),
    "a path upwards": lambda folder: os.path.relpath(folder / "secret"),
    "a path beside the description": lambda folder: "../../secret",
    "a file URI": lambda folder: (folder / "secret").as_uri(),
    "a file URI of the host": lambda folder: f"file://localhost{folder / 'secret'}",
    "a package": lambda folder: "package://packed/secret",
    "a model": lambda folder: "model://packed/secret",
    "a link in a package": lambda folder: "package://packed/link",
    "a path below the root": lambda folder: str(folder / "given" / "robot" / "secret"),
}


def test_an_edit_makes_the_server_neither_open_nor_serve_a_file(
    description: Path, tmp_path: Path, load: Callable[..., LiveModel], monkeypatch: pytest.MonkeyPatch
) -> None:
    packed = tmp_path / "packages" / "packed"
    packed.mkdir(parents=True)
    for folder in tmp_path, packed, description.parent:
        (folder / "secret").write_bytes(SECRET)
    (packed / "link").symlink_to(tmp_path / "secret")
    for variable in "ROS_PACKAGE_PATH", "GZ_SIM_RESOURCE_PATH":
        monkeypatch.setenv(variable, str(packed.parent))
    monkeypatch.setenv("KINEVERSE_ROOT", str(tmp_path))  # the server may open all of these itself
    meshes = {door: kv.model.Mesh(make(tmp_path)) for door, make in DOORS.items()}
    digest, store, opened = hashlib.sha256(SECRET).hexdigest(), tmp_path / "cup.db", list[str]()

    def watch(event: str, arguments: tuple[object, ...]) -> None:
        if event == "open" and str(arguments[0]).endswith(("secret", "link")):
            opened.append(str(arguments[0]))

    with serve(description, store=store, name="cup"):
        model = load("live:cup")
        audit(watch)
        with model.edit() as edit:
            for door, mesh in meshes.items():
                edit.add_frame(door, "world", body=kv.model.Body(visuals=(kv.model.Shape(mesh),)))
        with model.edit() as edit:  # all get new places, so that all files are looked up
            for count in range(40):
                edit.insert(SetData(f"n{count}", 0), f"n{count}", before="frame a package")
        with model.edit() as edit:
            edit.remove("frame a package")
        model.undo(model.version)
        others = [load("live:cup"), load("live:cup", frames=[*meshes], bodies=True)]
        for one in (model, *others):
            assert [door for door in meshes if mesh_of(one, door).content is not None] == []
            assert one.exchange.fetch_part(digest, 0) is None
        assert mesh_of(others[0], "cup").content is not None
    with serve(store=store, name="cup"):  # a store tells no more
        again = load("live:cup")
        assert [door for door in meshes if mesh_of(again, door).content is not None] == []
        assert again.exchange.fetch_part(digest, 0) is None
    audit(None)
    assert not opened


_watchers: list[Callable[[str, tuple[object, ...]], None]] = []


def audit(watch: Callable[[str, tuple[object, ...]], None] | None) -> None:
    """Watch what this process opens, in place of who watched before; a hook cannot be removed."""
    if not _watchers:
        sys.addaudithook(lambda event, arguments: [one(event, arguments) for one in _watchers if one])
        _watchers.append(lambda *_: None)
    _watchers[:] = [watch or (lambda *_: None)]


def test_a_digest_that_is_claimed_serves_nothing_that_is_not_served(
    description: Path, tmp_path: Path, load: Callable[..., LiveModel]
) -> None:
    digest = hashlib.sha256(SECRET).hexdigest()
    with serve(description):
        model = load("live:cup")
        known = mesh_of(model, "cup").content
        for name, content in ("false", (digest, len(SECRET))), ("true", known):
            mesh = kv.model.Mesh("anywhere.stl", content=content)
            with model.edit() as edit:
                edit.add_frame(name, "world", body=kv.model.Body(visuals=(kv.model.Shape(mesh),)))
        other = load("live:cup")
        assert mesh_of(other, "false").content is None
        assert mesh_of(other, "true").content == known
        assert model.exchange.fetch_part(digest, 0) is None


def test_a_file_that_has_changed_is_not_sent_from_its_middle(
    description: Path, load: Callable[..., LiveModel]
) -> None:
    file = description.parent / "meshes" / "cup.stl"
    with serve(description):
        model = load("live:cup")
        digest, size = mesh_of(model, "cup").content or ("", 0)
        assert model.exchange.fetch_part(digest, 9) == STL[9:]
        file.unlink()
        file.symlink_to(description.parents[2] / "secret.stl")
        assert model.exchange.fetch_part(digest, 9) is None
        file.unlink()
        file.write_bytes(STL)
        assert model.exchange.fetch_part(digest, 9) == STL[9:]
        assert size == len(STL)
