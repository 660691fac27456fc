"""URDF materials: colours and textures, and the names that share them.

A colour inside of a visual applies to that visual. A material that is only named is looked up among those of
the robot, then among those that other visuals define.
"""

from __future__ import annotations

from typing import TypeAlias

from kineverse.formats.reader_warnings import ReaderWarnings
from kineverse.formats.xml_reader import Element, ElementError, find_child, quote
from kineverse.formats.xml_values import parse_numbers
from kineverse.model.body import Rgba

Appearance: TypeAlias = tuple[Rgba | None, str]
"""Colour or None, and the file of the texture or an empty string."""

_NO_APPEARANCE: Appearance = (None, "")


class UrdfMaterials:
    """Materials of one document, as far as it has been read."""

    def __init__(self, remarks: ReaderWarnings):
        self._remarks = remarks
        self._shared: dict[str, Appearance] = {}
        self._local: dict[str, Appearance] = {}

    def define(self, material: Element) -> None:
        """Define a material of the robot."""
        appearance = self._read(material, material)
        if appearance == _NO_APPEARANCE:
            return
        earlier = self._shared.setdefault(material[1].get("name", ""), appearance)
        if earlier != appearance:
            mistake = ElementError(
                material,
                f"is {_format_appearance(appearance)} here and {_format_appearance(earlier)} before; "
                "give the two different names.",
            )
            self._remarks.mend(mistake, "the first is taken")

    def appearance(self, material: Element, link: Element) -> Appearance | None:
        """Return the appearance of a visual's ``<material>``; None if it is not defined yet."""
        name = material[1].get("name", "")
        if material[2]:
            own = self._read(material, link)
            if own != _NO_APPEARANCE:
                self._local.setdefault(name, own)
                return own
        return self._shared.get(name) if name else _NO_APPEARANCE

    def final_appearance(self, material: Element, link: Element) -> Appearance:
        """Return the appearance of a material that is only named, after the end of the document."""
        name = material[1].get("name", "")
        found = self._shared.get(name) or self._local.get(name)
        if found is None:
            self._remarks.add(material, "is defined nowhere; the shape has no colour.", link)
        return found or _NO_APPEARANCE

    def _read(self, material: Element, owner: Element) -> Appearance:
        """Return the colour and texture of a material; three numbers are read as an opaque colour."""
        color, texture = find_child(material, "color"), find_child(material, "texture")
        file = "" if texture is None else texture[1].get("filename", "")
        text = None if color is None else color[1].get("rgba")
        if color is None or text is None:
            return (None, file)
        try:
            if len(text.split()) == 3:
                red, green, blue = parse_numbers(text, 3)
                self._remarks.add(color, "has three numbers instead of four; it is taken as opaque.", owner)
                return ((red, green, blue, 1.0), file)
            red, green, blue, alpha = parse_numbers(text, 4)
        except ValueError as error:
            mistake = ElementError(color, f"rgba={quote(text)} {error}.")
        else:
            return ((red, green, blue, alpha), file)
        try:
            red, green, blue, alpha = parse_numbers(" ".join(text.split()[:4]), 4)
        except ValueError:
            self._remarks.mend(mistake, "it is no colour", owner)
            return (None, file)
        self._remarks.mend(mistake, "the first four are taken", owner)
        return ((red, green, blue, alpha), file)


def _format_appearance(appearance: Appearance) -> str:
    """Return an appearance as text for messages."""
    color, texture = appearance
    words = [] if color is None else ["rgba " + " ".join(f"{part:g}" for part in color)]
    return " with ".join([*words, f"texture {quote(texture)}"] if texture else words)
