"""What is near, as text for the page."""

from __future__ import annotations

import html
from collections.abc import Iterable, Mapping

from kineverse.geometry import Closest
from kineverse.view.marks import color, millimetres
from kineverse.view.near import Nearness
from kineverse.view.violations import number

LINES = 12
"""Lines of the list: more than these are counted, not listed."""

LEFT_OUT = 5
"""Bodies, and shapes of them, that are left out and named with the reason; more are counted."""

TOUCHING = 5e-6
"""What is less deep than this is said to touch, not to be 0.00 mm deep [m]."""

_GREY = "#868e96"


def near_report(found: Nearness, problems: Mapping[str, str]) -> str:
    """Return HTML: how many pairs are near, the nearest of them with their distances, what is left out."""
    lines = [f"<b>{_summary(found)}</b>"]
    lines += [_line(pair, color(pair.distance, found.radius)) for pair in found.pairs[:LINES]]
    lines += _more(found.found - LINES)
    if found.ignored:
        lines.append('<div style="margin-top:5px"><b>Near, but not looked at</b></div>')
        lines += [_line(pair, None, why) for pair, why in found.ignored[:LINES]]
        lines += _more(len(found.ignored) - LINES)
    lines += _left_out(problems)
    pairs = f"{found.looked_at} pairs are looked at, {found.not_looked_at} are not"
    lines.append(f'<div style="color:{_GREY};margin-top:5px">{pairs}</div>')
    return boxed(lines)


def near_failure(message: str) -> str:
    """Return HTML that says why there are no distances."""
    return boxed([f'<b style="color:#c92a2a">There are no distances now.</b><br>{html.escape(message)}'])


def boxed(lines: Iterable[str]) -> str:
    """Return lines of HTML in the font of the panel."""
    return (
        '<div class="kineverse-near" style="font-size:0.8em;line-height:1.35;padding:2px 9px 8px;'
        f'overflow-wrap:anywhere">{"".join(lines)}</div>'
    )


def _summary(found: Nearness) -> str:
    if not found.found:
        return f"No pair is within {number(found.radius)} m."
    near = f"{found.found} pair{'' if found.found == 1 else 's'} within {number(found.radius)} m"
    if not found.touching:
        return f"{near}, none touches"
    return f"{near}, {found.touching} touch{'es' if found.touching == 1 else ''}"


def _line(pair: Closest, rgb: tuple[float, float, float] | None, why: str = "") -> str:
    shade = _GREY if rgb is None else f"rgb({','.join(str(round(255 * c)) for c in rgb)})"
    distance = millimetres(pair.distance)
    if pair.touches:
        distance = f"{millimetres(-pair.distance)} deep" if pair.distance < -TOUCHING else "touching"
    dot = f'<span style="color:{shade}">●</span>'
    names = f"{html.escape(pair.a)} – {html.escape(pair.b)}"
    aside = f' <span style="color:{_GREY}">{html.escape(why)}</span>' if why else ""
    return (
        '<div style="display:flex;gap:6px;margin-top:2px">'
        f'{dot}<span style="flex:1">{names}{aside}</span>'
        f'<span style="white-space:nowrap">{distance}</span></div>'
    )


def _more(count: int) -> list[str]:
    return [f'<div style="color:{_GREY}">and {count} more</div>'] if count > 0 else []


def _left_out(problems: Mapping[str, str]) -> list[str]:
    if not problems:
        return []
    lines = ['<div style="margin-top:5px"><b>No distances to</b></div>']
    for name, why in list(problems.items())[:LEFT_OUT]:
        lines.append(f"<div>{html.escape(name)}: {html.escape(why)}</div>")
    return lines + _more(len(problems) - LEFT_OUT)
