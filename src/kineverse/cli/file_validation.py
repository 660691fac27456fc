"""Validation of a model file: reader warnings, format, problems, contacts."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import kineverse as kv
from kineverse.cli.format_values import format_contents, format_count
from kineverse.cli.summary import find_penetrations
from kineverse.errors import KineverseError
from kineverse.formats.document import OpaqueOperation
from kineverse.formats.files import read_file
from kineverse.formats.locate import Source, locate_model
from kineverse.formats.reader_warnings import Fault, collect_warnings
from kineverse.formats.validate import ModelProblem, find_problems
from kineverse.formats.xml_reader import read_root_tag
from kineverse.model.registry import LoopTreatment

FORMATS = {".kv.json": "document", ".urdf": "URDF", ".sdf": "SDF", ".world": "SDF", ".mjcf": "MJCF"}

VALID, INVALID, UNREADABLE = 0, 1, 2
"""Values of :attr:`ValidationResult.status`."""


@dataclass(frozen=True)
class ValidationResult:
    """Findings in one file.

    Attributes
    ----------
    name
        What it was asked for by.
    format
        What it is, as far as that is known.
    model
        What is in it; None if it cannot be read, and then ``error`` says why.
    facts
        What a document says about itself: its ``version``, and ``sha256``, the hash of its content.
    remarks
        What its reader left out, or took another way.
    faults
        What a strict reader refuses.
    problems
        What is wrong with the model.
    strict
        Whether remarks are problems, too.
    """

    name: str
    format: str = ""
    model: kv.Model | None = None
    error: KineverseError | OSError | None = None
    facts: Mapping[str, int | str] = field(default_factory=dict)
    remarks: Sequence[str] = ()
    faults: Sequence[str] = ()
    problems: Sequence[ModelProblem] = ()
    strict: bool = False

    @property
    def status(self) -> int:
        """The exit status for this file."""
        if self.model is None or self.faults:
            return UNREADABLE
        return INVALID if self.problems or (self.strict and self.remarks) else VALID

    @property
    def kind(self) -> str:
        """The format, with the facts; of a hash only so much as people compare."""
        return ", ".join([self.format, *(f"{name} {str(fact)[:12]}" for name, fact in self.facts.items())])

    @property
    def contents(self) -> str:
        """Counts of frames, coordinates and constraints."""
        if self.model is None:
            return ""
        return f"{format_contents(self.model)}, {format_count(len(self.model.bodies), 'body')}"

    @property
    def reason(self) -> str:
        """Reason on one line if the file cannot be read."""
        if isinstance(self.error, OSError) and self.error.strerror:
            return self.error.strerror
        return " ".join(str(self.error).split())


def validate_file(
    name: str,
    meshes: bool = True,
    strict: bool = False,
    touch: bool = False,
    root: str | None = None,
    loops: LoopTreatment = "solve",
) -> ValidationResult:
    """Validate a file; its faults are listed in the result and not raised.

    Parameters
    ----------
    name
        The name of a model or the path of a file.
    meshes
        Whether to look for the files of meshes.
    strict
        Whether remarks are problems, too.
    touch
        Whether to look for bodies that penetrate each other at the default state.
    root
        The folder below which the file may open others; by default its package or repository.
    loops
        What becomes of closed loops, see :func:`kineverse.load`.
    """
    language = ""
    with collect_warnings() as remarks:
        try:
            source = locate_model(name)
            language = detect_format(source)
            model = kv.load(name, root=root, loops=loops)
            facts = _document_header(source)
            problems = (*find_problems(model, meshes), *(find_penetrations(model) if touch else ()))
        except (KineverseError, OSError) as error:
            return ValidationResult(name, language, error=error, remarks=remarks, strict=strict)
    faults = [remark for remark in remarks if isinstance(remark, Fault)]
    noted = [remark for remark in remarks if not isinstance(remark, Fault)]
    return ValidationResult(
        name, language, model, None, facts, [*noted, *_frozen_operations(model)], faults, problems, strict
    )


def _frozen_operations(model: kv.Model) -> list[str]:
    """List the operations of a document that cannot follow changes of the values they read, with reasons."""
    operations = {tag: model.history.operation(tag) for tag in model.history.tags}
    return [
        f"operation {tag!r} is frozen: {operation.frozen}"
        for tag, operation in operations.items()
        if isinstance(operation, OpaqueOperation) and operation.frozen
    ]


def detect_format(source: Source) -> str:
    """Return in which language a model is written; empty if its name does not say."""
    if source.scene:
        return "scene of the gallery"
    if source.path.name.endswith(".xml"):
        return "MJCF" if read_root_tag(read_file(source.path)).startswith("mujoco") else "URDF"
    endings = (name for name in FORMATS if source.path.name.endswith(name))
    return FORMATS.get(next(endings, ""), "")


def _document_header(source: Source) -> dict[str, int | str]:
    """Return the version of a document, and its hash if it has one; its reader has checked both."""
    if source.scene or not source.path.name.endswith(".kv.json"):
        return {}
    head = json.loads(read_file(source.path))
    return {key: head[key] for key in ("version", "sha256") if key in head}
