"""Commands about model servers: ``ls``, ``status``, ``watch``, ``history``, ``undo``, ``keys`` and others."""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, NamedTuple

from msgspec import Struct, structs

from kineverse._checks import as_positive
from kineverse.errors import DuplicateNameError, FormatError, InvalidValueError, KineverseError, OfflineError
from kineverse.exchange import protocol
from kineverse.exchange.address import SCHEME, Address, list_servers
from kineverse.exchange.client import LiveModel, load_live
from kineverse.exchange.connection import Connection
from kineverse.formats.file_formats import DOCUMENT_SUFFIXES
from kineverse.formats.reader_warnings import collect_warnings
from kineverse.model.changes import Diff
from kineverse.model.registry import writable_suffixes

from .arguments import add_model_options, print_notes, require
from .output import (
    colorize,
    format_contents,
    format_count,
    format_table,
    join_lines,
    print_line,
    show_activity,
    truncate_lines,
)
from .pages import handle_interrupts

SHOWN = 3
"""Number of operations or paths of a commit that are named in its line."""
REMARKS = 10
"""Number of reader warnings printed."""
_LOOK = 1.0
"""Time in which a server has to answer to be listed with what it has [s]."""
_PAUSE = 0.5
"""Time after which the watch looks whether the server is there [s]."""

SIGNS = (("added", "+"), ("removed", "-"), ("replaced", "~"), ("moved", "moved"), ("rerun", "again"))
"""Kinds of changed operations, with what stands before them in a line."""


class ServerCommand(NamedTuple):
    """Command about model servers; it takes the name of one and ``--json``, save for some."""

    HELP: str
    run: Callable[[argparse.Namespace], int]
    add_options: Callable[[argparse.ArgumentParser], object] = lambda parser: None
    takes_name: bool = True
    has_json: bool = True

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Declare the options."""
        if self.takes_name:
            what = f"name of a server, see ls; or its address, {SCHEME}tcp/HOST:PORT/NAME"
            parser.add_argument("server", metavar="NAME", help=what)
        self.add_options(parser)
        if self.has_json:
            parser.add_argument("--json", action="store_true", help="everything, as JSON")


# -- what is there -------------------------------------------------------------------------------------------


def _run_ls(arguments: argparse.Namespace) -> int:
    require(arguments.command.prog, {"exchange": True})
    found = {name: _look(Address(name)) for name in list_servers()}
    if arguments.json:
        print(json.dumps([{"name": name, **_as_data(one)} for name, one in found.items()], allow_nan=False))
        return 0
    if not found:
        print("No model server of this user is running. One is started by: kineverse serve kitchen")
        return 0
    head = ("name", "operations", "frames", "revision", "clients", "since", "store")
    rows = []
    for name, status in found.items():
        if status is None:
            rows.append((name, *[""] * 5, "does not answer"))
            continue
        counts = status.operations, status.frames, status.revision, len(status.clients)
        since = _format_time(status.since, status.time)
        rows.append((name, *map(str, counts), since, status.store or "none, in memory"))
    print(format_table(head, rows, "<>>>>"))
    return 0


def _look(address: Address) -> protocol.Status | None:
    """Return the status of a server; None if it does not answer at once."""
    try:
        with closing(Connection(address)) as connection:
            return connection.ask(protocol.GetStatus(), protocol.Status, _LOOK)
    except KineverseError:
        return None


LS = ServerCommand(
    """\
