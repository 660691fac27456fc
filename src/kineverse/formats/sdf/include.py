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
    """Find the file of an include: the file itself, or the one that the manifest of a model folder names.

    ``model://name/...`` and paths are searched below the folder of the document, then below the folders of
    ``GZ_SIM_RESOURCE_PATH``, ``IGN_GAZEBO_RESOURCE_PATH``, ``GAZEBO_MODEL_PATH`` and ``SDF_PATH``, then below
    the parent folders of the document. The file has to be within the root, or below a folder that one of
    these variables or ``KINEVERSE_ROOT`` names. A model may also be in a parent folder of the document that
    holds models.
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
    declared = [path for _, path in model_paths()]
    rest = unquote(rest)
    if "\0" in rest or not rest.strip("/. \\"):
        raise FormatError(f"{quote(uri)} names no model.")
    parts = re.split(r"[/\\]", rest)
    named = scheme in ("model", "package")
    if named and ".." in parts:
        raise FormatError(f"{quote(uri)} leads out of the folder of models with '..', which is refused.")
    # A declared folder may itself be the model.
    own = [(str(place), place.parent / rest) for place in declared if place.name == parts[0]]
    candidates = [(root, here / rest)]
    if ".." not in parts:
        candidates += [*((str(place), place / rest) for place in declared), *own]
    if not os.path.isabs(rest) and scheme != "file":
        for above in here.parents:
            model = above / parts[0]
            bound = str(model) if named and counts_as_package(model, here, root) else root
            candidates.append((bound, above / rest))
    outside = False
    for bound, candidate in candidates:
        real = os.path.realpath(candidate)
        # An allowed folder may be a symbolic link; files below it may not lead out of it.
        if not any(is_below(real, os.path.realpath(place)) for place in (bound, *declared_roots()) if place):
            outside = outside or bound == root
            continue
        if _is_model(candidate):
            return _model_file(candidate) if candidate.is_dir() else candidate
    if outside and not named and (os.path.isabs(rest) or _is_model(here / rest)):
        raise outside_root_error(uri, root)
    variables = ", ".join(dict.fromkeys(variable for variable, _ in model_paths())) or "none is set"
    raise FormatError(
        f"{quote(uri)} is not there. Looked below {here}, the folders of GZ_SIM_RESOURCE_PATH, "
        f"GAZEBO_MODEL_PATH and SDF_PATH ({variables}), and the folders above. Set "
        "one of these to the folder that holds it."
    )


def _is_model(path: Path) -> bool:
    """Return True for the folder of a model and for a description file."""
    if os.path.isdir(path):  # False rather than an error for a name that is too long
        return (path / "model.config").is_file() or (path / "model.sdf").is_file()
    return path.suffix in _FILES and os.path.isfile(path)


def _model_file(folder: Path) -> Path:
    """Return the description of the newest supported version that the manifest of a model names."""
    manifest = folder / "model.config"
    if not manifest.is_file():
        return folder / "model.sdf"
    root = parse_xml(read_file(manifest), manifest.name, texts=True)
    found = [(version, name) for version, name in _listed_files(root) if version <= _LATEST]
    if not found:
        raise FormatError(f"{quote(str(manifest))} names no <sdf> of a version up to 1.12.")
    _, name = max(found)
    path = folder / name
    if not path.resolve().is_relative_to(folder.resolve()):
        raise FormatError(f"{quote(str(manifest))} names {quote(name)}, which is outside of its folder.")
    if not os.path.isfile(path):
        raise FormatError(f"{quote(str(manifest))} names {quote(name)}, and there is no such file.")
    return path


def _listed_files(root: Element) -> Iterator[tuple[SdfVersion, str]]:
    """Yield version and file name of all descriptions that a manifest lists."""
    for element in root[2]:
        if element[0] == "sdf" and read_text(element):
            match = re.fullmatch(r"1\.(\d{1,3})", element[1].get("version", "1.0").strip())
            yield (1, int(match[1])) if match else (1, 0), read_text(element)
