"""``kineverse validate``: whether files are what they should be."""

from __future__ import annotations

import argparse
import json
from typing import TYPE_CHECKING, Any

from kineverse.cli.paint import bounded, paint
from kineverse.cli.progress import progress
from kineverse.cli.reading import add_reading_options
from kineverse.cli.table import table
from kineverse.cli.wording import number

if TYPE_CHECKING:
    from kineverse.cli.examination import Examination

HELP = """read files strictly, and say what is wrong with them

Mistakes that kv.load reads past with a remark are listed, all of them, and the file counts as one that cannot
be read. A file that can be read is looked at for limits that are broken at the default state, poses that are
not finite and loops that do not close there or within the limits, bodies with an impossible inertia, and
meshes whose files are missing. With --contacts bodies that are in each other at the default state are
problems as well, unless they are joined; many a good model has some. Remarks are what the reader left out, or
took in a way that may not have been meant.

The exit status is 0 if nothing is wrong, 1 if something is, and 2 if a file cannot be read, or not strictly;
of several files, the worst.

examples:
  kineverse validate robot.urdf
  kineverse validate robots/*.urdf worlds/*.sdf
  kineverse validate robot.urdf --no-meshes --strict
  kineverse validate robot.urdf --contacts
  kineverse validate home.kv.json --json"""

SHOWN, SHOWN_OF_SEVERAL = 10, 3
"""How many remarks, and problems of a kind, are printed of a file unless all are asked for."""

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
    parser.add_argument("--no-meshes", action="store_true", help="do not look for the files of meshes")
    parser.add_argument(
        "--contacts", action="store_true", help="bodies that penetrate each other are problems (needs coal)"
    )
    add_reading_options(parser, "remarks count as problems")
    parser.add_argument(
        "--all", action="store_true", help=f"print all remarks and problems, not {SHOWN} of a kind"
    )
    parser.add_argument("--json", action="store_true", help="everything, as one JSON object")


def run(arguments: argparse.Namespace) -> int:
    """Examine, print, and return the worst status."""
    from kineverse.cli.examination import examine
    from kineverse.geometry.solids import coal_engine

    files = progress(arguments.files, "validating", "file")
    if arguments.contacts:
        coal_engine()
    meshes, strict, touch = not arguments.no_meshes, arguments.strict, arguments.contacts
    found = [examine(file, meshes, strict, touch, arguments.root, arguments.loops) for file in files]
    status = max(examination.status for examination in found)
    most = None if arguments.all else SHOWN if len(found) == 1 else SHOWN_OF_SEVERAL
    if arguments.json:
        print(json.dumps({"status": status, "files": [as_json(e) for e in found]}, allow_nan=False))
    elif len(found) > 1:
        told = [report(e, most) for e in found if e.status]
        print("\n\n".join([_table(found), *("\n".join(lines) for lines in told)]))
    elif found[0].error is not None:
        raise found[0].error
    else:
        print("\n".join(report(found[0], most)))
    return status


def report(found: Examination, most: int | None) -> list[str]:
    """Return what was found in one file, with at most so many remarks, and problems of a kind."""
    if found.error is not None:
        return [found.name, f"  {paint('cannot be read', '!')}: {found.reason}"]
    lines = [f"{found.name}: {found.kind}", f"  {found.contents}", f"  {_verdict(found)}"]
    for kind, texts in _by_kind(found).items():
        lines += [f"  {kind}", *bounded([f"    {text}" for text in texts], most, "    ")]
    return lines


def _by_kind(found: Examination) -> dict[str, list[str]]:
    """Return the problems under their kinds, and the remarks at the end."""
    kinds: dict[str, list[str]] = {"mistakes": list(found.faults)} if found.faults else {}
    for problem in found.problems:
        kinds.setdefault(TITLES[problem.kind], []).append(f"{problem.where}: {problem.text}")
    return {**kinds, "remarks": list(found.remarks)} if found.remarks else kinds


def _verdict(found: Examination) -> str:
    problems, remarks = len(found.problems), len(found.remarks)
    text = f"{problems or 'no'} problem{'' if problems == 1 else 's'}"
    if found.faults:
        text = f"not read strictly: {number(len(found.faults), 'mistake')}, {text}"
    noted = f", {remarks} remark{'' if remarks == 1 else 's'}" if remarks else ""
    return f"{paint(text, '!' if found.status else '+')}{noted}"


def _table(found: list[Examination]) -> str:
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
        for e in found
    ]
    return table(("file", "format", "frames", "DoF", "constraints", "remarks", "problems"), rows, "<<>>>>>")


def as_json(found: Examination) -> dict[str, Any]:
    """Return everything about one file as JSON has it."""
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
