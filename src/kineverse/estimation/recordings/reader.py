"""Reader of pose tables (CSV and the like): columns, units, rows."""

from __future__ import annotations

import csv
import math
import os
import re
from collections.abc import Mapping, Sequence
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
_RPY, _VECTOR = ("roll", "pitch", "yaw"), ("rx", "ry", "rz")
ORIENTATIONS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {"quaternion": ("qx", "qy", "qz", "qw"), "rpy": _RPY, "rotation vector": _VECTOR}
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
    {TIME: _TIMES} | dict.fromkeys(POSITION, _LENGTHS) | dict.fromkeys(_RPY + _VECTOR, _ANGLES)
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

    position: tuple[int, ...]  # x, y and z
    orientation: tuple[int, ...] = ()
    form: str = ""  # one of ORIENTATIONS, or ""


@dataclass(frozen=True)
class Columns:
    """Columns of a table by meaning."""

    names: tuple[str, ...]
    parts: Mapping[str, PartColumns]  # by name of the part, which is "" if columns name no part
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
            raise FormatError(f"{where}: there are two columns '{name}'.")
        places[part, quantity] = index
        if factor != 1.0:
            factors[index] = factor
    time, row_part = places.get(("", TIME)), places.get(("", PART))
    owners = dict.fromkeys(part for part, quantity in places if quantity not in (TIME, PART))
    if not owners:
        raise FormatError(
            f"{where}: no column is a position; the columns are {_format_list(names)}. {COLUMN_HELP}"
        )
    named = next(filter(None, owners), "")
    if row_part is not None and named:
        raise FormatError(f"{where}: parts are named in rows and in columns ('{named}'); one or the other.")
    if "" in owners and named:
        raise FormatError(f"{where}: some columns belong to a part ('{named}'), others such as 'x' to none.")
    parts = {part: _parse_part(part, places, where, ignored) for part in owners}
    return Columns(tuple(names), parts, time, row_part, factors, tuple(ignored))


def _parse_column(name: str, where: str) -> tuple[str, str, float]:
    """Return part, quantity and factor of a column; the quantity is empty if the name has no meaning."""
    match = _WITH_UNIT.fullmatch(name.strip())
    assert match is not None  # all parts of the pattern are optional
    part, quantity = "", match["name"]
    if of_part := re.fullmatch(r"(.*)[./:]([^./:]*)", match["name"]):
        part, quantity = of_part[1].strip(), of_part[2].strip()
    quantity = SYNONYMS.get(quantity.lower(), quantity.lower())
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
    part: str, places: Mapping[tuple[str, str], int], where: str, ignored: Sequence[str]
) -> PartColumns:
    owner = f"{where}: the part '{part}' has" if part else f"{where}: the table has"
    columns: dict[str, tuple[int, ...]] = {}
    for form, quantities in {"position": POSITION, **ORIENTATIONS}.items():
        missing = [quantity for quantity in quantities if (part, quantity) not in places]
        if not missing:
            columns[form] = tuple(places[part, quantity] for quantity in quantities)
        elif len(missing) < len(quantities):
            hint = f" Not understood: {_format_list(ignored)}." if ignored else ""
            raise FormatError(f"{owner} no column {', '.join(missing)}.{hint} {COLUMN_HELP}")
    position = columns.pop("position", None)
    if position is None:
        raise FormatError(f"{owner} an orientation, but no position x, y, z.")
    if len(columns) > 1:
        raise FormatError(f"{owner} its orientation twice, as {' and '.join(columns)}.")
    form, orientation = next(iter(columns.items()), ("", ()))
    return PartColumns(position, orientation, form)


def _format_list(names: Sequence[str]) -> str:
    shown = ", ".join(f"'{name}'" for name in names[:12])
    return shown if len(names) <= 12 else f"{shown} and {len(names) - 12} more"


COMMENT = "#"


@dataclass(frozen=True)
class TextTable:
    """Text cells of a table file."""

    source: str  # name of the file in messages
    head: list[str] | None  # column names; None if the file begins with numbers
    lines: tuple[int, ...]  # line number of each row, counted from 1
    cells: tuple[list[str], ...]  # texts of each row, equally many in each


