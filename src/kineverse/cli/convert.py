"""``kineverse convert``: conversion of a model file to another format."""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from kineverse.errors import DuplicateNameError, FormatError, InvalidValueError
from kineverse.formats.conversion_check import ConversionCheck, check_conversion, find_engine
from kineverse.formats.document import to_json
from kineverse.formats.export.capabilities import UnsupportedError
from kineverse.formats.locate import locate_model
from kineverse.formats.reader_warnings import collect_warnings
from kineverse.model.registry import FrameDeviation, SaveResult, find_scheme, writable_suffixes

from .arguments import add_model_options, load_model
from .diff import format_pose_difference
from .output import count_contents, format_bytes, format_contents, format_count, show_activity, truncate_lines

if TYPE_CHECKING:
    import kineverse as kv

HELP = """\
IN is any model that can be loaded. OUT is a document (.kv.json), which holds the whole model, URDF (.urdf),
MJCF (.xml), SDF (.sdf) or USD (.usda, .usdc). A motion that the format cannot represent is refused by name,
and nothing is written; with --tolerance, such motions are approximated, and a guaranteed bound on the errors
of frames is printed. Constraints that the format cannot represent, such as locks and couplings of wheel
speeds, are left out and listed on standard error; --strict refuses these, too, and --leave-out names
exceptions. The new file is read back before it becomes OUT. It is written whole or not at all, and replaces a
file only with --force. If OUT is a dash, a document goes to standard output. From URDF to URDF, names of
materials and elements such as <transmission> and <gazebo> are kept.

USD (.usda, .usdc, .usd) holds the document of the model beside joints for other tools, so nothing is refused
unless --strict is given; needs the extra usd.

Mesh files are not copied; OUT refers to them by paths that are valid from its folder. Meshes that MuJoCo
cannot read are converted, into a folder beside OUT; missing ones are left out of MJCF.

With --check, an engine of the format reads OUT on its own: pinocchio a URDF, MuJoCo an MJCF, drake an SDF,
OpenUSD a USD. In 100 states within limits, the poses of all frames in OUT are compared with those of IN. If
one differs by more than 1e-9 m or rad (1e-6 in USD; an approximated one by more than its bound), the joint is
named and the status is 1. If the engine cannot read OUT, the status is 2. OUT is kept in both cases. To
compare IN and OUT by Kineverse alone: kineverse diff IN OUT --values

examples:
  kineverse convert robot.sdf robot.urdf
  kineverse convert pr2 pr2.sdf --check
  kineverse convert robot.urdf robot.kv.json --prefix left --force
  kineverse convert live:home home.kv.json
  kineverse convert kitchen - | gzip > kitchen.kv.json.gz
  kineverse convert pr2 pr2.xml
  kineverse convert pr2 pr2.usda
  kineverse convert garage.kv.json garage.urdf --strict --leave-out garage/lock
  kineverse convert articulations/pedal_bin bin.xml --tolerance 0.01"""

STDOUT = "-"
SHOWN = 10  # number of reader warnings printed without --all


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("source", metavar="IN", help="name of a shipped model, or path of a file")
    parser.add_argument("target", metavar="OUT", help="path of the file to write; - for standard output")
    parser.add_argument("--prefix", metavar="NAME", help="prefix of all names, followed by a slash")
    parser.add_argument("--force", action="store_true", help="replace OUT if it exists")
    add_model_options(
        parser,
        "refuse what is otherwise left out with a remark, such as constraints that OUT cannot represent",
    )
    parser.add_argument(
        "--leave-out",
        metavar="NAME",
        action="append",
        default=[],
        help="constraint or articulation that OUT may leave out; may be given several times",
    )
    parser.add_argument(
        "--tolerance",
        metavar="X",
        type=float,
        help="largest error of any frame of OUT [m], [rad]; without it nothing is approximated",
    )
    parser.add_argument(
        "--check", action="store_true", help="compare OUT with IN in an engine that reads OUT on its own"
    )
    parser.add_argument("--all", action="store_true", help=f"print more than {SHOWN} remarks")
    parser.add_argument("--json", action="store_true", help="report as one JSON object")


def run(arguments: argparse.Namespace) -> int:
    """Read the model, write it, and print a report."""
    to_stdout = arguments.target == STDOUT
    if not to_stdout:
        # Checked before the model is loaded, so that a wrong name fails at once.
        check_writable(arguments.target, arguments.source, arguments.force)
        if arguments.check:
            find_engine(arguments.target)
    else:
        given = {
            "--json": arguments.json,
            "--leave-out": arguments.leave_out,
            "--tolerance": arguments.tolerance is not None,
            "--strict": arguments.strict,
            "--check": arguments.check,
        }
        option = next((name for name, is_given in given.items() if is_given), None)
        if option is not None:
            raise InvalidValueError(
                f"{option} and - exclude each other: standard output is a document, which omits nothing."
            )

    with collect_warnings() as left_out, show_activity(f"reading {arguments.source}"):
        model = load_model(arguments, arguments.source, arguments.prefix)
    with show_activity(f"writing {arguments.target}"):
        if to_stdout:
            content = to_json(model).encode()
            sys.stdout.buffer.write(content)
            sys.stdout.flush()
            saved, size = SaveResult(Path(STDOUT)), len(content)
        else:
            saved = _save_model(model, arguments)
            size = os.path.getsize(saved.path)
    check = None
    if arguments.check:
        with show_activity(f"checking {arguments.target}"):
            check = check_conversion(model, saved.path, bounds=saved.errors)
    if saved.left_out:
        lines = [f"  {name} {reason}" for name, reason in saved.left_out.items()]
        count = format_count(len(lines), "thing")
        head = f"{arguments.target} leaves out {count} that it cannot express; --strict refuses instead:"
        shown = truncate_lines(lines, None if arguments.all else SHOWN, "  ")
        print("\n".join([head, *shown]), file=sys.stderr)
    if arguments.json:
        report = _as_json(arguments, model, size, left_out, saved)
        if check is not None:
            report["check"] = _check_as_json(check)
        print(json.dumps(report, allow_nan=False))
    else:
        lines = _format_report(arguments, model, size, left_out, saved)
        if check is not None:
            lines[2:2] = _format_check(check)
        print("\n".join(lines), file=sys.stderr if to_stdout else sys.stdout)
    if check is None or check.ok:
        return 0
    print(_format_wrong(arguments.target, check), file=sys.stderr)
    return 1


