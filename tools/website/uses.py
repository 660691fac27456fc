"""Uses of public names: in the Python blocks of the pages, and in the example scripts."""

from __future__ import annotations

import ast
import json
import re
from collections import defaultdict
from collections.abc import Iterator
from functools import cache

from website.names import ROOT, find_home, find_modules
from website.pages import find_documents

_BLOCK = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)


@cache
def find_uses() -> dict[str, set[str]]:
    """Return the homes of the public names that each file uses, for all files that are pages of the site."""
    return {file: set(list_names(_read_code(file))) for file in find_documents()}


@cache
def find_users() -> dict[str, list[str]]:
    """Return the files that use each public name, pages before scripts."""
    users = defaultdict(list)
    for file in sorted(find_documents(), key=lambda one: (not one.endswith(".md"), one)):
        for home in find_uses()[file]:
            users[home].append(file)
    return dict(users)


def list_names(code: str) -> Iterator[str]:
    """Yield the homes of the public names that code imports or reaches by dots."""
    meanings: dict[str, str] = {}
    tree = ast.parse(code)
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                meanings[alias.asname or alias.name.partition(".")[0]] = (
                    alias.name if alias.asname else alias.name.partition(".")[0]
                )
        elif isinstance(node, ast.ImportFrom) and not node.level:
            for alias in node.names:
                meanings[alias.asname or alias.name] = f"{node.module}.{alias.name}"
                yield from _public(f"{node.module}.{alias.name}")
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute):
            first, _, rest = ast.unparse(node).partition(".")
            if first in meanings:
                yield from _public(f"{meanings[first]}.{rest}")


def _public(path: str) -> Iterator[str]:
    """Yield the public name that a path means, or of which it means a member."""
    home = find_home(path)
    if home is None or home in find_modules():
        return
    module = max((one for one in find_modules() if home.startswith(f"{one}.")), key=len)
    yield f"{module}.{home.removeprefix(f'{module}.').partition('.')[0]}"


def _read_code(file: str) -> str:
    path = ROOT / file
    if path.is_dir():
        return "\n".join(one.read_text(encoding="utf-8") for one in sorted(path.glob("*.py")))
    text = path.read_text(encoding="utf-8")
    if file.endswith(".ipynb"):
        cells = (cell["source"] for cell in json.loads(text)["cells"] if cell["cell_type"] == "code")
        return "\n".join("".join(cell) for cell in cells)
    return "\n".join(_BLOCK.findall(text)) if file.endswith(".md") else text
