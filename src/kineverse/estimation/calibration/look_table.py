"""Looks of a calibration, read from a table: joint values, and poses, points and pixels that were seen.

A row is a look. Columns named like joints are their values, all other ones are read as poses are, by
:mod:`kineverse.estimation.recordings`. The model decides what the table leaves open: between two looks, what
is seen turns by the angle that the joint values give, wherever camera and marker are mounted.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from typing import Any

import numpy as np

from kineverse.compilation import compile
from kineverse.errors import FormatError, UnknownNameError, list_some, suggest
from kineverse.estimation.recordings.reader import open_table, parse_units, read_tracks
from kineverse.estimation.recordings.recording import Indices, RecordedTrack, Recording
from kineverse.estimation.recordings.table import UNITS, Table, is_number, parse_column
from kineverse.estimation.tracking.measurements import ObservedPosition
from kineverse.expressions.expression import ExpressionLike
from kineverse.lie import Array, quaternion, rotation_angle, rotation_of, to_quaternion, transform
from kineverse.model.frame import WORLD
from kineverse.model.model_view import ModelView
from kineverse.symbols import Symbol

from .observations import Look, ObservedPixel

_LOOKS = 60  # largest number of looks of which all pairs are compared
_DECISIVE = 3.0  # ratio of misfits that decides between two readings
_NOTHING = math.radians(0.1)  # angle that makes no difference between two readings [rad]
_DOUBTFUL = 0.2  # median misfit above which joints and what was seen hardly belong together [rad]
_UNIT = re.compile(r"(?P<name>.*?)\s*[\[(]\s*(?P<unit>[^\[\]()]*?)\s*[\])]\s*|(?P<bare>.*?)")
_JOINT = re.compile(r"(?:.*?joint_states?[./])?(?:positions?[./:])?(?P<name>.*?)(?:[./:]positions?)?")
_PIXEL = re.compile(r"(?:(?P<frame>.*?)[./:_ ])?(?P<axis>[uv])")


@dataclass(frozen=True, eq=False)
class LookTable:
    """Looks of a table.

    Attributes
    ----------
    looks
        A look for each row.
    lines
        Line of each look in the file, from 1.
    assumptions
        What the table leaves open, such as "joint values in deg".
    ignored
        Names of columns without meaning.
    remarks
        Doubts about the table.

    See Also
    --------
    kineverse.estimation.read_looks
    """

    looks: tuple[Look, ...]
    lines: tuple[int, ...]
    assumptions: tuple[str, ...] = ()
    ignored: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()


def read_looks(
    source: str | os.PathLike[str] | Any,
    model: ModelView,
    *,
    observed: str | None = None,
    relative_to: str | None = None,
    columns: str | Sequence[str] | None = None,
    units: str | None = None,
    state: Mapping[Symbol | str, float] | None = None,
    focal: tuple[ExpressionLike, ExpressionLike] | None = None,
    centre: tuple[ExpressionLike, ExpressionLike] = (0.0, 0.0),
) -> LookTable:
    """Read the looks of a calibration from a table.

    Parameters
    ----------
    source
        Path of a text file, a data frame such as that of pandas, a structured array, or an array.
    model
        Model whose joints and frames the columns name, with or without the model's prefix.
    observed, relative_to
        Frame that was seen, and frame that it was seen in, where the table does not name them; the latter is
        the world by default, and the camera for pixels.
    columns
        Names of all columns, separated by commas if in one text; ``-`` for a column to skip. They replace the
        head of the table.
    units
        Units of the columns without one: ``mm``, ``deg``, or ``mm,deg``.
    state
        Values of joints that the table lacks, the same in all looks [m], [rad].
    focal, centre
        (f_x, f_y) and (c_x, c_y) [px] of the camera, numbers or parameters, for columns u and v.

    Raises
    ------
    FormatError
        If the table cannot be read, or its meaning is ambiguous. The message names the line or the option.
    UnknownNameError
        If no column is a joint of the model, or a frame is none of it.

    Examples
    --------
    >>> model = kv.load("kitchen")
    >>> rows = ["fridge_door[deg],x[mm],y[mm],z[mm]", "0,10,20,30", "30,11,21,31"]
    >>> with open("looks.csv", "w", encoding="utf-8") as file:
    ...     size = file.write(chr(10).join(rows))
    >>> table = kv.estimation.read_looks("looks.csv", model, observed="kitchen/fridge_door_handle")
    >>> len(table.looks), table.looks[1].state
    (2, {kitchen/fridge_door: 0.5235987755982988})
    """
    table = open_table(source)
    reader = _LookReader(table, model, columns, units)
    return reader.read(observed, relative_to, dict(state or {}), focal, centre)


class _LookReader:
    """Reader of one table."""

    def __init__(
        self, table: Table, model: ModelView, columns: str | Sequence[str] | None, units: str | None
    ) -> None:
        self.table, self.model, self.units = table, model, units
        names = columns.split(",") if isinstance(columns, str) else columns
        if names is None and table.head is None:
            raise FormatError(
                f"{table.source}: its {table.cells.shape[1]} columns have no names, which say what the "
                "numbers are: joints of the model, and x, y, z and qx, qy, qz, qw of what was seen. Name "
                "them in the first line, or by columns=."
            )
        self.names = [name.strip() for name in (table.head if names is None else names) or ()]
        if len(self.names) != table.cells.shape[1]:
            raise FormatError(
                f"{table.source} has {table.cells.shape[1]} columns, and there are {len(self.names)} names."
            )
        self.frames = (WORLD, *model.frames)
        self.assumed: list[str] = []

    def read(
        self,
        observed: str | None,
        relative_to: str | None,
        state: dict[Symbol | str, float],
        focal: tuple[ExpressionLike, ExpressionLike] | None,
        centre: tuple[ExpressionLike, ExpressionLike],
    ) -> LookTable:
        """Return the looks."""
        joints, pixels, rest = self._sort_columns()
        twice = [name for name in map(str, joints) if name in {*map(str, state)}]
        if twice:
            raise FormatError(
                f"{self.table.source}: '{twice[0]}' has a column, so state= cannot give its value as well."
            )
        reference = None if relative_to is None else self._frame(relative_to, "relative_to=")
        observations: list[list[tuple[Any, Any] | ObservedPixel]] = [[] for _ in self.table.cells]
        ignored: tuple[str, ...] = ()
        tracks: list[tuple[str, str, RecordedTrack]] = []
        if any(name != "-" for name in rest):
            recording = self._read_poses(rest, joints, state, observed, reference)
            self.assumed += recording.assumptions
            ignored = recording.ignored
            tracks = self._named(recording, observed, reference)
        values, kept = self._joint_values(joints, state, tracks)
        self._check_complete(values, state, [(frame, seen_in) for frame, seen_in, _ in tracks])
        remarks = self._check_turns(tracks, values, state)
        for frame, seen_in, track in tracks:
            key: Any = (frame, seen_in)
            if not track.has_orientation:
                key = ObservedPosition(frame, relative_to=seen_in)
            for row, pose in zip(track.rows.tolist(), track.poses, strict=True):
                observations[row].append((key, pose))
        for frame, places in pixels.items():
            self._read_pixels(observations, frame or observed, places, reference, focal, centre)
        rows = [row for row in kept if observations[row]]
        if not rows:
            raise FormatError(f"{self.table.source}: nothing was observed in any row.")
        looks = []
        for row in rows:
            given: dict[Symbol | str, float] = {**state, **{s: float(v[row]) for s, v in values.items()}}
            looks.append(Look(given, observations[row]))
        lines = tuple(int(self.table.lines[row]) for row in rows)
        hinted = tuple(map(self._with_hint, ignored))
        return LookTable(tuple(looks), lines, tuple(dict.fromkeys(self.assumed)), hinted, remarks)

    # -- columns ---------------------------------------------------------------------------------------------

    def _sort_columns(self) -> tuple[dict[Symbol, int], dict[str, dict[str, int]], list[str]]:
        """Return the columns of joints, of pixels by frame, and the names with ``-`` for these."""
        joints: dict[Symbol, int] = {}
        pixels: dict[str, dict[str, int]] = {}
        rest = [*self.names]
        for k, name in enumerate(self.names):
            text = self._split_unit(name)[0]
            symbol = self._joint(text)
            if symbol is not None:
                if symbol in joints:
                    raise FormatError(
                        f"{self.table.source}: the columns '{self.names[joints[symbol]]}' and '{name}' are "
                        f"both values of '{symbol}'. Skip one of them: call it '-'."
                    )
                joints[symbol], rest[k] = k, "-"
            elif found := _PIXEL.fullmatch(text):
                pixels.setdefault(found["frame"] or "", {})[found["axis"]] = k
                rest[k] = "-"
        if not joints:
            symbols = [str(s) for s in self.model.symbols]
            raise UnknownNameError(
                f"{self.table.source}: no column is a joint of the model; the columns are "
                f"{list_some(map(repr, self.names), 8)}. Joints are {list_some(symbols, 8)}."
            )
        return joints, pixels, rest

    def _split_unit(self, name: str) -> tuple[str, str]:
        found = _UNIT.fullmatch(name)
        return (found["bare"] or found["name"] or "", found["unit"] or "") if found else (name, "")

    def _joint(self, text: str) -> Symbol | None:
        """Return the coordinate that a column's name stands for; None if there is none."""
        inner = _JOINT.fullmatch(text)
        for name in dict.fromkeys((text, inner["name"] if inner else text)):
            ends = [s for s in self.model.symbols if str(s) == name]
            ends = ends or [s for s in self.model.symbols if str(s).partition("/")[2] == name]
            if not parse_column(name, self.table.source).quantity:  # else it may be that of another base's x
                ends = ends or [s for s in self.model.symbols if str(s).endswith(f"/{name}")]
            if name and len(ends) == 1:
                return ends[0]
            if name and len(ends) > 1:
                raise UnknownNameError(
                    f"{self.table.source}: the column '{text}' may be {list_some(map(str, ends), 4)}. Write "
                    "the whole name."
                )
        return None

    def _frame(self, text: str, what: str) -> str:
        """Return the frame of a name without or with the model's prefix."""
        ends = [text] if text in self.frames else [f for f in self.frames if f.endswith(f"/{text}")]
        if len(ends) == 1:
            return ends[0]
        if ends:
            raise UnknownNameError(f"{what} '{text}' may be {list_some(ends, 4)}. Write the whole name.")
        short = [frame.partition("/")[2] or frame for frame in self.frames]
        raise UnknownNameError(f"{what} '{text}' is no frame of the model. {suggest(text, short, 'frame')}")

    def _with_hint(self, column: str) -> str:
        """Return the name of a column without meaning, with the joint that may be meant."""
        names = {str(s).partition("/")[2] or str(s): None for s in self.model.symbols}
        near = get_close_matches(self._split_unit(column)[0], names, 1, 0.8)
        return f"{column} (is '{near[0]}' meant?)" if near else column

    # -- poses -----------------------------------------------------------------------------------------------

    def _read_poses(
        self,
        rest: list[str],
        joints: Mapping[Symbol, int],
        state: Mapping[Symbol | str, float],
        observed: str | None,
        reference: str | None,
    ) -> Recording:
        """Read the poses; where only the motion tells the order of quaternions, the model is asked."""
        try:
            return read_tracks(self.table, rest, self.units)
        except FormatError as error:
            options = {name.split(".")[-1]: k for k, name in enumerate(rest)}
            if not {"q1", "q2", "q3", "q4"} <= options.keys():
                raise
            found = [self._reordered(rest, order) for order in ("qx,qy,qz,qw", "qw,qx,qy,qz")]
            readings = [read_tracks(self.table, names, self.units) for names in found]
            misfits = []
            for reading in readings:
                tracks = self._named(reading, observed, reference)
                values = {s: self._numbers(k, self._quantity(s))[0] for s, k in joints.items()}
                misfits.append(self._misfit(tracks, values, state))
            best = int(np.argmin(misfits))
            if not misfits[1 - best] > _DECISIVE * misfits[best]:
                raise error
            self.assumed.append(f"quaternions as {('qx,qy,qz,qw', 'qw,qx,qy,qz')[best]}, as the joints turn")
            return readings[best]

    @staticmethod
    def _reordered(names: list[str], order: str) -> list[str]:
        result = [*names]
        for plain, meant in zip(("q1", "q2", "q3", "q4"), order.split(","), strict=True):
            result = [re.sub(rf"(^|[./:_ ]){plain}$", rf"\g<1>{meant}", name) for name in result]
        return result

    def _named(
        self, recording: Recording, observed: str | None, reference: str | None
    ) -> list[tuple[str, str, RecordedTrack]]:
        """Return the tracks with the frame that was seen, and the one that it was seen in."""
        result = []
        for name, track in recording.tracks.items():
            if not name and observed is None:
                raise FormatError(
                    f"{self.table.source} does not say which frame was seen. Name it by observed=, and the "
                    "one that it was seen in by relative_to=, if that is not the world."
                )
            frame = self._frame(observed if observed and len(recording.tracks) == 1 else name, "The part")
            seen_in = reference or (self._frame(track.frame, "The frame_id") if track.frame else WORLD)
            result.append((frame, seen_in, track))
        return result

    # -- joint values ----------------------------------------------------------------------------------------

    def _numbers(self, column: int, quantity: str) -> tuple[Array, bool]:
        """Return the values of a column in SI units, NaN for empty cells, and True if its unit is stated."""
        name, unit = self._split_unit(self.names[column])
        cells = self.table.cells[:, column]
        for row, text in enumerate(cells):
            if text and not is_number(text):
                raise FormatError(
                    f"{self.table.source}, line {self.table.lines[row]}: {name} is '{str(text)[:40]}', which "
                    "is no number."
                )
        values = np.array([float(text) if text else math.nan for text in cells])
        factors = {"px": 1.0} if quantity == "pixel" else UNITS[quantity]
        if unit and unit.lower() not in factors:
            known = {"pixel": "px", "angle": "rad or deg"}.get(quantity, "m, cm or mm")
            raise FormatError(
                f"{self.table.source}: the column '{self.names[column]}' has the unit '{unit}', but '{name}' "
                f"is in {known}."
            )
        return values * factors.get(unit.lower(), 1.0), bool(unit)

    def _joint_values(
        self,
        joints: Mapping[Symbol, int],
        state: Mapping[Symbol | str, float],
        tracks: Sequence[tuple[str, str, RecordedTrack]],
    ) -> tuple[dict[Symbol, Array], Indices]:
        """Return the values of joints in SI units, and the rows that have all of them."""
        values: dict[Symbol, Array] = {}
        open_angles: list[Symbol] = []
        given = parse_units(self.units)
        for symbol, column in joints.items():
            quantity = self._quantity(symbol)
            values[symbol], stated = self._numbers(column, quantity)
            if not stated and quantity in given:
                values[symbol] = values[symbol] * given[quantity]
            elif not stated and quantity == "angle":
                open_angles.append(symbol)
        whole = np.isfinite(np.stack([*values.values()])).all(axis=0)
        lost = int((~whole).sum())
        if lost:
            self.assumed.append(f"{lost} rows without all joint values are left out")
        rows: Indices = np.flatnonzero(whole)
        if not len(rows):
            raise FormatError(f"{self.table.source}: no row has values of all joints.")
        if open_angles and self._are_degrees(values, open_angles, state, tracks):
            self.assumed.append("joint values in deg")
            values |= {symbol: np.radians(values[symbol]) for symbol in open_angles}
        return values, rows

    def _quantity(self, symbol: Symbol) -> str:
        """Return "angle" for a coordinate by which something turns, else "length"."""
        for one in self.model.articulations.values():
            if symbol in one.coordinates:
                pose = self.model.fk(one.child, relative_to=one.parent)
                return "angle" if symbol in pose[:3, :3].symbols else "length"
        return "angle"

    def _are_degrees(
        self,
        values: Mapping[Symbol, Array],
        angles: Sequence[Symbol],
        state: Mapping[Symbol | str, float],
        tracks: Sequence[tuple[str, str, RecordedTrack]],
    ) -> bool:
        """Return True if values without a unit are degrees: by what was seen, else by the limits."""
        in_degrees = {**values, **{s: np.radians(values[s]) for s in angles}}
        plain, turned = self._misfit(tracks, values, state), self._misfit(tracks, in_degrees, state)
        if plain > _DECISIVE * turned:
            return True
        if turned > _DECISIVE * plain:
            return False
        return any(float(np.nanmax(np.abs(values[s]))) > 2.0 * math.pi for s in angles)

    def _check_complete(
        self,
        values: Mapping[Symbol, Array],
        state: Mapping[Symbol | str, float],
        seen: Sequence[tuple[str, str]],
    ) -> None:
        """Check that all joints between a frame and where it was seen have values."""
        known = {*map(str, values), *map(str, state)}
        for frame, seen_in in seen:
            used = self.model.fk(frame, relative_to=seen_in).symbols
            missing = [str(s) for s in used if s.has_derivative and s.order == 0 and str(s) not in known]
            if missing:
                raise UnknownNameError(
                    f"{self.table.source}: '{frame}' as seen in '{seen_in}' depends on "
                    f"{list_some(missing, 4)}, which no column has. If they stay the same in all looks, give "
                    "their values: state="
                )

    def _check_turns(
        self,
        tracks: Sequence[tuple[str, str, RecordedTrack]],
        values: Mapping[Symbol, Array],
        state: Mapping[Symbol | str, float],
    ) -> tuple[str, ...]:
        """Refuse quaternions in the wrong order; return a remark if nothing turns as the joints do."""
        plain = self._misfit(tracks, values, state)
        if plain < _DOUBTFUL:
            return ()
        turned = [
            (frame, seen_in, replace(track, poses=_reordered_quaternions(track.poses)))
            for frame, seen_in, track in tracks
            if track.has_orientation
        ]
        if plain > _DECISIVE * self._misfit(turned, values, state):
            raise FormatError(
                f"{self.table.source}: what was seen turns as the joints do if its quaternions are w, x, y, "
                "z, though their columns are called qx, qy, qz, qw. Correct the first line, or name the "
                "columns in their order, by columns="
            )
        angle = math.degrees(plain)
        return (
            f"what was seen does not turn as the joints do: by {angle:.0f} deg more or less, in the median. "
            "Do the rows belong together, and is it the pose of the frame in the other one, not the inverse?",
        )

    def _misfit(
        self,
        tracks: Sequence[tuple[str, str, RecordedTrack]],
        values: Mapping[Symbol, Array],
        state: Mapping[Symbol | str, float],
    ) -> float:
        """Return the median difference of the angles between looks, seen and by the joints [rad].

        R_i = C⁻¹ A(q_i) M is seen. So products of R_i R_jᵀ turn by the angle of those of A_i A_jᵀ, for all
        mounts C and M. They are products of two, since the order of quaternions leaves the angle of one.
        """
        known = {str(s): v for s, v in state.items()}
        misfits = []
        for frame, seen_in, track in tracks:
            rotation = self.model.fk(frame, relative_to=seen_in)[:3, :3]
            symbols = [s for s in rotation.symbols if s.order == 0]
            fixed = {s: known.get(str(s), s.value) for s in symbols if s not in values}
            if not track.has_orientation or any(v is None for v in fixed.values()):
                continue
            moving = [s for s in symbols if s in values]
            if not moving:
                continue
            part: Any = rotation.substitute(fixed)  # type: ignore[arg-type]
            function = compile(part, moving, tier="interpreter")
            columns = np.stack([values[s][track.rows] for s in moving], axis=1)
            good = np.isfinite(columns).all(axis=1)
            some = np.flatnonzero(good)[:: max(1, int(good.sum()) // _LOOKS)]
            if len(some) < 3:
                continue
            predicted, seen = function.batch(columns[some]), rotation_of(track.poses[some])
            a, b = np.triu_indices(len(some), 1)
            other = np.random.default_rng(0).permutation(len(a))
            turns = [r[a] @ np.swapaxes(r[b], 1, 2) for r in (np.asarray(predicted), seen)]
            angles = [rotation_angle(turn @ turn[other]) for turn in turns]
            misfits.append(float(np.median(np.abs(angles[0] - angles[1]))))
        return max(misfits, default=0.0) + _NOTHING

    # -- pixels ----------------------------------------------------------------------------------------------

    def _read_pixels(
        self,
        observations: list[list[tuple[Any, Any] | ObservedPixel]],
        frame: str | None,
        places: Mapping[str, int],
        camera: str | None,
        focal: tuple[ExpressionLike, ExpressionLike] | None,
        centre: tuple[ExpressionLike, ExpressionLike],
    ) -> None:
        if {*places} != {"u", "v"}:
            raise FormatError(
                f"{self.table.source}: a pixel has the columns u and v; one of them is missing."
            )
        if frame is None or camera is None or focal is None:
            missing = [
                name
                for name, value in (("observed=", frame), ("relative_to=", camera), ("focal=", focal))
                if value is None
            ]
            raise FormatError(
                f"{self.table.source}: pixels need the frame that was seen, that of the camera, and its "
                f"focal length: {', '.join(missing)} is missing."
            )
        frame = self._frame(frame, "The part")
        u, v = (self._numbers(places[axis], "pixel")[0] for axis in "uv")
        for row in np.flatnonzero(np.isfinite(u) & np.isfinite(v)).tolist():
            pixel = float(u[row]), float(v[row])
            observations[row].append(ObservedPixel(frame, camera, pixel, focal=focal, centre=centre))


def _reordered_quaternions(poses: Array) -> Array:
    """Return poses (N, 4, 4) whose quaternions were w, x, y, z where x, y, z, w was read."""
    quaternions = to_quaternion(poses[:, :3, :3])
    # The sign of a quaternion says nothing, so reordering its numbers is as good as it is from the file.
    return transform(quaternion(np.roll(quaternions, -1, axis=1)), poses[:, :3, 3])
