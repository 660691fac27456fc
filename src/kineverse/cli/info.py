"""``kineverse info``: contents of a model, and the list of articulations."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from kineverse.expressions.printing import format_number

from .arguments import add_model_options, load_model
from .output import format_table, truncate_lines

if TYPE_CHECKING:
    from kineverse.geometry import DistanceResult

    from .summary import ModelSummary

HELP = """\
examples:
  kineverse info kitchen
  kineverse info my_robot.urdf --frames
  kineverse info pr2 --json
  kineverse info articulations        list of the gallery"""


SHOWN = 10
"""Number of reader warnings printed."""


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

    from kineverse.formats.reader_warnings import collect_warnings

    from .summary import summarize_model

    with collect_warnings() as remarks:
        model = load_model(arguments, arguments.model)
    summary = summarize_model(arguments.model, model)
    if arguments.json:
        print(json.dumps({**summary_to_json(summary), "remarks": remarks}, allow_nan=False))
        return 0
    sections = format_sections(summary, arguments.frames, arguments.constraints)
    if remarks:
        sections.append(
            "\n".join(["remarks", *truncate_lines([f"  {text}" for text in remarks], SHOWN, "  ")])
        )
    print("\n\n".join(sections))
    return 0


def format_sections(summary: ModelSummary, frames: bool = False, constraints: bool = False) -> list[str]:
    """Return the paragraphs of the report."""
    extent = " x ".join(f"{edge:.2f}" for edge in summary.extent)
    frames_, freedoms, conditions = map(len, (summary.frames, summary.freedoms, summary.constraints))
    lines = [
        summary.name,
        f"  {frames_} frames, {freedoms} DoF, {conditions} constraints",
        f"  {extent} m, {summary.mass:.4g} kg, {summary.shapes} shape{'' if summary.shapes == 1 else 's'}"
        + (f", {len(summary.problems)} of them not loaded" if summary.problems else ""),
    ]
    if summary.unplaced:
        lines.append(f"  not finite at the default state: {', '.join(summary.unplaced)}")
    if summary.touched_as_seen:
        bodies = (
            "1 body has"
            if len(summary.touched_as_seen) == 1
            else f"{len(summary.touched_as_seen)} bodies have"
        )
        lines.append(f"  {bodies} no collision shapes; distances are to hulls of what is seen")
    if summary.contacts:
        lines.append(_format_contacts(summary.contacts))
    if summary.sha256:
        lines.append(f"  document, sha256 {summary.sha256}")
    sections = ["\n".join(lines)]
    if summary.freedoms:
        rows = [
            (
                f.name,
                f.unit,
                format_number(f.lower),
                format_number(f.upper),
                format_number(f.default),
                format_number(f.speed),
            )
            for f in summary.freedoms
        ]
        sections.append(format_table(("DoF", "unit", "lower", "upper", "default", "speed"), rows, "<<>>>>"))
    if summary.interlocks:
        sections.append("\n".join(["interlocks", *(f"  {interlock}" for interlock in summary.interlocks)]))
    locking = {name for interlock in summary.interlocks for name in interlock.constraints}
    shown = [c for c in summary.constraints if constraints or not (c.simple or c.name in locking)]
    if shown:
        title = "constraint" if constraints else "other constraints"
        sections.append(format_table((title, ""), [(c.name, c.text) for c in shown]))
    if frames:
        sections.append("frames\n" + "\n".join(_format_tree(summary.frames)))
    hidden = [] if frames else ["--frames"]
    if not constraints and len(shown) < len(summary.constraints):
        hidden.append("--constraints")
    if hidden:
        sections.append(f"More with {' and '.join(hidden)}.")
    return sections


def summary_to_json(summary: ModelSummary) -> dict[str, Any]:
    """Return the summary as JSON data; missing limits are null."""

    def finite(value: float) -> float | None:
        return value if abs(value) < float("inf") else None

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
        "dof": [
            {
                "name": f.name,
                "unit": f.unit or None,
                "lower": finite(f.lower),
                "upper": finite(f.upper),
                "default": finite(f.default),
                "speed": finite(f.speed),
            }
            for f in summary.freedoms
        ],
        "constraints": [
            {"name": c.name, "text": c.text, "symbols": c.symbols, "simple": c.simple}
            for c in summary.constraints
        ],
        **summary.interlocks.as_data(),
        **({"sha256": summary.sha256} if summary.sha256 else {}),
        "not_loaded": summary.problems,
        "not_finite": summary.unplaced,
        "touched_as_seen": summary.touched_as_seen,
        "touching": None
        if summary.contacts is None
        else [{"a": pair.a, "b": pair.b, "distance": pair.distance} for pair in summary.contacts],
    }


def _format_contacts(pairs: Sequence[DistanceResult]) -> str:
    """Return the number of pairs in contact, and the deepest one."""
    from .summary import CONTACT_DEPTH

    pair, depth = pairs[0], -pairs[0].distance
    deepest = f"{pair.a} and {pair.b}" + (
        f", {format_number(depth, 3)} m deep" if depth > CONTACT_DEPTH else ""
    )
    if len(pairs) == 1:
        return f"  1 pair of bodies touches at the default state: {deepest}"
    return f"  {len(pairs)} pairs of bodies touch at the default state, first {deepest}"


def _format_tree(frames: dict[str, str]) -> list[str]:
    """Return the frames in depth-first order, each indented by two spaces more than its parent."""
    children: dict[str, list[str]] = {}
    for name, parent in frames.items():
        children.setdefault(parent, []).append(name)
    lines, stack = [], [(name, 1) for name in reversed(children.get("world", []))]
    while stack:
        name, depth = stack.pop()
        lines.append("  " * depth + name)
        stack.extend((child, depth + 1) for child in reversed(children.get(name, [])))
    return lines


def is_gallery_list(model: str) -> bool:
    """Return whether a name stands for the list of articulations."""
    from kineverse.formats.locate import GALLERY

    return model.rstrip("/") == GALLERY


def print_articulations(as_json: bool = False) -> int:
    """Print a line for each articulation, and return the exit status."""
    from kineverse import gallery
    from kineverse.formats.locate import GALLERY

    rows = [(f"{GALLERY}/{name}", gallery.summary(name)) for name in gallery.names()]
    if as_json:
        print(json.dumps({"models": [{"name": name, "shows": text} for name, text in rows]}))
    else:
        print(format_table(("model", "shows"), rows, "<<"))
        print(f"\nMove one with: kineverse view {rows[0][0]}")
    return 0


def print_models() -> int:
    """Print a line for each shipped model and each articulation, and return the exit status."""
    from kineverse.formats import shipped_models

    print("models: " + ", ".join(shipped_models()), end="\n\n")
    return print_articulations()
