"""Names and patterns of names, such as ``kitchen/*``, in arguments that take several."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from fnmatch import fnmatchcase
from typing import Any, TypeVar

from kineverse.errors import InvalidValueError, UnknownNameError, suggest, unknown_attribute_error

Kind = TypeVar("Kind", bound=type)

_WILDCARDS = "*?["


def is_pattern(text: object) -> bool:
    """Return True for a text with a wildcard: ``*`` any text, ``?`` one sign, ``[ab]`` one of these."""
    return isinstance(text, str) and any(sign in text for sign in _WILDCARDS)


def matches_pattern(name: str, patterns: Iterable[str]) -> bool:
    """Return True if a name equals or matches one of some patterns, in which ``*`` is any text."""
    return any(name == pattern or fnmatchcase(name, pattern) for pattern in patterns)


def match_names(given: Any, known: Iterable[str], what: str, argument: str = "") -> tuple[str, ...]:
    """Return the known names that a name, a pattern or several of them stand for, in the order given.

    A pattern stands for its matches in the order of the known names; a name that contains wildcards itself is
    found as well. Given are a text, an object with the text of a name, such as a symbol, or several of them.
    ``what`` is the noun for the names, and ``argument``, such as ``fixed=`` or ``--still``, begins messages.
    What leads to nothing is an UnknownNameError with the nearest names or patterns.
    """
    names = dict.fromkeys(known)
    found: dict[str, None] = {}
    for item in _as_list(given, what, argument):
        text = str(item)
        matching = [text] if text in names else [n for n in names if fnmatchcase(n, text)]
        if not matching:
            raise no_match_error(text, names, what, argument)
        found.update(dict.fromkeys(matching))
    return tuple(found)


def no_match_error(text: str, known: Iterable[str], what: str, argument: str = "") -> UnknownNameError:
    """Return the error for a name that does not exist, or for a pattern that matches nothing."""
    names = list(dict.fromkeys(known))
    if is_pattern(text):
        problem, hint = f"no {what} matches {text!r:.80}.", _suggest_patterns(text, names, what)
    else:
        problem, hint = f"there is no {what} {text!r:.80}.", suggest(text, names, what)
    begin = f"{argument}: {problem}" if argument else problem[0].upper() + problem[1:]
    return UnknownNameError(f"{begin} {hint}")


def answer_foreign_names(owner: str, synonyms: Mapping[str, str]) -> Callable[[Kind], Kind]:
    """Return a decorator of classes whose objects say what an unknown attribute is called here.

    ``owner`` is the subject of the message. It is no ``__getattr__`` in the class, so that type checkers
    report unknown attributes themselves.
    """

    def find(thing: Any, name: str) -> Any:
        if hasattr(type(thing), name):  # a slot without a value yet, or a property that failed: its error
            return object.__getattribute__(thing, name)
        known = () if name.startswith("_") else dir(thing)
        raise unknown_attribute_error(owner, name, known, synonyms)

    def decorate(kind: Kind) -> Kind:
        kind.__getattr__ = find  # type: ignore[attr-defined]
        return kind

    return decorate


def _suggest_patterns(pattern: str, names: list[str], what: str) -> str:
    """Return the nearest patterns that match something: with other words, or below a prefix."""
    words = pattern.split("/")
    near = dict.fromkeys([pattern, f"*/{pattern}", f"{pattern}*"])
    for name in names:
        parts = name.split("/")
        # A wildcard of the pattern stays, so 'kitchn/*' leads to 'kitchen/*'.
        pairs = zip(words, parts, strict=False)
        near["/".join(word if is_pattern(word) else part for word, part in pairs)] = None
    useful = [one for one in near if is_pattern(one) and any(fnmatchcase(name, one) for name in names)]
    return suggest(pattern, useful, "pattern") if useful else suggest(pattern, names, what)


def _as_list(given: Any, what: str, argument: str) -> list[Any]:
    if isinstance(given, str) or getattr(given, "shape", None) == () or not isinstance(given, Iterable):
        given = [given]
    items = list(given)
    wrong = [item for item in items if item is None or isinstance(item, bool | int | float | bytes)]
    if wrong:
        begin = f"{argument}: " if argument else ""
        raise InvalidValueError(f"{begin}A {what} is given by its name, a text, not by {wrong[0]!r:.80}.")
    return items
