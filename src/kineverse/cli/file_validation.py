"""Validation of a model file: reader warnings, format, problems, contacts."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import kineverse as kv
from kineverse.errors import KineverseError
from kineverse.formats.document import OpaqueOperation
from kineverse.formats.files import read_file
from kineverse.formats.locate import Source, locate_model
from kineverse.formats.reader_warnings import Fault, collect_warnings
from kineverse.formats.validate import ModelProblem, find_problems
from kineverse.formats.xml_reader import read_root_tag
from kineverse.model.registry import LoopTreatment

from .diff_report import format_contents, format_count
from .output import join_lines
from .summary import find_penetrations

FORMATS = {".kv.json": "document", ".urdf": "URDF", ".sdf": "SDF", ".world": "SDF", ".mjcf": "MJCF"}

VALID, INVALID, UNREADABLE = 0, 1, 2
"""Values of :attr:`ValidationResult.status`."""


@dataclass(frozen=True)
class ValidationResult:
    """Findings in one file."""

    name: str  # name or path as given
    format: str = ""  # format of the file; empty if unknown
    model: kv.Model | None = None  # loaded model; None if the file cannot be read, for the reason in error
    error: KineverseError | OSError | None = None
    facts: Mapping[str, int | str] = field(default_factory=dict)  # header of a document
    remarks: Sequence[str] = ()  # reader warnings: content left out or interpreted
    faults: Sequence[str] = ()  # mistakes that a strict reader refuses
    problems: Sequence[ModelProblem] = ()
    strict: bool = False  # True if remarks count as problems

    @property
    def status(self) -> int:
        """Exit status for this file."""
        if self.model is None or self.faults:
            return UNREADABLE
        return INVALID if self.problems or (self.strict and self.remarks) else VALID

    @property
    def kind(self) -> str:
        """Format and header; of a hash the first 12 digits."""
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
        return join_lines(self.error)


def validate_file(
    name: str,
    meshes: bool = True,
    strict: bool = False,
    contacts: bool = False,
    root: str | None = None,
    loops: LoopTreatment = "solve",
) -> ValidationResult:
    """Validate a file; mistakes in it are returned, not raised."""
    language = ""
    with collect_warnings() as remarks:
        try:
            source = locate_model(name)
            language = detect_format(source)
            model = kv.load(name, root=root, loops=loops)
            facts = _document_header(source)
            problems = (*find_problems(model, meshes), *(find_penetrations(model) if contacts else ()))
        except (KineverseError, OSError) as error:
            return ValidationResult(name, language, error=error, remarks=remarks, strict=strict)
    faults = [remark for remark in remarks if isinstance(remark, Fault)]
    others = [remark for remark in remarks if not isinstance(remark, Fault)]
    return ValidationResult(
        name, language, model, None, facts, [*others, *_frozen_operations(model)], faults, problems, strict
    )


def _frozen_operations(model: kv.Model) -> list[str]:
    """Return a line for each operation that does not follow changes of what it reads, with the reason."""
    operations = {tag: model.history.operation(tag) for tag in model.history.tags}
    return [
        f"operation {tag!r} is frozen: {operation.frozen}"
        for tag, operation in operations.items()
        if isinstance(operation, OpaqueOperation) and operation.frozen
    ]


def detect_format(source: Source) -> str:
    """Return the format of a model; empty if its suffix is unknown."""
    if source.collection:
        return f"model of the collection '{source.collection}'"
    if source.path.name.endswith(".xml"):
        return "MJCF" if read_root_tag(read_file(source.path)).startswith("mujoco") else "URDF"
    endings = (name for name in FORMATS if source.path.name.endswith(name))
    return FORMATS.get(next(endings, ""), "")


def _document_header(source: Source) -> dict[str, int | str]:
    """Return the version of a document, and its hash if it has one; the reader has checked both."""
    if source.collection or not source.path.name.endswith(".kv.json"):
        return {}
    head = json.loads(read_file(source.path))
    return {key: head[key] for key in ("version", "sha256") if key in head}
