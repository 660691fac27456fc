"""Names and prefixes: validation, removal of empty parts, and unique names by numbers behind them."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable
from typing import TypeAlias

from kineverse.errors import ExpressionError, FormatError
from kineverse.symbols import position

from .xml_reader import quote


def check_prefix(prefix: object) -> None:
    """Check that a prefix can stand in front of names."""
    if prefix is None or prefix == "":
        return
    if not isinstance(prefix, str):
        raise FormatError(f"A prefix is a text that is put in front of names, not {prefix!r}.")
    try:
        position(prefix)
    except ExpressionError:
        raise FormatError(
            f"The prefix {prefix!r} has an empty part, a control character or half of a surrogate pair. The "
            "slash behind it comes by itself."
        ) from None


NameMap: TypeAlias = Callable[[str], str]  # returns the name in the model for a name in a description

NameFaultHandler: TypeAlias = Callable[[str, str, str], None]
"""Handler of an invalid name, called with place, problem and replacement; raises in a strict reader."""


def drop_empty_parts(name: str) -> str:
    """Return a name without empty parts."""
    return "/".join(filter(None, name.split("/")))


class NumberedNames:
    """Numbers behind names that are taken, from 2 on; the last one of each name is remembered."""

    def __init__(self) -> None:
        self._next: dict[str, int] = {}

    def first_free(self, name: str, taken: Container[str]) -> str:
        """Return the name if it is free, else with the first number behind it that is."""
        if name not in taken:
            return name
        number = self._next.get(name, 2)
        while f"{name}_{number}" in taken:
            number += 1
        self._next[name] = number + 1
        return f"{name}_{number}"


class TakenNames:
    """Set of names that are taken."""

    def __init__(self, taken: Iterable[str] = ()) -> None:
        self._taken = set(taken)
        self._numbers = NumberedNames()

    def take(self, *wishes: str) -> str:
        """Take and return the first wish that is free, else the last one with a number."""
        free = next((wish for wish in wishes if wish not in self._taken), None)
        name = self._numbers.first_free(wishes[-1], self._taken) if free is None else free
        self._taken.add(name)
        return name


class UniqueNames:
    """Names of the elements of a description, each with the element that has it."""

    def __init__(self, report: NameFaultHandler, *taken: str) -> None:
        self._owners: dict[str, str] = dict.fromkeys(taken, "the world")
        self._report = report
        self._numbers = NumberedNames()

    def take(self, name: str, where: str) -> str:
        """Take the name of an element and return it, or another one if it is taken or no valid name."""
        short, problem = drop_empty_parts(name), ""
        if not short or any(ord(character) < 32 for character in short):
            problem = "the name has nothing but slashes, or a control character. Rename it"
            short = "".join(c if ord(c) >= 32 else "_" for c in short) or "nameless"
        elif self._owners.get(short, where) != where:
            problem = (
                f"it would be called {quote(short)} here, as {self._owners[short]} is. Rename one of them"
            )
        if not problem:
            self._owners[short] = where
            return short
        return self.replace(short, where, problem)

    def replace(self, name: str, where: str, problem: str) -> str:
        """Report a problem with a name, and return the free name that the element has instead."""
        result = self.invent(name, where)
        self._report(where, problem, f"it is called {quote(result)}")
        return result

    def invent(self, name: str, where: str, *more: str) -> str:
        """Take and return the first of several names that is free, else the first one with a number."""
        free = next((wish for wish in (name, *more) if wish not in self._owners), None)
        result = self._numbers.first_free(name, self._owners) if free is None else free
        self._owners[result] = where
        return result

    def __contains__(self, name: str) -> bool:
        return name in self._owners
