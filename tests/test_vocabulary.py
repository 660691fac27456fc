"""The vocabulary of the sources: one name for one thing, and docstrings in the field's terms."""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from importlib import import_module
from pathlib import Path

import pytest

import kineverse as kv
from kineverse._runtime import no_collection

ROOT = Path(__file__).parents[1]
SOURCES = {"": ROOT / "src" / "kineverse", "studies.": ROOT / "studies" / "kineverse_studies"}
CLAUSE = re.compile(
    r"(What|Who|Whose|Whom|Whoever|Whatever|Whether|Where|Wherever|How|However|Which|When|Why|That|If)\b"
)
SECTION = re.compile(r"^(Parameters|Returns|Raises|Attributes|Yields)\n-{3,}$", re.MULTILINE)
Definition = ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
TWINS = {"lie", "spatial"}
"""Modules that have the same names on purpose: numbers and expressions."""

INTERFACES = {
    "cli": {"add_arguments", "main", "run"},
    "studies": {"add_arguments", "main", "measure", "run"}
    | {"batch", "call", "document", "edit", "frames", "loop", "make_loop"},
}
"""Functions that every command, benchmark or experiment has, since they are called by that name."""


@cache
def trees() -> dict[str, ast.Module]:
    with no_collection():
        return {
            prefix + ".".join(path.relative_to(folder).with_suffix("").parts): ast.parse(
                path.read_text("utf-8")
            )
            for prefix, folder in SOURCES.items()
            for path in sorted(folder.rglob("*.py"))
        }


def definitions(node: ast.AST) -> Iterator[ast.AST]:
    """Yield a node and the statements in it, without their expressions: those define nothing."""
    yield node
    for name in ("body", "orelse", "finalbody", "handlers", "cases"):
        for inner in below if isinstance(below := getattr(node, name, None), list) else ():
            yield from definitions(inner)


def documented(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield the line and the text of all docstrings, those of attributes included."""
    for node in definitions(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            for first, statement in enumerate(node.body):
                if isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant):
                    text = statement.value.value
                    if isinstance(text, str) and (first == 0 or not isinstance(node, ast.FunctionDef)):
                        yield statement.lineno, text.strip()


def test_no_docstring_begins_with_a_clause() -> None:
    clauses = [
        f"{module}:{line}: {text.splitlines()[0]}"
        for module, tree in trees().items()
        for line, text in documented(tree)
        if CLAUSE.match(text)
    ]
    assert not clauses, "\n".join(clauses)


def test_functions_begin_with_a_verb_and_classes_do_not() -> None:
    """Functions say what they do ("Return", "Compute"); D401 of the linter holds the mood."""
    functions: set[str] = set()
    for tree in trees().values():
        for node in definitions(tree):
            if isinstance(node, ast.FunctionDef) and not is_property(node) and ast.get_docstring(node):
                functions.add((ast.get_docstring(node) or "").split()[0].strip(".,;:"))
    nouns = {
        word for word in functions if word in ("The", "A", "An", "This", "It", "Its", "All", "Each", "No")
    }
    assert not nouns
    third_person = {
        "Adds",
        "Applies",
        "Closes",
        "Collects",
        "Gives",
        "Holds",
        "Keeps",
        "Says",
        "Sets",
        "Stores",
    }
    verbs = {"Return", "Yield", "Compute", "Raise", "Write", "Make", "Build", "Find"}
    classes = [
        f"{module}.{node.name}: {text}"
        for module, tree in trees().items()
        for node in definitions(tree)
        if isinstance(node, ast.ClassDef)
        and (text := ast.get_docstring(node) or "-").split()[0] in verbs | third_person
    ]
    assert not classes, "\n".join(classes)


def test_reference_sections_belong_to_exported_names() -> None:
    """What no face exports has one line, and units and shapes next to the field."""
    exported = exported_names()
    sections = [
        f"{module}:{node.lineno}: {node.name}"
        for module, tree in trees().items()
        if not module.startswith("studies.")
        for node in unexported(tree.body, exported)
        if SECTION.search(ast.get_docstring(node) or "")
    ]
    assert not sections, "\n".join(sections)


def exported_names() -> set[str]:
    """Return the names in the face of any package or public module, and those of the bases of such classes."""
    source = SOURCES[""]
    packages = [init.parent.relative_to(source.parent).parts for init in source.rglob("__init__.py")]
    modules = [import_module(".".join(parts)) for parts in packages]
    modules += [import_module(f"kineverse.{path.stem}") for path in source.glob("[a-z]*.py")]
    faces = [(module, name) for module in modules for name in getattr(module, "__all__", vars(module))]
    values = [getattr(module, name) for module, name in faces]
    bases = {base.__name__ for value in values if isinstance(value, type) for base in value.__mro__}
    return bases | {name for _, name in faces if name[0] != "_"}


def unexported(body: list[ast.stmt], exported: set[str] | None) -> Iterator[Definition]:
    """Yield the definitions that are not public; all names without an underscore are if ``exported`` is None."""
    for node in body:
        if isinstance(node, Definition):
            special = node.name.startswith("__")
            public = special or (node.name[0] != "_" if exported is None else node.name in exported)
            if not public:
                yield node
            is_face = public and isinstance(node, ast.ClassDef)
            yield from unexported(node.body, None if is_face else set())


def is_property(node: ast.FunctionDef) -> bool:
    return any(
        (isinstance(d, ast.Name) and d.id.endswith("property"))
        or (isinstance(d, ast.Attribute) and d.attr in ("setter", "getter"))
        for d in node.decorator_list
    )


def test_one_name_is_one_thing() -> None:
    """A public class or function of a module has a name of its own in the whole package."""
    owners: defaultdict[str, set[str]] = defaultdict(set)
    for module, tree in trees().items():
        for node in tree.body:
            if isinstance(node, ast.ClassDef | ast.FunctionDef) and not node.name.startswith("_"):
                if node.name not in INTERFACES.get(module.partition(".")[0], ()):
                    owners[node.name].add(module)
    several = {
        name: sorted(modules)
        for name, modules in owners.items()
        if len(modules - TWINS) > 1 or (len(modules) > 1 and modules & TWINS and modules - TWINS)
    }
    assert not several, "\n".join(f"{name}: {', '.join(where)}" for name, where in sorted(several.items()))


def test_the_face_is_small() -> None:
    assert len(kv.__all__) <= 64
    for name in kv.__all__:
        assert getattr(kv, name) is not None


@pytest.mark.parametrize(
    ("name", "place"),
    [
        ("Ball", "kv.articulations.Ball"),
        ("UnknownNameError", "kv.errors.UnknownNameError"),
        ("Writes", "kv.model.Writes"),
        ("less", "kv.logic.less"),
        ("to_bytes", "kv.formats.to_bytes"),
        ("Tracker", "kv.estimation.Tracker"),
        ("Scene", "kv.geometry.Scene"),
        ("interlocks", "kv.reasoning.interlocks"),
    ],
)
def test_a_name_that_lives_below_is_answered_with_its_place(name: str, place: str) -> None:
    with pytest.raises(AttributeError, match=re.escape(place)):
        getattr(kv, name)
