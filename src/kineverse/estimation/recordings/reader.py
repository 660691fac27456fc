"""Reader of pose tables."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from kineverse.errors import FormatError
from kineverse.formats.xml_values import LARGEST
from kineverse.lie import Array, exp_so3, quaternion, rotation_angle, rpy, to_quaternion, transform

from .recording import Indices, RecordedTrack, Recording, spaced_indices
from .table import (
    COLUMN_HELP,
    UNITS,
    UNNAMED_COLUMNS,
    UNORDERED,
    YAW,
    Columns,
    PartColumns,
    Table,
    convert_frame,
    is_number,
    parse_columns,
    read_table,
)

ROOM, FARTHEST = 50.0, 1000.0
"""Largest range of the positions of a part, and their largest coordinate, that are possible in a room [m]."""

_DOUBTFUL = 10.0  # range of positions without a unit that may be metres or millimetres
_INLYING = (0.05, 0.95)  # quantiles between which positions are no outliers
_ROTATION_TOLERANCE = 0.01  # deviation of a quaternion's length from 1, and of a matrix from a rotation
_DECISIVE = 1.5  # ratio of misfits that decides between two readings of an orientation
_FEWEST_ROWS, _MOST_ROWS = 8, 200  # that decide
_TINY = 1e-4  # misfit that makes no difference, relative to the motion
_STILL = 0.05  # rotation that makes no difference [rad]
_EPOCHS = ((1e17, "ns"), (1e14, "us"), (1e11, "ms"))  # times without a unit that are this large
_ABOUT_Z = (0.0, 0.0, 1.0)
_GAPS = {"", "nan", "na", "n/a", "null", "none", "<na>"}


def read_recording(
    source: str | os.PathLike[str] | Any, columns: str | Sequence[str] | None = None, units: str | None = None
) -> Recording:
    """Read a table of poses.

    Parameters
    ----------
    source
        Path of a text file, a data frame such as that of pandas, a structured array, or an array (N, M).
    columns
        Names of all columns, separated by commas if in one text; ``-`` for a column to skip. They replace the
        head of the table.
    units
        Units of the columns without one: ``mm``, ``deg``, or ``mm,deg``.

    Raises
    ------
    FormatError
        If the table cannot be read, or its meaning is ambiguous. The message names the line or the option.

    Examples
    --------
    >>> rows = ["time,part,x,y,z"]
    >>> for k in range(20):
    ...     rows.append(f"{0.1 * k},drawer,{0.02 * k},0,0.5")
    >>> with open("poses.csv", "w", encoding="utf-8") as file:
    ...     size = file.write(chr(10).join(rows))
    >>> recording = kv.estimation.recordings.read_recording("poses.csv")
    >>> pair = recording.pair("world", "drawer")
    >>> pair.relative.shape
    (20, 3)
    """
    table = open_table(source)
    names = columns.split(",") if isinstance(columns, str) else columns
    return read_tracks(table, None if names is None else [name.strip() for name in names], units)


def open_table(source: str | os.PathLike[str] | Any) -> Table:
    """Return the cells of a text file, a data frame or an array."""
    return read_table(Path(source)) if isinstance(source, (str, os.PathLike)) else convert_frame(source)


def read_tracks(table: Table, names: list[str] | None = None, units: str | None = None) -> Recording:
    """Return the poses in a table, with its columns' names, or those of its head."""
    return _Reader(table, names, parse_units(units)).read()


def parse_units(units: str | None) -> dict[str, float]:
    """Return the factors of the units in a text such as ``mm,deg``, by kind."""
    given: dict[str, float] = {}
    for unit in filter(None, (units or "").replace(" ", "").split(",")):
        kind = next((kind for kind in ("length", "angle") if unit in UNITS[kind]), None)
        if kind is None:
            raise FormatError(f"'{unit}' is no unit of lengths (m, cm, mm) or angles (rad, deg).")
        given[kind] = UNITS[kind][unit]
    return given


