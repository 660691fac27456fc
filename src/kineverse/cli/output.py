"""Terminal output: colours, plain text tables, progress."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Iterable, Iterator, Sequence, Sized
from contextlib import contextmanager
from typing import Literal, TypeVar

from kineverse.cli.streams import unwrap_stream

_CODES = {"+": "32", "-": "31", "~": "33", ">": "36", "!": "31", "bold": "1"}


def colorize(text: str, style: str) -> str:
    """Return a text in the colour of a sign (``+``, ``-``, ``~``, ``>``, ``!``), or ``bold``.

    The text stays plain if standard output is not a terminal, or the environment has ``NO_COLOR``.
    """
    if not text or not sys.stdout.isatty() or os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb":
        return text
    return f"\033[{_CODES[style]}m{text}\033[0m"


def truncate_lines(lines: Sequence[str], most: int | None, indent: str = "  ") -> list[str]:
    """Return the first ``most`` lines and the number of others; all lines if ``most`` is None."""
    if most is None or len(lines) <= most:
        return list(lines)
    return [*lines[:most], f"{indent}… and {len(lines) - most} more (--all)"]


# Names from files may have line feeds; a row is one line.
_NO_LINES = str.maketrans({"\n": "\\n", "\r": "\\r", "\t": "\\t"})

Align = Literal["<", ">"]


def format_table(
    head: Sequence[str], rows: Iterable[Sequence[str]], align: str = "", width: int | None = None
) -> str:
    """Return rows of cells as lines with aligned columns."""
    cells = [list(head), *([cell.translate(_NO_LINES) for cell in row] for row in rows)]
    sides: list[str] = [align[k] if k < len(align) else "<" for k in range(len(head))]
    widths = [max(len(row[k]) for row in cells) for k in range(len(head))]
    available = (terminal_width() if width is None else width) - sum(widths[1:]) - 2 * (len(head) - 1)
    if widths and widths[0] > available:
        widths[0] = max(available, 12)
    lines = []
    for row in cells:
        row[0] = shorten_text(row[0], widths[0])
        texts = (f"{cell:{side}{w}}" for cell, side, w in zip(row, sides, widths, strict=True))
        lines.append("  ".join(texts).rstrip())
    lines.insert(1, "  ".join("-" * w for w in widths))
    return "\n".join(lines)


def format_markdown(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return rows of cells as a table in Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in row)} |" for row in lines)


def format_cells(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table of names and, aligned to the right, of what is known about them."""
    return format_table(head, rows, "<" + ">" * (len(head) - 1))


def join_lines(message: object) -> str:
    """Return a message, such as an exception, on one line."""
    return " ".join(str(message).split())


def shorten_text(text: str, width: int) -> str:
    """Return a text cut in its middle to a width."""
    if len(text) <= width:
        return text
    left = (width - 3) // 2
    return f"{text[:left]}...{text[len(text) - (width - 3 - left) :]}"


def terminal_width() -> int:
    """Return the columns of the terminal; 10 000 if standard output is not a terminal."""
    return shutil.get_terminal_size().columns if sys.stdout.isatty() else 10_000


Item = TypeVar("Item")


def show_progress(
    items: Iterable[Item], what: str, unit: str = "", total: int | None = None
) -> Iterator[Item]:
    """Yield the items, with a bar on standard error if that is a terminal."""
    if not sys.stderr.isatty():
        yield from items
        return
    from tqdm import tqdm

    if isinstance(items, Sized):
        total = len(items)
    # The stream of commands would escape the moves of the cursor.
    yield from tqdm(
        items,
        file=unwrap_stream(sys.stderr),
        desc=what,
        total=total,
        unit=f" {unit}" if unit else "it",
        leave=False,
    )


@contextmanager
def show_activity(what: str) -> Iterator[None]:
    """Print an activity on standard error while it lasts, if that is a terminal."""
    if not sys.stderr.isatty():
        yield
        return
    print(f"{what} ...", end="", file=sys.stderr, flush=True)
    try:
        yield
    finally:
        print("\r\033[K", end="", file=sys.stderr, flush=True)


def print_line(text: str) -> None:
    """Print a line on standard error, in the place of an activity that is shown there."""
    clear = "\r\033[K" if sys.stderr.isatty() else ""
    print(f"{clear}{text}", file=sys.stderr, flush=True)
