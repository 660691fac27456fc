"""Differences of two models as text and as JSON."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from kineverse.cli.format_values import (
    format_contents,
    format_count,
    format_delta,
    format_interval,
    format_pose_difference,
    format_value,
    value_to_json,
)
from kineverse.cli.output import colorize, truncate_lines
from kineverse.model.compare import SIGNS, Delta, ModelComparison, ValueDifference
from kineverse.model.operation import ARTICULATIONS, BODIES, CONSTRAINTS, DATA, FRAMES, RATES
from kineverse.model.sampled_comparison import BehaviourComparison, LimitDifference

ORDER = (FRAMES, CONSTRAINTS, BODIES, ARTICULATIONS, RATES, DATA)
WORDS = {**SIGNS, ">": "moved"}
_WIDEST = 44


@dataclass(frozen=True)
class ModelComparisonReport:
    """Printable differences of two models, by value."""

    found: ModelComparison

    def blocks(self, most: int | None) -> list[list[str]]:
        """Return the paragraphs of the report, with at most so many differences each."""
        result = [_operation_lines(self.found, most)] if any(self.found.operations.values()) else []
        for kind in ORDER:
            differences = self.found.by_kind(kind)
            if differences:
                result.append([colorize(kind, "bold"), *_difference_lines(differences, most)])
        result.append(_totals(self.found))
        return result

    def as_json(self) -> dict[str, Any]:
        """Return all of it as JSON has it: by operation, and by kind of data."""
        operations = {WORDS[sign]: list(tags) for sign, tags in self.found.operations.items()}
        return {
            "operations": operations if self.found.operations_compared else None,
            **{kind: _kind_to_json(self.found.by_kind(kind)) for kind in ORDER},
            "alike": self.found.alike,
        }


def _operation_lines(found: ModelComparison, most: int | None) -> list[str]:
    lines = [f"  {colorize(sign, sign)} {tag}" for sign, tags in found.operations.items() for tag in tags]
    return [colorize("operations", "bold"), *truncate_lines(lines, most)]


def _difference_lines(differences: list[ValueDifference], most: int | None) -> list[str]:
    shown = differences[:most]
    width = min(max(len(d.change.name) for d in shown), _WIDEST)
    entries = []
    for difference in shown:
        first, *others = _difference_texts(difference)
        sign = colorize(difference.sign, difference.sign)
        line = f"  {sign} {difference.change.name:<{width}}  {first}".rstrip()
        entries.append("\n".join([line, *(" " * (width + 6) + text for text in others)]))
    return [*entries, *truncate_lines([""] * len(differences), len(shown))[len(shown) :]]


def _difference_texts(difference: ValueDifference) -> list[str]:
    change = difference.change
    if change.before is not None and change.after is not None:
        return [text for delta in difference.parts for text in format_delta(delta)]
    there = change.after if change.before is None else change.before
    return [format_value(there[1] if change.kind == RATES else there)]


def _totals(found: ModelComparison) -> list[str]:
    """Return the sum, and what was not counted."""
    within = f"within {found.tolerance:g}" if found.tolerance else "to the bit"
    notes = []
    if found.alike:
        notes.append(f"{format_count(len(found.alike), 'value')} written or rounded in another way")
    if not found.operations_compared:
        notes.append("operations not compared")
    said = f" ({', '.join(notes)})" if notes else ""
    if found.equal:
        return [f"equal {within}: {format_contents(found.after)}{said}"]
    counts = ", ".join(f"{count} {word}" for word, count in found.counts.items() if count)
    lines = [f"{format_count(len(found.differences), 'difference')}: {counts or 'in operations only'}{said}"]
    if not set(found.before.frames) & set(found.after.frames) and found.before.frames and found.after.frames:
        lines.append("They have no frame in common; --prefix NAME puts the same name in front of both.")
    return lines


def _kind_to_json(differences: list[ValueDifference]) -> dict[str, Any]:
    by_sign = {word: [d for d in differences if d.sign == sign] for sign, word in SIGNS.items()}
    return {
        "added": [d.change.name for d in by_sign["added"]],
        "removed": [d.change.name for d in by_sign["removed"]],
        "changed": [
            {"name": d.change.name, "parts": [_delta_to_json(delta) for delta in d.parts]}
            for d in by_sign["changed"]
        ],
    }


def _delta_to_json(delta: Delta) -> dict[str, Any]:
    return {
        "what": delta.what,
        "before": value_to_json(delta.before),
        "after": value_to_json(delta.after),
        "distance": delta.distance if math.isfinite(delta.distance) else None,
        "angle": delta.angle if math.isfinite(delta.angle) else None,
    }


@dataclass(frozen=True)
class BehaviourComparisonReport:
    """Printable differences of two models, by behaviour."""

    found: BehaviourComparison

    def blocks(self, most: int | None) -> list[list[str]]:
        """Return the paragraphs of the report, with at most so many lines each."""
        result = []
        for title, sides in (("frames", self.found.frames), ("degrees of freedom", self.found.freedoms)):
            lines = [
                f"  {colorize(sign, sign)} {name}"
                for sign, side in (("-", "removed"), ("+", "added"))
                for name in sides[side]
            ]
            if lines:
                result.append([colorize(title, "bold"), *truncate_lines(lines, most)])
        if self.found.apart:
            width = max(len(a.frame) for a in self.found.apart)
            lines = [
                f"  {colorize('~', '~')} {a.frame:<{width}}  {format_pose_difference(a.distance, a.angle)}"
                for a in self.found.apart
            ]
            title = f"{colorize('poses', 'bold')}, at worst in {self.found.states} states"
            result.append([title, *truncate_lines(lines, most)])
        if self.found.ranges:
            width = max(len(r.name) for r in self.found.ranges)
            lines = [
                f"  {colorize('~', '~')} {r.name:<{width}}  "
                f"{format_interval(*r.before)} → {format_interval(*r.after)}"
                for r in self.found.ranges
            ]
            result.append([colorize("limits", "bold"), *truncate_lines(lines, most)])
        if self.found.helpers:
            names = ", ".join(self.found.helpers[:most])
            more = "" if most is None or len(self.found.helpers) <= most else ", ..."
            result.append([f"not counted, in between and without bodies: {names}{more}"])
        if not self.found.apart:
            common = format_count(len(self.found.frames["common"]), "frame")
            agree = f"{common} at the same places in {self.found.states} states"
            result.append(
                [
                    f"{agree}, to within {format_pose_difference(*self.found.largest)}"
                    if any(self.found.largest)
                    else agree
                ]
            )
        return result

    def as_json(self) -> dict[str, Any]:
        """Return all of it as JSON has it; a pose that is nowhere on one side is null apart."""
        return {
            "states": self.found.states,
            "largest": {
                "distance": _finite_or_none(self.found.largest[0]),
                "angle": _finite_or_none(self.found.largest[1]),
            },
            "frames": {
                "removed": self.found.frames["removed"],
                "added": self.found.frames["added"],
                "helpers": self.found.helpers,
                "changed": [
                    {
                        "name": a.frame,
                        "distance": _finite_or_none(a.distance),
                        "angle": _finite_or_none(a.angle),
                    }
                    for a in self.found.apart
                ],
            },
            "dof": {
                "removed": self.found.freedoms["removed"],
                "added": self.found.freedoms["added"],
                "changed": [_limits_to_json(r) for r in self.found.ranges],
            },
        }


def _limits_to_json(found: LimitDifference) -> dict[str, Any]:
    return {
        "name": found.name,
        "before": [_finite_or_none(bound) for bound in found.before],
        "after": [_finite_or_none(bound) for bound in found.after],
    }


def _finite_or_none(number: float) -> float | None:
    return number if math.isfinite(number) else None
