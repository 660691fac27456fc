"""Sphere covers and trees by the content of shapes: in memory, on the disk, damaged."""

import numpy as np
import pytest

import kineverse as kv
from kineverse.errors import InvalidValueError
from kineverse.geometry.objects import CollisionObjects
from kineverse.model.body import Body, Box, Mesh, Shape
from kineverse.planning.spheres import cover_objects, make_sphere_tree, object_covers
from kineverse.planning.spheres.object_covers import cover_key, find_or_make_tree


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Separate the cache of this test from all others."""
    monkeypatch.setenv("KINEVERSE_CACHE_DIR", str(tmp_path))
    object_covers._in_memory.clear()
    return tmp_path


def collision_object(geometry, triangles=()):
    """Return the collision object of a model with one shape."""
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("part", "world", body=Body(collisions=(Shape(geometry),)))
    objects = CollisionObjects(tuple(triangles), (), ())
    objects.synchronize(model)
    return objects.by_body["part"][0]


@pytest.fixture
def fits(monkeypatch):
    """Count the covers that are computed."""
    made, original = [], object_covers.cover_solids

    def count(*arguments):
        made.append(arguments)
        return original(*arguments)

    monkeypatch.setattr(object_covers, "cover_solids", count)
    return made


def test_equal_shapes_and_settings_are_covered_once(fits):
    first = cover_objects([collision_object(Box((0.1, 0.1, 0.1)))], 0.02)
    assert cover_objects([collision_object(Box((0.1, 0.1, 0.1)))], 0.02) is first
    assert len(fits) == 1
    cover_objects([collision_object(Box((0.1, 0.1, 0.1)))], 0.03)
    cover_objects([collision_object(Box((0.1, 0.1, 0.1)))], 0.02, 4)
    cover_objects([collision_object(Box((0.1, 0.1, 0.11)))], 0.02)
    assert len(fits) == 4
    cover_objects([collision_object(Box((0.1, 0.1, 0.1)))], 0.02, force=True)
    assert len(fits) == 5


def test_the_disk_gives_back_the_same_cover(fits):
    first = cover_objects([collision_object(Box((0.1, 0.1, 0.1)))], 0.02)
    object_covers._in_memory.clear()
    again = cover_objects([collision_object(Box((0.1, 0.1, 0.1)))], 0.02)
    assert len(fits) == 1
    assert np.array_equal(again.centres, first.centres)
    assert np.array_equal(again.radii, first.radii)
    assert again.protrusion == first.protrusion
    assert not again.centres.flags.writeable
    assert [one.name for one in object_covers.list_covers()] == ["part: box"]


def test_trees_are_kept_by_solids_poses_and_settings():
    box, made = collision_object(Box((0.1, 0.1, 0.1))).make_solid(), []
    spheres = np.random.default_rng(0).uniform(0.1, 0.2, (9, 4))
    moved = np.eye(4)
    moved[0, 3] = 0.1

    def make():
        made.append(make_sphere_tree(spheres[:, :3], spheres[:, 3]))
        return made[-1]

    def find(*parts, protrusion=0.02):
        object_covers._in_memory.clear()
        return find_or_make_tree(cover_key(parts, protrusion), make)

    first, again = find((box, np.eye(4))), find((box, np.eye(4)))
    assert len(made) == 1
    for name in first.__slots__:
        assert np.array_equal(getattr(first, name), getattr(again, name)), name
    find((box, moved))
    find((box, np.eye(4)), (box, moved))
    find((box, np.eye(4)), protrusion=None)
    assert len(made) == 4
    object_covers.clear_covers()
    find((box, np.eye(4)))
    assert len(made) == 5


@pytest.mark.parametrize("damage", [b"", b"nonsense", None])
def test_damaged_files_count_as_absent(fits, folder, damage, caplog):
    cover_objects([collision_object(Box((0.1, 0.1, 0.1)))], 0.02)
    object_covers._in_memory.clear()
    (file,) = (folder / "spheres").glob("*.spheres")
    file.write_bytes(file.read_bytes()[:-40] if damage is None else damage)
    cover_objects([collision_object(Box((0.1, 0.1, 0.1)))], 0.02)
    assert len(fits) == 2
    assert "damaged" in caplog.text


def test_the_cache_is_bounded_and_can_be_emptied(monkeypatch):
    monkeypatch.setattr(object_covers.COVERS, "most_bytes", 500)
    for k in range(5):
        cover_objects([collision_object(Box((0.1, 0.1, 0.1 + 0.01 * k)))], 0.2)
    assert 0 < len(object_covers.list_covers()) < 5
    assert object_covers.clear_covers() > 0
    assert not object_covers.list_covers()


def test_triangle_meshes_are_refused(tmp_path):
    path = tmp_path / "tetrahedron.stl"
    corners, lines = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], ["solid x"]
    for face in ((0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2)):
        lines += ["facet normal 0 0 0", "outer loop"]
        lines += ["vertex {} {} {}".format(*corners[k]) for k in face]
        lines += ["endloop", "endfacet"]
    path.write_text("\n".join([*lines, "endsolid x"]))
    mesh = Mesh(str(path), (0.1, 0.1, 0.1))
    with pytest.raises(InvalidValueError, match="body 'part' is a triangle mesh"):
        cover_objects([collision_object(mesh, triangles=["part"])])
    assert len(cover_objects([collision_object(mesh)])) > 1
