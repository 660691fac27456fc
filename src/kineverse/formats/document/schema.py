"""The published schema of documents."""

from __future__ import annotations

import json
from importlib.resources import files
from typing import Any


def schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of documents, the content of ``schema.json`` beside this file.

    It says what a document consists of. What only the reader checks: that references are to earlier nodes,
    shapes, limits on size and work, and the hash.
    """
    content: dict[str, Any] = json.loads(files(__package__).joinpath("schema.json").read_text("utf-8"))
    return content
