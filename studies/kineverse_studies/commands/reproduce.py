"""``kineverse reproduce``: the papers' experiments."""

from __future__ import annotations

import argparse
import json
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING

from kineverse.cli.arguments import require
from kineverse.cli.output import format_markdown, format_table, show_progress
from kineverse.errors import MissingDependencyError, UnknownNameError
from kineverse.expressions.printing import format_number

if TYPE_CHECKING:
    from kineverse_studies.experiments import Report, ReportTable

HELP = """reproduce an experiment of the papers, with tables and a figure

examples:
  kineverse reproduce --list
  kineverse reproduce fig3
  kineverse reproduce fig3 --figure door.svg
  kineverse reproduce estimation-grid --quick
  kineverse reproduce sturm --data sturm_tracks
  kineverse reproduce kitchens --seed 100 --count 50 --robot hsr
  kineverse reproduce fig3 --json"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add, flag, noise = parser.add_argument, "store_true", "3mm+3mm/m,0.5deg,30Hz"
    add("name", metavar="NAME", nargs="?", help="name of an experiment, see --list")
    add("--list", action=flag, help="list the experiments and exit")
    add("--quick", action=flag, help="reduced experiment, in seconds")
    add("--data", metavar="FOLDER", type=Path, help="folder of the recordings that it needs")
    add("--model", metavar="MODEL", help="name or path of its model")
    folders = "folder of further models; may be given several times"
    add("--models", metavar="FOLDER", action="append", type=Path, default=[], help=folders)
    add("--seed", metavar="N", type=int, default=0, help="first seed (0)")
    add("--count", metavar="N", type=int, help="number of seeds or repetitions")
    robots = "name or path of a robot; may be given several times"
    add("--robot", metavar="ROBOT", action="append", default=[], help=robots)
    add("--processes", metavar="N", type=int, help="number of processes (cores)")
    add("--world", default="kinematic", help="kinematic (the default), mujoco, or both")
    add("--noise", metavar="NOISE", help=f"noise of the sensors, such as {noise} (none: the truth)")
    add("--ros", action=flag, help="the robot is only topics of ROS 2")
    add("--record", metavar="FOLDER", type=Path, help="folder for a recording of each trial")
    figure, form = parser.add_mutually_exclusive_group(), parser.add_mutually_exclusive_group()
    where = "file of the figure (NAME.png; with --json, --markdown: none)"
    figure.add_argument("--figure", metavar="FILE", type=Path, help=where)
    figure.add_argument("--no-figure", action=flag, help="draw nothing")
    form.add_argument("--json", action=flag, help="one JSON object on standard output")
    form.add_argument("--markdown", action=flag, help="tables in Markdown on standard output")


def run(arguments: argparse.Namespace) -> int:
    """Run the experiment, print its tables, write its figure."""
    from kineverse_studies.experiments import EXPERIMENTS, Options, reproduce
    from kineverse_studies.experiments.registry import PLANNED, REQUIRED_EXTRAS

    if arguments.list:
        table = format_table(("name", "about"), EXPERIMENTS.items())
        print(json.dumps(dict(EXPERIMENTS), indent=2) if arguments.json else table)
        return 0
    if arguments.name is None:
        raise UnknownNameError(f"Name an experiment. There are: {', '.join(EXPERIMENTS)}.")
    given = vars(arguments) | {"robot": tuple(arguments.robot), "models": tuple(arguments.models)}
    options = Options(**{f.name: given[f.name] for f in fields(Options) if f.name in given})
    needed = REQUIRED_EXTRAS.get(arguments.name, ())
    extras = {
        "check": "check" in needed,
        "control": "control" in needed,
        "exchange": "exchange" in needed,
        "figures": arguments.figure is not None,
        "geometry": "geometry" in needed,
        "mjcf": "mjcf" in needed or ("geometry" in needed and arguments.world != "kinematic"),
        "recording": arguments.record is not None,
    }
    require(f"kineverse reproduce {arguments.name}", extras, compiler=arguments.name in PLANNED)
    report = reproduce(arguments.name, show_progress, options)
    if arguments.figure is not None and (arguments.json or arguments.markdown):
        _save_figures(report, arguments.figure)
    if arguments.json:
        answer = {
            "name": report.name,
            "title": report.title,
            "figure": arguments.figure and str(arguments.figure),
            **report.numbers,
        }
        print(json.dumps(answer, indent=2, allow_nan=False))
        return 0
    print(format_report(report, arguments.markdown), flush=True)
    if arguments.no_figure or arguments.markdown:
        return 0
    try:
        paths = _save_figures(report, arguments.figure or Path(f"{report.name}.png"))
    except MissingDependencyError as error:
        if arguments.figure:
            raise
        print(f"\nThere is no figure. {error}")
    else:
        names = ", ".join(map(str, paths))
        print(f"\nThe figures are in {names}." if len(paths) > 1 else f"\nThe figure is in {names}.")
    return 0


def _save_figures(report: Report, requested: Path) -> list[Path]:
    paths = {requested: report.figure}
    for name, picture in report.pictures.items():
        paths[requested.with_name(f"{requested.stem}-{name}{requested.suffix}")] = picture
    for path, figure in paths.items():
        figure.save(path)
    return list(paths)


def format_report(report: Report, markdown: bool = False) -> str:
    title = f"# {report.title}" if markdown else report.title
    return "\n\n".join([title, *(_format_report_table(table, markdown) for table in report.tables)])


def _format_report_table(table: ReportTable, markdown: bool) -> str:
    rows = [[cell if isinstance(cell, str) else format_number(cell) for cell in row] for row in table.rows]
    if markdown:
        return f"## {table.title}\n\n{format_markdown(table.head, rows)}"
    return f"{table.title}\n{format_table(table.head, rows, '>' * len(table.head))}"
