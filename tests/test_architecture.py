"""The architecture page: its layers, its tree and its modules are those of the sources, which have a good size."""

from __future__ import annotations

import ast
import re
import runpy
import tomllib
from collections import Counter
from functools import cache
from pathlib import Path

import pytest

import kineverse as kv

ROOT = Path(__file__).parents[1]

from inventory.size import count_lines, find_importers, find_modules  # noqa: E402  - it is no part of the package

PAGE = (ROOT / "docs" / "architecture.md").read_text("utf-8")
LARGEST, SMALLEST, MOST_FILES = 650, 100, 26
MOST_LINES_OF_C = 12  # in a string: declarations, and calls of what is generated
LARGE = {"kineverse.expressions.expression"}
"""Modules above the largest size: one class that behaves like an array."""

SMALL = {"kineverse.shipped.robots"}
"""Modules below the smallest size that one other imports, and that cannot be a part of it: its layer is lower."""


def test_the_layers_are_those_of_the_contract() -> None:
    table = PAGE.partition("## Layers")[2].partition("## ")[0]
    rows = [row.split("|")[2] for row in table.splitlines() if row.startswith("| ")][1:]
    listed = [set(re.findall(r"`(\w+)`", row)) for row in rows]
    with (ROOT / "pyproject.toml").open("rb") as file:
        contract = tomllib.load(file)["tool"]["importlinter"]["contracts"][0]["layers"]
    lowest_first = [set(re.findall(r"\w+", layer)) - {"_version"} for layer in reversed(contract)]
    assert set.union(*listed) == set.union(*lowest_first)
    order = {name: number for number, names in enumerate(listed) for name in names}
    numbers = [order[name] for names in lowest_first for name in sorted(names, key=order.__getitem__)]
    assert numbers == sorted(numbers)


def test_the_tree_is_that_of_the_sources() -> None:
    """``python tools/source_tree.py --write`` draws it anew."""
    block = PAGE.partition("## Source tree\n\n```text\n")[2].partition("```")[0]
    assert block == runpy.run_path(str(ROOT / "tools" / "source_tree.py"))["tree"]()


def test_the_modules_of_the_data_flow_exist() -> None:
    table = PAGE.partition("## Data flow")[2].partition("## Values by name")[0]
    cells = [row.split("|")[2] for row in table.splitlines() if row.startswith("| ")]
    names = [name for cell in cells for name in re.findall(r"`([a-z_.]+)`", cell)]
    assert len(names) > 80
    assert [n for n in names if f"kineverse.{n}" not in _modules()] == []


def test_modules_and_folders_have_a_good_size() -> None:
    """Large modules are divided, and small ones belong into the module that imports them."""
    modules = _modules()
    lines, importers = count_lines(modules), find_importers(modules)
    assert {name for name, n in lines.items() if n > LARGEST} == LARGE
    small = {
        name: importers[name]
        for name, n in lines.items()
        if n < SMALLEST and len(importers[name]) == 1 and name.startswith("kineverse.")
    }
    small = {name: by for name, by in small.items() if modules[name].stem != "__init__"}
    assert {name: by for name, by in small.items() if name not in SMALL} == {}
    assert small.keys() >= SMALL
    folders = Counter(path.parent.relative_to(ROOT).as_posix() for path in modules.values())
    assert {folder: n for folder, n in folders.items() if n > MOST_FILES} == {}


@cache
def _modules() -> dict[str, Path]:
    return find_modules(ROOT / "src", ROOT / "studies")


def test_the_package_does_not_import_its_studies() -> None:
    sources = sorted((ROOT / "src").rglob("*.py"))
    assert [path for path in sources if "kineverse_studies" in path.read_text("utf-8")] == []


def test_hand_written_c_is_in_files() -> None:
    """Python has C only where it is made of expressions, in pieces. ``kineverse._native`` has the rest."""
    pieces = [
        f"{path}:{node.lineno}"
        for path in sorted((ROOT / "src").rglob("*.py"))
        for node in _strings_of(ast.parse(path.read_text("utf-8")))
        if node.value.count("\n") >= MOST_LINES_OF_C and _is_c(node.value)
    ]
    assert pieces == []
    files = [path.read_text("utf-8") for path in sorted((ROOT / "src/kineverse/_native").rglob("*.[ch]"))]
    assert all(_is_c(text) for text in files if text.count("\n") >= MOST_LINES_OF_C)


def _strings_of(module: ast.Module) -> list[ast.Constant]:
    """Return the strings of a module but those that stand alone, which document what is above them."""
    nodes = [*ast.walk(module)]
    alone = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
    strings = [node for node in nodes if isinstance(node, ast.Constant) and id(node) not in alone]
    return [node for node in strings if isinstance(node.value, str)]


def _is_c(text: str) -> bool:
    return bool(re.search(r"\b(void|int|double|float|struct|static)\b.*[;{]$", text, re.MULTILINE))


@pytest.mark.parametrize("package", ["formats", "geometry", "view"])
def test_private_attributes_of_expressions_are_read_by_no_package_above(package: str) -> None:
    private = {slot for slot in kv.Expression.__slots__ if not slot.startswith("__")}
    reads = [
        f"{path}:{node.lineno}: {ast.unparse(node)}"
        for path in sorted((ROOT / "src" / "kineverse" / package).rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text("utf-8")))
        if isinstance(node, ast.Attribute) and node.attr in private and ast.unparse(node.value) != "self"
    ]
    assert not reads, "\n".join(reads)
