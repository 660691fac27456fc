"""Document of a model inside a USD stage, and the digest of the stage that it belongs to."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from .pxr_api import pxr, set_text, text_of

DOCUMENT_PRIM = "kineverse"
"""Name of the prim below the default prim that holds the document."""

_DOCUMENT, _DIGEST = "kineverse:document", "kineverse:sha256"
_METRICS = ("metersPerUnit", "kilogramsPerUnit", "upAxis", "defaultPrim")
_SCHEMAS = ("PhysicsRigidBodyAPI", "PhysicsCollisionAPI", "PhysicsArticulationRootAPI")


@dataclass(frozen=True)
class EmbeddedDocument:
    """Text of a document in a stage; ``is_current`` is False if the stage has changed since."""

    text: str
    is_current: bool


def embed_document(stage: Any, text: str) -> None:
    """Add a document to a complete stage, with the digest of all that it describes."""
    prim = stage.DefinePrim(stage.GetDefaultPrim().GetPath().AppendChild(DOCUMENT_PRIM), "Scope")
    set_text(prim, _DOCUMENT, text)
    set_text(prim, _DIGEST, stage_digest(stage))


def find_embedded_document(stage: Any) -> EmbeddedDocument | None:
    """Return the document of a stage; None if it has none."""
    for prim in stage.Traverse():
        text = text_of(prim, _DOCUMENT)
        if text is not None:
            return EmbeddedDocument(text, text_of(prim, _DIGEST) == stage_digest(stage))
    return None


def stage_digest(stage: Any) -> str:
    """Return SHA-256 of all that a stage says of a model, 64 hexadecimal digits.

    That is its units, every property of the default prim and of the prims below it except the document, and
    bodies, joints and colliders elsewhere. It is the same in files of text and binary ones. Lights and
    cameras elsewhere do not count.
    """
    digest = hashlib.sha256()

    def add(text: str) -> None:
        digest.update(f"{text}\n".encode(errors="surrogatepass"))

    for name in _METRICS:
        add(f"{name}={stage.GetMetadata(name)}")
    for prim in _relevant_prims(stage):
        add(f"{prim.GetPath()} {prim.GetTypeName()} {sorted(prim.GetAppliedSchemas())}")
        for part in sorted(prim.GetAuthoredProperties(), key=lambda part: str(part.GetName())):
            if isinstance(part, pxr().Usd.Relationship):
                add(f"{part.GetName()} -> {list(map(str, part.GetTargets()))}")
            elif part.HasAuthoredValue():
                add(f"{part.GetName()} {part.GetTypeName()} {part.GetTimeSamples()}")
                digest.update(_bytes_of(part.Get()))
    return digest.hexdigest()


def _relevant_prims(stage: Any) -> Iterator[Any]:
    default = stage.GetDefaultPrim()
    root = default.GetPath() if default else None
    document = None if root is None else root.AppendChild(DOCUMENT_PRIM)
    joint = pxr().UsdPhysics.Joint
    for prim in stage.Traverse(pxr().Usd.TraverseInstanceProxies()):
        path = prim.GetPath()
        if path == document:
            continue
        is_inside = root is not None and path.HasPrefix(root)
        if is_inside or prim.IsA(joint) or not set(_SCHEMAS).isdisjoint(prim.GetAppliedSchemas()):
            yield prim


def _bytes_of(value: Any) -> bytes:
    """Return a value of an attribute as bytes; arrays by their numbers, which have no text of full length."""
    try:
        array = np.asarray(value)
    except (TypeError, ValueError):
        return repr(value).encode(errors="surrogatepass")
    if array.dtype.kind in "biuf":
        return f"{array.shape}".encode() + np.ascontiguousarray(array, dtype=np.float64).tobytes()
    return repr(value).encode(errors="surrogatepass")
