"""Shapes and mass properties of the bodies on a USD stage."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from kineverse.formats.description import Matrix
from kineverse.formats.xml_reader import quote
from kineverse.lie import inverse, round_exact, transform
from kineverse.model.body import (
    Body,
    Box,
    Capsule,
    Cone,
    Cylinder,
    Ellipsoid,
    Geometry,
    Inertia,
    Pose,
    Shape,
    Sphere,
)

from .pxr_api import NAME, number_of, numbers_of, pose_from_gf, pxr, text_of
from .scene import IN_WORLD, UsdBody, UsdScene, find_body_above

_EQUAL = 1e-6  # relative difference of two scales that are one: stages have six digits of them
_AXES = {
    "X": np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]),
    "Y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
    "Z": np.eye(3),
}
"""Rotations whose last column is an axis: shapes of the model are about z."""


class UsdBodyReader:
    """Reader of the bodies of one scene."""

    def __init__(self, scene: UsdScene, source: str) -> None:
        self._scene, self._source = scene, source
        self._xforms = pxr().UsdGeom.XformCache()
        self._shapes: dict[str, list[tuple[Any, str]]] = {}
        self.remarks: list[str] = []
        self._meshes = 0
        for prim in scene.stage.Traverse(pxr().Usd.TraverseInstanceProxies()):
            if prim.IsA(pxr().UsdGeom.Gprim):
                self._shapes.setdefault(find_body_above(prim, scene.bodies), []).append(
                    (prim, str(prim.GetPath()))
                )

    def read(self, body: UsdBody | None) -> Body:
        """Return the shapes and the mass of a body; those of the world without one."""
        place = np.eye(4) if body is None else body.pose
        visuals: list[Shape] = []
        collisions: list[Shape] = []
        for prim, path in self._shapes.get(IN_WORLD if body is None else body.path, ()):
            is_collision = prim.HasAPI(pxr().UsdPhysics.CollisionAPI)
            enabled = prim.GetAttribute("physics:collisionEnabled")
            purpose = prim.GetAttribute("purpose").Get()
            is_visual = purpose in ("default", "render", None)
            is_touched = is_collision and not (enabled and enabled.Get() is False)
            if not (is_visual or is_touched):
                continue
            shape = self._shape(prim, path, place)
            if shape is not None:
                visuals += [shape] if is_visual else []
                collisions += [shape] if is_touched else []
        inertia = None if body is None or body.is_massless else self._inertia(body)
        return Body(tuple(visuals), tuple(collisions), inertia)

    def finish(self) -> list[str]:
        """Return the remarks, with the number of meshes that are left out."""
        if self._meshes:
            self.remarks.append(
                f"{self._source}: {self._meshes} mesh{'es are' * (self._meshes > 1) or ' is'} left out: the "
                "triangles of a USD file are not read. Models that Kineverse wrote refer to the files of "
                "their meshes."
            )
        return self.remarks

    def _shape(self, prim: Any, path: str, world_T_body: Matrix) -> Shape | None:
        if prim.GetTypeName() == "Mesh":
            self._meshes += 1
            return None
        units = self._scene.units
        rows = np.array(self._xforms.GetLocalToWorldTransform(prim)).T
        linear = units.rotation @ rows[:3, :3]
        scale = np.linalg.norm(linear, axis=0)
        if not (np.isfinite(rows).all() and scale.min() > 0):
            self._say(path, "has no size")
            return None
        turn = linear / scale
        if np.abs(turn.T @ turn - np.eye(3)).max() > _EQUAL:
            self._say(path, "is sheared, as no shape of a model is")
            return None
        geometry, axis = self._geometry(prim, path, scale * units.length)
        if geometry is None:
            return None
        if np.linalg.det(turn) < 0:  # shapes are their own mirror images across their axis
            turn[:, 1 if axis == "X" else 0] *= -1.0
        world_T_shape = transform(turn @ _AXES[axis], units.rotation @ rows[:3, 3] * units.length)
        origin = round_exact(inverse(world_T_body) @ world_T_shape)
        return Shape(geometry, Pose.from_matrix(origin), text_of(prim, NAME) or "", _color(prim))

    def _geometry(self, prim: Any, path: str, scale: Matrix) -> tuple[Geometry | None, str]:
        """Return the geometry of a prim at a scale [m], and its axis."""
        kind, axis = str(prim.GetTypeName()), "Z"

        def number(name: str) -> float:
            found = number_of(prim, name)
            return math.nan if found is None else found

        form: Geometry
        if kind == "Cube":
            x, y, z = sizes = (number("size") * scale).tolist()
            form = Box((x, y, z))
        elif kind == "Sphere":
            a, b, c = sizes = (number("radius") * scale).tolist()
            form = Sphere(a) if _same(a, b, c) else Ellipsoid((a, b, c))
        elif kind in ("Cylinder", "Capsule", "Cone"):
            given = str(prim.GetAttribute("axis").Get())
            axis = given if given in _AXES else axis
            along = "XYZ".index(axis)
            across = [float(scale[k]) for k in range(3) if k != along]
            if not _same(*across) or (kind == "Capsule" and not _same(*scale.tolist())):
                self._say(path, f"is a {kind.lower()} that is scaled to none")
                return None, axis
            sizes = [number("radius") * across[0], number("height") * float(scale[along])]
            form = {"Cylinder": Cylinder, "Capsule": Capsule, "Cone": Cone}[kind](*sizes)  # type: ignore[assignment]
        else:
            self._say(path, f"is a {quote(kind)}, which no model has")
            return None, axis
        if not all(0 <= size < math.inf for size in sizes):
            self._say(path, "has a size that is none")
            return None, axis
        return form, axis

    def _inertia(self, body: UsdBody) -> Inertia | None:
        prim = self._scene.stage.GetPrimAtPath(body.path)
        units = self._scene.units
        mass = (number_of(prim, "physics:mass") or 0.0) * units.mass
        if not mass > 0:
            prims = [prim, *(shape for shape, _ in self._shapes.get(body.path, ()))]
            if any(number_of(one, f"physics:{key}") for one in prims for key in ("density", "mass")):
                self._say(body.path, "has a density, or colliders with a mass, which is left out")
            return None
        rows = np.array(self._xforms.GetLocalToWorldTransform(prim)).T
        point = np.array(numbers_of(prim, "physics:centerOfMass", 3) or (0.0, 0.0, 0.0))
        world = units.rotation @ (rows @ np.append(point, 1.0))[:3] * units.length
        place = (inverse(body.pose) @ np.append(world, 1.0))[:3]
        axes = prim.GetAttribute("physics:principalAxes").Get()
        turn = np.eye(3)
        if isinstance(axes, pxr().Gf.Quatf):
            turn = pose_from_gf((0.0, 0.0, 0.0), axes)[:3, :3]
        diagonal = np.array(numbers_of(prim, "physics:diagonalInertia", 3) or (0.0, 0.0, 0.0))
        xx, yy, zz = (diagonal * units.mass * units.length**2).tolist()
        if not any((xx, yy, zz)):
            self._say(body.path, "has a mass and no moments of inertia, which are 0 here")
        return Inertia(
            mass, (xx, 0.0, 0.0, yy, 0.0, zz), Pose.from_matrix(round_exact(transform(turn, place)))
        )

    def _say(self, path: str, text: str) -> None:
        self.remarks.append(f"{self._source}: {path} {text}.")


def _same(*numbers: float) -> bool:
    return max(numbers) - min(numbers) <= _EQUAL * max(numbers)


def _color(prim: Any) -> tuple[float, float, float, float] | None:
    """Return the first colour of a shape, with its opacity."""
    rgb = numbers_of(prim, "primvars:displayColor", 3)
    if not rgb:
        return None
    (alpha,) = numbers_of(prim, "primvars:displayOpacity", 1) or (1.0,)
    return rgb[0], rgb[1], rgb[2], alpha
