"""Plain text tables."""

from __future__ import annotations

import math
import shutil
from collections.abc import Iterable, Sequence
from typing import Literal

Align = Literal["<", ">"]


def table(
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
    room = (screen_width() if width is None else width) - sum(widths[1:]) - 2 * (len(head) - 1)
    if widths and widths[0] > room:
        widths[0] = max(room, 12)
    lines = []
    for row in cells:
        row[0] = shortened(row[0], widths[0])
        texts = (f"{cell:{side}{w}}" for cell, side, w in zip(row, sides, widths, strict=True))
        lines.append("  ".join(texts).rstrip())
    lines.insert(1, "  ".join("-" * w for w in widths))
    return "\n".join(lines)


def shortened(text: str, width: int) -> str:
    """Return a text cut in its middle to a width."""
    if len(text) <= width:
        return text
    left = (width - 3) // 2
    return f"{text[:left]}...{text[len(text) - (width - 3 - left) :]}"


def screen_width() -> int:
    """Return the columns of the terminal; practically no limit where the output is not read on one."""
    import sys

    return shutil.get_terminal_size().columns if sys.stdout.isatty() else 10_000


def figure(value: float, digits: int = 4) -> str:
    """Return a number in few digits; an absent limit as ``-``."""
    if math.isinf(value):
        return "-"
    text = f"{value:.{digits}g}"
    return "0" if float(text) == 0.0 else text
