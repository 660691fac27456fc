"""MJCF documents compiled by MuJoCo.

MuJoCo's ``MjSpec`` of a file keeps its notation: defaults, frames, six notations of an orientation, degrees.
Its ``MjModel`` has all of it resolved to one convention, with which MuJoCo computes kinematics. So the
description is taken from the ``MjModel``, and only lines, actuators, keys and explicit inertia from the
``MjSpec``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from kineverse.errors import FormatError
from kineverse.formats.xml_values import LARGEST

from . import mujoco_api
from .elements import ElementRemark, MjcfElement
from .meshes import MeshAsset, MeshReplacement
from .mujoco_api import mujoco
from .preprocess import PreprocessedMjcf

_CHECKED_ARRAYS = (
    *("body_pos", "body_quat", "jnt_pos", "jnt_axis"),
    *("qpos0", "site_pos", "site_quat", "eq_data"),
)


@dataclass(frozen=True, slots=True)
class CompiledMjcf:
    """Document compiled by MuJoCo."""

    spec: Any  # MjSpec of the document
    model: Any  # its MjModel, with the same numbers of elements
    prepared: PreprocessedMjcf
    assets: dict[str, MeshAsset]  # meshes of files, by name
    left_out: dict[int, str]  # reasons why geoms are left out, by the number of the geom
    unknown_inertia: frozenset[int]  # numbers of the bodies whose inertia depends on missing files
    efforts: dict[str, float]  # largest force [N] or torque [N m] of joints, by name
    home: npt.NDArray[np.float64] | None  # positions of all joints in the key home; None without that key

    def nodes(self, parts: Any) -> dict[int, MjcfElement | None]:
        """Return the elements of parts of the specification, such as its joints, by number."""
        return {part.id: self.prepared.node(part.info) for part in parts}


class _MeshError(FormatError):
    """Error of MuJoCo that a mesh file may have caused."""


def compile_document(
    prepared: PreprocessedMjcf, source: str, folder: str, root: str, remark: ElementRemark
) -> CompiledMjcf:
    """Parse and compile a document with MuJoCo."""
    with mujoco_api.capture_mujoco_warnings() as captured:
        try:
            compiled = _try_compile(prepared, source, folder, root, remark)
        except _MeshError as error:
            remark(None, f"inertia and sizes that follow from meshes are left out: {error}")
            compiled = _try_compile(prepared, source, folder, root, remark, with_files=False)
    for text in dict.fromkeys(captured):
        remark(None, f"MuJoCo says: {text.strip()}")
    for name in _CHECKED_ARRAYS:
        if not (np.abs(getattr(compiled.model, name)) <= LARGEST).all():
            raise FormatError(f"{source}: a number of it is not finite, or too large ({name}).")
    return compiled


def _try_compile(
    prepared: PreprocessedMjcf,
    source: str,
    folder: str,
    root: str,
    remark: ElementRemark,
    with_files: bool = True,
) -> CompiledMjcf:
    spec = mujoco_api.parse_spec(prepared, source)
    strength, home = joint_efforts(spec), _home(spec)
    if spec.actuators or spec.keys:
        # Muscles slow down compilation, and keys fail if joints are left out. To delete them one by one takes
        # time in the square of their number.
        spec = mujoco_api.parse_spec(prepared, source, passive=True)
    height_fields = _prepare_shapes(spec)
    replacement = MeshReplacement(spec, prepared, folder, root, remark)
    files = replacement.read_files(with_files)
    try:
        model = mujoco_api.compile_spec(spec, prepared, source)
    except FormatError as error:
        if files:
            raise _MeshError(str(error)) from None
        raise
    left_out = {geom.id: "is left out: a height field is no shape here." for geom in height_fields}
    for geom in replacement.unknown_size:
        left_out[geom.id] = "is left out: its size is that of a mesh that is not there."
    unknown_inertia = frozenset(body.id for body in replacement.unknown_inertia)
    return CompiledMjcf(spec, model, prepared, replacement.assets, left_out, unknown_inertia, strength, home)


def _prepare_shapes(spec: Any) -> list[Any]:
    """Make signed distance fields the meshes that they have the mass of; return the height fields."""
    kinds = mujoco_api.mujoco().mjtGeom
    result = []
    for geom in spec.geoms:
        if geom.type == kinds.mjGEOM_SDF:
            geom.type = kinds.mjGEOM_MESH
        elif geom.type == kinds.mjGEOM_HFIELD:
            result.append(geom)
    return result


def _home(spec: Any) -> npt.NDArray[np.float64] | None:
    for key in spec.keys:
        if key.name == "home" and len(key.qpos):
            return np.array(key.qpos, dtype=float)
    return None


def joint_efforts(spec: Any) -> dict[str, float]:
    """Return the largest force [N] or torque [N m] of all actuators on each joint, by joint name.

    Joints with an actuator whose strength depends on its controller are missing.
    """
    engine = mujoco()
    direct = (engine.mjtTrn.mjTRN_JOINT, engine.mjtTrn.mjTRN_JOINTINPARENT)
    found: dict[str, float] = {}
    for actuator in spec.actuators:
        if actuator.trntype in direct:
            strength = _strength(actuator) * abs(float(actuator.gear[0]))
            found[actuator.target] = found.get(actuator.target, 0.0) + strength
    return {name: effort for name, effort in found.items() if math.isfinite(effort)}


def _strength(actuator: Any) -> float:
    """Return the largest force of an actuator; infinite if its controller decides it."""
    engine = mujoco()
    if _limited(actuator.forcelimited, actuator.forcerange):
        return _largest(actuator.forcerange)
    motor = (
        actuator.gaintype == engine.mjtGain.mjGAIN_FIXED
        and actuator.biastype == engine.mjtBias.mjBIAS_NONE
        and actuator.dyntype == engine.mjtDyn.mjDYN_NONE
    )
    if motor and _limited(actuator.ctrllimited, actuator.ctrlrange):
        return abs(float(actuator.gainprm[0])) * _largest(actuator.ctrlrange)
    return math.inf


def _limited(flag: Any, limits: Any) -> bool:
    kinds = mujoco().mjtLimited
    return bool(flag == kinds.mjLIMITED_TRUE or (flag == kinds.mjLIMITED_AUTO and limits[0] < limits[1]))


def _largest(limits: Any) -> float:
    return max(abs(float(limits[0])), abs(float(limits[1])))
