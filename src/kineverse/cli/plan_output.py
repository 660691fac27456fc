"""Output of ``kineverse plan``: figures of a path, its points, and plain data."""

from __future__ import annotations

import argparse
import math
from typing import TYPE_CHECKING, Any

import numpy as np

from kineverse.cli.output import format_table
from kineverse.expressions.printing import format_number

if TYPE_CHECKING:
    from kineverse.planning import Path

_COLUMNS = 6
"""Number of points of a path in a table."""


def print_path(arguments: argparse.Namespace, path: Path, preparation: float) -> None:
    """Print what was found."""
    goal = " ".join(arguments.to)
    if not path.found:
        print(f"{goal}: not found. {path.why}")
        if not arguments.move:
            print(f"  moves      {_list_moving(path)}; --move names others")
        return
    clearance = path.clearance()
    near = "nothing within 50 cm" if math.isinf(clearance) else f"{format_number(1e3 * clearance, 4)} mm"
    print(f"{goal}: found")
    for name, value in (
        ("moves", _list_moving(path)),
        ("points", str(len(path))),
        ("length", f"{format_number(path.length, 4)} (rad, m)"),
        ("duration", f"{format_number(float(path.times[-1]), 4)} s"),
        ("clearance", near),
        ("planned", _format_time(path.seconds)),
        ("prepared", _format_time(preparation)),
    ):
        print(f"  {name:<9}  {value}")
    if arguments.verbose:
        print(_format_way(path))
    if arguments.save is not None:
        print(f"trajectory: {arguments.save}")


def _list_moving(path: Path) -> str:
    more = f" and {len(path.symbols) - 3} more" if len(path.symbols) > 3 else ""
    return ", ".join(map(str, path.symbols[:3])) + more


def _format_time(seconds: float) -> str:
    return f"{format_number(1e3 * seconds, 3)} ms" if seconds < 1 else f"{format_number(seconds, 3)} s"


def _format_way(path: Path) -> str:
    """Return a table of the positions at some points of a path."""
    chosen = np.unique(np.linspace(0, len(path) - 1, _COLUMNS).round().astype(int))
    head = ["time [s]", *(format_number(float(t), 3) for t in path.times[chosen])]
    rows = [
        [str(symbol), *(format_number(float(v), 4) for v in column[chosen])]
        for symbol, column in zip(path.symbols, path.points.T, strict=True)
    ]
    return format_table(head, rows, "<" + ">" * len(chosen))


def path_to_json(path: Path, preparation: float) -> dict[str, Any]:
    """Return a path as plain data."""
    clearance = path.clearance() if path.found else math.inf
    return {
        "found": path.found,
        "why": path.why,
        "coordinates": [str(symbol) for symbol in path.symbols],
        "points": path.points.tolist(),
        "times": path.times.tolist() if path.found else None,
        "length": path.length,
        "clearance": clearance if math.isfinite(clearance) else None,
        "seconds": path.seconds,
        "preparation_seconds": preparation,
        # The end, as 'kineverse reach' writes it: --from takes the file.
        "positions": dict(zip(map(str, path.symbols), path.points[-1].tolist(), strict=True)),
    }
