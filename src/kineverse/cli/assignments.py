"""``--set NAME=VALUE``: positions on the command line."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Iterable

from kineverse.errors import NameTakenError, ValueRejectedError

_NUMBER = r"(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?"
_VALUE = re.compile(
    rf"(?P<sign>[-+]?)\s*(?:(?P<number>{_NUMBER})?\s*(?:(?P<times>\*?)\s*(?P<pi>pi|π))?)"
    rf"\s*(?:/\s*(?P<divisor>{_NUMBER}))?\s*(?P<unit>deg|°|rad|mm|cm|m)?"
)

UNITS = {
    None: 1.0,
    "rad": 1.0,
    "deg": math.pi / 180.0,
    "°": math.pi / 180.0,
    "m": 1.0,
    "cm": 0.01,
    "mm": 0.001,
}
LENGTHS = (None, "m", "cm", "mm")


def add_set_option(parser: argparse.ArgumentParser) -> None:
    """Add ``--set`` to a command."""
    parser.add_argument(
        "--set",
        metavar="NAME=VALUE",
        action="append",
        default=[],
        dest="assignments",
        help="a position in rad or m: 0.3, pi/2, 30deg, 12cm; may be given several times",
    )


def parse_assignments(texts: Iterable[str]) -> dict[str, float]:
    """Return values by name from texts like ``kitchen/fridge_door=30deg``.

    Raises
    ------
    ValueRejectedError
        If a text is no assignment, or the value no finite number.
    NameTakenError
        If there are two values for a name.
    """
    values: dict[str, float] = {}
    for text in texts:
        # A value has no equals sign in it; a name may.
        name, equals, value = text.rpartition("=")
        if not equals or not name.strip():
            raise ValueRejectedError(f"--set {text!r}: write NAME=VALUE, such as kitchen/fridge_door=0.3")
        if name.strip() in values:
            raise NameTakenError(f"--set {name.strip()} is given twice.")
        values[name.strip()] = parse_value(value)
    return values


def has_unit(text: str) -> bool:
    """Whether a value says what it is measured in; parts of pi are angles."""
    return unit_kind(text) is not None


def unit_kind(text: str) -> str | None:
    """Return ``rad`` or ``m``, whichever a value is measured in; None if it does not say."""
    match = _VALUE.fullmatch(text.rpartition("=")[2].strip())
    if match is None or not (match["unit"] or match["pi"]):
        return None
    return "m" if match["unit"] in LENGTHS[1:] else "rad"


def parse_length(text: str) -> float:
    """Return the number [m] of a text such as ``0.05``, ``5cm``, ``2 mm``.

    Raises
    ------
    ValueRejectedError
        If it is none, not finite, or an angle.
    """
    match = _VALUE.fullmatch(text.strip())
    if match is None or match["unit"] not in LENGTHS or match["pi"]:
        raise ValueRejectedError(f"{text.strip()!r} is not a length; write a number of m (0.05), or 5cm, 2mm")
    return parse_value(text)


def parse_value(text: str) -> float:
    """Return the number [rad] or [m] of a text such as ``0.3``, ``-pi/2``, ``1.5pi``, ``30deg``, ``12 cm``.

    Raises
    ------
    ValueRejectedError
        If it is none, or not finite.
    """
    match = _VALUE.fullmatch(text.strip())
    if match is None or not (match["number"] or match["pi"]) or (match["times"] and not match["number"]):
        raise ValueRejectedError(
            f"{text.strip()!r} is not a value; write a finite number of rad or m (0.3, 1e-2), "
            "parts of pi (pi/2, -0.5*pi), or a unit (30deg, 12cm, 5mm)"
        )
    value = float(match["number"] or 1.0) * (math.pi if match["pi"] else 1.0)
    divisor = float(match["divisor"] or 1.0)
    if divisor == 0.0:
        raise ValueRejectedError(f"{text.strip()!r} divides by zero")
    value = value / divisor * UNITS[match["unit"]] * (-1.0 if match["sign"] == "-" else 1.0)
    if not math.isfinite(value):
        raise ValueRejectedError(f"{text.strip()!r} is not finite")
    return value