Reading = Callable[[Array], Array]
READINGS: Mapping[str, Mapping[str, Reading]] = MappingProxyType(
    {
        "quaternion": {"": quaternion},
        UNORDERED: {"qx,qy,qz,qw": quaternion, "qw,qx,qy,qz": lambda q: quaternion(np.roll(q, -1, axis=-1))},
        "matrix": {"": lambda numbers: quaternion(to_quaternion(numbers.reshape(-1, 3, 3)))},
        "rpy": {"rad": rpy, "deg": lambda angles: rpy(np.radians(angles))},
        YAW: {"rad": lambda yaw: rpy(yaw * _ABOUT_Z), "deg": lambda yaw: rpy(np.radians(yaw) * _ABOUT_Z)},
        "rotation vector": {"rad": exp_so3, "deg": lambda vectors: exp_so3(np.radians(vectors))},
    }
)
"""Rotations of the numbers of each representation; of several readings the first is that of exact names."""


class _Reader:
    """Reader of one table, and its assumptions."""

    def __init__(self, table: Table, names: list[str] | None, units: dict[str, float]) -> None:
        self.table, self.units, self.assumed = table, units, [*table.assumed]
        self.columns = self._parse_names(names)

    def read(self) -> Recording:
        """Return the tracks of all parts."""
        source, lines = self.table.source, self.table.lines
        found = {
            part or name: (where, rows)
            for part, where in self.columns.parts.items()
            for name, rows in self._rows_by_part(where).items()
            if len(rows)
        }
        if not found:
            raise FormatError(f"{source}: nothing was observed in any row.")
        poses = {name: self._parse_numbers(where.position, rows) for name, (where, rows) in found.items()}
        scale = self._length_unit([*poses.values()])
        poses = {
            name: scale * np.pad(positions, ((0, 0), (0, 3 - positions.shape[1])))
            for name, positions in poses.items()
        }
        for where in (where for where, _ in found.values() if where.form == YAW):
            self.assumed.append("roll = pitch = 0" if len(where.position) == 3 else "z = roll = pitch = 0")
        for form in {where.form: None for where, _ in found.values() if where.form}:
            numbers = {}
            for name, (where, rows) in found.items():
                if where.form == form:
                    numbers[name] = self._parse_numbers(where.orientation, rows)
                    self._check_rotations(numbers[name], rows)
            read = READINGS[form][self._choose_reading(form, numbers, poses)]
            poses |= {name: transform(read(some), poses[name]) for name, some in numbers.items()}
        tracks = {
            name: RecordedTrack(poses[name], rows, lines[rows], self._parse_times(rows), self._frame(rows))
            for name, (_, rows) in found.items()
        }
        return Recording(source, tracks, self.columns.ignored, tuple(dict.fromkeys(self.assumed)))

    def _parse_names(self, names: list[str] | None) -> Columns:
        table, count = self.table, self.table.cells.shape[1]
        if names is not None:
            if len(names) != count:
                raise FormatError(
                    f"{table.source} has {count} columns, and there are {len(names)} names: "
                    f"{','.join(names)}. A column that is not wanted is called '-'."
                )
            return parse_columns(names, "The names of the columns")
        if table.head is not None:
            # Some programs number the rows in a column of this name, others name the part in it.
            numbered = {k for k, name in enumerate(table.head) if name.lower() == "frame"}
            numbered = {k for k in numbered if all(map(is_number, table.cells[:, k]))}
            head = ["-" if k in numbered else name for k, name in enumerate(table.head)]
            return parse_columns(head, f"{table.source}, line 1" if table.lines[0] == 2 else table.source)
        kinds = "".join("n" if _is_gap(cell) or is_number(cell) else "t" for cell in table.cells[0])
        if kinds not in UNNAMED_COLUMNS:
            raise FormatError(
                f"{table.source}: {count} columns without names. 3 are taken for positions, 7 for poses, 8 "
                f"for times and poses, 12 or 16 for matrices; others need names. {COLUMN_HELP}"
            )
        found = UNNAMED_COLUMNS[kinds]
        if count > 3 and "q1" not in found:
            self.assumed.append(f"columns {found}")
        return parse_columns(found.split(","), table.source)

    def _rows_by_part(self, where: PartColumns) -> dict[str, Indices]:
        observed: dict[str, list[int]] = {}
        columns, needed, gaps = self.columns, (*where.position, *where.orientation), 0
        for row, cells in enumerate(self.table.cells):
            name = "" if columns.part is None else cells[columns.part]
            if columns.part is not None and not name:
                raise FormatError(f"{self._at(row)}: the name of the part is missing.")
            rows, lacking = observed.setdefault(name, []), [k for k in needed if _is_gap(cells[k])]
            if not lacking:
                rows.append(row)
            elif len(lacking) < len(needed):
                rule = "all cells of a part that was not observed are empty or NaN"
                raise FormatError(f"{self._at(row)}: {columns.names[lacking[0]]} is missing; {rule}.")
            gaps += any(cells[k] for k in lacking)
        if gaps:
            self.assumed.append(f"{gaps} rows of NaN are gaps")
        return {name: np.array(rows, dtype=np.intp) for name, rows in observed.items()}

    def _at(self, row: int) -> str:
        return f"{self.table.source}, line {self.table.lines[row]}"

    def _parse_numbers(self, places: Sequence[int], rows: Indices) -> Array:
        texts = self.table.cells[rows][:, places]
        good = np.array([[is_number(text) and abs(float(text)) <= LARGEST for text in row] for row in texts])
        if not good.all():
            row, k = np.argwhere(~good)[0]
            hint = " A decimal point is expected." if "," in texts[row, k] else ""
            raise FormatError(
                f"{self._at(rows[row])}: {self.columns.names[places[k]]} is '{texts[row, k][:40]}', which is "
                f"no finite number.{hint}"
            )
        return np.asarray(texts.astype(np.float64) * [self.columns.factors.get(k, 1.0) for k in places])

    def _length_unit(self, positions: list[Array]) -> float:
        """Return the unit of lengths [m] beyond those of the head."""
        is_metric = self.columns.is_metric
        if "length" in self.units:
            lengths = {k for part in self.columns.parts.values() for k in part.position}
            return 1.0 if lengths & {*self.columns.factors} else self.units["length"]
        ends = [np.quantile(part, _INLYING, axis=0) for part in positions]
        wide, far = max(np.ptp(end, axis=0).max() for end in ends), max(np.abs(end).max() for end in ends)
        is_possible = wide <= ROOM and far <= FARTHEST
        if is_possible and (is_metric or wide <= _DOUBTFUL):
            return 1.0
        if is_possible or is_metric or max(wide, far) > 1000.0 * ROOM:
            what = "are these metres or millimetres?" if is_possible else "no room holds this, if in metres."
            raise FormatError(
                f"{self.table.source}: positions range over {wide:.3g} and reach {far:.3g}; {what} Say "
                "--units m or --units mm."
            )
        self.assumed.append("lengths in mm")
        return 0.001

    def _check_rotations(self, numbers: Array, rows: Indices) -> None:
        """Raise an error if quaternions are not of unit length, or matrices are no rotations."""
        lengths = np.linalg.norm(numbers, axis=1)
        off = np.abs(lengths - 1.0)
        if numbers.shape[1] == 9:
            off = np.abs(READINGS["matrix"][""](numbers).reshape(-1, 9) - numbers).max(axis=1)
        wrong = np.flatnonzero(off > _ROTATION_TOLERANCE).tolist() if numbers.shape[1] > 3 else []
        if wrong:
            k = wrong[0]
            what = f"the quaternion has the length {lengths[k]:.4g}"
            what = "the matrix is no rotation" if numbers.shape[1] == 9 else what
            raise FormatError(
                f"{self._at(rows[k])}: {what}, which is off by {off[k]:.2g}; {len(wrong)} of {len(off)} are. "
                "If the columns mean something else, name them: --columns."
            )

    def _choose_reading(self, form: str, numbers: dict[str, Array], positions: dict[str, Array]) -> str:
        """Return the order of the quaternions or the unit of the angles."""
        first, *others = READINGS[form]
        wheres = [where for where in self.columns.parts.values() if where.form == form]
        if not others or any(k in self.columns.factors for where in wheres for k in where.orientation):
            return first
        if form != UNORDERED and "angle" in self.units:
            return "rad" if self.units["angle"] == 1.0 else "deg"
        rotations = {
            name: {r: read(some) for r, read in READINGS[form].items()} for name, some in numbers.items()
        }
        decided = next(filter(None, (_decide(positions[name], each) for name, each in rotations.items())), "")
        if form != UNORDERED:
            largest = max(float(np.abs(some).max()) for some in numbers.values())
            reading = decided or ("deg" if largest > 2.0 * math.pi else "rad")
            self.assumed.append(f"angles in {reading}")
            return reading
        options = {r: ",".join(self.columns.names).replace("q1,q2,q3,q4", r) for r in READINGS[form]}
        turns = [rotation_angle(each[first][0].T @ each[first]).max() for each in rotations.values()]
        if not decided and max(turns) > _STILL:
            raise FormatError(
                f"{self.table.source}: is the order of the quaternion x, y, z, w, or w, x, y, z? The motion "
                f"does not show it. Say --columns {' or --columns '.join(options.values())}."
            )
        self.assumed.append(f"columns {options[decided or first]}")
        return decided or first

    def _parse_times(self, rows: Indices) -> Array | None:
        if not self.columns.times:
            return None
        cells, lines = self.table.cells, self.table.lines[rows]
        # A stamp that nobody filled in stands still.
        moving = (places for places in self.columns.times if (cells[:, places] != cells[0, places]).any())
        places = next(moving, self.columns.times[0])
        try:
            dates = [] if is_number(cells[rows[0], places[0]]) else cells[rows, places[0]].tolist()
            dates = [datetime.fromisoformat(text) for text in dates]
        except ValueError:
            dates = []
        times = np.array([date.replace(tzinfo=date.tzinfo or UTC).timestamp() for date in dates])
        times = times if dates else self._parse_numbers(places, rows).sum(axis=1)
        unit = next((unit for least, unit in _EPOCHS if abs(times[0]) > least), None)
        if unit and places[0] not in self.columns.factors:
            times *= UNITS["time"][unit]
            self.assumed.append(f"times in {unit}")
        for k in np.flatnonzero(np.diff(times) <= 0.0).tolist():
            how = "the same time as" if times[k + 1] == times[k] else "earlier than"
            raise FormatError(
                f"{self._at(rows[k + 1])}: {times[k + 1]:.10g} s is {how} line {lines[k]} of the same part "
                f"({times[k]:.10g} s). Rows are expected in the order of their times."
            )
        return times

    def _frame(self, rows: Indices) -> str:
        """Return the frame that the poses are in; an empty text if it is not known."""
        if self.columns.frame is None:
            return ""
        frames = self.table.cells[rows, self.columns.frame]
        if others := np.flatnonzero(frames != frames[0]).tolist():
            raise FormatError(
                f"{self._at(rows[others[0]])}: poses of one part are in the frames '{frames[0]}' and "
                f"'{frames[others[0]]}'. One frame for all of them is expected."
            )
        return str(frames[0])


def _is_gap(text: str) -> bool:
    return text.lower() in _GAPS


def _decide(positions: Array, readings: Mapping[str, Array]) -> str:
    """Return the reading in which the part turns about a point at rest; an empty text if none does clearly.

    A hinge or a ball has p = c + R a, with a constant point c and a constant lever a.
    """
    some = spaced_indices(len(positions), _MOST_ROWS)
    if len(some) < _FEWEST_ROWS:
        return ""
    p = positions[some] - positions.mean(axis=0)
    misfits = {}
    for reading, rotations in readings.items():
        design = np.concatenate([np.broadcast_to(np.eye(3), (len(some), 3, 3)), rotations[some]], axis=2)
        solution = np.linalg.lstsq(design.reshape(-1, 6), p.reshape(-1), rcond=None)[0]
        misfits[reading] = float(np.linalg.norm(design @ solution - p)) + _TINY * float(np.linalg.norm(p))
    best, other = sorted(misfits, key=misfits.__getitem__)
    return best if misfits[other] > _DECISIVE * misfits[best] else ""
