"""Pages of notebooks: their text, their code, and what they last showed."""

from __future__ import annotations

import base64
import json
import re
from pathlib import Path
from typing import Any

from website.equations import to_mathml


def write_notebook(path: Path) -> tuple[str, dict[str, bytes]]:
    """Return a notebook as a Markdown page, and its pictures by their names beside the page."""
    parts: list[str] = []
    pictures: dict[str, bytes] = {}
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        source = "".join(cell["source"]).strip()
        if cell["cell_type"] == "markdown":
            parts.append(source)
        elif cell["cell_type"] == "code" and source:
            parts.append(_fence("python", source))
            for output in cell["outputs"]:
                name = f"{path.stem}_{len(pictures) + 1}.png"
                shown, picture = _show(output, name)
                parts.append(shown)
                if picture:
                    pictures[name] = picture
    return "\n\n".join(filter(None, parts)) + "\n", pictures


def _show(output: dict[str, Any], name: str) -> tuple[str, bytes]:
    """Return an output as Markdown, in the richest form that a page can show, and its picture."""
    data = {kind: "".join(text) for kind, text in output.get("data", {}).items()}
    if "image/png" in data:
        return f"![]({name})", base64.b64decode(data["image/png"])
    if "text/html" in data:
        return _fence("{raw} html", data["text/html"]), b""
    if "text/latex" in data:
        latex = data["text/latex"].strip().strip("$").replace(r"\displaystyle", "").strip()
        try:
            to_mathml(latex)
        except ValueError:  # it has more than a page can draw
            pass
        else:
            return f"$$\n{latex}\n$$", b""
    text = data.get("text/plain") or "".join(output.get("text", "")) or "\n".join(output.get("traceback", []))
    return _fence("text", re.sub(r"\x1b\[[\d;]*m", "", text.rstrip())) if text.strip() else "", b""


def _fence(kind: str, text: str) -> str:
    longest = max(map(len, re.findall("`{3,}", text)), default=2)
    fence = "`" * (longest + 1)
    return f"{fence}{kind}\n{text}\n{fence}"
