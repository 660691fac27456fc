"""``kineverse calibrate``: corrections of a model by what was seen at known joint values."""

from __future__ import annotations

import argparse
import json
import math
from fnmatch import filter as filter_names
from typing import TYPE_CHECKING, Any

import numpy as np

import kineverse as kv
from kineverse.errors import InvalidValueError, KineverseError, UnknownNameError, suggest
from kineverse.estimation import calibrate, read_looks
from kineverse.estimation.calibration.calibration import SHOWN_UNITS, format_direction, format_size
from kineverse.estimation.calibration.corrections import find_corrections
from kineverse.expressions.printing import format_number
from kineverse.symbols import parameter

from .arguments import (
    add_model_options,
    add_set_option,
    load_model,
    parse_assignments,
    parse_length,
    parse_value,
    print_notes,
)
from .convert import check_writable
from .output import format_table, show_activity

if TYPE_CHECKING:
    from collections.abc import Sequence

    from kineverse.estimation import Calibration, LookTable
    from kineverse.model.registry import SaveResult
    from kineverse.symbols import Symbol

HELP = """\
MODEL is corrected so that it explains DATA: the zeros of its joints, where its camera and its markers are
mounted, lengths, axes. DATA is a table in text, a row for each look. Columns that are called like joints,
with or without the prefix of the model, are their values. All others are what was seen, as in kineverse fit:
x, y, z and qx, qy, qz, qw (or roll, pitch, yaw, or rx, ry, rz), with units as in "x [mm]"; of several frames
as marker.x, where marker is a frame of the model; positions x, y, z alone; pixels u, v. Empty cells are gaps.

--free says what is corrected, by a word and a pattern of names, and may be given several times:
  offsets PATTERN   zeros of joints             lengths PATTERN   lengths of links, along their direction
  mount FRAME       pose of a frame or joint in its parent, six numbers
  axis JOINT        direction of an axis        pitch JOINT       pitch of a screw
  intrinsics        focal lengths and centre of the camera, for pixels
--attach adds a frame that the model lacks, such as a marker. Its mount may be free, from nothing.

Joint values in degrees, lengths in millimetres and quaternions as w, x, y, z show in what was seen, or are
asked for; a note says what was assumed. The noise is estimated, and gross errors are left out and listed.
What the looks cannot tell stays as it was, and is named. The error in looks that were left out says what to
expect.

With --output, a URDF is the file of MODEL with nothing but the corrected numbers changed: comments,
transmissions and plugins stay to the byte. A document (.kv.json) has all corrections.

The exit status is 0 if everything free was told, 1 if some directions were not, 2 for wrong use.

examples:
  kineverse calibrate arm.urdf looks.csv --free "offsets *" --free "mount camera" --observed tip --in camera
  kineverse calibrate pr2 looks.csv --free "offsets r_*" --observed r_gripper_tool_frame --output pr2.urdf
  kineverse calibrate arm.urdf looks.csv --attach marker=hand --attach camera=world --free "mount marker"
      --free "mount camera" --observed marker --in camera
  kineverse calibrate arm.urdf corners.csv --free intrinsics --free "mount camera" --observed corner
      --in camera --intrinsics 600,600,320,240"""

UNTOLD = 1
_SHOWN = 12  # number of gross errors listed


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("model", metavar="MODEL", help="name of a shipped model, or path of a file")
    parser.add_argument("data", metavar="DATA", help="path of the table")
    parser.add_argument(
        "--free",
        metavar="WHAT",
        action="append",
        default=[],
        help='what is corrected, such as "offsets r_*"; may be given several times',
    )
    parser.add_argument(
        "--observed", metavar="FRAME", help="frame that was seen, if the columns do not name it"
    )
    parser.add_argument(
        "--in",
        "--relative-to",
        dest="relative_to",
        metavar="FRAME",
        help="frame that it was seen in, such as a camera (world)",
    )
    parser.add_argument(
        "--attach",
        metavar="NAME=PARENT",
        action="append",
        default=[],
        help="add a frame NAME at PARENT, such as a marker; may be given several times",
    )
    add_set_option(parser, "the value of a joint that DATA lacks, the same in all looks")
    parser.add_argument(
        "--columns", metavar="NAMES", help="names of the columns, with commas (- to ignore one)"
    )
    parser.add_argument(
        "--units",
        metavar="UNITS",
        help="units of columns without one: mm, deg, or mm,deg (m, rad, if possible)",
    )
    parser.add_argument(
        "--intrinsics", metavar="FX,FY,CX,CY", help="focal lengths and centre of the camera [px], for pixels"
    )
    parser.add_argument(
        "--noise",
        metavar="M[,RAD]",
        help="standard deviations of positions and orientations: 3mm,0.5deg (estimated)",
    )
    parser.add_argument(
        "--held-out",
        metavar="N",
        type=int,
        default=5,
        help="number of parts in which looks are left out to measure the error of others (5; 0 for none)",
    )
    parser.add_argument(
        "--output", metavar="FILE", help="write the corrected model: .urdf, .kv.json, .xml (MJCF)"
    )
    parser.add_argument("--force", action="store_true", help="replace FILE if it exists")
    parser.add_argument("--prefix", metavar="NAME", help="prefix of all names, followed by a slash")
    add_model_options(parser)
    parser.add_argument("--json", action="store_true", help="everything, as one JSON object")


