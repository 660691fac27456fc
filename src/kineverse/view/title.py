"""Title of the page."""

from __future__ import annotations

import os
from contextlib import suppress

from kineverse.errors import KineverseError
from kineverse.formats.files import read_file
from kineverse.formats.locate import locate_model
from kineverse.formats.xml_reader import Element, Visit, parse_xml
from kineverse.model.frame import WORLD
from kineverse.model.model_view import ModelView

UNNAMED = "Kineverse"

MOST = 3
"""Most names in a title of several models."""

LONGEST = 60
"""Most characters of one of them."""

SUFFIXES = (".urdf", ".xml", ".mjcf", ".sdf", ".world")
"""Suffixes of files that declare the name of a model."""

NAMED_BY = {"robot": "name", "mujoco": "model", "model": "name", "world": "name"}
"""The attributes of elements of URDF, MJCF and SDF that declare the name of a model."""


class _NamedError(Exception):
    """End of reading a file, raised once its name is known."""


def choose_title(model: ModelView) -> str:
    """Return the prefixes of all frames, such as ``kitchen, pr2``, or ``Kineverse``."""
    frames = [name for name in model.frames if name != WORLD]
    prefixes = list(dict.fromkeys(name.partition("/")[0] for name in frames))
    if not frames or not all("/" in name for name in frames):
        return UNNAMED
    return ", ".join(map(_shorten, prefixes[:MOST])) + (" …" if len(prefixes) > MOST else "")


def read_title(source: str) -> str:
    """Return the name of a model that its file declares, or the name of the file."""
    plain = os.path.basename(source.rstrip("/"))
    try:
        found = locate_model(source)
        if found.shipped or not found.path.name.endswith(SUFFIXES):
            return plain
        return _shorten(_read_declared_name(read_file(found.path), plain) or plain)
    except KineverseError:
        return plain


def _read_declared_name(content: bytes, source: str) -> str:
    """Return the name of a model that an XML document declares, empty if it declares none."""
    names: list[str] = []

    def note(element: Element) -> None:
        tag, attributes, _, _ = element
        names.extend(filter(None, [attributes.get(NAMED_BY.get(tag, ""), "").strip()]))
        if names or tag != "sdf":
            raise _NamedError

    def begin(root: Element) -> Visit:
        note(root)
        return note

    with suppress(_NamedError):
        parse_xml(content, source, begin=begin)
    return names[0] if names else ""


def _shorten(name: str) -> str:
    return name if len(name) <= LONGEST else f"{name[: LONGEST - 1]}…"
