"""Text files as rows of cells, each with the number of its line."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

from kineverse.errors import FormatError
from kineverse.formats.files import read_file

COMMENT = "#"


@dataclass(frozen=True)
class Rows:
    """The cells of a file.

    Attributes
    ----------
    source
        What the file is called in messages.
    head
        The names of the columns, None if the file begins with numbers.
    lines
        The number of each row's line, counted from 1.
    cells
        The texts of each row, as many in each.
    """

    source: str
    head: tuple[str, ...] | None
    lines: tuple[int, ...]
    cells: tuple[tuple[str, ...], ...]


def read_rows(path: Path) -> Rows:
    """Read a table whose cells are separated by commas, semicolons, tabs or spaces.

    Empty lines are skipped, and those that begin with ``#``. The first other line is the head if a cell of it
    is no number. It also tells the separator: a semicolon if it has one, else a comma, else a tab in a head,
    else spaces.

    Raises
    ------
    FormatError
        If there is no such file, it is no text, it is empty, or a row has more or fewer cells than others.
    """
    source = str(path)
    found = [
        (line, text)
        for line, text in enumerate(_text(path, source).splitlines(), start=1)
        if text.strip() and not text.lstrip().startswith(COMMENT)
    ]
    if not found:
        raise FormatError(f"{source}: the file is empty; a row for each pose is expected.")
    separator = next((mark for mark in ";,\t" if mark in found[0][1]), None)
    if separator == "\t" and all(map(spells_number, found[0][1].split())):
        separator = None  # columns of numbers, aligned by tabs and spaces
    first = _cells(found[0][1], separator)
    has_head = not all(map(spells_number, filter(None, first)))
    split = [(line, _cells(text, separator)) for line, text in found]
    for line, cells in split:
        if len(cells) != len(first):
            raise FormatError(
                f"{source}, line {line}: {_counted(len(cells))}, where line {found[0][0]} has {len(first)}."
            )
    body = split[1:] if has_head else split
    if not body:
        raise FormatError(f"{source}: there are names of columns, but no row below them.")
    head = tuple(first) if has_head else None
    return Rows(source, head, tuple(line for line, _ in body), tuple(tuple(cells) for _, cells in body))


def spells_number(text: str) -> bool:
    """Return whether a text is a number, NaN and infinities included."""
    # Python also reads digits grouped by underscores.
    if "_" in text:
        return False
    try:
        float(text)
    except ValueError:
        return False
    return True


def _text(path: Path, source: str) -> str:
    data = read_file(path)
    if b"\0" in data:
        raise FormatError(f"{source}: this is no text, or not in UTF-8; poses are read from a table in text.")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise FormatError(
            f"{source}, line {line}: this is no text in UTF-8; poses are read from a table in text."
        ) from None


def _cells(text: str, separator: str | None) -> list[str]:
    if separator is None:
        return text.split()
    return [cell.strip() for cell in next(csv.reader([text], delimiter=separator, skipinitialspace=True))]


def _counted(count: int) -> str:
    return f"{count} cell{'' if count == 1 else 's'}"
