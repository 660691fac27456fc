"""Access to the keys of a model server through endpoints of TLS: what is not granted here is refused there.

A user asks questions under keys of its own, so the server knows the asker by the key. Only the server itself
publishes commits and signs of life, answers questions, and sees who is there.
"""

from __future__ import annotations

from typing import Final

from .rights import Rights
from .transport import Grant, Use

RELAY: Final = "relay"  # in front of the name of a relay in its certificate

SEE: Final[tuple[tuple[Use, str], ...]] = (
    ("find", "user/*/ask"),
    ("find", "user/*/edit"),
    ("read", "log"),
    ("read", "view/*"),
    ("read", "beat"),
    ("read", "state/*"),
    ("find", "state/*/layout"),
    ("ask", "state/*/layout"),
    ("publish", "seen"),
    ("show", "client/*"),
)
"""Uses of keys, below ``kineverse/NAME``, by all users with a right."""

EDIT_ALL: Final[tuple[tuple[Use, str], ...]] = (
    ("publish", "state/*"),
    ("answer", "state/*/layout"),
)
"""Those of users who may edit everything, beside."""

OWN: Final[tuple[tuple[Use, str], ...]] = (("ask", "user/{}/ask"), ("ask", "user/{}/edit"))
"""Those of a user alone; an edit that a right does not cover is refused by the server, which says why."""

ANYBODY: Final[tuple[tuple[Use, str], ...]] = (("watch", "alive/*"),)
"""Those of everybody with a certificate, to tell a missing right from a missing server."""


def relay_name(name: str) -> str:
    """Return the common name in the certificate of a relay; that of a user is the user's name."""
    return f"{RELAY} {name}"


def make_grants(name: str, rights: Rights) -> list[Grant]:
    """Return what the users and relays with some rights may use of the server of a name."""
    who: dict[str, tuple[str, ...]] = {user: (user,) for user in rights.users}
    who |= {relay_name(relay): users for relay, users in rights.relays.items() if users}
    may_edit = {user for user, right in rights.users.items() if right.may_edit_all}
    lists = (
        (ANYBODY, None),
        (SEE, tuple(who)),
        (EDIT_ALL, tuple(one for one, users in who.items() if may_edit & {*users})),
    )
    grants = [Grant(use, (f"kineverse/{name}/{key}",), names) for uses, names in lists for use, key in uses]
    for one, users in who.items():
        keys = tuple(f"kineverse/{name}/{key.format(user)}" for user in users for _, key in OWN)
        grants.append(Grant("ask", keys, (one,)))
    return grants
