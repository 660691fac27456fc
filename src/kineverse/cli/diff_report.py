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

    comparison: ModelComparison

    def blocks(self, most: int | None) -> list[list[str]]:
        """Return the paragraphs of the report, with at most ``most`` differences each."""
        result = [_operation_lines(self.comparison, most)] if any(self.comparison.operations.values()) else []
        for kind in ORDER:
            differences = self.comparison.by_kind(kind)
            if differences:
                result.append([colorize(kind, "bold"), *_difference_lines(differences, most)])
        result.append(_totals(self.comparison))
        return result

    def as_json(self) -> dict[str, Any]:
        """Return the report as JSON data, by operation and by kind of data."""
        operations = {WORDS[sign]: list(tags) for sign, tags in self.comparison.operations.items()}
        return {
            "operations": operations if self.comparison.operations_compared else None,
            **{kind: _kind_to_json(self.comparison.by_kind(kind)) for kind in ORDER},
            "alike": self.comparison.alike,
        }


def _operation_lines(comparison: ModelComparison, most: int | None) -> list[str]:
    lines = [
        f"  {colorize(sign, sign)} {tag}" for sign, tags in comparison.operations.items() for tag in tags
    ]
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
    value = change.after if change.before is None else change.before
    return [format_value(value[1] if change.kind == RATES else value)]


def _totals(comparison: ModelComparison) -> list[str]:
    """Return the number of differences, with a note on those that are not counted."""
    within = f"within {comparison.tolerance:g}" if comparison.tolerance else "to the bit"
    notes = []
    if comparison.alike:
        notes.append(f"{format_count(len(comparison.alike), 'value')} written or rounded in another way")
    if not comparison.operations_compared:
        notes.append("operations not compared")
    note = f" ({', '.join(notes)})" if notes else ""
    if comparison.equal:
        return [f"equal {within}: {format_contents(comparison.after)}{note}"]
    counts = ", ".join(f"{count} {word}" for word, count in comparison.counts.items() if count)
    count = format_count(len(comparison.differences), "difference")
    lines = [f"{count}: {counts or 'in operations only'}{note}"]
    before, after = comparison.before.frames, comparison.after.frames
    if before and after and not set(before) & set(after):
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

    comparison: BehaviourComparison

    def blocks(self, most: int | None) -> list[list[str]]:
        """Return the paragraphs of the report, with at most ``most`` lines each."""
        result = []
        for title, sides in (
            ("frames", self.comparison.frames),
            ("degrees of freedom", self.comparison.freedoms),
        ):
            lines = [
                f"  {colorize(sign, sign)} {name}"
                for sign, side in (("-", "removed"), ("+", "added"))
                for name in sides[side]
            ]
            if lines:
                result.append([colorize(title, "bold"), *truncate_lines(lines, most)])
        if self.comparison.apart:
            width = max(len(a.frame) for a in self.comparison.apart)
            lines = [
                f"  {colorize('~', '~')} {a.frame:<{width}}  {format_pose_difference(a.distance, a.angle)}"
                for a in self.comparison.apart
            ]
            title = f"{colorize('poses', 'bold')}, at worst in {self.comparison.states} states"
            result.append([title, *truncate_lines(lines, most)])
        if self.comparison.ranges:
            width = max(len(r.name) for r in self.comparison.ranges)
            lines = [
                f"  {colorize('~', '~')} {r.name:<{width}}  "
                f"{format_interval(*r.before)} → {format_interval(*r.after)}"
                for r in self.comparison.ranges
            ]
            result.append([colorize("limits", "bold"), *truncate_lines(lines, most)])
        if self.comparison.helpers:
            names = ", ".join(self.comparison.helpers[:most])
            more = "" if most is None or len(self.comparison.helpers) <= most else ", ..."
            result.append([f"not counted, in between and without bodies: {names}{more}"])
        if not self.comparison.apart:
            common = format_count(len(self.comparison.frames["common"]), "frame")
            agree = f"{common} at the same places in {self.comparison.states} states"
            result.append(
                [
                    f"{agree}, to within {format_pose_difference(*self.comparison.largest)}"
                    if any(self.comparison.largest)
                    else agree
                ]
            )
        return result

    def as_json(self) -> dict[str, Any]:
        """Return the report as JSON data; a distance is null if the pose exists on one side only."""
        return {
            "states": self.comparison.states,
            "largest": {
                "distance": _finite_or_none(self.comparison.largest[0]),
                "angle": _finite_or_none(self.comparison.largest[1]),
            },
            "frames": {
                "removed": self.comparison.frames["removed"],
                "added": self.comparison.frames["added"],
                "helpers": self.comparison.helpers,
                "changed": [
                    {
                        "name": a.frame,
                        "distance": _finite_or_none(a.distance),
                        "angle": _finite_or_none(a.angle),
                    }
                    for a in self.comparison.apart
                ],
            },
            "dof": {
                "removed": self.comparison.freedoms["removed"],
                "added": self.comparison.freedoms["added"],
                "changed": [_limits_to_json(r) for r in self.comparison.ranges],
            },
        }


def _limits_to_json(difference: LimitDifference) -> dict[str, Any]:
    return {
        "name": difference.name,
        "before": [_finite_or_none(bound) for bound in difference.before],
        "after": [_finite_or_none(bound) for bound in difference.after],
    }


def _finite_or_none(number: float) -> float | None:
    return number if math.isfinite(number) else None
