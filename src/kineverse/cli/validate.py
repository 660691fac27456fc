"""``kineverse validate``: strict validation of model files."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import kineverse as kv
from kineverse.errors import KineverseError
from kineverse.formats.document import OpaqueOperation
from kineverse.formats.files import read_file
from kineverse.formats.locate import Source, locate_model
from kineverse.formats.reader_warnings import Fault, collect_warnings
from kineverse.formats.validate import ModelProblem, find_problems
from kineverse.formats.xml_reader import read_root_tag
from kineverse.geometry.shapes import import_coal
from kineverse.model.registry import LoopTreatment

from .arguments import add_model_options
from .diff import format_contents, format_count
from .info import find_penetrations
from .output import colorize, format_table, join_lines, show_progress, truncate_lines

HELP = """\
All mistakes that kv.load tolerates with a remark are listed, and a file with mistakes counts as unreadable. A
file that can be read is checked for limits that are violated at the default state, poses that are not finite
there, loops that do not close there or within the limits, bodies with an impossible inertia, and missing mesh
files. With --contacts, bodies that penetrate each other at the default state are problems as well, unless a
joint connects them; many valid models have some. Remarks name content that the reader left out, or
interpreted in one of several ways.

The exit status is 0 without problems, 1 with problems, and 2 if a file cannot be read, or has mistakes; of
several files, the worst.

examples:
  kineverse validate robot.urdf
  kineverse validate robots/*.urdf worlds/*.sdf
  kineverse validate robot.urdf --no-meshes --strict
  kineverse validate robot.urdf --contacts
  kineverse validate home.kv.json --json"""

SHOWN, SHOWN_OF_SEVERAL = 10, 3
"""Number of reader warnings, and of problems of a kind, printed for a file without --all."""

TITLES = {
    "limit": "limits",
    "loop": "loops",
    "pose": "poses",
    "inertia": "inertia",
    "mesh": "meshes",
    "contact": "contacts",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("files", metavar="FILE", nargs="+", help="path of a file, or name of a shipped model")
    parser.add_argument("--no-meshes", action="store_true", help="do not check that mesh files exist")
    parser.add_argument(
        "--contacts", action="store_true", help="bodies that penetrate each other are problems (needs coal)"
    )
    add_model_options(parser, "remarks count as problems")
    parser.add_argument(
        "--all", action="store_true", help=f"print all remarks and problems, not {SHOWN} of a kind"
    )
    parser.add_argument("--json", action="store_true", help="everything, as one JSON object")


def run(arguments: argparse.Namespace) -> int:
    """Validate the files, print the results, and return the worst status."""
    files = show_progress(arguments.files, "validating", "file")
    if arguments.contacts:
        import_coal()
    meshes, strict, contacts = not arguments.no_meshes, arguments.strict, arguments.contacts
    results = [
        validate_file(file, meshes, strict, contacts, arguments.root, arguments.loops) for file in files
    ]
    status = max(result.status for result in results)
    most = None if arguments.all else SHOWN if len(results) == 1 else SHOWN_OF_SEVERAL
    if arguments.json:
        print(
            json.dumps(
                {"status": status, "files": [validation_to_json(result) for result in results]},
                allow_nan=False,
            )
        )
    elif len(results) > 1:
        details = [format_validation(result, most) for result in results if result.status]
        print("\n\n".join([_format_results(results), *("\n".join(lines) for lines in details)]))
    elif results[0].error is not None:
        raise results[0].error
    else:
        print("\n".join(format_validation(results[0], most)))
    return status


def format_validation(found: ValidationResult, most: int | None) -> list[str]:
    """Return the lines of one file, with at most ``most`` remarks, and problems of a kind."""
    if found.error is not None:
        return [found.name, f"  {colorize('cannot be read', '!')}: {found.reason}"]
    lines = [f"{found.name}: {found.kind}", f"  {found.contents}", f"  {_format_verdict(found)}"]
    for kind, texts in _group_by_kind(found).items():
        lines += [f"  {kind}", *truncate_lines([f"    {text}" for text in texts], most, "    ")]
    return lines


def _group_by_kind(found: ValidationResult) -> dict[str, list[str]]:
    """Return the problems under their kinds, and the remarks at the end."""
    kinds: dict[str, list[str]] = {"mistakes": list(found.faults)} if found.faults else {}
    for problem in found.problems:
        kinds.setdefault(TITLES[problem.kind], []).append(f"{problem.where}: {problem.text}")
    return {**kinds, "remarks": list(found.remarks)} if found.remarks else kinds


def _format_verdict(found: ValidationResult) -> str:
    problems, remarks = len(found.problems), len(found.remarks)
    text = f"{problems or 'no'} problem{'' if problems == 1 else 's'}"
    if found.faults:
        text = f"not read strictly: {format_count(len(found.faults), 'mistake')}, {text}"
    remark_text = f", {remarks} remark{'' if remarks == 1 else 's'}" if remarks else ""
    return f"{colorize(text, '!' if found.status else '+')}{remark_text}"


def _format_results(results: list[ValidationResult]) -> str:
    rows = [
        (e.name, e.format, "", "", "", "", "cannot be read")
        if e.model is None
        else (
            e.name,
            e.format,
            str(len(e.model.frames)),
            str(len(e.model.degrees_of_freedom)),
            str(len(e.model.constraints)),
            str(len(e.remarks)),
            str(len(e.problems) + len(e.faults)),
        )
        for e in results
    ]
    return format_table(
        ("file", "format", "frames", "DoF", "constraints", "remarks", "problems"), rows, "<<>>>>>"
    )


def validation_to_json(found: ValidationResult) -> dict[str, Any]:
    """Return the result of one file as JSON data."""
    model = found.model
    counts = None
    if model is not None:
        counts = {
            "frames": len(model.frames),
            "dof": len(model.degrees_of_freedom),
            "constraints": len(model.constraints),
            "bodies": len(model.bodies),
        }
    return {
        "file": found.name,
        "format": found.format or None,
        **found.facts,
        "status": found.status,
        "error": found.reason if found.error is not None else found.faults[0] if found.faults else None,
        **({"mistakes": list(found.faults)} if found.faults else {}),
        "counts": counts,
        "problems": [{"kind": p.kind, "where": p.where, "text": p.text} for p in found.problems],
        "remarks": list(found.remarks),
    }


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
