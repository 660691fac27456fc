"""Size of a mesh file with everything written out that it draws several times.

COLLADA, 3MF and glTF name parts of a drawing more than once. A COLLADA of 2 KB whose nodes instance each
other twice, thirty deep, draws a billion parts, so the size is computed before such a file is read.
"""

from __future__ import annotations

import importlib
import io
import json
import struct
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

_NODE_BYTES = 2048  # size of a node beyond its triangles [bytes]: trimesh takes about as long for it

_COMPONENT_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}


@dataclass(slots=True)
class _Part:
    """Part of a drawing: its own size [bytes], the keys of what it draws, and whether the file holds it."""

    size: float = _NODE_BYTES
    draws: list[object] = field(default_factory=list)
    is_written: bool = True


def expanded_size(path: Path) -> float:
    """Return the size that a mesh file gains if everything it draws is written out [bytes]."""
    kind = path.suffix.lower()
    if kind == ".dae":
        return _collada_size(path.read_bytes())
    if kind == ".zae":
        return max(map(_collada_size, _packed(path, ".dae")), default=0.0)
    if kind == ".3mf":
        models = map(ElementTree.fromstring, _packed(path, ".model"))
        return _total({key: part for model in models for key, part in _threemf_parts(model)})
    if kind in (".gltf", ".glb"):
        return _total(dict(_gltf_parts(_gltf_header(path))))
    return 0.0


def _total(parts: Mapping[object, _Part]) -> float:
    """Return the size of the parts that the part None draws, less that of the parts that are written."""
    sizes: dict[object, float] = {}
    stack: list[object] = [None]
    inside: set[object] = set()
    while stack:
        key = stack[-1]
        part = parts.get(key)
        waiting = [k for k in part.draws if k in parts and k not in sizes] if part is not None else []
        if waiting and key not in inside:
            inside.add(key)
            if not inside.isdisjoint(waiting):
                raise ValueError("a part of it draws itself")
            stack += waiting
            continue
        stack.pop()
        inside.discard(key)
        if part is not None and key not in sizes:
            if waiting:
                raise ValueError("a part of it draws itself")
            sizes[key] = part.size + sum(sizes[k] for k in part.draws if k in parts)
    return sizes.get(None, 0.0) - sum(part.size for part in parts.values() if part.is_written)


def _packed(path: Path, ending: str) -> list[bytes]:
    if not zipfile.is_zipfile(path):
        return []
    with zipfile.ZipFile(path) as packed:
        return [packed.read(name) for name in packed.namelist() if name.lower().endswith(ending)]


def _tag(element: ElementTree.Element) -> str:
    tag = element.tag
    return tag.rpartition("}")[2] if isinstance(tag, str) else ""  # that of a comment is no text for lxml


def _collada_size(content: bytes) -> float:
    """Return :func:`expanded_size` of a COLLADA, parsed as pycollada does it, in any encoding."""
    try:
        parse = importlib.import_module("collada.xmlutil").createElementTree
    except (ImportError, AttributeError):  # older versions use this one
        parse = ElementTree.parse
    return _total(dict(_collada_parts(parse(io.BytesIO(content)).getroot())))


def _collada_parts(root: ElementTree.Element) -> Iterator[tuple[object, _Part]]:
    """Yield the nodes and geometries of a COLLADA, and as None all of its scenes."""
    whole = _Part(0.0)
    elements = list(root.iter())  # kept, since lxml makes new ones otherwise, with other ids
    for element in elements:
        tag = _tag(element)
        if tag in ("geometry", "controller"):
            text = float(sum(len(e.text or "") for e in element.iter()))
            drawn = [f"#{source.lstrip('#')}" for e in element for source in [e.get("source")] if source]
            yield f"#{element.get('id')}", _Part(text, list(drawn))
        elif tag in ("node", "visual_scene"):
            part = _Part()
            for child in element:
                if _tag(child) == "node":
                    part.draws.append(id(child))
                elif _tag(child).startswith("instance_"):
                    part.draws.append(child.get("url"))
            yield id(element), part
            if tag == "visual_scene":
                whole.draws.append(id(element))
            elif element.get("id"):
                yield f"#{element.get('id')}", _Part(0.0, [id(element)])
    yield None, whole


def _threemf_parts(root: ElementTree.Element) -> Iterator[tuple[object, _Part]]:
    """Yield the objects of a 3MF, and as None what is to be built."""
    whole = _Part(0.0)
    for element in root.iter():
        if _tag(element) == "object":
            inner = list(element.iter())
            triangles = sum(_tag(e) in ("triangle", "vertex") for e in inner) * 32.0
            drawn = [e.get("objectid") for e in inner if _tag(e) == "component"]
            yield element.get("id"), _Part(_NODE_BYTES + triangles, list(drawn))
        elif _tag(element) == "item":
            whole.draws.append(element.get("objectid"))
    yield None, whole


def _gltf_header(path: Path) -> Mapping[str, Any]:
    """Return the JSON of a glTF, which is the first chunk of a GLB."""
    content = path.read_bytes()
    if content[:4] == b"glTF":
        (length,) = struct.unpack_from("<I", content, 12)
        content = content[20 : 20 + length]
    header = json.loads(content)
    return header if isinstance(header, dict) else {}


def _gltf_parts(header: Mapping[str, Any]) -> Iterator[tuple[object, _Part]]:
    """Yield the meshes and accessors of a glTF, and as None what its nodes draw."""
    whole = _Part(0.0)
    for k, accessor in enumerate(header.get("accessors", ())):
        each = _COMPONENT_BYTES.get(accessor.get("componentType"), 4)
        each *= _COMPONENTS.get(accessor.get("type"), 16)
        is_written = "bufferView" in accessor  # an accessor without one is all zeros
        yield ("accessor", k), _Part(float(accessor.get("count", 0)) * each, is_written=is_written)
        whole.draws += [("accessor", k)] * (not is_written)
    for k, mesh in enumerate(header.get("meshes", ())):
        used = _Part()
        for primitive in mesh.get("primitives", ()):
            numbers = [*primitive.get("attributes", {}).values(), primitive.get("indices")]
            used.draws += [("accessor", number) for number in numbers]
        yield ("mesh", k), used
    # A node has one parent in trimesh, so it is drawn once.
    whole.draws += [("mesh", node["mesh"]) for node in header.get("nodes", ()) if "mesh" in node]
    whole.size = float(_NODE_BYTES * len(header.get("nodes", ())))
    yield None, whole