def read_table(path: Path) -> TextTable:
    """Read a table with cells separated by commas, semicolons, tabs or spaces.

    Empty lines and lines that begin with ``#`` are skipped. The first other line is the head if one of its
    cells is not a number. It also determines the separator: a semicolon if it has one, else a comma, else a
    tab in a head, else spaces.
    """
    source, data = str(path), read_file(path)
    wanted = "poses are read from a table in text"
    if b"\0" in data:
        raise FormatError(f"{source}: this is no text, or not in UTF-8; {wanted}.")
    try:
        lines = enumerate(data.decode("utf-8-sig").splitlines(), start=1)
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise FormatError(f"{source}, line {line}: this is no text in UTF-8; {wanted}.") from None
    texts = {line: text for line, text in lines if text.strip() and not text.lstrip().startswith(COMMENT)}
    if not texts:
        raise FormatError(f"{source}: the file is empty; a row for each pose is expected.")
    (top, first), *_ = texts.items()
    separator = next((mark for mark in ";,\t" if mark in first), None)
    if separator == "\t" and all(map(is_number, first.split())):
        separator = None  # numeric columns, aligned by tabs and spaces
    cells = {line: _split_cells(text, separator) for line, text in texts.items()}
    head = None if all(map(is_number, filter(None, cells[top]))) else cells[top]
    count = len(cells[top])
    for line, each in cells.items():
        if len(each) != count:
            plural = "" if len(each) == 1 else "s"
            raise FormatError(
                f"{source}, line {line}: {len(each)} cell{plural}, where line {top} has {count}."
            )
    if head is not None:
        del cells[top]
    if not cells:
        raise FormatError(f"{source}: there are names of columns, but no row below them.")
    return TextTable(source, head, tuple(cells), tuple(cells.values()))


def is_number(text: str) -> bool:
    """Return True if a text is a number, including NaN and infinities."""
    try:
        float(text)
    except ValueError:
        return False
    return "_" not in text  # Python also reads digits grouped by underscores


def _split_cells(text: str, separator: str | None) -> list[str]:
    if separator is None:
        return text.split()
    return [cell.strip() for cell in next(csv.reader([text], delimiter=separator, skipinitialspace=True))]


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
    names = columns.split(",") if isinstance(columns, str) else columns
    by_meaning = _choose_columns(table, None if names is None else [name.strip() for name in names])
    tracks = {
        part or name: _build_track(table, by_meaning, where, rows)
        for part, where in by_meaning.parts.items()
        for name, rows in _rows_by_part(table, by_meaning, where).items()
    }
    tracks = {name: track for name, track in tracks.items() if len(track)}
    if not tracks:
        raise FormatError(f"{table.source}: nothing was observed in any row.")
    return Recording(table.source, tracks, by_meaning.ignored)


def _choose_columns(table: TextTable, names: Sequence[str] | None) -> Columns:
    count = len(table.cells[0])
    if names is not None:
        if len(names) != count:
            raise FormatError(
                f"{table.source} has {count} columns, and there are {len(names)} names: {','.join(names)}. A "
                "column that is not wanted is called '-'."
            )
        return parse_columns(names, "The names of the columns")
    if table.head is not None:
        return parse_columns(table.head, f"{table.source}, line 1" if table.lines[0] == 2 else table.source)
    if count not in UNNAMED_COLUMNS:
        raise FormatError(
            f"{table.source}: {count} columns without names. 3 are taken for {UNNAMED_COLUMNS[3]} and 7 for "
            f"{UNNAMED_COLUMNS[7]}; otherwise name them (--columns). {COLUMN_HELP}"
        )
    return parse_columns(UNNAMED_COLUMNS[count].split(","), table.source)


def _rows_by_part(table: TextTable, columns: Columns, where: PartColumns) -> dict[str, Indices]:
    observed: dict[str, list[int]] = {}
    needed = (*where.position, *where.orientation)
    for row, cells in enumerate(table.cells):
        name, place = "" if columns.part is None else cells[columns.part], f"line {table.lines[row]}"
        if columns.part is not None and not name:
            raise FormatError(f"{table.source}, {place}: the name of the part is missing.")
        rows, lacking = observed.setdefault(name, []), [columns.names[k] for k in needed if not cells[k]]
        if not lacking:
            rows.append(row)
        elif len(lacking) < len(needed):
            rule = "all cells of a part that was not observed are empty"
            raise FormatError(f"{table.source}, {place}: {lacking[0]} is missing; {rule}.")
    return {name: np.array(rows, dtype=np.intp) for name, rows in observed.items()}


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
    texts = [[table.cells[row][k] for k in places] for row in rows]
    good = np.array([[is_number(text) for text in row] for row in texts], dtype=bool)
    if good.all():
        numbers = np.array(texts, dtype=np.float64).reshape(len(rows), len(places))
        good = np.abs(numbers) <= LARGEST  # NaN is not
    if not good.all():
        row, k = np.argwhere(~good)[0]
        text, name = texts[row][k], columns.names[places[k]]
        hint = " A decimal point is expected." if "," in text else ""
        hint = " All cells of a part that was not observed are empty." if text.lower() == "nan" else hint
        raise FormatError(
            f"{table.source}, line {table.lines[rows[row]]}: {name} is '{text[:40]}', which is no finite "
            f"number.{hint}"
        )
    return np.asarray(numbers * np.array([columns.factors.get(k, 1.0) for k in places]))


def _rotations(table: TextTable, columns: Columns, where: PartColumns, rows: Indices) -> Array:
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
    for k in np.flatnonzero(np.diff(times) <= 0.0).tolist():
        how = "the same time as" if times[k + 1] == times[k] else "earlier than"
        raise FormatError(
            f"{table.source}, line {lines[k + 1]}: {times[k + 1]:.10g} s is {how} line {lines[k]} of the "
            f"same part ({times[k]:.10g} s). Rows are expected in the order of their times."
        )
