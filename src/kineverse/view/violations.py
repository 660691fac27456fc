"""HTML reports of violated constraints and failures."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from kineverse.view.hypertext import BREAK, Html, colored_box, element

MOST_LINES = 12
"""Lines of the panel; further constraints are counted, not listed."""

_RED, _LIGHT_RED = "#c92a2a", "#fff5f5"


def format_violations(violations: Iterable[Any], unchecked: Iterable[Any] = ()) -> Html:
    """Return HTML: each violated constraint with its value, bounds and excess, or that there is none."""
    found = sorted(violations, key=lambda v: -abs(v.excess))
    rest = len(list(unchecked))
    aside = [element("span", f" · {rest} on speeds not checked", style="color:#868e96")] if rest else []
    if not found:
        return colored_box("#2b8a3e", "#ebfbee", element("b", "All constraints hold."), *aside)
    noun = "constraint" if len(found) == 1 else "constraints"
    lines = [element("b", f"{len(found)} {noun} violated"), *aside]
    lines += [
        element(
            "div",
            element("b", v.name),
            BREAK,
            "{} is not in [{}, {}], by {}".format(
                *map(format_significant, (v.value, v.lower, v.upper, v.excess))
            ),
            class_="kineverse-violation",
            style="margin-top:3px",
        )
        for v in found[:MOST_LINES]
    ]
    if len(found) > MOST_LINES:
        lines.append(element("div", f"and {len(found) - MOST_LINES} more"))
    return colored_box(_RED, _LIGHT_RED, *lines)


def format_failure(message: str) -> Html:
    """Return HTML: the reason why the state on the page cannot be shown."""
    return colored_box(_RED, _LIGHT_RED, element("b", "This state cannot be shown."), BREAK, message)


def format_missing_meshes(problems: Sequence[str]) -> Html:
    """Return HTML: the meshes that could not be loaded."""
    lines = [element("div", line, style="margin-top:3px") for line in problems[:MOST_LINES]]
    if len(problems) > MOST_LINES:
        lines.append(element("div", f"and {len(problems) - MOST_LINES} more"))
    noun = "mesh" if len(problems) == 1 else "meshes"
    return colored_box(_RED, _LIGHT_RED, element("b", f"{len(problems)} {noun} could not be loaded"), *lines)


def format_significant(value: float) -> str:
    """Format a number with at most 4 significant digits and a legible minus sign."""
    text = f"{value:.4g}"
    return text.replace("-", "−").replace("inf", "∞")
