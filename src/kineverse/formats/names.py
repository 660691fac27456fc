"""Names and prefixes: checked, without empty parts, and unique by numbers behind them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TypeAlias

from kineverse.errors import ExpressionError, FormatError
from kineverse.formats.xml_reader import quote
from kineverse.symbols import position


def check_prefix(prefix: object) -> None:
    """Refuse what cannot be put in front of names.

    Raises
    ------
    FormatError
        With what is wrong with it.
    """
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


NameMap: TypeAlias = Callable[[str], str]
"""Function that returns the name in the model for a name in a description."""

NameFaultHandler: TypeAlias = Callable[[str, str, str], None]
"""Called with the place of a mistake, what it is and what is taken instead; raises in a strict reader."""


def drop_empty_parts(name: str) -> str:
    """Return a name without empty parts."""
    return "/".join(filter(None, name.split("/")))


class UniqueNames:
    """Names that are taken, with what has each of them."""

    def __init__(self, mend: NameFaultHandler, *taken: str) -> None:
        self._taken: dict[str, str] = dict.fromkeys(taken, "the world")
        self._mend = mend
        self._numbers: dict[str, int] = {}

    def take(self, name: str, where: str) -> str:
        """Return the name of the file as it is here, another one if it cannot be a name, or is taken.

        Raises
        ------
        FormatError
            If it is another one, and the file is read strictly.
        """
        short, problem = drop_empty_parts(name), ""
        if not short or any(ord(character) < 32 for character in short):
            problem = "the name has nothing but slashes, or a control character. Rename it"
            short = "".join(c if ord(c) >= 32 else "_" for c in short) or "nameless"
        elif self._taken.get(short, where) != where:
            problem = (
                f"it would be called {quote(short)} here, as {self._taken[short]} is. Rename one of them"
            )
        if not problem:
            self._taken[short] = where
            return short
        return self.replace(short, where, problem)

    def replace(self, name: str, where: str, problem: str) -> str:
        """Return another name than the one that is wanted, which has a problem."""
        found = self.invent(name, where)
        self._mend(where, problem, f"it is called {quote(found)}")
        return found

    def invent(self, name: str, where: str, *more: str) -> str:
        """Return the first name that is free: the one wanted, then others, then numbered ones."""
        for candidate in (name, *more):
            if candidate not in self._taken:
                break
        else:
            number = self._numbers.get(name, 2)
            while f"{name}_{number}" in self._taken:
                number += 1
            self._numbers[name] = number + 1
            candidate = f"{name}_{number}"
        self._taken[candidate] = where
        return candidate

    def __contains__(self, name: str) -> bool:
        return name in self._taken


class TakenNames:
    """Names of one kind that are taken."""

    def __init__(self, taken: Iterable[str] = ()) -> None:
        self._taken = set(taken)

    def take(self, *wishes: str) -> str:
        """Return the first wish that is free, else the last with a number behind it; it is taken then."""
        for wish in wishes:
            if wish not in self._taken:
                self._taken.add(wish)
                return wish
        count = 2
        while f"{wishes[-1]}_{count}" in self._taken:
            count += 1
        return self.take(f"{wishes[-1]}_{count}")
