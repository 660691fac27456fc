"""``kineverse validate``: strict validation of model files."""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from kineverse.errors import InvalidValueError
from kineverse.expressions.printing import format_number
from kineverse.formats import ValidationResult, validate_file
from kineverse.formats.validate import INVALID, VALID
from kineverse.geometry.motion_checks.check import check_motion
from kineverse.geometry.motion_checks.report import MotionFinding, MotionReport
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

--motion moves each joint through its range, with the others at rest, and looks at what it moves. What is
certainly wrong is a finding: degrees for radians, millimetres for metres, an axis far from the part and from
all else, a joint that moves nothing, a part that floats, an impossible inertia, a centre of mass outside of
the part, a mesh that is inside out, crossed limits. Suspects are worth a look and change no exit status: a
part that enters its carrier or comes apart, a flipped or turned axis, a wrong scale or density. Links of
robots are only suspects where their shapes say little. What lacks shapes is listed as what cannot be said.
--pictures draws each of them where it is worst, the part in orange. With --json, "coordinates" lists them by
stable kinds, for programs that generate models.

The exit status is 0 without problems, 1 with problems, and 2 if a file cannot be read, or has mistakes; of
several files, the worst.

examples:
  kineverse validate robot.urdf
  kineverse validate robots/*.urdf worlds/*.sdf
  kineverse validate robot.urdf --no-meshes --strict
  kineverse validate robot.urdf --contacts
  kineverse validate home.kv.json --json
  kineverse validate cupboard.urdf --motion
  kineverse validate cupboard.urdf --motion --pictures pictures
  kineverse validate generated/*.urdf --motion --json"""

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
    parser.add_argument("--motion", action="store_true", help="move each joint over its range (needs coal)")
    pictures = "with --motion: folder for a PNG of each finding and suspect"
    parser.add_argument("--pictures", metavar="FOLDER", type=Path, help=pictures)
    add_model_options(parser, "remarks count as problems")
    parser.add_argument(
        "--all", action="store_true", help=f"print all remarks and problems, not {SHOWN} of a kind"
    )
    parser.add_argument("--json", action="store_true", help="everything, as one JSON object")


def run(arguments: argparse.Namespace) -> int:
    """Validate the files, print the results, and return the worst status."""
    files = show_progress(arguments.files, "validating", "file")
    if arguments.contacts or arguments.motion:
        import_coal()
    if arguments.pictures is not None:
        if not arguments.motion:
            raise InvalidValueError("--pictures shows what --motion finds. Add --motion.")
        arguments.pictures.mkdir(parents=True, exist_ok=True)
    options = {"meshes": not arguments.no_meshes, "strict": arguments.strict, "root": arguments.root}
    further = find_penetrations if arguments.contacts else None
    results = [validate_file(file, loops=arguments.loops, further=further, **options) for file in files]
    motions = check_results(results, arguments.pictures) if arguments.motion else []
    if motions:
        results = [_without_inertia(result) for result in results]
    statuses = [result.status for result in results]
    for k, motion in enumerate(motions):
        statuses[k] = max(statuses[k], VALID if motion is None or motion.report.ok else INVALID)
    status = max(statuses)
    most = None if arguments.all else SHOWN if len(results) == 1 else SHOWN_OF_SEVERAL
    if arguments.json:
        answer = {
            "status": status,
            "files": [
                validation_to_json(result) | {"status": one}
                for result, one in zip(results, statuses, strict=True)
            ],
        }
        print(json.dumps(answer | motions_to_json(results, motions), allow_nan=False))
    elif len(results) > 1:
        details = [format_validation(result, most) for result in results if result.status]
        print("\n\n".join([_format_results(results), *("\n".join(lines) for lines in details)]))
        for result, motion in zip(results, motions, strict=True) if motions else ():
            if motion is not None and motion.has_entries:
                print("\n".join(["", f"{result.name}:", *format_motion(motion, most)]))
    elif results[0].error is not None:
        raise results[0].error
    else:
        print("\n".join(format_validation(results[0], most)))
        for motion in motions:
            if motion is not None:
                print("\n".join(format_motion(motion, most)))
    return status


@dataclass(frozen=True)
class CheckedMotion:
    """Report of a file's motions, and the pictures of it: name of the coordinate, kind, and file."""

    report: MotionReport
    pictures: tuple[tuple[str, str, Path], ...] = ()

    @property
    def has_entries(self) -> bool:
        """True if there is a finding or a suspect."""
        return bool(self.report.findings or self.report.suspects)


def check_results(results: list[ValidationResult], folder: Path | None) -> list[CheckedMotion | None]:
    """Check the motions of files, and draw what is found; None for a file that cannot be read."""
    checked: list[CheckedMotion | None] = []
    taken: set[str] = set()
    for result in results:
        if result.model is None:
            checked.append(None)
            continue
        report = check_motion(result.model, result.faults)
        pictures: tuple[tuple[str, str, Path], ...] = ()
        if folder is not None:
            from kineverse.view.finding_pictures import save_finding_pictures  # for start-up time

            before = f"{Path(result.name).stem}." if len(results) > 1 else ""
            pictures = tuple(save_finding_pictures(result.model, report, folder, before, taken))
        checked.append(CheckedMotion(report, pictures))
    return checked


def _without_inertia(result: ValidationResult) -> ValidationResult:
    """Return a result without the inertias, which the report of motions has with their coordinates."""
    return replace(result, problems=[p for p in result.problems if p.kind != "inertia"])


def format_motion(motion: CheckedMotion, most: int | None) -> list[str]:
    """Return the report of motions as lines, at most so many of a severity."""
    report = motion.report
    counts = {"finding": len(report.findings), "suspect": len(report.suspects)}
    said = ", ".join(format_count(count, noun) for noun, count in counts.items() if count) or "nothing wrong"
    style = "!" if report.findings else "~" if report.suspects else "+"
    lines = [f"  motion of {format_count(len(report.coordinates), 'coordinate')}: {colorize(said, style)}"]
    for title, severity in (("findings", "finding"), ("suspects", "suspect"), ("cannot say", "cannot_say")):
        texts = [
            _format_entry(one.name, entry)
            for one in report.all
            for entry in one.entries
            if entry.severity == severity
        ]
        if texts:
            lines += [f"  {title}", *truncate_lines(texts, most, "    ")]
    if motion.pictures:
        folder = motion.pictures[0][2].parent
        lines.append(f"  {format_count(len(motion.pictures), 'picture')} in {folder}")
    return lines


def _format_entry(name: str, entry: MotionFinding) -> str:
    """Return the reason on one line, and below it the numbers and what to do."""
    where = f" ({entry.joint})" if entry.joint and entry.joint != name else ""
    first = f"    {name}{where}: {entry.text}" if name else f"    {entry.text}"
    state = ", ".join(f"{key} = {format_number(value)}" for key, value in entry.state.items())
    if entry.severity == "cannot_say" or not (entry.advice or state):
        return first
    numbers = [f"at {state}"] if state else []
    if entry.value is not None and entry.limit is not None:
        unit = "" if entry.unit == "1" else f" {entry.unit}"
        value, limit = (f"{format_number(number, 3)}{unit}" for number in (entry.value, entry.limit))
        numbers.append(f"{value}, where {limit} is accepted")
    return f"{first}\n      {'. '.join(filter(None, [': '.join(numbers), entry.advice]))}"


def motions_to_json(results: list[ValidationResult], motions: list[CheckedMotion | None]) -> dict[str, Any]:
    """Return the reports of motions as JSON data: all coordinates with their files, and bodies at rest."""
    if not motions:
        return {}
    coordinates: list[dict[str, Any]] = []
    at_rest: list[dict[str, Any]] = []
    for result, motion in zip(results, motions, strict=True):
        if motion is None:
            continue
        for one in motion.report.all:
            files = [(kind, str(path)) for name, kind, path in motion.pictures if name == one.name]
            pictures = [{"kind": kind, "file": file} for kind, file in files]
            data = one.to_json() | {"file": result.name, "pictures": pictures}
            (coordinates if one.name else at_rest).append(data)
    return {"coordinates": coordinates, "at_rest": at_rest}


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
