"""Tests with their markers and numbers of assertions; as a plugin of pytest, this module lists them."""

from __future__ import annotations

import ast
import inspect
import json
import os
import re
import sys
import tempfile
import textwrap
from pathlib import Path
from typing import Any

MARKERS = ("browser", "compiler", "data", "long", "skip", "skipif", "xfail")
FILE = "INVENTORY_OF_TESTS"
_CHECKS = re.compile(r"assert|raises|warns|check|expect|compare")


def tests(data: Path | None) -> dict[str, Any]:
    """Return all tests by their identifiers, long ones too."""
    from inventory.bounded import ROOT, import_path, run

    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "tests.json"
        path = [*import_path(), str(ROOT / "tools")]
        changes = {FILE: str(file), "PYTHONPATH": os.pathsep.join(path), "CI": "1"}
        changes["KINEVERSE_TEST_DATA"] = str(data) if data else ""
        below = [name for name in ("tests", "studies") if (ROOT / name).is_dir()]
        options = [
            "-q",
            "--collect-only",
            "--long",
            "-p",
            "no:cacheprovider",
            "-p",
            "inventory.suite",
            *below,
        ]
        ended = run([sys.executable, "-m", "pytest", *options], 1200, ROOT, changes)
        if not file.is_file():
            raise RuntimeError(f"pytest collects nothing: {ended.out[-2000:]} {ended.err[-2000:]}")
        found: dict[str, Any] = json.loads(file.read_text("utf-8"))
        return found if ended.status == 0 else {**found, "": f"status {ended.status}"}


def pytest_collection_finish(session: Any) -> None:
    """Write the tests that were collected; long ones too."""
    found: dict[str, Any] = {}
    for item in session.items:
        markers = sorted({mark.name for mark in item.iter_markers()} & {*MARKERS})
        found[item.nodeid] = {"markers": markers, "assertions": _assertions(getattr(item, "function", None))}
    if FILE in os.environ:
        Path(os.environ[FILE]).write_text(json.dumps(found), "utf-8")


_known: dict[Any, int] = {}


def _assertions(function: Any) -> int:
    """Return the number of statements and calls that check something."""
    function = getattr(function, "__func__", function)
    function = getattr(getattr(function, "hypothesis", None), "inner_test", function)
    if function not in _known:
        try:
            tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
        except (OSError, TypeError, SyntaxError):
            return 0
        calls = [ast.unparse(n.func) for n in ast.walk(tree) if isinstance(n, ast.Call)]
        asserts = sum(isinstance(node, ast.Assert) for node in ast.walk(tree))
        _known[function] = asserts + sum(bool(_CHECKS.search(name)) for name in calls)
    return _known[function]
