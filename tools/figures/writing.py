"""Tables written to their pages, from what their commands print."""

from __future__ import annotations

import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable

from .documented import DocumentedTable
from .pages import DOCS, ROOT, Table, find_titled_tables, write_block
from .short_forms import DATA


def write_tables(chosen: Iterable[DocumentedTable]) -> None:
    """Run the commands of some tables, each once, and write the tables."""
    commands: dict[str, list[DocumentedTable]] = {}
    for one in chosen:
        commands.setdefault(one.command, []).append(one)
    for command, tables in commands.items():
        sys.stderr.write(f"$ {command} --markdown\n")
        write_printed(run_command(command, any(one.data for one in tables)), tables)


def run_command(command: str, needs_data: bool) -> str:
    """Return what a command prints with ``--markdown``, or a target of make without.

    A command runs in the folder of other people's data, or in an empty one: some experiments take what they
    find.
    """
    words = shlex.split(command)
    if words[0] == "make":
        return subprocess.run(
            words, check=True, stdout=subprocess.PIPE, text=True, encoding="utf-8", cwd=ROOT
        ).stdout
    words = [sys.executable, "-m", *words, "--markdown"]
    with tempfile.TemporaryDirectory() as empty:
        folder = DATA if needs_data else empty
        return subprocess.run(
            words,
            check=True,
            stdout=subprocess.PIPE,
            text=True,
            encoding="utf-8",
            cwd=folder,
        ).stdout


def write_printed(printed: str, tables: Iterable[DocumentedTable]) -> None:
    """Write the tables that a command printed, with the command and the date below each."""
    today = time.strftime("%-d %B %Y")
    for one in tables:
        text = f"{find_table(printed, one)}\n`{one.command}`, {today}\n"
        write_block(DOCS / one.page, one.name, text)
        sys.stderr.write(f"{one.page}: {one.name}\n")


def find_table(printed: str, one: DocumentedTable) -> Table:
    """Return the columns of a table that its page has.

    Raises
    ------
    ValueError
        If there is no table of its title.
    """
    for title, table in find_titled_tables(printed):
        if title.startswith(one.title):
            return table.chosen(one.columns)
    raise ValueError(f"'{one.command}' prints no table '{one.title}'")
