"""Tables in HTML, for notebooks: what Jupyter shows in place of a ``repr``."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

_MOST = 50
_LONGEST = 200


def html_table(caption: str, header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table of texts, which are escaped; long ones are cut, and so are many rows."""
    head = "".join(f"<th>{escape(title)}</th>" for title in header)
    body = "".join(
        f"<tr>{''.join(f'<td>{escape(_cut(cell))}</td>' for cell in row)}</tr>" for row in rows[:_MOST]
    )
    if len(rows) > _MOST:
        body += f'<tr><td colspan="{len(header)}">... {len(rows) - _MOST} more</td></tr>'
    return (
        f"<table><caption>{escape(caption)}</caption><thead><tr>{head}</tr></thead>"
        f"<tbody>{body}</tbody></table>"
    )


def _cut(text: str) -> str:
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 1]}…"
