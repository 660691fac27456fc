"""Faults of the machine, and what remains of a model server: ``make faults ARGS="store --damages 1000"``.

Every target ends with the first violation. Its number and its seed repeat it.
"""

from __future__ import annotations

import argparse
import sys
import time

from . import costs, edge, live, server, store

TARGETS = {"store": store, "server": server, "edge": edge, "costs": costs, "live": live}
"""Modules with ``add_arguments`` and ``run``, and a docstring that says what must hold."""


def main() -> int:
    """Try the faults of one target, or of all with their defaults; return 1 after a violation."""
    parser = argparse.ArgumentParser(prog="make faults", description=__doc__)
    targets = parser.add_subparsers(dest="target", metavar="TARGET")
    for name, module in TARGETS.items():
        text = (module.__doc__ or "").partition("\n")[0]
        module.add_arguments(targets.add_parser(name, help=text, description=text))
    given = parser.parse_args()
    for name in [given.target] if given.target else TARGETS:
        options = given if given.target else parser.parse_args([name])
        try:
            for line in TARGETS[name].run(options):
                _say(f"{name}: {line}")
        except AssertionError as violation:
            _say(f"{name}: {violation}")
            return 1
    return 0


def _say(text: str) -> None:
    sys.stdout.write(f"{time.strftime('%H:%M:%S')} {text}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
