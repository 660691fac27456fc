"""MJCF mesh assets, with boxes in their place while MuJoCo compiles.

MuJoCo moves the origin of a mesh to its centre and rotates it to its principal axes. The inverse of the
transform that it applies to the box gives the frame of the file, whatever its content. A file is read only if
something depends on it: the inertia of a body that states none, or the size of a shape fitted to it.

The settings in a file control the code of a plugin that makes meshes, such as ``mujoco.sdf.torus``, and it
may crash: a torus of radius 0 does. So these meshes are made in a process of its own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from kineverse.errors import FormatError
from kineverse.formats import poses
from kineverse.formats.files import read_file
from kineverse.formats.isolation import IsolatedCallError, call_isolated
from kineverse.formats.poses import compose_poses
from kineverse.formats.xml_reader import quote
from kineverse.formats.xml_writer import Tag, format_xml
from kineverse.lie import transform
from kineverse.model.body import Mesh, Pose

from . import mujoco_api
from .elements import MjcfElement, find_below_root
from .mujoco_api import mujoco
from .preprocess import MeshReference, PreprocessedMjcf

_FORMATS = (".stl", ".obj", ".msh")
_DIAGONAL = 1e-9
_IDENTITY_PLACEMENT = [1.0] * 3, [0.0] * 3, [1.0, 0.0, 0.0, 0.0]
"""Scale, position and quaternion (w, x, y, z) of a mesh that is not moved."""


@dataclass(frozen=True, slots=True)
class MeshAsset:
    """Mesh asset of a description: v' = S Rᵀ (v - p) for the vertices v of the file."""

    uri: str
    scale: tuple[float, ...]
    position: tuple[float, ...]
    quaternion: tuple[float, ...]


class MeshReplacement:
    """Replacement of mesh files in a specification by boxes, or by their content where it matters.

    ``assets`` are the meshes by name, ``unknown_inertia`` the bodies whose inertia depends on a missing file,
    and ``unknown_size`` the geoms whose size does.
    """

    def __init__(
        self,
        spec: Any,
        prepared: PreprocessedMjcf,
        folder: str,
        root: str,
        remark: Callable[[MjcfElement, str], None],
    ) -> None:
        self._spec, self._prepared, self._remark = spec, prepared, remark
        self._folder, self._root = folder, root
        self.assets: dict[str, MeshAsset] = {}
        self.unknown_inertia: list[Any] = []
        self.unknown_size: list[Any] = []
        self._made: dict[MeshReference, Triangles | str] = {}
        self._nodes: dict[str, MjcfElement] = {}
        self._boxes: dict[str, tuple[Any, list[float], list[int]]] = {}
        for mesh in spec.meshes:
            node = prepared.node(mesh.info)
            if node is None or node not in prepared.files:
                continue
            self._nodes[mesh.name] = node
            placement = (tuple(map(float, v)) for v in (mesh.scale, mesh.refpos, mesh.refquat))
            self.assets[mesh.name] = MeshAsset(prepared.files[node].uri, *placement)
            mesh.scale, mesh.refpos, mesh.refquat = _IDENTITY_PLACEMENT
            self._boxes[mesh.name] = mesh, list(mesh.uservert), list(mesh.userface)

    def read_files(self, wanted: bool = True) -> bool:
        """Read the files on which inertia or sizes depend; return True if there are any.

        If files are not wanted or cannot be read, their boxes remain, and inertia and sizes are unknown.
        """
        self.unknown_inertia, self.unknown_size = [], []
        needed = [
            (geom, body) for body in self._spec.bodies for geom in body.geoms if self._needs_file(geom, body)
        ]
        contents: dict[str, bytes] = {}
        missing: dict[str, bool] = {}
        if wanted:
            found = [
                self._prepared.files[self._nodes[name]] for name in sorted({g.meshname for g, _ in needed})
            ]
            plugins = [reference for reference in dict.fromkeys(found) if reference.plugin]
            self._made = make_plugin_meshes(plugins) if plugins else {}
        for geom, body in needed:
            name = geom.meshname
            if name not in missing:
                content = self._content(name) if wanted else None
                missing[name] = content is None
                self._set_content(name, content, contents)
            if missing[name]:
                if geom.type != mujoco().mjtGeom.mjGEOM_MESH:
                    self.unknown_size.append(geom)
                if not any(body is other for other in self.unknown_inertia) and body.name != "world":
                    self.unknown_inertia.append(body)
        self._spec.assets = contents
        for body in self.unknown_inertia:
            self._keep_frame(body)
        return any(not is_missing for is_missing in missing.values())

    def _keep_frame(self, body: Any) -> None:
        """Keep the frame of a free body of unknown inertia, with which MuJoCo would align it."""
        engine, kinds = mujoco(), mujoco().mjtAlignFree
        for joint in body.joints:
            if joint.type != engine.mjtJoint.mjJNT_FREE or joint.align == kinds.mjALIGNFREE_FALSE:
                continue
            if joint.align == kinds.mjALIGNFREE_TRUE or self._spec.compiler.alignfree:
                node = self._prepared.node(body.info)
                if node is not None:
                    self._remark(node, "is not aligned with its inertia, which is not known.")
            joint.align = kinds.mjALIGNFREE_FALSE

    def _needs_file(self, geom: Any, body: Any) -> bool:
        if geom.meshname not in self._nodes:
            return False
        engine, compiler = mujoco(), self._spec.compiler
        if geom.type != engine.mjtGeom.mjGEOM_MESH:
            return True
        low, high = compiler.inertiagrouprange
        weightless = geom.mass == 0.0 or (np.isnan(geom.mass) and geom.density == 0.0)
        if body.name == "world" or weightless or not low <= geom.group <= high:
            return False
        rule = compiler.inertiafromgeom
        kinds = engine.mjtInertiaFromGeom
        if rule == kinds.mjINERTIAFROMGEOM_AUTO:
            return not body.explicitinertial
        return bool(rule == kinds.mjINERTIAFROMGEOM_TRUE)

    def _content(self, name: str) -> bytes | Triangles | None:
        """Return the content of a mesh file, or the triangles that a plugin makes.

        None, with a remark, if the file cannot be read or the plugin makes none.
        """
        node = self._nodes[name]
        reference = self._prepared.files[node]
        uri = reference.uri
        if reference.plugin:
            made = self._made[reference]
            if not isinstance(made, str):
                return made
            self._remark(node, f"is a mesh of {quote(reference.plugin)}, and has no inertia here: {made}.")
            return None
        if not uri:
            self._remark(node, "is not made by MuJoCo here, and has no inertia: it has too many triangles.")
            return None
        try:
            if Path(uri).suffix.lower() not in _FORMATS:
                node.refuse(f"names {quote(uri)}, which is in no format that MuJoCo reads.")
            return read_file(find_below_root(node, uri, self._root, self._folder))
        except FormatError as error:
            reason = str(error).removeprefix(f"{node.where}: ")
            self._remark(node, f"is not read, where its triangles decide an inertia or a size: {reason}")
            return None

    def _set_content(self, name: str, content: bytes | Triangles | None, contents: dict[str, bytes]) -> None:
        """Set a mesh to a file of some content, to triangles, or to its box if there is neither."""
        asset = self.assets[name]
        mesh, *box = self._boxes[name]
        if content is None:
            mesh.file, (mesh.uservert, mesh.userface) = "", box
            mesh.scale, mesh.refpos, mesh.refquat = _IDENTITY_PLACEMENT
            return
        if isinstance(content, bytes):
            mesh.file = f"{len(contents)}{Path(asset.uri).suffix.lower()}"
            contents[mesh.file] = content
            mesh.uservert, mesh.userface = [], []
        else:
            mesh.uservert, mesh.userface = content
        mesh.scale, mesh.refpos, mesh.refquat = asset.scale, asset.position, asset.quaternion


