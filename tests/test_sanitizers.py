"""Hand-written and generated C under sanitizers for addresses and undefined behaviour, a little of each."""

from __future__ import annotations

import runpy
import subprocess
import sys
from pathlib import Path

import pytest

TOOL = Path(__file__).parents[1] / "tools" / "sanitize.py"
TOOLS = runpy.run_path(str(TOOL))
FAULT = """
from kineverse.compilation import c_source
from kineverse.compilation.c_library import SourceLibrary

texts = {
    "fault.c": '#include "parts/part.h"\\n',
    "parts/part.h": '#pragma once\\n#include "../definitions.h"\\n#include <stdlib.h>\\n'
    'EXPORTED int read(int k) {\\n  int *four = calloc(4, sizeof(int));\\n  return four[k];\\n}\\n',
}
read = c_source._read
c_source._read = lambda name: texts[name] if name in texts else read(name)
library = SourceLibrary("fault.c", lambda code: None)
assert library.prepare(wait=True)
assert library.code.read(3) == 0
print("and now", flush=True)
library.code.read(4)
"""


@pytest.fixture
def libraries() -> list[str]:
    found: list[str] | None = TOOLS["find_libraries"]()
    if found is None:
        pytest.skip("gcc has no libasan and libubsan")
    return found


@pytest.mark.compiler
def test_sanitizers_find_nothing_in_a_batch_a_distance_a_plan_and_an_update(libraries: list[str]) -> None:
    result = subprocess.run([sys.executable, str(TOOL), "--short"], capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr


@pytest.mark.compiler
def test_sanitizers_name_the_function_and_the_line_of_a_fault(libraries: list[str], tmp_path: Path) -> None:
    environment = TOOLS["environment"](tmp_path, libraries)
    result = subprocess.run([sys.executable, "-c", FAULT], env=environment, capture_output=True, text=True)
    assert (result.returncode, result.stdout) == (TOOLS["REPORTED"], "and now\n"), result.stderr
    reports = result.stderr + "".join(path.read_text() for path in tmp_path.glob("report.*"))
    assert "in read parts/part.h:6" in reports