def _save_model(model: kv.Model, arguments: argparse.Namespace) -> SaveResult:
    try:
        return model.save(
            arguments.target,
            tolerance=arguments.tolerance,
            leave_out=arguments.leave_out,
            strict=arguments.strict,
        )
    except UnsupportedError as error:
        raise error.with_remedies("--tolerance 0.001", "--leave-out NAME", "without --strict") from None


def check_writable(target: str, source: str, force: bool = False) -> None:
    """Check that a file can be written, before the model is loaded."""
    endings = writable_suffixes()
    if not target:
        raise FormatError("The name of the file to write is empty.")
    path = Path(target).expanduser()
    if path.is_dir():
        inside = path / f"{Path(source).name.partition('.')[0] or 'model'}{endings[0]}"
        raise FormatError(f"{target} is a folder; name a file in it, such as {inside}.")
    if not path.name.endswith(endings):
        raise FormatError(f"{target}: no format has this suffix. Use one of {', '.join(endings)}.")
    if not path.parent.is_dir():
        raise FormatError(f"{target}: the folder {path.parent} does not exist.")
    if not os.path.lexists(path):
        return
    if not path.is_file():
        raise FormatError(f"{target} is no regular file.")
    found = None if find_scheme(source) else locate_model(source)
    if found is not None and not found.collection and path.samefile(found.path):
        raise DuplicateNameError(f"{target} is the input; give the output another name.")
    if not force:
        raise DuplicateNameError(f"{target} exists already; --force replaces it.")


def _format_report(
    arguments: argparse.Namespace, model: kv.Model, size: int, left_out: list[str], saved: SaveResult
) -> list[str]:
    lines = [f"{arguments.source} → {arguments.target}", f"  {format_contents(model)}, {format_bytes(size)}"]
    if saved.errors:
        lines.append(f"  {_approximation_errors(saved)}")
    most = None if arguments.all else SHOWN
    for when, texts in (("reading", left_out), ("writing", saved.remarks)):
        if texts:
            lines.append(f"  remarks on {when}")
            lines += truncate_lines([f"    {text}" for text in texts], most, "    ")
    return lines


def _approximation_errors(saved: SaveResult) -> str:
    errors = saved.errors
    furthest = max(errors, key=lambda name: errors[name].position)
    most_turned = max(errors, key=lambda name: errors[name].angle)
    position, angle = saved.error.position, saved.error.angle
    worst = [f"{format_pose_difference(position, 0.0)} ({furthest})"] if position else []
    if angle:
        worst.append(f"{format_pose_difference(0.0, angle)} ({most_turned})")
    return f"{format_count(len(errors), 'frame')} approximated, off by at most {' and '.join(worst)}"


def _format_check(check: ConversionCheck) -> list[str]:
    where = f" ({check.frame}" + (f", joint {check.joint})" if check.joint else ")") if check.frame else ""
    lines = [
        f"  checked by {check.engine} {check.version}: {format_count(check.states, 'state')}, "
        f"{format_count(check.frames, 'frame')}, largest difference {check.largest}{where}"
    ]
    if check.bounds != FrameDeviation():
        lines.append(f"    bound of the approximated frames {check.bounds}")
    return [*lines, *(f"    {remark}" for remark in check.remarks)]


def _format_wrong(target: str, check: ConversionCheck) -> str:
    name, error = next(iter(check.wrong.items()))
    more = f", and {len(check.wrong) - 1} more" if len(check.wrong) > 1 else ""
    return (
        f"{target} does not move like the model: in {check.engine}, '{name}' is off by {error}{more}. "
        f"The first joint that differs is '{check.cause}'. {target} is kept, for a look at it only."
    )


def _check_as_json(check: ConversionCheck) -> dict[str, object]:
    def finite(value: float) -> float | None:
        return value if math.isfinite(value) else None

    largest = check.largest
    return {
        "engine": check.engine,
        "version": check.version,
        "states": check.states,
        "frames": check.frames,
        "largest": {
            "distance": finite(largest.position),
            "angle": finite(largest.angle),
            "frame": check.frame,
            "joint": check.joint,
        },
        "bound": {"distance": finite(check.bounds.position), "angle": finite(check.bounds.angle)},
        "ok": check.ok,
        "wrong": list(check.wrong),
        "cause": check.cause,
        "remarks": list(check.remarks),
    }


def _as_json(
    arguments: argparse.Namespace, model: kv.Model, size: int, left_out: list[str], saved: SaveResult
) -> dict[str, object]:
    worst_first = sorted(saved.errors.items(), key=lambda item: (-item[1].position, -item[1].angle))
    return {
        "in": arguments.source,
        "out": arguments.target,
        "bytes": size,
        "counts": count_contents(model),
        "largest": {"distance": saved.error.position, "angle": saved.error.angle},
        "approximated": [
            {"name": name, "distance": error.position, "angle": error.angle} for name, error in worst_first
        ],
        "left_out": dict(saved.left_out),
        "remarks": {"reading": left_out, "writing": list(saved.remarks)},
    }