examples:
  kineverse ls
  kineverse ls --json""",
    _run_ls,
    takes_name=False,
)


def _run_status(arguments: argparse.Namespace) -> int:
    with _connect(arguments) as connection:
        status = connection.status()
    if arguments.json:
        print(json.dumps(_as_data(status), allow_nan=False))
    else:
        print("\n\n".join(_format_status(connection.address, status)))
    return 0


def _format_status(address: Address, status: protocol.Status) -> list[str]:
    """Return the paragraphs of a report."""
    kept = f"kept in {status.store}" if status.store else "kept in memory only"
    contents = format_count(status.operations, "operation"), format_count(status.frames, "frame")
    lines = [
        str(address),
        f"  revision {status.revision}: {', '.join(contents)}",
        f"  {kept}{', durable' if status.durable else ''}",
        f"  since {_format_time(status.since, status.time)}: process {status.process}, "
        f"Kineverse {status.library}, protocol {status.protocol}",
        f"  {format_count(status.edits, 'edit')}, {60 * status.rate:.0f} in the last minute",
    ]
    sections = ["\n".join(lines)]
    if status.stages:
        rows = [(s.name, f"{1e3 * s.p50:.3f}", f"{1e3 * s.p95:.3f}") for s in status.stages]
        sections.append(format_table(("stage of an edit", "p50 [ms]", "p95 [ms]"), rows, "<>>"))
    if status.clients:
        # A client of a part has what concerns it, at a revision that may be long past.
        clients = [
            (c.who, "part" if c.view else "all", str(status.revision - c.revision), f"{c.seconds:.1f}")
            for c in status.clients
        ]
        sections.append(format_table(("client", "has", "revisions behind", "told [s ago]"), clients, "<<>>"))
    if status.sources:
        sources = [
            (s.source, str(len(s.coordinates)), f"{1e3 * s.offset:.3f}", s.endpoint) for s in status.sources
        ]
        head = ("source of states", "coordinates", "clock offset [ms]", "endpoint")
        sections.append(format_table(head, sources, "<>>"))
    if status.refusals:
        lines = [
            f"  {_format_time(one.time, status.time)}  {one.who}: {join_lines(one.message)}"
            for one in reversed(status.refusals)
        ]
        sections.append("\n".join(["refused, the last first", *lines]))
    return sections


STATUS = ServerCommand(
    """\
The report has the times of the server's stages of an edit, its clients with the number of revisions that they
are behind, the sources of states, and the last edits that were refused, with the reasons.

examples:
  kineverse status home
  kineverse status live:tcp/robot.local:7410/home --json""",
    _run_status,
)


# -- commits -------------------------------------------------------------------------------------------------


def _add_history_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("-n", type=int, default=20, metavar="N", dest="most", help="number of commits (20)")
    parser.add_argument("--before", type=int, metavar="REVISION", help="those before a revision only")


def _run_history(arguments: argparse.Namespace) -> int:
    if not 1 <= arguments.most <= protocol.MAX_LISTED:
        raise InvalidValueError(f"-n is a number of commits from 1 to {protocol.MAX_LISTED}.")
    with _connect(arguments) as connection:
        found = connection.history(arguments.most, arguments.before)
    if arguments.json:
        print(json.dumps([_as_data(row) for row in found], allow_nan=False))
    elif found:
        rows = [(str(r.revision), _format_time(r.time), r.who, _format_operations(r)) for r in found]
        print(format_table(("revision", "time", "who", "operations"), rows, ">"))
    else:
        print("There are no commits.")
    return 0


HISTORY = ServerCommand(
    """\
In a line, + is added, - removed, ~ replaced, and again: run again because something before it has changed.

examples:
  kineverse history home
  kineverse history home -n 100
  kineverse history home --before 40 --json""",
    _run_history,
    _add_history_options,
)


def _add_watch_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--frames", metavar="FRAME", nargs="+", help="only what concerns these frames")
    parser.add_argument("--count", type=int, metavar="N", help="end after N commits")


def _run_watch(arguments: argparse.Namespace) -> int:
    if arguments.count is not None and arguments.count < 1:
        raise InvalidValueError("--count is a number of commits from 1.")
    arrived: SimpleQueue[Diff] = SimpleQueue()
    with handle_interrupts(), _join(arguments, frames=arguments.frames) as model:
        connection, is_online, shown, last = model.exchange, True, 0, model.version
        model.listen(arrived.put)
        print_line(f"{connection.address} is at revision {last}   (Ctrl-C ends)")
        while arguments.count is None or shown < arguments.count:
            try:
                diff = arrived.get(timeout=_PAUSE)
            except Empty:
                if connection.is_online != is_online:
                    is_online = connection.is_online
                    print_notes([f"the server {'is back' if is_online else 'has gone'}"])
                continue
            if diff.version <= last:  # of a part that was asked for again, as its server was started again
                continue
            last = diff.version
            print(_format_commit(diff, _find_row(connection, diff.version), arguments.json), flush=True)
            shown += 1
    return 0


def _find_row(connection: Connection, revision: int) -> protocol.HistoryRow | None:
    """Return who has made a commit and when; None if the server has gone."""
    try:
        return next(iter(connection.history(1, revision + 1)), None)
    except OfflineError:
        return None


def _format_commit(diff: Diff, row: protocol.HistoryRow | None, as_json: bool) -> str:
    """Return the line of a commit."""
    if as_json:
        data: dict[str, Any] = {"revision": diff.version, "time": row and row.time, "who": row and row.who}
        data |= {kind: getattr(diff, kind) for kind, _ in SIGNS}
        return json.dumps(data | {"paths": diff.paths})
    parts = [_format_time(row.time) if row else "", str(diff.version), row.who if row else "?"]
    parts.append(_format_operations(diff, colorize))
    return "  ".join([*parts, f"({_format_names(diff.paths)})"] if diff.paths else parts)


WATCH = ServerCommand(
    """\
