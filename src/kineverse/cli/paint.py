"""Colours on a terminal, plain text everywhere else."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

_CODES = {"+": "32", "-": "31", "~": "33", ">": "36", "!": "31", "bold": "1"}


def paint(text: str, style: str) -> str:
    """Return a text in the colour of a sign (``+``, ``-``, ``~``, ``>``, ``!``), or ``bold``.

    Plain if standard output is no terminal, or the environment has ``NO_COLOR``.
    """
    if not text or not sys.stdout.isatty() or os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb":
        return text
    return f"\033[{_CODES[style]}m{text}\033[0m"


def bounded(lines: Sequence[str], most: int | None, indent: str = "  ") -> list[str]:
    """Return the first so many lines, and how many more there are; all of them if ``most`` is None."""
    if most is None or len(lines) <= most:
        return list(lines)
    return [*lines[:most], f"{indent}… and {len(lines) - most} more (--all)"]
