"""Lazy faces of packages: a public name is imported from its module at first use (PEP 562)."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections.abc import Callable, Mapping


def lazy_face(
    package: str,
    names: Mapping[str, str],
    below: Callable[[], Mapping[str, str]] | None = None,
) -> None:
    """Give a package its public names: ``__all__``, ``__dir__`` and a ``__getattr__`` that imports them.

    ``names`` are the public names, separated by spaces, by the module that defines them, relative to the
    package: ``{".scene": "Scene"}``; those of ``"."`` are modules. ``below`` are names of other packages, for
    errors. For type checkers the package imports the same names below ``if TYPE_CHECKING``.
    """
    face = vars(sys.modules[package])
    homes = {name: module for module, group in names.items() for name in group.split()}
    public = sorted(homes.keys() | {"__version__"} & face.keys())

    def find(name: str) -> object:
        home = homes.get(name)
        if home is not None:
            module = importlib.import_module(f".{name}" if home == "." else home, package)
            value = face[name] = module if home == "." else getattr(module, name)
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
