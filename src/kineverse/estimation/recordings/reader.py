"""Reader of pose tables (CSV and the like)."""

from __future__ import annotations

import csv
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kineverse.errors import FormatError
from kineverse.estimation.recordings.columns import (
    COLUMN_HELP,
    UNNAMED_COLUMNS,
    Columns,
    PartColumns,
    parse_columns,
)
from kineverse.estimation.recordings.recording import Indices, RecordedTrack, Recording
from kineverse.formats.files import read_file
from kineverse.formats.xml_values import LARGEST
from kineverse.lie import Array, exp_so3, quaternion, rpy, transform

COMMENT = "#"


@dataclass(frozen=True)
class TextTable:
    """Text cells of a table file."""

    source: str  # name of the file in messages
    head: tuple[str, ...] | None  # column names; None if the file begins with numbers
    lines: tuple[int, ...]  # line number of each row, counted from 1
    cells: tuple[tuple[str, ...], ...]  # texts of each row, equally many in each


def read_table(path: Path) -> TextTable:
    """Read a table with cells separated by commas, semicolons, tabs or spaces.

    Empty lines and lines that begin with ``#`` are skipped. The first other line is the head if one of its
    cells is not a number. It also determines the separator: a semicolon if it has one, else a comma, else a
    tab in a head, else spaces.
    """
    source = str(path)
    found = [
        (line, text)
        for line, text in enumerate(_read_text(path, source).splitlines(), start=1)
        if text.strip() and not text.lstrip().startswith(COMMENT)
    ]
    if not found:
        raise FormatError(f"{source}: the file is empty; a row for each pose is expected.")
    separator = next((mark for mark in ";,\t" if mark in found[0][1]), None)
    if separator == "\t" and all(map(is_number, found[0][1].split())):
        separator = None  # numeric columns, aligned by tabs and spaces
    first = _split_cells(found[0][1], separator)
    has_head = not all(map(is_number, filter(None, first)))
    split = [(line, _split_cells(text, separator)) for line, text in found]
    for line, cells in split:
        if len(cells) != len(first):
            raise FormatError(
                f"{source}, line {line}: {_count_text(len(cells))}, where line {found[0][0]} has "
                f"{len(first)}."
            )
    body = split[1:] if has_head else split
    if not body:
        raise FormatError(f"{source}: there are names of columns, but no row below them.")
    head = tuple(first) if has_head else None
    return TextTable(source, head, tuple(line for line, _ in body), tuple(tuple(cells) for _, cells in body))


def is_number(text: str) -> bool:
    """Return True if a text is a number, including NaN and infinities."""
    # Python also reads digits grouped by underscores.
    if "_" in text:
        return False
    try:
        float(text)
    except ValueError:
        return False
    return True


def _read_text(path: Path, source: str) -> str:
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


def _split_cells(text: str, separator: str | None) -> list[str]:
    if separator is None:
        return text.split()
    return [cell.strip() for cell in next(csv.reader([text], delimiter=separator, skipinitialspace=True))]


def _count_text(count: int) -> str:
    return f"{count} cell{'' if count == 1 else 's'}"


QUATERNION_TOLERANCE = 0.01
"""Largest accepted deviation of a quaternion's length from one; two digits suffice."""


def read_recording(path: str | os.PathLike[str], columns: str | Sequence[str] | None = None) -> Recording:
    """Read a table of poses.

    A head names the columns: ``time``, ``part``, ``x``, ``y``, ``z``, and an orientation. The orientation is
    a quaternion ``qx``, ``qy``, ``qz``, ``qw``, or ``roll``, ``pitch``, ``yaw`` about fixed axes, or a
    rotation vector ``rx``, ``ry``, ``rz``. Units are [m], [rad] and [s] unless a name says otherwise, as in
    ``x [mm]``. A row has one part, or all parts with columns such as ``door.x``. Empty cells mark a part that
    was not observed. Without a head, three columns are positions and seven are positions and quaternions.

    Parameters
    ----------
    path
        Text file with cells separated by commas, semicolons, tabs or spaces; ``#`` begins a comment.
    columns
        Column names that replace the head; ``-`` skips a column. A sequence, or one text separated by commas.

    Raises
    ------
    FormatError
        If the table is malformed or has an invalid number: NaN, a quaternion that is not of unit length, or a
        time that does not increase. The message names the line.
    """
    table = read_table(Path(path))
    named = columns.split(",") if isinstance(columns, str) else columns
    given = _choose_columns(table, None if named is None else [name.strip() for name in named])
    tracks = {
        part or name: _build_track(table, given, where, rows)
        for part, where in given.parts.items()
        for name, rows in _rows_by_part(table, given, where).items()
    }
    empty = [name for name, track in tracks.items() if not len(track)]
    if len(empty) == len(tracks):
        raise FormatError(f"{table.source}: nothing was seen in any row.")
    return Recording(table.source, {k: t for k, t in tracks.items() if len(t)}, given.ignored)


