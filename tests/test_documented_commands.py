"""Every command in the README and in ``docs/`` runs as printed, from the root of the checkout, after ``make demo``.

What takes minutes is asked for its list instead; ``KINEVERSE_WHOLE_COMMANDS=1`` runs it as printed. Pages in the browser are
opened, fetched once, and shut. A command that several pages name runs once, and examples run in ``test_examples.py``.
"""

from __future__ import annotations

import os
import re
import shlex
import sys
import tomllib
import urllib.request
from contextlib import nullcontext, suppress
from pathlib import Path

import pytest

from kineverse.cli import main
from kineverse.cli.command_line import COMMANDS, find_added_commands, make_parser
from markdown_examples import ROOT, agree, examples
from test_examples import SCRIPTS

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
IN_CONSOLES = [page for page in PAGES if any(examples(page, "console"))]

DIFFERENT = (
    "diff examples/door.urdf examples/door_new.urdf",
    "diff examples/door.urdf examples/door_new.urdf --values",
    "validate examples/door_new.urdf",
    "validate examples/door_new.urdf --motion",
    "validate examples/door.urdf examples/door_new.urdf kitchen",
)
"""What ends with status 1, as it finds what is to be shown."""

ESTIMATED = ("fit", "calibrate")
"""Whose last digits depend on the linear algebra of the machine."""

NARRATED = ("open",)
"""Commands that report their progress on standard error."""

WHOLE = bool(os.environ.get("KINEVERSE_WHOLE_COMMANDS"))


def _name(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def _commands(page: Path) -> list[tuple[str, str]]:
    """Return the commands of the consoles on a page, without what is said about them, and what they print."""
    return [
        (re.split(r"\s+#\s", command)[0].strip(), output)
        for example in examples(page, "console")
        for command, output in re.findall(r"^\$ (.*)\n((?:(?!\$ ).*\n)*)", example.code, re.MULTILINE)
    ]


def _page_that_runs(command: str) -> Path:
    """Return the first page that names a command, or rather the first that says what it prints."""
    return min(
        (not output, page) for page in IN_CONSOLES for said, output in _commands(page) if said == command
    )[1]


@pytest.fixture
def at_the_root(tmp_path, monkeypatch):
    """Stand in a folder that has what the commands name, and nothing that matters to lose."""
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["kineverse"])


@pytest.fixture
def pages(monkeypatch):
    """Fetch each page that is opened, instead of waiting until somebody has seen enough."""
    viewer = pytest.importorskip("kineverse.view.viewer")
    answers = []

    def fetch(page):
        with urllib.request.urlopen(page.address, timeout=30) as answer:
            answers.append((answer.status, b"<html" in answer.read().lower()))

    monkeypatch.setattr(viewer.Viewer, "wait", fetch)
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"):
        monkeypatch.delenv(name, raising=False)
    return answers


@pytest.mark.parametrize("page", IN_CONSOLES, ids=_name)
def test_documented_commands_print_the_documented_output(page, at_the_root, pages, capsys):
    for name in ("matplotlib", "coal", "coacd", "viser"):
        pytest.importorskip(name)
    opened = 0
    for command, output in _commands(page):
        program, *words = shlex.split(command)
        if program == ".":
            continue  # changes the shell only
        if program == "python":
            (script,) = words
            assert Path(script).resolve() in SCRIPTS, command
            continue
        assert program == "kineverse", command
        if not output and page != _page_that_runs(command):
            continue
        if words[0] == "bench" and not WHOLE:
            words, output = ["bench", "--list"], ""
        status, printed = main(words), capsys.readouterr()
        assert status == int(shlex.join(words) in DIFFERENT), command
        assert not printed.err or words[0] in NARRATED, command
        if output:
            rel = 0.02 if words[0] in ESTIMATED else 1e-6
            assert agree(output, printed.out, rel), f"{command} prints\n{printed.out}"
        else:
            assert printed.out, command
        listed = words[1:] in ([], ["articulations"])
        shown = words[0] == "view" or "--view" in words
        opened += shown and not listed and not {"--picture", "--plot"} & {*words}
    assert pages == [(200, True)] * opened


def test_commands_in_help_texts_parse(capsys):
    """Each line that begins with ``kineverse`` below a heading "examples"."""
    shown = [make_parser().format_help()]
    for name in [*COMMANDS, *find_added_commands()]:
        assert main([name, "--help"]) == 0
        shown.append(capsys.readouterr().out)
    lines = [
        line
        for text in shown
        for line in re.findall(r"^  (kineverse .*)$", text.partition("examples:")[2], re.MULTILINE)
    ]
    assert len(lines) > 3 * len(COMMANDS)
    for line in lines:
        _parsed(line)


@pytest.mark.parametrize("page", [page for page in PAGES if any(examples(page, "bash"))], ids=_name)
def test_commands_in_shell_blocks_parse(page):
    """Commands that take too long to run here, such as skills with physics."""
    for block in examples(page, "bash"):
        for line in re.findall(r"^kineverse .*", block.code.replace("\\\n", " "), re.MULTILINE):
            _parsed(line)


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_inline_commands_of_the_docs_parse(page, capsys):
    """Commands in the text, which need not be whole: command and options exist."""
    for said in re.findall(r"`kineverse\s([^`]+)`", page.read_text(encoding="utf-8")):
        command, *words = said.split()
        assert command in COMMANDS or command in find_added_commands(), said
        assert main([command, "--help"]) == 0
        options = set(re.findall(r"(?<![\w-])--?[a-z][a-z-]*", capsys.readouterr().out))
        assert {word for word in words if word.startswith("-")} <= options, said


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_targets_extras_and_tests_that_pages_name_exist(page):
    text = page.read_text(encoding="utf-8")
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for target in re.findall(r"^make ([a-z]+)|`make ([a-z]+)", text, re.M):
        assert f"\n{''.join(target)}:" in makefile
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    for extras in re.findall(r"pip install [^`\n]*'\.\[([a-z,]+)\]", text):
        assert set(extras.split(",")) <= set(project["optional-dependencies"])
    for path in re.findall(r"^pytest (tests/\S+)", text, re.M):
        assert (ROOT / path).exists()


def _parsed(command: str) -> None:
    words = shlex.split(re.split(r"\s{3,}|\s+#\s| [|>]", command)[0])[1:]
    with suppress(SystemExit) if "--help" in words else nullcontext():
        make_parser(words[0]).parse_args(words)
