"""Trajectories in JSON files: plain data with names, exact to the last bit.

::

    {"format": "kineverse trajectory", "version": 1, "coordinates": ["kitchen/fridge_door", ...],
     "times": [0.0, ...], "positions": [[0.0, ...], ...], "velocities": [[0.0, ...], ...]}

Times are in [s], positions and velocities in [rad], [m] and per second, one row for each time.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import numpy as np

from kineverse.errors import ExpressionError, FormatError
from kineverse.formats.files import read_file, replace_file
from kineverse.lie import Array
from kineverse.symbols import Symbol, parse_symbol_name

FORMAT = "kineverse trajectory"
VERSION = 1


class TrajectoryData(NamedTuple):
    """Names and numbers of a trajectory: names (n,), times (T,), positions and velocities (T, n)."""

    names: list[str]
    times: Array
    positions: Array
    velocities: Array


def check_trajectory_name(path: str | os.PathLike[str]) -> None:
    """Check that a file name ends in .json, or has no suffix."""
    suffix = Path(path).suffix
    if suffix.lower() not in ("", ".json"):
        raise FormatError(
            f"Trajectories are written as .json, not {suffix}: '{Path(path).with_suffix('.json')}'."
        )


def write_trajectory_file(path: str | os.PathLike[str], data: TrajectoryData) -> None:
    """Write a trajectory to a file."""
    check_trajectory_name(path)
    document = {"format": FORMAT, "version": VERSION, "coordinates": data.names}
    document |= {key: getattr(data, key).tolist() for key in data._fields[1:]}
    replace_file(Path(path), json.dumps(document, allow_nan=False).encode())


def read_trajectory_file(path: str | os.PathLike[str]) -> TrajectoryData:
    """Read a trajectory from a file, and check types and shapes."""
    path = Path(path)
    source = path.name

    def refuse(text: str) -> NoReturn:
        raise FormatError(f"{source}: {text} is not a number.")

    try:
        document = json.loads(read_file(path), parse_constant=refuse)
    except (ValueError, RecursionError) as error:
        if isinstance(error, FormatError):
            raise
        raise FormatError(f"{source}: not JSON: {str(error)[:200]}.") from None
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise FormatError(f'{source}: not a trajectory, which is an object with "format": "{FORMAT}".')
    if document.get("version") != VERSION:
        raise FormatError(
            f"{source}: version {document.get('version')!r:.40} of the format; this version reads {VERSION}."
        )
    missing = [key for key in ("coordinates", *TrajectoryData._fields[1:]) if key not in document]
    if missing:
        raise FormatError(f"{source}: there is no {missing[0]!r}.")
    names = document["coordinates"]
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise FormatError(f"{source}: 'coordinates' is a list of names.")
    times = _numbers(document["times"], "times", source)
    shape = (times.size, len(names))
    tables = (_table(document[key], key, shape, source) for key in ("positions", "velocities"))
    return TrajectoryData(names, times, *tables)


def parse_coordinates(names: list[str], source: str) -> tuple[Symbol, ...]:
    """Parse names of coordinates."""
    result = []
    for name in names:
        try:
            path, order = parse_symbol_name(name)
            symbol = Symbol(path, order)
        except ExpressionError as error:
            raise FormatError(f"{source}: {name!r:.80} is not the name of a coordinate: {error}") from None
        if order:
            raise FormatError(f"{source}: {name!r:.80} is a derivative; the columns are positions.")
        result.append(symbol)
    return tuple(result)


def _numbers(values: Any, key: str, source: str) -> Array:
    """Read a list of numbers as an array; texts, truth values and nested lists are refused."""
    if not isinstance(values, list):
        raise FormatError(f"{source}: '{key}' is a list of numbers, not {values!r:.40}.")
    for value in values:
        if type(value) not in (int, float):
            raise FormatError(f"{source}: {value!r:.40} in '{key}' is not a number.")
    try:
        return np.array(values, dtype=float)
    except OverflowError:
        raise FormatError(f"{source}: '{key}' has a number that is too large.") from None


def _table(rows: Any, key: str, shape: tuple[int, int], source: str) -> Array:
    if not isinstance(rows, list) or len(rows) != shape[0]:
        raise FormatError(f"{source}: '{key}' is a list of {shape[0]} rows, one for each time.")
    table = np.empty(shape)
    for k, row in enumerate(rows):
        numbers = _numbers(row, key, source)
        if len(numbers) != shape[1]:
            raise FormatError(
                f"{source}: row {k} of '{key}' has {len(numbers)} numbers, and there are {shape[1]} "
                "coordinates."
            )
        table[k] = numbers
    return table
