"""``kineverse cache``: what is kept on the disk to be fast, and its removal."""

from __future__ import annotations

import argparse
import json
import time
from typing import Any

from kineverse.compilation.cache import cache_folder
from kineverse.compilation.cache_kinds import KINDS, CacheUsage, clear_kind, measure_kind
from kineverse.errors import UnknownNameError, suggest

from .output import format_bytes, format_count, format_table

HELP = f"""\
Compiled functions, hulls, sphere covers and meshes of model servers are kept in a folder of this user:
KINEVERSE_CACHE_DIR, else kineverse in XDG_CACHE_HOME, else ~/.cache/kineverse. Everything there is made again
when it is needed, so that it may be removed at any time, also while Kineverse runs.

A kind that reaches its limit loses the files that were not used for the longest time. The kinds are
{", ".join(KINDS)}.

examples:
  kineverse cache
  kineverse cache --clear                     all kinds
  kineverse cache --clear libraries zig"""

PERIODS = ((86400, "day"), (3600, "hour"), (60, "minute"))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--clear",
        metavar="KIND",
        nargs="*",
        action="extend",
        help="remove the files of these kinds; of all if none is named",
    )
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output")


def run(arguments: argparse.Namespace) -> int:
    """Print the kinds, or clear them."""
    for name in arguments.clear or ():
        if name not in KINDS:
            raise UnknownNameError(
                f"There is no kind {name!r} of cached files. {suggest(name, KINDS, 'kind')}"
            )
    is_cleared = arguments.clear is not None
    names = dict.fromkeys(arguments.clear or KINDS)
    found = {name: clear_kind(name) if is_cleared else measure_kind(name) for name in names}
    files, size = sum(usage.files for usage in found.values()), sum(usage.bytes for usage in found.values())
    folder = cache_folder()
    if arguments.json:
        kinds = {name: _to_json(usage) for name, usage in found.items()}
        print(json.dumps({"folder": str(folder), "removed" if is_cleared else "kinds": kinds}))
    elif is_cleared:
        for name, usage in found.items():
            if usage.files:
                print(f"{name}: {format_count(usage.files, 'file')} removed, {format_bytes(usage.bytes)}")
        print(f"{format_count(files, 'file')} removed from {folder}, {format_bytes(size)}")
    else:
        head = ("kind", "contents", "files", "size", "limit", "last use")
        print(format_table(head, [_format_row(name, usage) for name, usage in found.items()], "<<>>><"))
        print(f"{format_count(files, 'file')}, {format_bytes(size)} in {folder}")
    return 0


def format_last_use(moment: float) -> str:
    """Return how long ago a moment [s since 1970] was, in whole days, hours or minutes."""
    age = max(time.time() - moment, 0.0)
    for seconds, unit in PERIODS:
        if age >= seconds:
            return f"{format_count(int(age // seconds), unit)} ago"
    return "now"


def _format_row(name: str, usage: CacheUsage) -> tuple[str, ...]:
    limit = "none" if usage.kind.most_bytes is None else format_bytes(usage.kind.most_bytes)
    used = ""
    if usage.oldest is not None and usage.newest is not None:
        oldest, newest = format_last_use(usage.oldest), format_last_use(usage.newest)
        used = newest if oldest == newest else f"{oldest} to {newest}"
    return name, usage.kind.contents, str(usage.files), format_bytes(usage.bytes), limit, used


def _to_json(usage: CacheUsage) -> dict[str, Any]:
    return {
        "contents": usage.kind.contents,
        "folder": str(usage.folder),
        "files": usage.files,
        "bytes": usage.bytes,
        "limit": usage.kind.most_bytes,
        "oldest_use": usage.oldest,
        "newest_use": usage.newest,
    }
