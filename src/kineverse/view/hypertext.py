"""HTML whose text is escaped: the one place where names and messages become part of the page.

Whoever writes a file chooses the names in it. Only :class:`Html` is put on the page as it is, and only
:func:`element` makes it.
"""

from __future__ import annotations

import html
from typing import Any


class Html(str):
    """Text that is HTML already."""

    __slots__ = ()


def element(tag: str, *content: str, style: str = "", **attributes: object) -> Html:
    """Return an element of HTML; what it contains is escaped, unless it is :class:`Html`.

    Parameters
    ----------
    tag
        Its name, such as ``div``.
    content
        What is in it, in this order.
    style
        Its CSS.
    attributes
        Others, an underscore at the end of a name dropped (``class_``), those inside hyphens.
    """
    named = {name.rstrip("_").replace("_", "-"): value for name, value in attributes.items()}
    shown = {**({"style": style} if style else {}), **named}
    opened = "".join(f' {name}="{html.escape(str(value))}"' for name, value in shown.items())
    inside = "".join(text if isinstance(text, Html) else html.escape(text) for text in content)
    return Html(f"<{tag}{opened}>{inside}</{tag}>")


def join_html(*content: str) -> Html:
    """Return content one after the other; what is not :class:`Html` is escaped."""
    return Html("".join(text if isinstance(text, Html) else html.escape(text) for text in content))


class HtmlBox:
    """HTML on a page, which can be exchanged.

    Parameters
    ----------
    gui
        The gui of a viser server.
    content
        What it shows at first.
    """

    def __init__(self, gui: Any, content: Html) -> None:
        self._handle = gui.add_html(str(content))

    @property
    def content(self) -> str:
        """What it shows."""
        return str(self._handle.content)

    def show(self, content: Html) -> None:
        """Show something else, which is sent if it is something else."""
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
