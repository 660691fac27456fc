"""Robots, furniture and recordings of other people, in the folder that ``KINEVERSE_TEST_DATA`` names.

What the folder has to hold is in ``DATA.md``. A test asks for the fixture ``published``, or is marked ``data``.
"""

from __future__ import annotations

import os
from pathlib import Path

import pytest

VARIABLE = "KINEVERSE_TEST_DATA"
FOLDER = Path(os.environ[VARIABLE]).absolute() if os.environ.get(VARIABLE) else None


def published_path(*parts: str) -> Path:
    """Return a file or folder of the published data; without it, skip the test."""
    path = FOLDER.joinpath(*parts) if FOLDER else None
    if path is None or not path.exists():
        pytest.skip(f"no {'/'.join(parts) or 'folder'} in {VARIABLE}")
    return path


def published_files(ending: str, *parts: str) -> list[Path]:
    """Return the files below a folder of the published data, sorted; none if there is no such folder."""
    return sorted(FOLDER.joinpath(*parts).rglob(f"*{ending}")) if FOLDER else []


def relative_name(file: Path | None) -> str:
    """Return the path of a file below the published data; ``none`` for None."""
    return str(file.relative_to(FOLDER)) if file and FOLDER else "none"
