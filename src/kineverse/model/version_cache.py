"""Results about a model that are kept until it changes."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import TypeVar

from .symbolic_view import SymbolicView

Result = TypeVar("Result")


def cached_for_version(model: SymbolicView, key: Hashable, compute: Callable[[], Result]) -> Result:
    """Return a result about the present version of a model; it is computed for the first call with a key.

    The result lives no longer than the model, and may refer to it.
    """
    model._settle()
    kept = model._derived  # an edit replaces it, so that no result of an old version is entered later
    if key not in kept:
        kept[key] = compute()
    found: Result = kept[key]
    return found
