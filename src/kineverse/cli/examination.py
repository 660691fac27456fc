"""One file, read and looked over."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass

import kineverse as kv
from kineverse.cli.findings import Finding, findings
from kineverse.cli.wording import contents, number
from kineverse.errors import KineverseError
from kineverse.formats.document import Recorded
from kineverse.formats.remarks import listening
from kineverse.formats.sources import Source, locate_model

GOOD, BAD, UNREADABLE = 0, 1, 2
"""What :attr:`Examination.status` may be."""


@dataclass(frozen=True)
class Examination:
    """What was found in a file.

    Attributes
    ----------
    name
        What it was asked for by.
    format
        What it is, as far as that is known.
    model
        What is in it; None if it cannot be read, and then ``error`` says why.
    remarks
        What its reader left out, or took another way.
    problems
        What is wrong with the model.
    strict
        Whether remarks are problems, too.
    """

    name: str
    format: str = ""
    model: kv.Model | None = None
    error: KineverseError | OSError | None = None
    remarks: Sequence[str] = ()
    problems: Sequence[Finding] = ()
    strict: bool = False

    @property
    def status(self) -> int:
        """The exit status for this file."""
        if self.model is None:
            return UNREADABLE
        return BAD if self.problems or (self.strict and self.remarks) else GOOD

    @property
    def contents(self) -> str:
        """What is in the model, counted."""
        if self.model is None:
            return ""
        return f"{contents(self.model)}, {number(len(self.model.bodies), 'body')}"

    @property
    def reason(self) -> str:
        """Why it cannot be read, on one line."""
        if isinstance(self.error, OSError) and self.error.strerror:
            return self.error.strerror
        return " ".join(str(self.error).split())


def examine(name: str, meshes: bool = True, strict: bool = False) -> Examination:
    """Return what is found in a file; nothing is raised for what is wrong with it."""
    kind = ""
    with listening() as remarks:
        try:
            kind = format_of(locate_model(name))
            model = kv.load(name)
            problems = tuple(findings(model, meshes))
            remarks += _frozen(model)
        except (KineverseError, OSError) as error:
            return Examination(name, kind, error=error, remarks=remarks, strict=strict)
    return Examination(name, kind, model, None, remarks, problems, strict)


def _frozen(model: kv.Model) -> list[str]:
    """Return which operations of a document cannot follow when what they read is changed, and why."""
    operations = {tag: model.history.operation(tag) for tag in model.history.tags}
    return [
        f"operation {tag!r} is frozen: {operation.frozen}"
        for tag, operation in operations.items()
        if isinstance(operation, Recorded) and operation.frozen
    ]


def format_of(source: Source) -> str:
    """Return in which language a model is written, with what a document says about itself."""
    if source.scene:
        return "scene of the gallery"
    name = source.path.name
    if name.endswith(".kv.json"):
        return _document(source)
    if name.endswith((".sdf", ".world")):
        return "SDF"
    if name.endswith(".xml"):
        with source.path.open("rb") as file:
            return "MJCF" if b"<mujoco" in file.read(1 << 16) else "URDF"
    return "URDF" if name.endswith(".urdf") else ""


def _document(source: Source) -> str:
    """Return the version of a document, and its hash if it has one; its reader says what is wrong with it."""
    try:
        head = json.loads(source.path.read_bytes())
        facts = [f"{key} {str(head[key])[:20]}" for key in ("version", "hash") if key in head]
    except (ValueError, TypeError, RecursionError):
        return "document"
    return ", ".join(["document", *facts])
