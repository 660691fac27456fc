"""MJCF files and text as checked descriptions.

``docs/mjcf.md`` lists the supported elements.
"""

from __future__ import annotations

import os
from pathlib import Path

from kineverse.errors import FormatError
from kineverse.formats.files import read_file
from kineverse.formats.reader_warnings import Fault, warn
from kineverse.formats.root_folder import find_text_root

from .bodies import MjcfBodies, MjcfShapes
from .compiled_document import compile_document
from .constraints import MjcfConstraints
from .description import MjcfScene
from .elements import MjcfElement
from .preprocess import MjcfPreprocessor


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
    source
        Name of the document in error messages.
    folder
        Folder relative to which included files and meshes are found.
    root
        Folder that contains all of them; None for that of :func:`kineverse.formats.root_folder.find_root`.
    strict
        If True, mistakes that other parsers accept are errors. Otherwise they are warnings.

    Raises
    ------
    FormatError
        If the text is no valid MJCF; the message names source, line, element and reason.
    MissingDependencyError
        If MuJoCo is not installed.
    """
    mjcf_warnings = _MjcfWarnings(source, strict)
    add, repair = mjcf_warnings.add, mjcf_warnings.repair
    root_folder = find_text_root(folder, root)
    preprocessor = MjcfPreprocessor(folder, root_folder, add, None if strict else mjcf_warnings.xml_fault)
    compiled = compile_document(preprocessor.run(text, source), source, folder, root_folder, add)
    shapes = MjcfShapes(compiled, folder, root_folder, add)
    bodies = MjcfBodies(compiled, shapes, source, add, repair)
    constraints = MjcfConstraints(compiled, bodies, add, repair)
    return MjcfScene(
        bodies.links,
        bodies.sites,
        constraints.couplings,
        constraints.closures,
        constraints.tendons,
        constraints.tendon_couplings,
        source,
        tuple(mjcf_warnings.texts),
        compiled.home is not None,
    )


class _MjcfWarnings:
    """Warnings about a document, each once."""

    def __init__(self, source: str, strict: bool) -> None:
        self._source, self._strict = source, strict
        self.texts: dict[str, None] = {}

    def add(self, node: MjcfElement | None, text: str) -> None:
        if node is not None:
            text = f"{node.place if node.source == self._source else node.where} {text}"
        if text not in self.texts:
            self.texts[text] = None
            warn([f"{self._source}, {text}"])

    def repair(self, where: str, problem: str, replacement: str) -> None:
        if self._strict:
            raise FormatError(f"{where}: {problem}.")
        self._fault(f"{where.removeprefix(f'{self._source}, ')}: {problem}; {replacement}.")

    def xml_fault(self, source: str, line: int, text: str) -> None:
        self._fault(f"{'' if source == self._source else f'{source}, '}line {line}, {text}")

    def _fault(self, text: str) -> None:
        self.texts[Fault(text)] = None
        warn([Fault(f"{self._source}, {text}")])
