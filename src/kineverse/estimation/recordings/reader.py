"""Reader of pose tables (CSV and the like): columns, units, rows."""

from __future__ import annotations

import csv
import math
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType

import numpy as np

from kineverse.errors import FormatError
from kineverse.formats.files import read_file
from kineverse.formats.xml_values import LARGEST
from kineverse.lie import Array, exp_so3, quaternion, rpy, transform

from .recording import Indices, RecordedTrack, Recording

POSITION = ("x", "y", "z")
ORIENTATIONS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "quaternion": ("qx", "qy", "qz", "qw"),
        "rpy": ("roll", "pitch", "yaw"),
        "rotation vector": ("rx", "ry", "rz"),
    }
)
"""Representations of an orientation, with their columns."""

TIME, PART, SKIP = "time", "part", "-"
SYNONYMS: Mapping[str, str] = MappingProxyType(
    dict.fromkeys(("t", "stamp", "timestamp"), TIME)
    | dict.fromkeys(("name", "link", "body", "object", "frame", "child_frame_id"), PART)
)

_LENGTHS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
_ANGLES = {"rad": 1.0, "deg": math.pi / 180.0, "°": math.pi / 180.0}
_TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
UNITS: Mapping[str, Mapping[str, float]] = MappingProxyType(
    {TIME: _TIMES}
    | dict.fromkeys(POSITION, _LENGTHS)
    | dict.fromkeys(ORIENTATIONS["rpy"] + ORIENTATIONS["rotation vector"], _ANGLES)
)
"""Units of each quantity; the first is the default."""

QUANTITIES = (TIME, PART, *POSITION, *(name for names in ORIENTATIONS.values() for name in names))
UNNAMED_COLUMNS: Mapping[int, str] = MappingProxyType({3: "x,y,z", 7: "x,y,z,qx,qy,qz,qw"})
"""Column names of a table without a head, by number of columns."""

COLUMN_HELP = (
    "Known are time, part, x, y, z, and qx, qy, qz, qw or roll, pitch, yaw or rx, ry, rz (a rotation "
    "vector), with a unit as in 'x [mm]', and for several parts in a row a name before them, as in 'door.x'."
)

_WITH_UNIT = re.compile(r"(?P<name>.*?)\s*(?:[\[(]\s*(?P<unit>[^\[\]()]*?)\s*[\])])?")


@dataclass(frozen=True)
class PartColumns:
    """Columns of one part."""

    position: tuple[int, ...]  # columns of x, y and z
    orientation: tuple[int, ...] = ()  # columns of the orientation; empty if there is none
    form: str = ""  # one of ORIENTATIONS, or ""


@dataclass(frozen=True)
class Columns:
    """Columns of a table by meaning."""

    names: tuple[str, ...]  # names as given
    parts: Mapping[str, PartColumns]  # columns of each part by name; the name is "" if columns name no part
    time: int | None = None
    part: int | None = None  # of the part's name; None if there are none
    factors: Mapping[int, float] = field(default_factory=dict)
    ignored: tuple[str, ...] = ()  # names without meaning


def parse_columns(names: Sequence[str], where: str) -> Columns:
    """Parse column names."""
    places: dict[tuple[str, str], int] = {}
    factors: dict[int, float] = {}
    ignored: list[str] = []
    for index, name in enumerate(names):
        part, quantity, factor = _parse_column(name, where)
        if not quantity:
            ignored += [name] if name not in ("", SKIP) else []
            continue
        if (part, quantity) in places:
            raise FormatError(f"{where}: the column '{name}' is there twice.")
        places[part, quantity] = index
        if factor != 1.0:
            factors[index] = factor
    time, row_part = places.get(("", TIME)), places.get(("", PART))
    owners = dict.fromkeys(part for part, quantity in places if quantity not in (TIME, PART))
    if not owners:
        raise FormatError(
            f"{where}: no column is a position; the columns are {_format_list(names)}. {COLUMN_HELP}"
        )
    if row_part is not None and set(owners) != {""}:
        raise FormatError(
            f"{where}: a part is named in each row, and in the names of columns too "
            f"('{next(filter(None, owners))}'); one or the other."
        )
    if "" in owners and len(owners) > 1:
        named = next(filter(None, owners))
        raise FormatError(f"{where}: some columns belong to a part ('{named}'), others such as 'x' to none.")
    parts = {part: _parse_part(part, places, where, ignored) for part in owners}
    return Columns(tuple(names), parts, time, row_part, factors, tuple(ignored))


def _parse_column(name: str, where: str) -> tuple[str, str, float]:
    """Return part, quantity and factor of a column; the quantity is empty if the name has no meaning."""
    match = _WITH_UNIT.fullmatch(name.strip())
    assert match is not None  # all parts of the pattern are optional
    part, quantity = "", match["name"]
    found = re.fullmatch(r"(.*)[./:]([^./:]*)", match["name"])
    if found:
        part, quantity = found[1].strip(), found[2].strip()
    quantity = quantity.lower()
    quantity = SYNONYMS.get(quantity, quantity)
    if quantity not in QUANTITIES or (part and quantity == PART):
        return "", "", 1.0
    if quantity == TIME:
        part = ""
    unit = match["unit"]
    if unit is None:
        return part, quantity, 1.0
    units = UNITS.get(quantity, {})
    if unit not in units:
        known = f"Known are {', '.join(units)}." if units else "It has none."
        raise FormatError(f"{where}: the column '{name}' has the unit '{unit}'. {known}")
    return part, quantity, units[unit]


def _parse_part(
    part: str, places: Mapping[tuple[str, str], int], where: str, ignored: Iterable[str]
) -> PartColumns:
    position = _find_columns(part, POSITION, places, where, ignored)
    if not position:
        raise FormatError(f"{where}: {_describe_owner(part)} an orientation, but no position x, y, z.")
    forms = {
        form: found
        for form, names in ORIENTATIONS.items()
        if (found := _find_columns(part, names, places, where, ignored))
    }
    if len(forms) > 1:
        raise FormatError(
            f"{where}: {_describe_owner(part)} its orientation twice, as {' and '.join(forms)}."
        )
    for form, found in forms.items():
        return PartColumns(position, found, form)
    return PartColumns(position)


def _find_columns(
    part: str,
    quantities: tuple[str, ...],
    places: Mapping[tuple[str, str], int],
    where: str,
    ignored: Iterable[str],
) -> tuple[int, ...]:
    """Return the columns of quantities that belong together; none if all are missing."""
    found = [places.get((part, quantity)) for quantity in quantities]
    missing = [quantity for quantity, place in zip(quantities, found, strict=True) if place is None]
    if len(missing) == len(quantities):
        return ()
    if missing:
        others = list(ignored)
        hint = f" Not understood: {_format_list(others)}." if others else ""
        raise FormatError(
            f"{where}: {_describe_owner(part)} no column {', '.join(missing)}.{hint} {COLUMN_HELP}"
        )
    return tuple(place for place in found if place is not None)


def _describe_owner(part: str) -> str:
    return f"the part '{part}' has" if part else "the table has"


def _format_list(names: Sequence[str]) -> str:
    shown = ", ".join(f"'{name}'" for name in names[:12])
    return shown if len(names) <= 12 else f"{shown} and {len(names) - 12} more"


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
