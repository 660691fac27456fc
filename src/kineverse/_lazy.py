"""Lazy faces of packages: a public name is imported from its module at first use (PEP 562)."""

from __future__ import annotations

import builtins
import importlib
import importlib.util
import sys
from collections.abc import Callable, Mapping
from types import CodeType, SimpleNamespace


def lazy_face(package: str, below: Callable[[], Mapping[str, str]] | None = None) -> None:
    """Give a package its public names: ``__all__``, ``__dir__`` and a ``__getattr__`` that imports them.

    The names are those that the package imports below ``if TYPE_CHECKING``, so a type checker sees the same.
    ``below`` are names of other packages, for errors.
    """
    face = vars(sys.modules[package])
    homes = _list_imports(sys._getframe(1).f_code)
    public = sorted(name for name in homes if not name.startswith("_"))

    def find(name: str) -> object:
        home = homes.get(name)
        if home not in (None, package):
            value = face[name] = getattr(importlib.import_module(home, package), name)
            return value
        if not name.startswith("_") and importlib.util.find_spec(f".{name}", package):
            return importlib.import_module(f".{name}", package)
        from kineverse._synonyms import MODULE_SYNONYMS  # for start-up time, like all of this
        from kineverse.errors import unknown_attribute_error

        further = {} if below is None or name.startswith("_") else below()
        raise unknown_attribute_error(f"The package {package}", name, public, MODULE_SYNONYMS, further)

    def list_names() -> list[str]:
        return sorted({*public, *(name for name in face if name.startswith("__"))})

    face.update(__all__=public, __getattr__=find, __dir__=list_names)


def _list_imports(code: CodeType) -> dict[str, str]:
    """Run a module with TYPE_CHECKING set and with an import that only takes notes: {name: module}."""
    homes: dict[str, str] = {}

    def note(name: str, _globals: object, _locals: object, names: tuple[str, ...], level: int) -> object:
        if name == "typing":
            return SimpleNamespace(TYPE_CHECKING=True)
        if name == __name__:
            return SimpleNamespace(lazy_face=lambda *_, **__: None)
        homes.update(dict.fromkeys(names, "." * level + name))
        return SimpleNamespace(**dict.fromkeys(names))

    exec(code, {"__name__": "", "__builtins__": {**vars(builtins), "__import__": note}})
    return homes