Each commit is a line: when, its revision, who, the operations, and in brackets the paths of what has changed.
+ is added, - removed, ~ replaced, and again: run again because something before it has changed.

examples:
  kineverse watch home
  kineverse watch home --frames kitchen/fridge_door_handle
  kineverse watch home --count 1 --json               wait for the next commit""",
    _run_watch,
    _add_watch_options,
)


# -- edits ---------------------------------------------------------------------------------------------------


def _add_undo_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("revision", metavar="REVISION", type=int, help="number of the commit, see history")


def _run_undo(arguments: argparse.Namespace) -> int:
    with _join(arguments) as model:
        model.undo(arguments.revision)
        row = _find_row(model.exchange, arguments.revision)
        what = f" ({_format_operations(row)})" if row else ""
        print(f"revision {arguments.revision} is taken back{what}; now at revision {model.version}")
    return 0


UNDO = ServerCommand(
    """\
The commit of a revision is taken back by another one. If a later commit has changed the same, this one is
named, and nothing is done.

examples:
  kineverse history home
  kineverse undo home 12""",
    _run_undo,
    _add_undo_options,
    has_json=False,
)


def _add_dump_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", metavar="FILE", help="path of the new file")


def _run_dump(arguments: argparse.Namespace) -> int:
    path: str = arguments.file
    others = [one for one in writable_suffixes() if one not in DOCUMENT_SUFFIXES]
    if path.endswith(tuple(others)):
        raise FormatError(
            f"{path}: neither a backup nor a document has this suffix. "
            f"Try: kineverse convert {SCHEME}{arguments.server.removeprefix(SCHEME)} {path}"
        )
    if os.path.lexists(path):
        raise DuplicateNameError(f"{path} exists already. Name a new file.")
    if path.endswith(DOCUMENT_SUFFIXES):
        with _join(arguments) as model, show_activity(f"writing {path}"):
            revision = model.version
            model.save(path)
            print(f"{path}: {format_contents(model)}, revision {revision}")
        return 0
    with _connect(arguments) as connection, show_activity(f"writing {path}"):
        store = connection.backup(path)
    print(f"{path}: backup of {connection.address}, revision {store.revision}")
    return 0


DUMP = ServerCommand(
    f"""\
A name that ends in {" or ".join(DOCUMENT_SUFFIXES)} is a document: the model as it is now. Any other one is a
backup: a store with all commits, from which the model is served again. The server goes on meanwhile.

examples:
  kineverse dump home home-monday.db
  kineverse serve --store home-monday.db
  kineverse dump home home.kv.json""",
    _run_dump,
    _add_dump_options,
    has_json=False,
)


def _add_apply_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", metavar="FILE", help="path of a file, or name of a shipped model")
    parser.add_argument("--prefix", metavar="PREFIX", help="prefix of all names, followed by a slash")
    add_model_options(parser)


def _run_apply(arguments: argparse.Namespace) -> int:
    options = {"root": arguments.root, "strict": arguments.strict, "loops": arguments.loops}
    with _join(arguments) as model:
        with collect_warnings() as remarks, show_activity(f"reading {arguments.file}"):
            try:
                tags = model.transact(lambda edit: edit.include(arguments.file, arguments.prefix, **options))
            except DuplicateNameError as error:
                taken = str(error).partition(";")[0].rstrip(".")
                advice = "Put a prefix in front of all names with --prefix."
                raise DuplicateNameError(f"{taken}. {advice}") from None
        print_notes(truncate_lines([*dict.fromkeys(remarks)], REMARKS, ""))
        added = format_count(len(tags), "operation")
        print(f"{model.exchange.address}: {added} added, revision {model.version}")
    return 0


APPLY = ServerCommand(
    """\
