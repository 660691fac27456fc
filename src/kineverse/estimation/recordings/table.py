"""Pose tables: files of several programs, data frames and arrays; names, units and parts of their columns."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from kineverse.errors import FormatError
from kineverse.formats.files import read_file

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


POSITION = ("x", "y", "z")
UNORDERED = "quaternion of unknown order"
ORIENTATIONS = (
    ("quaternion", ("qx", "qy", "qz", "qw")),
    ("quaternion", ("rx", "ry", "rz", "rw")),
    ("quaternion", ("q1", "q2", "q3", "q0")),
    (UNORDERED, ("q1", "q2", "q3", "q4")),
    ("matrix", tuple(f"r{i}{j}" for i, j in product("123", repeat=2))),
    ("rpy", ("roll", "pitch", "yaw")),
    ("rotation vector", ("rx", "ry", "rz")),
)
"""Representations of an orientation, with their columns. The last two are read only if no other is there."""

YAW = "yaw"  # the orientation of a motion in the plane

UNNAMED_COLUMNS: Mapping[str, str] = MappingProxyType(
    {
        "nnn": "x,y,z",
        "n" * 7: "x,y,z,q1,q2,q3,q4",
        "n" * 8: "time,x,y,z,q1,q2,q3,q4",
        "n" * 12: "r11,r12,r13,x,r21,r22,r23,y,r31,r32,r33,z",
        "n" * 16: "r11,r12,r13,x,r21,r22,r23,y,r31,r32,r33,z,-,-,-,-",
        "nnt" + "n" * 7: "stamp.sec,stamp.nanosec,frame_id,x,y,z,qx,qy,qz,qw",
        "nntt" + "n" * 7: "stamp.sec,stamp.nanosec,frame_id,child_frame_id,x,y,z,qx,qy,qz,qw",
    }
)
"""ColumnMeaning names of a table without a head, by its cells: n for a number, t for a text."""

_NAMES_OF_UNITS = {
    "length": {1.0: "m meter meters metre metres", 0.01: "cm", 0.001: "mm millimeters millimetres"},
    "angle": {1.0: "rad radian radians", math.pi / 180.0: "deg degree degrees °"},
    "time": {
        1.0: "s sec secs second seconds",
        1e-3: "ms msec milliseconds",
        1e-6: "us µs usec microseconds",
        1e-9: "ns nsec nsecs nanosec nanosecs nanoseconds",
    },
}
UNITS: Mapping[str, Mapping[str, float]] = MappingProxyType(
    {
        kind: {name: factor for factor, names in units.items() for name in names.split()}
        for kind, units in _NAMES_OF_UNITS.items()
    }
)
"""Factors of the units of each kind of quantity."""

_KINDS = (
    dict.fromkeys(POSITION, "length")
    | dict.fromkeys(("roll", "pitch", "yaw", "rx", "ry", "rz"), "angle")
    | {"time": "time"}
)

COLUMN_HELP = (
    "Known are time, part, x, y, z, and qx, qy, qz, qw or roll, pitch, yaw or rx, ry, rz (a rotation "
    "vector), with a unit as in 'x [mm]', and for several parts in a row a name before them, as in 'door.x'. "
    "--columns names all columns in their order."
)

# Names of quantities, with the name of a part before them.
_PATTERNS = tuple(
    (re.compile(rf"(?:(?P<part>.*?)[./:_ ]+)?(?:{pattern})", re.IGNORECASE), quantity)
    for pattern, quantity in {
        "(?:p|pos|position|t|trans|translation|tvec)[./:_ ]?([xyz])": "{}",
        "(?:q|quat|quaternion|rot|rotation|orientation)[./:_ ]?([xyzw])": "q{}",
        "(?:rvec|rotvec|rotation_vector)[./:_ ]?([xyz])": "r{}",
        "(?:(?:rot|rotation|orientation|euler|rpy)[./:_ ])?(roll|pitch|yaw)": "{}",
        "(theta|heading)": "yaw",
        "(x|y|z|q[xyzw0-4]|r[xyzw]|r[1-3][1-3])": "{}",
    }.items()
)
_AXES_FIRST = re.compile(r"(?P<kind>[pq])_[A-Z]+(?:_[A-Z])?_(?P<axis>[xyzw])")  # p_RS_R_x of EuRoC
_TIME = re.compile(r"(?:.*[./: ])?(?:time|timestamp|stamp|t|rosbagTimestamp)", re.IGNORECASE)
_WHOLE = {"frame_id": "frame", "header.frame_id": "frame", "field.header.frame_id": "frame"} | dict.fromkeys(
    ("part", "name", "link", "body", "object", "frame", "child_frame_id", "field.child_frame_id"), "part"
)
_ROS = re.compile(r"(?:pose|transform)[./](?:position|translation)[./][xyz]$")
# Fields of messages that say nothing about the part, and those that are no poses.
_WRAPPER = re.compile(r"^field\b|(?:^|[./:_ ]+)(?:pose|transform)$", re.IGNORECASE)
_NO_POSE = re.compile(
    r"(?:.*[./:_ ])?(?:twist|linear|angular|velocity|vel|acceleration|accel|acc|force|torque|wrench|gyro|mag"
    r"|covariance|cov|std|sigma|error|gravity|size|scale|dimensions|bias)(?:[./:_ ].*)?|[a-z](?:_.*)?_",
    re.IGNORECASE,
)
_UNIT = re.compile(r"(?P<name>.*?)(?:\s*[\[(]\s*(?P<unit>[^\[\]()]*?)\s*[\])]|[._ ]+(?P<suffix>[a-zµ°]+))")


class ColumnMeaning(NamedTuple):
    """Meaning of a column's name."""

    part: str  # owner of the quantity; for times, the name without the unit
    quantity: str  # a coordinate, "time", "part" or "frame"; empty if the name has no meaning
    factor: float | None = None  # of the unit; None if there is none


