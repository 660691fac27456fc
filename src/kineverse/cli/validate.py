"""``kineverse validate``: strict validation of model files."""

from __future__ import annotations

import argparse
import json
from typing import Any

from kineverse.formats import ValidationResult, validate_file
from kineverse.geometry.shapes import import_coal

from .arguments import add_model_options
from .info import find_penetrations
from .output import colorize, format_contents, format_count, format_table, show_progress, truncate_lines

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
    options = {"meshes": not arguments.no_meshes, "strict": arguments.strict, "root": arguments.root}
    further = find_penetrations if arguments.contacts else None
    results = [validate_file(file, loops=arguments.loops, further=further, **options) for file in files]
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
    assert found.model is not None
    lines = [
        f"{found.name}: {_describe_format(found)}",
        f"  {format_contents(found.model)}, {format_count(len(found.model.bodies), 'body')}",
        f"  {_format_verdict(found)}",
    ]
    for kind, texts in _group_by_kind(found).items():
        lines += [f"  {kind}", *truncate_lines([f"    {text}" for text in texts], most, "    ")]
    return lines


def _describe_format(found: ValidationResult) -> str:
    """Return format and header; of a hash the first 12 digits."""
    return ", ".join([found.format, *(f"{name} {str(fact)[:12]}" for name, fact in found.facts.items())])


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
