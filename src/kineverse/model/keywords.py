"""The keywords that operations are made with."""

from __future__ import annotations

from dataclasses import MISSING, fields
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from kineverse.errors import ExpressionError, ValueRejectedError, suggest


class Keywords(NamedTuple):
    """The names that a class is made with: those that have to be given, and all."""

    required: frozenset[str]
    known: tuple[str, ...]


def check_keywords(made: type, arguments: tuple[Any, ...], given: dict[str, Any]) -> None:
    """Look whether an operation that takes keywords only is given those that it takes.

    Raises
    ------
    ExpressionError
        With the keywords, if one is missing or not known, or a value stands without one.
    """
    keywords = keywords_of(made)
    if keywords is None or not (arguments or given):
        return  # pickle gives nothing, and to everybody else Python says what is missing
    if not arguments and keywords.required <= given.keys() and given.keys() <= set(keywords.known):
        return
    name = made.__name__
    required = [f"{key}=" for key in keywords.known if key in keywords.required]
    optional = [f"{key}=" for key in keywords.known if key not in keywords.required]
    takes = f"It takes {', '.join(required) or 'nothing that has to be given'}"
    takes += f" and, if wanted, {', '.join(optional)}." if optional else "."
    if arguments:
        raise ExpressionError(f"{name} is made with keywords, and {arguments[0]!r} has none. {takes}")
    for key in given:
        if key not in keywords.known:
            raise ExpressionError(
                f"{name} has no keyword {key!r}. {suggest(key, keywords.known, 'keyword')} {takes}"
            )
    missing = [key for key in required if key[:-1] not in given]
    raise ExpressionError(f"{name} is made without {', '.join(missing)}. {takes}")


def check_flag(name: str, given: object) -> None:
    """Look whether a keyword that switches something is True or False: the text 'no' would be taken for yes.

    Raises
    ------
    ValueRejectedError
        If it is neither.
    """
    if not isinstance(given, bool | np.bool_):
        raise ValueRejectedError(f"{name}= is True or False, not {given!r}.")


@cache
def keywords_of(made: type) -> Keywords | None:
    """Return the keywords of a dataclass that takes nothing else; None for any other class."""
    maker = next(base for base in made.__mro__ if "__init__" in vars(base))
    parameters = vars(maker).get("__dataclass_params__")
    if parameters is None or not parameters.init:
        return None
    own = [field for field in fields(maker) if field.init]
    if not own or not all(field.kw_only for field in own):
        return None
    required = {f.name for f in own if f.default is MISSING and f.default_factory is MISSING}
    return Keywords(frozenset(required), tuple(field.name for field in own))
