"""Pages of the reference: one for each public module, and one for each public name of a package."""

from __future__ import annotations

import importlib
import inspect
import posixpath
from collections.abc import Iterator

from sphinx.pycode import ModuleAnalyzer

from website.names import PublicName, find_home, find_homes, find_modules, find_names, find_pages, is_package
from website.pages import find_documents
from website.uses import find_users

BASES = "object, ABC, Mapping, Sequence, Struct, tuple, dict, str, int, Enum, BaseException, Exception, Protocol, Generic"
"""Classes of other people: what a class of ours has from them stands in their own documentation."""


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


def summarize(documented: object) -> str:
    """Return the first line of a docstring."""
    return (inspect.getdoc(documented) or "").partition("\n")[0]


def _write_index() -> str:
    title = "Python API"
    rows = [f"   * - :doc:`{shorten(module)} </{find_pages()[module]}>`\n     - {summarize(importlib.import_module(module))}" for module in find_modules()]
    intro = (
        "``import kineverse as kv`` gives what most programs need; the rest is in its packages. A name that several "
        "packages export has one page, under its shortest path. The search box finds methods as well."
    )
    tree = [f"   {shorten(module)} </{find_pages()[module]}>" for module in find_modules()]
    return "\n".join(
        [_head(title), intro, "", ".. list-table::", "   :widths: 35 65", "", *rows, "", ".. toctree::", "   :hidden:", "", *tree, ""]
    )


def _write_module(module: str) -> str:
    """Write the page of a module: its docstring, a table of its names, and the names if it is no package."""
    parts = [_head(shorten(module)), f".. automodule:: {module}\n   :no-members:"]
    own = [one for one in find_names() if one.module == module]
    names = {one.name: one.home for one in own}
    for name, definition in find_modules()[module].items():
        names[name] = find_homes()[definition] if definition in find_homes() else names[name]
    rows = [f"   * - {_refer(home, name)}\n     - {_summarize_name(home)}" for name, home in sorted(names.items(), key=_by_kind)]
    parts.append("\n".join([".. list-table::", "   :widths: 35 65", "", *rows]))
    if not is_package(module):
        parts += [_document(one) for one in own]
    return "\n\n".join(parts) + "\n"


def _by_kind(entry: tuple[str, str]) -> tuple[bool, bool, str]:
    """Order modules first, then classes, then functions and constants."""
    name, home = entry
    return home not in find_modules(), not name[0].isupper(), name


def _refer(home: str, text: str) -> str:
    if home in find_modules():
        return f":doc:`{text} </{find_pages()[home]}>`"
    return f":py:obj:`{text} <{home}>`"


def _write_name(one: PublicName) -> str:
    parts = [":orphan:", _head(one.name)]
    parts += [f"In {_refer(one.module, shorten(one.module))}." if not one.others else f"In {_refer(one.module, shorten(one.module))}; also as {', '.join(f'``{shorten(other)}``' for other in one.others)}."]
    parts.append(_document(one))
    return "\n\n".join(parts) + "\n"


def _document(one: PublicName) -> str:
    """Return the directives that document a name, and the pages that use it."""
    value = resolve(one.home)
    if inspect.isclass(value):
        text = f".. autoclass:: {one.home}\n   :members:\n   :inherited-members: {BASES}"
        if any(find_home(f"{base.__module__}.{base.__qualname__}") for base in value.__bases__):
            text += "\n   :show-inheritance:"
    elif callable(value) and hasattr(value, "__code__"):
        text = f".. autofunction:: {one.home}"
    else:
        text = _document_value(one, value)
    users = find_users().get(one.home)
    if users:
        places = find_documents()
        links = ", ".join(f":doc:`/{places[file]}`" for file in users)
        text += f"\n\n.. rubric:: Used in\n\n{links}"
    return text


def _document_value(one: PublicName, value: object) -> str:
    """Return the directive of a constant or an alias of a type, with what the source says about it."""
    return f".. py:data:: {one.home}\n   :value: {_format_value(one)}\n\n   {_describe_value(one)}"


def _format_value(one: PublicName) -> str:
    module, _, name = one.definition.rpartition(".")
    import ast

    analyzer = ModuleAnalyzer.for_module(module)
    for node in ast.parse(analyzer.code).body:
        targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
        if any(ast.unparse(target) == name for target in targets):
            value = node.value
            text = value.value if isinstance(value, ast.Constant) and isinstance(value.value, str) and isinstance(node, ast.AnnAssign) else ast.unparse(value)
            return " ".join(text.split())
    raise LookupError(one.definition)


def _describe_value(one: PublicName) -> str:
    module, _, name = one.definition.rpartition(".")
    comments = ModuleAnalyzer.for_module(module).find_attr_docs()
    return " ".join(comments.get(("", name), [""])).strip()


def _summarize_name(home: str) -> str:
    value = resolve(home)
    if inspect.ismodule(value) or inspect.isclass(value) or hasattr(value, "__code__"):
        return summarize(value)
    one = next(one for one in find_names() if one.home == home)
    return _describe_value(one).partition(". ")[0]


def resolve(home: str) -> object:
    """Return what a public path means."""
    if home in find_modules():
        return importlib.import_module(home)
    module, _, name = home.rpartition(".")
    return getattr(importlib.import_module(module), name)


def link_names(file: str, homes: set[str]) -> Iterator[str]:
    """Yield Markdown links from the page of a script to the pages of the names that it uses."""
    here = posixpath.dirname(find_documents()[file])
    for home in sorted(homes):
        page = posixpath.relpath(f"{find_pages()[home]}.rst", here or ".")
        yield f"[`{shorten(home)}`]({page})"


def _head(title: str) -> str:
    return f"{title}\n{'=' * len(title)}"
