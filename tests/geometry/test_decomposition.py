"""Convex decomposition: results of CoACD, the cache, and the measured accuracy."""

import functools
import os
import signal
import stat
import subprocess
import sys

import numpy as np
import pytest

from fake_coacd import cube, ell, fake_coacd, finger, overlapping, tray
from kineverse.errors import FormatError, InvalidValueError
from kineverse.geometry.decomposition import (
    DecompositionError,
    DecompositionSettings,
    ResourceLimits,
    clear,
    convex_decomposition,
    decompose,
    decompose_all,
    find_hulls,
    list_entries,
    result,
)
from kineverse.geometry.decomposition.accuracy import Polytope, is_closed, measure_accuracy
from kineverse.geometry.decomposition.convex_decomposition import clean_hulls, clean_mesh, reduce_hulls
from kineverse.geometry.decomposition.result import Decomposition
from kineverse.geometry.mesh_files import Faces
from kineverse.model.body import Mesh

trimesh = pytest.importorskip("trimesh")
pytest.importorskip("coal")
spatial = pytest.importorskip("scipy.spatial")

SHAPES = {
    "ell": (ell, 0.004),
    "finger": (finger, 0.0014),
    "tray": (tray, 0.006),
    "overlapping": (overlapping, 0.003),
}
LAWS = ("ell", "finger", "overlapping", pytest.param("tray", marks=pytest.mark.long))


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """A cache of the test's own."""
    monkeypatch.setenv("KINEVERSE_CACHE_DIR", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def file(tmp_path):
    """Write a mesh into a file, and return what refers to it."""

    def write(mesh, name="mesh.stl", scale=(1.0, 1.0, 1.0)):
        mesh.export(tmp_path / name)
        return Mesh(name, scale=scale, folder=str(tmp_path))

    return write


@functools.cache
def made(name):
    """Decompose one of the shapes, once for all tests; return the mesh as trimesh has it, and the result."""
    import tempfile

    shape, error = SHAPES[name]
    mesh = shape()
    with tempfile.TemporaryDirectory() as folder:
        mesh.export(f"{folder}/{name}.stl")
        return mesh, decompose(Mesh(f"{name}.stl", folder=folder), DecompositionSettings(error)).decomposition


# Laws of what CoACD makes.


@pytest.mark.parametrize("name", LAWS)
def test_decomposition_covers_every_corner_within_the_error(name):
    mesh, result = made(name)
    hulls = [spatial.ConvexHull(hull).equations for hull in result.hulls]
    beyond = np.min([(mesh.vertices @ e[:, :3].T + e[:, 3]).max(axis=1) for e in hulls], axis=0)
    # How far beyond a face is no more than the distance, which is measured.
    assert beyond.max() <= result.accuracy.uncovered + 1e-7
    assert result.accuracy.uncovered <= 0.1 * result.error


@pytest.mark.parametrize("name", LAWS)
def test_decomposition_hulls_are_convex(name):
    for hull in made(name)[1].hulls:
        oracle = spatial.ConvexHull(hull)
        assert len(oracle.vertices) == len(hull)
        assert oracle.volume == pytest.approx(Polytope.from_points(hull).volume, rel=1e-6)


@pytest.mark.parametrize("name", LAWS)
def test_decomposition_volume_lies_between_mesh_and_hull(name):
    mesh, result = made(name)
    solid = trimesh.boolean.union(mesh.split(), engine="manifold")
    union = trimesh.boolean.union([trimesh.convex.convex_hull(h) for h in result.hulls], engine="manifold")
    accuracy = result.accuracy
    assert accuracy.volume == pytest.approx(union.volume, rel=5e-3)
    assert accuracy.hull_volume == pytest.approx(mesh.convex_hull.volume, rel=1e-6)
    assert accuracy.mesh_volume == pytest.approx(abs(mesh.volume), rel=1e-5)
    assert solid.volume * (1 - 1e-3) <= union.volume <= accuracy.hull_volume
    assert union.volume < 0.5 * (solid.volume + accuracy.hull_volume)


@pytest.mark.parametrize("name", LAWS)
def test_decomposition_excess_is_within_the_error(name):
    mesh, result = made(name)
    assert result.accuracy.excess <= result.error
    # An oracle of its own: the hulls' corners outside of the mesh, and how far they are from it.
    corners = np.concatenate(result.hulls)
    _, distances, _ = trimesh.proximity.closest_point(mesh, corners)
    outside = ~trimesh.boolean.union(mesh.split(), engine="manifold").contains(corners)
    assert distances[outside].max(initial=0.0) <= result.accuracy.excess + 2e-5


def test_decomposition_finds_convex_parts_exactly():
    _, result = made("overlapping")
    assert len(result.hulls) == 2
    assert result.accuracy.volume == pytest.approx(0.002 - 0.05**3, rel=1e-2)
    assert result.accuracy.excess == 0.0


def test_decomposition_is_reproducible(file):
    first = made("finger")[1]
    second = decompose(file(finger()), DecompositionSettings(0.0014), force=True).decomposition
    assert len(first.hulls) == len(second.hulls) > 1
    for one, other in zip(first.hulls, second.hulls, strict=True):
        np.testing.assert_array_equal(one, other)


def test_open_surface_is_wrapped_with_a_remark(file):
    half = trimesh.Trimesh(cube().vertices, cube().faces[:11])
    result = decompose(file(half), DecompositionSettings(0.1)).decomposition
    assert result.accuracy.mesh_volume is None
    assert "not closed" in result.remarks[0]
    assert result.accuracy.uncovered < 1e-3
    assert result.accuracy.volume <= result.accuracy.hull_volume * (1 + 1e-6)


# Measuring, where the answer is known.


def _surface(mesh):
    return Faces(np.array(mesh.vertices), np.array(mesh.faces, dtype=np.int64))


def test_accuracy_of_the_hull_of_an_ell():
    mesh = _surface(ell())
    measured = measure_accuracy(mesh, [Polytope.from_points(mesh.vertices)])
    # The middle of the slanted face of the hull is 75 mm from the sides of both legs.
    assert 0.073 < measured.excess <= 0.075 + 1e-5
    assert measured.uncovered == 0.0
    assert measured.mesh_volume == pytest.approx(0.05 * (0.2 * 0.05 + 0.15 * 0.05))
    assert measured.volume == pytest.approx(measured.hull_volume, rel=1e-12)


def test_accuracy_of_one_leg_of_an_ell():
    leg = cube((0.2, 0.05, 0.05), (0.1, 0.025, 0.025)).vertices
    measured = measure_accuracy(_surface(ell()), [Polytope.from_points(np.array(leg))])
    assert measured.uncovered == pytest.approx(0.15, abs=1e-5)
    assert measured.excess == 0.0
    assert measured.volume == pytest.approx(0.2 * 0.05 * 0.05)


@pytest.mark.parametrize("overlap", [0.0, 0.3, 1.0])
def test_union_volume_counts_overlaps_once(overlap):
    cubes = [
        Polytope.from_points(np.array(cube((1, 1, 1), (k * (1 - overlap), 0, 0)).vertices)) for k in range(2)
    ]
    measured = measure_accuracy(_surface(cube((1, 1, 1))), cubes)
    assert measured.volume == pytest.approx(2 - overlap, rel=1e-2)


def test_is_closed_needs_every_edge_in_both_directions():
    faces = np.array(cube().faces, dtype=np.int64)
    assert is_closed(faces)
    assert is_closed(faces[:, ::-1])
    assert not is_closed(faces[1:])
    assert not is_closed(np.concatenate([faces[:1, ::-1], faces[1:]]))
    assert not is_closed(np.concatenate([faces, faces]))


def test_reduce_hulls_joins_where_volume_grows_least():
    row = [Polytope.from_points(np.array(cube((1, 1, 1), (x, 0, 0)).vertices)) for x in (0, 1, 2, 10)]
    joined = reduce_hulls(row, 2)
    assert sorted(round(one.volume, 9) for one in joined) == [1.0, 3.0]
    assert len(reduce_hulls(row, 1)) == 1
    assert reduce_hulls(row, 4) == row


def test_clean_hulls_drops_contained_and_degenerate_hulls():
    large, small = (np.array(cube((e, e, e)).vertices) for e in (1.0, 0.5))
    line = np.outer(np.arange(4.0), [1, 0, 0])
    (one,) = clean_hulls([small, line, large], Polytope.from_points(2 * large))
    assert one.volume == pytest.approx(1.0)
    (one,) = clean_hulls([small, line, 1.1 * large], Polytope.from_points(large))
    np.testing.assert_allclose(np.abs(one.points), 0.5, atol=1e-6)


def test_part_that_faces_inwards_is_a_hole(file):
    hole = cube((0.05, 0.05, 0.05))
    hole.invert()
    hollow = clean_mesh(file(trimesh.util.concatenate([cube(), hole]), "hollow.stl"))
    assert hollow.parts.max() == 0
    assert measure_accuracy(
        hollow.faces, [Polytope.from_points(hollow.faces.vertices)]
    ).mesh_volume == pytest.approx(0.1**3 - 0.05**3)
    assert clean_mesh(file(overlapping(), "two.stl")).parts.max() == 1
    inverted = overlapping()
    inverted.invert()
    assert (
        clean_mesh(file(inverted, "inverted.stl")).digest == clean_mesh(file(overlapping(), "two.stl")).digest
    )


# The cache. What CoACD would make is of no interest here.

ONE_HULL = "return [(mesh.vertices, mesh.faces)]"


@pytest.fixture
def plain(tmp_path, monkeypatch):
    """Let CoACD return the mesh itself, and do not look at it long."""
    monkeypatch.setattr("kineverse.geometry.decomposition.accuracy.SAMPLES", 100)
    fake_coacd(tmp_path / "fake", monkeypatch, ONE_HULL)


def test_decompose_reads_the_cache(file, plain, monkeypatch):
    mesh = file(cube())
    assert find_hulls(mesh) is None
    first = decompose(mesh)
    assert not first.cached
    monkeypatch.setattr(convex_decomposition, "run_coacd", None)
    again = decompose(mesh)
    assert again.cached
    assert again.decomposition.accuracy == first.decomposition.accuracy
    for hulls in (again.decomposition.hulls, find_hulls(mesh), find_hulls(mesh, DecompositionSettings())):
        np.testing.assert_array_equal(hulls[0], first.decomposition.hulls[0])
        assert not hulls[0].flags.writeable
    # Another file of the same content, in another format, with the corners in another order.
    assert find_hulls(file(cube(), "other.stl")) is not None
    assert find_hulls(mesh, DecompositionSettings(max_hulls=3)) is None
    assert find_hulls(file(cube(), scale=(1.0, 2.0, 1.0))) is None


def test_find_hulls_without_settings_returns_the_latest(file, plain):
    mesh = file(cube())
    decompose(mesh, DecompositionSettings(max_hulls=5))
    latest = decompose(mesh, DecompositionSettings(error=0.01))
    assert result.find_entry(clean_mesh(mesh).digest).error == latest.decomposition.error == 0.01


def test_decompose_applies_scale_and_mirroring(file, plain):
    (hull,) = decompose(file(ell(), scale=(-1.0, 2.0, 0.5))).decomposition.hulls
    np.testing.assert_allclose(hull.min(axis=0), [-0.2, 0, 0], atol=1e-7)
    np.testing.assert_allclose(hull.max(axis=0), [0, 0.4, 0.025], atol=1e-7)


def test_cache_folder_is_private_and_damaged_files_are_dropped(file, plain, cache, caplog):
    mesh = file(cube())
    decompose(mesh)
    folder = cache / "decompositions"
    (path,) = folder.iterdir()
    if os.name == "posix":
        assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    content = path.read_bytes()
    assert Decomposition.from_bytes(content[:-32]).to_bytes() == content[:-32]
    for broken in (content[:-1], content[1:], b"", content[:50] + b"x" + content[51:]):
        path.write_bytes(broken)
        assert find_hulls(mesh) is None
        assert "damaged" in caplog.text
        assert not path.exists()
    with pytest.raises(FormatError):
        Decomposition.from_bytes(b"no archive")


def test_cache_is_bounded_listed_and_cleared(file, plain, monkeypatch):
    small, large = file(cube(), "small.stl"), file(cube((1, 1, 1)), "large.stl")
    decompose(small)
    decompose(large)
    assert [os.path.basename(kept.decomposition.name) for kept in list_entries()] == [
        "large.stl",
        "small.stl",
    ]
    room = max(kept.bytes for kept in list_entries()) + 100
    monkeypatch.setattr(result.DECOMPOSITIONS, "most_bytes", room)
    decompose(file(finger(), "finger.stl"))
    assert [os.path.basename(kept.decomposition.name) for kept in list_entries()] == ["finger.stl"]
    assert clear() == 1
    assert list_entries() == []


# CoACD goes wrong.

WRONG = {
    "os.abort": ("import os; os.abort()", "ended by SIGABRT"),
    "raises": ("raise RuntimeError('too concave')", "ended with status 1: RuntimeError: too concave"),
    "nothing": ("return []", "ended with status 1"),
    "no memory for C++": (
        "import os; os.write(2, b'instance of std::bad_alloc\\n\\nAborted.'); os.abort()",
        "by SIGABRT: Aborted. It needs more memory than it may have",
    ),
    "no memory to load": (
        "raise OSError('x.so: failed to map segment from shared object')",
        "object. It needs more memory than it may have",
    ),
    "no memory in the system": (
        "import os, signal; os.kill(os.getpid(), signal.SIGKILL)",
        "Systems without free memory",
    ),
    "a crash": (
        "import os; os.kill(os.getpid(), 11)",
        "SIGSEGV. Simplify or repair the mesh, or allow more memory",
    ),
    "not finite": ("mesh.vertices[0] = float('nan')\n" + ONE_HULL, "not where the mesh is"),
    "elsewhere": ("mesh.vertices += 1\n" + ONE_HULL, "not where the mesh is"),
    "a line": ("mesh.vertices[:] = mesh.vertices[0]\n" + ONE_HULL, "found no hull"),
    "hangs": ("while True: pass", "did not end within"),
}


@pytest.mark.sampled(2)
@pytest.mark.parametrize("name", WRONG)
def test_coacd_failure_is_an_error_that_names_the_file(file, tmp_path, monkeypatch, capfd, name):
    body, message = WRONG[name]
    fake_coacd(tmp_path / "fake", monkeypatch, body)
    limits = ResourceLimits(seconds=1.0 if name == "hangs" else 100.0)
    with pytest.raises(DecompositionError, match=message) as caught:
        decompose(file(cube(), "bad one.stl"), limits=limits)
    assert "bad one.stl" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")


@pytest.mark.skipif(sys.platform != "linux", reason="the memory of a process is bounded on Linux only")
def test_coacd_memory_is_bounded(file, tmp_path, monkeypatch):
    fake_coacd(tmp_path / "fake", monkeypatch, "bytearray(3 * 2**30)\n" + ONE_HULL)
    with pytest.raises(DecompositionError, match="more memory"):
        decompose(file(cube()), limits=ResourceLimits(memory=2 * 2**30))


def test_decompose_all_keeps_results_before_an_interruption(file, tmp_path, monkeypatch):
    fake_coacd(tmp_path / "fake", monkeypatch, "while len(mesh.vertices) > 8: pass\n" + ONE_HULL)
    good, endless = file(cube(), "good.stl"), file(ell(), "endless.stl")
    outcomes = decompose_all([good, endless], jobs=2)
    assert next(outcomes).mesh is good
    outcomes.close()  # as Ctrl-C does; returns only when CoACD has been ended
    assert find_hulls(good) is not None
    assert find_hulls(endless) is None


def test_coacd_process_does_not_outlive_its_parent(tmp_path, monkeypatch):
    fake_coacd(tmp_path / "fake", monkeypatch, "while True: pass")
    box = cube()
    np.savez(tmp_path / "in.npz", vertices=box.vertices, faces=box.faces, parts=np.zeros(12, dtype=int))
    command = [
        sys.executable,
        "-P",
        str(convex_decomposition.PROGRAM),
        str(tmp_path / "in.npz"),
        "out.npz",
        "1",
        str(2**33),
    ]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL) as process:
        process.stdin.close()
        assert process.wait() in (1, -signal.SIGKILL)


