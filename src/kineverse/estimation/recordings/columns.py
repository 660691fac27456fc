"""Column names, quantities and units of a pose table."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType

from kineverse.errors import FormatError

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
