"""Written files in the libraries of their formats: bodies, masses, limits and poses are those of the model."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from pinocchio_oracle import PinocchioReference
from round_trip import SCENES, SHIPPED, load_cached, poses
from test_export_urdf import REFUSED

import kineverse as kv
from kineverse.model.basic_operations import SetBody
from kineverse.model.body import Body, Box, Capsule, Cone, Cylinder, Ellipsoid, Inertia, Mesh, Shape, Sphere

pin = pytest.importorskip("pinocchio")

CURVES = ("turns by", "slides by", "moves by speeds")  # which URDF cannot represent even without constraints
MODELS = [n for n in (*SHIPPED, *SCENES) if not any(word in REFUSED.get(n, "") for word in CURVES)]


def writable(shape: Shape) -> bool:
    """Return True for shapes that URDF has, with files that are there."""
    return not isinstance(shape.geometry, (Ellipsoid, Cone, Mesh))


def without_meshes(text: str) -> str:
    """Return a file without its meshes, whose folders pinocchio does not know."""
    return re.sub(r"<(visual|collision)\b(?:(?!</\1>).)*<mesh\b.*?</\1>", "", text, flags=re.DOTALL)


def assert_same_in_pinocchio(model: kv.Model, file: Path, seed: int = 0) -> None:
    """Compare shapes, masses, centres, moments, limits and poses with what urdfdom reads of a file."""
    text = without_meshes(file.read_text())
    reference = PinocchioReference(text)
    values = reference.random_values(np.random.default_rng(seed))
    assert set(values) == {str(s) for s in model.degrees_of_freedom}
    reference.place(values)
    frames = list(model.frames)
    for name, pose in zip(frames, poses(model, frames, values), strict=True):
        if name != "world":
            np.testing.assert_allclose(reference.pose(name), pose, rtol=0, atol=1e-9, err_msg=name)
    for kind, shapes in ((pin.COLLISION, "collisions"), (pin.VISUAL, "visuals")):
        read = pin.buildGeomFromUrdfString(reference.model, text, kind).geometryObjects
        found = sorted(re.sub(r"_\d+$", "", g.name) for g in read)
        assert found == sorted(n for n, b in model.bodies.items() for s in getattr(b, shapes) if writable(s))
    masses = [b.inertia.mass for n, b in model.bodies.items() if b.inertia is not None]
    # Pinocchio puts aside what is fixed to the world, and keeps it in the inertia of the universe.
    assert sum(i.mass for i in reference.model.inertias) == pytest.approx(sum(masses), rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.sampled(2)
def test_urdfdom_reads_the_urdf_of_shipped_models_as_they_are(name: str, tmp_path: Path) -> None:
    model = load_cached(name)
    model.save(tmp_path / "m.urdf")
    assert_same_in_pinocchio(model, tmp_path / "m.urdf")


FORMS = (Box((0.1, 0.2, 0.3)), Sphere(0.1), Cylinder(0.1, 0.4), Capsule(0.1, 0.4), Ellipsoid((0.1, 0.2, 0.3)))


@pytest.mark.parametrize("newer", [False, True])
@pytest.mark.parametrize(
    "forms", [FORMS, *((form,) for form in FORMS)], ids=lambda f: f[0].kind + str(len(f))
)
def test_urdfdom_reads_every_shape_that_is_written(forms: tuple, newer: bool, tmp_path: Path) -> None:
    shapes = tuple(Shape(form) for form in forms)
    inertia = Inertia(2.0, (1, 0, 0, 1, 0, 1))
    dynamics = (("effort", 3.0), ("acceleration", 4.0)) if newer else ()
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("base", "world", body=Body(shapes, shapes, inertia))
        edit.apply(kv.Revolute(name="q", parent="base", child="arm", lower=-1, upper=1, dynamics=dynamics))
        edit.apply(SetBody("arm", Body(shapes, shapes, inertia)))
    saved = model.save(tmp_path / "m.urdf")
    assert_same_in_pinocchio(model, tmp_path / "m.urdf")
    text = saved.path.read_text()
    has_capsule = any(isinstance(form, Capsule) for form in forms)
    # A parser of version 1.0 reads what does not need a newer one.
    assert ('version="1.2"' in text, 'version="1.1"' in text) == (newer, has_capsule and not newer)
    assert any("version 1.1" in r for r in saved.remarks) == (has_capsule and not newer)
