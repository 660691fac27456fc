"""``kineverse info`` and ``fk``: contents of a model, the list of articulations, the pose of a frame."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

import kineverse as kv
from kineverse import formats, gallery
from kineverse.errors import InvalidValueError, KineverseError
from kineverse.expressions.printing import format_number
from kineverse.formats import shipped_models
from kineverse.formats.file_formats import DOCUMENT_SUFFIXES
from kineverse.formats.locate import GALLERY
from kineverse.formats.reader_warnings import collect_warnings
from kineverse.geometry import DistanceResult, Scene
from kineverse.geometry.exclusions import find_unusable_shapes, is_installed
from kineverse.geometry.objects import bodies_with_visual_collision
from kineverse.geometry.shapes import import_coal
from kineverse.lie import to_quaternion
from kineverse.model.constraint import Constraint
from kineverse.model.display import DofSummary, order_depth_first, summarize_freedoms
from kineverse.model.model_view import ModelView
from kineverse.reasoning import Interlocks, interlocks
from kineverse.view.drawables import collect_drawables
from kineverse.view.poses import FramePoses, complete, roll_pitch_yaw

from .arguments import (
    add_model_options,
    add_set_option,
    find_limit_notes,
    load_model,
    parse_assignments,
    print_notes,
)
from .output import format_count, format_table, truncate_lines

if TYPE_CHECKING:
    from kineverse.formats.validate import ModelProblem

HELP = """\
examples:
  kineverse info kitchen
  kineverse info my_robot.urdf --frames
  kineverse info pr2 --json
  kineverse info articulations        list of the gallery"""

SHOWN, MISSING = 10, 3  # number of reader warnings, and of meshes that cannot be read, printed


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("model", metavar="MODEL", help="name of a shipped model, or path of a file")
    parser.add_argument("--frames", action="store_true", help="also print the tree of frames")
    parser.add_argument("--constraints", action="store_true", help="also print all constraints")
    parser.add_argument("--json", action="store_true", help="everything, as one JSON object")
    add_model_options(parser)


def run(arguments: argparse.Namespace) -> int:
    """Load the model, summarise it, and print the summary."""
    if is_gallery_list(arguments.model):
        return print_articulations(arguments.json)

    with collect_warnings() as remarks:
        model = load_model(arguments, arguments.model)
    summary = summarize_model(arguments.model, model)
    if arguments.json:
        print(json.dumps({**summary_to_json(summary), "remarks": remarks}, allow_nan=False))
        return 0
    sections = format_sections(summary, arguments.frames, arguments.constraints)
    if remarks:
        lines = truncate_lines([f"  {text}" for text in remarks], SHOWN, "  ")
        sections.append("\n".join(["remarks", *lines]))
    print("\n\n".join(sections))
    return 0


def format_sections(summary: ModelSummary, frames: bool = False, constraints: bool = False) -> list[str]:
    """Return the paragraphs of the report."""
    extent = " x ".join(f"{edge:.2f}" for edge in summary.extent)
    counted = (summary.frames, "frame"), (summary.freedoms, "DoF"), (summary.constraints, "constraint")
    lines = [
        summary.name,
        f"  {', '.join(format_count(len(items), noun) for items, noun in counted)}",
        f"  {extent} m, {summary.mass:.4g} kg, {format_count(summary.shapes, 'shape')}"
        + (f", {len(summary.problems)} of them not loaded" if summary.problems else ""),
    ]
    lines += truncate_lines([f"  {frame}: {why}" for frame, why in summary.problems.items()], MISSING, "  ")
    if summary.unplaced:
        lines.append(f"  not finite at the default state: {', '.join(summary.unplaced)}")
    if summary.touched_as_seen:
        count = len(summary.touched_as_seen)
        bodies = "1 body has" if count == 1 else f"{count} bodies have"
        lines.append(f"  {bodies} no collision shapes; distances are to hulls of what is seen")
    if summary.contacts:
        lines.append(_format_contacts(summary.contacts))
    if summary.sha256:
        lines.append(f"  document, sha256 {summary.sha256}")
    sections = ["\n".join(lines)]
    if summary.freedoms:
        rows = [(name, unit, *map(format_number, numbers)) for name, unit, *numbers in summary.freedoms]
        sections.append(format_table(("DoF", *DofSummary._fields[1:-1], "speed [/s]"), rows, "<<>>>>"))
    if summary.interlocks:
        sections.append("\n".join(["interlocks", *(f"  {interlock}" for interlock in summary.interlocks)]))
    locking = {name for interlock in summary.interlocks for name in interlock.constraints}
    shown = [c for c in summary.constraints if constraints or not (c.simple or c.name in locking)]
    if shown:
        title = "constraint" if constraints else "other constraints"
        sections.append(format_table((title, ""), [(c.name, c.text) for c in shown]))
    if frames:
        tree = order_depth_first(summary.frames)
        sections.append("frames\n" + "\n".join("  " * (depth + 1) + name for name, depth in tree))
    hidden = [] if frames else ["--frames"]
    if not constraints and len(shown) < len(summary.constraints):
        hidden.append("--constraints")
    if hidden:
        sections.append(f"More with {' and '.join(hidden)}.")
    return sections


def summary_to_json(summary: ModelSummary) -> dict[str, Any]:
    """Return the summary as JSON data; missing limits are null."""
    touching = None
    if summary.contacts is not None:
        touching = [{"a": pair.a, "b": pair.b, "distance": pair.distance} for pair in summary.contacts]
    return {
        "model": summary.name,
        "counts": {
            "frames": len(summary.frames),
            "dof": len(summary.freedoms),
            "constraints": len(summary.constraints),
            "shapes": summary.shapes,
        },
        "size": {"low": summary.low, "high": summary.high, "extent": summary.extent, "mass": summary.mass},
        "frames": [{"name": name, "parent": parent} for name, parent in summary.frames.items()],
        "dof": [_dof_to_json(freedom) for freedom in summary.freedoms],
        "constraints": [constraint._asdict() for constraint in summary.constraints],
        **summary.interlocks.as_data(),
        **({"sha256": summary.sha256} if summary.sha256 else {}),
        "not_loaded": list(summary.problems),
        "not_finite": summary.unplaced,
        "touched_as_seen": summary.touched_as_seen,
        "touching": touching,
    }


def _dof_to_json(freedom: DofSummary) -> dict[str, Any]:
    name, unit, *numbers = freedom
    finite = [value + 0.0 if abs(value) < float("inf") else None for value in numbers]
    return {"name": name, "unit": unit or None, **dict(zip(freedom._fields[2:], finite, strict=True))}


def _format_contacts(pairs: Sequence[DistanceResult]) -> str:
    pair, depth = pairs[0], -pairs[0].distance
    deepest = f"{pair.a} and {pair.b}"
    if depth > CONTACT_DEPTH:
        deepest += f", {format_number(depth, 3)} m deep"
    if len(pairs) == 1:
        return f"  1 pair of bodies touches at the default state: {deepest}"
    return f"  {len(pairs)} pairs of bodies touch at the default state, first {deepest}"


def is_gallery_list(model: str) -> bool:
    """Return whether a name stands for the list of articulations."""
    return model.rstrip("/") == GALLERY


def print_articulations(as_json: bool = False) -> int:
    """Print a line for each articulation, and return the exit status."""
    rows = [(f"{GALLERY}/{name}", gallery.summary(name)) for name in gallery.names()]
    if as_json:
        print(json.dumps({"models": [{"name": name, "shows": text} for name, text in rows]}))
    else:
        print(format_table(("model", "shows"), rows, "<<"))
        print(f"\nMove one with: kineverse view {rows[0][0]}")
    return 0


def print_models() -> int:
    """Print a line for each shipped model and each articulation, and return the exit status."""
    print("models: " + ", ".join(shipped_models()), end="\n\n")
    return print_articulations()


CONTACT_DEPTH = 1e-5  # depth below which bodies only touch, such as a drawer on its rail [m]


def find_contacts(model: ModelView) -> Sequence[DistanceResult] | None:
    """Return the touching or penetrating pairs at the default state, deepest first.

    Unusable shapes are left out. The result is None if the extra ``geometry`` is not installed, or poses at
    the default state are not finite.
    """
    if not is_installed():
        return None
    try:
        scene = Scene(model, leave_out=find_unusable_shapes(model))
        scene.update(model.default_state())
        return scene.pairs_within(0.0)
    except KineverseError:  # Poses that are not finite are reported separately.
        return None


def find_penetrations(model: ModelView) -> Iterator[ModelProblem]:
    """Yield the pairs of bodies that penetrate each other at the default state."""
    from kineverse.formats.validate import ModelProblem  # for start-up time

    import_coal()
    for pair in find_contacts(model) or ():
        if pair.distance < -CONTACT_DEPTH:
            text = f"in {pair.b} by {format_number(-pair.distance, 3)} m at the default state"
            yield ModelProblem("contact", pair.a, text)


class ConstraintSummary(NamedTuple):
    """Constraint as text; ``simple`` is True if it bounds a single symbol by numbers."""

    name: str
    text: str
    symbols: list[str]
    simple: bool


@dataclass(frozen=True, slots=True)
class ModelSummary:
    """Contents of a model, for printing and JSON."""

    name: str  # name or path of the model, as given
    frames: dict[str, str]  # parents of the frames, by name
    freedoms: list[DofSummary]
    constraints: list[ConstraintSummary]
    low: list[float]  # bounding box of all shapes at the default state [m]
    high: list[float]
    extent: list[float]
    mass: float  # mass of all bodies [kg]
    shapes: int  # number of visual shapes
    problems: dict[str, str]  # frames of shapes that cannot be loaded
    unplaced: list[str]  # frames whose poses at the default state are not finite; the box leaves them out
    interlocks: Interlocks  # interlocks between coordinates
    touched_as_seen: list[str]  # bodies without collision shapes
    contacts: Sequence[DistanceResult] | None  # pairs that touch at the default state, deepest first
    sha256: str  # hash of the content if the model is a document, else empty


def summarize_model(name: str, model: ModelView) -> ModelSummary:
    """Return the summary of a model; meshes are read for their size."""
    values = complete(model)
    poses = FramePoses(model)
    matrices = poses.evaluate(values)
    unplaced = poses.unplaced(matrices)
    pose_of = dict(zip(poses.names, matrices, strict=True))
    for frame in unplaced:
        del pose_of[frame]
    drawables = collect_drawables(model)
    loaded = [part for part in drawables if not part.placeholder and part.frame in pose_of]
    placed = [
        part.surface.vertices @ pose_of[part.frame][:3, :3].T + pose_of[part.frame][:3, 3] for part in loaded
    ]
    corners = np.concatenate(placed or [np.array([pose[:3, 3] for pose in pose_of.values()])])
    low, high = corners.min(axis=0), corners.max(axis=0)
    masses = (body.inertia.mass for body in model.bodies.values() if body.inertia is not None)
    return ModelSummary(
        name=name,
        frames={frame: model.frames[frame].parent for frame in model.frames},
        freedoms=summarize_freedoms(model),
        constraints=[_summarize_constraint(key, constraint) for key, constraint in model.constraints.items()],
        low=low.tolist(),
        high=high.tolist(),
        extent=(high - low).tolist(),
        mass=float(sum(masses)),
        shapes=len(drawables),
        problems=dict(sorted((part.frame, part.problem) for part in drawables if part.problem)),
        unplaced=unplaced,
        interlocks=interlocks(model),
        touched_as_seen=bodies_with_visual_collision(model),
        contacts=find_contacts(model),
        sha256=formats.document.document_hash(model) if name.endswith(DOCUMENT_SUFFIXES) else "",
    )


def _summarize_constraint(name: str, constraint: Constraint) -> ConstraintSummary:
    bounded_by_numbers = not (constraint.lower.symbols or constraint.upper.symbols)
    symbols = constraint.expression.symbols
    simple = bounded_by_numbers and len(symbols) == 1 and bool(constraint.expression == symbols[0])
    lower, upper = map(_format_bound, (constraint.lower, constraint.upper))
    text = f"{lower} <= {constraint.expression!r} <= {upper}"
    return ConstraintSummary(name, text, [str(symbol) for symbol in constraint.symbols], simple)


def _format_bound(expression: object) -> str:
    text = repr(expression)
    try:
        return f"{float(text) + 0.0:.4g}"  # no minus before a zero
    except ValueError:
        return text


# -- pose of a frame -----------------------------------------------------------------------------------------


class PoseCommand(NamedTuple):
    """Command that prints the pose of a frame."""

    HELP: str
    add_arguments: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], int]


def _add_fk_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("model", metavar="MODEL", help="name of a shipped model, or path of a file")
    parser.add_argument("frame", metavar="FRAME", help="name of a frame, such as kitchen/fridge_door")
    parser.add_argument("--relative-to", metavar="FRAME", default="world", help="reference frame (world)")
    add_set_option(parser)
    add_model_options(parser)
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output")


def _run_fk(arguments: argparse.Namespace) -> int:
    """Evaluate the pose and print it."""
    # Parsed before the model is loaded, so that a typing error is reported at once.
    assigned = parse_assignments(arguments.assignments)

    model = load_model(arguments, arguments.model)
    expression = model.fk(arguments.frame, arguments.relative_to)
    values = complete(model, assigned)
    pose = np.asarray(expression(kv.State(values)), dtype=float)
    notes = find_limit_notes(model, values, arguments.assignments)
    used = {str(s): values[str(s)] for s in expression.symbols if str(s) in values}
    if not np.isfinite(pose).all():
        print_notes(notes)
        where = ", ".join(f"{name}={format_number(value, 6)}" for name, value in used.items()) or "all values"
        raise InvalidValueError(
            f"The pose of '{arguments.frame}' in '{arguments.relative_to}' is not finite at {where}; "
            "set other positions with --set."
        )
    position, rpy = pose[:3, 3], roll_pitch_yaw(pose)
    xyzw = to_quaternion(pose[:3, :3])
    if arguments.json:
        answer = {
            "frame": arguments.frame,
            "relative_to": arguments.relative_to,
            "transform": pose.tolist(),
            "position": position.tolist(),
            "quaternion_xyzw": xyzw.tolist(),
            "roll_pitch_yaw": rpy.tolist(),
            "depends_on": used,
        }
        print(json.dumps(answer, allow_nan=False))
    else:
        print(f"{arguments.frame} in {arguments.relative_to}")
        print("\n".join("  " + "".join(f"{format_number(x, 6):>12}" for x in row) for row in pose))
        rows = ("position", position, "m"), ("roll pitch yaw", rpy, "rad"), ("quaternion xyzw", xyzw, "")
        for name, numbers, unit in rows:
            cells = "".join(f"{format_number(x, 6):>12}" for x in numbers)
            print(f"  {name:<16}{cells}  {unit}".rstrip())
        if used:
            print("  at " + ", ".join(f"{name}={format_number(value, 6)}" for name, value in used.items()))
    print_notes(notes)
    return 0


FK = PoseCommand(
    """\
Positions that are not set have their defaults: 0, or the nearest value within the limits.

examples:
  kineverse fk kitchen kitchen/fridge_door_handle
  kineverse fk kitchen kitchen/fridge_door_handle --set kitchen/fridge_door=30deg --json
  kineverse fk pr2 pr2/l_gripper_tool_frame --relative-to pr2/torso_lift_link""",
    _add_fk_arguments,
    _run_fk,
)
