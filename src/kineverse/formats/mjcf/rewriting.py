"""A tree of elements as text for MuJoCo, one element a line, so that the lines it names lead back to them."""

from __future__ import annotations

from xml.sax.saxutils import quoteattr

from .tree import Node

_ESCAPED = {"\n": "&#10;", "\r": "&#13;", "\t": "&#9;"}


def written(root: Node, first: int = 1) -> tuple[str, list[Node]]:
    """Return a document, and its nodes by line from ``first`` on; the lines before are empty."""
    lines: list[str] = []
    nodes: list[Node] = []
    ahead: list[Node | str] = [root]
    while ahead:
        part = ahead.pop()
        if isinstance(part, str):
            lines[-1] += part
            continue
        words = [part.tag, *(f"{k}={quoteattr(v, _ESCAPED)}" for k, v in part.attributes.items())]
        nodes.append(part)
        lines.append(f"<{' '.join(words)}{'>' if part.children else '/>'}")
        if part.children:
            ahead.append(f"</{part.tag}>")
            ahead.extend(reversed(part.children))
    return "\n" * (first - 1) + "\n".join(lines), nodes