# Meshes that are none.


def _with_nan():
    mesh = cube()
    mesh.vertices[3, 1] = np.nan
    return mesh


def _soup():
    return trimesh.Trimesh(np.zeros((3, 3)), [[0, 1, 2]], process=False)


BAD = {
    "nan.stl": (_with_nan, FormatError, "not finite"),
    "huge.stl": (lambda: cube((1e9, 1, 1)), InvalidValueError, "extent"),
    "tiny.stl": (lambda: cube((1e-9, 1e-9, 1e-9)), InvalidValueError, "extent"),
    "flat.stl": (lambda: cube((1, 1, 0)), InvalidValueError, "flat"),
    "point.stl": (_soup, InvalidValueError, "extent"),
}


@pytest.mark.parametrize("name", BAD)
def test_decompose_refuses_unsuitable_meshes_and_names_the_file(file, monkeypatch, name):
    mesh, kind, message = BAD[name]
    monkeypatch.setattr(convex_decomposition, "run_coacd", None)
    bad = file(mesh(), name)
    for call in (decompose, find_hulls):
        with pytest.raises(kind, match=message) as caught:
            call(bad)
        assert name in str(caught.value)


@pytest.mark.parametrize("content", [b"", b"this is no mesh", b"solid x\nendsolid x\n"])
def test_decompose_refuses_files_that_are_no_meshes(tmp_path, content):
    (tmp_path / "none.stl").write_bytes(content)
    with pytest.raises(FormatError, match=r"none\.stl"):
        decompose(Mesh("none.stl", folder=str(tmp_path)))
    with pytest.raises(FormatError, match=r"gone\.stl"):
        decompose(Mesh("gone.stl", folder=str(tmp_path)))