def run(arguments: argparse.Namespace) -> int:
    """Read the table, calibrate the model, and print and save the result."""
    if not arguments.free:
        raise InvalidValueError(
            'Nothing is free. Say what is corrected, as in --free "offsets *" or --free "mount camera".'
        )
    if arguments.output:
        check_writable(arguments.output, arguments.model, arguments.force)
    noise = None if arguments.noise is None else _parse_noise(arguments.noise)
    with show_activity(f"reading {arguments.model}"):
        model = load_model(arguments, arguments.model, arguments.prefix)
    _attach_frames(model, arguments.attach)
    camera = _Camera(arguments.intrinsics)
    free = [part for text in arguments.free for part in _complete(model, text, camera)]
    state: dict[Symbol | str, float] = {
        str(_coordinate(model, k)): v for k, v in parse_assignments(arguments.assignments).items()
    }
    find_corrections(model, [part for part in free if isinstance(part, str)])  # before the table is read
    try:
        table = read_looks(
            arguments.data,
            model,
            observed=arguments.observed,
            relative_to=arguments.relative_to,
            columns=arguments.columns,
            units=arguments.units,
            state=state,
            focal=camera.focal,
            centre=camera.centre,
        )
    except KineverseError as error:
        raise type(error)(
            str(error)
            .replace("state=", "--set NAME=VALUE")
            .replace("focal=", "--intrinsics")
            .replace("relative_to=", "--in")
        ) from None
    assumed = [f"assumed: {'; '.join(table.assumptions)}"] if table.assumptions else []
    ignored = [f"columns that mean nothing here: {', '.join(table.ignored)}"] if table.ignored else []
    print_notes([*assumed, *table.remarks, *ignored])
    with show_activity(f"calibrating by {len(table.looks)} looks"):
        found = calibrate(model, table.looks, free, noise=noise, held_out=arguments.held_out)
    saved = None
    if arguments.output:
        with show_activity(f"writing {arguments.output}"):
            saved = found.save(arguments.output)
    if arguments.json:
        print(json.dumps(_as_json(arguments, table, found, saved), allow_nan=False))
    else:
        print("\n".join(_format(arguments, model, table, found, saved)))
    return UNTOLD if found.unobservable else 0


# -- options -------------------------------------------------------------------------------------------------


class _Camera:
    """Focal lengths and centre of the camera, as parameters so that they may be free."""

    def __init__(self, text: str | None) -> None:
        self.focal: tuple[Symbol, Symbol] | None = None
        self.centre: tuple[Symbol | float, Symbol | float] = (0.0, 0.0)
        self.symbols: tuple[Symbol, ...] = ()
        if text is None:
            return
        try:
            numbers = [float(part) for part in text.split(",")]
        except ValueError:
            numbers = []
        if len(numbers) != 4 or not all(map(math.isfinite, numbers)) or not min(numbers[:2]) > 0:
            raise InvalidValueError(
                f"--intrinsics {text!r}: write four numbers of px, the focal lengths and the centre: "
                "600,600,320,240"
            )
        names = zip(("fx", "fy", "cx", "cy"), numbers, strict=True)
        fx, fy, cx, cy = self.symbols = tuple(parameter(f"camera/{n}", v) for n, v in names)
        self.focal, self.centre = (fx, fy), (cx, cy)


def _complete(model: kv.Model, text: str, camera: _Camera) -> list[str | Symbol]:
    """Return what is free by one option, with the model's prefix where a pattern lacks it."""
    word, _, pattern = text.strip().partition(" ")
    if word == "intrinsics":
        if not camera.symbols:
            raise InvalidValueError(
                "--free intrinsics needs their present values: --intrinsics FX,FY,CX,CY, such as "
                "600,600,320,240"
            )
        return [*camera.symbols]
    names, pattern = [*model.articulations, *model.frames], pattern.strip()
    if not pattern or filter_names(names, pattern):
        return [text]
    prefixes = sorted({name.partition("/")[0] for name in names if "/" in name})
    longer = [f"{prefix}/{pattern}" for prefix in prefixes]
    return [f"{word} {one}" for one in longer if filter_names(names, one)] or [text]


def _coordinate(model: kv.Model, name: str) -> Symbol:
    """Return the coordinate of a name without or with the model's prefix."""
    found = [s for s in model.symbols if str(s) == name or str(s).endswith(f"/{name}")]
    exact = [s for s in found if str(s) == name] or found
    if len(exact) == 1:
        return exact[0]
    hint = suggest(name, map(str, model.symbols), "coordinate")
    raise UnknownNameError(f"--set {name}: the model has no such coordinate. {hint}")


