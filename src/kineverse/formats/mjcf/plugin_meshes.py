"""Triangles of meshes that plugins of MuJoCo make, such as those of ``mujoco.sdf.torus``.

The settings in a file control the code of a plugin, which may crash: a torus of radius 0 does. So the meshes
are made in a process of its own.
"""

from __future__ import annotations

from typing import Any, TypeAlias

from kineverse.formats.isolation import IsolatedCallError, call_isolated
from kineverse.formats.xml_writer import Tag, format_xml

from . import mujoco_api
from .preprocess import MeshReference

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
            name="m",
            uservert=model.mesh_vert.ravel().tolist(),
            userface=model.mesh_face.ravel().tolist(),
        )
        spec.worldbody.add_geom(type=engine.mjtGeom.mjGEOM_MESH, meshname="m")
        principal = spec.compile()
        made.append((principal.mesh_vert.ravel().tolist(), principal.mesh_face.ravel().tolist()))
    return made
