"""The types that a user's checker sees: a small program is checked strictly, and run."""

from __future__ import annotations

import runpy
import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = Path(__file__).parent / "typed_usage.py"


def test_a_program_of_a_user_is_typed() -> None:
    pytest.importorskip("mypy")
    root = PROGRAM.parent.parent
    checked = subprocess.run(
        [sys.executable, "-m", "mypy", "--strict", str(PROGRAM)], cwd=root, capture_output=True, text=True
    )
    assert checked.returncode == 0, checked.stdout + checked.stderr


def test_it_runs() -> None:
    runpy.run_path(str(PROGRAM))
