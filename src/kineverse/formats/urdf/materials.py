"""URDF materials: colours and textures, and the names that share them.

A visual's own colour counts for that visual. A material that is only named is looked up among those of the
robot, then among those that some visual defines.
"""

from __future__ import annotations

from typing import TypeAlias

from kineverse.formats.reader_warnings import ReaderWarnings
from kineverse.formats.xml_reader import Element, ElementError, find_child, quote
from kineverse.formats.xml_values import parse_numbers
from kineverse.model.body import Rgba

Appearance: TypeAlias = tuple[Rgba | None, str]
"""Colour, if there is one, and the file of the texture, or an empty string."""

_NONE: Appearance = (None, "")


class UrdfMaterials:
    """The materials of one document, as far as it has been read."""

    def __init__(self, remarks: ReaderWarnings):
        self._remarks = remarks
        self._shared: dict[str, Appearance] = {}
        self._local: dict[str, Appearance] = {}

    def share(self, material: Element) -> None:
        """Take up a material of the robot itself.

        Raises
        ------
        ElementError
            If there is another one of that name which differs. Saying the same twice is harmless.
        """
        appearance = self._read(material, material)
        if appearance == _NONE:
            return
        earlier = self._shared.setdefault(material[1].get("name", ""), appearance)
        if earlier != appearance:
            mistake = ElementError(
                material,
                f"is {_show(appearance)} here and {_show(earlier)} before; give the two different names.",
            )
            self._remarks.mend(mistake, "the first is taken")

    def appearance(self, material: Element, link: Element) -> Appearance | None:
        """Return what the ``<material>`` of a visual looks like, None if that may be said further on."""
        name = material[1].get("name", "")
        if material[2]:
            own = self._read(material, link)
            if own != _NONE:
                self._local.setdefault(name, own)
                return own
        return self._shared.get(name) if name else _NONE

    def appearance_at_last(self, material: Element, link: Element) -> Appearance:
        """Return what a material that is only named looks like, now that all of the document is read."""
        name = material[1].get("name", "")
        found = self._shared.get(name) or self._local.get(name)
        if found is None:
            self._remarks.add(material, "is defined nowhere; the shape has no colour.", link)
        return found or _NONE

    def _read(self, material: Element, owner: Element) -> Appearance:
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


def _show(appearance: Appearance) -> str:
    color, texture = appearance
    words = [] if color is None else ["rgba " + " ".join(f"{part:g}" for part in color)]
    return " with ".join([*words, f"texture {quote(texture)}"] if texture else words)
