"""``kineverse relay``: a site's way to a model server elsewhere."""

from __future__ import annotations

import argparse

from kineverse.exchange.address import SCHEME

from .arguments import require
from .output import print_line
from .pages import handle_interrupts
from .serve import list_addresses

HELP = """\
The computers of a site connect to the relay, and the relay to the server, so that commits and states come to
the site once. It keeps nothing. Who may use it is in rights.toml in the folder of its keys, which 'kineverse
keys --relay' makes; what they may do, the server decides. If the server is away, the relay waits for it.

examples:
  kineverse relay live:tls/home.example.org:7410/home --listen tls/0.0.0.0:7410 --keys hamburg"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "server", metavar="ADDRESS", help=f"address of the server, {SCHEME}tls/HOST:PORT/NAME"
    )
    parser.add_argument(
        "--listen",
        metavar="ENDPOINT",
        action="append",
        required=True,
        help="where clients connect: tls/HOST:PORT; may be given several times",
    )
    parser.add_argument("--keys", metavar="FOLDER", required=True, help="folder with the keys of the relay")


def run(arguments: argparse.Namespace) -> int:
    """Relay until interrupted."""
    require("kineverse relay", {"exchange": True})
    from kineverse.exchange.relay import Relay  # for those who have no need of the package cryptography

    with handle_interrupts(), Relay(arguments.server, listen=arguments.listen, keys=arguments.keys) as relay:
        address = relay.address
        users = ", ".join(relay.rights.users) or "nobody"
        print(
            f"{relay.keys.name} of {address.name}, for {users}   (Ctrl-C ends)",
            *(f"  {one}" for one in list_addresses(arguments.listen, address.name, arguments.keys)),
            sep="\n",
            flush=True,
        )
        for is_there in relay.watch():
            if is_there:
                print(f"connected with {address}", flush=True)
            else:
                print_line(f"kineverse: the server is away, and waited for: {relay.explain()}")
    return 0
