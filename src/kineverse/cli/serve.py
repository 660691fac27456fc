"""``kineverse serve``: a model that other processes read and edit."""

from __future__ import annotations

import argparse

from kineverse.errors import InvalidValueError
from kineverse.formats.reader_warnings import collect_warnings

from .arguments import print_notes, require
from .output import format_contents, show_activity, truncate_lines
from .pages import handle_interrupts

HELP = """\
Other processes load the model by its address, edit it, and see each other's edits at once. It is served until
Ctrl-C, to processes of this user on this computer; with --listen also to others, who need no password.

With --store, the model and all of its edits are kept in a file, and served from there the next time. A MODEL
is read into an empty store only. Without --store, edits end with the server.

examples:
  kineverse serve kitchen
  kineverse serve kitchen pr2 --name home --store home.db
  kineverse serve --store home.db                     again, as it was
  kineverse serve --name empty
  kineverse serve kitchen --listen tcp/127.0.0.1:7410"""

SHOWN = 10  # number of reader warnings printed without --all


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "models", metavar="MODEL", nargs="*", help="names of shipped models, or paths of files"
    )
    parser.add_argument("--name", metavar="NAME", help="name of the server (that of the store, or the model)")
    parser.add_argument("--store", metavar="FILE", help="file that keeps the model and its edits")
    parser.add_argument(
        "--listen",
        metavar="ENDPOINT",
        action="append",
        default=[],
        help="also listen at tcp/HOST:PORT or unixsock-stream/PATH; may be given several times",
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
            arguments.models,
            name=arguments.name,
            store=arguments.store,
            listen=arguments.listen,
            durable=arguments.durable,
        )
    with handle_interrupts(), server:
        model = server.snapshot()
        lines = [
            f"{server.name}: {format_contents(model)}, revision {server.revision}   (Ctrl-C ends)",
            f"  {server.address}",
            f'  model = kv.load("{server.address}")',
            f"  kineverse view {server.address}",
            *(f"  live:{endpoint}/{server.name}" for endpoint in arguments.listen),
        ]
        if remarks:
            shown = truncate_lines([f"  {text}" for text in remarks], None if arguments.all else SHOWN, "  ")
            lines += ["remarks", *shown]
        notes = [] if arguments.store else ["edits end with this server; --store FILE keeps them"]
        if any(endpoint.startswith("tcp/") for endpoint in arguments.listen):
            notes.append("whoever reaches the port can read and edit the model, without a password")
        print_notes(notes)
        print("\n".join(lines), flush=True)
        server.run()
    return 0
