"""HTML with escaped text: the only place in which names and messages become part of the page.

The names in a file are chosen by its author. Only :class:`Html` is put on the page unchanged, and only
:func:`element` makes it.
"""

from __future__ import annotations

import html
from typing import Any


class Html(str):
    """Text that is HTML already."""

    __slots__ = ()


def element(tag: str, *content: str, style: str = "", **attributes: object) -> Html:
    """Return an HTML element; its content is escaped, unless it is :class:`Html`."""
    named = {name.rstrip("_").replace("_", "-"): value for name, value in attributes.items()}
    shown = {**({"style": style} if style else {}), **named}
    opened = "".join(f' {name}="{html.escape(str(value))}"' for name, value in shown.items())
    inside = "".join(text if isinstance(text, Html) else html.escape(text) for text in content)
    return Html(f"<{tag}{opened}>{inside}</{tag}>")


def join_html(*content: str) -> Html:
    """Concatenate content; text that is not :class:`Html` is escaped."""
    return Html("".join(text if isinstance(text, Html) else html.escape(text) for text in content))


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

FONT = "font-size:0.8em;line-height:1.35;overflow-wrap:anywhere;"
"""The font of the panel."""


def colored_box(color: str, background: str, *content: str) -> Html:
    """Return a coloured box in the font of the panel."""
    colors = f"color:{color};background:{background}"
    return element(
        "div", *content, style=f"{FONT}padding:6px 9px;margin:2px 8px 10px;border-radius:4px;{colors}"
    )
