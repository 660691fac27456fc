"""What two models differ in, as text and as JSON."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from kineverse.cli.comparison import SIGNS, Comparison, Difference
from kineverse.cli.paint import bounded, paint
from kineverse.cli.wording import contents, data, number, part, value
from kineverse.model.delta import Delta
from kineverse.model.operation import ARTICULATIONS, BODIES, CONSTRAINTS, DATA, FRAMES, RATES

ORDER = (FRAMES, CONSTRAINTS, BODIES, ARTICULATIONS, RATES, DATA)
WORDS = {**SIGNS, ">": "moved"}
_WIDEST = 44


@dataclass(frozen=True)
class ComparisonReport:
    """What two models differ in, to be printed."""

    found: Comparison

    def blocks(self, most: int | None) -> list[list[str]]:
        """Return the paragraphs of the report, with at most so many differences each."""
        result = [_operations(self.found, most)] if any(self.found.operations.values()) else []
        for kind in ORDER:
            differences = self.found.of(kind)
            if differences:
                result.append([paint(kind, "bold"), *_lines(differences, most)])
        result.append(_closing(self.found))
        return result

    def as_json(self) -> dict[str, Any]:
        """Return all of it as JSON has it: by operation, and by kind of data."""
        operations = {WORDS[sign]: list(tags) for sign, tags in self.found.operations.items()}
        return {
            "operations": operations if self.found.operations_compared else None,
            **{kind: _kind(self.found.of(kind)) for kind in ORDER},
            "alike": self.found.alike,
        }


def _operations(found: Comparison, most: int | None) -> list[str]:
    lines = [f"  {paint(sign, sign)} {tag}" for sign, tags in found.operations.items() for tag in tags]
    return [paint("operations", "bold"), *bounded(lines, most)]


def _lines(differences: list[Difference], most: int | None) -> list[str]:
    shown = differences[:most]
    width = min(max(len(d.change.name) for d in shown), _WIDEST)
    entries = []
    for difference in shown:
        first, *others = _texts(difference)
        line = (
            f"  {paint(difference.sign, difference.sign)} {difference.change.name:<{width}}  {first}".rstrip()
        )
        entries.append("\n".join([line, *(" " * (width + 6) + text for text in others)]))
    return [*entries, *bounded([""] * len(differences), len(shown))[len(shown) :]]


def _texts(difference: Difference) -> list[str]:
    change = difference.change
    if change.before is not None and change.after is not None:
        return [text for delta in difference.parts for text in part(delta)]
    there = change.after if change.before is None else change.before
    return [value(there[1] if change.kind == RATES else there)]


def _closing(found: Comparison) -> list[str]:
    """Return the sum, and what was not counted."""
    within = f"within {found.tolerance:g}" if found.tolerance else "to the bit"
    notes = []
    if found.alike:
        notes.append(f"{number(len(found.alike), 'value')} written or rounded in another way")
    if not found.operations_compared:
        notes.append("operations not compared")
    said = f" ({', '.join(notes)})" if notes else ""
    if found.equal:
        return [f"equal {within}: {contents(found.after)}{said}"]
    counts = ", ".join(f"{count} {word}" for word, count in found.counts.items() if count)
    lines = [f"{number(len(found.differences), 'difference')}: {counts or 'in operations only'}{said}"]
    if not set(found.before.frames) & set(found.after.frames) and found.before.frames and found.after.frames:
        lines.append("They have no frame in common; --prefix NAME puts the same name in front of both.")
    return lines


def _kind(differences: list[Difference]) -> dict[str, Any]:
    by_sign = {word: [d for d in differences if d.sign == sign] for sign, word in SIGNS.items()}
    return {
        "added": [d.change.name for d in by_sign["added"]],
        "removed": [d.change.name for d in by_sign["removed"]],
        "changed": [
            {"name": d.change.name, "parts": [_part(delta) for delta in d.parts]} for d in by_sign["changed"]
        ],
    }


def _part(delta: Delta) -> dict[str, Any]:
    return {
        "what": delta.what,
        "before": data(delta.before),
        "after": data(delta.after),
        "distance": delta.distance if math.isfinite(delta.distance) else None,
        "angle": delta.angle if math.isfinite(delta.angle) else None,
    }
