"""Options and values of the command line.

Model sources, ``--set NAME=VALUE``, units, limits; requirements of commands.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import kineverse as kv
from kineverse._extras import install_command
from kineverse._names import is_pattern, match_names
from kineverse.compilation.toolchain import no_compiler, toolchain
from kineverse.errors import (
    CompileError,
    DuplicateNameError,
    InvalidValueError,
    MissingDependencyError,
)
from kineverse.expressions.printing import format_number
from kineverse.formats.file_formats import is_mjcf
from kineverse.model.kinematics import infer_units
from kineverse.model.registry import find_scheme

from .output import format_cells, print_line

if TYPE_CHECKING:
    from kineverse.model.model_view import ModelView

_NUMBER_PATTERN = r"(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?"
_VALUE_PATTERN = re.compile(
    rf"(?P<sign>[-+]?)\s*(?:(?P<number>{_NUMBER_PATTERN})?\s*(?:(?P<times>\*?)\s*(?P<pi>pi|π))?)"
    rf"\s*(?:/\s*(?P<divisor>{_NUMBER_PATTERN}))?\s*(?P<unit>deg|°|rad|mm|cm|m)?"
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


def add_set_option(parser: argparse.ArgumentParser, what: str = "a position") -> None:
    """Add ``--set`` to a command, with what it sets."""
    parser.add_argument(
        "--set",
        metavar="NAME=VALUE",
        action="append",
        default=[],
        dest="assignments",
        help=f"{what} in rad or m: 0.3, pi/2, 30deg, 12cm; may be given several times",
    )


def parse_assignments(texts: Iterable[str], option: str = "--set") -> dict[str, float]:
    """Return values by name from texts like ``kitchen/fridge_door=30deg``, given by an option."""
    values: dict[str, float] = {}
    for text in texts:
        # A name may contain an equals sign, a value does not.
        name, equals, value = text.rpartition("=")
        if not equals or not name.strip():
            raise InvalidValueError(f"{option} {text!r}: write NAME=VALUE, such as kitchen/fridge_door=0.3")
        if name.strip() in values:
            raise DuplicateNameError(f"{option} {name.strip()} is given twice.")
        values[name.strip()] = parse_value(value)
    return values


def has_unit(text: str) -> bool:
    """Return whether a value has a unit; parts of pi are angles."""
    return unit_kind(text) is not None


def unit_kind(text: str) -> str | None:
    """Return the base unit of a value, ``rad`` or ``m``; None if the text has no unit."""
    match = _VALUE_PATTERN.fullmatch(text.rpartition("=")[2].strip())
    if match is None or not (match["unit"] or match["pi"]):
        return None
    return "m" if match["unit"] in LENGTHS[1:] else "rad"


def parse_length(text: str) -> float:
    """Return the number [m] of a text such as ``0.05``, ``5cm``, ``2 mm``."""
    match = _VALUE_PATTERN.fullmatch(text.strip())
    if match is None or match["unit"] not in LENGTHS or match["pi"]:
        raise InvalidValueError(f"{text.strip()!r} is not a length; write a number of m (0.05), or 5cm, 2mm")
    return parse_value(text)


def parse_pose_numbers(texts: Sequence[str]) -> tuple[float, ...]:
    """Return the numbers of X, Y, Z [m], and of ROLL, PITCH, YAW [rad] that may follow."""
    for text in texts[3:]:
        if unit_kind(text) == "m":
            raise InvalidValueError(
                f"{text.strip()!r} is not an angle; write a number of rad (0.5), or 30deg"
            )
    return (*map(parse_length, texts[:3]), *map(parse_value, texts[3:]))


def parse_value(text: str) -> float:
    """Return number [rad] or [m] of a text such as ``0.3``, ``-pi/2``, ``1.5pi``, ``30deg``, ``12 cm``."""
    match = _VALUE_PATTERN.fullmatch(text.strip())
    if match is None or not (match["number"] or match["pi"]) or (match["times"] and not match["number"]):
        raise InvalidValueError(
            f"{text.strip()!r} is not a value; write a finite number of rad or m (0.3, 1e-2), "
            "parts of pi (pi/2, -0.5*pi), or a unit (30deg, 12cm, 5mm)"
        )
    value = float(match["number"] or 1.0) * (math.pi if match["pi"] else 1.0)
    divisor = float(match["divisor"] or 1.0)
    if divisor == 0.0:
        raise InvalidValueError(f"{text.strip()!r} divides by zero")
    value = value / divisor * UNITS[match["unit"]] * (-1.0 if match["sign"] == "-" else 1.0)
    if not math.isfinite(value):
        raise InvalidValueError(f"{text.strip()!r} is not finite")
    return value


def add_cache_options(parser: argparse.ArgumentParser, force: str) -> None:
    """Declare the options of a command about its cache; ``force`` is the help of ``--force``."""
    parser.add_argument("--force", action="store_true", help=force)
    parser.add_argument("--json", action="store_true", help="everything, as one JSON object")
    parser.add_argument("--list", action="store_true", help="list the cache and exit")
    parser.add_argument("--clear", action="store_true", help="empty the cache and exit")


def manage_cache(
    arguments: argparse.Namespace,
    named: object,
    what: str,
    folder: Path,
    clear: Callable[[], int],
    head: Sequence[str],
    entries: Sequence[tuple[dict[str, Any], Sequence[str]]],
) -> int:
    """List or empty a cache, see :func:`add_cache_options`, and return the status.

    ``named`` is what the command line names, which is an error, ``what`` the plural of what lies in the
    folder. Each entry has its facts and its row below ``head``.
    """
    if named or (arguments.list and arguments.clear):
        raise InvalidValueError("--list and --clear act on the whole cache: give one of them, and no names.")
    if arguments.clear:
        count = clear()
        print(json.dumps({"removed": count}) if arguments.json else f"{count} removed from {folder}")
        return 0
    facts, rows = [entry[0] for entry in entries], [entry[1] for entry in entries]
    if arguments.json:
        print(json.dumps({"folder": str(folder), what: facts}, allow_nan=False))
    elif rows:
        print(format_cells(head, rows))
    else:
        print(f"There are no {what} in {folder}.")
    return 0


def add_model_options(
    parser: argparse.ArgumentParser, strict: str = "refuse a file that is otherwise read with remarks"
) -> None:
    """Declare ``--root``, ``--loops`` and ``--strict``, the last with the help text ``strict``."""
    parser.add_argument(
        "--root",
        metavar="FOLDER",
        help="folder that meshes and included files must lie in (the package or repository of the file)",
    )
    parser.add_argument(
        "--loops",
        choices=("solve", "constraint", "refuse"),
        default="solve",
        help="treatment of closed loops: solve those that can be solved (the default), keep all as equality "
        "constraints, or refuse a model with a loop that cannot be solved",
    )
    parser.add_argument("--strict", action="store_true", help=strict)


def load_model(
    arguments: argparse.Namespace, source: str, prefix: str | None = None, *, follow: bool = False
) -> kv.Model:
    """Load a model with the options of the command line.

    Of a live model it is a copy, which the command may edit, unless it is to ``follow`` the server.
    """
    options = {"root": arguments.root, "strict": arguments.strict, "loops": arguments.loops}
    if find_scheme(source) is None:
        return kv.load(source, prefix, **options)
    live: kv.Model = kv.load(source, **options)
    arguments.opened.enter_context(live)  # until the command ends, as meshes come from the server
    if prefix is None:
        return live if follow else live.copy()
    return kv.formats.from_bytes(kv.formats.to_bytes(live), prefix)


ALTERNATIVE_UNITS = {"rad": ("deg",), "m": ("cm", "mm")}
"""Units accepted on the command line, in radians and metres."""


def find_limit_notes(model: ModelView, values: Mapping[str, float], texts: Iterable[str]) -> list[str]:
    """Return a line for each violated limit or constraint, and for each angle above 2π without a unit.

    A value in a unit of lengths is refused for an angle, and the other way round.
    """
    given = {text.rpartition("=")[0].strip(): text for text in texts}
    kinds = infer_units(model, values, given) if given else {}
    reported, lines = set(), []
    for name, text in given.items():
        lower, upper = map(float, model.limits(model.symbol(name)))
        kind, value = kinds[name], values[name]
        check_unit("--set", text, name, kind)
        turns = kind == "rad" and abs(value) > math.tau and not has_unit(text)
        if lower <= value <= upper and not turns:
            continue
        reported.add(name)
        what = f"{name} = {format_number(value, 6)} {kind}".rstrip()
        if lower <= value <= upper:
            what += f" is {format_number(value / math.tau, 3)} turns"
        else:
            what += f" is beyond its limits [{format_number(lower)}, {format_number(upper)}]"
        lines.append(what + _suggest_unit(text, kind, lower, upper))
    for violation in model.violations(kv.State(values)):
        names = [str(symbol) for symbol in model.constraints[violation.name].expression.symbols]
        if len(names) == 1 and names[0] in reported:
            continue
        lines.append(
            f"{violation.name} is violated: {format_number(violation.value)} is not in "
            f"[{format_number(violation.lower)}, {format_number(violation.upper)}]"
        )
    return lines


def check_assigned_units(model: ModelView, texts: Iterable[str], option: str) -> None:
    """Raise InvalidValueError for a length that is assigned to an angle, and the other way round."""
    given = {text.rpartition("=")[0].strip(): text for text in texts if has_unit(text)}
    if not given:
        return
    values = {str(symbol): value for symbol, value in model.default_state().items()}
    for name, unit in infer_units(model, values, given).items():
        check_unit(option, given[name], name, unit)


def check_unit(option: str, text: str | None, coordinate: object, unit: str) -> None:
    """Raise InvalidValueError for a value in a unit of lengths or angles that is not its coordinate's."""
    stated = unit_kind(text or "")
    if unit and stated not in (None, unit):
        raise InvalidValueError(
            f"{option} {(text or '').strip()}: '{coordinate}' is in {unit}; write "
            f"{'30deg or 0.5' if unit == 'rad' else '12cm or 0.12'}, for instance."
        )


