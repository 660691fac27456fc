"""Meshes as hulls and as triangles; errors name unusable meshes, and other queries still work."""

from __future__ import annotations

import os

import numpy as np
import pytest
import trimesh
from scene_models import body
from scipy.spatial import ConvexHull

import kineverse as kv
from kineverse.geometry import Scene, mesh_files, shapes
from kineverse.geometry.shapes import THICKNESS, convex_hull, solid_from_geometry
from kineverse.model.body import Body, Box, Capsule, Cone, Cylinder, Ellipsoid, Mesh, Shape, Sphere


def test_convex_hulls_match_scipy():
    rng = np.random.default_rng(0)
    for scale in (1.0, 1e-3, 10.0):
        points = rng.normal(size=(300, 3)) * scale
        ours, theirs = convex_hull(points), ConvexHull(points)
        corners = np.array(sorted(np.array(ours.points()).tolist()))
        np.testing.assert_allclose(corners, sorted(points[theirs.vertices].tolist()), atol=1e-12 * scale)
        assert ours.computeVolume() == pytest.approx(theirs.volume)
        assert trimesh.Trimesh(points).convex_hull.volume == pytest.approx(theirs.volume)


def saved(mesh: trimesh.Trimesh, folder, name: str) -> Mesh:
    mesh.export(folder / name)
    return Mesh(name, folder=str(folder))


@pytest.mark.parametrize("ending", ["stl", "obj", "dae", "ply"])
def test_mesh_is_its_hull_or_its_triangles(tmp_path, ending):
    mesh = saved(trimesh.creation.torus(0.5, 0.1), tmp_path, f"torus.{ending}")
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("torus", "world", kv.translation(0, 0, kv.position("z")), body(mesh))
        edit.add_frame("ball", "world", np.eye(4), body(Sphere(0.1)))
    for triangles, around, above in ((), -0.2, 0.8), (("tor*",), 0.3, np.hypot(0.5, 1) - 0.2):
        scene = Scene(model, triangles=triangles)
        scene.update({"z": 0.0})
        assert scene.distance("torus", "ball").distance == pytest.approx(around, abs=0.02)
        scene.update({"z": 1.0})
        assert scene.distance("torus", "ball").distance == pytest.approx(above, abs=0.02)


def test_mesh_scale_stretches_and_mirrors(tmp_path):
    corner = trimesh.Trimesh(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
    )
    mesh = saved(corner, tmp_path, "corner.stl")
    for scale in ((1, 1, 1), (2, 3, 0.5), (-1, 1, 1), (-1, -2, -0.001)):
        scaled = Mesh(mesh.uri, scale=scale, folder=mesh.folder)
        for solid in (solid_from_geometry(scaled), solid_from_geometry(scaled, triangles=True)):
            low, high = solid.centre - solid.half, solid.centre + solid.half
            np.testing.assert_allclose(low, np.minimum(scale, 0), atol=1e-6)
            np.testing.assert_allclose(high, np.maximum(scale, 0), atol=1e-6)
        assert solid_from_geometry(scaled).engine.computeVolume() == pytest.approx(
            abs(np.prod(scale)) / 6, rel=1e-5
        )
        assert solid_from_geometry(scaled) is solid_from_geometry(scaled)


def test_mesh_files_of_equal_content_share_a_solid(tmp_path):
    one = saved(trimesh.creation.box((1, 2, 3)), tmp_path, "one.stl")
    (tmp_path / "other.stl").write_bytes((tmp_path / "one.stl").read_bytes())
    assert solid_from_geometry(one) is solid_from_geometry(Mesh("other.stl", folder=str(tmp_path)))
    assert solid_from_geometry(Box((1, 2, 3))) is solid_from_geometry(Box((1, 2, 3)))
    assert solid_from_geometry(one) is not solid_from_geometry(one, triangles=True)


def test_flat_mesh_is_thickened(tmp_path):
    pane = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    solid = solid_from_geometry(saved(pane, tmp_path, "pane.stl"))
    np.testing.assert_allclose(2 * solid.half, [1, 1, THICKNESS], atol=1e-9)


