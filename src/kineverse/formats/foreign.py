"""What to do with files that hold no model, or one in a format that is not read here."""

from __future__ import annotations

from pathlib import Path

from kineverse.errors import FormatError

READ = "URDF (.urdf, .xml), SDF (.sdf, .world), MJCF (.xml, .mjcf) and documents (.kv.json, .kv.msgpack)"

_MESHES = (".stl", ".obj", ".dae", ".ply", ".glb", ".gltf", ".off", ".3mf", ".msh")
_USD = (".usd", ".usda", ".usdc", ".usdz")

_ADVICE = {
    **dict.fromkeys(
        _MESHES,
        "is a mesh, and no model. A description names it as the shape of a link; "
        "'kineverse decompose' takes the file itself.",
    ),
    **dict.fromkeys(
        _USD, "is USD, which is not read. Convert it to URDF or MJCF with the tool that it comes from."
    ),
    ".mjb": (
        "is a model that MuJoCo has compiled, which is not read. Load the MJCF it was made of, or write one: "
        "mujoco.mj_saveLastXML('model.xml', model)."
    ),
    ".srdf": "is an SRDF, which names groups of joints of a robot that a URDF describes. Load the URDF.",
    ".erb": "is a template. Expand it first: erb model.sdf.erb > model.sdf",
    ".config": "is the manifest of a model. Load the .sdf that it names.",
    ".launch": "is a launch file. Load the description that it starts.",
}


def not_read(path: Path) -> FormatError:
    """Return the error for a file of another format: what it is, and what to do."""
    if path.suffix.lower() == ".xacro":
        plain = path.name[: -len(path.suffix)]
        plain = plain if "." in plain else f"{plain}.urdf"
        return FormatError(
            f"{path}: is a template of xacro, which is not expanded here. "
            f"Run xacro first: xacro {path.name} > {plain}"
        )
    advice = _ADVICE.get(path.suffix.lower())
    if advice is not None:
        return FormatError(f"{path}: {advice}")
    return FormatError(f"{path}: this version reads {READ}, not '{''.join(path.suffixes) or path.name}'.")
