"""The constraints that a state does not satisfy, as text for the page."""

from __future__ import annotations

import html
from collections.abc import Iterable
from typing import Any

MOST = 12
"""Lines of the panel: more than these are counted, not listed."""


def report(violations: Iterable[Any], unchecked: Iterable[Any] = ()) -> str:
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
    aside = f'<span style="color:#868e96"> · {rest} on speeds not checked</span>' if rest else ""
    if not found:
        return _box("#2b8a3e", "#ebfbee", f"<b>All constraints hold.</b>{aside}")
    noun = "constraint" if len(found) == 1 else "constraints"
    lines = [f"<b>{len(found)} {noun} violated</b>{aside}"]
    lines += [
        f'<div class="kineverse-violation" style="margin-top:3px"><b>{html.escape(v.name)}</b><br>'
        f"{number(v.value)} is not in [{number(v.lower)}, {number(v.upper)}], by {number(v.excess)}</div>"
        for v in found[:MOST]
    ]
    if len(found) > MOST:
        lines.append(f"<div>and {len(found) - MOST} more</div>")
    return _box("#c92a2a", "#fff5f5", "".join(lines))


def failure(message: str) -> str:
    """Return HTML that says why the state on the page cannot be shown."""
    return _box("#c92a2a", "#fff5f5", f"<b>This state cannot be shown.</b><br>{html.escape(message)}")


def number(value: float) -> str:
    """Return a number in at most 4 significant digits, with a minus sign one can see."""
    text = f"{value:.4g}"
    return text.replace("-", "−").replace("inf", "∞")


def _box(color: str, background: str, content: str) -> str:
    return (
        f'<div style="font-size:0.8em;line-height:1.35;padding:6px 9px;margin:2px 8px 10px;border-radius:4px;'
        f'overflow-wrap:anywhere;color:{color};background:{background}">{content}</div>'
    )
