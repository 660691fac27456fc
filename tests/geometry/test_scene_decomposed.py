"""Scenes with decomposed meshes."""

import numpy as np
import pytest

import kineverse as kv
from fake_coacd import fake_coacd, overlapping, tray
from kineverse.geometry.decomposition import decompose, find_hulls
from kineverse.model.body import Body, Mesh, Pose, Shape, Sphere

pytest.importorskip("trimesh")
pytest.importorskip("coal")


@pytest.fixture
def model(tmp_path, monkeypatch):
    """A ball of 1 cm that goes up from the floor of a tray, which is turned about z by a right angle."""
    monkeypatch.setenv("KINEVERSE_CACHE_DIR", str(tmp_path / "cache"))
    tray().export(tmp_path / "tray.stl")
    turned, model = Pose.from_matrix(kv.rotation_z(np.pi / 2)), kv.Model()
    with model.edit() as edit:
        shape = Shape(Mesh("tray.stl", folder=str(tmp_path)), turned)
        edit.add_frame("tray", parent="world", transform=kv.rotation_x(0.0), body=Body(collisions=(shape,)))
        up = kv.translation(0, 0, kv.position("height"))
        edit.add_frame("ball", parent="world", transform=up, body=Body(collisions=(Shape(Sphere(0.01)),)))
    return model


def test_decomposed_tray_is_hollow_and_its_hull_is_not(model):
    decompose(model.bodies["tray"].collisions[0].geometry)
    scenes = [kv.geometry.Scene(model, decomposed=which) for which in ((), ("t*",))]
    for height in (0.0, 0.03, 0.2):
        for scene in scenes:
            scene.update({"height": height})
        hull, hulls = (scene.distance("tray", "ball").distance for scene in scenes)
        # The floor is 2 cm thick and its lower side at -5 cm, the walls are 13 and 8 cm from the middle.
        to_the_rim = np.hypot(0.08, max(height - 0.05, 0.0))
        assert hulls == pytest.approx(min(height + 0.03, to_the_rim) - 0.01, abs=2e-4)
        assert hull < 0.0 if height < 0.05 else hull > 0.0


def test_decomposed_mesh_outside_of_the_cache_is_its_hull_with_a_warning(model, caplog):
    scene = kv.geometry.Scene(model, decomposed=("*",))
    assert "kineverse decompose" in caplog.text
    assert "tray.stl" in caplog.text
    scene.update({"height": 0.0})
    assert scene.distance("tray", "ball").distance < 0.0


def test_missing_decomposed_mesh_fails_at_the_query(model, tmp_path, caplog):
    (tmp_path / "tray.stl").unlink()
    scene = kv.geometry.Scene(model, decomposed=("*",))
    scene.update({"height": 0.0})
    with pytest.raises(kv.KineverseError, match=r"tray.*tray\.stl"):
        scene.distance("tray", "ball")


def test_solids_of_equal_hulls_are_shared(tmp_path, monkeypatch):
    from kineverse.geometry.shapes import solid_from_points

    monkeypatch.setenv("KINEVERSE_CACHE_DIR", str(tmp_path / "cache"))
    fake_coacd(tmp_path / "fake", monkeypatch, "return [(mesh.vertices, mesh.faces)]")
    overlapping().export(tmp_path / "two.stl")
    mesh = Mesh("two.stl", folder=str(tmp_path))
    decompose(mesh)
    first, second = (find_hulls(mesh) for _ in range(2))
    assert len(first) == 2
    assert [solid_from_points(a) for a in first] == [solid_from_points(b) for b in second]