@pytest.mark.parametrize("scale", [(0.0, 1.0, 1.0), (np.nan, 1.0, 1.0), (np.inf, 1.0, 1.0)])
def test_decompose_refuses_an_invalid_scale(file, scale):
    with pytest.raises(InvalidValueError, match="scale"):
        decompose(file(cube(), scale=scale))


def test_decompose_refuses_too_many_triangles(file, monkeypatch):
    monkeypatch.setattr("kineverse.geometry.decomposition.convex_decomposition.MOST_FACES", 10)
    with pytest.raises(InvalidValueError, match="12 triangles"):
        decompose(file(cube()))


@pytest.mark.parametrize("asked", [{"error": 0.0}, {"error": np.nan}, {"error": -1.0}, {"max_hulls": 0}])
def test_decomposition_settings_refuse_invalid_values(asked):
    with pytest.raises(InvalidValueError):
        DecompositionSettings(**asked)


def test_decompose_all_continues_after_an_error(file, plain, tmp_path):
    meshes = [Mesh("gone.stl", folder=str(tmp_path)), file(cube(), "a.stl"), file(ell(), "b.stl")]
    found = {outcome.mesh.uri: outcome for outcome in decompose_all(meshes, jobs=2)}
    assert "gone.stl" in str(found["gone.stl"].error)
    assert all(len(found[name].decomposition.hulls) == 1 for name in ("a.stl", "b.stl"))
