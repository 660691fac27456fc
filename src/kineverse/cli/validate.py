"""``kineverse validate``: strict validation of model files."""

from __future__ import annotations

import argparse
import json
from typing import Any

from kineverse.formats import ValidationResult, validate_file
from kineverse.geometry.shapes import import_coal

from .arguments import add_model_options
from .info import find_penetrations
from .output import (
    colorize,
    count_contents,
    format_contents,
    format_count,
    format_table,
    show_progress,
    truncate_lines,
)

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
        answer = {"status": status, "files": [validation_to_json(result) for result in results]}
        print(json.dumps(answer, allow_nan=False))
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
    header = [f"{name} {str(fact)[:12]}" for name, fact in found.facts.items()]  # 12 digits of a hash
    lines = [
        f"{found.name}: {', '.join([found.format, *header])}",
        f"  {format_contents(found.model)}, {format_count(len(found.model.bodies), 'body')}",
        f"  {_format_verdict(found)}",
    ]
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
    text = format_count(len(found.problems), "problem") if found.problems else "no problems"
    if found.faults:
        text = f"not read strictly: {format_count(len(found.faults), 'mistake')}, {text}"
    remarks = f", {format_count(len(found.remarks), 'remark')}" if found.remarks else ""
    return f"{colorize(text, '!' if found.status else '+')}{remarks}"


def _format_results(results: list[ValidationResult]) -> str:
    rows = []
    for one in results:
        cells = [""] * 4 + ["cannot be read"]
        if one.model is not None:
            counts = [*count_contents(one.model).values(), len(one.remarks)]
            cells = [str(count) for count in (*counts, len(one.problems) + len(one.faults))]
        rows.append([one.name, one.format, *cells])
    head = ("file", "format", "frames", "DoF", "constraints", "remarks", "problems")
    return format_table(head, rows, "<<>>>>>")


def validation_to_json(found: ValidationResult) -> dict[str, Any]:
    """Return the result of one file as JSON data."""
    counts = None
    if found.model is not None:
        counts = count_contents(found.model) | {"bodies": len(found.model.bodies)}
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