def _choose_columns(table: TextTable, named: Sequence[str] | None) -> Columns:
    count = len(table.cells[0])
    if named is not None:
        if len(named) != count:
            raise FormatError(
                f"{table.source} has {count} columns, and {len(named)} names were given for them: "
                f"{','.join(named)}. A column that is not wanted is called '-'."
            )
        return parse_columns(named, "The names of the columns")
    if table.head is not None:
        return parse_columns(table.head, f"{table.source}, line 1" if table.lines[0] == 2 else table.source)
    if count not in UNNAMED_COLUMNS:
        raise FormatError(
            f"{table.source}: {count} columns without names. 3 are taken for {UNNAMED_COLUMNS[3]} and 7 for "
            f"{UNNAMED_COLUMNS[7]}; otherwise say what they are (--columns). {COLUMN_HELP}"
        )
    return parse_columns(UNNAMED_COLUMNS[count].split(","), table.source)


def _rows_by_part(table: TextTable, columns: Columns, where: PartColumns) -> dict[str, Indices]:
    """Return the rows in which each part was observed, by its name."""
    seen: dict[str, list[int]] = {}
    for row, cells in enumerate(table.cells):
        name = cells[columns.part] if columns.part is not None else ""
        if columns.part is not None and not name:
            raise FormatError(f"{table.source}, line {table.lines[row]}: the name of the part is missing.")
        filled = [bool(cells[k]) for k in (*where.position, *where.orientation)]
        if any(filled) and not all(filled):
            lacking = [k for k in (*where.position, *where.orientation) if not cells[k]]
            raise FormatError(
                f"{table.source}, line {table.lines[row]}: {columns.names[lacking[0]]} is missing; all "
                "cells of a part that was not seen are left empty."
            )
        rows = seen.setdefault(name, [])
        if all(filled):
            rows.append(row)
    return {name: np.array(rows, dtype=np.intp) for name, rows in seen.items()}


def _build_track(table: TextTable, columns: Columns, where: PartColumns, rows: Indices) -> RecordedTrack:
    lines = np.array(table.lines, dtype=np.intp)[rows]
    poses = _parse_numbers(table, columns, where.position, rows)
    if where.form:
        poses = transform(_rotations(table, columns, where, rows), poses)
    times = None
    if columns.time is not None:
        times = _parse_numbers(table, columns, (columns.time,), rows)[:, 0]
        _check_order(table, times, lines)
    return RecordedTrack(poses, rows, lines, times)


def _parse_numbers(table: TextTable, columns: Columns, places: Sequence[int], rows: Indices) -> Array:
    """Return the cells of some columns as numbers, (N, len(places))."""
    texts = [[table.cells[row][k] for k in places] for row in rows]
    try:
        numbers = np.array(texts, dtype=np.float64).reshape(len(rows), len(places))
        good = np.abs(numbers) <= LARGEST  # NaN is not
        good &= np.array(["_" not in text for row in texts for text in row], dtype=bool).reshape(good.shape)
    except ValueError:
        good = np.array([[is_number(text) for text in row] for row in texts])
    if not good.all():
        row, k = np.argwhere(~good)[0]
        text, name = texts[row][k], columns.names[places[k]]
        hint = " A decimal point is expected." if "," in text else ""
        hint = " Leave all cells of a part empty that was not seen." if text.lower() == "nan" else hint
        raise FormatError(
            f"{table.source}, line {table.lines[rows[row]]}: {name} is '{text[:40]}', which is no finite "
            f"number.{hint}"
        )
    scaled: Array = numbers * np.array([columns.factors.get(k, 1.0) for k in places])
    return scaled


def _rotations(table: TextTable, columns: Columns, where: PartColumns, rows: Indices) -> Array:
    """Return (N, 3, 3)."""
    numbers = _parse_numbers(table, columns, where.orientation, rows)
    if where.form == "quaternion":
        lengths = np.linalg.norm(numbers, axis=1)
        off = np.abs(lengths - 1.0)
        if off.size and off.max() > QUATERNION_TOLERANCE:
            worst = int(np.argmax(off > QUATERNION_TOLERANCE))
            raise FormatError(
                f"{table.source}, line {table.lines[rows[worst]]}: the quaternion has the length "
                f"{lengths[worst]:.4g}, which is off by {off[worst]:.2g}; "
                f"{int((off > QUATERNION_TOLERANCE).sum())} of {len(off)} are not of unit length."
            )
        return quaternion(numbers)
    return rpy(numbers) if where.form == "rpy" else exp_so3(numbers)


def _check_order(table: TextTable, times: Array, lines: Indices) -> None:
    wrong = np.flatnonzero(np.diff(times) <= 0.0)
    if not wrong.size:
        return
    k = int(wrong[0])
    how = "the same time as" if times[k + 1] == times[k] else "earlier than"
    raise FormatError(
        f"{table.source}, line {lines[k + 1]}: {times[k + 1]:.10g} s is {how} line {lines[k]} of the same "
        f"part ({times[k]:.10g} s). Rows are expected in the order of their times."
    )
