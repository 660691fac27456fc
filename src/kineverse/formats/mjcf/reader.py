"""MJCF files and text as checked descriptions.

``docs/mjcf.md`` lists what becomes what.
"""

from __future__ import annotations

import os
from pathlib import Path

from kineverse.errors import FormatError
from kineverse.formats.files import read_file
from kineverse.formats.reader_warnings import Fault, warn
from kineverse.formats.root_folder import find_text_root

from .bodies import MjcfBodies
from .compile import compile_document
from .constraints import MjcfConstraints
from .description import MjcfScene
from .elements import MjcfElement
from .preprocess import MjcfPreprocessor
from .shapes import MjcfShapes


def read_mjcf(
    path: str | os.PathLike[str], root: str | os.PathLike[str] | None = None, strict: bool = False
) -> MjcfScene:
    """Read an MJCF file, with what it includes and attaches; see :func:`parse_mjcf`.

    Raises
    ------
    FormatError
        If the file cannot be read or is not a valid MJCF; the message names file, line, element and reason.
    MissingDependencyError
        If MuJoCo is not installed.
    """
    path = Path(path)
    return parse_mjcf(read_file(path), path.name, str(path.absolute().parent), root, strict)


def parse_mjcf(
    text: str | bytes,
    source: str = "<mjcf>",
    folder: str = "",
    root: str | os.PathLike[str] | None = None,
    strict: bool = False,
) -> MjcfScene:
    """Read an MJCF from text.

    Parameters
    ----------
    text
        The document.
    source
        Its name in error messages.
    folder
        The folder from which the files it includes and the meshes it names are found.
    root
        The folder that they do not leave; None for that which :func:`kineverse.formats.root_folder.find_root` finds.
    strict
        Whether mistakes that others read past are refused, rather than remarked on.

    Raises
    ------
    FormatError
        If it is not a valid MJCF; the message names source, line, element and reason.
    MissingDependencyError
        If MuJoCo is not installed.
    """
    notes = _Notes(source, strict)
    below = find_text_root(folder, root)
    prepared = MjcfPreprocessor(folder, below, notes.add, None if strict else notes.misspelt).run(
        text, source
    )
    compiled = compile_document(prepared, source, folder, below, notes.add)
    bodies = MjcfBodies(
        compiled, MjcfShapes(compiled, folder, below, notes.add), source, notes.add, notes.mend
    )
    found = MjcfConstraints(compiled, bodies, notes.add, notes.mend)
    return MjcfScene(
        bodies.links,
        bodies.sites,
        found.couplings,
        found.closures,
        found.tendons,
        found.tendon_couplings,
        source,
        tuple(notes.texts),
        compiled.home is not None,
    )


class _Notes:
    """What is remarked on a document, each remark once."""

    def __init__(self, source: str, strict: bool) -> None:
        self._source, self._strict = source, strict
        self.texts: dict[str, None] = {}

    def add(self, node: MjcfElement | None, text: str) -> None:
        if node is not None:
            text = f"{node.place if node.source == self._source else node.where} {text}"
        if text not in self.texts:
            self.texts[text] = None
            warn([f"{self._source}, {text}"])

    def mend(self, where: str, problem: str, taken: str) -> None:
        """Note a mistake at a place, and what is taken instead.

        Raises
        ------
        FormatError
            The mistake, where the file is read strictly.
        """
        if self._strict:
            raise FormatError(f"{where}: {problem}.")
        self._fault(f"{where.removeprefix(f'{self._source}, ')}: {problem}; {taken}.")

    def misspelt(self, source: str, line: int, text: str) -> None:
        """Note what is no XML, but can be read."""
        self._fault(f"{'' if source == self._source else f'{source}, '}line {line}, {text}")

    def _fault(self, text: str) -> None:
        self.texts[Fault(text)] = None
        warn([Fault(f"{self._source}, {text}")])