def parse_column(name: str, where: str) -> ColumnMeaning:
    """Parse the name of a column."""
    text = name.strip().lstrip("#% ./").strip("_")
    found = _UNIT.fullmatch(text)
    if found and found["suffix"]:
        column = _parse_name(found["name"])
        factor = UNITS.get(_KINDS.get(column.quantity, ""), {}).get(found["suffix"])
        return _parse_name(text) if factor is None else column._replace(factor=factor)
    column = _parse_name(found["name"] if found else text)
    if column.quantity == "time" and name.strip().startswith(("%time", "field.")):
        return column._replace(factor=1e-9)  # rostopic echo -p
    if not column.quantity or found is None or not found["unit"]:
        return column
    kind = _KINDS.get(column.quantity, "")
    if (factor := UNITS.get(kind, {}).get(found["unit"].lower())) is None:
        known = ", ".join(names.split()[0] for names in _NAMES_OF_UNITS.get(kind, {}).values())
        known = f"Known are {known}." if known else "It has none."
        raise FormatError(f"{where}: the column '{name}' has the unit '{found['unit']}'. {known}")
    return column._replace(factor=factor)


def _parse_name(name: str) -> ColumnMeaning:
    if quantity := _WHOLE.get(name.lower()):
        return ColumnMeaning("", quantity)
    if _TIME.fullmatch(name):
        return ColumnMeaning(name, "time")
    if found := _AXES_FIRST.fullmatch(name):
        return ColumnMeaning("", found["axis"] if found["kind"] == "p" else f"q{found['axis']}")
    for pattern, quantity in _PATTERNS:
        if found := pattern.fullmatch(name):
            part = found["part"] or ""
            if _NO_POSE.fullmatch(part) or re.fullmatch(r"[a-z](_.*)?_", name[: len(part) + 1]):
                break
            bare = _WRAPPER.sub("", part).strip("./:_ ")
            while bare != part:
                part, bare = bare, _WRAPPER.sub("", bare).strip("./:_ ")
            return ColumnMeaning(part, quantity.format(found[2].lower()))
    return ColumnMeaning("", "")


@dataclass(frozen=True)
class PartColumns:
    """Columns of one part."""

    position: tuple[int, ...]  # x, y and z; x and y of a motion in the plane
    orientation: tuple[int, ...] = ()
    form: str = ""  # one of ORIENTATIONS, YAW, or ""


