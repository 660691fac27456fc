"""Public names: each has one home, the shortest path that imports it, and may have other paths."""

from __future__ import annotations

import ast
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
SRC = ROOT / "src"


@dataclass(frozen=True)
class PublicName:
    """A name that users import."""

    home: str  # the path on its page: kineverse.control.Goal
    others: tuple[str, ...]  # further public paths
    definition: str  # module.name where it is written

    @property
    def module(self) -> str:
        """Public module of the home."""
        return self.home.rpartition(".")[0]

    @property
    def name(self) -> str:
        """Name within its module."""
        return self.home.rpartition(".")[2]


@cache
def find_modules() -> dict[str, dict[str, str]]:
    """Return the names of all public modules, each with its definition, without an import of them.

    They are the packages with a face, and the modules right below ``kineverse``. A package is public if its
    ``__init__`` imports names under ``TYPE_CHECKING``, or has an ``__all__``.
    """
    faces = {}
    paths = sorted({*(SRC / "kineverse").rglob("__init__.py"), *(SRC / "kineverse").glob("[a-z]*.py")})
    for path in paths:
        parts = path.relative_to(SRC).with_suffix("").parts
        is_package = parts[-1] == "__init__"
        module = ".".join(parts[:-1] if is_package else parts)
        names = dict(_read_face(ast.parse(path.read_text(encoding="utf-8")), module, is_package))
        if names:
            faces[module] = names
    return faces


def _read_face(tree: ast.Module, module: str, is_package: bool) -> Iterator[tuple[str, str]]:
    listed, imported = [], {}
    for node in tree.body:
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING" and is_package:
            for item in node.body:
                if isinstance(item, ast.ImportFrom):
                    listed += [alias.name for alias in item.names if alias.asname == alias.name]
                    imported |= {alias.name: _absolute(item, module) for alias in item.names}
        elif isinstance(node, ast.ImportFrom) and is_package:
            imported |= {alias.name: _absolute(node, module) for alias in node.names}
        elif isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
            listed += ast.literal_eval(node.value)
    for name in listed:
        yield name, f"{imported.get(name, module)}.{name}"


def _absolute(item: ast.ImportFrom, package: str) -> str:
    if not item.level:
        return item.module or ""
    above = ".".join(package.split(".")[: 1 - item.level or None])
    return f"{above}.{item.module}" if item.module else above


@cache
def find_names() -> tuple[PublicName, ...]:
    """Return all public names but modules, by home."""
    modules = find_modules()
    paths = defaultdict(list)
    for module, names in modules.items():
        for name, definition in names.items():
            if definition not in modules:
                paths[_define(definition)].append(f"{module}.{name}")
    found = []
    for definition, several in paths.items():
        home, *others = sorted(several, key=lambda path: _rank(path, definition))
        found.append(PublicName(home, tuple(others), definition))
    return tuple(sorted(found, key=lambda one: one.home))


def _define(path: str) -> str:
    """Follow a name through the faces that hand it on."""
    module, _, name = path.rpartition(".")
    further = find_modules().get(module, {}).get(name, path)
    return path if further == path else _define(further)


def _rank(path: str, definition: str) -> tuple[int, bool, str]:
    """Order the paths of a name: the shortest first, then that of the package that defines it."""
    module = path.rpartition(".")[0]
    return path.count("."), not definition.startswith(f"{module}."), path


@cache
def find_pages() -> dict[str, str]:
    """Return the page of each public module and name: one of its own, or that of a module without packages.

    Names of files differ in more than case, as some file systems want it.
    """
    pages = {module: f"api/module-{module}" for module in find_modules()}
    taken = set()
    for one in find_names():
        if not is_package(one.module):
            pages[one.home] = pages[one.module]
            continue
        file = one.home
        while file.lower() in taken:
            file += "_"
        taken.add(file.lower())
        pages[one.home] = f"api/{file}"
    return pages


def is_package(module: str) -> bool:
    """Return whether a public module is a package, whose names have a page each."""
    return (SRC / module.replace(".", "/")).is_dir()


@cache
def find_homes() -> dict[str, str]:
    """Return the home of each path that means a public name or module: homes, other paths, definitions."""
    homes = {module: module for module in find_modules()}
    for one in find_names():
        homes |= dict.fromkeys((one.home, one.definition, *one.others), one.home)
    return homes


def find_home(path: str) -> str | None:
    """Return the home of a path, also of a member of a class: ``kineverse.model.model.Model.fk``."""
    homes, rest = find_homes(), ""
    while path:
        if path in homes and (rest == "" or homes[path] not in find_modules()):
            return homes[path] + rest
        path, _, last = path.rpartition(".")
        rest = f".{last}{rest}"
    return None


@cache
def list_aliases() -> dict[str, str]:
    """Return the home of each capitalised name that only one public class has, for types in plain text."""
    homes: dict[str, str] = {}
    several = set()
    for one in find_names():
        if one.name in homes:
            several.add(one.name)
        if one.name[0].isupper():
            homes[one.name] = one.home
    return {name: home for name, home in homes.items() if name not in several}
