"""Terminal output: colours, plain text tables, progress."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Iterable, Iterator, Sequence, Sized
from contextlib import contextmanager
from typing import Literal, TypeVar

_CODES = {"+": "32", "-": "31", "~": "33", ">": "36", "!": "31", "bold": "1"}


def colorize(text: str, style: str) -> str:
    """Return a text in the colour of a sign (``+``, ``-``, ``~``, ``>``, ``!``), or ``bold``.

    Plain if standard output is no terminal, or the environment has ``NO_COLOR``.
    """
    if not text or not sys.stdout.isatty() or os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb":
        return text
    return f"\033[{_CODES[style]}m{text}\033[0m"


def truncate_lines(lines: Sequence[str], most: int | None, indent: str = "  ") -> list[str]:
    """Return the first ``most`` lines and the number of the rest; all lines if ``most`` is None."""
    if most is None or len(lines) <= most:
        return list(lines)
    return [*lines[:most], f"{indent}… and {len(lines) - most} more (--all)"]


Align = Literal["<", ">"]


def format_table(
    head: Sequence[str], rows: Iterable[Sequence[str]], align: str = "", width: int | None = None
) -> str:
    """Return rows of cells as lines with aligned columns.

    Parameters
    ----------
    head
        The titles of the columns.
    rows
        The cells.
    align
        A ``<`` or ``>`` for each column; left if missing.
    width
        The width of the screen; the terminal's if None. If the table is wider, its first column is cut in the
        middle, where names of frames differ least. In a pipe nothing is ever cut.
    """
    cells = [list(head), *(list(row) for row in rows)]
    sides: list[str] = [align[k] if k < len(align) else "<" for k in range(len(head))]
    widths = [max(len(row[k]) for row in cells) for k in range(len(head))]
    room = (terminal_width() if width is None else width) - sum(widths[1:]) - 2 * (len(head) - 1)
    if widths and widths[0] > room:
        widths[0] = max(room, 12)
    lines = []
    for row in cells:
        row[0] = shorten_text(row[0], widths[0])
        texts = (f"{cell:{side}{w}}" for cell, side, w in zip(row, sides, widths, strict=True))
        lines.append("  ".join(texts).rstrip())
    lines.insert(1, "  ".join("-" * w for w in widths))
    return "\n".join(lines)


def shorten_text(text: str, width: int) -> str:
    """Return a text cut in its middle to a width."""
    if len(text) <= width:
        return text
    left = (width - 3) // 2
    return f"{text[:left]}...{text[len(text) - (width - 3 - left) :]}"


def terminal_width() -> int:
    """Return the columns of the terminal; practically no limit where the output is not read on one."""
    import sys

    return shutil.get_terminal_size().columns if sys.stdout.isatty() else 10_000


Item = TypeVar("Item")


def show_progress(
    items: Iterable[Item], what: str, unit: str = "", total: int | None = None
) -> Iterator[Item]:
    """Yield the items, with a bar on standard error if that is a terminal.

    Parameters
    ----------
    items
        What is worked on.
    what
        What is being done, in front of the bar.
    unit
        What is counted.
    total
        How many items there are, if they cannot say so themselves.
    """
    if not sys.stderr.isatty():
        yield from items
        return
    from tqdm import tqdm

    if isinstance(items, Sized):
        total = len(items)
    yield from tqdm(items, desc=what, total=total, unit=f" {unit}" if unit else "it", leave=False)


@contextmanager
def show_activity(what: str) -> Iterator[None]:
    """Show an activity on standard error while it lasts, if that is a terminal."""
    if not sys.stderr.isatty():
        yield
        return
    print(f"{what} ...", end="", file=sys.stderr, flush=True)
    try:
        yield
    finally:
        print("\r\033[K", end="", file=sys.stderr, flush=True)