def test_hulls_of_mesh_files_are_kept_on_the_disk(tmp_path, monkeypatch, caplog):
    monkeypatch.setenv("KINEVERSE_CACHE_DIR", str(tmp_path / "cache"))
    reads = []
    monkeypatch.setattr(shapes, "read_faces", lambda file: reads.append(file) or mesh_files.read_faces(file))
    ball = trimesh.creation.icosphere(2)

    def make(mesh: Mesh) -> shapes.Solid:
        monkeypatch.setattr(shapes, "_by_content", {})  # as in another process
        return solid_from_geometry(mesh)

    mesh = saved(ball, tmp_path, "ball.stl")
    first, again = make(mesh), make(mesh)
    assert len(reads) == 1
    assert np.array_equal(first.core.corners, again.core.corners)
    assert np.array_equal(first.surface.normals, again.surface.normals)
    assert make(Mesh(mesh.uri, (1, 2, 3), mesh.folder)).half[2] == pytest.approx(3 * first.half[2])
    assert len(reads) == 2
    assert make(saved(ball.apply_scale(2), tmp_path, "ball.stl")).radius == pytest.approx(2 * first.radius)
    assert len(reads) == 3
    for kept in (tmp_path / "cache" / "mesh_hulls").iterdir():
        kept.write_bytes(b"x" + kept.read_bytes()[1:])
    make(mesh)
    assert len(reads) == 4
    assert "damaged" in caplog.text
    with monkeypatch.context() as patch:
        patch.setattr("tempfile.mkstemp", lambda **_: os.mkdir(tmp_path))  # an OSError
        make(saved(ball.apply_scale(3), tmp_path, "large.stl"))
    assert "cannot be written" in caplog.text
    reads.clear()
    # The corners of such a file may lie in another one.
    for _ in range(2):
        make(saved(ball, tmp_path, "ball.glb"))
    assert len(reads) == 2


BAD_MESHES = {
    "missing.stl": None,
    "empty.stl": b"",
    "words.obj": b"this is no mesh",
    "noise.stl": b"\x00\x01" * 400,
    "noise.dae": b"<COLLADA>",
    "what.xyz123": b"v 0 0 0",
    "line.obj": b"v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n",
    "point.obj": b"v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n",
    "nan.obj": b"v 0 0 0\nv 1 0 nan\nv 0 1 0\nf 1 2 3\n",
    "far.obj": b"v 0 0 0\nv 1e9 0 0\nv 0 1e9 0\nv 0 0 1e9\nf 1 2 3\nf 1 2 4\n",
    "speck.obj": b"v 0 0 0\nv 1e-9 0 0\nv 0 1e-9 0\nv 0 0 1e-9\nf 1 2 3\nf 1 2 4\n",
    "no_faces.obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\n",
}
BAD_SHAPES = [
    Box((1, 0, 1)),
    Box((1, -1, 1)),
    Box((1, np.nan, 1)),
    Sphere(0.0),
    Sphere(np.inf),
    Cylinder(0.1, 0.0),
    Capsule(-0.1, 1.0),
    Cone(0.1, -1.0),
    Ellipsoid((1, 1, 0)),
    Sphere(1e12),
    Sphere("large"),
    Box((1, 1)),
    Ellipsoid(3),
]


def with_a_bad_one(geometry):
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("good", "world", kv.translation(kv.position("x"), 0, 0), body(Box((1, 1, 1))))
        edit.add_frame("fine", "world", kv.translation(3, 0, 0), body(Sphere(0.5)))
        edit.add_frame("bad", "world", kv.translation(5, 0, 0), Body(collisions=(Shape(geometry),)))
    return model


def check(model, *names):
    """The error names body and file; the rest of the scene can be used, before and after it."""
    scene = Scene(model)
    scene.update({"x": 0.0})
    for ask in (
        lambda: scene.pairs_within(1.0),
        lambda: scene.distance("good", "bad"),
        lambda: scene.ray((0, 0, 9), (1, 0, 0)),
    ):
        with pytest.raises(kv.KineverseError) as caught:
            ask()
        assert all(name in str(caught.value) for name in ("'bad'", "leave_out", *names)), str(caught.value)
        assert len(str(caught.value)) < 1500
        assert scene.distance("good", "fine").distance == pytest.approx(2.0)
    scene.update({"x": 1.0})
    assert scene.distance("good", "fine").distance == pytest.approx(1.0)
    without = Scene(model, leave_out=["bad"])
    without.update({"x": 1.0})
    assert [r.distance for r in without.pairs_within(2.0)] == [pytest.approx(1.0)]
    with model.edit() as edit:
        edit.remove("frame bad")
    assert [r.distance for r in scene.pairs_within(2.0)] == [pytest.approx(1.0)]


@pytest.mark.parametrize("name", BAD_MESHES)
def test_unusable_mesh_is_named_with_its_body(tmp_path, name):
    if BAD_MESHES[name] is not None:
        (tmp_path / name).write_bytes(BAD_MESHES[name])
    check(with_a_bad_one(Mesh(name, folder=str(tmp_path))), name)


@pytest.mark.parametrize("name", BAD_MESHES)
def test_unusable_mesh_is_refused_as_triangles(tmp_path, name):
    if BAD_MESHES[name] is not None:
        (tmp_path / name).write_bytes(BAD_MESHES[name])
    scene = Scene(with_a_bad_one(Mesh(name, folder=str(tmp_path))), triangles=["bad"])
    scene.update({"x": 0.0})
    with pytest.raises(kv.KineverseError, match=f"'bad'.*{name}"):
        scene.distance("good", "bad")


