"""Sizes: lines, files, modules that are too small or too large, and what commands import."""

from __future__ import annotations

import ast
import json
import re
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from inventory.bounded import ROOT, run

SMALL, LARGE, CROWDED = 100, 600, 26
_EXAMPLES = re.compile(r'^ *Examples\n *-{8}\n.*?(?=^ *""")', re.MULTILINE | re.DOTALL)
_COUNT = """
import json, sys
def count():
    ours = [n for n in sys.modules if n.partition(".")[0] == "kineverse"]
    sys.stderr.write("\\n" + json.dumps({"ours": len(ours), "all": len(sys.modules)}))
import atexit
atexit.register(count)
"""
_PROGRAMS = {
    "import kineverse": "import kineverse",
    "load": "import kineverse; kineverse.load('kitchen')",
    "--help": "from kineverse.cli import main; main(['--help'])",
    "open": "from kineverse.cli import main; "
    "main('open kitchen --robot fetch --what kitchen/fridge_door --json'.split())",
}


def size(data: Path | None) -> dict[str, Any]:
    """Return sizes of the package, the studies and the tests, and numbers of imported modules."""
    found: dict[str, Any] = {}
    for folder in ("src/kineverse", "studies", "tests", "tools", "docs"):
        files = [f for f in sorted((ROOT / folder).rglob("*")) if f.suffix in (".py", ".c", ".h", ".md")]
        found[folder] = {"lines": sum(_lines(f) for f in files), "files": len(files)}
        found[folder] |= {
            "all": sum(f.is_file() and "__pycache__" not in f.parts for f in (ROOT / folder).rglob("*"))
        }
        if folder in ("src/kineverse", "studies") and files:
            found |= {f"{folder}: {key}": value for key, value in _rooms(ROOT / folder).items()}
    with tempfile.TemporaryDirectory() as place:
        for name, program in _PROGRAMS.items():
            ended = run([sys.executable, "-c", _COUNT + program], 300, Path(place))
            found[f"modules imported by {name}"] = json.loads(ended.err.strip().splitlines()[-1])
    return found


def _rooms(folder: Path) -> dict[str, Any]:
    """Return modules that are small and imported by one other alone, large ones, and crowded folders."""
    files = find_modules(folder)
    counted, importers = count_lines(files), find_importers(files)
    inner = {
        name: lines
        for name, lines in counted.items()
        if files[name].name not in ("__init__.py", "__main__.py")
    }
    below = [folder, *(p for p in sorted(folder.rglob("*")) if p.is_dir())]
    counts = {
        p.relative_to(folder).as_posix(): sum(f.suffix in (".py", ".c", ".h") for f in p.iterdir())
        for p in below
    }
    return {
        "modules under 100 lines": sum(lines < SMALL for lines in inner.values()),
        "modules under 100 lines that one other imports": {
            name: lines for name, lines in inner.items() if lines < SMALL and len(importers[name]) == 1
        },
        "modules over 600 lines": {name: lines for name, lines in inner.items() if lines > LARGE},
        "folders of more than 26 files": {name: count for name, count in counts.items() if count > CROWDED},
    }


def find_modules(*folders: Path) -> dict[str, Path]:
    """Return the files of the modules below some folders by name."""
    return {_module(f): f for folder in folders for f in sorted(folder.rglob("*.py"))}


def count_lines(files: dict[str, Path]) -> dict[str, int]:
    """Return the number of lines of some modules, without the examples in their docstrings."""
    return {name: _lines(file) - _lines_of_examples(file) for name, file in files.items()}


def find_importers(files: dict[str, Path]) -> dict[str, set[str]]:
    """Return the modules, among some, that import each of them."""
    importers: dict[str, set[str]] = {name: set() for name in files}
    for name, file in files.items():
        for imported in {*_imports(name, file, files)} - {name}:
            importers[imported].add(name)
    return importers


def _imports(name: str, file: Path, files: dict[str, Path]) -> Iterator[str]:
    """Yield the modules, among some, that a module imports or names in a text such as ``module:function``."""
    package = name if file.name == "__init__.py" else name.rpartition(".")[0]
    for node in ast.walk(ast.parse(file.read_text("utf-8"))):
        found: list[str] = []
        if isinstance(node, ast.Import):
            found = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            origin = ".".join([*base, *([node.module] if node.module else [])])
            found = [origin, *(f"{origin}.{alias.name}" for alias in node.names)]
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            found = [node.value.partition(":")[0]]  # "package.module:function"
        yield from (n for n in found if n in files)


def _module(file: Path) -> str:
    root = next(p for p in file.parents if not (p / "__init__.py").exists())
    parts = file.relative_to(root).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _lines(file: Path) -> int:
    return len(file.read_text("utf-8").splitlines())


def _lines_of_examples(file: Path) -> int:
    return sum(match[0].count("\n") for match in _EXAMPLES.finditer(file.read_text("utf-8")))
