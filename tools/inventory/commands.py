"""Commands with their options, as the parser of each states them when it is asked for help."""

from __future__ import annotations

import argparse
import contextlib
import io
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from inventory.names import short


def commands(data: Path | None) -> dict[str, Any]:
    """Return all commands, and their options and arguments: ``command`` and ``command --option``."""
    return dict(describe([]))


def describe(words: list[str]) -> Iterator[tuple[str, Any]]:
    """Yield a command, its options and arguments, and the commands below it."""
    parser, text = ask_for_help(words)
    name = " ".join(words) or "kineverse"
    if parser is None:  # it prints its help without a parser
        yield name, {"help": text}
        below = re.findall(r"^ {2,4}([a-z][\w-]*) {2,}", text, re.MULTILINE)
    else:
        yield name, {"help": [parser.description or "", parser.epilog or ""]}
        below = []
        for action in parser._actions:
            if isinstance(action, argparse._SubParsersAction):
                below += [str(choice.dest) for choice in action._choices_actions] or list(action.choices)
            elif "--help" not in action.option_strings:
                yield (
                    f"{name} {'|'.join(action.option_strings) or action.metavar or action.dest}",
                    _option(parser, action),
                )
    for sub in sorted(below):
        if not words or parser is not None:
            yield from describe([*words, sub])


def _option(parser: argparse.ArgumentParser, action: argparse.Action) -> dict[str, Any]:
    try:
        wording = parser._get_formatter()._expand_help(action) if action.help else ""
    except (KeyError, ValueError):
        wording = action.help or ""
    return {
        "kind": type(action).__name__.strip("_"),
        "nargs": action.nargs,
        "default": short(action.default),
        "choices": sorted(map(str, action.choices)) if action.choices is not None else None,
        "required": action.required,
        "hidden": action.help == argparse.SUPPRESS,
        "metavar": short(action.metavar),
        "help": wording,
    }


def ask_for_help(words: list[str]) -> tuple[argparse.ArgumentParser | None, str]:
    """Return the parser that prints the help of a command, and what is printed."""
    from kineverse.cli import main

    caught: list[argparse.ArgumentParser] = []
    usual = argparse.ArgumentParser.format_help

    def format_help(parser: argparse.ArgumentParser) -> str:
        caught.append(parser)
        return usual(parser)

    argparse.ArgumentParser.format_help = format_help  # type: ignore[method-assign]
    try:
        with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(out):
            main([*words, "--help"])
    finally:
        argparse.ArgumentParser.format_help = usual  # type: ignore[method-assign]
    return (caught[-1] if caught else None), out.getvalue()
