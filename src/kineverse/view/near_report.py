"""What is near, as text for the page."""

from __future__ import annotations

from collections.abc import Mapping

from kineverse.geometry import Closest
from kineverse.view.hypertext import BREAK, FONT, Html, element, joined
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


def near_report(found: Nearness, problems: Mapping[str, str]) -> Html:
    """Return HTML: how many pairs are near, the nearest of them with their distances, what is left out."""
    lines = [element("b", _summary(found))]
    lines += [_line(pair, color(pair.distance, found.radius)) for pair in found.pairs[:LINES]]
    lines += _more(found.found - LINES)
    if found.ignored:
        lines.append(_heading("Near, but not looked at"))
        lines += [_line(pair, None, why) for pair, why in found.ignored[:LINES]]
        lines += _more(len(found.ignored) - LINES)
    lines += _left_out(problems)
    pairs = f"{found.looked_at} pairs are looked at, {found.not_looked_at} are not"
    lines.append(element("div", pairs, style=f"color:{_GREY};margin-top:5px"))
    return boxed(*lines)


def near_failure(message: str) -> Html:
    """Return HTML that says why there are no distances."""
    return boxed(element("b", "There are no distances now.", style="color:#c92a2a"), BREAK, message)


def boxed(*content: str) -> Html:
    """Return content in the font of the panel."""
    return element("div", *content, class_="kineverse-near", style=f"{FONT}padding:2px 9px 8px")


def _summary(found: Nearness) -> str:
    if not found.found:
        return f"No pair is within {number(found.radius)} m."
    near = f"{found.found} pair{'' if found.found == 1 else 's'} within {number(found.radius)} m"
    if not found.touching:
        return f"{near}, none touches"
    return f"{near}, {found.touching} touch{'es' if found.touching == 1 else ''}"


def _line(pair: Closest, rgb: tuple[float, float, float] | None, why: str = "") -> Html:
    shade = _GREY if rgb is None else f"rgb({','.join(str(round(255 * c)) for c in rgb)})"
    distance = millimetres(pair.distance)
    if pair.touches:
        distance = f"{millimetres(-pair.distance)} deep" if pair.distance < -TOUCHING else "touching"
    aside = joined(" ", element("span", why, style=f"color:{_GREY}")) if why else ""
    return element(
        "div",
        element("span", "●", style=f"color:{shade}"),
        element("span", f"{pair.a} – {pair.b}", aside, style="flex:1"),
        element("span", distance, style="white-space:nowrap"),
        style="display:flex;gap:6px;margin-top:2px",
    )


def _heading(text: str) -> Html:
    return element("div", element("b", text), style="margin-top:5px")


def _more(count: int) -> list[Html]:
    return [element("div", f"and {count} more", style=f"color:{_GREY}")] if count > 0 else []


def _left_out(problems: Mapping[str, str]) -> list[Html]:
    if not problems:
        return []
    lines = [element("div", f"{name}: {why}") for name, why in list(problems.items())[:LEFT_OUT]]
    return [_heading("No distances to"), *lines, *_more(len(problems) - LEFT_OUT)]