def test_degenerate_triangles_are_ignored(tmp_path):
    """For coal one that is a point or a line touches everything."""
    corners, degenerate = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nv .5 0 0\n", "f 1 1 2\nf 2 2 2\nf 1 2 5\n"
    (tmp_path / "open.obj").write_text(corners + "f 1 2 3\nf 1 2 4\n" + degenerate)
    scene = Scene(with_a_bad_one(Mesh("open.obj", folder=str(tmp_path))), triangles=["bad"])
    scene.update({"x": 0.0})
    assert scene.distance("bad", "fine").distance == pytest.approx(1.5)
    assert scene.distance("bad", "good").distance == pytest.approx(4.5)


@pytest.mark.parametrize("shape", BAD_SHAPES, ids=str)
def test_impossible_sizes_are_named_with_their_body(shape):
    check(with_a_bad_one(shape), type(shape).__name__.lower())


@pytest.mark.parametrize("scale", [(0, 1, 1), (1, np.nan, 1), (1, 1, np.inf)])
def test_scale_with_a_factor_of_zero_is_refused(tmp_path, scale):
    mesh = saved(trimesh.creation.box(), tmp_path, "box.stl")
    check(with_a_bad_one(Mesh(mesh.uri, scale=scale, folder=mesh.folder)), "box.stl", "scale")


def test_mesh_file_above_the_limit_is_not_read(tmp_path, monkeypatch):
    monkeypatch.setattr(mesh_files, "LARGEST_FILE", 100)
    check(with_a_bad_one(saved(trimesh.creation.icosphere(), tmp_path, "large.stl")), "large.stl", "MiB")


def test_error_lists_several_unusable_shapes(tmp_path):
    model = with_a_bad_one(Sphere(0.0))
    with model.edit() as edit:
        edit.add_frame("worse", "world", np.eye(4), body(Mesh("gone.stl", folder=str(tmp_path))))
    scene = Scene(model)
    scene.update({"x": 0.0})
    with pytest.raises(kv.errors.FormatError, match=r"2 shapes(.|\n)*'bad'(.|\n)*'worse'.*gone"):
        scene.pairs_within(1.0)


def test_update_with_poses_that_are_not_finite_moves_nothing():
    model, x = kv.Model(), kv.position("x")
    with model.edit() as edit:
        edit.add_frame("odd", "world", kv.translation(np.sqrt(x), 0, 0), body(Box((1, 1, 1))))
        edit.add_frame("ball", "world", kv.translation(3, 0, 0), body(Sphere(0.5)))
    scene = Scene(model)
    scene.update({"x": 1.0})
    with pytest.raises(kv.errors.InvalidValueError, match="odd"):
        scene.update({"x": -1.0})
    with pytest.raises(kv.errors.InvalidValueError, match="NaN"):
        scene.update({"x": np.nan})
    assert scene.distance("odd", "ball").distance == pytest.approx(1.0)
    scene.update([4.0])
    assert scene.distance("odd", "ball").distance == pytest.approx(0.0, abs=1e-6)


def test_scene_refuses_wrong_names_and_values():
    model = with_a_bad_one(Sphere(0.5))
    scene = Scene(model)
    with pytest.raises(kv.errors.UnknownNameError, match=r"'x'|x: call"):
        scene.pairs_within(1.0)
    with pytest.raises(kv.errors.UnknownNameError, match="'x'"):
        scene.update({})
    with pytest.raises(kv.errors.UnknownNameError, match="no symbol"):
        scene.update({"x": 1.0, "y": 2.0})
    with pytest.raises(kv.errors.ShapeError):
        scene.update([1.0, 2.0])
    scene.update({"x": 1.0, "x:velocity": 0.0})
    with pytest.raises(kv.errors.UnknownNameError, match="'good'"):
        scene.distance("goood", "fine")
    with pytest.raises(kv.errors.InvalidValueError, match="itself"):
        scene.distance("good", "good")
    for radius in (-1.0, np.nan):
        with pytest.raises(kv.errors.InvalidValueError, match="radius"):
            scene.pairs_within(radius)
    with pytest.raises(kv.errors.UnknownNameError, match="rule"):
        Scene(model, rules=[kv.geometry.Rule("good", "goood")])
    with pytest.raises(kv.errors.InvalidValueError, match="rule"):
        Scene(model, rules=[("good",), 3])


def test_missing_coal_error_names_the_extra(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "coal", None)
    with pytest.raises(kv.errors.MissingDependencyError, match=r"\[geometry\]"):
        Scene(with_a_bad_one(Sphere(0.5)))
    assert shapes.solid_from_geometry.__doc__
