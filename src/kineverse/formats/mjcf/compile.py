"""MJCF documents compiled by MuJoCo.

Of the two things that MuJoCo makes of a file, its ``MjSpec`` still has everything as it was written:
defaults, frames, six ways to say an orientation, degrees. Its ``MjModel`` has everything resolved, in one
convention, and is what its kinematics run on. So the description is taken from the ``MjModel``, and the
``MjSpec`` is asked for the rest: lines, actuators, keys, whether a body states its inertia.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from kineverse.errors import FormatError
from kineverse.formats.xml_values import LARGEST

from . import mujoco_api
from .actuators import joint_efforts
from .elements import MjcfElement
from .meshes import MeshAsset, MeshReplacement
from .preprocess import PreprocessedMjcf

ElementNote = Callable[[MjcfElement | None, str], None]

_NUMBERS = ("body_pos", "body_quat", "jnt_pos", "jnt_axis", "qpos0", "site_pos", "site_quat", "eq_data")
_SHAPELESS = {"mjGEOM_HFIELD": "a height field is no shape here", "mjGEOM_SDF": "its shape is a plugin's"}


@dataclass(frozen=True, slots=True)
class CompiledMjcf:
    """What MuJoCo made of a document.

    Attributes
    ----------
    spec, model
        Its ``MjSpec`` and ``MjModel``; things in both have the same numbers.
    prepared
        What it was given.
    assets
        The meshes of files, by name.
    left_out
        The numbers of geoms whose shape is not known, with the reason.
    guessed
        The numbers of bodies whose inertia is not known.
    efforts
        How strong joints are, by name [N] or [N m].
    home
        Positions of all joints in the key ``home``.
    """

    spec: Any
    model: Any
    prepared: PreprocessedMjcf
    assets: dict[str, MeshAsset]
    left_out: dict[int, str]
    guessed: frozenset[int]
    efforts: dict[str, float]
    home: npt.NDArray[np.float64] | None

    def nodes(self, things: Any) -> dict[int, MjcfElement | None]:
        """Return the elements of things of the specification, by their numbers."""
        return {thing.id: self.prepared.node(thing.info) for thing in things}


class _MeshError(FormatError):
    """What MuJoCo says where it may be the fault of a mesh file."""


def compile_document(
    prepared: PreprocessedMjcf, source: str, folder: str, root: str, note: ElementNote
) -> CompiledMjcf:
    """Have MuJoCo parse and compile a document.

    Parameters
    ----------
    prepared
        The document.
    source
        Its name in messages.
    folder
        From where mesh files are found, where they decide something.
    root
        The folder that they do not leave.
    note
        Called with what is left out.

    Raises
    ------
    FormatError
        With what MuJoCo says about which element; for numbers that are none.
    """
    with mujoco_api.capture_mujoco_warnings() as heard:
        try:
            compiled = _try_compile(prepared, source, folder, root, note)
        except _MeshError as error:
            note(None, f"inertia and sizes that follow from meshes are left out: {error}")
            compiled = _try_compile(prepared, source, folder, root, note, with_files=False)
    for remark in dict.fromkeys(heard):
        note(None, f"MuJoCo says: {remark.strip()}")
    for name in _NUMBERS:
        if not (np.abs(getattr(compiled.model, name)) <= LARGEST).all():
            raise FormatError(f"{source}: a number of it is not finite, or too large ({name}).")
    return compiled


def _try_compile(
    prepared: PreprocessedMjcf,
    source: str,
    folder: str,
    root: str,
    note: ElementNote,
    with_files: bool = True,
) -> CompiledMjcf:
    spec = mujoco_api.parse_spec(prepared, source)
    shapeless = _replace_shapeless(spec)
    replacement = MeshReplacement(spec, prepared, folder, root, note)
    files = replacement.read_files(with_files)
    strength, home = joint_efforts(spec), _home(spec)
    # What has been read goes: muscles make compiling long, and keys of what is left out make it fail.
    for thing in (*spec.actuators, *spec.keys):
        spec.delete(thing)
    try:
        model = mujoco_api.compile_spec(spec, prepared, source)
    except FormatError as error:
        if files:
            raise _MeshError(str(error)) from None
        raise
    meshes = replacement.meshes
    shapeless += [(geom, "its size is that of a mesh that is not there") for geom in meshes.fitted]
    left_out = {geom.id: f"is left out: {reason}." for geom, reason in shapeless}
    guessed = frozenset(body.id for body in meshes.guessed)
    return CompiledMjcf(spec, model, prepared, meshes.assets, left_out, guessed, strength, home)


def _replace_shapeless(spec: Any) -> list[tuple[Any, str]]:
    """Make spheres of geoms that need files or plugins; return them, each with the reason."""
    kinds = mujoco_api.mujoco().mjtGeom
    found: list[tuple[Any, str]] = []
    for geom in spec.geoms:
        for kind, reason in _SHAPELESS.items():
            if geom.type == getattr(kinds, kind):
                geom.type, geom.size = kinds.mjGEOM_SPHERE, [1.0] * 3
                geom.hfieldname = geom.meshname = ""
                found.append((geom, reason))
    return found


def _home(spec: Any) -> npt.NDArray[np.float64] | None:
    """Return the joint positions of the key ``home``."""
    for key in spec.keys:
        if key.name == "home" and len(key.qpos):
            return np.array(key.qpos, dtype=float)
    return None
