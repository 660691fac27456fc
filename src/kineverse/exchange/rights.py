"""Rights of those who come with a certificate: who sees, who edits, and below which names.

What counts are the names of what an edit itself writes, before and after it. A constraint is also about the
coordinates that it restricts, a rate about those that it joins, and the record of an articulation about its
frame and its coordinates.
"""

from __future__ import annotations

import os
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from kineverse.errors import FormatError, InvalidValueError, suggest
from kineverse.model.history import HistoryEntry
from kineverse.model.operation import ARTICULATIONS, CONSTRAINTS, RATES, Cell

from .address import check_server_name
from .conflicts import RefusedError
from .views import find_paths

FILE_NAME: Final = "rights.toml"
_ROLES: Final = {"see": (), "edit": ("",)}
_ROLE: Final = "A right is 'see', 'edit', or a list of prefixes such as ['kitchen/'], below which one edits."


@dataclass(frozen=True)
class Right:
    """Right of a user to edit names that begin with one of some prefixes, and to see everything.

    The role *see* has no prefix, and *edit* the empty one. Any other ends with a slash.
    """

    prefixes: tuple[str, ...]
    user: str = ""
    """Name of the user; empty for all who use the server's own computer as its user."""

    @property
    def may_edit(self) -> bool:
        """True if it allows any edit."""
        return bool(self.prefixes)

    @property
    def may_edit_all(self) -> bool:
        """True if it allows every edit, and all else that changes something, such as to publish state."""
        return "" in self.prefixes

    def covers(self, name: str) -> bool:
        """Return whether it allows to edit a name."""
        return name.startswith(self.prefixes)

    def __str__(self) -> str:
        if self.may_edit_all:
            return f"{self.user} may edit everything"
        what = f"edit below {' and '.join(self.prefixes)}" if self.prefixes else "see, and not edit"
        return f"{self.user} may {what}"


EVERYTHING: Final = Right(_ROLES["edit"])


@dataclass(frozen=True)
class Rights:
    """Rights of users by the name in their certificate, and the users for whom relays of sites speak."""

    users: Mapping[str, Right] = field(default_factory=dict)
    relays: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Rights:
        """Read a file of rights; one that cannot be read, or has a wrong entry, is a FormatError."""
        try:
            content = tomllib.loads(Path(path).read_text("utf-8"))
        except OSError as error:
            raise FormatError(f"The rights in {path} cannot be read: {error.strerror}.") from None
        except (ValueError, RecursionError) as error:  # of TOML, or of UTF-8
            raise FormatError(f"{path} is not TOML: {error}.") from None
        try:
            for name in content:
                if name not in ("users", "relays"):
                    raise InvalidValueError(f"there is {name!r:.80}. The tables are [users] and [relays].")
            users = {name: _as_right(name, right) for name, right in _items(content, "users")}
            relays = {name: _as_users(name, given, users) for name, given in _items(content, "relays")}
        except InvalidValueError as error:
            raise FormatError(f"In {path}, {error}") from None
        return cls(users, relays)


def _items(content: Mapping[str, Any], table: str) -> Iterable[tuple[str, Any]]:
    found = content.get(table, {})
    if not isinstance(found, dict):
        raise InvalidValueError(f"{table} is {found!r:.80}, and has to be a table, [{table}].")
    for name in found:
        try:
            check_server_name(name, table.removesuffix("s"))  # it is a part of keys
        except InvalidValueError as error:
            raise InvalidValueError(f"[{table}] has a wrong entry: {error}") from None
    return found.items()


def _as_right(user: str, given: Any) -> Right:
    if isinstance(given, str):
        if given in _ROLES:
            return Right(_ROLES[given], user)
        raise InvalidValueError(f"the user {user!r} has the right {given!r:.80}, which there is not. {_ROLE}")
    prefixes = _as_texts(f"the user {user!r}", given, _ROLE)
    for prefix in prefixes:
        if not prefix.endswith("/") or "//" in f"/{prefix}":
            raise InvalidValueError(
                f"the user {user!r} has the prefix {prefix!r:.80}. A prefix is the beginning of names, with "
                "a slash at its end and none in front, such as 'kitchen/'."
            )
    if not prefixes:
        raise InvalidValueError(f"the user {user!r} has an empty list. {_ROLE}")
    return Right(prefixes, user)


def _as_users(relay: str, given: Any, users: Mapping[str, Right]) -> tuple[str, ...]:
    if relay in users:
        raise InvalidValueError(
            f"{relay!r} is a user and a relay. Give the relay another name, and a certificate of its own."
        )
    names = _as_texts(f"the relay {relay!r}", given, "It has a list of the users for whom it speaks.")
    for name in names:
        if name not in users:
            raise InvalidValueError(
                f"the relay {relay!r} speaks for {name!r:.80}, who is no user. "
                f"{suggest(name, users, 'user')} Users stand in [users]."
            )
    return names


def _as_texts(subject: str, given: Any, wanted: str) -> tuple[str, ...]:
    """Return the texts in a list, each of which is there once."""
    if not isinstance(given, list) or not all(isinstance(text, str) for text in given):
        raise InvalidValueError(f"{subject} has {given!r:.80}. {wanted}")
    for text in given:
        if given.count(text) > 1:
            raise InvalidValueError(f"{subject} has {text!r:.80} twice. Once is enough.")
    return tuple(given)


# -- what an operation writes --------------------------------------------------------------------------------


def check_right(right: Right, entries: Iterable[HistoryEntry | None]) -> None:
    """Raise a RefusedError if a right does not cover what some entries write."""
    for entry in entries:
        error = None if entry is None else find_forbidden(right, entry.tag, entry.writes)
        if error is not None:
            raise error


def find_forbidden(right: Right, tag: str, writes: Mapping[Cell, Any]) -> RefusedError | None:
    """Return the error for an operation that writes what a right does not cover, or nothing at all."""
    if right.may_edit_all:
        return None
    if not writes:
        message = f"{right}, and {tag!r} writes nothing, so it is below no name."
        return RefusedError("forbidden", message, tag)
    for cell, value in writes.items():
        path = "/".join(cell)
        for name in _find_names(cell, value):
            if not right.covers(name):
                what = path if name == cell[1] else f"{path}, which is about {name}"
                return RefusedError("forbidden", f"{right}, and {tag!r} writes {what}.", tag, path)
    return None


def _find_names(cell: Cell, value: Any) -> Iterator[str]:
    """Yield the names that a written value decides about; of a coordinate, its path."""
    kind, name = cell
    if kind == RATES:
        yield value[0].path
    else:
        yield name
    if kind in (CONSTRAINTS, RATES):
        yield from sorted(find_paths(kind, value))
    elif kind == ARTICULATIONS:
        yield value.child
        yield from (symbol.path for symbol in (*value.coordinates, *value.speeds))
