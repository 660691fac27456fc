"""``kineverse keys``: certificates for a model server, its users and relays."""

from __future__ import annotations

import argparse
from pathlib import Path

from kineverse._checks import as_positive

from .arguments import print_notes, require
from .output import format_table

HELP = """\
A server that other computers reach knows its users by certificates of an authority. This makes the authority
in FOLDER, and the keys of the server, users and relays, each in a folder that is ready to be copied. Called
again, it adds to what is there. New users may see; rights.toml in the server's folder says who may edit.

Whoever has FOLDER/authority/key.pem can make users: keep FOLDER where nobody else reads it.

examples:
  kineverse keys home-keys --server home.example.org 192.0.2.7 --user alice bob
  kineverse keys home-keys --user carol
  kineverse keys home-keys --relay hamburg relay.hamburg.example.org
  kineverse keys home-keys --user bob --renew"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("folder", metavar="FOLDER", help="folder of the authority and of all keys")
    for option, name, action, what in (
        ("--server", "HOST", "extend", "names and IP addresses by which clients reach the server"),
        ("--user", "NAME", "extend", "names of users"),
        ("--relay", ("NAME", "HOST"), "append", "name of a relay, and its hosts"),
    ):
        parser.add_argument(option, metavar=name, nargs="+", action=action, default=[], help=what)
    parser.add_argument(
        "--days", metavar="N", type=float, default=365.0, help="days for which the keys are valid (365)"
    )
    parser.add_argument(
        "--renew", action="store_true", help="make new keys for those who have some, in their place"
    )


def run(arguments: argparse.Namespace) -> int:
    """Make the keys, and print what goes where."""
    require("kineverse keys", {"exchange": True})
    days = as_positive(arguments.days, "--days")
    from kineverse.exchange.keys import make_keys  # for those who have no need of the package cryptography

    relays: dict[str, list[str]] = {}
    for name, *hosts in arguments.relay:
        relays.setdefault(name, []).extend(hosts)
    made = make_keys(
        arguments.folder,
        server=arguments.server,
        user=arguments.user,
        relay=relays,
        days=days,
        renew=arguments.renew,
    )
    root = Path(arguments.folder)
    rows = [("authority", str(root / "authority"), "stays here: its key makes users")]
    for path in made:
        place = path.relative_to(root.expanduser().absolute())
        if place.parts[0] == "users":
            owner, where = f"user {path.name}", "~/.config/kineverse/keys, or KINEVERSE_KEYS names it"
        elif place.parts[0] == "relays":
            owner, where = f"relay {path.name}", "kineverse relay ... --keys FOLDER"
        else:
            owner, where = "server", "kineverse serve ... --keys FOLDER"
        rows.append((owner, str(root / place), where))
    print(format_table(("keys of", "folder", "to be used as"), rows, "<<<"))
    print_notes(
        ["rights.toml of the server, and of each relay, says who may edit; they read it when they start"]
    )
    return 0
