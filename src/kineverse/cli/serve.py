"""``kineverse serve``: a model that other processes read and edit."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from kineverse.errors import InvalidValueError
from kineverse.exchange.address import Address, split_endpoint
from kineverse.formats.reader_warnings import collect_warnings

from .arguments import print_notes, require
from .output import format_contents, show_activity, truncate_lines
from .pages import handle_interrupts
from .plan_arguments import parse_robot

if TYPE_CHECKING:
    from kineverse.model.model import Model

HELP = """\
Other processes load the model by its address, edit it, and see each other's edits at once. It is served until
Ctrl-C, to processes of this user on this computer. With --listen tls/HOST:PORT and --keys it is served to
other computers, for users with a certificate; rights.toml in the folder of keys says what they may do.

With --store, the model and all of its edits are kept in a file, and served from there the next time. A MODEL
is read into an empty store only. Without --store, edits end with the server.

examples:
  kineverse serve kitchen
  kineverse serve kitchen pr2 --name home --store home.db
  kineverse serve kitchen --robot hsr --name home     for the processes of a live system
  kineverse serve --store home.db                     again, as it was
  kineverse serve --name empty
  kineverse serve kitchen --listen tcp/127.0.0.1:7410         for everybody on this computer
  kineverse keys home-keys --server home.example.org --user alice
  kineverse serve kitchen --listen tls/0.0.0.0:7410 --keys home-keys/server"""

SHOWN = 10  # number of reader warnings printed without --all


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "models", metavar="MODEL", nargs="*", help="names of shipped models, or paths of files"
    )
    parser.add_argument(
        "--robot",
        metavar="ROBOT",
        help="a robot that is put into the model, by name or file, for kineverse world, track and behave",
    )
    parser.add_argument("--name", metavar="NAME", help="name of the server (that of the store, or the model)")
    parser.add_argument("--store", metavar="FILE", help="file that keeps the model and its edits")
    parser.add_argument(
        "--listen",
        metavar="ENDPOINT",
        action="append",
        default=[],
        help="also listen at tls/HOST:PORT, tcp/127.0.0.1:PORT or unixsock-stream/PATH; may be given several "
        "times",
    )
    parser.add_argument(
        "--keys",
        metavar="FOLDER",
        help="folder with the keys of the server, which 'kineverse keys' makes, for tls/",
    )
    parser.add_argument(
        "--insecure",
        action="store_true",
        help="allow tcp/HOST:PORT, where whoever reaches it may edit everything, without encryption",
    )
    parser.add_argument(
        "--durable",
        action="store_true",
        help="acknowledge an edit only when it survives a loss of power, and not only the end of the process",
    )
    parser.add_argument("--all", action="store_true", help=f"print more than {SHOWN} remarks")


def run(arguments: argparse.Namespace) -> int:
    """Serve until interrupted."""
    require("kineverse serve", {"exchange": True})
    if arguments.durable and not arguments.store:
        raise InvalidValueError("--durable is about what a store keeps. Name one: --store FILE.")
    from kineverse.exchange.server import serve  # for start-up time

    with collect_warnings() as remarks, show_activity("reading the model"):
        server = serve(
            arguments.models if arguments.robot is None else [_load_with_robot(arguments)],
            name=arguments.name or _choose_name(arguments),
            store=arguments.store,
            listen=arguments.listen,
            durable=arguments.durable,
            keys=arguments.keys,
            insecure=arguments.insecure,
        )
    with handle_interrupts(), server:
        model = server.snapshot()
        lines = [
            f"{server.name}: {format_contents(model)}, revision {server.revision}   (Ctrl-C ends)",
            f"  {server.address}",
            f'  model = kv.load("{server.address}")',
            f"  kineverse view {server.address}",
            *(f"  {address}" for address in list_addresses(arguments.listen, server.name, arguments.keys)),
        ]
        if remarks:
            shown = truncate_lines([f"  {text}" for text in remarks], None if arguments.all else SHOWN, "  ")
            lines += ["remarks", *shown]
        notes = [] if arguments.store else ["edits end with this server; --store FILE keeps them"]
        if any(endpoint.startswith("tcp/") for endpoint in arguments.listen):
            notes.append("whoever reaches the port can read and edit the model, without a password")
        if arguments.keys:
            notes.append(
                "users need the keys that 'kineverse keys' has made for them; KINEVERSE_KEYS is their folder"
            )
        print_notes(notes)
        print("\n".join(lines), flush=True)
        server.run()
    return 0


def _load_with_robot(arguments: argparse.Namespace) -> Model:
    """Return all models in one, with the robot next to them."""
    from kineverse.manipulation import place_robot  # for start-up time
    from kineverse.model.model import Model  # for start-up time

    source, place = parse_robot(arguments.robot)
    model = Model()
    with model.edit() as edit:
        for one in arguments.models:
            edit.include(one)
    if place_robot(model, source, place).place:
        raise InvalidValueError(
            f"--robot {arguments.robot}: a robot with a base stands where its world puts it: kineverse world "
            "live:NAME --robot ROBOT@X,Y,ANGLE."
        )
    return model


def _choose_name(arguments: argparse.Namespace) -> str | None:
    """Return the name of the first model, if it is not served as it is and nothing else names the server."""
    if arguments.robot is None or arguments.store is not None or not arguments.models:
        return None
    return Path(arguments.models[0]).name.partition(".")[0] or None


def list_addresses(endpoints: Sequence[str], name: str, keys: str | None) -> list[str]:
    """Return addresses for clients, with a host of the certificate, as they refuse any other."""
    hosts: Sequence[str] = ()
    if keys is not None:
        from kineverse.exchange.keys import Keys  # for those who have no need of the package cryptography

        hosts = Keys.read(keys).hosts
    result = []
    for endpoint in endpoints:
        kind = endpoint.partition("/")[0]
        if kind != "unixsock-stream" and hosts:
            host, port = split_endpoint(endpoint)
            if host in ("0.0.0.0", "::") or (kind == "tls" and host not in hosts):
                endpoint = f"{kind}/{f'[{hosts[0]}]' if ':' in hosts[0] else hosts[0]}:{port}"
        result.append(str(Address(name, endpoint)))
    return result
