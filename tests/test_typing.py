"""The types that a user's checker sees: a small program uses the whole face, and runs. mypy checks it with the package."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

import kineverse as kv

PROGRAM = Path(__file__).parent / "typed_usage.py"


def test_all_of_the_face_is_used() -> None:
    text = PROGRAM.read_text("utf-8")
    assert not [name for name in kv.__all__ if not re.search(rf"\bkv\.{name}\b", text)]


def test_it_runs() -> None:
    runpy.run_path(str(PROGRAM))
