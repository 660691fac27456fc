"""Pages of the reference: one for each public module, and one for each public name of a package."""

from __future__ import annotations

import ast
import importlib
import inspect
import posixpath
from collections.abc import Iterable, Iterator

from sphinx.pycode import ModuleAnalyzer

from website.names import (
    PublicName,
    find_home,
    find_homes,
    find_modules,
    find_names,
    find_pages,
    is_package,
)
from website.pages import find_documents
from website.uses import find_users

BASES = "object, ABC, Protocol, Generic, Mapping, Sequence, Struct, Enum, BaseException, tuple, str, int"
"""Classes of other people: what a class of ours has from them stands in their own documentation."""

INTRODUCTION = (
    "``import kineverse as kv`` gives what most programs need; the rest is in its packages. A name that "
    "several packages export has one page, under its shortest path. The search finds methods as well."
)


def write_reference() -> Iterator[tuple[str, str]]:
    """Yield the pages, as places without suffix and reStructuredText."""
    pages = find_pages()
    yield "api/index", _write_index()
    for module in find_modules():
        yield pages[module], _write_module(module)
    for one in find_names():
        if is_package(one.module):
            yield pages[one.home], _write_name(one)


def shorten(path: str) -> str:
    """Return a path as programs write it, with ``kv`` for the package."""
    return "kv" + path.removeprefix("kineverse")


def link_names(file: str, homes: Iterable[str]) -> Iterator[str]:
    """Yield Markdown links from the page of a script to the pages of the names that it uses."""
    here = posixpath.dirname(find_documents()[file])
    for home in sorted(homes):
        page = posixpath.relpath(f"{find_pages()[home]}.rst", here or ".")
        yield f"[`{shorten(home)}`]({page})"


def resolve(home: str) -> object:
    """Return what a public path means."""
    if home in find_modules():
        return importlib.import_module(home)
    module, _, name = home.rpartition(".")
    return getattr(importlib.import_module(module), name)


def _write_index() -> str:
    table = [(_refer(module, shorten(module)), _summarize(module)) for module in find_modules()]
    tree = [f"   {shorten(module)} </{find_pages()[module]}>" for module in find_modules()]
    toctree = "\n".join([".. toctree::", "   :hidden:", "", *tree])
    return _join(_head("Python API"), INTRODUCTION, _table(table), toctree)


def _write_module(module: str) -> str:
    """Write the page of a module: its docstring, a table of its names, and the names if it is no package."""
    homes = find_homes()
    names = {
        name: homes.get(definition) or homes[f"{module}.{name}"]
        for name, definition in find_modules()[module].items()
    }
    order = sorted(names, key=lambda name: (names[name] not in find_modules(), not name[0].isupper(), name))
    table = [(_refer(names[name], name), _summarize(names[name])) for name in order]
    parts = [_head(shorten(module)), f".. automodule:: {module}\n   :no-members:", _table(table)]
    if not is_package(module):
        parts += [_document(one) for one in find_names() if one.module == module]
    return _join(*parts)


def _write_name(one: PublicName) -> str:
    others = ", ".join(f"``{shorten(other)}``" for other in one.others)
    place = f"In {_refer(one.module, shorten(one.module))}{'; also ' if others else ''}{others}."
    return _join(":orphan:", _head(one.name), place, _document(one))


def _document(one: PublicName) -> str:
    """Return the directives that document a name, and the pages that use it."""
    value = resolve(one.home)
    if inspect.isclass(value):
        text = f".. autoclass:: {one.home}\n   :members:\n   :inherited-members: {BASES}"
        if any(find_home(f"{base.__module__}.{base.__qualname__}") for base in value.__bases__):
            text += "\n   :show-inheritance:"
    elif inspect.isfunction(value):
        text = f".. autofunction:: {one.home}"
    else:
        text = f".. py:data:: {one.home}\n   :value: {_write_value(one)}\n\n   {_describe_value(one)}"
    users = find_users().get(one.home)
    if not users:
        return text
    links = ", ".join(f":doc:`/{find_documents()[file]}`" for file in users)
    return f"{text}\n\n.. rubric:: Used in\n\n{links}"


def _write_value(one: PublicName) -> str:
    """Return the value of a constant, or what an alias of a type stands for, as the source has it."""
    module, _, name = one.definition.rpartition(".")
    for node in ast.parse(ModuleAnalyzer.for_module(module).code).body:
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            if name in map(ast.unparse, targets):
                is_alias = isinstance(node, ast.AnnAssign) and ast.unparse(node.annotation) == "TypeAlias"
                is_text = isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
                return node.value.value if is_alias and is_text else ast.unparse(node.value)
    raise LookupError(f"{one.definition} has no value in its module")


def _describe_value(one: PublicName) -> str:
    """Return the text that stands below a constant in the source."""
    module, _, name = one.definition.rpartition(".")
    return " ".join(ModuleAnalyzer.for_module(module).find_attr_docs().get(("", name), [""])).strip()


def _summarize(home: str) -> str:
    """Return the first line about a name."""
    value = resolve(home)
    if inspect.ismodule(value) or inspect.isclass(value) or inspect.isfunction(value):
        return (inspect.getdoc(value) or "").partition("\n")[0]
    return _describe_value(next(one for one in find_names() if one.home == home))


def _refer(home: str, text: str) -> str:
    if home in find_modules():
        return f":doc:`{text} </{find_pages()[home]}>`"
    return f":py:obj:`{text} <{home}>`"


def _table(rows: Iterable[tuple[str, str]]) -> str:
    lines = [line for one, other in rows for line in (f"   * - {one}", f"     - {other}")]
    return "\n".join([".. list-table::", "   :widths: 35 65", "", *lines])


def _head(title: str) -> str:
    return f"{title}\n{'=' * len(title)}"


def _join(*parts: str) -> str:
    return "\n\n".join(parts) + "\n"
