"""Remarks on positions that are set beyond limits, where a unit was forgotten most of all."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

from kineverse.cli.assignments import UNITS, has_unit, unit_kind
from kineverse.cli.table import figure

if TYPE_CHECKING:
    import kineverse as kv

SMALLER = {"rad": ("deg",), "m": ("cm", "mm")}
"""What people think in instead of radians and metres."""


def remarks(model: kv.Model, values: Mapping[str, float], texts: Iterable[str]) -> list[str]:
    """Return a line for everything that is violated, and for angles of more than a turn that have no unit.

    Parameters
    ----------
    model
        The model.
    values
        Of all its symbols, by name [rad], [m].
    texts
        What was given as ``--set``.
    """
    import kineverse as kv
    from kineverse.view.units import units

    given = {text.rpartition("=")[0].strip(): text for text in texts}
    kinds = units(model, values, given) if given else {}
    said, lines = set(), []
    for name, text in given.items():
        lower, upper = map(float, model.limits(model.symbol(name)))
        kind, value = kinds[name], values[name]
        if unit_kind(text) not in (None, kind) and kind:
            sort, wrong = "an angle" if kind == "rad" else "a length", text.rpartition("=")[2].strip()
            lines.append(f"{name} is {sort}, and {wrong} is none: it is taken for {figure(value, 6)} {kind}")
        turns = kind == "rad" and abs(value) > math.tau and not has_unit(text)
        if lower <= value <= upper and not turns:
            continue
        said.add(name)
        what = f"{name} = {figure(value, 6)} {kind}".rstrip()
        if lower <= value <= upper:
            what += f" is {figure(value / math.tau, 3)} turns"
        else:
            what += f" is beyond its limits [{figure(lower)}, {figure(upper)}]"
        lines.append(what + _meant(text, kind, lower, upper))
    for violation in model.violations(kv.State(values)):
        about = [str(symbol) for symbol in model.constraints[violation.name].expression.symbols]
        if len(about) == 1 and about[0] in said:
            continue
        lines.append(
            f"{violation.name} is violated: {figure(violation.value)} is not in "
            f"[{figure(violation.lower)}, {figure(violation.upper)}]"
        )
    return lines


def note(lines: Iterable[str]) -> None:
    """Print remarks on standard error."""
    for line in lines:
        print(f"kineverse: note: {line}", file=sys.stderr)


def _meant(text: str, kind: str, lower: float, upper: float) -> str:
    """Return what the same number means in a smaller unit, if it is within the limits in that."""
    if has_unit(text):
        return ""
    name, _, number = text.rpartition("=")
    value = float(number) if _is_number(number) else math.nan
    for unit in SMALLER.get(kind, ()):
        if lower <= value * UNITS[unit] <= upper:
            long = "degrees" if unit == "deg" else unit
            return f"; in {long} it is --set {name.strip()}={number.strip()}{unit}"
    return ""


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
