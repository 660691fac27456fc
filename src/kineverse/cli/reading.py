"""Options of the commands that load models."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import kineverse as kv


def add_reading_options(
    parser: argparse.ArgumentParser, strict: str = "refuse what is otherwise read with a remark"
) -> None:
    """Declare ``--root``, ``--loops`` and ``--strict``, which means ``strict``."""
    parser.add_argument(
        "--root",
        metavar="FOLDER",
        help="the folder below which it may open files, meshes and included ones (its package or repository)",
    )
    parser.add_argument(
        "--loops",
        choices=("solve", "constraint", "refuse"),
        default="solve",
        help="what becomes of closed loops: solved where that can be done (the default), all kept as "
        "equality constraints, or refused where one cannot be solved",
    )
    parser.add_argument("--strict", action="store_true", help=strict)


def load(arguments: argparse.Namespace, source: str, prefix: str | None = None) -> kv.Model:
    """Load a model as the options say.

    Raises
    ------
    KineverseError
        If it cannot be loaded.
    """
    import kineverse as kv

    return kv.load(source, prefix, root=arguments.root, strict=arguments.strict, loops=arguments.loops)