def find_turn_notes(texts: Iterable[str]) -> list[str]:
    """Return a line for each number of an angle above 2π without a unit."""
    angles = [text for text in texts if not has_unit(text) and abs(parse_value(text)) > math.tau]
    return [
        f"{text} rad is {format_number(parse_value(text) / math.tau, 3)} turns; in degrees it is {text}deg"
        for text in angles
    ]


def match_coordinates(model: ModelView, words: Iterable[str], option: str) -> list[str]:
    """Return the names of an option, with those of coordinates in place of patterns such as ``kitchen/*``."""
    names = [str(symbol) for symbol in model.degrees_of_freedom]
    # The library knows what else a name may stand for.
    parts = (match_names(w, names, "coordinate", option) if is_pattern(w) else (w,) for w in words)
    return [name for part in parts for name in part]


def print_notes(lines: Iterable[str]) -> None:
    """Print remarks on standard error."""
    for line in lines:
        print_line(f"kineverse: note: {line}")


def _suggest_unit(text: str, kind: str, lower: float, upper: float) -> str:
    """Return advice to write the number in a smaller unit, if that value is within the limits."""
    if has_unit(text):
        return ""
    name, _, number = text.rpartition("=")
    try:
        value = float(number)
    except ValueError:
        return ""
    for unit in ALTERNATIVE_UNITS.get(kind, ()):
        if lower <= value * UNITS[unit] <= upper:
            long = "degrees" if unit == "deg" else unit
            return f"; in {long} it is --set {name.strip()}={number.strip()}{unit}"
    return ""


