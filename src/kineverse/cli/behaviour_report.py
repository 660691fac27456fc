"""What two models do differently, as text and as JSON."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from kineverse.cli.behaviour import Behaviour, Range
from kineverse.cli.paint import bounded, paint
from kineverse.cli.wording import apart, interval, number


@dataclass(frozen=True)
class BehaviourReport:
    """What two models do differently, to be printed."""

    found: Behaviour

    def blocks(self, most: int | None) -> list[list[str]]:
        """Return the paragraphs of the report, with at most so many lines each."""
        result = []
        for title, sides in (("frames", self.found.frames), ("degrees of freedom", self.found.freedoms)):
            lines = [
                f"  {paint(sign, sign)} {name}"
                for sign, side in (("-", "removed"), ("+", "added"))
                for name in sides[side]
            ]
            if lines:
                result.append([paint(title, "bold"), *bounded(lines, most)])
        if self.found.apart:
            width = max(len(a.frame) for a in self.found.apart)
            lines = [
                f"  {paint('~', '~')} {a.frame:<{width}}  {apart(a.distance, a.angle)}"
                for a in self.found.apart
            ]
            title = f"{paint('poses', 'bold')}, at worst in {self.found.states} states"
            result.append([title, *bounded(lines, most)])
        if self.found.ranges:
            width = max(len(r.name) for r in self.found.ranges)
            lines = [
                f"  {paint('~', '~')} {r.name:<{width}}  {interval(*r.before)} → {interval(*r.after)}"
                for r in self.found.ranges
            ]
            result.append([paint("limits", "bold"), *bounded(lines, most)])
        if self.found.helpers:
            names = ", ".join(self.found.helpers[:most])
            more = "" if most is None or len(self.found.helpers) <= most else ", ..."
            result.append([f"not counted, in between and without bodies: {names}{more}"])
        if not self.found.apart:
            common = number(len(self.found.frames["common"]), "frame")
            agree = f"{common} at the same places in {self.found.states} states"
            result.append(
                [f"{agree}, to within {apart(*self.found.largest)}" if any(self.found.largest) else agree]
            )
        return result

    def as_json(self) -> dict[str, Any]:
        """Return all of it as JSON has it; a pose that is nowhere on one side is null apart."""
        return {
            "states": self.found.states,
            "largest": {"distance": _finite(self.found.largest[0]), "angle": _finite(self.found.largest[1])},
            "frames": {
                "removed": self.found.frames["removed"],
                "added": self.found.frames["added"],
                "helpers": self.found.helpers,
                "changed": [
                    {"name": a.frame, "distance": _finite(a.distance), "angle": _finite(a.angle)}
                    for a in self.found.apart
                ],
            },
            "dof": {
                "removed": self.found.freedoms["removed"],
                "added": self.found.freedoms["added"],
                "changed": [_range(r) for r in self.found.ranges],
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
