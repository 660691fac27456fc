"""What two models do differently, as text and as JSON."""

from __future__ import annotations

import math
from typing import Any

from kineverse.cli.behaviour import Behaviour, Range
from kineverse.cli.paint import bounded, paint
from kineverse.cli.wording import apart, interval


def blocks(found: Behaviour, most: int | None) -> list[list[str]]:
    """Return the paragraphs of the report, with at most so many lines each."""
    result = []
    for title, sides in (("frames", found.frames), ("degrees of freedom", found.freedoms)):
        lines = [
            f"  {paint(sign, sign)} {name}"
            for sign, side in (("-", "removed"), ("+", "added"))
            for name in sides[side]
        ]
        if lines:
            result.append([paint(title, "bold"), *bounded(lines, most)])
    if found.apart:
        width = max(len(a.frame) for a in found.apart)
        lines = [f"  {paint('~', '~')} {a.frame:<{width}}  {apart(a.distance, a.angle)}" for a in found.apart]
        title = f"{paint('poses', 'bold')}, at worst in {found.states} states"
        result.append([title, *bounded(lines, most)])
    if found.ranges:
        width = max(len(r.name) for r in found.ranges)
        lines = [
            f"  {paint('~', '~')} {r.name:<{width}}  {interval(*r.before)} → {interval(*r.after)}"
            for r in found.ranges
        ]
        result.append([paint("limits", "bold"), *bounded(lines, most)])
    if not found.apart:
        common = len(found.frames["common"])
        agree = f"{common} frames are at the same places in {found.states} states"
        result.append([f"{agree}, to within {apart(*found.largest)}" if any(found.largest) else agree])
    return result


def as_json(found: Behaviour) -> dict[str, Any]:
    """Return all of it as JSON has it; a pose that is nowhere on one side is null apart."""
    return {
        "states": found.states,
        "largest": {"distance": _finite(found.largest[0]), "angle": _finite(found.largest[1])},
        "frames": {
            "removed": found.frames["removed"],
            "added": found.frames["added"],
            "changed": [
                {"name": a.frame, "distance": _finite(a.distance), "angle": _finite(a.angle)}
                for a in found.apart
            ],
        },
        "dof": {
            "removed": found.freedoms["removed"],
            "added": found.freedoms["added"],
            "changed": [_range(r) for r in found.ranges],
        },
    }


def _range(found: Range) -> dict[str, Any]:
    return {
        "name": found.name,
        "before": [_finite(bound) for bound in found.before],
        "after": [_finite(bound) for bound in found.after],
    }


def _finite(number: float) -> float | None:
    return number if math.isfinite(number) else None
