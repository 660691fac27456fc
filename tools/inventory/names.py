"""Public names with their signatures, as they are reached from the faces of packages."""

from __future__ import annotations

import ast
import dataclasses
import importlib.util
import inspect
import pkgutil
import re
import textwrap
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

from inventory.bounded import ROOT, neutral

ROOTS = ("kineverse", "kineverse_studies")
MODULES = (
    "lie",
    "spatial",
    "state",
    "symbols",
    "logic",
    "errors",
    "intervals",
    "model.body",
    "manipulation.session",
)
_IMPORT = re.compile(r"^\s*(?:from (kineverse[\w.]*) import (?:\(([^)]*)\)|([\w, ]+)))", re.MULTILINE)
_USUAL = {
    "__init__",
    "__new__",
    "__repr__",
    "__str__",
    "__hash__",
    "__eq__",
    "__reduce__",
    "__getattr__",
    "__getstate__",
}
_USUAL |= {
    "__setstate__",
    "__post_init__",
    "__init_subclass__",
    "__dir__",
    "__reduce_ex__",
    "__setattr__",
    "__delattr__",
}
_USUAL |= {
    "__replace__",
    "__class_getitem__",
    "__copy__",
    "__deepcopy__",
    "__instancecheck__",
    "__subclasshook__",
    "__del__",
}


def names(data: Path | None) -> dict[str, Any]:
    """Return all public names: ``face:name`` and ``face:Class.member``."""
    faces = {face: _public(module) for face, module in _faces()}
    for face, imported in _documented():
        faces.setdefault(face, [])
        faces[face] += [name for name in imported if name not in faces[face]]
    return {key: entry for face in sorted(faces) for key, entry in describe(face, faces[face])}


def describe(face: str, public: list[str] | None = None) -> Iterator[tuple[str, Any]]:
    """Yield the names of a module with their descriptions."""
    try:
        module = importlib.import_module(face)
    except ImportError as error:
        yield f"{face}:", {"kind": "missing", "error": str(error)}
        return
    for name in sorted(_public(module) if public is None else public):
        try:
            value = getattr(module, name)
        except AttributeError:
            below = hasattr(module, "__path__") and importlib.util.find_spec(f"{face}.{name}")
            kind = "module" if below else "missing"
            yield f"{face}:{name}", {"kind": kind}
            continue
        except Exception as error:  # a lazy name
            yield f"{face}:{name}", {"kind": "missing", "error": f"{type(error).__name__}: {error}"}
            continue
        if inspect.isclass(value):
            bases = [b.__name__ for b in value.__mro__[1:-1] if not b.__name__.startswith("_")]
            kind = "exception" if issubclass(value, BaseException) else "class"
            yield f"{face}:{name}", {"kind": kind, "bases": bases, "signature": signature(value)}
            for member, entry in sorted(_members(value).items()):
                yield f"{face}:{name}.{member}", entry
        elif inspect.ismodule(value):
            yield f"{face}:{name}", {"kind": "module"}
        elif callable(value) and hasattr(value, "__name__"):
            yield f"{face}:{name}", {"kind": "function", "signature": signature(value)}
        else:
            yield f"{face}:{name}", {"kind": type(value).__name__, "value": short(value)}


def signature(function: Any) -> str:
    """Return parameters with their defaults, without types."""
    try:
        parameters = inspect.signature(function).parameters.values()
    except (ValueError, TypeError):
        return "?"
    shown = [
        p.replace(annotation=p.empty, default=p.default if p.default is p.empty else _Default(p.default))
        for p in parameters
    ]
    return str(inspect.Signature(shown))


def short(value: object) -> str:
    """Return the beginning of a representation that does not depend on where things are defined."""
    if isinstance(value, Mapping):
        value = sorted(map(str, value)) if all(isinstance(key, str) for key in value) else "a mapping"
    text = re.sub(r"\b(?:kineverse\w*)(?:\.\w+)*\.(?=\w)", "", neutral(repr(value)))
    return textwrap.shorten(text, 100, placeholder=" ...")


class _Default:
    def __init__(self, value: object) -> None:
        self.text = short(value)

    def __repr__(self) -> str:
        return self.text


def _faces() -> Iterator[tuple[str, ModuleType]]:
    """Yield modules that users import from: packages with ``__all__`` and :data:`MODULES`."""
    for root in ROOTS:
        try:
            top = importlib.import_module(root)
        except ImportError:
            continue
        yield root, top
        for found in pkgutil.walk_packages(top.__path__, f"{root}.", onerror=lambda name: None):
            below = found.name.removeprefix(f"{root}.")
            if any(part.startswith("_") for part in below.split(".")):
                continue
            if found.ispkg or "." not in below or below in MODULES:
                module = importlib.import_module(found.name)
                if below in MODULES or hasattr(module, "__all__"):
                    yield found.name, module


def _documented() -> Iterator[tuple[str, list[str]]]:
    """Yield what documents and examples import."""
    for file in [
        ROOT / "README.md",
        *sorted((ROOT / "docs").glob("*.md")),
        *sorted((ROOT / "examples").rglob("*.py")),
    ]:
        for face, several, one in _IMPORT.findall(file.read_text("utf-8")):
            listed = [name.split(" as ")[0].strip() for name in re.sub(r"#.*", "", several or one).split(",")]
            yield face, [name for name in listed if name.isidentifier()]


def _public(module: ModuleType) -> list[str]:
    if hasattr(module, "__all__"):
        return list(module.__all__)
    return [
        name
        for name, value in vars(module).items()
        if not name.startswith("_") and getattr(value, "__module__", module.__name__) == module.__name__
        if not inspect.ismodule(value) and name not in ("annotations", "TYPE_CHECKING")
    ]


def _members(owner: type) -> dict[str, Any]:
    """Return methods, values and operators of a class, also of its bases in the package."""
    found: dict[str, Any] = {}
    operators: set[str] = set()
    for base in owner.__mro__:
        if not base.__module__.startswith(ROOTS):
            continue
        for name in {*vars(base), *vars(base).get("__annotations__", {}), *_assigned(base)}:
            if name.startswith("__") and name not in _USUAL and callable(vars(base).get(name)):
                operators.add(name)
            elif not name.startswith("_") and name not in found:
                found[name] = _member(inspect.getattr_static(owner, name, None))
    if dataclasses.is_dataclass(owner):
        found |= {f.name: {"kind": "value"} for f in dataclasses.fields(owner) if not f.name.startswith("_")}
    return found | ({"operators": sorted(operators)} if operators else {})


def _member(value: object) -> dict[str, str]:
    if isinstance(value, (classmethod, staticmethod)):
        return {"kind": type(value).__name__, "signature": signature(value.__func__)}
    if inspect.isfunction(value):
        return {"kind": "method", "signature": signature(value)}
    return {"kind": "value"}


def _assigned(owner: type) -> set[str]:
    """Return names of attributes that methods assign."""
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(owner)))
    except (OSError, TypeError, SyntaxError):
        return set()
    return {
        node.attr
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store)
        if isinstance(node.value, ast.Name) and node.value.id == "self"
    }
