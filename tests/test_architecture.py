"""The architecture page: its layers are those that the linter holds, and its tree is that of the sources."""

from __future__ import annotations

import ast
import re
import runpy
import tomllib
from pathlib import Path

import pytest

import kineverse as kv

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "architecture.md").read_text("utf-8")


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


def test_the_package_does_not_import_its_studies() -> None:
    sources = sorted((ROOT / "src").rglob("*.py"))
    assert [path for path in sources if "kineverse_studies" in path.read_text("utf-8")] == []


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
