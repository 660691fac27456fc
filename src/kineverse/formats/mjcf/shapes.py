"""Shapes and inertia of MJCF geoms."""

from __future__ import annotations

from typing import Any

from kineverse.formats import poses
from kineverse.formats.poses import compose_poses, invert_pose
from kineverse.formats.resource_paths import find_root_violation
from kineverse.model.body import (
    Body,
    Box,
    Capsule,
    Cylinder,
    Ellipsoid,
    Geometry,
    Inertia,
    Pose,
    Rgba,
    Shape,
    Sphere,
)

from .compile import CompiledMjcf
from .elements import ElementRemark
from .meshes import place_mesh
from .mujoco_api import mujoco

_VISIBLE_GROUPS = range(3)
"""Geom groups that MuJoCo's viewers show by default."""

_DEFAULT_COLOR = [0.5, 0.5, 0.5, 1.0]
"""Colour of a geom without one, which has the colour of its material instead."""


class MjcfShapes:
    """Shapes and inertia of the bodies of a compiled model."""

    def __init__(self, compiled: CompiledMjcf, folder: str, root: str, remark: ElementRemark) -> None:
        self._model, self._compiled = compiled.model, compiled
        self._folder, self._root = folder, root
        self._nodes, self._remark = compiled.nodes(compiled.spec.geoms), remark

    def body(self, number: int) -> Body:
        """Return the shapes and the inertia of a body; no inertia if it is unknown or zero."""
        m = self._model
        visuals: list[Shape] = []
        collisions: list[Shape] = []
        first = int(m.body_geomadr[number])
        for geom in range(first, first + int(m.body_geomnum[number])):
            collides = bool(m.geom_contype[geom] or m.geom_conaffinity[geom])
            color = self._color(geom)
            is_visible = int(m.geom_group[geom]) in _VISIBLE_GROUPS and color[3] > 0.0
            shape = self._shape(geom, color) if collides or is_visible else None
            if shape is not None:
                if is_visible:
                    visuals.append(shape)
                if collides:
                    collisions.append(shape)
        return Body(tuple(visuals), tuple(collisions), self._inertia(number))

    def _inertia(self, number: int) -> Inertia | None:
        """Return the inertia of a body; None if it is unknown or zero."""
        m = self._model
        mass = float(m.body_mass[number])
        a, b, c = m.body_inertia[number].tolist()
        if number in self._compiled.unknown_inertia or not (mass or a or b or c):
            return None
        return Inertia(mass, (a, 0.0, 0.0, b, 0.0, c), mujoco_pose(m.body_ipos[number], m.body_iquat[number]))

    def _shape(self, geom: int, color: Rgba) -> Shape | None:
        """Return the shape of a geom; None, with a remark, if it is left out."""
        m, kinds = self._model, mujoco().mjtGeom
        name, kind = m.geom(geom).name, m.geom_type[geom]
        pose = mujoco_pose(m.geom_pos[geom], m.geom_quat[geom])
        if geom in self._compiled.left_out:
            self._remark_geom(geom, self._compiled.left_out[geom])
            return None
        if kind != kinds.mjGEOM_MESH:
            form = _primitive(kind, m.geom_size[geom].tolist())
            if form is None:
                self._remark_geom(geom, "is left out: a plane has no end, which no shape here has.")
                return None
            return Shape(form, pose, name, color)
        mesh = int(m.geom_dataid[geom])
        asset = self._compiled.assets.get(m.mesh(mesh).name)
        if asset is None or not asset.uri:
            self._remark_geom(geom, "is left out: its triangles are in no file.")
            return None
        mesh_T_centre = mujoco_pose(m.mesh_pos[mesh], m.mesh_quat[mesh])
        placed = place_mesh(asset, compose_poses(pose, invert_pose(mesh_T_centre)), self._folder, self._root)
        if placed is None:
            self._remark_geom(
                geom, "is left out: its mesh is scaled along other axes than those of its file."
            )
            return None
        violation = find_root_violation(asset.uri, self._folder, self._root)
        if violation is not None:
            self._remark_geom(geom, f"names {violation}")
        form, origin = placed
        return Shape(form, origin, name, color)

    def _remark_geom(self, geom: int, text: str) -> None:
        self._remark(self._nodes[geom], text)

    def _color(self, geom: int) -> Rgba:
        """Return the colour of a geom, or of its material if it has none."""
        m = self._model
        rgba, material = m.geom_rgba[geom].tolist(), int(m.geom_matid[geom])
        if material >= 0 and rgba == _DEFAULT_COLOR:
            rgba = m.mat_rgba[material].tolist()
        red, green, blue, alpha = (round(value, 7) for value in rgba)  # single precision
        return red, green, blue, alpha


def _primitive(kind: int, size: list[float]) -> Geometry | None:
    """Return the geometry of a primitive geom; None for other types."""
    kinds = mujoco().mjtGeom
    x, y, z = size
    if kind == kinds.mjGEOM_BOX:
        return Box((2.0 * x, 2.0 * y, 2.0 * z))
    if kind == kinds.mjGEOM_SPHERE:
        return Sphere(x)
    if kind == kinds.mjGEOM_CAPSULE:
        return Capsule(x, 2.0 * y)
    if kind == kinds.mjGEOM_CYLINDER:
        return Cylinder(x, 2.0 * y)
    return Ellipsoid((x, y, z)) if kind == kinds.mjGEOM_ELLIPSOID else None


def mujoco_pose(position: Any, wxyz: Any) -> Pose:
    """Return the pose of a position and a quaternion (w, x, y, z), in MuJoCo's order."""
    x, y, z = map(float, position)
    w, a, b, c = map(float, wxyz)
    return poses.pose_from_quaternion((x, y, z), (a, b, c, w))
