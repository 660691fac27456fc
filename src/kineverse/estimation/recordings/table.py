"""Tables of texts: files of several programs, data frames, and arrays."""

from __future__ import annotations

import csv
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from kineverse.errors import FormatError
from kineverse.formats.files import read_file

from .columns import POSITION, UNITS, parse_column
from .recording import Indices

_SECTIONS = ("Segments", "Objects", "Trajectories")  # of a Vicon file, the preferred one first
_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+([eE][-+]?\d+)?")


@dataclass(frozen=True, eq=False)
class Table:
    """Cells of a table."""

    source: str  # name in messages
    head: list[str] | None  # column names; None if there are none
    lines: Indices  # line number of each row, from 1
    cells: Any  # texts (N, M)
    assumed: tuple[str, ...] = ()


def is_number(text: str) -> bool:
    """Return True if a text is a number, including NaN and infinities."""
    try:
        float(text)
    except ValueError:
        return False
    return "_" not in text  # Python also reads digits grouped by underscores


def convert_frame(data: Any) -> Table:
    """Return the cells of a data frame, a structured array, or an array (N, M)."""
    if (names := getattr(data, "columns", None)) is not None:
        columns = [np.asarray(data[name]) for name in names]
        names = [".".join(map(str, name)) if isinstance(name, tuple) else str(name) for name in names]
        if index := getattr(getattr(data, "index", None), "name", None):
            names, columns = [str(index), *names], [np.asarray(data.index), *columns]
    else:
        array = np.asarray(data)
        names = [*array.dtype.names] if array.dtype.names else None
        columns = [array[name] for name in names] if names else [*np.atleast_2d(array).T]
    if not columns or any(column.ndim != 1 for column in columns) or not len(columns[0]):
        raise FormatError("The table needs rows, with one number or text in each cell.")
    texts = [(c.astype(str) if c.dtype.kind == "M" else c).tolist() for c in columns]
    cells = np.array([[*map(str, column)] for column in texts], dtype=object).T
    return Table("the table", names, np.arange(1, len(cells) + 1), cells)


def read_table(path: Path) -> Table:
    """Read a table with cells separated by commas, semicolons, tabs or spaces.

    Empty lines and lines that begin with ``#`` or ``%`` are skipped. The head is the first other line if it
    has names, or else the last of the skipped ones above the numbers.
    """
    source, data = str(path), read_file(path)
    wanted = "poses are read from a table in text"
    if b"\0" in data:
        raise FormatError(f"{source}: this is no text, or not in UTF-8; {wanted}.")
    try:
        texts = [text.strip(" ") for text in data.decode("utf-8-sig").splitlines()]
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise FormatError(f"{source}, line {line}: this is no text in UTF-8; {wanted}.") from None
    start, end, bare = 0, len(texts), [text.strip(",;\t ") for text in texts]
    if section := next((name for name in _SECTIONS if name in bare), None):
        start = bare.index(section)
        end = next((k for k in range(start, end) if not bare[k]), end)
    lines = [
        k for k in range(start, end) if texts[k].strip() and not texts[k].startswith(("#", "%", "//", "sep="))
    ]
    if not lines:
        raise FormatError(f"{source}: the file is empty; a row for each pose is expected.")
    last = [texts[k] for k in lines[-20:]]
    separator = max((";", "\t", ",", None), key=lambda mark: _count_cells(last, mark))
    rows = dict(zip(lines, (_split(texts[k], separator) for k in lines), strict=True))
    head, top = None, next((k for k in lines[1:12] if rows[k][0].lower() == "frame"), lines[0])
    if top > lines[0] and (section or rows[lines[0]][0] == "Format Version"):
        stacked = [rows.pop(k) for k in lines if k <= top]
        count = max(map(len, [*stacked, *rows.values()]))
        stacked = [row + [""] * (count - len(row)) for row in stacked]
        head = _join_vicon_head(stacked) if section else _join_motive_head(stacked)
        if section:  # the first column counts frames
            rate = next((float(row[0]) for row in stacked if is_number(row[0])), 1.0)
            for row in rows.values():
                row[0] = str(float(row[0]) / rate) if is_number(row[0]) else row[0]
    elif not _is_data(rows[top := lines[0]]):
        head = rows.pop(top)
    elif comments := [k for k in range(lines[0]) if texts[k].startswith(("#", "%"))]:
        names = _split(texts[comments[-1]].lstrip("# "), separator)
        if len(names) == len(rows[top]) and any(parse_column(n, source).quantity in POSITION for n in names):
            head = names
    if head and rows and _are_units(units := rows[next(iter(rows))]):
        head = [f"{name} [{unit}]" if unit else name for name, unit in zip(head, units, strict=False)]
        del rows[next(iter(rows))]
    if not rows:
        raise FormatError(f"{source}: there are names of columns, but no row below them.")
    count = len(rows[top] if head is None else head)
    for k, row in rows.items():
        while len(row) > count and not row[-1]:  # separators at the end of the line
            row.pop()
        if len(row) != count:
            cells = f"{len(row)} cell{'s' * (len(row) != 1)}"
            raise FormatError(f"{source}, line {k + 1}: {cells}, where line {top + 1} has {count}.")
    table = np.array([*rows.values()], dtype=object).reshape(len(rows), count)
    assumed: tuple[str, ...] = ()
    if separator != "," and any("," in texts[k] for k in rows):
        has_comma = np.vectorize(lambda cell: bool(_DECIMAL_COMMA.fullmatch(cell)), otypes=[bool])(table)
        if has_comma.any() and not any("." in cell and is_number(cell) for cell in table.flat):
            table[has_comma] = [cell.replace(",", ".") for cell in table[has_comma]]
            assumed = ("decimal commas",)
    return Table(source, head, np.array([*rows], dtype=np.intp) + 1, table, assumed)


