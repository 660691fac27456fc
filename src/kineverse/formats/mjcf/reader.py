"""MJCF files and text to a checked description, by MuJoCo's parser and compiler.

Of the two things that MuJoCo makes of a file, its ``MjSpec`` still has everything as it was written:
defaults, frames, six ways to say an orientation, degrees. Its ``MjModel`` has everything resolved, in one
convention, and is what its kinematics run on. So the description is taken from the ``MjModel``, and the
``MjSpec`` is asked for what that has no place for: lines, actuators, whether a body states its inertia.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from kineverse.errors import FormatError
from kineverse.formats.files import read_file
from kineverse.formats.remarks import tell

from . import engine
from .actuators import efforts
from .bodies import Bodies
from .constraints import Constraints
from .description import Scene
from .meshes import Meshes, Replacement
from .preparing import Preparation, Prepared
from .shapes import Shapes
from .tree import Node

_NUMBERS = ("body_pos", "body_quat", "jnt_pos", "jnt_axis", "qpos0", "site_pos", "site_quat", "eq_data")
_SHAPELESS = {"mjGEOM_HFIELD": "a height field is no shape here", "mjGEOM_SDF": "its shape is a plugin's"}


def read_mjcf(path: str | os.PathLike[str]) -> Scene:
    """Read an MJCF file, with what it includes and attaches from its folder.

    Raises
    ------
    FormatError
        If the file cannot be read or is not a valid MJCF; the message names file, line, element and reason.
    MissingExtraError
        If MuJoCo is not installed.
    """
    path = Path(path)
    return parse_mjcf(read_file(path), source=path.name, folder=str(path.absolute().parent))


def parse_mjcf(text: str | bytes, source: str = "<mjcf>", folder: str = "") -> Scene:
    """Read an MJCF from text.

    Parameters
    ----------
    text
        The document.
    source
        Its name in error messages.
    folder
        The folder below which the files it includes are, and from which the meshes it names are found.

    Raises
    ------
    FormatError
        If it is not a valid MJCF; the message names source, line, element and reason.
    MissingExtraError
        If MuJoCo is not installed.
    """
    return _Reading(source, folder).run(text)


class _Reading:
    """One document on its way."""

    def __init__(self, source: str, folder: str) -> None:
        self._source, self._folder = source, folder
        self._remarks: dict[str, None] = {}

    def run(self, text: str | bytes) -> Scene:
        prepared = Preparation(self._folder, self._note).run(text, self._source)
        with engine.listening() as warnings:
            spec = engine.parse(prepared, self._source)
            strength = efforts(spec)
            home = _home(spec)
            self._strip(spec)
            unknown = self._take_shapeless(spec)
            meshes, model = self._compile(spec, prepared)
        for warning in dict.fromkeys(warnings):
            self._remark(f"MuJoCo says: {warning.strip()}")
        for name in _NUMBERS:
            if not np.isfinite(getattr(model, name)).all():
                raise FormatError(f"{self._source}: a number of it is not finite, or too large ({name}).")
        for geom in meshes.fitted:
            unknown.append((geom, "its size is that of a mesh that is not there"))
        left_out = {geom.id: f"is left out: {reason}." for geom, reason in unknown}
        geoms = {geom.id: geom for geom in spec.geoms}

        def note_geom(number: int, text: str) -> None:
            self._note(prepared.node(geoms[number].info), text)

        shapes = Shapes(model, meshes.assets, left_out, self._folder, note_geom)
        guessed = frozenset(body.id for body in meshes.guessed)
        bodies = Bodies(spec, model, prepared, shapes, guessed, strength, home, self._source, self._note)
        found = Constraints(spec, model, prepared, bodies, self._note)
        return Scene(
            bodies.links,
            bodies.sites,
            found.couplings,
            found.closures,
            found.tendons,
            found.tendon_couplings,
            self._source,
            tuple(self._remarks),
        )

    def _strip(self, spec: Any) -> None:
        """Take out what has been read: muscles and keys can make compiling long, or fail."""
        for thing in (*spec.actuators, *spec.keys):
            spec.delete(thing)

    def _take_shapeless(self, spec: Any) -> list[tuple[Any, str]]:
        """Make spheres of geoms that need files or plugins; return them, each with the reason."""
        kinds = engine.mujoco().mjtGeom
        found: list[tuple[Any, str]] = []
        for geom in spec.geoms:
            for kind, reason in _SHAPELESS.items():
                if geom.type == getattr(kinds, kind):
                    geom.type, geom.size, geom.hfieldname, geom.meshname = (
                        kinds.mjGEOM_SPHERE,
                        [1.0] * 3,
                        "",
                        "",
                    )
                    found.append((geom, reason))
        return found

    def _compile(self, spec: Any, prepared: Prepared) -> tuple[Meshes, Any]:
        replacement = Replacement(spec, prepared, self._folder, self._note)
        if replacement.read_files():
            try:
                return replacement.meshes, engine.compiled(spec, prepared, self._source)
            except FormatError as error:
                # It may be the meshes' fault. If not, the boxes give the same error again.
                replacement.read_files(wanted=False)
                model = engine.compiled(spec, prepared, self._source)
                self._remark(f"inertia that follows from meshes is left out: {error}")
                return replacement.meshes, model
        return replacement.meshes, engine.compiled(spec, prepared, self._source)

    def _note(self, node: Node | None, text: str) -> None:
        if node is None:
            self._remark(text)
            return
        self._remark(f"{node.place if node.source == self._source else node.where} {text}")

    def _remark(self, text: str) -> None:
        if text not in self._remarks:
            self._remarks[text] = None
            tell([f"{self._source}, {text}"])


def _home(spec: Any) -> np.ndarray[tuple[int], np.dtype[np.float64]] | None:
    """Return the joint positions of the key ``home``."""
    for key in spec.keys:
        if key.name == "home" and len(key.qpos):
            return np.array(key.qpos, dtype=float)
    return None