@dataclass(frozen=True)
class Columns:
    """Columns of a table by meaning."""

    names: tuple[str, ...]
    parts: Mapping[str, PartColumns]  # by name of the part, which is "" if columns name no part
    factors: Mapping[int, float]  # of the columns with units
    times: tuple[tuple[int, ...], ...]  # alternatives, the preferred one first; the columns of each are added
    part: int | None = None  # of the part's name; None if there are none
    frame: int | None = None  # of the name of the frame that the poses are in
    ignored: tuple[str, ...] = ()  # names without meaning

    @property
    def is_metric(self) -> bool:
        """True if lengths are in metres by a unit in the head, or by the convention of ROS."""
        lengths = [k for part in self.parts.values() for k in part.position]
        return any(k in self.factors or _ROS.search(self.names[k]) for k in lengths)


def parse_columns(names: Sequence[str], where: str) -> Columns:
    """Parse the names of all columns."""
    places: dict[tuple[str, str], int] = {}
    factors: dict[int, float] = {}
    times: dict[str, list[int]] = {}
    ignored: list[str] = []
    for index, name in enumerate(names):
        part, quantity, factor = parse_column(name, where)
        if factor is not None:
            factors[index] = factor
        if quantity == "time":
            times.setdefault(part, []).append(index)
        elif not quantity:
            ignored += [name] if name not in ("", "-") else []
        elif places.setdefault((part, quantity), index) != index:
            raise FormatError(f"{where}: there are two columns '{name}'.")
    row_part, frame = (places.pop(("", quantity), None) for quantity in ("part", "frame"))
    owners = dict.fromkeys(part for part, _ in places)
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
    alternatives: list[tuple[int, ...]] = []
    for base in sorted(times, key=lambda base: "stamp" not in base):  # of the sensor, rather than the logger
        group = times[base]
        in_pieces = {factors.get(k) for k in group} == {1.0, 1e-9}  # seconds, and nanoseconds on top
        alternatives += [tuple(group)] if in_pieces else [(k,) for k in group]
    return Columns(tuple(names), parts, factors, tuple(alternatives), row_part, frame, tuple(ignored))


def _parse_part(
    part: str, places: Mapping[tuple[str, str], int], where: str, ignored: Sequence[str]
) -> PartColumns:
    owner = f"{where}: the part '{part}' has" if part else f"{where}: the table has"
    left = {quantity for owner, quantity in places if owner == part}
    if left - {"z"} == {"x", "y", "yaw"}:
        return PartColumns(
            tuple(places[part, axis] for axis in POSITION if axis in left), (places[part, "yaw"],), YAW
        )
    found: dict[str, tuple[int, ...]] = {}
    for form, quantities in (("position", POSITION), *ORIENTATIONS):
        if left.issuperset(quantities):
            found.setdefault(form, tuple(places[part, quantity] for quantity in quantities))
            left.difference_update(quantities)
    position = found.pop("position", None)
    if position is None and found:
        raise FormatError(f"{owner} an orientation, but no position x, y, z.")
    if left and not (position and found):  # else something else that is derived from the pose
        wanted = (POSITION, *(names for _, names in ORIENTATIONS))
        missing = min(({*names} - left for names in wanted if left & {*names}), key=len)
        hint = f" Not understood: {_format_list(ignored)}." if ignored else ""
        if missing == {"qw"} and not left & {*POSITION} and position is None:
            raise FormatError(
                f"{owner} no positions x, y, z, and no qw, the fourth number of the quaternion."
            )
        if missing == {"qw"}:
            hint = " Three angles are called roll, pitch, yaw, and a rotation vector rx, ry, rz."
        raise FormatError(f"{owner} no column {', '.join(sorted(missing))}.{hint} {COLUMN_HELP}")
    assert position is not None  # all columns of the part would be left
    if {*found} == {"rpy", "rotation vector"}:
        raise FormatError(f"{owner} its orientation twice, as {' and '.join(found)}.")
    form, orientation = next(iter(found.items()), ("", ()))
    return PartColumns(position, orientation, form)


def _format_list(names: Sequence[str]) -> str:
    shown = ", ".join(f"'{name}'" for name in names[:12])
    return shown if len(names) <= 12 else f"{shown} and {len(names) - 12} more"