def place_mesh(asset: MeshAsset, body_T_mesh: Pose, folder: str, root: str) -> tuple[Mesh, Pose] | None:
    """Return a mesh and the pose of its file's frame in a body; None if no scale along its axes exists.

    v' = S Rᵀ (v - p) = Rᵀ (R S Rᵀ v) - S Rᵀ p, so R S Rᵀ has to be diagonal.
    """
    w, x, y, z = asset.quaternion
    turn = poses.pose_from_quaternion((0.0, 0.0, 0.0), (x, y, z, w)).matrix[:3, :3]
    scale = np.diag(asset.scale)
    along = turn @ scale @ turn.T
    if np.abs(along - np.diag(np.diag(along))).max() > _DIAGONAL * np.abs(scale).max():
        return None
    mesh_T_file = transform(turn.T, -scale @ turn.T @ asset.position)
    a, b, c = np.diag(along).tolist()
    return Mesh(asset.uri, (a, b, c), folder, root), compose_poses(
        body_T_mesh, Pose.from_matrix(mesh_T_file + 0.0)
    )


Triangles: TypeAlias = "tuple[list[float], list[int]]"
"""Coordinates of the vertices [m] and numbers of the corners of the faces, each in a row."""


def make_plugin_meshes(plugins: list[MeshReference]) -> dict[MeshReference, Triangles | str]:
    """Return the triangles of the meshes that plugins make, or the reason why there are none."""
    jobs = [[plugin.plugin, list(plugin.settings)] for plugin in plugins]
    try:
        made = call_isolated(__name__, "compile_plugin_meshes", jobs)
    except IsolatedCallError as error:
        made = [str(error)] * len(plugins)
    return {p: m if isinstance(m, str) else (m[0], m[1]) for p, m in zip(plugins, made, strict=True)}


def compile_plugin_meshes(jobs: list[tuple[str, list[tuple[str, str]]]]) -> list[Any]:
    """Return for each plugin and its settings the vertices and faces of its mesh, or MuJoCo's error."""
    engine = mujoco_api.mujoco()
    made: list[Any] = []
    for plugin, settings in jobs:
        root = Tag("mujoco")
        instance = root.add("extension").add("plugin", plugin=plugin).add("instance", name="p")
        for key, value in settings:
            instance.add("config", key=key, value=value)
        root.add("asset").add("mesh", name="m").add("plugin", instance="p")
        root.add("worldbody").add("geom", type="mesh", mesh="m")
        try:
            model = engine.MjModel.from_xml_string(format_xml(root).decode())
        except (ValueError, RuntimeError, engine.FatalError, engine.UnexpectedError) as error:
            made.append(mujoco_api.extract_reason(str(error)))
            continue
        # MuJoCo takes the principal axes of such a mesh for its own, other than those of all other meshes.
        spec = engine.MjSpec()
        spec.add_mesh(
            name="m", uservert=model.mesh_vert.ravel().tolist(), userface=model.mesh_face.ravel().tolist()
        )
        spec.worldbody.add_geom(type=engine.mjtGeom.mjGEOM_MESH, meshname="m")
        principal = spec.compile()
        made.append((principal.mesh_vert.ravel().tolist(), principal.mesh_face.ravel().tolist()))
    return made
