"""``kineverse bench``: how fast things are, here."""

from __future__ import annotations

import argparse
import importlib

HELP = """measure the speed of this installation, beside its peers where they are installed

Without names everything is measured; the numbers say which tier of evaluation they come from.

examples:
  kineverse bench
  kineverse bench fk --json"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("names", metavar="NAME", nargs="*", help="what to measure; everything if left out")
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output")


def run(arguments: argparse.Namespace) -> int:
    """Measure and print."""
    measurements = importlib.import_module("kineverse.bench")
    words = [*arguments.names, *(["--json"] if arguments.json else [])]
    return int(measurements.run(words) or 0)
