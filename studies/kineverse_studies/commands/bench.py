"""``kineverse bench``: speed of this installation beside other libraries."""

from __future__ import annotations

import argparse
import json
import math
import textwrap
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kineverse._checks import as_count
from kineverse.cli.output import format_markdown, format_table, show_progress
from kineverse.expressions.printing import format_number

if TYPE_CHECKING:
    from kineverse_studies.bench import BenchmarkResult, Comparison, Machine

HELP = """measure the speed of this installation, beside its peers where they are installed

All benchmarks run unless names are given. All libraries do the same work in turns and must compute equal
results. Times are printed, and how many times as fast Kineverse is as each peer. Compare these ratios, since
times drift. Peers that are not installed are listed at the end.

examples:
  kineverse bench
  kineverse bench --quick                            in a minute or two
  kineverse bench call batch --quick
  kineverse bench load --robot my_robot.urdf --frame tool0
  kineverse bench --list"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add, flag = parser.add_argument, "store_true"
    add("names", metavar="NAME", nargs="*", help="names of benchmarks, see --list")
    add("--list", action=flag, help="list the benchmarks and exit")
    add("--quick", action=flag, help="few rounds, for an order of magnitude")
    add("--targets", action=flag, help="also print the targets of the developers, met or missed")
    add("--robot", metavar="MODEL", help="path of a URDF file, or name of a model (a PR2)")
    add("--frame", metavar="FRAME", help="frame of the pose and Jacobian (a gripper)")
    add("--queries", metavar="N", type=int, help="number of queries of 'planning' in kitchens (1000)")
    add("--examples", metavar="FOLDER", type=Path, help="folder of our examples (that of the checkout)")
    form = parser.add_mutually_exclusive_group()
    form.add_argument("--json", action=flag, help="one JSON object on standard output")
    form.add_argument("--markdown", action=flag, help="tables in Markdown on standard output")


def run(arguments: argparse.Namespace) -> int:
    from kineverse_studies import bench

    if arguments.list:
        listing = bench.BENCHMARKS
        table = format_table(("benchmark", "what it measures"), listing.items())
        print(json.dumps(dict(listing), indent=2) if arguments.json else table)
        return 0
    names = bench.select_benchmarks(arguments.names)
    settings = replace(
        bench.QUICK if arguments.quick else bench.BenchmarkSettings(),
        robot=arguments.robot,
        frame=arguments.frame,
        folder=arguments.examples,
        progress=show_progress,
    )
    if arguments.queries is not None:
        settings = replace(settings, queries=as_count("--queries", arguments.queries, 0))
    here = bench.describe_machine()
    if arguments.json:
        results = list(bench.run_benchmarks(names, settings))
        answer = {"machine": asdict(here), "benchmarks": list(map(benchmark_to_json, results))}
        print(json.dumps(answer, indent=2, allow_nan=False))
        return 0
    if not arguments.markdown:
        print(f"{_format_machine(here)}\n\n{RATIO_NOTE}", flush=True)
    missing: dict[str, None] = {}
    for result in bench.run_benchmarks(names, settings):
        if arguments.markdown:
            lines = "".join(f"- not measured: {line}\n" for line in result.missing)
            print(
                f"## {result.name}: {result.work}\n\n{benchmark_to_markdown(result)}\n\n{lines}",
                end="",
                flush=True,
            )
        elif result.measurements:
            print(f"\n{format_benchmark(result, arguments.targets)}", flush=True)
        missing.update(dict.fromkeys(result.missing))
    if missing and not arguments.markdown:
        print("\n" + "\n".join(["not measured here:", *(f"  {line}" for line in missing)]))
    return 0


RATIO_NOTE = """\
"Times as fast" is how many times as long the other one takes for the same work; below 1, Kineverse is slower.
Times drift on a machine that others use, ratios hardly."""


def benchmark_to_json(result: BenchmarkResult) -> dict[str, Any]:
    """Return a result as JSON data, times in s; ``value`` is null where a peer is missing."""
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


def benchmark_to_markdown(result: BenchmarkResult) -> str:
    """Return one table in Markdown: each contender, and how many times as long it takes as the first."""
    rows = []
    for m in result.measurements:
        slower = [f"{_format_speedup(c)} × {c.ours}" for c in result.comparisons if c.theirs == m.name]
        cells = (m.name, format_quantity(m.median, m.unit), format_quantity(m.best, m.unit))
        rows.append((*cells, "; ".join(slower)))
    known = [c for c in result.comparisons if c.unit == "x" and not c.theirs and c.value is not None]
    rows += [(c.name, f"{_format_speedup(c)} ×", "", "") for c in known]
    return format_markdown((result.name, "median", "best", "takes"), rows)


def format_benchmark(result: BenchmarkResult, targets: bool = False) -> str:
    measured = [
        (m.name, format_quantity(m.median, m.unit), format_quantity(m.best, m.unit))
        for m in result.measurements
    ]
    work = textwrap.fill(f"{result.name}: {result.work}", 100, subsequent_indent="  ")
    parts = [f"{work}\n{format_table(('', 'median', 'best'), measured, '<>>')}"]
    known = [c for c in result.comparisons if c.value is not None]
    speeds = [(_format_speedup(c), c.ours, c.theirs) for c in known if c.theirs]
    if speeds:
        parts.append(format_table(("times as fast", "is", "as"), speeds, "><<"))
    lengths = [(_format_speedup(c), c.name) for c in known if c.unit == "x" and not c.theirs]
    if lengths:
        parts.append(format_table(("times as long", ""), lengths, "><"))
    if targets and (with_bars := [_target_row(c) for c in result.comparisons if c.bar is not None]):
        parts.append(format_table(("target", "measured", "bar", ""), with_bars, "<>><"))
    return "\n\n".join(parts)


def _target_row(comparison: Comparison) -> tuple[str, str, str, str]:
    value, unit, bar = comparison.value, comparison.unit, comparison.bar
    assert bar is not None
    found = "-" if value is None else format_quantity(value, unit)
    target = f"{'>=' if bar.at_least else '<='} {format_quantity(bar.limit, unit)}"
    return comparison.name, found, target, comparison.status


def format_quantity(value: float, unit: str) -> str:
    """Return a number with its unit; times are scaled to s, ms, µs or ns."""
    if unit == "x":
        return f"{format_number(value, 3)} x"
    if unit != "s":
        return f"{format_number(value, 3)} {unit}"
    for prefix, factor in (("", 1.0), ("m", 1e3), ("µ", 1e6)):
        if abs(value) * factor >= 0.9995:
            return f"{format_number(value * factor, 3)} {prefix}s"
    return f"{format_number(value * 1e9, 3)} ns"


def _format_speedup(comparison: Comparison) -> str:
    value = math.nan if comparison.value is None else comparison.value
    return f"{value:.0f}" if abs(value) >= 1000.0 else format_number(value, 3)


def _format_machine(machine: Machine) -> str:
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
    return format_table(("measured", "here"), rows)
