"""Names for everything: those of the file, and for what has none one that stays while others come and go."""

from __future__ import annotations

from kineverse.errors import FormatError
from kineverse.formats.markup import quote


def plain(name: str) -> str:
    """Return a name without empty parts."""
    return "/".join(filter(None, name.split("/")))


class Names:
    """Names that are taken, with what has each of them."""

    def __init__(self, *taken: str) -> None:
        self._taken: dict[str, str] = dict.fromkeys(taken, "the world")

    def take(self, name: str, where: str) -> str:
        """Return the name of the file as it is here.

        Raises
        ------
        FormatError
            If it cannot be a name, or is taken.
        """
        short = plain(name)
        if not short or not (short.isprintable() or all(ord(character) >= 32 for character in short)):
            raise FormatError(
                f"{where}: the name has nothing but slashes, or a control character. Rename it."
            )
        other = self._taken.setdefault(short, where)
        if other != where:
            raise FormatError(
                f"{where}: it would be called {quote(short)} here, as {other} is. Rename one of them."
            )
        return short

    def invent(self, name: str, where: str, *more: str) -> str:
        """Return the first name that is free: the one wanted, then others, then numbered ones."""
        for candidate in (name, *more):
            if candidate not in self._taken:
                break
        else:
            number = 2
            while f"{name}_{number}" in self._taken:
                number += 1
            candidate = f"{name}_{number}"
        self._taken[candidate] = where
        return candidate

    def __contains__(self, name: str) -> bool:
        return name in self._taken
