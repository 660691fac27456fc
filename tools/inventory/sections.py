"""Sections of an inventory, the cheap ones first: mappings from the name of an entry to its content."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

SECTIONS = {
    "names": "names",
    "commands": "commands",
    "shipped": "models",
    "tests": "suite",
    "size": "size",
    "poses": "models",
    "without": "without",
    "locks": "skills",
    "verdicts": "models",
    "skills": "skills",
}
"""Name of a section, and the module with the function ``section(data)`` of that name."""


def entries(section: str, data: Path | None) -> dict[str, Any]:
    """Return the entries of a section."""
    module = importlib.import_module(f"inventory.{SECTIONS[section]}")
    found: dict[str, Any] = getattr(module, section)(data)
    return found
