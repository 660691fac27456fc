"""Rich displays of notebooks: HTML elements with escaped text, tables, pictures and curves.

This is the only place in which names and messages become HTML. They come from files and may contain anything.
"""

from __future__ import annotations

import io
from base64 import b64encode
from collections.abc import Iterable, Sequence
from html import escape
from typing import Any

ROWS = 50  # most rows of a table; further ones are counted, not listed
CELL = 200  # most characters of a cell

_LEFT = "text-align:left"  # notebooks align text in tables to the right


class Html(str):
    """Text that is HTML already."""

    __slots__ = ()


def element(tag: str, *content: str, style: str = "", **attributes: object) -> Html:
    """Return an HTML element; its content is escaped, unless it is :class:`Html`."""
    named = {name.rstrip("_").replace("_", "-"): value for name, value in attributes.items()}
    shown = {**({"style": style} if style else {}), **named}
    opened = "".join(f' {name}="{escape(str(value))}"' for name, value in shown.items())
    return Html(f"<{tag}{opened}>{join_html(*content)}</{tag}>")


def join_html(*content: str) -> Html:
    """Concatenate content; text that is not :class:`Html` is escaped."""
    return Html("".join(text if isinstance(text, Html) else escape(text) for text in content))


def html_table(
    caption: str, header: Sequence[str], rows: Sequence[Sequence[str]], total: int | None = None
) -> Html:
    """Return a table of texts, which are escaped; long texts and further rows are cut, with an ellipsis.

    ``total`` is the number of all rows, if ``rows`` are only the first ones.
    """
    body = [_table_row("td", row) for row in rows[:ROWS]]
    more = (len(rows) if total is None else total) - len(body)
    if more > 0:
        cell = Html(f'<td colspan="{len(header)}" style="{_LEFT}">… {more} more</td>')
        body.append(element("tr", cell))
    return element(
        "table",
        element("caption", caption, style=f"{_LEFT};caption-side:top;white-space:nowrap"),
        element("thead", _table_row("th", header)),
        element("tbody", *body),
    )


def _table_row(tag: str, cells: Iterable[str]) -> Html:
    return element("tr", *(element(tag, shorten(cell), style=_LEFT) for cell in cells))


def shorten(text: str, most: int = CELL) -> str:
    """Return a text that is cut, with an ellipsis, to a number of characters; HTML is left as it is."""
    return text if isinstance(text, Html) or len(text) <= most else f"{text[: most - 1]}…"


class TableDisplay:
    """Base of results that notebooks show as a table, and as their text where there is no HTML."""

    def _repr_html_(self) -> str:
        raise NotImplementedError

    def _repr_mimebundle_(self, include: object = None, exclude: object = None) -> dict[str, str]:
        # A notebook keeps a plain text as well, and the repr has all numbers.
        return {"text/plain": str(self), "text/html": self._repr_html_()}


def folded(title: str, *content: str) -> Html:
    """Return content below a title that a click unfolds."""
    return element("details", element("summary", title), *content)


def picture_element(png: bytes, text: str) -> Html:
    """Return a picture that the HTML contains, with a text in its place for those who do not see it."""
    source = f"data:image/png;base64,{b64encode(png).decode()}"
    return Html(f'<img src="{source}" alt="{escape(text)}" style="max-width:100%">')


CURVES = 8  # most curves of a figure: more cannot be told apart


def draw_curves(
    x: Any, values: Any, names: Sequence[str], xlabel: str = "time [s]", ylabel: str = "[rad], [m]"
) -> bytes | None:
    """Return a PNG of curves, the columns of ``values`` (N, n) over ``x`` (N,); None without matplotlib."""
    try:
        from matplotlib.figure import Figure  # an extra
    except ImportError:
        return None
    canvas = Figure(figsize=(6.0, 2.6), dpi=80, layout="constrained")
    axes = canvas.subplots()
    for k, name in enumerate(names[:CURVES]):
        # A label is no TeX, and one that begins with an underscore would be left out.
        axes.plot(x, values[:, k], linewidth=1.2, label=f" {shorten(name, 40)}".replace("$", r"\$"))
    more = len(names) - CURVES
    axes.set(xlabel=xlabel, ylabel=ylabel, title=f"… {more} more" if more > 0 else "")
    if names:
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize="small", frameon=False)
    content = io.BytesIO()
    canvas.savefig(content, format="png", metadata={"Software": None})
    return content.getvalue()