The operations of the file are added in one edit: all of them, or none.

examples:
  kineverse apply home pr2
  kineverse apply home table.urdf --prefix left
  kineverse apply home articulations/screw""",
    _run_apply,
    _add_apply_options,
    has_json=False,
)


# -- relays --------------------------------------------------------------------------------------------------


def _add_relay_options(parser: argparse.ArgumentParser) -> None:
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


def _run_relay(arguments: argparse.Namespace) -> int:
    require("kineverse relay", {"exchange": True})
    from kineverse.exchange.relay import Relay  # for those who have no need of the package cryptography

    from .serve import list_addresses  # for start-up time

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


RELAY = ServerCommand(
    """\
The computers of a site connect to the relay, and the relay to the server, so that commits and states come to
the site once. It keeps nothing. Who may use it is in rights.toml in the folder of its keys, which 'kineverse
keys --relay' makes; what they may do, the server decides. If the server is away, the relay waits for it.

examples:
  kineverse relay live:tls/home.example.org:7410/home --listen tls/0.0.0.0:7410 --keys hamburg""",
    _run_relay,
    _add_relay_options,
    takes_name=False,
    has_json=False,
)


# -- parts of several ----------------------------------------------------------------------------------------


def _find_address(arguments: argparse.Namespace) -> Address:
    require(arguments.command.prog, {"exchange": True})
    name: str = arguments.server
    return Address.parse(name if name.startswith(SCHEME) else SCHEME + name)


def _connect(arguments: argparse.Namespace) -> closing[Connection]:
    """Connect to a server for questions alone."""
    return closing(Connection(_find_address(arguments)))


def _join(arguments: argparse.Namespace, frames: Sequence[str] | None = None) -> LiveModel:
    return load_live(str(_find_address(arguments)), frames=frames)


def _format_operations(
    changes: protocol.HistoryRow | Diff, paint: Callable[[str, str], str] = lambda text, sign: text
) -> str:
    """Return the operations that a commit concerns, by what was done with them."""
    texts = []
    for kind, sign in SIGNS:
        tags: tuple[str, ...] = getattr(changes, kind)
        if kind == "replaced":
            tags = tuple(tag for tag in tags if tag not in changes.moved)
        if tags:
            text = f"{sign} {_format_names(tags)}"
            texts.append(paint(text, sign) if len(sign) == 1 else text)
    return "  ".join(texts)


def _format_names(names: Sequence[str]) -> str:
    more = len(names) - SHOWN
    # One more name takes no more place than its number.
    return ", ".join(names if more <= 1 else [*names[:SHOWN], f"{more} more"])


def _format_time(seconds: float, now: float | None = None) -> str:
    """Return a time [s since 1970] on the clock of this place, with its date unless that is today's."""
    try:
        then, today = time.localtime(seconds), time.localtime(now)
        return time.strftime("%H:%M:%S" if then[:3] == today[:3] else "%Y-%m-%d %H:%M:%S", then)
    except (OverflowError, ValueError, OSError):  # of a server with a wrong clock
        return "?"


def _as_data(value: Any) -> Any:
    """Return a message as JSON data; nothing is an empty object."""
    if isinstance(value, Struct):
        return {name: _as_data(part) for name, part in structs.asdict(value).items()}
    if isinstance(value, tuple):
        return [_as_data(part) for part in value]
    return value.hex() if isinstance(value, bytes) else {} if value is None else value


def _add_key_options(parser: argparse.ArgumentParser) -> None:
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


def _run_keys(arguments: argparse.Namespace) -> int:
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


KEYS = ServerCommand(
    """\
A server that other computers reach knows its users by certificates of an authority. This makes the authority
in FOLDER, and the keys of the server, users and relays, each in a folder that is ready to be copied. Called
again, it adds to what is there. New users may see; rights.toml in the server's folder says who may edit.

Whoever has FOLDER/authority/key.pem can make users: keep FOLDER where nobody else reads it.

examples:
  kineverse keys home-keys --server home.example.org 192.0.2.7 --user alice bob
  kineverse keys home-keys --user carol
  kineverse keys home-keys --relay hamburg relay.hamburg.example.org
  kineverse keys home-keys --user bob --renew""",
    _run_keys,
    _add_key_options,
    takes_name=False,
    has_json=False,
)