def _attach_frames(model: kv.Model, texts: Sequence[str]) -> None:
    """Add frames to a model."""
    with model.edit() as edit:
        for text in texts:
            name, sign, parent = (part.strip() for part in text.partition("="))
            if not sign or not name or not parent:
                raise InvalidValueError(f"--attach {text!r}: write NAME=PARENT, such as marker=hand")
            frames = ("world", *edit.model.frames)
            ends = [parent] if parent in frames else [f for f in frames if f.endswith(f"/{parent}")]
            if len(ends) != 1:
                hint = suggest(parent, frames, "frame")
                raise UnknownNameError(f"--attach {text}: the model has no frame '{parent}'. {hint}")
            if name in frames:
                raise InvalidValueError(
                    f"--attach {text}: there is a frame '{name}' already. Choose another."
                )
            edit.add_frame(name, parent=ends[0])


def _parse_noise(text: str) -> dict[str, float]:
    """Return the standard deviations of a text such as ``3mm,0.5deg``."""
    first, comma, second = text.partition(",")
    try:
        sizes = {"position": parse_length(first)}
        if comma:
            sizes["orientation"] = parse_value(second)
        good = min(sizes.values()) > 0.0
    except InvalidValueError:
        good = False
    if not good:
        raise InvalidValueError(
            f"--noise {text!r}: write positive numbers of m and rad: 0.003,0.01 or 3mm,0.5deg"
        )
    return sizes


# -- report --------------------------------------------------------------------------------------------------


def _scaled(value: float, unit: str) -> tuple[float, str]:
    factor, shown = SHOWN_UNITS.get(unit, (1.0, unit))
    return factor * value, shown


def _format(
    arguments: argparse.Namespace,
    model: kv.Model,
    table: LookTable,
    found: Calibration,
    saved: SaveResult | None,
) -> list[str]:
    """Return the result as lines of text."""
    lines = [f"{arguments.model}, calibrated by {len(table.looks)} looks of {arguments.data}", ""]
    rows = []
    for symbol, value in found.state.items():
        name = str(symbol)
        unit = found.units[name]  # only intrinsics have none
        number, shown = _scaled(value, unit)
        deviation = found.deviations[name]
        spread = "not told alone" if math.isinf(deviation) else format_number(_scaled(deviation, unit)[0], 2)
        rows.append(
            [name, format_number(number, 4), f"± {spread}", shown or "px"]
        )  # only intrinsics have none
    lines.append(format_table(["parameter", "correction", "deviation", "unit"], rows, "<>><"))
    lines.append("")
    groups = list(found.noise)
    head, rows = ["", *groups], []
    for title, sizes in (
        ("noise", found.noise),
        ("off before", found.before),
        ("off now, in looks left out", found.held_out),
    ):
        if sizes:
            rows.append([title, *(format_size(sizes[g], g) if g in sizes else "" for g in groups)])
    lines.append(format_table(head, rows, "<" + ">" * len(groups)))
    if found.outliers:
        looks = sorted({outlier.look for outlier in found.outliers})
        shown_lines = ", ".join(str(table.lines[k]) for k in looks[:_SHOWN])
        more = ", …" if len(looks) > _SHOWN else ""
        where = "line" if len(looks) == 1 else "lines"
        lines.append(f"\ngross errors, left out: {len(found.outliers)}, in {where} {shown_lines}{more}")
    if found.unobservable:
        lines.append("\nnot told by these looks, and as before:")
        lines += [f"  {format_direction(direction)}" for direction in found.unobservable]
    if saved is not None:
        lines.append(f"\nwritten: {saved.path}")
        lines += [f"  {remark}" for remark in saved.remarks]
    return lines


def _as_json(
    arguments: argparse.Namespace, table: LookTable, found: Calibration, saved: SaveResult | None
) -> dict[str, Any]:
    return {
        "model": arguments.model,
        "data": arguments.data,
        "looks": len(table.looks),
        "assumptions": list(table.assumptions),
        "ignored": list(table.ignored),
        "state": {str(s): float(v) for s, v in found.state.items()},
        "deviations": {n: None if math.isinf(d) else d for n, d in found.deviations.items()},
        "units": dict(found.units),
        "covariance": np.asarray(found.covariance).tolist(),
        "unobservable": [dict(direction) for direction in found.unobservable],
        "noise": dict(found.noise),
        "before": dict(found.before),
        "held_out": dict(found.held_out),
        "outliers": [
            {"line": table.lines[o.look], "what": o.what, "probability": o.probability}
            for o in found.outliers
        ],
        "output": None if saved is None else str(saved.path),
        "remarks": [] if saved is None else list(saved.remarks),
    }
