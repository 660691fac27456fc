"""The types that a user's checker sees: a small program is checked strictly, and run."""

from __future__ import annotations

import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

import kineverse as kv

PROGRAM = Path(__file__).parent / "typed_usage.py"


def test_a_program_of_a_user_is_typed() -> None:
    pytest.importorskip("mypy")
    root = PROGRAM.parent.parent
    checked = subprocess.run(
        [sys.executable, "-m", "mypy", "--strict", str(PROGRAM)], cwd=root, capture_output=True, text=True
    )
    assert checked.returncode == 0, checked.stdout + checked.stderr


def test_all_of_the_face_is_used() -> None:
    text = PROGRAM.read_text("utf-8")
    assert not [name for name in kv.__all__ if not re.search(rf"\bkv\.{name}\b", text)]


def test_it_runs() -> None:
    runpy.run_path(str(PROGRAM))