def _split(text: str, separator: str | None) -> list[str]:
    if separator is None:
        return re.split(r"\s+(?![\[(])", text) if "[" in text or "(" in text else text.split()
    return [cell.strip() for cell in next(csv.reader([text], delimiter=separator, skipinitialspace=True))]


def _count_cells(texts: list[str], separator: str | None) -> tuple[int, int]:
    """Return how many cells are numbers, and how many cells there are."""
    cells = [cell for text in texts for cell in _split(text, separator)]
    return sum(is_number(cell) or bool(_DECIMAL_COMMA.fullmatch(cell)) for cell in cells), len(cells)


def _is_data(row: list[str]) -> bool:
    numbers = sum(is_number(cell) or bool(_DECIMAL_COMMA.fullmatch(cell)) for cell in row)
    return numbers >= 3 or numbers == sum(map(bool, row))


def _are_units(row: list[str]) -> bool:
    known = {unit for units in UNITS.values() for unit in units}
    return any(row) and all(cell.strip("[]()").lower() in known for cell in row if cell)


def _join_vicon_head(rows: list[list[str]]) -> list[str]:
    """Return the column names of a section: a row of parts above a row of axes."""
    *_, parts, axes = rows
    names: list[str] = []
    for part in parts:  # named above its first column
        subject, _, segment = part.partition(":")
        names.append((subject if subject == segment else part) or (names[-1] if names else ""))
    named = zip(names[1:], axes[1:], strict=True)
    return ["time", *(f"{name}.{axis}" if name else "-" for name, axis in named)]


def _join_motive_head(rows: list[list[str]]) -> list[str]:
    """Return the column names of OptiTrack Motive: rows of types, names, quantities and axes."""
    settings = dict(zip(rows[0][::2], rows[0][1::2], strict=False))
    unit = settings.get("Length Units", "").lower()
    types, names = (next((row for row in rows if row[1] == title), rows[-1]) for title in ("Type", "Name"))
    head = ["-", "time [s]"]
    for kind, part, quantity, axis in [*zip(types, names, rows[-2], rows[-1], strict=True)][2:]:
        is_wanted = axis and quantity in ("Position", "Rotation") and kind != "Rigid Body Marker"
        of_unit = f" [{unit}]" if quantity == "Position" and unit else ""
        head.append(f"{part}.{quantity}.{axis}{of_unit}" if is_wanted else "-")
    return head
