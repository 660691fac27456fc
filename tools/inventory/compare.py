"""Differences of two inventories."""

from __future__ import annotations

import math
import sys
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

TOLERANCE = 1e-9
"""Difference of numbers that counts as rounding, of the larger of 1 and the number."""
NEVER_DIFFERENT = ("size",)
WORDING, SECONDS = "help", "seconds"
"""Fields that are told, and are no difference."""
ASSERTIONS = "assertions"
"""Number that may grow."""
_WIDTH = 140

Entries = Mapping[str, Any]


def compare(before: Mapping[str, Entries], after: Mapping[str, Entries], most: int | None) -> int:
    """Print the differences of each section, at most some of each kind; return 1 if there are any, else 0."""
    status = 0
    for section in dict.fromkeys((*before, *after)):
        if section not in before or section not in after:
            sys.stdout.write(f"{section}: only {'before' if section in before else 'after'}\n")
            status = 1
            continue
        kinds = compare_entries(before[section], after[section])
        equal = kinds.pop("equal")
        counts = "".join(f", {len(texts)} {kind}" for kind, texts in kinds.items() if texts)
        pace = _pace(before[section], after[section])
        sys.stdout.write(f"{section}: {len(equal)} equal{counts}{pace}\n")
        for kind, texts in kinds.items():
            listed = [text for key, text in texts.items() if key.rpartition(".")[0] not in texts]
            if kind == "moved":
                listed = [f"{place}: {count}" for place, count in Counter(listed).items()]
            for text in listed[:most]:
                cut = text if most is None or len(text) < _WIDTH else f"{text[:_WIDTH]} …"
                sys.stdout.write(f"  {kind} {cut}\n")
            if most is not None and len(listed) > most:
                sys.stdout.write(f"  … and {len(listed) - most} more {kind} (--all)\n")
        if section not in NEVER_DIFFERENT and (kinds["added"] or kinds["removed"] or kinds["changed"]):
            status = 1
    return status


def compare_entries(before: Entries, after: Entries) -> dict[str, dict[str, str]]:
    """Return texts about equal, removed, added, changed, moved and reworded entries, by their keys.

    An entry has moved if its name after the first colon is the same: a test in another file, a name in
    another package.
    """
    kinds: dict[str, dict[str, str]] = {
        kind: {} for kind in ("equal", "removed", "added", "changed", "moved", "reworded")
    }
    new = {key for key in after if key not in before}
    places: dict[str, list[str]] = {}
    for key in sorted(after, key=lambda key: (key not in new, key)):
        places.setdefault(_tail(key), []).append(key)
    for key in sorted(before):
        there = key if key in after else _place(key, before[key], places, after, new)
        if there is None:
            kinds["removed"][key] = f"{key}  {_short(before[key])}"
            continue
        new.discard(there)
        found = [*changes(before[key], after[there])]
        if there != key:
            kinds["moved"][key] = f"{key.partition(':')[0]} -> {there.partition(':')[0]}"
        if found:
            kinds["changed"][key] = f"{key}  {'; '.join(found)}"
        elif there == key:
            kinds["equal"][key] = key
        if any(_wordings(before[key], after[there])):
            kinds["reworded"][key] = key
    kinds["added"] = {key: f"{key}  {_short(after[key])}" for key in sorted(new)}
    return kinds


def _place(key: str, entry: Any, places: dict[str, list[str]], after: Entries, new: set[str]) -> str | None:
    """Return where an entry has moved: to its like, else to a new one of the same name."""
    named = places.get(_tail(key), []) if _tail(key) else []
    same = [k for k in named if not any(changes(entry, after[k]))]
    still = same[0] if same and "::" not in key else None  # a test with the name of another is another test
    return next((k for k in (*same, *named) if k in new), still)


def changes(before: Any, after: Any, place: str = "") -> Iterator[str]:
    """Yield the differences of two entries, without wording and times."""
    if isinstance(before, Mapping) and isinstance(after, Mapping):
        for key in sorted({*before, *after} - {WORDING, SECONDS}):
            yield from changes(before.get(key), after.get(key), f"{place}.{key}".strip("."))
    elif not (_equal(before, after) or (place == ASSERTIONS and after > before)):
        yield f"{place + ': ' if place else ''}{_short(before)} -> {_short(after)}"


def _wordings(before: Any, after: Any) -> Iterator[bool]:
    if isinstance(before, Mapping) and isinstance(after, Mapping):
        yield before.get(WORDING) != after.get(WORDING)


def _equal(a: Any, b: Any) -> bool:
    if isinstance(a, list) and isinstance(b, list):
        return len(a) == len(b) and all(map(_equal, a, b))
    numbers = all(isinstance(x, (int, float)) for x in (a, b))
    if numbers and float in (type(a), type(b)) and math.isfinite(a) and math.isfinite(b):
        return abs(a - b) <= TOLERANCE * max(1.0, abs(a), abs(b))
    return bool(a == b) or (numbers and math.isnan(a) and math.isnan(b))


def _pace(before: Entries, after: Entries) -> str:
    """Return how many times as long entries take as before: the geometric mean."""
    pairs = [
        (a[SECONDS], b[SECONDS])
        for a, b in ((before[key], after[key]) for key in before if key in after)
        if isinstance(a, Mapping) and isinstance(b, Mapping) and a.get(SECONDS) and b.get(SECONDS)
    ]
    if not pairs:
        return ""
    mean = math.exp(sum(math.log(b / a) for a, b in pairs) / len(pairs))
    return f"; {mean:.2f} times the seconds"


def _tail(key: str) -> str:
    return key.partition(":")[2]


def _short(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(
            f"{k}={_short(v)}" for k, v in value.items() if k != WORDING and v not in (None, [], "")
        )
    return str(value)
