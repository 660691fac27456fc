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

from .compile import CompiledMjcf, ElementNote
from .meshes import place_mesh
from .mujoco_api import mujoco

_SHOWN = range(3)
"""The groups that MuJoCo's viewers show unless they are asked for others."""

_UNSET = [0.5, 0.5, 0.5, 1.0]
"""The colour of a geom that says none, in place of which its material's is used."""


class MjcfShapes:
    """Reads the shapes and inertia of bodies.

    Parameters
    ----------
    compiled
        What MuJoCo made of the document.
    folder
        From where mesh files are found.
    note
        Called with what is left out, and why.
    """

    def __init__(self, compiled: CompiledMjcf, folder: str, root: str, note: ElementNote) -> None:
        self._model, self._compiled = compiled.model, compiled
        self._folder, self._root = folder, root
        self._nodes, self._say = compiled.nodes(compiled.spec.geoms), note

    def body(self, number: int) -> Body:
        """Return what a body carries; its inertia is none where nobody knows it."""
        m = self._model
        visuals: list[Shape] = []
        collisions: list[Shape] = []
        first = int(m.body_geomadr[number])
        for geom in range(first, first + int(m.body_geomnum[number])):
            touches = bool(m.geom_contype[geom] or m.geom_conaffinity[geom])
            color = self._color(geom)
            shown = int(m.geom_group[geom]) in _SHOWN and color[3] > 0.0
            shape = self._shape(geom, color) if touches or shown else None
            if shape is not None:
                if shown:
                    visuals.append(shape)
                if touches:
                    collisions.append(shape)
        return Body(tuple(visuals), tuple(collisions), self._inertia(number))

    def _inertia(self, number: int) -> Inertia | None:
        m = self._model
        mass = float(m.body_mass[number])
        a, b, c = m.body_inertia[number].tolist()
        if number in self._compiled.guessed or not (mass or a or b or c):
            return None
        return Inertia(mass, (a, 0.0, 0.0, b, 0.0, c), mujoco_pose(m.body_ipos[number], m.body_iquat[number]))

    def _shape(self, geom: int, color: Rgba) -> Shape | None:
        m, kinds = self._model, mujoco().mjtGeom
        name, kind = m.geom(geom).name, m.geom_type[geom]
        pose = mujoco_pose(m.geom_pos[geom], m.geom_quat[geom])
        if geom in self._compiled.left_out:
            self._note(geom, self._compiled.left_out[geom])
            return None
        if kind != kinds.mjGEOM_MESH:
            form = _primitive(kind, m.geom_size[geom].tolist())
            if form is None:
                self._note(geom, "is left out: a plane has no end, which no shape here has.")
                return None
            return Shape(form, pose, name, color)
        mesh = int(m.geom_dataid[geom])
        asset = self._compiled.assets.get(m.mesh(mesh).name)
        if asset is None or not asset.uri:
            self._note(geom, "is left out: its triangles are in no file.")
            return None
        centred = mujoco_pose(m.mesh_pos[mesh], m.mesh_quat[mesh])
        found = place_mesh(asset, compose_poses(pose, invert_pose(centred)), self._folder, self._root)
        if found is None:
            self._note(geom, "is left out: its mesh is scaled along other axes than those of its file.")
            return None
        wrong = find_root_violation(asset.uri, self._folder, self._root)
        if wrong is not None:
            self._note(geom, f"names {wrong}")
        form, origin = found
        return Shape(form, origin, name, color)

    def _note(self, geom: int, text: str) -> None:
        self._say(self._nodes[geom], text)

    def _color(self, geom: int) -> Rgba:
        m = self._model
        rgba, material = m.geom_rgba[geom].tolist(), int(m.geom_matid[geom])
        if material >= 0 and rgba == _UNSET:
            rgba = m.mat_rgba[material].tolist()
        red, green, blue, alpha = (round(value, 7) for value in rgba)  # single precision
        return red, green, blue, alpha


def _primitive(kind: int, size: list[float]) -> Geometry | None:
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
    """Return a pose by MuJoCo's numbers: an offset, and a quaternion with the scalar first."""
    x, y, z = map(float, position)
    w, a, b, c = map(float, wxyz)
    return poses.pose_from_quaternion((x, y, z), (a, b, c, w))
