"""Models with everything in them that a document has to carry."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import kineverse as kv
from kineverse.model.body import Box, Capsule, Cone, Cylinder, Ellipsoid, Mesh, Sphere
from kineverse.model.read_recorder import ReadRecorder


@dataclass(frozen=True)
class Doubled(kv.Operation):
    """Reads a datum, lists the bodies and writes twice the datum: a class that no reader of a document has."""

    source: str
    target: str

    def apply(self, model: ReadRecorder) -> kv.model.Writes:
        value = model.data[self.source]
        return kv.model.Writes(
            data={self.target: 2 * value, f"{self.target}/bodies": len(list(model.bodies))}
        )


@dataclass(frozen=True)
class Dressed(kv.Operation):
    """Gives a frame one shape of each kind, with names and colours and without."""

    frame: str

    def apply(self, model: ReadRecorder) -> kv.model.Writes:
        origin = kv.model.Pose.from_matrix(kv.translation(1, 0.1, 0) @ kv.rotation_z(0.3))
        shapes = (
            kv.model.Shape(Box((1, 2, 0.3)), origin, "a box", (1, 0, 0.5, 1)),
            kv.model.Shape(Cylinder(0.1, 1 / 3)),
            kv.model.Shape(Capsule(0.1, 0.2)),
            kv.model.Shape(Ellipsoid((0.1, 0.2, 0.3))),
            kv.model.Shape(Cone(0.1, 0.2)),
            kv.model.Shape(Sphere(1e-3), texture="wood.png"),
            kv.model.Shape(Mesh("package://cups/cup.stl", (0.001, 0.001, 0.001), "/models")),
        )
        inertia = kv.model.Inertia(0.3, (1, 0, 0, 2, 0.1, 3), origin)
        return kv.model.Writes(bodies={self.frame: kv.model.Body(shapes, shapes[:1], inertia)})


def rich_model() -> kv.Model:
    """Return a model with every node type, joints, rates, data, awkward names and numbers."""
    a, b, c = (kv.position(path) for path in ("a", "ünt:er/b%", "c"))
    p = kv.parameter("length", 0.1 + 0.2)
    closed = (a < 0.3) & (b < c) | ~(p < a)
    bent = (np.sin(a) * b).augment({kv.velocity("wheel"): p * c, a.derivative(): b})
    model = kv.load("shelf_door")
    with model.edit() as edit:
        edit.apply(
            kv.articulations.DifferentialDrive(
                name="drive", parent="world", child="base", radius=0.1, track=0.5
            )
        )
        edit.apply(kv.Floating(name="cup", parent="base", child="cup"))
        hinge = kv.Revolute(
            name="arm", parent="base", child="arm", axis=(1, 2, 3), lower=-1, upper=p, velocity=3
        )
        edit.apply(hinge, tag="the arm")
        edit.add_frame(
            "bent",
            parent="arm",
            transform=kv.translation(bent, kv.minimum(a, p), kv.norm(kv.array([a, b, c]))),
        )
        edit.constrain("lock", -closed, a.derivative(), closed)
        edit.constrain("profile", -1, kv.spline(a * b, (-0.3, 0.1, 0.2), (0.5, 1 / 3, 0.5), periodic=True), p)
        edit.constrain("choice", -np.inf, kv.where(a < b, bent, kv.maximum(b, c)), np.inf)
    seen = model.fk("arm")[0, 3] * model.fk("arm")[0, 0]  # over coordinates that carry rates
    with model.edit() as edit:
        edit.constrain("heading", -1, seen.substitute({kv.position("drive/x"): a * b}), 1e300)
        edit.constrain("replaced", -0.0, b.with_gradient({kv.velocity("wheel"): 5e-324}), 1)
        edit.constrain("guess", 0, c.augment({kv.velocity("wheel"): 1}, heuristic=True), 1)
        edit.write("colour", ("red", 1, True, None, -np.inf, (a * b,)))
        edit.write("number", 21)
        edit.apply(Doubled("number", "twice"), tag="mine")
        edit.apply(Dressed("cup"))
    return model
