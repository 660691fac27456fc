"""Files of SDF include elements."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import unquote

from kineverse.errors import FormatError
from kineverse.formats.files import read_file
from kineverse.formats.resource_paths import counts_as_package, model_paths
from kineverse.formats.root_folder import declared_roots, is_below, outside_root_error
from kineverse.formats.xml_reader import Element, parse_xml, quote
from kineverse.formats.xml_values import read_text

from .pose_graph import SdfVersion

_LATEST = (1, 12)
_FILES = (".sdf", ".world", ".urdf")


def find_included(uri: str, folder: str, root: str) -> Path:
    """Return the file that an include means: a file, or that which the manifest of a folder names.

    ``model://name/...`` and plain paths are looked for below the folder of the document, then below those of
    ``GZ_SIM_RESOURCE_PATH``, ``IGN_GAZEBO_RESOURCE_PATH``, ``GAZEBO_MODEL_PATH`` and ``SDF_PATH``, then below
    the folders above the document. A path has to lie within the root, or below a folder that one of these
    variables or ``KINEVERSE_ROOT`` names; a model may also be in a folder above the document that holds
    models.

    Parameters
    ----------
    uri
        What the document says.
    folder
        Where the document lies.
    root
        The folder that paths do not leave, as :func:`kineverse.formats.root_folder.find_root` returns it.

    Raises
    ------
    FormatError
        If there is none (the message says where it was looked for), if it is to be fetched from a network, or
        if the path leaves the places where models are.
    """
    scheme, colon, rest = uri.partition("://")
    if not colon:
        scheme, rest = "", uri
    if scheme not in ("", "model", "package", "file"):
        raise FormatError(
            f"{quote(uri)} is not fetched from a network. Download the model, and name it "
            "by model:// or a path."
        )
    here = Path(folder).absolute()
    given = [path for _, path in model_paths()]
    rest = unquote(rest)
    if "\0" in rest or not rest.strip("/. \\"):
        raise FormatError(f"{quote(uri)} names no model.")
    parts = re.split(r"[/\\]", rest)
    named = scheme in ("model", "package")
    if named and ".." in parts:
        raise FormatError(f"{quote(uri)} leads out of the folder of models with '..', which is refused.")
    # A folder on the path may itself be the model.
    itself = [(str(place), place.parent / rest) for place in given if place.name == parts[0]]
    candidates = [(root, here / rest)]
    if ".." not in parts:
        candidates += [*((str(place), place / rest) for place in given), *itself]
    if not os.path.isabs(rest) and scheme != "file":
        for above in here.parents:
            model = above / parts[0]
            bound = str(model) if named and counts_as_package(model, here, root) else root
            candidates.append((bound, above / rest))
    left = False
    for bound, candidate in candidates:
        real = os.path.realpath(candidate)
        # A place may be a link to somewhere else; what is below it may not.
        if not any(is_below(real, os.path.realpath(place)) for place in (bound, *declared_roots()) if place):
            left = left or bound == root
            continue
        if _is_model(candidate):
            return _model_file(candidate) if candidate.is_dir() else candidate
    if left and not named and (os.path.isabs(rest) or _is_model(here / rest)):
        raise outside_root_error(uri, root)
    variables = ", ".join(dict.fromkeys(variable for variable, _ in model_paths())) or "none is set"
    raise FormatError(
        f"{quote(uri)} is not there. Looked below {here}, the folders of GZ_SIM_RESOURCE_PATH, "
        f"GAZEBO_MODEL_PATH and SDF_PATH ({variables}), and the folders above. Set "
        "one of these to the folder that holds it."
    )


def _is_model(path: Path) -> bool:
    if os.path.isdir(path):  # which is no for a name that is too long, and no error
        return (path / "model.config").is_file() or (path / "model.sdf").is_file()
    return path.suffix in _FILES and os.path.isfile(path)


def _model_file(folder: Path) -> Path:
    """Return the newest description that the manifest of a model names and that can be read."""
    manifest = folder / "model.config"
    if not manifest.is_file():
        return folder / "model.sdf"
    root = parse_xml(read_file(manifest), manifest.name, texts=True)
    found = [(version, name) for version, name in _listed(root) if version <= _LATEST]
    if not found:
        raise FormatError(f"{quote(str(manifest))} names no <sdf> of a version up to 1.12.")
    _, name = max(found)
    path = folder / name
    if not path.resolve().is_relative_to(folder.resolve()):
        raise FormatError(f"{quote(str(manifest))} names {quote(name)}, which is outside of its folder.")
    if not os.path.isfile(path):
        raise FormatError(f"{quote(str(manifest))} names {quote(name)}, and there is no such file.")
    return path


def _listed(root: Element) -> Iterator[tuple[SdfVersion, str]]:
    for element in root[2]:
        if element[0] == "sdf" and read_text(element):
            match = re.fullmatch(r"1\.(\d{1,3})", element[1].get("version", "1.0").strip())
            yield (1, int(match[1])) if match else (1, 0), read_text(element)
