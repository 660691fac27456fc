"""Mass properties, shapes and meshes of written USD bodies."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from kineverse.errors import FormatError, MissingDependencyError, summarize_error
from kineverse.formats.description import Matrix
from kineverse.formats.names import TakenNames
from kineverse.lie import transform
from kineverse.model.body import (
    Body,
    Box,
    Capsule,
    Cone,
    Cylinder,
    Ellipsoid,
    Geometry,
    Inertia,
    Mesh,
    Shape,
    Sphere,
)
from kineverse.model.registry import find_service

from .pxr_api import MASSLESS, NAME, pxr, set_text, to_gf_matrix, to_gf_quaternion

SMALLEST_MASS, SMALLEST_INERTIA = 1e-3, 1e-6
"""Mass [kg] and moments of inertia [kg m²] of moving bodies that have neither mass nor anything to touch."""

_ROUNDING = 1e-12  # relative size of a negative moment that is a rounding error
_Z = "Z"


class PrimNames:
    """Identifiers of the prims below one prim, made of names and each used once."""

    def __init__(self, *taken: str) -> None:
        self._taken = TakenNames(taken)

    def take(self, name: str) -> str:
        """Return a free identifier for a name: other characters become underscores."""
        # Versions of OpenUSD before 24.03 read no identifiers outside of ASCII.
        identifier = re.sub(r"\W", "_", name, flags=re.ASCII) or "_"
        return self._taken.take(f"_{identifier}" if identifier[0].isdigit() else identifier)


class UsdBodyWriter:
    """Writer of the bodies of one stage."""

    def __init__(self, stage: Any, remarks: list[str]) -> None:
        self._stage, self._remarks = stage, remarks
        self._meshes: dict[Mesh, tuple[Any, Any, Any] | None] = {}

    def write(self, prim: Any, body: Body, name: str, moves: bool) -> None:
        """Add the mass and the shapes of a body to its prim; the world has shapes only."""
        if moves:
            has_mass = body.inertia is not None and self._inertia(prim, body.inertia, name)
            if not has_mass and not body.collisions:
                self._mass(prim, SMALLEST_MASS, np.eye(4), (SMALLEST_INERTIA,) * 3)
                prim.CreateAttribute(MASSLESS, pxr().Sdf.ValueTypeNames.Bool, True).Set(True)
        names = PrimNames()
        for shape in body.visuals:
            self._shape(
                prim, shape, names.take(f"visual_{shape.name}" if shape.name else "visual"), name, False
            )
        for shape in body.collisions:
            own = names.take(f"collision_{shape.name}" if shape.name else "collision")
            self._shape(prim, shape, own, name, True)

    def _inertia(self, prim: Any, inertia: Inertia, name: str) -> bool:
        """Add the mass properties; return False, with a remark, if no body has such ones."""
        xx, xy, xz, yy, yz, zz = inertia.tensor
        moments, axes = np.array([xx, yy, zz]), np.eye(3)
        if xy or xz or yz:
            moments, axes = np.linalg.eigh(np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))
            axes = axes * np.sign(np.linalg.det(axes))
        if inertia.mass < 0 or moments.min() < -_ROUNDING * max(moments.max(), 0.0):
            self._remark(f"the inertia of '{name}' is left out: no body has one that is negative")
            return False
        moments = np.maximum(moments, 0.0)
        if inertia.mass == 0.0 and not moments.any():
            return False
        if inertia.mass == 0.0 or not moments.all():
            self._remark(f"'{name}' has a mass or moments of 0, which engines replace by what they compute")
        pose = inertia.origin.matrix @ transform(axes, np.zeros(3))
        self._mass(prim, inertia.mass, pose, tuple(moments.tolist()))
        return True

    def _mass(self, prim: Any, mass: float, pose: Matrix, moments: tuple[float, ...]) -> None:
        api = pxr().UsdPhysics.MassAPI.Apply(prim)
        api.CreateMassAttr(mass)
        api.CreateCenterOfMassAttr(tuple(pose[:3, 3].tolist()))
        api.CreateDiagonalInertiaAttr(moments)
        api.CreatePrincipalAxesAttr(to_gf_quaternion(pose))

    def _shape(self, prim: Any, shape: Shape, own: str, name: str, is_collision: bool) -> None:
        path = prim.GetPath().AppendChild(own)
        if is_collision and isinstance(shape.geometry, Ellipsoid):
            self._remark(f"an ellipsoid collider of '{name}' is left out: UsdPhysics has none")
            return
        made = self._geometry(path, shape.geometry)
        if made is None:
            return
        gprim, scale = made
        gprim.AddTransformOp().Set(to_gf_matrix(shape.origin.matrix @ np.diag([*scale, 1.0])))
        if shape.name:
            set_text(gprim.GetPrim(), NAME, shape.name)
        if shape.color is not None:
            *rgb, alpha = shape.color
            gprim.CreateDisplayColorAttr([tuple(rgb)])
            if alpha != 1.0:
                gprim.CreateDisplayOpacityAttr([alpha])
        if shape.texture:
            self._remark(f"the texture {shape.texture} is left out")
        if not is_collision:
            return
        api = pxr()
        gprim.CreatePurposeAttr(api.UsdGeom.Tokens.guide)
        api.UsdPhysics.CollisionAPI.Apply(gprim.GetPrim())
        if isinstance(shape.geometry, Mesh):
            mesh = api.UsdPhysics.MeshCollisionAPI.Apply(gprim.GetPrim())
            mesh.CreateApproximationAttr(api.UsdPhysics.Tokens.convexHull)

    def _geometry(self, path: Any, form: Geometry) -> tuple[Any, tuple[float, float, float]] | None:
        """Define the prim of a shape; return it and the scale that its transform needs."""
        geometry, whole = pxr().UsdGeom, (1.0, 1.0, 1.0)
        made: Any
        extent: list[tuple[float, ...]]
        if isinstance(form, Box):
            made = geometry.Cube.Define(self._stage, path)
            made.CreateSizeAttr(1.0)
            made.CreateExtentAttr([(-0.5,) * 3, (0.5,) * 3])
            return made, form.size
        if isinstance(form, Mesh):
            return self._mesh(path, form)
        if isinstance(form, (Sphere, Ellipsoid)):
            is_round = isinstance(form, Sphere)
            made = geometry.Sphere.Define(self._stage, path)
            radius = form.radius if isinstance(form, Sphere) else 1.0
            made.CreateRadiusAttr(radius)
            made.CreateExtentAttr([(-radius,) * 3, (radius,) * 3])
            return made, whole if is_round else form.radii  # type: ignore[union-attr]
        kind = {Cylinder: "Cylinder", Capsule: "Capsule", Cone: "Cone"}[type(form)]
        made = getattr(geometry, kind).Define(self._stage, path)
        made.CreateAxisAttr(_Z)
        made.CreateRadiusAttr(form.radius)
        made.CreateHeightAttr(form.length)
        half = form.length / 2 + (form.radius if isinstance(form, Capsule) else 0.0)
        extent = [(-form.radius, -form.radius, -half), (form.radius, form.radius, half)]
        made.CreateExtentAttr(extent)
        return made, whole

    def _mesh(self, path: Any, mesh: Mesh) -> tuple[Any, tuple[float, float, float]] | None:
        if mesh not in self._meshes:
            self._meshes[mesh] = self._triangles(mesh)
        found = self._meshes[mesh]
        if found is None:
            return None
        points, indices, extent = found
        api = pxr()
        made = api.UsdGeom.Mesh.Define(self._stage, path)
        made.CreatePointsAttr(points)
        made.CreateFaceVertexCountsAttr(
            api.Vt.IntArray.FromNumpy(np.full(len(indices) // 3, 3, dtype=np.int32))
        )
        made.CreateFaceVertexIndicesAttr(indices)
        made.CreateSubdivisionSchemeAttr(api.UsdGeom.Tokens.none)
        made.CreateExtentAttr(extent)
        return made, (1.0, 1.0, 1.0)

    def _triangles(self, mesh: Mesh) -> tuple[Any, Any, Any] | None:
        """Return the points, the indices and the box of a mesh; None, with a remark, if it cannot be read."""
        try:
            found = find_service("read_mesh")(mesh)
        except (FormatError, MissingDependencyError, OSError) as error:
            self._remark(f"the mesh {mesh.uri} is left out. {summarize_error(error)}")
            return None
        points = (found.vertices * np.array(mesh.scale)).astype(np.float32)
        faces = found.faces.astype(np.int32)
        if np.prod(mesh.scale) < 0:
            faces = faces[:, ::-1]  # a mirrored triangle is seen from its other side
        vt = pxr().Vt
        extent = np.array([points.min(axis=0), points.max(axis=0)])
        indices = vt.IntArray.FromNumpy(np.ascontiguousarray(faces.ravel()))
        return vt.Vec3fArray.FromNumpy(points), indices, vt.Vec3fArray.FromNumpy(extent)

    def _remark(self, text: str) -> None:
        if text not in self._remarks:
            self._remarks.append(text)
