"""HTML of the page: exchangeable boxes, and reports of violated constraints and failures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np

from kineverse._rich_display import Html, element


class HtmlBox:
    """Exchangeable HTML on a page."""

    def __init__(self, gui: Any, content: Html) -> None:
        self._handle = gui.add_html(str(content))

    @property
    def content(self) -> str:
        """The present content."""
        return str(self._handle.content)

    def show(self, content: Html) -> None:
        """Replace the content; it is sent only if it differs."""
        if self._handle.content != content:
            self._handle.content = str(content)


BREAK = Html("<br>")

FONT = "font-size:0.8em;line-height:1.35;overflow-wrap:anywhere;"  # the font of the panel


def colored_box(color: str, background: str, *content: str) -> Html:
    """Return a coloured box in the font of the panel."""
    colors = f"color:{color};background:{background}"
    return element(
        "div", *content, style=f"{FONT}padding:6px 9px;margin:2px 8px 10px;border-radius:4px;{colors}"
    )


MOST_LINES = 12  # lines of the panel; further constraints are counted, not listed

_RED, _LIGHT_RED = "#c92a2a", "#fff5f5"


def format_violations(
    violations: Iterable[Any],
    unchecked: Iterable[Any] = (),
    scales: Mapping[str, tuple[float, str]] = MappingProxyType({}),
) -> Html:
    """Return HTML: each violated constraint with its value, bounds and excess, or that there is none.

    Numbers of the constraints in ``scales`` are multiplied by a factor, and have a unit.
    """
    found = sorted(violations, key=lambda v: -abs(v.excess))
    rest = len(list(unchecked))
    aside = [element("span", f" · {rest} on speeds not checked", style="color:#868e96")] if rest else []
    if not found:
        return colored_box("#2b8a3e", "#ebfbee", element("b", "All constraints hold."), *aside)
    noun = "constraint" if len(found) == 1 else "constraints"
    lines = [element("b", f"{len(found)} {noun} violated"), *aside]
    for v in found[:MOST_LINES]:
        factor, unit = scales.get(v.name, (1.0, ""))
        value, low, high, off = (
            format_significant(factor * x) for x in (v.value, v.lower, v.upper, v.excess)
        )
        text = f"{value} is not in [{low}, {high}], by {off} {unit}".rstrip()
        style = {"class_": "kineverse-violation", "style": "margin-top:3px"}
        lines.append(element("div", element("b", v.name), BREAK, text, **style))
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


_NEGLIGIBLE = 1e-9  # what is smaller is 0: rounding of a file's units


def format_significant(value: float) -> str:
    """Format a number with at most 4 significant digits and a legible minus sign."""
    if abs(value) < _NEGLIGIBLE:
        return "0"
    # Exponents only where the digits would be many.
    text = f"{value:.4g}"
    if "e" in text and 1e-6 <= abs(value) < 1e6:
        text = np.format_float_positional(float(text), trim="-")
    return text.replace("-", "−").replace("inf", "∞")
