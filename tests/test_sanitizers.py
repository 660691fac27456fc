"""Hand-written and generated C under sanitizers for addresses and undefined behaviour, a little of each."""

from __future__ import annotations

import runpy
import subprocess
import sys
from pathlib import Path

import pytest

TOOL = Path(__file__).parents[1] / "tools" / "sanitize.py"
TOOLS = runpy.run_path(str(TOOL))


@pytest.mark.compiler
def test_sanitizers_find_nothing_in_a_batch_a_distance_a_plan_and_an_update() -> None:
    if TOOLS["find_libraries"]() is None:
        pytest.skip("gcc has no libasan and libubsan")
    result = subprocess.run([sys.executable, str(TOOL), "--short"], capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr
