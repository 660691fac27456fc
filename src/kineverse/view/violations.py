"""The constraints that a state does not satisfy, as text for the page."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from kineverse.view.hypertext import BREAK, Html, colored_box, element

MOST_LINES = 12
"""Lines of the panel: more than these are counted, not listed."""

_RED, _LIGHT_RED = "#c92a2a", "#fff5f5"


def format_violations(violations: Iterable[Any], unchecked: Iterable[Any] = ()) -> Html:
    """Return HTML: that all is well, or each violated constraint with its value, bounds and excess.

    Parameters
    ----------
    violations
        What :meth:`kineverse.Model.violations` returns: name, value, lower, upper, excess.
    unchecked
        Names of constraints on speeds, about which a posture says nothing.
    """
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
            f"{format_significant(v.value)} is not in [{format_significant(v.lower)}, {format_significant(v.upper)}], by {format_significant(v.excess)}",
            class_="kineverse-violation",
            style="margin-top:3px",
        )
        for v in found[:MOST_LINES]
    ]
    if len(found) > MOST_LINES:
        lines.append(element("div", f"and {len(found) - MOST_LINES} more"))
    return colored_box(_RED, _LIGHT_RED, *lines)


def format_failure(message: str) -> Html:
    """Return HTML that says why the state on the page cannot be shown."""
    return colored_box(_RED, _LIGHT_RED, element("b", "This state cannot be shown."), BREAK, message)


def format_missing_meshes(problems: Sequence[str]) -> Html:
    """Return HTML that lists what could not be loaded."""
    lines = [element("div", line, style="margin-top:3px") for line in problems[:MOST_LINES]]
    if len(problems) > MOST_LINES:
        lines.append(element("div", f"and {len(problems) - MOST_LINES} more"))
    noun = "mesh" if len(problems) == 1 else "meshes"
    return colored_box(_RED, _LIGHT_RED, element("b", f"{len(problems)} {noun} could not be loaded"), *lines)


def format_significant(value: float) -> str:
    """Return a number in at most 4 significant digits, with a minus sign one can see."""
    text = f"{value:.4g}"
    return text.replace("-", "−").replace("inf", "∞")
