"""The README: its tour is short, its commands work, and it says what the package is called.

That the tour prints what is printed below it is tested with the other pages in ``test_docs``.
"""

from __future__ import annotations

import shlex
import tomllib
from pathlib import Path

import pytest

from examples import ROOT, examples
from kineverse.cli import main

README = ROOT / "README.md"


def test_the_tour_is_short_and_shows_something() -> None:
    tour = next(iter(examples(README)))
    lines = [line for line in tour.code.splitlines() if line.strip()]
    assert len(lines) < 30
    assert tour.output is not None
    assert len(tour.output.splitlines()) >= sum("print(" in line for line in lines)


@pytest.mark.parametrize(
    "command",
    [
        line.removeprefix("$ ").partition("  #")[0]
        for example in examples(README, "console")
        for line in example.code.splitlines()
        if line.startswith("$ kineverse")
    ],
)
def test_the_commands_work(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    words = shlex.split(command)[1:]
    # What runs until it is interrupted, measures, or is about files of one's own is asked for its help instead.
    if words[0] in ("view", "bench", "diff", "decompose", "fit"):
        words = [words[0], "--help"]
    assert main(words) == 0
    assert capsys.readouterr().out


def test_the_two_commands_are_targets_of_make() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    text = README.read_text(encoding="utf-8")
    for target in ("demo", "test"):
        assert f"make {target}" in text
        assert f"\n{target}:" in makefile


def test_the_names_agree() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    text = README.read_text(encoding="utf-8")
    assert project["name"] in text
    for extra in project["optional-dependencies"]:
        assert f"`{extra}`" in text
