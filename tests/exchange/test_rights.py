"""Rights of users: the file that has them."""

from __future__ import annotations

from pathlib import Path

import pytest

import kineverse as kv
from kineverse.exchange.rights import EVERYTHING, Right, Rights

FILE = """
[users]
alice = "edit"
bob = "see"
carol = ["kitchen/", "table/"]   # edits below these
[relays]
hamburg = ["alice", "carol"]
"""


def read(tmp_path: Path, text: str) -> Rights:
    path = tmp_path / "rights.toml"
    path.write_text(text, encoding="utf-8")
    return Rights.read(path)


def test_rights_are_read_from_a_file(tmp_path: Path) -> None:
    rights = read(tmp_path, FILE)
    users = {
        "alice": Right(("",), "alice"),
        "bob": Right((), "bob"),
        "carol": Right(("kitchen/", "table/"), "carol"),
    }
    assert rights == Rights(users, {"hamburg": ("alice", "carol")})
    assert [right.may_edit for right in users.values()] == [True, False, True]
    assert [right.may_edit_all for right in users.values()] == [True, False, False]
    assert read(tmp_path, "") == Rights()


@pytest.mark.parametrize(
    ("name", "covered"),
    [
        ("kitchen/door", True),
        ("table/leg/foot", True),
        ("kitchen", False),
        ("kitchen2/door", False),
        ("my/kitchen/door", False),
        ("Kitchen/door", False),
        ("", False),
    ],
)
def test_a_prefix_ends_where_a_name_does(name: str, covered: bool) -> None:
    assert Right(("kitchen/", "table/")).covers(name) == covered
    assert EVERYTHING.covers(name)
    assert not Right(()).covers(name)


WRONG = {
    "not TOML": ("[users", "is not TOML"),
    "twice": ('[users]\na = "see"\na = "edit"', "is not TOML"),
    "unknown table": ('[user]\na = "see"', "'user'"),
    "no table": ("users = 3", r"\[users\]"),
    "unknown role": ('[users]\na = "admin"', "'a' has the right 'admin'"),
    "no role": ("[users]\na = true", "'a' has True"),
    "a number in a list": ('[users]\na = ["kitchen/", 3]', "'a' has"),
    "nothing in a list": ("[users]\na = []", "'a' has an empty list"),
    "no slash": ('[users]\na = ["kitchen"]', "prefix 'kitchen'"),
    "no name": ('[users]\na = ["/"]', "prefix '/'"),
    "no prefix": ('[users]\na = [""]', "prefix ''"),
    "a slash in front": ('[users]\na = ["/kitchen/"]', "prefix '/kitchen/'"),
    "two slashes": ('[users]\na = ["kitchen//a/"]', "prefix 'kitchen//a/'"),
    "a prefix twice": ('[users]\na = ["k/", "k/"]', "'k/' twice"),
    "a wildcard for a name": ('[users]\n"*" = "see"', r"'\*' is no name of a user"),
    "a slash in a name": ('[users]\n"a/b" = "see"', "'a/b' is no name of a user"),
    "an empty name": ('[users]\n"" = "see"', "'' is no name of a user"),
    "a relay for nobody known": ('[users]\nalice = "see"\n[relays]\nr = ["alcie"]', "Did you mean 'alice'"),
    "a relay for text": ('[users]\na = "see"\n[relays]\nr = "a"', "'r' has 'a'"),
    "a relay for one twice": ('[users]\na = "see"\n[relays]\nr = ["a", "a"]', "'a' twice"),
    "a relay that is a user": ('[users]\na = "see"\n[relays]\na = ["a"]', "'a' is a user and a relay"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_file_of_rights_is_one_error(name: str, tmp_path: Path) -> None:
    text, message = WRONG[name]
    with pytest.raises(kv.errors.FormatError, match=message) as raised:
        read(tmp_path, text)
    assert "rights.toml" in str(raised.value)
    assert str(raised.value).endswith((".", "?"))


def test_a_file_that_cannot_be_read_is_one_error(tmp_path: Path) -> None:
    for path in tmp_path / "none.toml", tmp_path:
        with pytest.raises(kv.errors.FormatError, match="cannot be read"):
            Rights.read(path)
    (tmp_path / "latin").write_bytes(b'[users]\n"\xe9" = "see"')
    with pytest.raises(kv.errors.FormatError, match="not TOML"):
        Rights.read(tmp_path / "latin")
