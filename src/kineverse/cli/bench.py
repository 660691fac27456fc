"""``kineverse bench``: how fast things are, here."""

from __future__ import annotations

import argparse
import json
import math
import textwrap
from collections.abc import Iterable
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any

from kineverse.cli.progress import progress
from kineverse.cli.table import figure, table

if TYPE_CHECKING:
    from kineverse.bench import Comparison, Machine, Result

HELP = """measure the speed of this installation, beside its peers where they are installed

Everything is measured unless names are given. Everybody takes turns on the same work and has to compute the
same. Printed are times, and how many times as fast Kineverse is as each peer: compare these ratios, as times
drift. Peers that are not installed are named at the end.

examples:
  kineverse bench
  kineverse bench --quick                            in a minute or two
  kineverse bench call batch --quick
  kineverse bench load --robot my_robot.urdf --frame tool0
  kineverse bench --list"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("names", metavar="NAME", nargs="*", help="what to measure, see --list")
    parser.add_argument("--list", action="store_true", help="say what each benchmark measures, and end")
    parser.add_argument("--quick", action="store_true", help="few rounds: an order of magnitude")
    parser.add_argument(
        "--targets", action="store_true", help="also what the developers aim at, met or missed"
    )
    parser.add_argument("--robot", metavar="MODEL", help="a URDF file, or a name; a PR2 if left out")
    parser.add_argument("--frame", metavar="FRAME", help="whose pose and Jacobian; a gripper if left out")
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output")


def run(arguments: argparse.Namespace) -> int:
    """Measure and print."""
    from kineverse import bench

    if arguments.list:
        print(_listing(bench.BENCHMARKS.items(), arguments.json))
        return 0
    names = bench.chosen(arguments.names)
    settings = replace(
        bench.QUICK if arguments.quick else bench.Settings(),
        robot=arguments.robot,
        frame=arguments.frame,
        progress=progress,
    )
    here = bench.machine()
    if arguments.json:
        results = list(bench.measure(names, settings))
        answer = {"machine": asdict(here), "benchmarks": list(map(as_json, results))}
        print(json.dumps(answer, indent=2, allow_nan=False))
        return 0
    print(_where(here), flush=True)
    print(f"\n{RATIOS}")
    missing: dict[str, None] = {}
    for result in bench.measure(names, settings):
        if result.measurements:
            print(f"\n{as_text(result, arguments.targets)}", flush=True)
        missing.update(dict.fromkeys(result.missing))
    if missing:
        print("\n" + "\n".join(["not measured here:", *(f"  {line}" for line in missing)]))
    return 0


RATIOS = """\
"Times as fast" is how many times as long the other one takes for the same work; below 1, Kineverse is slower.
Times drift on a machine that others use, ratios hardly."""


def as_json(result: Result) -> dict[str, Any]:
    """Return a result as JSON has it: times in s; ``value`` is null where a peer is missing."""
    return {
        "name": result.name,
        "work": result.work,
        "measurements": [
            {"name": m.name, "unit": m.unit, "median": m.median, "best": m.best, "rounds": len(m.samples)}
            for m in result.measurements
        ],
        "comparisons": [
            {
                "name": c.name,
                "value": c.value,
                "unit": c.unit,
                "bar": None if c.bar is None else c.bar.limit,
                "at_least": None if c.bar is None else c.bar.at_least,
                "status": c.status,
            }
            for c in result.comparisons
        ],
        "missing": list(result.missing),
    }


def as_text(result: Result, targets: bool = False) -> str:
    """Return a result as tables; who is missing is left to whoever prints several.

    Parameters
    ----------
    result
        What was measured.
    targets
        Whether to say what the developers aim at.
    """
    measured = [(m.name, quantity(m.median, m.unit), quantity(m.best, m.unit)) for m in result.measurements]
    work = textwrap.fill(f"{result.name}: {result.work}", 100, subsequent_indent="  ")
    parts = [f"{work}\n{table(('', 'median', 'best'), measured, '<>>')}"]
    known = [c for c in result.comparisons if c.value is not None]
    speeds = [(_times(c), c.ours, c.theirs) for c in known if c.theirs]
    if speeds:
        parts.append(table(("times as fast", "is", "as"), speeds, "><<"))
    lengths = [(_times(c), c.name) for c in known if c.unit == "x" and not c.theirs]
    if lengths:
        parts.append(table(("times as long", ""), lengths, "><"))
    aimed = [(c.name, _value(c), _bar(c), c.status) for c in result.comparisons if c.bar is not None]
    if targets and aimed:
        parts.append(table(("target", "", "bar", ""), aimed, "<>><"))
    return "\n\n".join(parts)


def quantity(value: float, unit: str) -> str:
    """Return a number with its unit, times in the one that suits them."""
    if unit == "x":
        return f"{figure(value, 3)} x"
    if unit != "s":
        return f"{figure(value, 3)} {unit}"
    for prefix, factor in (("", 1.0), ("m", 1e3), ("µ", 1e6)):
        if abs(value) * factor >= 0.9995:
            return f"{figure(value * factor, 3)} {prefix}s"
    return f"{figure(value * 1e9, 3)} ns"


def _times(comparison: Comparison) -> str:
    value = math.nan if comparison.value is None else comparison.value
    return f"{value:.0f}" if abs(value) >= 1000.0 else figure(value, 3)


def _value(comparison: Comparison) -> str:
    return "-" if comparison.value is None else quantity(comparison.value, comparison.unit)


def _bar(comparison: Comparison) -> str:
    bar = comparison.bar
    if bar is None:
        return "-"
    return f"{'>=' if bar.at_least else '<='} {quantity(bar.limit, comparison.unit)}"


def _listing(benchmarks: Iterable[tuple[str, str]], as_object: bool) -> str:
    if as_object:
        return json.dumps(dict(benchmarks), indent=2)
    return table(("benchmark", "what it measures"), benchmarks)


def _where(machine: Machine) -> str:
    compiler = machine.compiler
    versions = (f"{name} {version or 'missing'}" for name, version in machine.versions.items())
    rows = [
        ("tier", machine.tier),
        ("vector unit", compiler.vector_unit),
        ("compiler", f"{compiler.version or 'none'} {' '.join(compiler.flags)}".strip()),
        ("processor", f"{machine.processor}, {compiler.cores} cores"),
        ("system", f"{machine.system}, {machine.python}"),
        ("versions", ", ".join(versions)),
    ]
    return table(("measured", "here"), rows)