MODULES: Mapping[str, str] = MappingProxyType(
    {
        "check": "pydrake",
        "control": "daqp",
        "decomposition": "coacd",
        "exchange": "zenoh",
        "figures": "matplotlib",
        "geometry": "coal",
        "mjcf": "mujoco",
        "recording": "mcap",
        "view": "viser",
    }
)
"""The module of each extra that is not in the core, and without which the extra is of no use."""

_HEAD = 1 << 16  # of a file, in which its root element begins [byte]


def require(what: str, extras: Mapping[str, bool], compiler: bool = False) -> None:
    """Raise if something is missing, and name all of it with how to install it."""
    needed = [extra for extra, is_needed in extras.items() if is_needed]
    missing = [extra for extra in needed if importlib.util.find_spec(MODULES[extra]) is None]
    sentences = []
    if missing:
        names = " and ".join(filter(None, [", ".join(map(repr, missing[:-1])), repr(missing[-1])]))
        noun = "extras" if len(missing) > 1 else "extra"
        modules = ", ".join(MODULES[extra] for extra in missing)
        sentences.append(f"{what} needs the {noun} {names} ({modules}): {install_command(*missing)}")
    if compiler and toolchain() is None:
        sentences.append(f"{what} needs a C compiler, and {no_compiler()}")
    if sentences:
        raise (MissingDependencyError if missing else CompileError)(". ".join(sentences))


def needs_mujoco(model: str) -> bool:
    """Return True for the path of a file that only MuJoCo reads."""
    try:
        with open(model, "rb") as file:
            return is_mjcf(model, file.read(_HEAD))
    except (OSError, ValueError):
        return False
