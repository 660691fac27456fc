"""``kineverse reproduce``: the papers' experiments, made again."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

from kineverse.cli.progress import progress
from kineverse.cli.table import figure, table
from kineverse.errors import UnknownNameError

if TYPE_CHECKING:
    from kineverse.experiments import Report, Table

HELP = """make an experiment of the papers again: a table here, a figure in a file

examples:
  kineverse reproduce --list
  kineverse reproduce fig3
  kineverse reproduce fig3 --figure door.svg
  kineverse reproduce estimation-grid --quick
  kineverse reproduce sturm --data sturm_tracks
  kineverse reproduce fig3 --json"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("name", metavar="NAME", nargs="?", help="which experiment, see --list")
    parser.add_argument("--list", action="store_true", help="say what each experiment is about, and end")
    parser.add_argument("--quick", action="store_true", help="a part of it, in seconds")
    parser.add_argument("--data", metavar="FOLDER", type=Path, help="where the recordings are that it needs")
    parser.add_argument("--model", metavar="MODEL", help="the model that it is about, a name or path")
    figure = parser.add_mutually_exclusive_group()
    figure.add_argument(
        "--figure", metavar="FILE", type=Path, help="where the figure goes (NAME.png; with --json: nowhere)"
    )
    figure.add_argument("--no-figure", action="store_true", help="draw nothing")
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output")


def run(arguments: argparse.Namespace) -> int:
    """Run the experiment, print its tables, write its figure."""
    from kineverse.experiments import EXPERIMENTS, Options, reproduce

    if arguments.list:
        listing = dict(EXPERIMENTS)
        print(json.dumps(listing, indent=2) if arguments.json else table(("name", "about"), listing.items()))
        return 0
    if arguments.name is None:
        raise UnknownNameError(f"Which experiment? There are: {', '.join(EXPERIMENTS)}.")
    options = Options(quick=arguments.quick, data=arguments.data, model=arguments.model)
    report = reproduce(arguments.name, progress, options)
    drawn = _where(arguments, report.name)
    if drawn:
        report.figure.save(drawn)
    if arguments.json:
        answer = {
            "name": report.name,
            "title": report.title,
            "figure": drawn and str(drawn),
            **report.numbers,
        }
        print(json.dumps(answer, indent=2, allow_nan=False))
        return 0
    print(as_text(report))
    if drawn:
        print(f"\nThe figure is in {drawn}.")
    return 0


def _where(arguments: argparse.Namespace, name: str) -> Path | None:
    """Return where the figure goes: a program that asks for numbers gets no files it did not ask for."""
    if arguments.no_figure:
        return None
    given: Path | None = arguments.figure
    return given if given or arguments.json else Path(f"{name}.png")


def as_text(report: Report) -> str:
    """Return a report as tables."""
    return "\n\n".join([report.title, *map(_table, report.tables)])


def _table(part: Table) -> str:
    rows = [[cell if isinstance(cell, str) else figure(cell) for cell in row] for row in part.rows]
    return f"{part.title}\n{table(part.head, rows, '>' * len(part.head))}"
